"""Rigid bodies in the response: they are pushed as bodies of their mass and inertia, and every step is certified."""

import newton
import numpy as np
import pytest
import warp as wp
from body_scenes import add_body, boxes, finalize, free
from newton_scenes import DT, SOLVERS, STIFF, Changed, Rollout, add_patch

import warp_bsc as bsc
from warp_bsc.response.state.structs import DIVIDED, FROZEN, PROJECTED

IDENTITY = wp.transform_identity()


def ball_and_sheet(device, *, fixed, speed=3.0, spin=(1.0, 5.0, 2.0), gravity=0.0, n=10, worlds=1):
    """A ball of 1 kg that flies at a sheet, and turns."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    add_patch(world, n, 0.05, (0.0, 0.0, 0.0), fixed=fixed)
    add_body(world, "sphere", (0.013, 0.007, 0.11), radius=0.1)
    builder = world
    if worlds > 1:
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
        builder.replicate(world, worlds)
    return finalize(builder, worlds * [[0.3, 0.0, -speed, *spin]], device)


def rotation(quaternion):
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    twist = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * twist + 2.0 * twist @ twist


def momenta(model, state):
    """Linear and angular momentum of all particles and bodies of a state."""
    mass = model.particle_mass.numpy()[:, None].astype(float)
    p = mass * state.particle_qd.numpy()
    linear, angular = p.sum(axis=0), np.cross(state.particle_q.numpy().astype(float), p).sum(axis=0)
    for body in range(model.body_count):
        pose, twist = state.body_q.numpy()[body].astype(float), state.body_qd.numpy()[body].astype(float)
        frame = rotation(pose[3:])
        p = float(model.body_mass.numpy()[body]) * twist[:3]
        linear += p
        angular += np.cross(pose[:3] + frame @ model.body_com.numpy()[body], p)
        angular += frame @ model.body_inertia.numpy()[body] @ frame.T @ twist[3:]
    return linear, angular


def check_vertices(rollout):
    """Asserts that the certified vertices are those of the poses of the state, bit by bit."""
    certified = rollout.solver.work.vertices.x1.numpy()
    assert certified.tobytes() == rollout.vertices(rollout.states[0]).tobytes()


@pytest.mark.parametrize("substeps", [1, 2])
def test_a_ball_and_a_free_cloth_keep_their_momenta(substeps, device):
    model = ball_and_sheet(device, fixed=False)
    rollout = Rollout(model, bsc.SolverCCD(free(model), friction=0.5, substeps=substeps))
    linear, angular = momenta(model, rollout.states[0])
    hits = 0
    for _ in range(8):
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        check_vertices(rollout)
    assert hits > 100 and rollout.collisions == 0
    assert (rollout.solver.report.totals.uncertified_steps, rollout.solver.report.totals.truncated_steps) == (0, 0)
    assert rollout.states[0].body_qd.numpy()[0, 2] > -2.99
    new_linear, new_angular = momenta(model, rollout.states[0])
    assert np.linalg.norm(new_linear - linear) < 1e-5 * np.linalg.norm(linear)
    assert np.linalg.norm(new_angular - angular) < 1e-5 * np.linalg.norm(angular)


def test_a_ball_dropped_on_a_pinned_sheet(device):
    """The stage changes the momentum of no step: what the sheet gives comes from its pins, through the inner solver."""
    model = ball_and_sheet(device, fixed=True, gravity=9.81)
    inner = SOLVERS["vbd"](model)
    step, wanted = inner.step, []

    def recorded_step(state_in, state_out, *arguments, **options):
        step(state_in, state_out, *arguments, **options)
        wanted[:] = momenta(model, state_out)

    inner.step = recorded_step
    rollout = Rollout(model, bsc.SolverCCD(inner, friction=0.5))
    lowest, hits = 0.0, 0
    for _ in range(60):
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        linear, _angular = momenta(model, rollout.states[0])
        assert np.linalg.norm(linear - wanted[0]) < 1e-5 * 3.0
        lowest = min(lowest, rollout.states[0].body_q.numpy()[0, 2])
    assert hits > 1000 and rollout.collisions == 0
    assert rollout.solver.report.totals.uncertified_steps == 0
    assert lowest < -0.1 and rollout.states[0].body_qd.numpy()[0, 2] > 0.0  # thrown back


@pytest.mark.parametrize(("rate", "steps"), [(240, 300), pytest.param(960, 600, marks=pytest.mark.slow)])
def test_a_box_at_rest_on_a_sheet(rate, steps, device):
    """It comes to rest on the pinned sheet that it stretches, and stays: it moves by less than 1 mm/s."""
    builder = newton.ModelBuilder()
    sides = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
    cloth = {"dim_x": 6, "dim_y": 6, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.002, **STIFF, "tri_kd": 10.0}
    builder.add_cloth_grid(pos=wp.vec3(-0.15, -0.15, 0.0), rot=wp.quat_identity(), vel=wp.vec3(), **cloth, **sides)
    inertia = (1e-4, 1.2e-4, 1.4e-4)
    add_body(builder, "box", (0.013, 0.007, 0.0305), mass=0.1, inertia=inertia, hx=0.05, hy=0.04, hz=0.03)
    model = finalize(builder, [6 * [0.0]], device)
    rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=5), friction=0.5))
    rollout.find_collisions = lambda before, after: []  # once at the end is enough here
    for step in range(steps):
        rollout.step(1.0 / rate)
        if step >= steps - 20:
            speed = np.linalg.norm(rollout.states[0].body_qd.numpy()[0, :3])
            assert speed < 1e-3, f"{1e3 * speed} mm/s"
    report = rollout.solver.report
    assert report.predicted_contacts > 0 and (report.totals.uncertified_steps, report.totals.frozen_steps) == (0, 0)
    assert 0.0 < rollout.states[0].body_q.numpy()[0, 2] < 0.03
    assert not rollout.find_crossings(rollout.vertices(rollout.states[0]))


@pytest.mark.parametrize("restitution", [0.0, 0.8])
def test_an_impulse_off_the_centre_of_mass(restitution, device):
    """The lowest vertex of a sphere, which is off its body's centre of mass, hits a sheet that is held."""
    mass, inertia, arm, speed = 2.0, (0.05, 0.03, 0.04), 0.1, 2.0
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0))
    builder.particle_mass = [0.0] * builder.particle_count
    at, offset = (0.013 - arm, 0.004, 0.0503), (arm, 0.0, 0.0)
    add_body(builder, "sphere", at, mass=mass, inertia=inertia, offset=offset, radius=0.05)
    model = finalize(builder, [[0.0, 0.0, -speed, 0.0, 0.0, 0.0]], device)
    start = model.particle_q.numpy().copy()
    rollout = Rollout(model, bsc.SolverCCD(free(model), friction=0.0, restitution=restitution))
    rollout.step(4e-4)  # other vertices of the sphere do not come down to the sheet
    assert rollout.solver.report.predicted_contacts > 0 and rollout.collisions == 0 and rollout.solver.report.certified
    impulse = (1.0 + restitution) * speed / (1.0 / mass + arm**2 / inertia[1])
    twist = rollout.states[0].body_qd.numpy()[0]
    np.testing.assert_allclose(twist[2], -speed + impulse / mass, atol=5e-3 * speed)
    np.testing.assert_allclose(twist[4], -arm * impulse / inertia[1], rtol=5e-3)
    assert rollout.positions.tobytes() == start.tobytes()


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_friction_slows_a_box_on_a_held_sheet(friction, device):
    builder = newton.ModelBuilder()
    add_patch(builder, 6, 0.2, (0.0, 0.0, 0.0))
    builder.particle_mass = [0.0] * builder.particle_count
    box = {"hx": 0.1, "hy": 0.1, "hz": 0.02}
    add_body(builder, "box", (-0.3, 0.017, 0.0205), mass=1.0, inertia=(4e-3, 4e-3, 7e-3), mu=friction, **box)
    model = finalize(builder, [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]], device)
    rollout = Rollout(model, bsc.SolverCCD(free(model), friction=friction, separation=1e-4))
    time = 0.2
    for _ in range(round(time / DT)):
        rollout.step()
    assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
    np.testing.assert_allclose(rollout.states[0].body_qd.numpy()[0, 0], 1.0 - friction * 9.81 * time, atol=2e-3)


@pytest.mark.parametrize(
    ("speed", "spin"), [pytest.param(60.0, (0.0, 0.0, 0.0), marks=pytest.mark.slow), (3.0, (100.0, 50.0, 300.0))]
)
def test_fast_bodies_and_spinning_ones_are_certified(speed, spin, device):
    model = ball_and_sheet(device, fixed=True, speed=speed, spin=spin, n=8)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.5))
    hits = 0
    for _ in range(8):
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        check_vertices(rollout)
    assert hits > 100 and rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
    assert not rollout.find_crossings(rollout.vertices(rollout.states[0]))


@pytest.mark.parametrize("freezes", [False, True])
def test_a_body_that_projection_does_not_stop_is_put_back_as_one(freezes, device):
    """Its pose goes back along its path until its vertices are on their sides, or to its start."""
    model = ball_and_sheet(device, fixed=True, n=8)
    rollout = Rollout(model, bsc.SolverCCD(free(model), max_iterations=0))
    if freezes:
        rollout.solver.work.status.max_divisions = 0
    outcomes = []
    for _ in range(4):
        before = rollout.states[0].body_q.numpy()[0]
        rollout.step()
        outcomes.append(int(rollout.solver.report.step_results.of_bodies.numpy()[0]))
        assert rollout.solver.report.certified
        check_vertices(rollout)
        after = rollout.states[0].body_q.numpy()[0]
        if outcomes[-1] & FROZEN:
            assert after.tobytes() == before.tobytes() and (rollout.states[0].body_qd.numpy() == 0.0).all()
        assert before[2] - 3.0 * DT - 1e-6 <= after[2] <= before[2]
    assert rollout.collisions == 0
    assert max(outcomes) & (FROZEN if freezes else DIVIDED) and not max(outcomes) & PROJECTED
    report = rollout.solver.report
    assert (report.totals.frozen_steps > 0, report.totals.truncated_steps > 0) == (freezes, not freezes)


@pytest.mark.parametrize("why", ["left", "kinematic", "infinite mass", "not finite"])
def test_bodies_that_cannot_be_moved_keep_every_bit(why, device):
    def change(state):
        q = state.body_q.numpy()
        q[0, 2] = np.nan if why == "not finite" else q[0, 2] - 0.02
        state.body_q.assign(q)

    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0))
    add_body(builder, "sphere", (0.013, 0.007, 0.11), mass=0.0 if why == "infinite mass" else 1.0, radius=0.1)
    model = finalize(builder, [[0.0, 0.0, -4.0, 0.0, 0.0, 0.0]], device)
    if why == "kinematic":
        model.body_flags.fill_(int(newton.BodyFlags.KINEMATIC))
    solver = bsc.SolverCCD(Changed(model, change), bodies="ignored" if why == "left" else "pushed")
    rollout = Rollout(model, solver)
    start, end = rollout.states
    for _ in range(3):
        wanted = model.state()
        wanted.assign(start)
        change(wanted)
        solver.step(start, end, None, None, DT)
        assert end.body_q.numpy().tobytes() == wanted.body_q.numpy().tobytes()
        if why == "not finite":
            assert not solver.report.certified and solver.report.uncertified_bodies.tolist() == [0]
            break
        assert solver.report.certified
        start, end = end, start
    else:
        assert solver.report.iterations > 0 and start.particle_q.numpy()[:, 2].min() < -0.03


def test_coupling_stops_a_ball_earlier(device):
    """The sheet pulls against the ball within a step, so that it gives way less."""
    lowest = []
    for substeps in (1, 4):
        model = ball_and_sheet(device, fixed=True, n=6)
        rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=substeps))
        heights = []
        for _ in range(16):
            rollout.step()
            heights.append(rollout.states[0].body_q.numpy()[0, 2])
        assert rollout.collisions == 0 and rollout.solver.report.totals.uncertified_steps == 0
        lowest.append(min(heights))
    assert lowest[1] > 0.5 * lowest[0] and lowest[0] < -0.05


def test_worlds_with_bodies_are_like_one_alone(device):
    one, three = (ball_and_sheet(device, fixed=True, worlds=worlds, n=6) for worlds in (1, 3))
    alone, together = (Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model))) for model in (one, three))
    for _ in range(5):
        alone.step()
        together.step()
    assert alone.solver.report.predicted_contacts > 0 and together.collisions == 0
    for name in ("particle_q", "body_q", "body_qd"):
        expected = getattr(alone.states[0], name).numpy()
        for world in np.split(getattr(together.states[0], name).numpy(), 3):
            assert world.tobytes() == expected.tobytes(), name


@pytest.mark.parametrize("inner", ["vbd", "free"])
def test_steps_with_bodies_in_a_graph_are_those_without(inner, device):
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    ends = []
    for in_graph in (True, False):
        model = ball_and_sheet(device, fixed=True, n=6)
        inner_solver = free(model) if inner == "free" else SOLVERS[inner](model)
        solver = bsc.SolverCCD(inner_solver)
        states = model.state(), model.state()

        def run(solver=solver, states=states, model=model):
            for start, end in (states, states[::-1]):
                start.clear_forces()
                solver.step(start, end, model.control(), None, DT)

        if in_graph:
            with wp.ScopedCapture(device) as capture:
                run()
        for _ in range(3):
            if in_graph:
                wp.capture_launch(capture.graph)
            else:
                run()
        assert (solver.report.totals.steps, solver.report.totals.uncertified_steps) == (
            6,
            0,
        ) and solver.report.predicted_contacts > 0
        ends.append([getattr(states[0], name).numpy() for name in ("particle_q", "body_q", "body_qd")])
    for actual, expected in zip(*ends, strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_without_bodies_no_kernel_of_bodies_is_launched(device, monkeypatch):
    """Static and kinematic shapes cost what they did."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.005), velocity=(0.0, 0.0, -3.0))
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=1.0, hy=1.0, hz=0.1)
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.3), wp.quat_identity()), is_kinematic=True)
    builder.add_shape_sphere(body, radius=0.1)
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0))
    launched, launch = [], wp.launch

    def recorded_launch(kernel, *arguments, **options):
        launched.append((kernel.module.name, kernel.key))
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", recorded_launch)
    states = model.state(), model.state()
    solver.step(*states, None, None, DT)
    assert solver.report.predicted_contacts > 0 and any(
        "sweep_positions" in key or key == "project_positions" for _module, key in launched
    )
    assert not [key for module, key in launched if "warp_bsc" in module and ("bod" in module or "bod" in key)]


def box_above_ground(device, *, tilt=0.0, velocity=(0.5, 0.0, 0.0), gravity=9.81, cloth=False):
    """A box half a millimetre above the ground, or a little more if it is tilted, and cloth that flies at it."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -gravity))
    builder.add_ground_plane()
    add_patch(builder, 6, 0.05, (0.01, 0.02, 0.2 if cloth else 5.0), velocity=(0.0, 0.0, -20.0))
    builder.particle_mass = [0.05] * builder.particle_count
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.3, 0.2)), tilt)
    at = wp.transform(wp.vec3(0.0, 0.0, 0.0505 + 0.06 * np.sin(tilt)), rotation)
    add_body(builder, "box", at, inertia=(2e-3, 2e-3, 2e-3), hx=0.06, hy=0.05, hz=0.05)
    return finalize(builder, [[*velocity, 0.0, 0.0, 0.0]], device)


def lowest_vertex(rollout, state):
    """Height of the lowest vertex of shapes."""
    return rollout.vertices(state)[rollout.model.particle_count :, 2].min()


@pytest.mark.parametrize(("tilt", "substeps"), [(0.0, 1), (0.5, 1), pytest.param(0.5, 4, marks=pytest.mark.slow)])
def test_the_ground_stops_a_box_if_asked(tilt, substeps, device):
    model = box_above_ground(device, tilt=tilt, velocity=(0.5, 0.0, -4.0 * tilt))
    rollout = Rollout(model, bsc.SolverCCD(free(model), bodies="separated", friction=0.5, substeps=substeps))
    for _ in range(90):
        rollout.step()
        assert rollout.solver.report.certified and lowest_vertex(rollout, rollout.states[0]) > 0.0
    assert rollout.solver.report.totals.truncated_steps == 0
    assert lowest_vertex(rollout, rollout.states[0]) < 2e-4
    speeds = np.abs(rollout.states[0].body_qd.numpy()[0])  # friction has stopped it
    assert speeds.max() < 0.02


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_cloth_pushes_no_box_into_the_ground(tilt, device):
    """Nor deeper than the inner solver wanted it, whose own contact with the ground may be soft."""
    model = box_above_ground(device, tilt=tilt, velocity=(0.0, 0.0, 0.0), gravity=0.0, cloth=True)
    inner, wanted = free(model), []
    step = inner.step

    def recorded_step(state_in, state_out, *arguments, **options):
        step(state_in, state_out, *arguments, **options)
        wanted.append(lowest_vertex(rollout, state_out))

    inner.step = recorded_step
    rollout = Rollout(model, bsc.SolverCCD(inner, friction=0.5))
    pushed = 0
    for _ in range(12):
        before = lowest_vertex(rollout, rollout.states[0])
        rollout.step()
        assert rollout.solver.report.certified
        lowest = lowest_vertex(rollout, rollout.states[0])
        assert lowest > 0.0 or lowest > min(before, wanted[-1]) - 0.05 * rollout.solver.separation
        pushed += lowest < wanted[-1] - 1e-4
    assert pushed > 0


def test_a_plane_does_not_stop_shapes_that_it_does_not_collide_with(device):
    model = box_above_ground(device, velocity=(0.0, 0.0, -1.0))
    model.shape_collision_group.fill_(0)
    rollout = Rollout(model, bsc.SolverCCD(free(model), bodies="separated"))
    for _ in range(4):
        rollout.step()
    assert rollout.solver.report.totals.steps == 4 and lowest_vertex(rollout, rollout.states[0]) < -0.01


@pytest.mark.parametrize("bodies", ["moved", True, None])
def test_what_bodies_do_has_three_names(bodies, device):
    model = ball_and_sheet(device, fixed=True, n=2)
    with pytest.raises((TypeError, ValueError), match="bodies"):
        bsc.SolverCCD(SOLVERS["vbd"](model), bodies=bodies)


def count_body_collisions(rollout):
    """Collisions of the last step between vertices of two bodies, or of a body and a static shape."""
    mesh = rollout.mesh
    body = np.full(mesh.vertex_count, -2)
    body[rollout.model.particle_count :] = mesh.shape_vertices.body
    c = rollout.detector.detect(rollout.start, rollout.vertices(rollout.states[0]))
    vertex_face = np.stack([c.vertex_face[:, 0], mesh.faces[c.vertex_face[:, 1]][:, 0]], axis=1)
    edge_edge = mesh.edges[c.edge_edge][:, :, 0]
    pairs = body[np.concatenate([vertex_face.reshape(-1, 2), edge_edge.reshape(-1, 2)])]
    return int((pairs[:, 0] != pairs[:, 1]).sum())


@pytest.mark.parametrize("static", [False, True])
def test_bodies_that_pass_each_other_are_reported(static, device):
    first = [] if static else [(-0.3, 0.01, 0.02)]
    model = boxes(
        device, positions=[*first, (0.0, 0.0, 0.0)], velocities=[*[(0, 0, 0)] * len(first), (-3.0, 0, 0)], static=static
    )
    rollout = Rollout(model, bsc.SolverCCD(free(model)))
    for _ in range(14):
        rollout.step()
        count = count_body_collisions(rollout)
        assert (count > 0) == (rollout.solver.report.body_contacts > 0)
        assert rollout.solver.report.certified and rollout.solver.report.predicted_contacts == 0
        if count:  # from now on they cross at the start of a step
            break
    assert count > 0
    np.testing.assert_allclose(rollout.states[0].body_qd.numpy()[-1, :3], [-3.0, 0.0, 0.0], atol=1e-6)


def test_filtered_pairs_are_not_reported(device):
    model = boxes(device, positions=[(-0.3, 0.01, 0.02), (0.0, 0.0, 0.0)], velocities=[(0, 0, 0), (-3.0, 0, 0)])
    groups = model.shape_collision_group.numpy()
    for group, other in ((0, 1), (1, 2), (-1, -1)):
        model.shape_collision_group.assign(np.array([group, other], dtype=np.int32))
        rollout = Rollout(model, bsc.SolverCCD(free(model), bodies="separated"))
        for _ in range(10):
            rollout.step()
            assert rollout.solver.report.body_contacts == rollout.solver.report.predicted_contacts == 0
    model.shape_collision_group.assign(groups)


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_bodies_push_each_other_if_asked(restitution, device):
    """Two boxes of one mass: the faster one stops and the other flies on, or both fly on together."""
    model = boxes(device, positions=[(-0.18, 0.0, 0.0), (0.0, 0.0, 0.0)], velocities=[(0, 0, 0), (-3.0, 0, 0)])
    solver = bsc.SolverCCD(free(model), bodies="separated", restitution=restitution, friction=0.0)
    rollout = Rollout(model, solver)
    linear, angular = momenta(model, rollout.states[0])
    hits = 0
    for _ in range(6):
        rollout.step()
        hits += solver.report.predicted_contacts
        assert solver.report.certified and solver.report.body_contacts == 0
        assert count_body_collisions(rollout) == 0
        check_vertices(rollout)
    assert hits > 0
    new_linear, new_angular = momenta(model, rollout.states[0])
    assert np.linalg.norm(new_linear - linear) < 1e-5 * np.linalg.norm(linear)
    assert np.linalg.norm(new_angular - angular) < 1e-5 * np.linalg.norm(linear)
    twists = rollout.states[0].body_qd.numpy()
    np.testing.assert_allclose(twists[1, 0] - twists[0, 0], 3.0 * restitution, atol=0.02)


def test_a_box_falls_on_a_static_one_and_stays(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.05, (0.0, 0.0, 5.0))
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.3, hy=0.3, hz=0.1)
    add_body(builder, "box", (0.013, 0.007, 0.055), inertia=(2e-3, 2e-3, 2e-3), hx=0.05, hy=0.05, hz=0.05)
    model = finalize(builder, [6 * [0.0]], device)
    solver = bsc.SolverCCD(free(model), bodies="separated")
    rollout = Rollout(model, solver)
    for _ in range(60):
        rollout.step()
        assert solver.report.certified and count_body_collisions(rollout) == 0
    pose, twist = rollout.states[0].body_q.numpy()[0], rollout.states[0].body_qd.numpy()[0]
    assert 0.05 < pose[2] < 0.0505 and np.abs(twist).max() < 0.05
    assert len(solver.report.uncertified_bodies) == 0


def test_a_light_box_rests_on_a_pile(device):
    """On sheets that lie on the ground, no path is cut: the box is only near the cloth that the projection moves."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    for layer in range(5):
        add_patch(builder, 7, 0.02, (0.003 * layer, 0.002 * layer, 0.004 * (layer + 1)))
    at = wp.transform(wp.vec3(0.07, 0.07, 0.06), wp.quat_identity())
    size = {"hx": 0.03, "hy": 0.03, "hz": 0.03}
    builder.add_shape_box(builder.add_body(xform=at), cfg=newton.ModelBuilder.ShapeConfig(density=80.0), **size)
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.3))
    for _ in range(48):
        rollout.step()
    report = rollout.solver.report
    assert (report.totals.uncertified_steps, report.totals.truncated_steps, rollout.collisions) == (0, 0, 0)
    velocity = rollout.states[0].body_qd.numpy()[0]
    assert np.linalg.norm(velocity[:3]) < 0.03  # [m/s]; it rocks a little, by 0.02 to 0.3 rad/s
    assert np.linalg.norm(velocity[3:]) < 0.4
