"""SolverImplicitAdjoint as a solver: VBD's results, its report, what it refuses, worlds, memory, the stage on top."""

import gc
import itertools

import newton
import numpy as np
import pytest
import warp as wp
from implicit_scenes import DT, Rollout, cloth_on_slope, hanging_cloth, springs

import warp_bsc as bsc
from warp_bsc._private_names.of_newton import pose_rebaseline_mask
from warp_bsc._private_names.of_warp import paused_tape


def test_results_are_those_of_vbd_bit_for_bit(device):
    model = cloth_on_slope(device)
    rollout = Rollout(model, polish=0)
    plain = rollout.run(rollout.begin())
    with wp.Tape():
        taped = rollout.run(rollout.begin())
    rollout.solver = newton.solvers.SolverVBD(model, iterations=10)
    expected = rollout.run(rollout.begin())
    for states in (plain, taped):
        assert (states[-1].particle_q.numpy() == expected[-1].particle_q.numpy()).all()
        assert (states[-1].particle_qd.numpy() == expected[-1].particle_qd.numpy()).all()
    assert (taped[0].particle_q.numpy() == model.particle_q.numpy()).all()  # which VBD overwrites


@pytest.mark.filterwarnings("ignore:.*of the weight")
def test_gradients_of_steps_that_are_not_solved_warn_and_polish_mends_them(device):
    model = hanging_cloth(device)
    rough = Rollout(model, iterations=2, polish=0)
    with pytest.warns(UserWarning, match="more than 1% of the weight"), wp.Tape():
        rough.run(rough.begin())
    report = rough.adjoint.report
    assert report.steps == rough.steps
    assert report.unconverged_steps > 0
    assert report.largest_residuals.max() >= report.residuals.max() > 0.01
    polished = Rollout(model, iterations=2, polish=3)
    with wp.Tape():
        polished.run(polished.begin())
    assert polished.adjoint.report.unconverged_steps == 0
    assert polished.adjoint.report.largest_residuals.max() < 1e-3
    assert polished.loss() != rough.loss()


def test_polish_is_the_same_on_a_tape_and_without(device):
    rollout = Rollout(cloth_on_slope(device))
    plain = rollout.run(rollout.begin())
    with wp.Tape():
        taped = rollout.run(rollout.begin())
    ends = plain[-1].particle_q.numpy(), taped[-1].particle_q.numpy()
    # VBD adds up forces of contacts in any order on a GPU
    np.testing.assert_allclose(*ends, rtol=0.0, atol=0.0 if rollout.model.device.is_cpu else 1e-6)


@pytest.mark.filterwarnings("ignore:.*of the weight")
def test_a_solve_that_does_not_converge_gives_nan_and_is_counted(device):
    rollout = Rollout(hanging_cloth(device), steps=1, polish=0, max_iterations=1)
    states = rollout.backward()
    free = rollout.model.particle_inv_mass.numpy() > 0.0
    assert np.isnan(states[0].particle_qd.grad.numpy()[free]).all()
    assert rollout.adjoint.report.failed_solves == 1
    assert rollout.adjoint.report.solves == 1
    with pytest.warns(UserWarning, match="did not converge"), wp.Tape():
        rollout.run(rollout.begin())


def test_worlds_are_independent(device):
    both = Rollout(hanging_cloth(device, 2, worlds=2), steps=3, polish=2)
    states = both.backward()
    assert both.adjoint.report.worlds.tolist() == [0, 1]
    assert (both.adjoint.report.residuals > 0.0).all()
    single = Rollout(hanging_cloth(device, 2), steps=3, polish=2)
    n = single.model.particle_count
    single.weights, single.velocity = both.weights[:, :n], both.velocity[:n]
    alone = single.backward()
    gradients = states[0].particle_qd.grad.numpy()[:n], alone[0].particle_qd.grad.numpy()
    np.testing.assert_allclose(*gradients, atol=1e-4 * np.abs(gradients[1]).max())


def test_a_world_that_fails_leaves_others(device):
    rollout = Rollout(hanging_cloth(device, 2, worlds=2), steps=1, polish=2)
    rollout.weights[0, 1] = np.nan  # of a free particle
    states = rollout.backward()
    assert rollout.adjoint.report.failed_solves == 1
    gradient = states[0].particle_qd.grad.numpy()
    assert np.isnan(gradient[:9]).any()
    assert np.isfinite(gradient[9:]).all()


def test_poses_of_kinematic_bodies_get_gradients(device):
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.0), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(body, hx=1.0, hy=1.0, hz=0.1, cfg=newton.ModelBuilder.ShapeConfig(ke=300.0, kd=0.0, mu=0.4))
    builder.add_particle(wp.vec3(0.0, 0.0, 0.105), wp.vec3(0.1, 0.0, 0.0), 0.01, radius=0.02)
    builder.color()
    model = builder.finalize(device=device, requires_grad=True)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 300.0, 0.0, 0.4
    solver = bsc.SolverImplicitAdjoint(newton.solvers.SolverVBD(model, iterations=10), polish=4)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.05)
    contacts = pipeline.contacts()

    def run(shift, steps=2):
        states = [model.state() for _ in range(steps + 1)]
        pipeline.collide(states[0], contacts)
        solver.reset(states[0])
        for i, state in enumerate(states):
            pose = state.body_q.numpy()
            pose[0, :3] = 0.002 * i * np.array([1.0, 0.5, 0.2])
            pose[0, :3] += shift if i == 1 else 0.0
            state.body_q.assign(pose)
        return states

    def finish(states):
        for start, end in itertools.pairwise(states):
            pose = wp.clone(end.body_q, requires_grad=False)
            solver.step(start, end, None, contacts, DT)
            with paused_tape():
                wp.copy(end.body_q, pose)  # the program moves the body between steps
        return states[-1].particle_q.numpy()[0].astype(float) @ np.array([1.0, 0.3, 2.0])

    states = run(np.zeros(3))
    with wp.Tape() as tape:
        finish(states)
    seed = wp.array([[1.0, 0.3, 2.0]], dtype=wp.vec3, device=device)
    tape.backward(grads={states[-1].particle_q: seed})
    gradient = states[1].body_q.grad.numpy()[0, :3]
    h = 3e-4
    central = [(finish(run(h * axis)) - finish(run(-h * axis))) / (2.0 * h) for axis in np.eye(3)]
    np.testing.assert_allclose(gradient, central, atol=0.01 * np.abs(central).max())


def test_without_the_name_of_the_mask_steps_with_bodies_are_refused(device):
    builder = newton.ModelBuilder()
    builder.add_body()
    builder.color()
    vbd = newton.solvers.SolverVBD(builder.finalize(device=device))
    assert pose_rebaseline_mask(vbd).numpy().all()  # before the first step
    del vbd._rigid_pose_rebaseline_mask
    with pytest.raises(RuntimeError, match="_rigid_pose_rebaseline_mask"):
        pose_rebaseline_mask(vbd)


@pytest.mark.filterwarnings("ignore:.*of the weight")
def test_many_tapes_take_no_more_memory(device):
    rollout = Rollout(cloth_on_slope(device), steps=2, polish=0)

    def arrays():
        gc.collect()
        return sum(isinstance(found, wp.array) for found in gc.get_objects())

    counts = []
    for _ in range(6):
        rollout.backward()
        counts.append(arrays())
    assert len(set(counts[1:])) == 1


class TestRefusals:
    """What cannot be differentiated raises an error that names it."""

    @pytest.mark.parametrize(
        "options, named",
        [
            ({"particle_enable_self_contact": True}, "particle_enable_self_contact"),
            ({"rigid_soft_enable_dat": True}, "rigid_soft_enable_dat|pipeline"),
        ],
    )
    def test_options_of_vbd(self, options, named, device):
        model = hanging_cloth(device)
        if "rigid_soft_enable_dat" in options:
            options = options | {"collision_pipeline": newton.CollisionPipeline(model)}
        solver = bsc.SolverImplicitAdjoint(newton.solvers.SolverVBD(model, iterations=1, **options))
        start, end = model.state(), model.state()
        with pytest.raises(NotImplementedError, match=named), wp.Tape():
            solver.step(start, end, None, None, DT)

    def test_dynamic_bodies(self, device):
        builder = newton.ModelBuilder()
        body = builder.add_body()
        builder.add_shape_sphere(body, radius=0.1)
        builder.add_particle(wp.vec3(0.0, 0.0, 1.0), wp.vec3(), 0.01)
        builder.color()
        model = builder.finalize(device=device, requires_grad=True)
        solver = bsc.SolverImplicitAdjoint(newton.solvers.SolverVBD(model, iterations=1))
        start, end = model.state(), model.state()
        with pytest.raises(NotImplementedError, match="dynamic bodies"), wp.Tape():
            solver.step(start, end, None, None, DT)
        solver.step(start, end, None, None, DT)  # without a tape, it is VBD

    @pytest.mark.filterwarnings("ignore:.*of the weight")
    def test_contacts_that_a_tape_detected_twice(self, device):
        rollout = Rollout(cloth_on_slope(device), steps=2, polish=0)
        rollout.contacts = rollout.contacts[:1] * 2
        with pytest.raises(ValueError, match="each step needs contacts of its own"), wp.Tape():
            rollout.run(rollout.begin())
        rollout.run(rollout.begin())
        tape = wp.Tape()
        for _ in range(2):  # a tape that was reset begins anew
            with tape:
                start, end = rollout.begin()[:2]
                rollout.pipeline.collide(start, rollout.contacts[0])
                rollout.solver.step(start, end, None, rollout.contacts[0], DT)
            tape.reset()

    def test_states_and_arguments(self, device):
        model = springs(device)
        vbd = newton.solvers.SolverVBD(model, iterations=1)
        solver, state = bsc.SolverImplicitAdjoint(vbd), model.state()
        with pytest.raises(ValueError, match="state_out must not be state_in"), wp.Tape():
            solver.step(state, state, None, None, DT)
        with pytest.raises(TypeError, match="solver"):
            bsc.SolverImplicitAdjoint(newton.solvers.SolverSemiImplicit(model))
        for option in ({"polish": -1}, {"tolerance": 0.0}, {"max_iterations": 0}):
            with pytest.raises(ValueError, match=next(iter(option))):
                bsc.SolverImplicitAdjoint(vbd, **option)


def test_the_stage_sees_vbd_through_its_adjoint(device):
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()))
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1)
    builder.add_cloth_grid(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        vel=wp.vec3(),
        dim_x=2,
        dim_y=2,
        cell_x=0.1,
        cell_y=0.1,
        mass=0.01,
    )
    builder.color()
    model = builder.finalize(device=device)
    vbd = newton.solvers.SolverVBD(model, particle_enable_self_contact=True)
    stage = bsc.SolverCCD(bsc.SolverImplicitAdjoint(vbd))
    assert stage.report.speed_limit_lifted
    assert stage._motion.moves_bodies


def test_gradients_go_through_the_stage_and_vbd(device):
    """A small patch of cloth is thrown at a sheet that is held."""
    builder = newton.ModelBuilder()
    material = {"tri_ke": 80.0, "tri_ka": 60.0, "tri_kd": 5e-3, "edge_ke": 5e-2, "edge_kd": 1e-3}
    tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.2)
    at = wp.vec3(-0.05, -0.04, 0.03)
    size = {"dim_x": 2, "dim_y": 2, "cell_x": 0.05, "cell_y": 0.05}
    builder.add_cloth_grid(pos=at, rot=tilt, vel=wp.vec3(), mass=0.002, particle_radius=0.01, **size, **material)
    thrown = builder.particle_count
    held = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
    size = {"dim_x": 1, "dim_y": 1, "cell_x": 0.6, "cell_y": 0.6}
    at, flat = wp.vec3(-0.3, -0.3, 0.0), wp.quat_identity()
    builder.add_cloth_grid(pos=at, rot=flat, vel=wp.vec3(), mass=0.002, **held, **size, **material)
    builder.color()
    model = builder.finalize(device=device, requires_grad=True)

    def wrap(solver):  # the layer is thicker than the path of a step
        return bsc.SolverCCD(bsc.ContactLayer(solver, thickness=0.02))

    rollout = Rollout(model, steps=4, polish=3, wrap=wrap)
    rollout.velocity[:thrown] = (0.3, 0.1, -1.0)
    states = rollout.backward()
    assert rollout.solver.report.totals.uncertified_steps == 0
    assert rollout.adjoint.report.failed_solves == 0
    direction = np.zeros((model.particle_count, 3))
    moved = Rollout(model, steps=4, polish=0)
    moved.solver = moved.adjoint.solver
    free = moved.run(states[:1] + moved.begin()[1:])[-1].particle_q.numpy()[:thrown, 2].min()
    assert free < 0.0 < states[-1].particle_q.numpy()[:thrown, 2].min()  # the stage has stopped it
    for axis in np.eye(3):
        direction[:thrown] = axis
        h = 1e-3
        ends = [rollout.loss(rollout.velocity + sign * h * direction) for sign in (1.0, -1.0)]
        gradient = (states[0].particle_qd.grad.numpy() * direction).sum()
        assert gradient == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=0.01, abs=2e-5)
