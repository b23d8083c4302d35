"""The monitor and the report: what is counted is what exact detection finds, and the monitor changes nothing."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, STIFF, Changed, Rollout, add_patch, bullet

import warp_bsc as bsc


def lose(particle):
    """A change that leaves a particle without a position."""

    def change(state):
        q = state.particle_q.numpy()
        q[particle] = np.nan
        state.particle_q.assign(q)

    return change


def record_wanted(solver):
    """Makes a solver keep all positions and velocities that it leaves, of both states."""
    step, wanted = solver.step, []

    def recorded_step(state_in, state_out, *arguments, **options):
        step(state_in, state_out, *arguments, **options)
        wanted[:] = bits(state_in, state_out)

    solver.step = recorded_step
    return wanted


def bits(*states):
    return [array.numpy().tobytes() for state in states for array in (state.particle_q, state.particle_qd)]


def exact_contacts(rollout, x0, x1):
    """The vertices of each contact of a motion, shape [n, 4], and how many pairs floating point leaves open."""
    c = rollout.detector.detect(x0, x1)
    mesh = rollout.detector.mesh
    of_faces = np.concatenate([c.vertex_face[:, :1], mesh.faces[c.vertex_face[:, 1]]], axis=1)
    contacts = np.concatenate([of_faces, mesh.edges[c.edge_edge].reshape(-1, 4)])
    return contacts, c.stats.vertex_face.unsure + c.stats.edge_edge.unsure


def blade(speed, *, device):
    """A patch that falls through a held sheet edge on, so that it crosses the sheet for some steps."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 16, 0.05, (0.0, 0.0, 0.0), fixed=True)
    tilt = wp.quat_from_axis_angle(wp.vec3(1.0, 0.2, 0.0), 1.3)
    size = {"dim_x": 8, "dim_y": 8, "cell_x": 0.03, "cell_y": 0.03, "mass": 0.001}
    builder.add_cloth_grid(pos=wp.vec3(-0.11, -0.04, 0.05), rot=tilt, vel=wp.vec3(0.0, 0.0, -speed), **size, **STIFF)
    builder.color()
    return builder.finalize(device=device)


@pytest.mark.parametrize("scene", [bullet, blade])
def test_the_monitor_reports_what_exact_detection_finds_and_changes_nothing(scene, device):
    model = scene(20.0, device=device)
    inner = SOLVERS["vbd"](model)
    wanted = record_wanted(inner)
    rollout = Rollout(model, bsc.CollisionMonitor(inner))
    report = rollout.solver.report
    hits = excluded = crossings = uncertified = equal = 0
    for _ in range(8):
        x0 = rollout.positions.copy()
        rollout.step()
        assert bits(*rollout.states[::-1]) == wanted
        contacts, unsure = exact_contacts(rollout, x0, rollout.positions)
        assert 0 <= report.predicted_contacts + report.excluded - len(contacts) <= unsure
        equal += unsure == 0 < len(contacts)
        assert report.remaining == report.predicted_contacts
        assert report.certified == (report.predicted_contacts == 0) == (len(report.uncertified_vertices) == 0)
        assert report.crossings == len(rollout.detector.find_intersections(x0))
        assert (report.iterations, report.truncated, report.frozen, report.not_finite) == (0, 0, 0, 0)
        hits, excluded, crossings = (
            hits + report.predicted_contacts,
            excluded + report.excluded,
            crossings + report.crossings,
        )
        uncertified += not report.certified
    assert hits > 100
    assert (excluded > 0) == (crossings > 0) == (scene is blade)  # the other is through within one step
    assert 0 < uncertified < 8 and equal > 0
    assert (report.totals.steps, report.totals.uncertified_steps) == (8, uncertified)
    totals = report.totals
    assert totals.truncated_steps == totals.frozen_steps == totals.not_finite_steps == 0


def test_the_monitor_reports_the_same_from_a_graph(device):
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    rows = []
    for in_graph in (False, True):
        model = blade(20.0, device=device)
        solver = bsc.CollisionMonitor(SOLVERS["vbd"](model))
        states, control = (model.state(), model.state()), model.control()

        def step(solver=solver, states=states, control=control):
            start, end = states
            start.clear_forces()
            solver.step(start, end, control, None, DT)
            wp.copy(start.particle_q, end.particle_q)
            wp.copy(start.particle_qd, end.particle_qd)

        if in_graph:
            with wp.ScopedCapture(device) as capture:  # before anything touches
                step()
        rows.append([])
        for _ in range(6):
            if in_graph:
                wp.capture_launch(capture.graph)
            else:
                step()
            report = solver.report
            counts = (
                report.predicted_contacts,
                report.remaining,
                report.excluded,
                report.crossings,
                report.totals.uncertified_steps,
            )
            rows[-1].append((*counts, report.uncertified_vertices.tolist(), states[0].particle_q.numpy().tobytes()))
        assert report.totals.steps == 6
    assert rows[0] == rows[1]
    assert sum(row[0] for row in rows[0]) > 100


@pytest.mark.parametrize("option", ["separation", "friction", "restitution", "substeps", "bodies"])
def test_arguments_of_a_response_are_refused(option, device):
    model = bullet(10.0, device=device)
    with pytest.raises(TypeError, match=option):
        bsc.CollisionMonitor(SOLVERS["xpbd"](model), **{option: 0.5})


def test_the_monitor_needs_no_friction(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=-1.0))
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.1), velocity=(0.0, 0.0, -60.0))
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.CollisionMonitor(newton.solvers.SolverXPBD(model, iterations=0)))
    rollout.step()
    report = rollout.solver.report
    assert (report.predicted_contacts, report.excluded) == (model.particle_count, 0)  # all vertices enter the plane
    rollout.step()
    assert (report.predicted_contacts, report.excluded) == (
        0,
        model.particle_count,
    )  # and are left to the solver from then on
    assert report.certified and report.totals.uncertified_steps == 1


def test_gradients_of_the_inner_solver_pass_the_monitor_unchanged(device):
    gradients, hits = [], 0
    for monitored in (False, True):
        model = bullet(60.0, device=device)
        model.requires_grad = True
        model.particle_ke = model.particle_kd = model.particle_kf = 0.0
        solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        solver = bsc.CollisionMonitor(solver) if monitored else solver
        states, control = [model.state(requires_grad=True) for _ in range(6)], model.control()
        with wp.Tape() as tape:
            for start, end in itertools.pairwise(states):
                start.clear_forces()
                solver.step(start, end, control, None, DT / 4)
                hits += solver.report.predicted_contacts if monitored else 0
        tape.backward(grads={states[-1].particle_q: wp.ones_like(states[-1].particle_q)})
        gradients.append([states[0].particle_q.grad.numpy(), states[0].particle_qd.grad.numpy()])
    assert hits > 0
    for actual, expected in zip(*gradients, strict=True):
        largest = np.abs(expected).max()
        assert largest > 0.0
        rounding = 2e-6 * largest if device.is_cuda else 0.0  # the inner solver's sums on a GPU have no order
        np.testing.assert_allclose(actual, expected, rtol=0.0, atol=rounding)


def particles_of_elements_with(model, particle):
    faces = model.tri_indices.numpy().reshape(-1, 3)
    return np.unique(faces[(faces == particle).any(axis=1)])


def test_a_particle_without_a_wanted_position_stands_and_is_counted(device):
    model = bullet(10.0, device=device)
    last = model.particle_count - 1
    rollout = Rollout(model, bsc.SolverCCD(Changed(model, lose(last))))
    for _ in range(2):
        before = rollout.positions.copy()
        rollout.step()
        np.testing.assert_array_equal(rollout.positions[last], before[last])
        assert (rollout.positions[last - 1] != before[last - 1]).any()
    report = rollout.solver.report
    totals = report.totals
    assert (report.not_finite, totals.not_finite_steps, totals.frozen_steps) == (1, 2, 0)
    assert (totals.uncertified_steps, totals.remaining) == (2, 0)
    assert not report.certified and report.uncertified_vertices.tolist() == [last]
    assert str(report).endswith("2 not certified, 2 steps with positions that are not finite")


def test_the_monitor_does_not_certify_positions_that_are_not_finite(device):
    model = bullet(-10.0, device=device)
    last = model.particle_count - 1
    solver = bsc.CollisionMonitor(Changed(model, lose(last)))
    start, end = model.state(), model.state()
    solver.step(start, end, model.control(), None, DT)
    report = solver.report
    totals = report.totals
    assert (report.not_finite, totals.not_finite_steps, report.predicted_contacts, totals.uncertified_steps) == (
        1,
        1,
        0,
        1,
    )
    assert np.isnan(end.particle_q.numpy()[last]).all()
    np.testing.assert_array_equal(report.uncertified_vertices, particles_of_elements_with(model, last))


@pytest.mark.parametrize("make", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_particles_without_a_position_at_the_start_are_named(make, device):
    model = bullet(-10.0, device=device)
    first = 0
    start, end = model.state(), model.state()
    lose(first)(start)
    solver = make(newton.solvers.SolverXPBD(model, iterations=0))
    solver.step(start, end, model.control(), None, DT)
    report = solver.report
    assert not report.certified and report.predicted_contacts == 0
    np.testing.assert_array_equal(report.uncertified_vertices, particles_of_elements_with(model, first))


@pytest.mark.parametrize("make", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_a_body_without_a_position_leaves_a_step_uncertified(make, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_shape_sphere(builder.add_body(), radius=0.1)
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.2))
    model = builder.finalize(device=device)
    solver = make(Changed(model, lambda state: state.body_q.fill_(wp.transform(wp.vec3(np.nan), wp.quat_identity()))))
    start, end = model.state(), model.state()
    solver.step(start, end, model.control(), None, DT)
    report = solver.report
    assert not report.certified and report.totals.uncertified_steps == 1
    assert report.not_finite == 0 and len(report.uncertified_vertices) == 0


def test_particles_that_kinematic_ones_squeeze_are_named(device):
    """Two held sheets that close on a free patch, and pass through it and each other."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for n, cell, at, fixed in ((3, 0.11, (0, 0, -0.1), False), (2, 0.03, (0.011, 0.017, 0), False)):
        add_patch(builder, n, cell, at, fixed=fixed)
    add_patch(builder, 3, 0.11, (0.013, 0.007, 0.1))
    held = np.r_[:16, 25:41]
    for particle in held:
        builder.particle_mass[particle] = 0.0
    model = builder.finalize(device=device)

    def close(state):
        q = state.particle_q.numpy()
        q[held, 2] *= -0.5
        state.particle_q.assign(q)

    rollout = Rollout(model, bsc.SolverCCD(Changed(model, close)))
    x0 = rollout.positions.copy()
    rollout.step()
    report = rollout.solver.report
    contacts, unsure = exact_contacts(rollout, x0, rollout.positions)
    assert unsure == 0
    movable = ~np.isin(contacts, held).all(axis=1)
    assert 0 < movable.sum() < len(contacts)
    assert not report.certified and report.remaining == movable.sum() and report.excluded == 0
    np.testing.assert_array_equal(report.uncertified_vertices, np.unique(contacts[movable]))


@pytest.mark.parametrize("make", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_crossings_at_the_start_are_counted_from_the_first_step(make, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.0))
    tilt = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.5)
    small = {"dim_x": 2, "dim_y": 2, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.001}
    builder.add_cloth_grid(pos=wp.vec3(0.013, -0.05, -0.051), rot=tilt, vel=wp.vec3(), **small, **STIFF)
    model = builder.finalize(device=device)
    rollout = Rollout(model, make(newton.solvers.SolverXPBD(model, iterations=0)))
    report = rollout.solver.report
    expected = len(rollout.detector.find_intersections(rollout.positions))
    assert expected > 0
    for steps in (1, 2):
        rollout.step()
        assert (report.crossings, report.totals.steps) == (expected, steps)
        assert (report.predicted_contacts, report.excluded) == (0, 0)  # nothing moves
        assert report.certified and len(report.uncertified_vertices) == 0
    assert f"0 not certified, {expected} crossings at the start of the step" in str(report)
