"""Repairs of states of Newton models: legal starts, of which nothing crosses and nothing is inside a solid."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp

import warp_bsc as bsc
from warp_bsc.bench.crossings import CrossingCounter

CELLS = 12
NOWHERE = wp.quat_identity()


def add_cloth(builder, place, turn=NOWHERE, **options):
    """Adds a square of cloth of 0.6 m whose corner is at a place."""
    cell = 0.6 / CELLS
    options = {"mass": 0.001, "tri_ke": 100.0, "tri_ka": 100.0, "edge_ke": 0.01, "vel": wp.vec3()} | options
    builder.add_cloth_grid(pos=wp.vec3(*place), rot=turn, dim_x=CELLS, dim_y=CELLS, cell_x=cell, cell_y=cell, **options)


def add_block(builder, place, cells=5):
    """Adds a soft block of 0.2 m."""
    size = {f"cell_{axis}": 0.2 / cells for axis in "xyz"} | {f"dim_{axis}": cells for axis in "xyz"}
    stiffness = {"k_mu": 1e4, "k_lambda": 1e4, "k_damp": 0.0}
    builder.add_soft_grid(pos=wp.vec3(*place), rot=NOWHERE, vel=wp.vec3(), density=100.0, **size, **stiffness)


def repaired(builder, device, *, certified=True, **options):
    """Repairs the start of a model, and checks what holds for every result; returns the model too."""
    builder.color()
    model = builder.finalize(device=device)
    state = model.state()
    before = state.particle_q.numpy()
    result = bsc.repair_state(model, state, **options)
    after = state.particle_q.numpy()
    assert np.array_equal(result.x, after)
    still = result.moved == 0.0
    assert after[still].tobytes() == before[still].tobytes()
    assert still[model.particle_inv_mass.numpy() == 0.0].all()
    assert result.certified == certified
    assert result.inverted == result.inverted_before
    assert CrossingCounter(model).count(state) == result.crossings <= result.crossings_before
    if certified:
        check_steps(model, state)
    return result, model


def check_steps(model, state):
    """Steps a model behind the stage, which must not warn, and must certify each step."""
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=2))
    other, control = model.state(), model.control()
    for _ in range(2):
        state.clear_forces()
        solver.step(state, other, control, None, 1.0 / 480.0)
        state, other = other, state
    totals = solver.report.totals
    assert (totals.crossing_steps, totals.uncertified_steps, totals.excluded) == (0, 0, 0)


@pytest.mark.parametrize(
    "solid",
    [
        {"type": "box", "hx": 0.1, "hy": 0.1, "hz": 0.1},
        {"type": "sphere", "radius": 0.12},
    ],
)
def test_cloth_leaves_a_shape(solid, device):
    builder = newton.ModelBuilder()
    kind = solid.pop("type")
    getattr(builder, f"add_shape_{kind}")(body=-1, **solid)
    add_cloth(builder, (-0.31, -0.29, 0.08))
    result, _ = repaired(builder, device)
    assert result.crossings_before > 10 and result.inside_before > 5
    assert result.moved.max() < 0.06
    assert result.max_strain < 0.15


@pytest.mark.parametrize("height", [-0.03, -0.01])
def test_cloth_leaves_the_ground(height, device):
    """Wholly or partly behind an infinite plane, also a tilted one, it comes in front."""
    builder = newton.ModelBuilder()
    builder.add_shape_plane(plane=(0.0, 0.6, 0.8, 0.0), width=0.0, length=0.0)
    about_x = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), -float(np.arctan2(0.6, 0.8)) + 0.03)
    add_cloth(builder, (-0.3, -0.1 + 0.6 * height, 0.08 + 0.8 * height), about_x)
    result, _ = repaired(builder, device)
    assert result.inside_before > 20
    assert len(result.inside) == result.crossings_before == 0


def test_soft_blocks_part_and_none_of_their_tetrahedra_inverts(device):
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for k in range(3):
        add_block(builder, (0.05 * k, 0.03 * k, 0.19 * k - 0.01))
    result, model = repaired(builder, device)
    assert result.crossings_before > 50 and result.inside_before > 50
    assert result.inverted == 0
    x, tets = result.x.astype(float), model.tet_indices.numpy().reshape(-1, 4)
    sides = x[tets[:, 1:]] - x[tets[:, :1]]
    assert (np.linalg.det(sides) > 0.0).all()


def test_a_rope_comes_out_of_cloth_end_first(device):
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0))
    rope = [builder.add_particle(wp.vec3(0.011, 0.007, 0.05 - 0.03 * k), wp.vec3(), 0.001) for k in range(6)]
    for one, next_one in itertools.pairwise(rope):
        builder.add_spring(one, next_one, 100.0, 0.0, 0)
    result, _ = repaired(builder, device, min_distance=0.002)
    assert (result.crossings_before, result.near) == (1, 0)


def test_sheets_change_places_by_their_order(device):
    """The outer sheet has gone through the inner one from border to border: the order tells what is right."""
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0))
    add_cloth(builder, (-0.307, -0.309, -0.03), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.1))
    count = builder.particle_count // 2
    result, _ = repaired(builder, device, order=np.repeat([0, 1], count))
    assert result.crossings_before > 10
    inner, outer = result.x[:count], result.x[count:]
    nearest = np.linalg.norm(outer[:, None, :2] - inner[None, :, :2], axis=2).argmin(axis=1)
    assert (outer[:, 2] > inner[nearest, 2] - 0.005).all()


def test_sheets_without_an_order_are_put_into_the_nearer_one_which_is_told(device):
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0))
    add_cloth(builder, (-0.307, -0.309, -0.03), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.1))
    result, _ = repaired(builder, device)
    assert result.crossings_before > 10
    assert sorted(set(result.order)) == [0, 1]


def test_cloth_that_is_folded_flat_opens_by_a_little(device):
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0))
    builder.particle_q = [wp.vec3(-abs(x), y + 0.1 * max(x, 0.0), z) for x, y, z in builder.particle_q]
    result, _ = repaired(builder, device)
    assert result.crossings_before > 100
    assert result.moved.max() < 0.01 and result.max_strain < 0.02


def test_cloth_that_crosses_itself_from_its_border_is_opened(device):
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0))
    u, v, _ = np.array(builder.particle_q).T / 0.3
    w = 0.8 * v - 0.1
    builder.particle_q = list(map(wp.vec3, 0.3 * np.stack([1.2 * u, w**3 - 0.6 * u * w, 0.8 * w * w], axis=1)))
    result, _ = repaired(builder, device)
    assert result.crossings_before > 10


def test_what_stays_is_named_by_particles_and_changes_no_bit(device):
    """Kinematic particles in a box hold cloth that passes through its sides."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(body=-1, hx=0.1, hy=0.1, hz=0.1)
    add_cloth(builder, (-0.31, -0.29, 0.01))
    is_inside = (np.abs(np.array(builder.particle_q)) < 0.1).all(axis=1)
    builder.particle_mass = np.where(is_inside, 0.0, 0.001).tolist()
    result, model = repaired(builder, device, certified=False)
    assert result.crossings == result.crossings_before > 0 and not result.moved.any()
    for contour in result.unresolved:
        edges, faces = result.mesh.edges[contour.elements[:, 0]], result.mesh.faces[contour.elements[:, 1]]
        assert ((edges.min(axis=1) < model.particle_count) | (faces.min(axis=1) < model.particle_count)).all()
        assert contour.reason


def test_pairs_that_are_too_near_part(device):
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0))
    add_cloth(builder, (-0.3, -0.3, 0.001))
    result, _ = repaired(builder, device, min_distance=0.004)
    assert result.near_before > 100 and result.near == 0
    assert result.max_strain < 0.01


def test_kinematic_cloth_stays_and_seams_do_not_part(device):
    """Cloth with doubled vertices at a seam, pushed through a kinematic patch."""
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.3, -0.3, 0.0), mass=0.0)
    x = np.array([[u, v, 0.03 * np.cos(12.0 * u) * np.cos(12.0 * v) + 0.02] for u in LINE for v in LINE])
    half = (CELLS + 1) * 6
    for part in (x[: half + CELLS + 1], x[half:]):
        n = len(part) // (CELLS + 1)
        i = np.arange(len(part)).reshape(n, CELLS + 1)
        a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
        faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        builder.add_cloth_mesh(
            pos=wp.vec3(), rot=NOWHERE, scale=1.0, vel=wp.vec3(), vertices=part, indices=faces.ravel(), density=0.1
        )
    builder.color()
    model = builder.finalize(device=device)
    state = model.state()
    result = bsc.repair_state(model, state)
    assert result.certified and result.crossings_before > 10
    first = (CELLS + 1) ** 2
    assert not result.moved[:first].any()
    seams = first + half + np.arange(CELLS + 1), first + half + CELLS + 1 + np.arange(CELLS + 1)
    assert np.array_equal(result.x[seams[0]], result.x[seams[1]])
    assert result.moved[seams[0]].any()


LINE = np.linspace(-0.25, 0.25, CELLS + 1)


def test_worlds_are_repaired_by_themselves(device):
    """Cloth in the shape of another world is not inside it, and a free world keeps every bit."""
    tangled, free = newton.ModelBuilder(), newton.ModelBuilder()
    tangled.add_shape_box(body=-1, hx=0.1, hy=0.1, hz=0.1)
    for builder in (tangled, free):
        add_cloth(builder, (-0.31, -0.29, 0.08))
    worlds = newton.ModelBuilder()
    worlds.add_world(tangled)
    worlds.add_world(free)
    worlds.add_world(tangled)
    result, model = repaired(worlds, device)
    moved = [result.moved[model.particle_world.numpy() == world].max() for world in range(3)]
    assert moved[0] == moved[2] > 0.0 == moved[1]


def test_the_stage_names_the_repair_when_a_start_crosses(device):
    builder = newton.ModelBuilder()
    builder.add_shape_box(body=-1, hx=0.1, hy=0.1, hz=0.1)
    add_cloth(builder, (-0.31, -0.29, 0.08))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=2))
    with pytest.warns(UserWarning, match=r"repair_state.*unresolved.*order"):
        solver.step(model.state(), model.state(), model.control(), None, 1.0 / 480.0)
        assert solver.report.crossings > 0
    assert "repair_state" in str(solver.report)


def test_positions_that_are_not_finite_are_refused(device):
    builder = newton.ModelBuilder()
    add_cloth(builder, (0.0, 0.0, 0.0))
    model = builder.finalize(device=device)
    state = model.state()
    x = state.particle_q.numpy()
    x[7, 1] = np.nan
    state.particle_q.assign(x)
    with pytest.raises(ValueError, match=r"positions of the state\[7\]"):
        bsc.repair_state(model, state)


def test_a_body_deep_in_the_ground_leaves_it_as_a_whole(device):
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    add_block(builder, (0.0, 0.0, -0.15))
    result, _ = repaired(builder, device)
    assert result.inside_before > 100 and len(result.inside) == 0
    assert 0.15 < result.moved.max() < 0.17
    assert result.max_strain < 0.15
