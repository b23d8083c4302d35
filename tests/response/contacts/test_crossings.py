"""Surfaces that cross, touch or overlap at the start of a step: they come apart, and everything else is certified."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, STIFF, Changed, Rollout, add_crossing_sheets, add_patch, crossing_sheets
from sample_sizes import cases
from stage_stress import SCENES, Stress

import warp_bsc as bsc


def faces_of_edge(mesh, edge):
    return np.flatnonzero(np.isin(mesh.faces, mesh.edges[edge]).sum(axis=1) == 2)


def is_reachable(rollout, edge, face, before):
    """Whether an edge may have come to cross a face through contacts of elements that crossed before."""
    if any(rollout.vertex_crosses(vertex, face, before) for vertex in rollout.mesh.edges[edge]):
        return True
    sides = np.flatnonzero(np.isin(rollout.mesh.edges, rollout.mesh.faces[face]).all(axis=1))
    return any(rollout.edges_cross(edge, side, before) for side in sides)


def check_new_crossings(rollout, before):
    """Asserts that elements cross only where neighbours did already; returns the crossings at the end."""
    after = rollout.find_crossings(rollout.positions)
    for edge, face in after - before:
        assert is_reachable(rollout, edge, face, before)
    return after


@pytest.mark.parametrize(("pull", "steps"), [(3.0, 30), (-2.0, 15), (0.0, 5)])
def test_crossing_sheets(pull, steps, device):
    """Pulled apart they come apart, pushed together they cross where they did, and at rest nothing changes."""
    model = crossing_sheets(pull, device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model)))
    before = rollout.find_crossings(rollout.positions)
    counts = [len(before)]
    excluded = 0
    report = rollout.solver.report
    for _ in range(steps):
        rollout.step()
        assert rollout.solver.report.certified
        assert rollout.solver.report.crossings == len(before)
        excluded += rollout.solver.report.excluded
        before = check_new_crossings(rollout, before)
        counts.append(len(before))
    assert counts[0] > 20
    if pull > 0.0:
        assert counts[-1] == 0 and excluded > 0
    elif pull < 0.0:
        assert counts[-1] > 0 and excluded > 0
    else:
        assert set(counts) == {counts[0]}
    totals = report.totals
    assert (rollout.collisions, totals.truncated_steps, totals.frozen_steps, totals.uncertified_steps) == (0, 0, 0, 0)
    assert (report.totals.excluded, report.totals.remaining) == (excluded, 0)
    assert (f"contacts: 0 remained, {excluded} excluded" in str(report)) == (excluded > 0)


def add_mesh(builder, points, indices, velocity=(0.0, 0.0, 0.0)):
    """A cloth of these triangles."""
    at = {"pos": wp.vec3(), "rot": wp.quat_identity(), "scale": 1.0, "vel": wp.vec3(*velocity)}
    builder.add_cloth_mesh(**at, vertices=points, indices=indices, density=0.1, **STIFF)


def flying(builder, device, change=None):
    """A rollout of the particles of a builder as they fly without forces."""
    builder.color()
    model = builder.finalize(device=device)
    return Rollout(model, bsc.SolverCCD(Changed(model, change)))


def test_the_count_is_that_of_exact_detection(device):
    """Also where the program moves particles between steps, and where they all move alike."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for height in (0.0, 0.2):
        add_patch(builder, 4, 0.05, (0.0, 0.0, height), velocity=(0.3, -0.2, 0.1))
    rollout = flying(builder, device)
    tilted = np.float32([[0.2, 0.1, 0.97]]) * rollout.positions[25:, :1]
    apart = rollout.positions
    crossing = np.concatenate([apart[:25], apart[25:] + tilted - np.float32([0.013, 0.007, 0.19])])
    turned = np.concatenate([apart[:25], apart[25:] + tilted[:, [1, 0, 2]] - np.float32([0.0, 0.01, 0.19])])
    counts, last, steps = [], None, 0
    for moved in (None, None, crossing, None, None, apart, None, turned, crossing, apart):
        if moved is not None:
            rollout.states[0].particle_q.assign(moved)
        pairs = np.array(list(rollout.find_crossings(rollout.positions)), dtype=int).reshape(-1, 2)
        of_edges = np.bincount(pairs[:, 0], minlength=len(rollout.mesh.edges))
        new = 0 if last is None else int(np.maximum(of_edges - last, 0).sum())
        last, steps = of_edges, steps + (new > 0)
        rollout.step()
        report = rollout.solver.report
        assert report.crossings == len(pairs) and report.certified and rollout.collisions == 0
        penetrated = report.penetrated
        assert (penetrated.passed, penetrated.crossed, penetrated.inside, penetrated.steps) == (0, new, 0, steps)
        assert bool(penetrated) == (steps > 0) and report.totals.penetrated_steps == steps
        counts.append((len(pairs) > 0, new > 0))
    assert counts == [(c == "1", n == "1") for c, n in zip("0011100110", "0010000110", strict=True)]
    assert rollout.solver.report.totals.frozen_steps == rollout.solver.report.totals.truncated_steps == 0


def test_what_crosses_in_a_first_step_or_after_a_reset_did_not_pass_through(device):
    """Of two worlds, the one that was not reset has passed through."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_crossing_sheets(world, 0.0, n=4)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, 2)
    rollout = flying(builder, device)
    report, crossing = rollout.solver.report, rollout.positions
    apart = crossing + np.float32([[0.0, 0.0, 1.0]]) * (np.arange(len(crossing)) % 50 >= 25)[:, None]
    worlds = wp.array([True, False, False], dtype=bool, device=device)
    for x, mask in ((crossing, None), (apart, None), (crossing, worlds), (apart, None)):
        rollout.states[0].particle_q.assign(x)
        if mask is not None:
            rollout.solver.reset(rollout.states[0], mask, flags=0)
        rollout.step()
        if x is crossing:
            new = 0 if mask is None else report.crossings // 2
            assert report.crossings > 10 and report.penetrated.crossed == new and bool(report.penetrated) == (new > 0)
    rollout.states[0].particle_q.assign(crossing)
    rollout.solver.reset(rollout.states[0], flags=0)
    rollout.step()
    assert report.penetrated.crossed == 0 and report.penetrated.steps == 1


def test_crossings_elsewhere_do_not_let_a_bullet_pass(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_crossing_sheets(builder, 2.0)
    add_patch(builder, 10, 0.05, (2.0, 0.0, 0.0), fixed=True)
    add_patch(builder, 6, 0.03, (2.011, 0.017, 0.1), velocity=(0.0, 0.0, -40.0))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model)))
    hits = 0
    for _ in range(5):
        rollout.step()
        assert rollout.solver.report.certified
        assert rollout.solver.report.crossings > 0
        hits += rollout.solver.report.predicted_contacts
    assert rollout.collisions == 0 and hits > 100
    assert rollout.velocities[-49:, 2].mean() > -20.0


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.4), (0.3, 0.1, 0.2), (0.3, 0.1, 0.0), (0.0, 0.0, -0.4)])
def test_a_vertex_on_a_face(velocity, device):
    """It leaves the face as the inner solver wants."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 2, 0.1, (0.0, 0.0, 0.0))
    tip = [wp.vec3(0.02, 0.05, 0.0), wp.vec3(-0.02, 0.04, 0.1), wp.vec3(0.06, 0.03, 0.1)]
    add_mesh(builder, tip, [0, 1, 2], velocity)
    rollout = flying(builder, device)
    assert rollout.find_crossings(rollout.positions)
    wanted = rollout.positions + np.float32(DT) * rollout.velocities
    rollout.step()
    assert rollout.solver.report.certified and rollout.collisions == 0
    assert rollout.solver.report.frozen == 0
    assert rollout.solver.report.crossings == 0
    if velocity[2] > 0.0:
        assert rollout.positions.tobytes() == wanted.tobytes()
    assert np.abs(rollout.positions - wanted)[-3:].max() < 0.1 * DT


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (0.011, 0.017, 0.0)])
def test_sheets_in_one_plane_are_not_stuck(at, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, -0.5))
    add_patch(builder, 4, 0.05, at, velocity=(0.0, 0.0, 0.5))
    rollout = flying(builder, device)
    for _ in range(3):
        wanted = rollout.positions + np.float32(DT) * rollout.velocities
        rollout.step()
        assert rollout.solver.report.certified
        np.testing.assert_allclose(rollout.positions, wanted, atol=1e-7)
    assert rollout.collisions == 0


def unwelded(x, quads):
    """Quads of a surface as triangles that share no vertex with those of other quads: positions and indices."""
    corners = np.arange(4 * len(quads)).reshape(-1, 4)
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    return [wp.vec3(*point) for point in x[quads.ravel()].tolist()], triangles.ravel().tolist()


def test_vertices_in_one_place_are_not_stuck(device):
    """Quads without common vertices that bend and turn as one sheet."""
    n = 5
    x = 0.05 * np.stack([*np.mgrid[0 : n + 1, 0 : n + 1], np.zeros((n + 1, n + 1))], axis=-1).reshape(-1, 3)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    points, indices = unwelded(x, np.stack([a, a + n + 1, a + n + 2, a + 1], axis=1))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_mesh(builder, points, indices)
    rollout = flying(builder, device, lambda state: state.particle_q.assign(wanted))
    for _ in range(3):
        x, y, z = rollout.positions.T
        wanted = np.float32(np.stack([x - 0.02 * y, y + 0.02 * x, z + 0.01 * np.sin(20.0 * x)], axis=1))
        rollout.step()
        assert rollout.solver.report.certified
        assert rollout.positions.tobytes() == wanted.tobytes()
    assert rollout.collisions == 0


def test_cloth_on_a_roller_without_common_vertices(device):
    """A kinematic cylinder of such quads turns under a cloth, which it carries along."""
    segments, radius = 24, 0.1
    angle = 2.0 * np.pi / segments * np.arange(segments)
    ring = np.stack([radius * np.cos(angle), np.zeros(segments), radius * np.sin(angle)], axis=1)
    half = np.array([0.0, 0.2, 0.0])
    x = np.concatenate([ring - half, ring + half])
    i, j = np.arange(segments), np.roll(np.arange(segments), -1)
    points, indices = unwelded(x, np.stack([i, j, j + segments, i + segments], axis=1))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    add_patch(builder, 8, 0.03, (0.0, 0.0, radius + 0.002))
    cloth = builder.particle_count
    add_mesh(builder, points, indices)
    builder.color()
    model = builder.finalize(device=device)
    flags = model.particle_flags.numpy()
    flags[cloth:] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags.assign(flags)
    solver = SOLVERS["vbd"](model)
    step, turned = solver.step, np.float32(points)

    def step_and_turn(state_in, state_out, *arguments, **options):
        step(state_in, state_out, *arguments, **options)
        state_out.particle_q.assign(np.concatenate([state_out.particle_q.numpy()[:cloth], turned]))

    solver.step = step_and_turn
    rollout = Rollout(model, bsc.SolverCCD(solver, friction=0.8))
    touched = 0
    for k in range(30):
        x, y, z = np.transpose(points)
        c, s = np.cos(0.02 * (k + 1)), np.sin(0.02 * (k + 1))
        turned = np.float32(np.stack([c * x + s * z, y, c * z - s * x], axis=1))
        rollout.step()
        touched += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
        assert rollout.positions[cloth:].tobytes() == turned.tobytes()
    assert rollout.collisions == 0 and touched > 0
    assert rollout.solver.report.totals.frozen_steps == 0
    assert rollout.positions[:cloth, 0].mean() > 1e-3  # at the start it is 0


def test_a_sheet_that_folds_within_its_plane_is_stopped(device):
    """All of its elements are in one plane at all times, but they do not touch at the start."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 8, 0.05, (0.0, 0.0, 0.0))
    rollout = flying(builder, device, lambda state: state.particle_q.assign(folded))
    start = rollout.positions
    folded = np.where([[True, False, False]], -np.float32(0.9) * np.abs(start), start)
    assert rollout.find_collisions(start, folded)
    rollout.step()
    assert rollout.solver.report.certified and rollout.collisions == 0
    assert rollout.solver.report.excluded == rollout.solver.report.crossings == 0


@pytest.mark.parametrize("name", SCENES)
def test_steps_from_anywhere(name, device):
    """Only what touches or crosses at the start is left out, in one plane and near one, at any gap, at rest or held."""
    scene = SCENES[name]
    # long paths meet everything, which takes long
    worlds, steps = (8, 8) if scene.path <= 0.1 else (3, 3 if scene.lattice else 5) if scene.path < 5.0 else (1, 3)
    stress = Stress(scene, np.random.default_rng(7), worlds=cases(worlds), device=device)
    for _ in range(steps):
        assert stress.step()
