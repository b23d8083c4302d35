"""The depth of meshes behind surfaces, against known depths and a brute-force computation."""

from collections import deque

import numpy as np
import pytest
import trimesh
from pxr import UsdGeom, Vt
from usd_stages import new_stage, save

import warp_bsc as bsc
from warp_bsc.scene_replay import depths as depths_module
from warp_bsc.scene_replay.depths import DepthFinder, DepthRecorder

BALL = trimesh.creation.icosphere(subdivisions=3, radius=1.0)


def grid(side, size=2.0, count=13, height=0.0):
    """A square of triangles, `size` wide, its middle at the origin; the vertices are not below those of others."""
    x, y = np.meshgrid(np.linspace(-size / 2, size / 2, count), np.linspace(-size / 2, size / 2, count), indexing="ij")
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1, 1)
    a, b, c, d = (corner + np.array([0, count, count + 1, 1])).T
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x + 0.013, y + 0.007, np.full_like(x, height)], axis=2).reshape(-1, 3)[:, side], faces


def depths(folder, meshes):
    """The depths at the first time, of meshes given by name as vertices and faces, and the intersections."""
    stage = new_stage(folder / "scene.usda")
    for name, (vertices, faces) in meshes.items():
        mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(vertices, dtype=np.float32)))
        mesh.CreateFaceVertexCountsAttr([3] * len(faces))
        mesh.CreateFaceVertexIndicesAttr(np.asarray(faces).reshape(-1).tolist())
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    found = DepthFinder().find(result.intersections[0])
    short = {tuple(name.removeprefix("/World/") for name in pair): depth for pair, depth in found.items()}
    return short, result.intersections[0]


UP = [0, 1, 2]


@pytest.mark.parametrize(("most_work", "times"), [(1_000_000, [0, 1, 2, 3, 4]), (0, [0, 1])])
def test_depths_of_large_scenes_are_measured_where_more_crosses(tmp_path, monkeypatch, most_work, times):
    """A ball sinks to its middle and beyond: its depth is the largest where the sheet cuts the most of its edges."""
    monkeypatch.setattr(depths_module, "_MOST_WORK", most_work)
    stage = new_stage(tmp_path / "scene.usda")
    for name, (vertices, faces) in {"Ball": (BALL.vertices, BALL.faces), "Sheet": grid(UP, 4.0)}.items():
        mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        for time, height in enumerate((0.9, 0.0, -0.1, 0.0, 0.05)):
            moved = np.asarray(vertices) + np.array([0, 0, height * (name == "Ball")])
            mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(moved.astype(np.float32)), time)
        mesh.CreateFaceVertexCountsAttr([3] * len(faces))
        mesh.CreateFaceVertexIndicesAttr(np.asarray(faces).reshape(-1).tolist())
    recorder, measured, find = DepthRecorder(), [], DepthFinder.find
    monkeypatch.setattr(DepthFinder, "find", lambda own, found: measured.append(found.time) or find(own, found))
    for result in bsc.replay(bsc.Scene(save(stage)), device="cpu"):
        recorder.add(result.intersections)
    assert recorder.largest() == {("/World/Ball", "/World/Sheet"): (pytest.approx(1.0, abs=1e-5), 1.0)}
    assert measured == times


@pytest.mark.parametrize("height", [0.85, -0.4])
def test_ball_through_a_sheet(tmp_path, height):
    ball = BALL.vertices, BALL.faces
    found, _ = depths(tmp_path, {"Ball": ball, "Sheet": grid(UP, 4.0, height=height)})
    # the smaller cap, or the sheet's vertices inside: at most as deep, where they are not above the middle
    cap = BALL.vertices[:, 2].max() - abs(height)
    assert found == {("Ball", "Sheet"): pytest.approx(cap, abs=1e-5)}


def test_depth_does_not_depend_on_how_much_is_on_a_side(tmp_path):
    """Most of the cloth is under the table's top: the depth is the distance from the top, not of what hangs down."""
    table = trimesh.creation.box((2.0, 2.0, 1.0)).subdivide().subdivide()
    points, faces = grid(UP, 2.6, count=27)
    outside = np.maximum(np.abs(points[:, :2]).max(axis=1) - 1.0, 0.0)
    points[:, 2] = 0.46 + np.where(outside > 0, 0.3, 0.0) + 2.0 * outside
    found, _ = depths(tmp_path, {"Cloth": (points, faces), "Table": (table.vertices, table.faces)})
    assert found["Cloth", "Table"] == pytest.approx(0.04, abs=0.02)


def test_needle_through_a_sheet(tmp_path):
    needle = [(0.1, 0.05, -0.7), (0.12, 0.05, 5.0), (0.1, 0.08, 5.0)], [(0, 1, 2)]
    found, _ = depths(tmp_path, {"Needle": needle, "Sheet": grid(UP)})
    assert found == {("Needle", "Sheet"): pytest.approx(0.7, abs=1e-6)}


def test_fin_through_a_sheet(tmp_path):
    """The sheet extends far on both sides of the fin: the fin is what would have to move.

    Its end is beyond the sheet, around which its edges connect both sides.
    """
    corners = [(x, 0.05, z) for z in (-0.25, -0.1, 0.1, 0.5) for x in (0.3, 3.0)]
    fin = corners, [face for i in (0, 2, 4) for face in ((i, i + 1, i + 3), (i, i + 3, i + 2))]
    found, _ = depths(tmp_path, {"Fin": fin, "Sheet": grid(UP)})
    assert found == {("Fin", "Sheet"): pytest.approx(0.25, abs=1e-6)}


def test_where_nothing_is_divided_the_plane_counts(tmp_path):
    """Two triangles that cut into each other from the side, with all ends beyond the border of the other one."""
    flag = [(-1.0, 0.0, -0.4), (-1.0, 0.0, 0.3), (1.5, 0.0, -0.2)], [(0, 1, 2)]
    other = [(1.0, -1.0, -0.05), (1.0, 1.0, 0.02), (-0.5, 0.1, 0.01)], [(0, 1, 2)]
    found, at_rest = depths(tmp_path, {"Flag": flag, "Other": other})
    a, b, c = (np.array([corners[0][k] for corners in (flag, other)]) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    ends = at_rest.x[at_rest.vertices[:, 0]]
    faces = at_rest.faces[:, 1]
    expected = np.abs(np.einsum("nki,ni->nk", ends - a[faces][:, None], normal[faces])).min(axis=1).max()
    assert found == {("Flag", "Other"): pytest.approx(expected, abs=1e-6)}


def test_parts_inside_and_touching(tmp_path):
    small = np.array(trimesh.creation.icosphere(subdivisions=1, radius=0.2).vertices) + np.array([0.5, 0.0, 0.0])
    outer = trimesh.creation.box((4.0, 4.0, 4.0))
    touching = [(2.0, 0.1, 0.1), (3.0, 0.0, 0.0), (3.0, 0.3, 0.0)], [(0, 1, 2)]
    inner = small, trimesh.creation.icosphere(subdivisions=1).faces
    found, _ = depths(tmp_path, {"Inner": inner, "Outer": (outer.vertices, outer.faces), "Touching": touching})
    deepest = 2.0 - np.abs(small).max(axis=1).min()  # of the vertex that is farthest from every wall
    assert 1.6 < deepest < 1.75
    assert found == {("Inner", "Outer"): pytest.approx(deepest, abs=1e-5), ("Outer", "Touching"): 0.0}


def test_mesh_through_itself(tmp_path):
    """A folded sheet whose upper half has two bumps through the lower half, the second one deeper."""
    points, faces = grid(UP, 2.0, count=25)
    x, y = points[:, 0].copy(), points[:, 1].copy()
    is_upper = x > 0
    points[:, 0] = -np.abs(x)
    points[:, 1] += np.where(is_upper, 0.031 * x, 0.0)  # no edges above each other
    points[:, 2] = np.where(is_upper, 0.2, 0.0) - 0.05 * np.abs(x) + 0.011 * np.sin(7 * x + 3 * y)
    for center, height in (((0.6, -0.5), 0.33), ((0.55, 0.45), 0.41)):
        points[:, 2] -= np.where(is_upper, height * np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / 0.02), 0.0)
    points = points.astype(np.float32).astype(float)
    found, at_rest = depths(tmp_path, {"Sheet": (points, faces)})
    assert at_rest.crossings > 10
    expected = brute_depth(points, faces, points, faces, is_own=True)
    assert found == {("Sheet", "Sheet"): pytest.approx(expected, abs=1e-5)}
    assert 0.15 < expected < 0.22


@pytest.mark.parametrize("seed", range(3))
def test_waving_sheets_by_brute_force(tmp_path, seed):
    """Sheets that are as large as each other, and that pass through each other in many places."""
    rng = np.random.default_rng(seed)
    sheets = []
    for size in (2.0, 2.6):
        points, faces = grid(UP, size, count=15)
        waves = rng.uniform(1.5, 4.0, (3, 2))
        points[:, 2] = sum(0.12 * np.sin(points[:, :2] @ wave + rng.uniform(0, 6)) for wave in waves)
        points += rng.uniform(-0.01, 0.01, points.shape)
        sheets.append((points.astype(np.float32).astype(float), faces))
    found, at_rest = depths(tmp_path, {"A": sheets[0], "B": sheets[1]})
    assert at_rest.crossings > 10
    expected = min(brute_depth(*sheets[0], *sheets[1]), brute_depth(*sheets[1], *sheets[0]))
    assert found == {("A", "B"): pytest.approx(expected, abs=2e-5)}


def test_edges_through_sides_pass_once(tmp_path):
    """The edges of two grids above each other meet in common points, where four faces have two rows for a passage."""
    (low, faces), (high, _) = grid(UP), grid(UP)
    high[:, 2] = np.where(np.hypot(high[:, 0] - 0.013, high[:, 1] - 0.007) < 0.4, -0.2, 0.1)
    found, at_rest = depths(tmp_path, {"Low": (low, faces), "High": (high, faces)})
    positions = np.round(at_rest.position[at_rest.crosses], 6)
    assert len(np.unique(positions, axis=0)) < len(positions)
    lowest = brute_depth(high, faces, low, faces, dodge=True)
    assert found == {("High", "Low"): pytest.approx(max(lowest, 0.1), abs=1e-5)}


# The brute-force computation ------------------------------------------------------------------------------------------


def closest(point, corners):
    """The points of triangles, shape [n, 3, 3], that are closest to a point, shape [n, 3]."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    found = [point - normal * ((point - a) * normal).sum(axis=1)[:, None]]
    is_inside = np.ones(len(corners), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        is_inside &= (np.cross(along, found[0] - start) * normal).sum(axis=1) >= 0
        share = ((point - start) * along).sum(axis=1) / (along * along).sum(axis=1)
        found.append(start + np.clip(share, 0, 1)[:, None] * along)
    lengths = np.linalg.norm(np.array(found) - point, axis=2)
    lengths[0, ~is_inside] = np.inf
    return np.array(found)[lengths.argmin(axis=0), np.arange(len(corners))]


def passes(p, q, corners):
    """Whether an edge passes through triangles, shape [n, 3, 3]."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    volumes = np.array([np.cross(x - p, y - p) @ (q - p) for x, y in ((a, b), (b, c), (c, a))])
    beside = ((p - a) * normal).sum(axis=1) * ((q - a) * normal).sum(axis=1)
    return (beside < 0) & ((volumes > 0).all(axis=0) | (volumes < 0).all(axis=0))


def gap(point, corners):
    return np.linalg.norm(closest(point, corners) - point, axis=1).min()


def brute_depth(points, faces, others, other_faces, is_own=False, dodge=False):
    """The depth of one mesh behind another by the definition: vertex by vertex, face by face."""
    points, others = np.asarray(points, dtype=float), np.asarray(others, dtype=float)
    shifted = points + np.array([1.3e-4, 0.7e-4, 0]) if dodge else points  # off the sides, for the passages alone
    edges = sorted({tuple(sorted((face[i - 1], face[i]))) for face in faces for i in range(3)})
    sides = [tuple(sorted((face[i - 1], face[i]))) for face in other_faces for i in range(3)]
    border = {side for side in sides if sides.count(side) == 1}

    corners = others[np.array(other_faces)]

    def passages(i, j):
        strange = ~np.isin(other_faces, (i, j)).any(axis=1) if is_own else slice(None)
        return passes(shifted[i], shifted[j], corners[strange]).sum()

    odd = {edge for edge in edges if passages(*edge) % 2}
    distance, left_out = np.zeros(len(points)), set()
    if not is_own:
        for number, point in enumerate(points):
            feet = closest(point, corners)
            lengths = np.linalg.norm(feet - point, axis=1)
            distance[number], foot = lengths.min(), feet[lengths.argmin()]
            if any(on_segment(foot, *others[list(side)]) for side in border):
                left_out.add(number)
    neighbours = {number: [] for number in range(len(points))}
    for i, j in edges:
        if not {i, j} & left_out:
            neighbours[i].append((j, (i, j) in odd))
            neighbours[j].append((i, (i, j) in odd))
    depth, seen = 0.0, set()
    for start in range(len(points)):
        if start in seen or start in left_out:
            continue
        side, queue, is_divided = {start: 0}, deque([start]), True
        while queue:
            vertex = queue.popleft()
            for other, flips in neighbours[vertex]:
                if other not in side:
                    side[other] = side[vertex] ^ flips
                    queue.append(other)
                is_divided &= side[other] == side[vertex] ^ flips
        seen |= set(side)
        assert is_divided
        members = [[vertex for vertex in side if side[vertex] == which] for which in (0, 1)]
        if all(members) and is_own:
            for own in regions(min(members, key=len), set(edges) - odd):
                outside = corners[~np.isin(other_faces, own).any(axis=1)]
                depth = max(depth, *(gap(points[vertex], outside) for vertex in own))
        elif all(members):
            depth = max(depth, min(max(distance[vertex] for vertex in side) for side in members))
    return depth


def regions(vertices, edges):
    """The vertices as lists of those that edges connect."""
    left = set(vertices)
    while left:
        found, queue = [], [left.pop()]
        while queue:
            found.append(queue.pop())
            nearby = {j for i, j in edges if i == found[-1]} | {i for i, j in edges if j == found[-1]}
            queue += nearby & left
            left -= nearby
        yield found


def on_segment(point, start, end):
    return abs(np.linalg.norm(point - start) + np.linalg.norm(point - end) - np.linalg.norm(end - start)) < 1e-9
