"""Programs as they come: resting cloth, positions that are not finite, shapes that leave no room, and many worlds."""

import importlib

import newton
import newton.examples
import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from newton_scenes import (
    DT,
    SOFT,
    Changed,
    Rollout,
    add_patch,
    add_plates,
    bullet,
    place_plates,
)

import warp_bsc as bsc
from warp_bsc.response.state.structs import DIVIDED, PROJECTED
from warp_bsc.response.tuning import MAX_ITERATIONS, MAX_STUCK_ITERATIONS


def check_rest(rollout, dt, steps):
    """Asserts that cloth which comes to rest is projected in each step, and never cut or frozen."""
    touched = 0
    for _ in range(steps):
        rollout.step(dt)
        touched += rollout.solver.report.predicted_contacts > 0
    report = rollout.solver.report
    assert (report.totals.truncated_steps, report.totals.frozen_steps, report.totals.uncertified_steps) == (0, 0, 0)
    assert rollout.collisions == 0 and touched > 0.1 * steps


@pytest.mark.parametrize(
    ("dt", "steps"), [(1.0 / 60.0, 24), pytest.param(1.0 / 240.0, 48, marks=pytest.mark.slow), (1.0 / 1920.0, 60)]
)
def test_a_drape(dt, steps, device):
    """Cloth comes to rest on a sphere."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(body=-1, radius=0.2, cfg=newton.ModelBuilder.ShapeConfig(mu=0.5))
    options = {"dim_x": 10, "dim_y": 10, "cell_x": 0.08, "cell_y": 0.08, "mass": 0.0005, **SOFT}
    builder.add_cloth_grid(pos=wp.vec3(-0.4, -0.4, 0.2005), rot=wp.quat_identity(), vel=wp.vec3(), **options)
    builder.color()
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverVBD(model, iterations=10)
    check_rest(Rollout(model, bsc.SolverCCD(inner, friction=0.5)), dt, steps)


def accordion(columns, rows, cell, gap):
    """A strip folded into four layers: positions and faces."""
    side, radius = 0.25 * columns * cell, 0.5 * gap
    straight = side - np.pi * radius
    along = cell * np.arange(columns + 1)
    layer = np.minimum((along / side).astype(int), 3)
    u = along - layer * side
    turn = np.maximum(u - straight, 0.0) / radius
    x = np.minimum(u, straight) + radius * np.sin(turn)
    x = np.where(layer % 2 == 0, x, straight - x)
    z = 0.02 + layer * gap + radius * (1.0 - np.cos(turn))
    y = cell * np.arange(rows + 1)
    positions = np.stack([np.repeat(x, rows + 1), np.tile(y, columns + 1), np.repeat(z, rows + 1)], axis=1)
    a = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    b, c, d = a + rows + 1, a + rows + 2, a + 1
    return positions, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


@pytest.mark.parametrize(("dt", "steps"), [(1.0 / 60.0, 12), pytest.param(1.0 / 240.0, 40, marks=pytest.mark.slow)])
def test_a_fold(dt, steps, device):
    """Four layers of one strip fall onto each other and the ground, and rest."""
    positions, faces = accordion(32, 8, 0.01, 0.01)
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    at = {"pos": wp.vec3(), "rot": wp.quat_identity(), "scale": 1.0, "vel": wp.vec3()}
    cloth = {"vertices": [wp.vec3(*p) for p in positions.tolist()], "indices": faces.ravel().tolist(), "density": 0.2}
    stiffness = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 1e-2, "edge_ke": 1e-3, "edge_kd": 1e-3}
    builder.add_cloth_mesh(**at, **cloth, **stiffness, particle_radius=0.002)
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10)))
    check_rest(rollout, dt, steps)
    assert rollout.positions[:, 2].min() > 0.0


def write_rows(array, rows, value):
    """Sets rows of an array on a device."""
    values = array.numpy().copy()
    values[rows] = value
    array.assign(values)


@pytest.mark.parametrize("what", ["particle_q", "particle_qd"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_wanted_position_that_is_not_finite(value, what, device):
    """Its particle stands, and lacks a certificate; the others are stopped as ever."""
    model = bullet(40.0, device=device)
    lost = model.particle_count - 41  # in the middle of the patch that flies
    rollout = Rollout(model, bsc.SolverCCD(Changed(model, lambda state: write_rows(getattr(state, what), lost, value))))
    hits = 0
    for _ in range(3):
        start = rollout.positions
        rollout.step()
        assert not rollout.solver.report.certified
        assert rollout.solver.report.not_finite == 1 and rollout.solver.report.remaining == 0
        assert rollout.solver.report.uncertified_vertices.tolist() == [lost]
        hits += rollout.solver.report.predicted_contacts
        assert rollout.positions[lost].tobytes() == start[lost].tobytes()
        assert (rollout.velocities[lost] == 0.0).all()
        assert np.isfinite(rollout.positions).all() and np.isfinite(rollout.velocities).all()
    moved = rollout.positions[-81:, 2] != model.particle_q.numpy()[-81:, 2]
    assert moved.sum() == 80
    assert rollout.collisions == 0 and hits > 50
    assert rollout.solver.report.totals.frozen_steps == 0
    rollout.solver.solver.change = None
    rollout.step()
    assert rollout.solver.report.not_finite == 0 and rollout.solver.report.certified


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_start_position_that_is_not_finite(value, device):
    """The step is not certified, but every collision without that particle is found and avoided."""
    model = bullet(40.0, device=device)
    broken = model.particle_count - 41
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    write_rows(rollout.states[0].particle_q, broken, value)
    others = np.arange(model.particle_count) != broken
    faces = rollout.mesh.faces
    without = [broken]
    if device.is_cuda:  # whose broad phase drops what the faces of the particle represent as well
        without = faces[(faces == broken).any(axis=1)]
    faces = faces[~np.isin(faces, without).any(axis=1)]
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, model.particle_count, device=device), method="exact")
    found = avoided = 0
    for step in range(4):
        start, end = rollout.states
        before = rollout.positions
        wanted = before + np.float32(DT) * rollout.velocities
        rollout.solver.step(start, end, None, None, DT)
        rollout.states = end, start
        report = rollout.solver.report
        assert not report.certified and report.totals.uncertified_steps == step + 1
        assert not np.isfinite(rollout.positions[broken]).any()
        assert np.isfinite(rollout.positions[others]).all() and np.isfinite(rollout.velocities[others]).all()
        for x1, collides in ((wanted, True), (rollout.positions, False)):
            c = detector.detect(np.where(others[:, None], before, 0), np.where(others[:, None], x1, 0))
            number = len(c.vertex_face) + len(c.edge_edge)
            if collides:
                avoided += number
            else:
                found += number
    assert (found, report.totals.frozen_steps) == (0, 0) and avoided > 100


@pytest.fixture(scope="module")
def shot(device):
    """A rollout that tests put back to its start: a patch that flies at a sheet, and reaches it in the second step."""
    model = bullet(20.0, device=device)
    return Rollout(model, bsc.SolverCCD(Changed(model)))


@settings(max_examples=12)
@given(share=st.sampled_from([0.01, 0.2, 0.9, 1.0]), seed=st.integers(0, 10**6))
def test_any_positions_that_are_not_finite(shot, share, seed):
    """Each of their particles stands, and no other does for that."""
    random = np.random.default_rng(seed)
    lost = np.flatnonzero(random.random(shot.model.particle_count) < share)
    values = random.choice(np.float32([np.nan, np.inf, -np.inf]), (len(lost), 3))
    shot.solver.solver.change = lambda state: write_rows(state.particle_q, lost, values)
    shot.states = shot.model.state(), shot.model.state()
    shot.collisions, standing = 0, shot.solver.report.totals.frozen_steps
    for _ in range(3):
        start = shot.positions
        shot.step()
        assert shot.solver.report.certified == (not len(lost)) and shot.solver.report.remaining == 0
        assert shot.solver.report.not_finite == len(lost)
        assert np.isfinite(shot.positions).all() and np.isfinite(shot.velocities).all()
        still = (shot.positions[lost] == start[lost]).all(axis=1)
        assert still.all() or shot.solver.report.predicted_contacts  # another may push it
    assert shot.collisions == 0 and shot.solver.report.totals.frozen_steps == standing


@pytest.mark.parametrize("iterations", [0, 40])
@pytest.mark.parametrize(
    "gaps", [(0.008, 0.004, 0.0, 0.004, 0.008, 0.03, 0.03), (0.015, 0.005, -0.005, 0.01, 0.03, 0.03)]
)
def test_plates_that_leave_no_room(gaps, iterations, device):
    """Steps in which they meet are not certified; what is elsewhere does not notice, and it ends with them."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.012)
    pressed = builder.particle_count
    add_patch(builder, 3, 0.04, (1.0, 0.0, 0.0), velocity=(0.3, 0.2, 0.1))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(
        model,
        bsc.SolverCCD(Changed(model, lambda state: place_plates(state, gap)), max_iterations=iterations),
    )
    certified, uncertified = [], 0
    for next_gap in gaps:
        gap = next_gap
        wanted = rollout.positions + np.float32(DT) * rollout.velocities
        collisions = rollout.collisions
        rollout.step()
        report = rollout.solver.report
        certified.append(report.certified)
        uncertified += not report.certified
        assert report.totals.uncertified_steps == uncertified
        assert report.certified == (report.remaining == 0)
        assert rollout.collisions - collisions <= report.remaining
        assert np.isfinite(rollout.positions).all() and np.isfinite(rollout.velocities).all()
        assert rollout.positions[pressed:].tobytes() == wanted[pressed:].tobytes()
    assert certified[:2] == [True, True] and not certified[2]
    assert certified[-2:] == [True, True]


def press_cloth(device, speed, **options):
    """Plates press a sheet through the ground by turns, then a crumpled patch is shot at another sheet.

    Returns the rollout, and of each step the number of frozen vertices and that of iterations.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane()
    add_patch(builder, 3, 0.04, (0.0, 0.0, 0.002))
    plates = slice(builder.particle_count, builder.particle_count + 6 * 9)
    for i in range(6):
        add_patch(builder, 2, 0.08, (0.013, 0.007, 0.005 + 0.01 * i))
    builder.particle_mass[plates] = [0.0] * 54
    add_patch(builder, 6, 0.05, (1.0, 0.0, 0.5), fixed=True)
    add_patch(builder, 6, 0.03, (1.011, 0.017, 0.55))
    builder.color()
    model = builder.finalize(device=device)

    def lower(state):
        write_rows(state.particle_q, plates, state.particle_q.numpy()[plates] - np.float32([0.0, 0.0, speed * DT]))

    rollout = Rollout(model, bsc.SolverCCD(Changed(model, lower), **options))
    frozen, iterations = [], []
    for step in range(11):
        if step == 8:
            random = np.random.default_rng(0).standard_normal((49, 3)) * (20.0, 20.0, 60.0) - (0.0, 0.0, 100.0)
            write_rows(rollout.states[0].particle_qd, slice(-49, None), random)
        rollout.step()
        report = rollout.solver.report
        assert len(rollout.new_collisions) == report.remaining and report.certified == (report.remaining == 0)
        frozen.append(report.frozen)
        iterations.append(report.iterations)
    return rollout, np.array(frozen), np.array(iterations)


def test_cloth_that_is_pressed_through_a_plane(device):
    """Its steps after the first take few iterations, what collides elsewhere then all that it needs."""
    through = r"let them through shape 0 \('ground_plane'\):.* mask = np.full\(1, -1\) and mask\[\[0\]\] = 0"
    with pytest.warns(UserWarning, match=through):
        pressed, frozen, iterations = press_cloth(device, 2.0)
    stuck = iterations[frozen > 0]
    assert len(stuck) > 4 and not frozen[8:].any()
    assert MAX_ITERATIONS < stuck[0] < MAX_ITERATIONS + 6 and stuck[1:].max() < MAX_STUCK_ITERATIONS + 6, iterations
    calm, frozen, iterations_of_calm = press_cloth(device, 0.0)
    assert not frozen.any() and iterations[8:].tolist() == iterations_of_calm[8:].tolist()
    assert iterations[8:].max() > 2 * MAX_STUCK_ITERATIONS, iterations
    assert pressed.positions[-98:].tobytes() == calm.positions[-98:].tobytes()


def test_a_filter_lets_cloth_be_pressed_through_a_plane(device):
    """It is the one that the warning of the test before names."""
    mask = np.full(1, -1)
    mask[[0]] = 0
    pressed, frozen, iterations = press_cloth(device, 2.0, collision_filter=bsc.CollisionFilter(shape_mask=mask))
    assert pressed.solver.report.totals.uncertified_steps == 0 and not frozen.any()
    assert iterations[:8].max() <= MAX_STUCK_ITERATIONS and pressed.positions[:16, 2].max() < 0.0


def test_shapes_may_pass_through_each_other(device):
    """What nothing can resolve is no part of the certificate."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.01)
    cloth = [wp.vec3(1.0 + x, y, z) for x, y, z in builder.particle_q]
    builder.particle_q = cloth
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model, lambda state: place_plates(state, gap))))
    for next_gap in (0.002, -0.01, -0.02, 0.01):
        gap = next_gap
        rollout.step()
        report = rollout.solver.report
        assert (report.certified, report.predicted_contacts, report.remaining) == (True, 0, 0)
        assert rollout.solver.report.crossings == 0
    np.testing.assert_array_equal(rollout.positions, np.float32(cloth))


def test_vertices_that_start_in_the_solid_of_a_plane(device):
    """They rise as they want to, and those above do not enter."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane()
    for height, speed in ((-0.02, 2.0), (0.02, -2.0)):
        add_patch(builder, 4, 0.05, (height * 30.0, 0.0, height), velocity=(0.0, 0.0, speed))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    below, excluded = rollout.positions[:, 2] < 0.0, 0
    for _ in range(5):
        wanted = rollout.positions + np.float32(DT) * rollout.velocities
        rollout.step()
        assert rollout.solver.report.certified and rollout.solver.report.frozen == 0
        assert rollout.positions[below].tobytes() == wanted[below].tobytes()
        assert rollout.positions[~below, 2].min() > 0.0
        excluded += rollout.solver.report.excluded
    assert excluded == 2 * below.sum()  # in two steps they also end there
    assert rollout.positions[below, 2].min() > 0.0


@pytest.mark.parametrize("trouble", ["crossing", "lost", "broken", "divided", "jammed"])
def test_worlds_do_not_notice_each_other(trouble, device):
    """What crosses, is lost or is divided in one world changes no bit of another."""
    ends = []
    for calm in (True, False):
        model = bullet(20.0, device=device, worlds=3)
        middle = np.arange(model.particle_count // 3, 2 * model.particle_count // 3)
        patch = middle[-81:]
        most = {} if trouble == "jammed" else {"max_iterations": 2}  # as many as the other worlds need
        rollout = Rollout(model, bsc.SolverCCD(Changed(model), **most))
        state = rollout.states[0]
        if calm:
            write_rows(state.particle_qd, patch, 0.0)
        elif trouble == "crossing":
            x = state.particle_q.numpy()[patch]
            write_rows(state.particle_q, patch, x + x[:, :1] * np.float32([0.0, 0.0, 1.0]) - np.float32([0, 0, 0.1007]))
        elif trouble == "lost":
            rollout.solver.solver.change = lambda state, rows=patch[::2]: write_rows(state.particle_q, rows, np.nan)
        elif trouble == "broken":
            write_rows(state.particle_q, patch[40], np.nan)
        else:
            random = np.random.default_rng(0).standard_normal((81, 3))
            write_rows(state.particle_qd, patch, random * (20.0, 20.0, 60.0) - (0.0, 0.0, 100.0))
        bits, troubled, hits = [], False, 0
        for _ in range(6):
            start, end = rollout.states
            rollout.solver.step(start, end, None, None, DT)
            rollout.states = end, start
            bits.append(np.delete(np.concatenate([rollout.positions, rollout.velocities], axis=1), middle, axis=0))
            hits += rollout.solver.report.predicted_contacts
            outcome = rollout.solver.report.step_results.of_vertices.numpy()
            assert not (np.delete(outcome, middle) & ~int(PROJECTED)).any()
            troubled |= {
                "crossing": rollout.solver.report.crossings > 0 and rollout.solver.report.excluded > 0,
                "lost": rollout.solver.report.not_finite > 0,
                "broken": not rollout.solver.report.certified,
                "divided": bool((outcome & int(DIVIDED)).any()),
                "jammed": rollout.solver.report.iterations > 3,
            }[trouble]
        assert troubled == (not calm) and hits > 100
        ends.append(np.stack(bits).tobytes())
    assert ends[0] == ends[1]


@pytest.mark.slow
def test_the_rollers_of_newton(device, monkeypatch):
    """Its example as it is, in its own graph, with fewer iterations: a frame is certified, and the cloth moves."""
    make, stages = newton.solvers.SolverVBD, []

    def make_staged(*arguments, **options):
        stages.append(bsc.SolverCCD(make(*arguments, **{**options, "iterations": 2})))
        return stages[0]

    monkeypatch.setattr(newton.solvers, "SolverVBD", make_staged)
    module = importlib.import_module("newton.examples.cloth.example_cloth_rollers")
    options = newton.examples.create_parser().parse_args(["--viewer", "null"])
    example = module.Example(newton.viewer.ViewerNull(num_frames=1), options)
    start = example.state_0.particle_q.numpy().copy()
    example.step()
    report = stages[0].report
    assert (report.totals.steps, report.totals.uncertified_steps, report.totals.frozen_steps) == (
        example.sim_substeps,
        0,
        0,
    )
    end = example.state_0.particle_q.numpy()
    moved = np.linalg.norm(end - start, axis=1)
    print(
        moved[: example.num_cloth_verts].max(),
        (moved[: example.num_cloth_verts] > 1e-3).sum(),
        report,
        stages[0].report.crossings,
    )
    assert (moved[: example.num_cloth_verts] > 1e-3).sum() > 100
    assert moved[example.num_cloth_verts :].min() > 0.5
