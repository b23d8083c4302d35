"""SolverImplicitAdjoint as a solver: VBD's results, its report, what it refuses, worlds, memory, the stage on top."""

import gc

import newton
import numpy as np
import pytest
import warp as wp
from implicit_scenes import (
    DT,
    SELF_CONTACT,
    Rollout,
    attached_cloth,
    cloth_on_slope,
    colliding_cloths,
    hanging_cloth,
    held_cloth,
    springs,
)
from newton_versions import needs_attachments, needs_hard_attachments, needs_truncation_before_shapes

import warp_bsc as bsc
import warp_bsc.implicit.solver as implicit_solver
from warp_bsc._private_names.of_newton import displacements_since_detection, pose_rebaseline_mask
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


@pytest.mark.parametrize("scene", [attached_cloth, held_cloth, colliding_cloths])
def test_the_limit_of_vbd_is_a_solved_step(scene, device):
    dt = 1.0 / 240.0 if scene is colliding_cloths else DT
    rollout = Rollout(scene(device), steps=1, iterations=300, polish=0, dt=dt, **SELF_CONTACT)
    with wp.Tape():
        rollout.run(rollout.begin())
    assert 0.0 < rollout.adjoint.report.residuals.max() < 1e-3


@pytest.mark.filterwarnings("ignore:.*of the weight")
def test_gradients_of_steps_that_are_not_solved_warn_and_polish_mends_them(device):
    model = hanging_cloth(device)
    rough = Rollout(model, iterations=2, polish=0)
    with pytest.warns(UserWarning, match="1% of the weight .* pass polish=3, or .*substeps=4"), wp.Tape():
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
    with pytest.warns(UserWarning, match="did not converge"):
        assert rollout.adjoint.report.failed_solves == 1
    assert rollout.adjoint.report.solves == 1


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


@pytest.mark.parametrize(
    "stiffness",
    [0.0, pytest.param(50.0, marks=needs_attachments), pytest.param(np.inf, marks=needs_hard_attachments)],
)
def test_poses_of_kinematic_bodies_get_gradients(stiffness, device):
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.0), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(body, hx=1.0, hy=1.0, hz=0.1, cfg=newton.ModelBuilder.ShapeConfig(ke=300.0, kd=0.0, mu=0.4))
    above = 0.117 if stiffness == 0.0 else 0.2  # with an attachment, no contact
    builder.add_particle(wp.vec3(0.0, 0.0, above), wp.vec3(0.1, 0.0, 0.0), 0.1, radius=0.02)
    if stiffness > 0.0:
        point = wp.vec3(0.002, 0.0, 0.21)
        builder.add_attachment_particle_body(0, body, body_point=point, stiffness=stiffness, damping=0.3)
    builder.color()
    model = builder.finalize(device=device, requires_grad=True)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 300.0, 0.0, 0.4
    solver = bsc.SolverImplicitAdjoint(newton.solvers.SolverVBD(model, iterations=10), polish=4)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.05)
    contacts = pipeline.contacts()

    def run(shift):
        """The states of two steps, and the pose to which the program moves the body between them."""
        states = [model.state() for _ in range(3)]
        with paused_tape():
            pipeline.collide(states[0], contacts)
            solver.reset(states[0])
        pose = states[0].body_q.numpy().copy()
        pose[0, :3] += np.array([0.002, 0.001, 0.0004]) + shift
        pose = wp.array(pose, dtype=wp.transform, device=device, requires_grad=True)
        solver.step(states[0], states[1], None, contacts, DT)
        wp.copy(states[1].body_q, pose)
        solver.step(states[1], states[2], None, contacts, DT)
        return states, pose

    def loss(shift):
        return run(shift)[0][-1].particle_q.numpy()[0].astype(float) @ np.array([1.0, 0.3, 2.0])

    with wp.Tape() as tape:
        states, pose = run(np.zeros(3))
    seed = wp.array([[1.0, 0.3, 2.0]], dtype=wp.vec3, device=device)
    tape.backward(grads={states[-1].particle_q: seed})
    gradient, h = pose.grad.numpy()[0, :3], 3e-4
    central = [(loss(h * axis) - loss(-h * axis)) / (2.0 * h) for axis in np.eye(3)]
    assert np.abs(central).max() > 0.1
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


def test_without_the_cut_of_vbd_polish_is_refused_with_self_contact(device):
    vbd = newton.solvers.SolverVBD(colliding_cloths(device), **SELF_CONTACT)
    start, displacements, cut = displacements_since_detection(vbd)
    assert start is vbd.pos_prev_collision_detection and displacements is vbd.particle_displacements
    state = vbd.model.state()
    state.particle_q.zero_()
    wp.copy(start, vbd.model.particle_q)
    displacements.zero_()
    cut(state)
    np.testing.assert_array_equal(state.particle_q.numpy(), vbd.model.particle_q.numpy())
    del vbd.particle_displacements
    with pytest.raises(RuntimeError, match="particle_displacements"):
        displacements_since_detection(vbd)


@pytest.mark.filterwarnings("ignore:.*of the weight")
def test_polish_does_not_leave_the_planes_of_self_contact_and_the_residual_says_so(device, monkeypatch):
    """Contacts are too soft to hold, so that solved steps pass through each other."""
    model = colliding_cloths(device)
    model.soft_contact_ke = 1.0
    mesh = bsc.CollisionMesh(model.tri_indices.numpy(), model.particle_count, device=device)
    detector, crossings, unconverged = bsc.CollisionDetector(mesh), [], []
    unread = [wp.zeros_like(model.particle_q) for _ in range(2)]
    without = (*unread, lambda state: None)
    for cuts in (True, False):
        rollout = Rollout(model, steps=2, iterations=1, start=(0.3, 0.1, -0.6), **SELF_CONTACT)
        if not cuts:
            monkeypatch.setattr(implicit_solver, "displacements_since_detection", lambda solver: without)
        with wp.Tape():
            states = rollout.run(rollout.begin())
        crossings.append(len(detector.find_intersections(states[-1].particle_q)))
        unconverged.append(rollout.adjoint.report.unconverged_steps)
    assert crossings[0] == 0 < crossings[1]
    assert unconverged == [2, 0]


@pytest.mark.filterwarnings("ignore:.*of the weight")
@pytest.mark.parametrize(("size", "expected"), [(1.0, 0), (0.7, 1)])
def test_solves_whose_matrix_is_not_positive_definite_are_counted(size, expected, device):
    model = hanging_cloth(device, n=4)
    model.particle_q.assign((model.particle_q.numpy() * (size, size, 1.0)).astype(np.float32))  # compressed
    rollout = Rollout(model, steps=1, polish=0)
    rollout.backward()
    report = rollout.adjoint.report
    assert (report.solves, report.failed_solves, report.indefinite_solves) == (1, 0, expected)
    assert report.rejected_solves == expected  # its residual is above the limit


def compressed_springs(device, offsets):
    """In each world, a mass halfway between two held points on springs of twice that length, some way off their line.

    Without gravity. On the line it is in balance: its forces across it are k y, with k = 2 * 60 N/m.
    """
    scene = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for offset in offsets:
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        for x, y, mass in ((-0.05, 0.0, 0.0), (0.0, offset, 0.02), (0.05, 0.0, 0.0)):
            builder.add_particle(wp.vec3(x, y, 0.0), wp.vec3(), mass, radius=0.01)
        for end in (0, 2):
            builder.add_spring(1, end, 60.0, 0.0, 0.0)
        builder.spring_rest_length[:] = [0.1, 0.1]
        scene.add_world(builder)
    scene.color()
    return scene.finalize(device=device, requires_grad=True)


@pytest.mark.filterwarnings("ignore:a step of VBD")
def test_gradients_of_an_unsolved_step_with_an_indefinite_matrix_are_nan_those_of_a_balance_are_exact(device):
    """On the line, (m / dt^2 - k) dy1 = m / dt dv0; off it, ten iterations leave two thirds of the weight."""
    rollout = Rollout(compressed_springs(device, (0.0, 0.01)), steps=1, polish=0, start=(0.0, 0.0, 0.0))
    rollout.velocity[:], rollout.weights[:] = 0.0, 0.0
    rollout.weights[0, :, 1] = 1.0
    gradient = rollout.backward()[0].particle_qd.grad.numpy()[[1, 4]]
    report = rollout.adjoint.report
    with pytest.warns(UserWarning, match="indefinite.* gradients are NaN .*substeps=4.* bending stiffness"):
        assert (report.solves, report.failed_solves, report.indefinite_solves, report.rejected_solves) == (1, 0, 2, 1)
    balanced, unsolved = report.residuals
    assert balanced == 0.0 and unsolved > 0.1
    expected = 0.02 / DT / (0.02 / DT**2 - 120.0)
    np.testing.assert_allclose(gradient[0], (0.0, expected, 0.0), rtol=1e-5, atol=1e-12)
    assert np.isnan(gradient[1]).all()


def test_polish_is_not_advised_to_a_program_that_passes_it(device):
    model = hanging_cloth(device, n=4)
    model.particle_q.assign((model.particle_q.numpy() * (0.7, 0.7, 1.0)).astype(np.float32))  # compressed
    with pytest.warns(UserWarning, match="of the weight") as said:
        rollout = Rollout(model, steps=1, iterations=1, polish=3)
        gradient = rollout.backward()[0].particle_qd.grad.numpy()
        assert rollout.adjoint.report.rejected_solves == 1
    assert np.isnan(gradient[model.particle_inv_mass.numpy() > 0.0]).all()
    words = [str(warning.message) for warning in said]
    assert not any("polish" in word for word in words) and any("substeps=4" in word for word in words)


@pytest.mark.filterwarnings("ignore:.*of the weight")
def test_pairs_that_self_contact_dropped_give_nan_in_their_world_and_are_counted(device):
    model = colliding_cloths(device, heights=(0.012, 0.1))  # those of the second world are not near each other
    options = {"steps": 1, "particle_vertex_contact_buffer_size": 1}
    rollout = Rollout(model, dt=1.0 / 240.0, start=(0.3, 0.1, -0.3), **options, **SELF_CONTACT)
    with pytest.warns(UserWarning, match="particle_vertex_contact_buffer_size"):
        gradient = rollout.backward()[0].particle_qd.grad.numpy()
        assert rollout.adjoint.report.overflowed_steps == 1
    free, world = model.particle_inv_mass.numpy() > 0.0, model.particle_world.numpy()
    assert np.isnan(gradient[free & (world == 0)]).all()
    assert np.isfinite(gradient[world == 1]).all()


@pytest.mark.parametrize("scene", [attached_cloth, colliding_cloths])
def test_gradients_in_a_graph_are_those_without(scene):
    rollout = Rollout(scene("cpu"), steps=2, polish=2, dt=1.0 / 240.0, start=(0.3, 0.1, -0.3), **SELF_CONTACT)
    expected, states = rollout.backward(), rollout.begin()
    seeds = wp.zeros((2, rollout.model.particle_count), dtype=wp.vec3, device="cpu")
    with wp.ScopedCapture("cpu") as capture:
        with wp.Tape() as tape:
            rollout.run(states)
        tape.backward(grads={states[-1].particle_q: seeds[0], states[-1].particle_qd: seeds[1]})
    for _ in range(2):
        begun = rollout.begin()[0]
        rollout.adjoint.solver.reset(states[0])  # the multipliers of attachments, which VBD begins with
        states[0].assign(begun)
        tape.zero()
        seeds.assign(rollout.weights)
        wp.capture_launch(capture.graph)
        np.testing.assert_array_equal(states[-1].particle_qd.numpy(), expected[-1].particle_qd.numpy())
        for name in ("particle_q", "particle_qd"):
            gradients = (getattr(state, name).grad.numpy() for state in (states[0], expected[0]))
            np.testing.assert_array_equal(*gradients)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*of the weight")
@pytest.mark.parametrize("scene", [cloth_on_slope, colliding_cloths])
def test_many_tapes_take_no_more_memory(scene, device):
    options = SELF_CONTACT if scene is colliding_cloths else {}
    rollout = Rollout(scene(device), steps=2, polish=0, **options)

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
            ({"collision_pipeline": True}, "collision pipeline"),
            pytest.param(
                {"rigid_soft_enable_dat": True}, "rigid_soft_enable_dat|pipeline", marks=needs_truncation_before_shapes
            ),
        ],
    )
    def test_options_of_vbd(self, options, named, device):
        model = hanging_cloth(device)
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

    def test_self_contact_of_particles_that_belong_to_no_world(self, device):
        scene, cloth = newton.ModelBuilder(), newton.ModelBuilder()
        for builder in (scene, cloth):
            size = {"dim_x": 1, "dim_y": 1, "cell_x": 0.1, "cell_y": 0.1, "mass": 0.01}
            builder.add_cloth_grid(pos=wp.vec3(), rot=wp.quat_identity(), vel=wp.vec3(), **size)
        scene.add_world(cloth)
        scene.color()
        model = scene.finalize(device=device, requires_grad=True)
        solver = bsc.SolverImplicitAdjoint(newton.solvers.SolverVBD(model, iterations=1, **SELF_CONTACT))
        start, end = model.state(), model.state()
        with pytest.raises(NotImplementedError, match="of a world and of none"), wp.Tape():
            solver.step(start, end, None, None, DT)

    def test_several_attachments_that_hold_a_particle(self, device):
        model = attached_cloth(device)
        vbd = newton.solvers.SolverVBD(model, iterations=1)
        solver = bsc.SolverImplicitAdjoint(vbd)
        model.attachment_particle_body_stiffness.fill_(np.inf)
        solver.notify_model_changed(newton.ModelFlags.CONSTRAINT_PROPERTIES)
        model.attachment_particle_body_particle.zero_()
        with pytest.raises(NotImplementedError, match="hold one particle"):
            solver.notify_model_changed(newton.ModelFlags.CONSTRAINT_PROPERTIES)
        with pytest.raises(NotImplementedError, match="hold one particle"):
            bsc.SolverImplicitAdjoint(vbd)

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
    assert stage.work.motion.moves_bodies


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
