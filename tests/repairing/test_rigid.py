"""Repairs with groups of vertices that move as a whole: each keeps its shape, and what is returned is certified."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

import warp_bsc as bsc
from warp_bsc.bench.scenes.repair import KINDS, damaged

CORNERS, BUTTON = 30, trimesh.creation.cylinder(0.06, 0.03, sections=24).subdivide()


def sheet_with_buttons(*places, turn=0.0):
    """Returns the faces and positions of a wavy sheet with buttons in it, and the group of each vertex."""
    u, v = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, CORNERS)] * 2, indexing="ij")).reshape(2, -1)
    i = np.arange(CORNERS**2).reshape(CORNERS, CORNERS)
    a, b, c, d = (corners.ravel() for corners in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    x, faces = [np.stack([u, v, 0.02 * np.sin(7.0 * u)], axis=1)], [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    count = len(BUTTON.vertices)
    for number, place in enumerate(places):
        turned = trimesh.transformations.rotation_matrix((1 + number) * turn, [1, 0, 0])
        x.append(trimesh.transform_points(BUTTON.vertices, turned) + place)
        faces.append(BUTTON.faces + CORNERS**2 + number * count)
    group = np.repeat(np.arange(-1, len(places)), [CORNERS**2] + [count] * len(places))
    return np.concatenate(faces), np.concatenate(x), group


def assert_rigid(before, after, group):
    """Checks that each group is moved by a rotation and a translation, up to rounding of its coordinates."""
    for number in np.unique(group[group >= 0]):
        x, y = (positions[group == number].astype(float) for positions in (before, after))
        lengths = [np.linalg.norm(z[:, None] - z[None], axis=2) for z in (x, y)]
        rounding = np.finfo(before.dtype).eps * max(np.abs(x).max(), np.abs(y).max())
        assert np.abs(lengths[0] - lengths[1]).max() <= 32.0 * rounding
        if len(x) > 3:  # not a mirror image
            a, b = (z - z.mean(axis=0) for z in (x, y))
            assert np.linalg.det(np.linalg.lstsq(a, b, rcond=1e-6)[0]) >= -1e-6


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("fixed", "turn"),
    [
        ("nothing", 0.7),
        ("sheet", 0.0),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in (("nothing", 0.0), ("sheet", 0.7))),
    ],
)
def test_buttons_leave_a_sheet_as_a_whole(dtype, turn, fixed):
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0], [0.7, 0.6, -0.015], turn=turn)
    x = x.astype(dtype)
    stays = group < 0 if fixed == "sheet" else []
    result = bsc.repair(faces, x, rigid=group, fixed=stays, device="cpu")
    assert result.crossings_before > 50 and result.certified and result.max_strain <= 0.1
    mesh = bsc.CollisionMesh(faces, len(x), device="cpu")
    assert not len(bsc.CollisionDetector(mesh).find_intersections(result.x))
    assert_rigid(x, result.x, group)
    assert result.moved[group >= 0].any()
    free = bsc.repair(faces, x, fixed=stays, device="cpu")
    with pytest.raises(AssertionError):
        assert_rigid(x, free.x, group)


def test_sets_of_vertices_are_groups_as_well():
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0], [0.7, 0.6, -0.015])
    by_number = bsc.repair(faces, x, rigid=group, device="cpu")
    by_set = bsc.repair(faces, x, rigid=[np.flatnonzero(group == 0), group == 1], device="cpu")
    assert by_number.x.tobytes() == by_set.x.tobytes()


def test_a_group_with_a_fixed_vertex_stays():
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0])
    result = bsc.repair(faces, x, rigid=group, fixed=[CORNERS**2 + 5], device="cpu")
    assert result.certified and not result.moved[group == 0].any() and result.moved.any()


def test_what_crosses_within_a_group_stays_and_is_named():
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0], [0.3317, 0.3071, 0.0123], turn=0.3)
    of_buttons = bsc.CollisionMesh(faces[group[faces[:, 0]] >= 0], len(x), device="cpu")
    expected = len(bsc.CollisionDetector(of_buttons).find_intersections(x))
    result = bsc.repair(faces, x, rigid=np.minimum(group, 0), device="cpu")
    assert not result.certified and result.crossings_before > result.crossings == expected > 0
    assert {contour.reason for contour in result.unresolved} == {"both of its sides are of one rigid group"}
    assert_rigid(x, result.x, np.minimum(group, 0))
    apart = bsc.repair(faces, x, rigid=group, device="cpu")
    assert apart.certified
    assert_rigid(x, apart.x, group)


def test_groups_of_a_seam_are_one():
    """The button is cut into two halves, whose borders are in one place."""
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0])
    is_second = (group[faces[:, 0]] == 0) & (x[faces, 0].mean(axis=1) > 0.3)
    doubled, numbers = np.unique(faces[is_second], return_inverse=True)
    faces = faces.copy()
    faces[is_second] = len(x) + numbers.reshape(-1, 3)
    x, group = np.concatenate([x, x[doubled]]), np.append(group, np.ones(len(doubled), int))
    group[~np.isin(np.arange(len(x)), faces)] = -1
    result = bsc.repair(faces, x, rigid=group, device="cpu")
    assert result.certified and result.doubled > 10 and result.moved[group >= 0].all()
    assert_rigid(x, result.x, np.minimum(group, 0))


def test_groups_come_from_another_pose_of_a_configuration_before():
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0], [0.7, 0.6, -0.015])
    before = x + np.where(group < 0, 0.0, 0.2)[:, None] * [0.0, 0.0, 1.0]
    middle = before[group == 1].mean(axis=0)
    turned = trimesh.transformations.rotation_matrix(0.4, [1.0, 2.0, 0.0], middle)
    before[group == 1] = trimesh.transform_points(before[group == 1], turned)
    result = bsc.repair(faces, x, rigid=group, x_previous=before, device="cpu")
    assert result.certified and result.moved.max() < 0.1
    assert_rigid(x, result.x, group)
    heights = (result.x - x)[:, 2]
    assert all(heights[group == number].mean() > 0.0 for number in (0, 1))


def test_a_minimum_distance_is_kept_by_groups():
    faces, x, group = sheet_with_buttons([0.3, 0.3, 0.0], [0.36, 0.36, 0.02])
    result = bsc.repair(faces, x, rigid=group, min_distance=0.004, device="cpu")
    assert result.certified and not result.near and result.near_before > 100
    assert_rigid(x, result.x, group)
    assert least_distance(faces, result.x, group) >= 0.004


def least_distance(faces, x, group):
    """The least distance of vertices of each part from the faces of the others, by trimesh."""
    least = np.inf
    for number in np.unique(group):
        points, others = x[group == number], x[faces[group[faces[:, 0]] != number]]
        for point in points:
            closest = trimesh.triangles.closest_point(others, np.broadcast_to(point, (len(others), 3)))
            least = min(least, np.linalg.norm(closest - point, axis=1).min())
    return least


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k == "stacks")) for k in KINDS])
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 19), single=st.booleans(), part=st.integers(0, 2))
def test_patches_of_damaged_meshes_keep_their_shapes(kind, seed, single, part):
    scene = damaged(kind, seed)
    x = scene.x.astype(np.float32) if single else scene.x
    middle = x[scene.faces[(part * len(scene.faces)) // 3, 0]]
    near = np.linalg.norm(x - middle, axis=1) < 0.1
    result = bsc.repair(scene.faces, x, fixed=scene.fixed, rigid=[near], device="cpu")
    assert_rigid(x, result.x, np.where(near, 0, -1))
    assert result.crossings <= result.crossings_before
    mesh = bsc.CollisionMesh(scene.faces, len(x), device="cpu")
    assert result.crossings == len(bsc.CollisionDetector(mesh).find_intersections(result.x))
    assert not result.certified or not result.crossings
