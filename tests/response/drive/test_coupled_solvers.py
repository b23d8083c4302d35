"""The stage as an entry of Newton's coupled solvers: bodies of another solver, and cloth of the inner one."""

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers.experimental.coupled import (
    CouplingInterface,
    ModelView,
    SolverCoupled,
    SolverCoupledADMM,
    SolverCoupledProxy,
)
from newton_scenes import DT, SOLVERS, Rollout, add_patch, bullet
from newton_versions import needs_attachments

import warp_bsc as bsc
from warp_bsc.response.drive import coupling

STEPS = 28
"""Of a ball that flies at a sheet, as far as it takes to be stopped or to pass."""


def ball_builder(mass):
    """A ball above a pinned sheet."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    radius = 0.05
    inertia = wp.mat33(*(0.4 * mass * radius**2 * np.eye(3)).ravel().tolist())
    pose = wp.transform(wp.vec3(0.013, 0.007, 0.055), wp.quat_identity())
    body = builder.add_body(xform=pose, mass=mass, inertia=inertia, lock_inertia=True)
    builder.add_shape_sphere(body, radius=radius, cfg=newton.ModelBuilder.ShapeConfig(mu=0.5, density=0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0), fixed=True)
    builder.color()
    return builder


def ball_over_sheet(device, mass=0.2):
    """A ball that flies at a pinned sheet."""
    model = ball_builder(mass).finalize(device=device)
    model.body_qd.assign(np.float32([[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]]))
    return model


def two_balls_over_sheet(device):
    """Two balls in free flight, far from a sheet."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for x in (-0.5, 0.5):
        body = builder.add_body(xform=wp.transform(wp.vec3(x, 0.0, 0.5), wp.quat_identity()))
        builder.add_shape_sphere(body, radius=0.05)
    add_patch(builder, 3, 0.05, (0.0, 0.0, 0.0), fixed=True)
    builder.color()
    return builder.finalize(device=device)


def entries(model, rigid, cloth):
    """The bodies of a model for one solver, the particles for another."""
    joints, particles = list(range(model.joint_count)), list(range(model.particle_count))
    bodies = list(range(model.body_count))
    return [
        SolverCoupled.Entry(name="rigid", solver=rigid, bodies=bodies, joints=joints),
        SolverCoupled.Entry(name="cloth", solver=cloth, particles=particles),
    ]


def with_proxy(model, inner="vbd", iterations=1, bodies=(0,), report=(), **options):
    """A coupled solver in which the first bodies are proxies in the entry of the cloth, and the stage in that entry."""
    stages = []

    def make(view):
        stages.append(bsc.SolverCCD(SOLVERS[inner](view), report=report))
        return stages[-1]

    proxies = [SolverCoupledProxy.Proxy(source="rigid", destination="cloth", bodies=bodies, **options)]
    config = SolverCoupledProxy.Config(proxies=proxies, iterations=iterations)
    rigid = lambda view: newton.solvers.SolverSemiImplicit(view, angular_damping=0.0)  # noqa: E731
    return SolverCoupledProxy(model, entries(model, rigid, make), config), stages[0]


def fall(model, solver, steps):
    """Poses of the first body after each step, and the last state."""
    start, end = model.state(), model.state()
    poses = []
    for _ in range(steps):
        start.clear_forces()
        solver.step(start, end, model.control(), None, DT)
        start, end = end, start
        poses.append(start.body_q.numpy()[0].copy())
    return np.array(poses), start


@pytest.mark.parametrize(
    ("inner", "mass", "mode", "iterations"),
    [
        ("vbd", 0.2, "lagged", 1),
        pytest.param("vbd", 0.2, "staggered", 1, marks=pytest.mark.slow),
        ("xpbd", 0.02, "lagged", 2),
    ],
)
def test_a_proxy_flies_as_a_body_of_the_inner_solver_does(inner, mass, mode, iterations, device):
    """The impulses of the response on the proxy reach the solver that owns the body, with ``lagged`` a step later."""
    model, steps = ball_over_sheet(device, mass), STEPS
    alone = bsc.SolverCCD(SOLVERS[inner](model))
    expected, _ = fall(model, alone, steps)
    solver, stage = with_proxy(model, inner, iterations, mode=mode)
    poses, state = fall(model, solver, steps)
    report = stage.report
    assert report.totals.steps == iterations * steps
    assert report.totals.uncertified_steps == report.totals.revoked_steps  # in its own view, the entry has no contacts
    lags = mode == "lagged" and iterations == 1
    np.testing.assert_allclose(poses[:, :3], expected[:, :3], atol=5e-3 if lags else 2e-3)
    assert poses[-1, 2] > 0.055 - steps * DT + 0.02
    assert (state.particle_q.numpy()[:, 2] < -0.01).any()


@pytest.mark.parametrize(
    "mode, iterations, mass",
    [("lagged", 1, 0.02), ("staggered", 1, 0.2), pytest.param("staggered", 2, 0.2, marks=pytest.mark.slow)],
)
def test_a_step_is_certified_in_the_state_of_the_program(mode, iterations, mass, device):
    """If, and only if, exact detection finds that state free; until it is seen, the step is not certified."""
    model = ball_over_sheet(device, mass)
    solver, stage = with_proxy(model, iterations=iterations, mode=mode)
    rollout, report, passing = Rollout(model, solver), stage.report, []
    unseen = with_proxy(model, iterations=iterations, mode=mode)[0]
    expected, _ = fall(model, unseen, STEPS)  # a look changes nothing
    with pytest.warns(UserWarning, match=r"in the state of the program a step is not certified.* body 0 \('body_0'\)"):
        for i in range(STEPS):
            crosses = rollout.find_crossings(rollout.vertices(rollout.states[0]))
            rollout.step()
            passing.append(bool(crosses or rollout.new_collisions))
            assert not report.certified and report.uncertified_bodies.tolist() == [0]
            assert (report.totals.revoked_steps, report.totals.unseen_steps) == (sum(passing[:-1]), 1)
            if i % 2:
                solver.sync_entry_states(rollout.states[0])
                assert report.certified != passing[-1] and report.totals.revoked_steps == sum(passing)
                assert report.uncertified_bodies.tolist() == [0] * passing[-1]
                assert (report.crossings > 0) == bool(crosses) and report.totals.unseen_steps == 0
    assert report.totals.uncertified_steps == sum(passing) and 0 < sum(passing) < STEPS
    assert report.penetrated and report.totals.penetrated_steps == sum(passing)
    np.testing.assert_array_equal(rollout.states[0].body_q.numpy()[0], expected[-1])


@pytest.mark.parametrize("mode", [pytest.param("lagged", marks=pytest.mark.slow), "staggered"])
def test_a_stage_around_the_coupled_solver_keeps_the_state_of_the_program_free(mode, device, recwarn):
    """Where the stage in the entry alone does not; the ball still feels the sheet."""
    model = ball_over_sheet(device)
    solver, entry = with_proxy(model, mode=mode)
    rollout = Rollout(model, bsc.SolverCCD(solver))
    for _ in range(STEPS):
        rollout.step()
        assert rollout.solver.report.certified and not rollout.find_crossings(rollout.vertices(rollout.states[0]))
    assert rollout.collisions == 0 and entry.report.totals.steps == STEPS
    assert rollout.states[0].body_q.numpy()[0, 2] > 0.055 - STEPS * DT + 0.02
    assert not [warning for warning in recwarn if "in the state of the program" in str(warning.message)]


def test_a_monitor_around_the_coupled_solver_counts_what_passes(device):
    model = ball_over_sheet(device)
    solver, _entry = with_proxy(model, mode="staggered")
    rollout, uncertified = Rollout(model, bsc.CollisionMonitor(solver)), 0
    for _ in range(STEPS):
        rollout.step()
        assert rollout.solver.report.predicted_contacts == len(rollout.new_collisions)
        uncertified += bool(rollout.new_collisions)
    assert rollout.solver.report.totals.uncertified_steps == uncertified > 0


def test_shapes_that_change_in_a_coupled_model_are_followed(device):
    """The step before is not seen any more: its end would be that of other shapes."""
    model = ball_over_sheet(device)
    solver, stage = with_proxy(model)
    states = model.state(), model.state()
    solver.step(*states, None, None, DT)
    model.shape_scale.assign(np.float32([[0.03, 0.0, 0.0]]))
    solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)
    radii = np.linalg.norm(stage.mesh.device_shape_vertices.position.numpy(), axis=1)
    np.testing.assert_allclose(radii, 0.03, rtol=1e-6)
    solver.step(*states[::-1], None, None, DT)
    solver.sync_entry_states(states[0])
    assert stage.report.certified and stage.report.totals.unseen_steps == 1


def test_worlds_and_resets_of_a_program_are_told_apart(device):
    """The ball of one world passes its sheet in the state of the program; a step that is reset is not seen."""
    world = ball_builder(0.2)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, 2)
    builder.color()
    model = builder.finalize(device=device)
    solver, stage = with_proxy(model, bodies=[0, 1], report=["worlds"], mode="staggered")
    states, report = [model.state(), model.state()], stage.report
    states[0].body_qd.assign(np.float32([[0.0, 0.0, -1.0, 0.0, 0.0, 0.0], 6 * [0.0]]))

    def step():
        states[0].clear_forces()
        solver.step(*states, None, None, DT)
        states.reverse()
        return report.worlds.certified.numpy().tolist()

    for _ in range(STEPS):
        assert step() == [False, False]
        solver.sync_entry_states(states[0])
        if not report.certified:
            break
    assert report.worlds.certified.numpy().tolist() == [False, True] and report.totals.revoked_steps == 1
    for crosses_at_start, unseen in ((True, 0), (False, 1)):
        step()
        for name in ("body_q", "body_qd", "joint_q", "joint_qd", "particle_q", "particle_qd"):
            getattr(states[0], name).assign(getattr(model, name))
        mask = wp.array([True, False, False], dtype=bool, device=device)
        solver.reset(states[0], mask, newton.StateFlags.NONE)
        step()
        # the step before the reset is not seen, unless it is known already not to be free
        assert (report.totals.revoked_steps, report.totals.unseen_steps) == (2, 1 + unseen), crosses_at_start
        solver.sync_entry_states(states[0])
        assert report.certified and report.worlds.certified.numpy().tolist() == [True, True]
        assert (report.totals.revoked_steps, report.totals.unseen_steps) == (2, unseen)


def test_shapes_that_an_entry_does_not_see_are_named(device):
    with pytest.warns(UserWarning, match="does not see 'shape_1', which collide"):
        with_proxy(two_balls_over_sheet(device))


@needs_attachments
def test_a_body_hangs_on_cloth_over_a_sphere(device):
    """ADMM attaches a body of one solver to cloth of another, whose stage keeps it on a static sphere."""
    builder = newton.ModelBuilder()
    at = wp.vec3(0.0, 0.0, -0.11)
    builder.add_shape_sphere(-1, xform=wp.transform(at, wp.quat_identity()), radius=0.1)
    add_patch(builder, 6, 0.05, (0.003, 0.007, 0.0))
    pose = wp.transform(wp.vec3(0.15, 0.15, -0.02), wp.quat_identity())
    inertia = wp.mat33(*(1e-5 * np.eye(3)).ravel().tolist())
    body = builder.add_body(xform=pose, mass=0.01, inertia=inertia, lock_inertia=True)
    corner = builder.particle_count - 1
    builder.add_attachment_particle_body(corner, body, body_point=(0.0, 0.0, 0.02), stiffness=1e3, damping=1e-1)
    builder.color()
    model = builder.finalize(device=device)
    stages = []

    def make(view):
        stages.append(bsc.SolverCCD(SOLVERS["vbd"](view)))
        return stages[-1]

    config = SolverCoupledADMM.Config(iterations=2, rho=20.0, baumgarte=0.2)
    rigid = newton.solvers.SolverSemiImplicit
    _, state = fall(model, SolverCoupledADMM(model, entries(model, rigid, make), config), 64)
    report = stages[0].report
    assert report.totals.steps == 128 and report.totals.uncertified_steps == 0 and report.crossings == 0
    q, pose = state.particle_q.numpy(), state.body_q.numpy()[0]
    assert np.linalg.norm(q - np.array(at), axis=1).min() > 0.098  # the sphere's surface is an inscribed mesh
    free_fall = -0.02 - 0.5 * 9.81 * (64 * DT) ** 2
    assert np.linalg.norm(q[corner] - pose[:3]) < 0.06 and pose[2] > 0.7 * free_fall


@pytest.mark.parametrize("declares", sorted({False, coupling.COUPLERS_DECLARE_RESTARTS}))
def test_particles_feel_the_impulses_of_a_pass_once(declares, device, monkeypatch):
    """A coupler in staggered mode rewinds no particles: what a contact has fed back is not fed back again.

    Couplers before Newton 1.8 do not declare whether they rewind.
    """
    monkeypatch.setattr(coupling, "COUPLERS_DECLARE_RESTARTS", declares)
    model = ModelView(bullet(30.0, device=device), "cloth")
    stage = bsc.SolverCCD(SOLVERS["vbd"](model))
    if declares:
        stage.coupling_notify_iteration_restarts(False)
    proxies = wp.array(np.arange(model.particle_count), dtype=int, device=device)
    fed_back = []
    for speed in (1.0, 0.0):
        start, end = model.state(), model.state()
        start.particle_qd.assign(speed * model.particle_qd.numpy())
        before = wp.clone(start.particle_qd)
        stage.coupling_notify_input_state_update(start, newton.StateFlags.PARTICLE, dt=DT)
        stage.step(start, end, None, None, DT)
        forces = wp.zeros(model.particle_count, dtype=wp.vec3, device=device)
        options = {"particle_qd_before": before, "state": start, "state_out": end, "contacts": None, "dt": DT}
        stage.coupling_harvest_proxy_particle_forces(proxies, forces, **options)
        fed_back.append(np.abs(forces.numpy()).max())
    assert fed_back[0] > 1.0 and fed_back[1] == 0.0


@pytest.mark.parametrize("iterations", [1, 3])
def test_each_pass_over_a_step_sweeps_the_way_of_an_animated_body(iterations, device):
    """A program moves a kinematic plate through a sheet between two steps: the sheet leaves ahead of it in any pass."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    body = builder.add_body(xform=wp.transform(wp.vec3(0.01, 0.02, -0.03), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(body, hx=0.05, hy=0.05, hz=0.01)
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0))
    builder.color()
    model = builder.finalize(device=device)
    stages = []

    def make(view):
        stages.append(bsc.SolverCCD(SOLVERS["vbd"](view)))
        return stages[-1]

    particles, joints = list(range(model.particle_count)), list(range(model.joint_count))
    entry = SolverCoupled.Entry(name="cloth", solver=make, bodies=[body], joints=joints, particles=particles)
    solver = SolverCoupledADMM(model, [entry], SolverCoupledADMM.Config(iterations=iterations))
    start, end = model.state(), model.state()
    for height in (-0.03, -0.03, 0.03, 0.03):
        pose = start.body_q.numpy()
        pose[0, 2] = height
        start.body_q.assign(pose)
        start.clear_forces()
        solver.step(start, end, None, None, DT)
        start, end = end, start
        report = stages[0].report
        assert report.certified and (report.crossings, report.excluded) == (0, 0)
    assert start.particle_q.numpy()[:, 2].max() > 0.04


def test_a_captured_graph_steps_as_the_solver_does(device):
    """A box that turns: its proxy's rotation, too, starts where the last step ended."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    pose, inertia = wp.transform(wp.vec3(0.013, 0.007, 0.06), wp.quat_identity()), wp.mat33(5e-4 * np.eye(3))
    body = builder.add_body(xform=pose, mass=0.5, inertia=inertia, lock_inertia=True)
    builder.add_shape_box(body, hx=0.05, hy=0.05, hz=0.05, cfg=newton.ModelBuilder.ShapeConfig(density=0.0))
    add_patch(builder, 8, 0.03, (0.0, 0.0, 0.0), fixed=True)
    builder.color()
    ends = []
    for captured in (False, True):
        model = builder.finalize(device=device)
        model.body_qd.assign(np.float32([[0.0, 0.0, -1.0, 2.0, 1.0, 0.0]]))
        stages = []

        def make(view, stages=stages):
            stages.append(bsc.SolverCCD(SOLVERS["vbd"](view)))
            return stages[-1]

        proxies = [SolverCoupledProxy.Proxy(source="rigid", destination="cloth", bodies=[body])]
        solver = SolverCoupledProxy(
            model, entries(model, newton.solvers.SolverSemiImplicit, make), SolverCoupledProxy.Config(proxies=proxies)
        )
        states, control = (model.state(), model.state()), model.control()

        def step_twice(solver=solver, states=states, control=control):
            for start, end in (states, states[::-1]):
                start.clear_forces()
                solver.step(start, end, control, None, DT)

        if captured:
            with wp.ScopedCapture(device) as capture:
                step_twice()
        for _ in range(6):
            wp.capture_launch(capture.graph) if captured else step_twice()
        totals = stages[0].report.totals
        assert totals.steps == 12 and totals.uncertified_steps == totals.revoked_steps > 0 and totals.unseen_steps == 1
        of_bodies, of_particles = states[0].body_q.numpy().ravel(), states[0].particle_q.numpy().ravel()
        ends.append(np.concatenate([of_bodies, of_particles, [totals.revoked_steps]]))
    assert ends[0][2] < 0.04
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("iterations", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_what_two_entries_pass_of_each_other_is_met_in_the_next_step(iterations, device):
    """Each entry sees the other at its start: two patches swap sides in a step, and are pushed back in the next."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 8, 0.03, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, 5.0))
    add_patch(builder, 8, 0.03, (0.011, 0.017, 0.1), velocity=(0.0, 0.0, -5.0))
    builder.color()
    model = builder.finalize(device=device)
    parts = np.split(np.arange(model.particle_count), 2)
    stages = []

    def make(view):
        stages.append(bsc.SolverCCD(SOLVERS["vbd"](view)))
        return stages[-1]

    own = [SolverCoupled.Entry(name=str(i), solver=make, particles=parts[i].tolist()) for i in range(2)]
    solver = SolverCoupledADMM(model, own, SolverCoupledADMM.Config(iterations=iterations))
    rollout, gaps, passing = Rollout(model, solver), [], 0
    for _ in range(8):
        crosses = rollout.find_crossings(rollout.vertices(rollout.states[0]))
        rollout.step()
        solver.sync_entry_states(rollout.states[0])
        passes = bool(crosses or rollout.new_collisions)
        assert all(stage.report.certified != passes for stage in stages)
        passing += passes
        lower, upper = (rollout.positions[part, 2].mean() for part in parts)
        gaps.append(upper - lower)
    assert gaps[2] < -0.01 and min(gaps[3:]) > 0.01
    for stage in stages:
        totals = stage.report.totals
        assert (totals.uncertified_steps, totals.revoked_steps, totals.unseen_steps) == (passing, passing, 0)
    assert passing > 0


@pytest.mark.parametrize("resets", [False, True])
def test_proxies_start_where_a_program_sets_them_first(resets, device):
    """A ball that begins, or is put by a reset, below a sheet has not passed it on its way from anywhere else."""
    model = ball_over_sheet(device)
    solver, stage = with_proxy(model)
    start, end = model.state(), model.state()
    if resets:
        solver.step(start, end, None, None, 0.1 * DT)
        start, end = end, start
    for name in ("body_q", "body_qd", "joint_q", "joint_qd", "particle_q", "particle_qd"):
        getattr(start, name).assign(getattr(model, name))
    pose = start.body_q.numpy()
    pose[0, 2] = -0.1
    start.body_q.assign(pose)
    newton.eval_ik(model, start, start.joint_q, start.joint_qd)
    if resets:
        solver.reset(start, flags=newton.StateFlags.NONE)
    start.clear_forces()
    solver.step(start, end, None, None, DT)
    solver.sync_entry_states(end)
    assert stage.report.certified and stage.report.predicted_contacts == 0
    # the sheet is at rest but for the rounding of its elastic forces; the ball would carry it by its radius
    np.testing.assert_allclose(end.particle_q.numpy(), model.particle_q.numpy(), rtol=0.0, atol=1e-8)


def test_hooks_are_those_of_the_inner_solver(device):
    calls = []
    hooks = [name for name in dir(CouplingInterface) if name.startswith("coupling_")]

    def record(name):
        return lambda self, *arguments, **options: calls.append((name, arguments, options))

    inner = type("Inner", (newton.solvers.SolverXPBD,), {name: record(name) for name in hooks})
    stage = bsc.SolverCCD(inner(ball_over_sheet(device)))
    options = {"state": 1, "dt": 0.0}
    for name in hooks:
        arguments = {"coupling_notify_input_state_update": (1, 0)}.get(name, (1, 2))
        arguments = (1,) if name == "coupling_notify_iteration_restarts" else arguments
        known = {} if name == "coupling_notify_iteration_restarts" else options
        known = {"dt": 0.0} if name == "coupling_notify_input_state_update" else known
        known = {**known, "dt": 1.0} if "harvest" in name else known
        forces = wp.zeros(1, dtype=wp.spatial_vector if "wrenches" in name else wp.vec3, device=device)
        proxy = wp.full(100, -1, dtype=int, device=device)
        arguments = (proxy, forces) if "harvest" in name else arguments
        getattr(stage, name)(*arguments, **known)
        assert calls[-1][:2] == (name, arguments)
    assert len(calls) == len(hooks)


def test_an_inner_solver_without_hooks_has_those_of_the_interface(device):
    model = ball_over_sheet(device)
    stage = bsc.SolverCCD(type("Plain", (newton.solvers.SolverBase,), {})(model))
    assert not isinstance(stage.solver, CouplingInterface)
    masses = wp.zeros(1, dtype=float, device=device)
    kinds = wp.array([int(CouplingInterface.EndpointKind.BODY)], dtype=int, device=device)
    points = wp.zeros(1, dtype=wp.vec3, device=device)
    stage.coupling_eval_effective_mass(kinds, wp.zeros(1, dtype=int, device=device), points, masses)
    np.testing.assert_allclose(masses.numpy(), 0.2, rtol=1e-6)
