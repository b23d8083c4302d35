"""What a program moves between steps, as animations do, takes that way in the next step."""

import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, Changed, Rollout, add_patch

import warp_bsc as bsc

SPEED = 6.0  # 25 mm a step, through a sheet without thickness
POSES = [(0.013, 0.007, 0.1 - SPEED * DT * i) for i in range(12)]


def pose(x):
    return np.float32([[*x, 0.0, 0.0, 0.0, 1.0]])


def ball_over_sheet(device, *, worlds=1, is_kinematic=True, speed=0.0, **options):
    """A sheet that floats, and a ball above it, which is kinematic or falls with a speed."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(world, 8, 0.04, (0.0, 0.0, 0.0))
    body = world.add_body(xform=wp.transform(wp.vec3(*POSES[0]), wp.quat_identity()), is_kinematic=is_kinematic)
    world.body_qd[body] = (0.0, 0.0, -speed, 0.0, 0.0, 0.0)
    world.add_shape_sphere(body, radius=0.05)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, worlds)
    builder.color()
    return builder.finalize(device=device, **options)


def animate(rollout, x):
    """Sets the ball between steps."""
    rollout.states[0].body_q.assign(pose(x))


def ball_in_sheet(rollout):
    """The number of edges that cross faces now, of which one is of the sheet."""
    return len(rollout.find_crossings(rollout.vertices(rollout.states[0])))


def test_a_ball_set_between_steps_is_one_that_moves_in_them(device):
    """Bit by bit: the inner solver knows nothing of the ball."""
    model = ball_over_sheet(device)
    between, within = (Rollout(model, bsc.SolverCCD(Changed(model))) for _ in range(2))
    within.solver.solver.change = lambda state: state.body_q.assign(pose(x))
    hits = 0
    for x in POSES:
        animate(between, x)
        between.step()
        within.step()
        assert between.solver.report.certified and between.solver.report.truncated == 0
        assert between.positions.tobytes() == within.positions.tobytes()
        assert between.velocities.tobytes() == within.velocities.tobytes()
        assert ball_in_sheet(between) == between.solver.report.crossings == 0
        hits += between.solver.report.predicted_contacts
    assert hits > 20 and between.positions[:, 2].min() < POSES[-1][2]


def said_of_bodies(rollout, steps, move=None):
    """Returns what some steps warn of bodies that a program moves, which happens between them."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for x in POSES[:steps]:
            if move is not None:
                move(rollout, x)
            rollout.step()
            assert rollout.solver.report.certified
    return [str(warning.message) for warning in said if "pose of dynamic bodies" in str(warning.message)]


def test_a_dynamic_body_that_a_program_sets_in_each_step_is_named_once(device):
    """Not one that is kinematic, that contacts push, that is set now and then, or whose world starts anew."""
    model, kinematic = ball_over_sheet(device, is_kinematic=False), ball_over_sheet(device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    (said,) = said_of_bodies(rollout, 12, animate)
    assert "body 0 ('body_0')" in said and "is_kinematic=True" in said
    assert rollout.solver.report.totals.set_bodies == 1

    def animate_at_times(rollout, x):
        if POSES.index(x) % 3:
            animate(rollout, x)

    def start_anew(rollout, x):
        animate(rollout, x)
        rollout.states[0].particle_q.assign(rollout.positions + np.float32([0.0, 0.0, 1e-3 * POSES.index(x)]))

    for bodies, move in ((model, animate_at_times), (model, start_anew), (kinematic, animate)):
        rollout = Rollout(bodies, bsc.SolverCCD(Changed(bodies)))
        assert not said_of_bodies(rollout, 9, move) and rollout.solver.report.totals.set_bodies == 0
    pushed = ball_over_sheet(device, is_kinematic=False, speed=SPEED)
    rollout = Rollout(pushed, bsc.SolverCCD(newton.solvers.SolverXPBD(pushed, iterations=1)))
    assert not said_of_bodies(rollout, 9) and rollout.solver.report.totals.truncated_steps == 0


@pytest.mark.parametrize("device_loop", [False, True])
def test_the_first_step_begins_where_the_model_puts_things(device_loop, device):
    """Loops often set the pose for the end of the step first: the ball then comes from its pose in the model."""
    model = ball_over_sheet(device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    if device_loop:  # nothing of the state is looked at when a graph is captured
        with wp.ScopedCapture(device) as capture:
            rollout.solver.step(*rollout.states, rollout.control, None, DT)
        animate(rollout, POSES[-1])
        wp.capture_launch(capture.graph)
        rollout.states = rollout.states[::-1]
    else:
        animate(rollout, POSES[-1])
        rollout.step()
    report = rollout.solver.report
    assert report.certified and report.predicted_contacts > 20 and report.truncated == 0
    assert ball_in_sheet(rollout) == rollout.solver.report.crossings == 0
    assert rollout.positions[:, 2].min() < POSES[-1][2] - 0.05  # below the ball


def arm_over_sheet(device, angle):
    """A sheet, and a kinematic arm above it that turns about a joint, which ``joint_q`` turns by an angle."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.04, (0.0, 0.0, 0.0))
    arm = builder.add_link(xform=wp.transform(wp.vec3(0.0, 0.0, 0.1), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_box(arm, hx=0.1, hy=0.02, hz=0.005)
    hinge = {"parent_xform": wp.transform(wp.vec3(-0.1, 0.0, 0.1), wp.quat_identity()), "axis": wp.vec3(0.0, 1.0, 0.0)}
    hinge["child_xform"] = wp.transform(wp.vec3(-0.1, 0.0, 0.0), wp.quat_identity())
    builder.add_articulation([builder.add_joint_revolute(-1, arm, **hinge)])
    builder.joint_q[-1] = angle
    builder.color()
    return builder.finalize(device=device)


@pytest.mark.parametrize(("placed", "turned", "passes"), [(0.0, 1.2, True), (1.2, 1.2, False), (1.2, -1.0, False)])
def test_joints_may_place_bodies_before_the_first_step(placed, turned, passes, device):
    """An arm that joint coordinates put elsewhere than ``body_q`` begins there; one at its ``body_q`` comes from it."""
    model = arm_over_sheet(device, placed)
    given = model.body_q.numpy().copy()
    given[:, 3:] *= -1.0  # the same rotation
    model.body_q.assign(given)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    assert model.body_q.numpy().tobytes() == given.tobytes()  # the model keeps what it is
    model.joint_q.fill_(turned)
    newton.eval_fk(model, model.joint_q, model.joint_qd, rollout.states[0])
    rollout.step()
    assert (rollout.solver.report.predicted_contacts > 0) == passes and rollout.solver.report.certified


def test_the_monitor_counts_what_a_ball_passes_between_steps(device):
    model = ball_over_sheet(device)
    rollout = Rollout(model, bsc.CollisionMonitor(Changed(model)))
    hits = 0
    for x in POSES:
        animate(rollout, x)
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
    assert hits > 20 and (rollout.positions[:, 2] == 0.0).all()


def test_particles_that_are_held_take_their_way_too(device):
    """A held patch that a program pulls through a sheet pushes that ahead."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 8, 0.04, (0.0, 0.0, 0.0))
    sheet = builder.particle_count
    add_patch(builder, 2, 0.04, (0.013, 0.007, 0.1), fixed=True)
    builder.particle_mass[sheet:] = [0.0] * (builder.particle_count - sheet)
    builder.color()
    rollout = Rollout(model := builder.finalize(device=device), bsc.SolverCCD(Changed(model)))
    for i in range(12):
        positions = rollout.positions
        positions[sheet:, 2] = 0.1 - SPEED * DT * i
        rollout.states[0].particle_q.assign(positions)
        rollout.step()
        assert rollout.solver.report.certified
        assert not rollout.find_crossings(rollout.positions) and rollout.solver.report.crossings == 0
    assert rollout.positions[:sheet, 2].min() < rollout.positions[sheet:, 2].max() < 0.0


def test_a_plane_that_a_program_moves_pushes(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 4, 0.04, (0.0, 0.0, 0.01))
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_plane(body=body, width=0.0, length=0.0)
    builder.color()
    rollout = Rollout(model := builder.finalize(device=device), bsc.SolverCCD(Changed(model)))
    for i in range(6):
        rollout.states[0].body_q.assign(pose((0.0, 0.0, 0.025 * i)))
        rollout.step()
        assert rollout.solver.report.certified
        assert rollout.positions[:, 2].min() > 0.025 * i


@pytest.mark.parametrize("how", ["state", "reset", "state before the first step"])
def test_what_is_set_to_another_state_begins_there(how, device):
    """The ball was above the sheet, and is below it after a reset: it did not pass."""
    model = ball_over_sheet(device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    for _ in range(0 if "first" in how else 2):
        rollout.step()
    expected = rollout.positions
    if how.startswith("state"):
        expected[0, 0] += 0.01
        rollout.states[0].particle_q.assign(expected)
    elif how == "reset":
        rollout.solver.reset(rollout.states[0])
    animate(rollout, POSES[-1])
    rollout.step()
    assert rollout.solver.report.certified and rollout.solver.report.predicted_contacts == 0
    assert rollout.positions.tobytes() == expected.tobytes()


@pytest.mark.parametrize("mask", [[True, False, False], [False, False, True], None])
def test_a_world_is_set_to_another_state_alone(mask, device):
    model = ball_over_sheet(device, worlds=2)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    rollout.step()
    before = rollout.positions
    if mask is not None:
        rollout.solver.reset(rollout.states[0], world_mask=wp.array(mask, dtype=bool, device=device))
    rollout.states[0].body_q.assign(np.concatenate([pose(POSES[-1])] * 2))
    rollout.step()
    moved = (rollout.positions != before).reshape(2, -1).any(axis=1)
    expected = {None: [True, True], (True, False, False): [False, True], (False, False, True): [False, False]}
    assert moved.tolist() == expected[None if mask is None else tuple(mask)]
    assert rollout.solver.report.certified


@wp.kernel(enable_backward=False)
def _lower(path: float, body_q: wp.array[wp.transform]):
    body_q[0] = wp.transform(wp.transform_get_translation(body_q[0]) - wp.vec3(0.0, 0.0, path), wp.quat_identity())


def test_a_graph_that_moves_a_ball(device):
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    model = ball_over_sheet(device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    states = rollout.states

    def frame():
        for start, end in (states, states[::-1]):
            wp.launch(_lower, 1, inputs=[SPEED * DT, start.body_q], device=device)
            start.clear_forces()
            rollout.solver.step(start, end, rollout.control, None, DT)

    with wp.ScopedCapture(device) as capture:
        frame()
    for _ in range(6):
        wp.capture_launch(capture.graph)
        assert rollout.solver.report.certified
        assert ball_in_sheet(rollout) == 0
    assert rollout.positions[:, 2].min() < -0.05
