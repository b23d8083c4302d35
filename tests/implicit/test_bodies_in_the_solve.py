"""SolverImplicit moves free rigid bodies in the solve: flight, rest, rolling, momenta, worlds, joints, couplers."""

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers.experimental.coupled import SolverCoupled, SolverCoupledProxy
from newton_scenes import Rollout, add_patch

from warp_bsc.implicit.solver_implicit import SolverImplicit

DT = 1.0 / 120.0
RADIUS = 0.08
TILTED = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.3)
BOX = {"hx": 0.1, "hy": 0.08, "hz": 0.05}


def add_body(builder, shape, at, *, mass=1.0, inertia=(4e-3, 4e-3, 4e-3), rotation=TILTED, **size):
    """A body with one shape, whose mass and inertia are those given."""
    options = {"mass": mass, "inertia": wp.mat33(*np.diag(inertia).ravel().tolist()), "lock_inertia": True}
    body = builder.add_body(xform=wp.transform(wp.vec3(*at), rotation), **options)
    getattr(builder, f"add_shape_{shape}")(body, cfg=newton.ModelBuilder.ShapeConfig(mu=0.5, density=0.0), **size)
    return body


def add_ball(builder, at, mass=0.1):
    """A solid ball."""
    return add_body(builder, "sphere", at, mass=mass, inertia=3 * (0.4 * mass * RADIUS**2,), radius=RADIUS)


def builder_without_gravity():
    return newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))


def finalize(builder, velocities, device):
    """A model whose bodies have these velocities, linear and angular."""
    builder.color()
    model = builder.finalize(device=device)
    model.body_qd.assign(np.float32(velocities))
    return model


def rotation_of(quaternion):
    return np.array(wp.quat_to_matrix(wp.quat(*quaternion.tolist()))).reshape(3, 3)


def spin_of(model, state):
    """Angular momentum of the first body about its centre, and its energy."""
    frame, spin = rotation_of(state.body_q.numpy()[0, 3:]), state.body_qd.numpy()[0, 3:]
    momentum = frame @ model.body_inertia.numpy()[0] @ frame.T @ spin
    return momentum, 0.5 * momentum @ spin


def lowest_vertex(rollout):
    """Height of the lowest vertex of a dynamic body."""
    body = rollout.solver.mesh.shape_vertices.body
    return rollout.vertices(rollout.states[0])[rollout.model.particle_count :][body >= 0, 2].min()


def test_a_box_that_turns_freely_keeps_its_angular_momentum_and_energy(device):
    """About the axis in the middle, where it tumbles."""
    builder = builder_without_gravity()
    add_body(builder, "box", (0.0, 0.0, 0.0), inertia=(1e-3, 2e-3, 3e-3), **BOX)
    model = finalize(builder, [[0.3, 0.0, 0.0, 0.1, 15.0, 0.0]], device)
    rollout = Rollout(model, SolverImplicit(model))
    momentum, energy = spin_of(model, rollout.states[0])
    turned_over = False
    for _ in range(60):
        rollout.step(DT)
        now, energy_now = spin_of(model, rollout.states[0])
        assert np.linalg.norm(now - momentum) < 1e-4 * np.linalg.norm(momentum)
        assert abs(energy_now - energy) < 0.01 * energy
        frame = rotation_of(rollout.states[0].body_q.numpy()[0, 3:])
        turned_over |= abs(frame[:, 1] @ momentum) < 0.9 * np.linalg.norm(momentum)
    assert turned_over
    np.testing.assert_allclose(rollout.states[0].body_q.numpy()[0, :3], [60 * DT * 0.3, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("floor", ["plane", "box"])
def test_a_box_dropped_on_a_floor_rests_on_it(floor, device):
    builder = newton.ModelBuilder()
    if floor == "plane":
        builder.add_ground_plane()
    else:
        builder.add_shape_box(
            -1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.5), wp.quat_identity()), hx=1.0, hy=1.0, hz=0.5
        )
    add_body(builder, "box", (0.0, 0.0, 0.11), **BOX)
    model = finalize(builder, [[0.2, 0.0, -1.0, 0.0, 0.0, 0.0]], device)
    rollout = Rollout(model, SolverImplicit(model))
    lowest = 1.0
    for _ in range(70):
        rollout.step(DT)
        assert rollout.solver.report.certified
        lowest = min(lowest, lowest_vertex(rollout))
    assert lowest > 0.0
    assert lowest_vertex(rollout) < 0.003
    up = rotation_of(rollout.states[0].body_q.numpy()[0, 3:])[2, 2]
    assert up > 1.0 - 1e-4  # flat on its side
    assert np.abs(rollout.states[0].body_qd.numpy()).max() < 5e-3


def test_a_ball_that_slides_ends_up_rolling_at_five_sevenths_of_its_speed(device):
    builder = newton.ModelBuilder()
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.5))
    add_ball(builder, (0.0, 0.0, RADIUS + 0.002))
    model = finalize(builder, [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]], device)
    rollout = Rollout(model, SolverImplicit(model))
    for _ in range(30):
        rollout.step(DT)
    velocity = rollout.states[0].body_qd.numpy()[0]
    assert velocity[0] == pytest.approx(5.0 / 7.0, rel=0.05)
    assert velocity[4] * RADIUS == pytest.approx(velocity[0], rel=0.05)


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_a_body_and_a_free_sheet_keep_their_momentum(shape, device):
    builder = builder_without_gravity()
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0))
    if shape == "sphere":
        add_ball(builder, (0.013, 0.007, RADIUS + 0.01))
    else:
        add_body(builder, "box", (0.013, 0.007, 0.1), mass=0.1, inertia=(4e-4, 6e-4, 9e-4), **BOX)
    model = finalize(builder, [[0.3, 0.0, -3.0, 1.0, 5.0, 2.0]], device)
    rollout = Rollout(model, SolverImplicit(model, max_iterations=60))
    mass, body_mass = model.particle_mass.numpy()[:, None], model.body_mass.numpy()[0]

    def momentum():
        state = rollout.states[0]
        return (mass * state.particle_qd.numpy()).sum(axis=0) + body_mass * state.body_qd.numpy()[0, :3]

    start = momentum()
    for _ in range(8):
        rollout.step(0.5 * DT)
        assert rollout.solver.report.certified
        certified = rollout.solver.work.vertices.x1.numpy()
        assert certified.tobytes() == rollout.vertices(rollout.states[0]).tobytes()
    assert rollout.collisions == 0
    assert rollout.states[0].particle_qd.numpy()[:, 2].min() < -1.0
    # each step ends as far from its solution as unknowns still change by, at up to 1 mm/s
    assert np.linalg.norm(momentum() - start) < 1e-3 * np.linalg.norm(start)


def falling_things(heights):
    """In each world a ball and a box above a sheet that is held at its border."""
    builder = newton.ModelBuilder()
    for height in heights:
        world = newton.ModelBuilder()
        add_patch(world, 4, 0.05, (0.0, 0.0, 0.0), fixed=True)
        add_ball(world, (0.013, 0.007, RADIUS + height))
        add_body(world, "box", (0.02, 0.0, 0.3 + height), mass=0.1, inertia=(4e-4, 6e-4, 9e-4), **BOX)
        builder.add_world(world)
    return builder


def test_each_world_moves_as_it_would_alone(device):
    heights, velocity = (0.006, 0.011, 0.03), [[0.1, 0.0, -1.0, 0.0, 1.0, 0.0], [0.0, 0.0, -3.0, 1.0, 0.0, 0.0]]

    def ends(heights):
        model = finalize(falling_things(heights), len(heights) * velocity, device)
        solver, states = SolverImplicit(model), [model.state(), model.state()]
        for _ in range(8):
            solver.step(*states, None, None, DT)
            states.reverse()
        size = len(heights), -1
        names = "particle_q", "particle_qd", "body_q", "body_qd"
        return np.concatenate([getattr(states[0], name).numpy().reshape(size) for name in names], axis=1)

    together = ends(heights)
    for world, height in enumerate(heights):
        assert together[world].tobytes() == ends([height])[0].tobytes()
    assert (together[:2, 2::3][:, :75].min(axis=1) < -1e-3).all()  # the ball has reached the sheet


def test_kinematic_bodies_and_bodies_without_mass_stay(device):
    builder = newton.ModelBuilder()
    kinematic = add_body(builder, "box", (0.0, 0.0, 0.2), rotation=wp.quat_identity(), **BOX)
    builder.body_flags[kinematic] = int(newton.BodyFlags.KINEMATIC)
    add_body(builder, "box", (1.0, 0.0, 0.2), mass=0.0, inertia=(0.0, 0.0, 0.0), **BOX)
    add_body(builder, "box", (0.0, 0.0, 0.32), rotation=wp.quat_identity(), **BOX)
    model = finalize(builder, 3 * [6 * [0.0]], device)
    rollout = Rollout(model, SolverImplicit(model))
    for _ in range(20):
        rollout.step(DT)
    poses = rollout.states[0].body_q.numpy()
    np.testing.assert_array_equal(poses[:2], model.body_q.numpy()[:2])
    assert 0.3 < poses[2, 2] < 0.315 and abs(rollout.states[0].body_qd.numpy()[2, 2]) < 1e-2


def hinged_box(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.05, (0.0, 0.0, -0.5))
    body = builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)), lock_inertia=True, label="door")
    builder.add_shape_box(body, cfg=newton.ModelBuilder.ShapeConfig(density=0.0), **BOX)
    builder.add_articulation([builder.add_joint_revolute(-1, body, axis=(0.0, 1.0, 0.0))])
    builder.color()
    return builder.finalize(device=device)


def test_bodies_behind_joints_are_for_another_solver(device):
    model = hinged_box(device)
    with pytest.raises(ValueError, match=r"a joint holds body 0 \('door'\).* to another entry, .* bodies='ignored'"):
        SolverImplicit(model)
    solver, states = SolverImplicit(model, bodies="ignored"), [model.state(), model.state()]
    solver.step(*states, None, None, DT)
    np.testing.assert_array_equal(states[1].body_q.numpy(), model.body_q.numpy())
    assert (states[1].particle_q.numpy()[:, 2] < -0.5).all()


def coupled_press(device, mode, iterations):
    """A plate on a vertical slide of another solver, over a soft block on a static box, and the entry of the block."""
    builder = newton.ModelBuilder()
    soft = {"density": 200.0, "k_mu": 2e4, "k_lambda": 2e4, "k_damp": 1e-3}
    cells = {"dim_x": 2, "dim_y": 2, "dim_z": 1, "cell_x": 0.05, "cell_y": 0.05, "cell_z": 0.05}
    at = {"pos": wp.vec3(-0.05, -0.05, 0.003), "rot": wp.quat_identity(), "vel": wp.vec3()}
    builder.add_soft_grid(**at, **cells, **soft)
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.05), wp.quat_identity()), **BOX)
    cfg = newton.ModelBuilder.ShapeConfig(density=0.0)
    plate = builder.add_link(mass=0.4, inertia=wp.mat33(4e-3 * np.eye(3)), lock_inertia=True, label="plate")
    builder.add_shape_box(plate, cfg=cfg, hx=0.1, hy=0.1, hz=0.02)
    slide = wp.transform(wp.vec3(0.0, 0.0, 0.076), wp.quat_identity())
    builder.add_articulation([builder.add_joint_prismatic(-1, plate, axis=(0.0, 0.0, 1.0), parent_xform=slide)])
    builder.color()
    model, stages = builder.finalize(device=device), []

    def make(view):
        stages.append(SolverImplicit(view, report=["contacts"]))
        return stages[-1]

    entries = [
        SolverCoupled.Entry(name="slide", solver=newton.solvers.SolverFeatherstone, bodies=[0], joints=[0]),
        SolverCoupled.Entry(name="soft", solver=make, particles=list(range(model.particle_count))),
    ]
    kind = {"bodies": [0], "joints": [0], "mode": mode}
    proxies = [SolverCoupledProxy.Proxy(source="slide", destination="soft", **kind)]
    config = SolverCoupledProxy.Config(proxies=proxies, iterations=iterations)
    return model, SolverCoupledProxy(model, entries, config), stages[0]


@pytest.mark.parametrize("mode, iterations", [("staggered", 1), ("lagged", 2)])
def test_a_proxy_whose_joint_the_entry_sees_is_carried_by_what_it_rests_on(mode, iterations, device):
    """The joint is the other solver's: the force that comes back is the weight of the plate, and the plate rests."""
    model, coupled, stage = coupled_press(device, mode, iterations)
    states, forces = [model.state(), model.state()], []
    newton.eval_fk(model, model.joint_q, model.joint_qd, states[0])
    for _ in range(60):
        states[0].clear_forces()
        coupled.step(*states, model.control(), None, DT)
        states.reverse()
        forces.append(stage.report.forces.body_impulse.numpy()[0, :3] / DT)
    np.testing.assert_allclose(np.mean(forces[-10:], axis=0), (0.0, 0.0, 0.4 * 9.81), atol=4e-3)
    assert np.abs(states[0].joint_qd.numpy()).max() < 1e-3 and abs(states[0].joint_q.numpy()[0]) < 1e-3
    assert stage.report.totals.revoked_steps == stage.report.totals.uncertified_steps == 0


def test_a_proxy_of_a_coupled_solver_flies_as_a_body_of_the_solve(device):
    builder = builder_without_gravity()
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0), fixed=True)
    add_ball(builder, (0.013, 0.007, RADIUS + 0.005), mass=0.2)
    model, steps, stages = finalize(builder, [[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]], device), 20, []

    def heights(solver):
        states, found = [model.state(), model.state()], []
        for _ in range(steps):
            states[0].clear_forces()
            solver.step(*states, model.control(), None, DT)
            states.reverse()
            found.append(states[0].body_q.numpy()[0, 2])
        return np.array(found)

    def make(view):
        stages.append(SolverImplicit(view))
        return stages[-1]

    entries = [
        SolverCoupled.Entry(
            name="rigid",
            solver=lambda view: newton.solvers.SolverSemiImplicit(view, angular_damping=0.0),
            bodies=[0],
            joints=list(range(model.joint_count)),
        ),
        SolverCoupled.Entry(name="cloth", solver=make, particles=list(range(model.particle_count))),
    ]
    proxies = [SolverCoupledProxy.Proxy(source="rigid", destination="cloth", bodies=(0,), mode="lagged")]
    coupled = SolverCoupledProxy(model, entries, SolverCoupledProxy.Config(proxies=proxies, iterations=2))
    expected = heights(SolverImplicit(model))
    assert expected.min() < expected[-1] - 0.01 and expected.min() < RADIUS - 0.02  # thrown back
    np.testing.assert_allclose(heights(coupled), expected, atol=2e-3)
    assert stages[0].report.totals.revoked_steps == 0
