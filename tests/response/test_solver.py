"""The collision stage: what it returns is free of collisions, by exact detection of what is stored, and little else."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, STIFF, Rollout, add_patch, bullet
from newton_versions import HAS_OBSERVABLES

import warp_bsc as bsc
from warp_bsc._private_names.of_newton import make_style3d
from warp_bsc.response.contacts.constraints import NEVER_VIOLATED
from warp_bsc.response.state.structs import ContactKind
from warp_bsc.response.tuning import MAX_ITERATIONS

SUBSTEPS = {"vbd": 1, "xpbd": 1, "semi_implicit": 16}  # explicit integration is stable in small steps only


@pytest.mark.parametrize("inner", ["vbd", "xpbd", pytest.param("semi_implicit", marks=pytest.mark.slow)])
@pytest.mark.parametrize("speed", [pytest.param(10.0, marks=pytest.mark.slow), 60.0])
def test_nothing_passes_through(inner, speed, device):
    model = bullet(speed, device=device)
    through = Rollout(model, SOLVERS[inner](model))
    stopped = Rollout(model, bsc.SolverCCD(SOLVERS[inner](model)))
    substeps = SUBSTEPS[inner]
    steps = substeps * (12 if speed < 50.0 else 6)
    for _ in range(steps):
        through.step(DT / substeps)
        stopped.step(DT / substeps)
        assert stopped.solver.report.certified
    assert through.collisions > 0
    assert stopped.collisions == 0
    assert len(stopped.detector.find_intersections(stopped.positions)) == 0
    report = stopped.solver.report
    assert (report.totals.steps, report.totals.uncertified_steps) == (steps, 0)


def test_style3d_is_an_inner_solver_too(device):
    """It wants cloth of its own kind, and contacts."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    newton.solvers.SolverStyle3D.register_custom_attributes(builder)
    stiff = {"tri_aniso_ke": wp.vec3(1e2, 1e2, 1e1), "edge_aniso_ke": wp.vec3(2e-5, 1e-5, 5e-6)}
    for n, cell, height, speed in ((12, 0.05, 0.0, 0.0), (6, 0.03, 0.05, -10.0)):
        newton.solvers.style3d.add_cloth_grid(
            builder,
            pos=wp.vec3(-0.5 * n * cell, -0.5 * n * cell, height),
            rot=wp.quat_identity(),
            vel=wp.vec3(0.0, 0.0, speed),
            dim_x=n,
            dim_y=n,
            cell_x=cell,
            cell_y=cell,
            mass=0.3 * cell**2,
            particle_radius=0.002,
            **dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], speed == 0.0),
            **stiff,
        )
    model = builder.finalize(device=device)
    contacts = newton.CollisionPipeline(model).contacts()
    collisions = []
    for ccd in (False, True):
        solver = make_style3d(model, 4)
        rollout = Rollout(model, bsc.SolverCCD(solver) if ccd else solver)
        for _ in range(8):
            rollout.step(contacts=contacts)
        collisions.append(rollout.collisions)
    assert collisions[0] > 0 and collisions[1] == 0
    assert rollout.solver.report.totals.uncertified_steps == rollout.solver.report.totals.truncated_steps == 0


@pytest.mark.parametrize("inner", SOLVERS)
def test_without_collisions_nothing_changes(inner, device):
    model = bullet(-10.0, device=device)
    solver = SOLVERS[inner](model)
    step, wanted = solver.step, []

    def recorded_step(state_in, state_out, *arguments, **options):
        step(state_in, state_out, *arguments, **options)
        wanted[:] = [state_out.particle_q.numpy().copy(), state_out.particle_qd.numpy().copy()]

    solver.step = recorded_step
    staged = Rollout(model, bsc.SolverCCD(solver))
    for _ in range(3):
        staged.step()
        report = staged.solver.report
        assert (report.predicted_contacts, report.iterations, report.truncated, report.frozen, report.certified) == (
            0,
            0,
            0,
            0,
            True,
        )
        assert staged.positions.tobytes() == wanted[0].tobytes()
        assert staged.velocities.tobytes() == wanted[1].tobytes()


def test_proximities_save_a_pile_an_iteration_for_each_layer(device, monkeypatch):
    """Six patches in a pile fall on a box, all at one speed: only the lowest has a contact at first.

    All contacts are projected, as where a world also has contacts of fast elements.
    """
    monkeypatch.setattr("warp_bsc.response.state.workspace.MAX_SLOW_ITERATIONS", MAX_ITERATIONS)
    monkeypatch.setattr("warp_bsc.response.state.workspace.SLOW_POSITION_SWEEPS", 16)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.1)
    for layer in range(6):
        at = (0.004 * layer, 0.003 * layer, 0.0005 * (layer + 1))
        add_patch(builder, 4, 0.028, at, velocity=(0.0, 0.0, -0.8))
    model = builder.finalize(device=device)

    def rounds():
        rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0)))
        rollout.step()
        assert rollout.collisions == 0 and rollout.solver.report.certified and rollout.solver.report.truncated == 0
        heights = rollout.positions[:, 2].reshape(6, -1)
        assert (np.diff(heights.mean(axis=1), prepend=0.0) > 0.0).all()
        return rollout.solver.report.iterations

    with_proximities = rounds()
    monkeypatch.setattr("warp_bsc.response.step.add_proximities", lambda work: None)
    assert 0 < with_proximities <= 3 < rounds()


def test_proximities_are_of_neighbours_in_a_pile(device):
    """Layers fall further in a step than three of them are apart; what is behind a neighbour is no proximity."""
    layers, spacing = 5, 0.0004
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.1)
    for layer in range(layers):
        at = (0.004 * layer, 0.003 * layer, spacing * (layer + 1))
        add_patch(builder, 4, 0.028, at, velocity=(0.0, 0.0, -0.8))
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0)))
    rollout.step()
    constraints = rollout.solver.work.constraints
    kinds, corners = (
        array.numpy()[: constraints.count.numpy()[0]] for array in (constraints.kind, constraints.vertices)
    )
    particles = model.particle_count
    layer = np.where(corners < particles, corners // (particles // layers), -1)  # of the box: -1
    x = model.particle_q.numpy()[:, :2]
    covered = (np.abs(x) < 0.05).all(axis=1)  # by every layer
    for kind in (ContactKind.VERTEX_FACE_PROXIMITY, ContactKind.EDGE_EDGE_PROXIMITY):
        found = (kinds == kind) & (corners < particles).all(axis=1)
        found &= covered[np.minimum(corners, particles - 1)].all(axis=1)
        apart = np.abs(layer[found, 0] - layer[found, 3])
        assert len(apart) > 20 and (apart == 1).all(), (kind, np.bincount(apart))
    # nor do contacts with the box act on what is behind the lowest layer
    disabled = constraints.separation.numpy()[: len(kinds)] == NEVER_VIOLATED
    apart = np.abs(layer[disabled, 0] - layer[disabled, 3])
    assert len(apart) > 20 and (apart > 1).all(), np.bincount(apart)


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("sideways", [0.0, 1.0])
def test_momenta_of_free_bodies_are_conserved(friction, sideways, device):
    """Two patches that meet off centre, and turn from then on."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 8, 0.05, (0.0, 0.0, 0.0), velocity=(sideways, 0.0, 3.0))
    add_patch(builder, 8, 0.05, (0.13, 0.11, 0.05), velocity=(0.0, -0.5 * sideways, -2.0))
    builder.color()
    model = builder.finalize(device=device)
    inner = newton.solvers.SolverXPBD(model, iterations=0)
    rollout = Rollout(model, bsc.SolverCCD(inner, friction=friction, substeps=16))
    linear, angular = rollout.momenta()
    met = 0
    for _ in range(8):
        rollout.step()
        met += rollout.solver.report.predicted_contacts
    assert met > 100
    assert rollout.solver.report.totals.truncated_steps == 0
    new_linear, new_angular = rollout.momenta()
    assert np.linalg.norm(new_linear - linear) < 1e-5 * np.linalg.norm(linear)
    assert np.linalg.norm(new_angular - angular) < 1e-5 * np.linalg.norm(angular)


@pytest.mark.parametrize("friction", [0.2, 0.6])
def test_friction_on_a_ramp(friction, device):
    """A patch on a ramp of triangles slides as a rigid body would, or stays."""
    angle, time = np.radians(20.0), 0.5
    tilt = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), float(angle))
    up, down = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, -np.sin(angle)])
    builder = newton.ModelBuilder()
    ramp = newton.Mesh.create_box(2.0, 1.0, 0.1, compute_normals=False, compute_uvs=False)
    material = newton.ModelBuilder.ShapeConfig(mu=friction)
    builder.add_shape_mesh(-1, mesh=ramp, xform=wp.transform(wp.vec3(), tilt), cfg=material)
    cloth = {"dim_x": 6, "dim_y": 6, "cell_x": 0.03, "cell_y": 0.03, "mass": 0.001}
    builder.add_cloth_grid(pos=wp.vec3(*(0.101 * up - down)), rot=tilt, vel=wp.vec3(), **cloth, **STIFF)
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), friction=friction))
    start = rollout.positions.mean(axis=0)
    for _ in range(round(time / DT)):
        rollout.step()
    slid = (rollout.positions.mean(axis=0) - start) @ down
    expected = 0.5 * 9.81 * max(0.0, np.sin(angle) - friction * np.cos(angle)) * time**2
    assert abs(slid - expected) < 0.05 * expected + 1e-3
    assert rollout.solver.report.totals.uncertified_steps == 0


def test_kinematic_and_inactive_particles_are_never_moved(device):
    model = bullet(60.0, device=device)
    flags = model.particle_flags.numpy()
    flags[20:40] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags.assign(flags)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["xpbd"](model)))
    still = (model.particle_inv_mass.numpy() == 0.0) | ((flags & int(newton.ParticleFlags.ACTIVE)) == 0)
    start = rollout.positions.copy()
    for _ in range(5):
        rollout.step()
    assert still.sum() > 60
    assert rollout.positions[still].tobytes() == start[still].tobytes()
    assert rollout.collisions == 0


def test_worlds_are_like_one_alone(device):
    alone = bullet(60.0, device=device)
    many = bullet(60.0, device=device, worlds=3)
    one, all_worlds = (Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), restitution=0.3)) for model in (alone, many))
    hits = 0
    for _ in range(5):
        one.step()
        all_worlds.step()
        hits += one.solver.report.predicted_contacts
    assert all_worlds.collisions == 0 and hits > 100
    for world in all_worlds.positions.reshape(3, -1, 3):
        assert world.tobytes() == one.positions.tobytes()


@pytest.mark.parametrize("shape", ["plane", "box", "mesh"])
def test_rigid_shapes_are_not_passed(shape, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    if shape == "plane":
        builder.add_ground_plane()
    elif shape == "box":
        builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, -0.1), wp.quat_identity()), hx=1.0, hy=1.0, hz=0.1)
    else:
        box = newton.Mesh.create_box(1.0, 1.0, 0.1, compute_normals=False, compute_uvs=False)
        builder.add_shape_mesh(-1, mesh=box, xform=wp.transform((0.0, 0.0, -0.1), wp.quat_identity()))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.1), velocity=(1.0, 0.0, -60.0))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["xpbd"](model)))
    for _ in range(5):
        rollout.step()
        assert rollout.solver.report.certified
        assert rollout.positions[:, 2].min() > 0.0
    assert rollout.positions[:, 2].max() < 0.1
    assert np.abs(rollout.velocities[:, 2]).max() < 10.0


def test_what_crosses_at_the_start_is_named(device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.0))
    builder.add_cloth_grid(
        pos=wp.vec3(0.013, -0.05, -0.051),
        rot=wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.5),
        vel=wp.vec3(),
        dim_x=2,
        dim_y=2,
        cell_x=0.05,
        cell_y=0.05,
        mass=0.001,
        **STIFF,
    )
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["xpbd"](model))
    rollout = Rollout(model, solver)
    expected = rollout.detector.find_intersections(rollout.positions)
    rollout.step()
    assert len(expected) > 0
    np.testing.assert_array_equal(solver.report.intersections, expected)


def test_the_inner_solver_is_asked_for_the_rest(device):
    model = bullet(10.0, device=device)
    inner = SOLVERS["vbd"](model)
    solver = bsc.SolverCCD(inner)
    assert isinstance(solver, newton.solvers.SolverBase)
    assert solver.iterations == 5
    assert solver.model is model and solver.device == model.device
    assert solver.collision_frequency == inner.collision_frequency
    if HAS_OBSERVABLES:
        assert solver.supported_observables == inner.supported_observables
    solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
    solver.reset(model.state())
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = solver.no_such_thing


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"separation": 0.0}, "separation"),
        ({"separation": np.nan}, "separation"),
        ({"friction": -1.0}, "friction"),
        ({"friction": 1e39}, "friction"),
        ({"friction": np.nan}, "friction"),
        ({"restitution": np.nan}, "restitution"),
        ({"restitution": 1.5}, "restitution"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message, device):
    model = bullet(10.0, device=device)
    with pytest.raises(ValueError, match=message):
        bsc.SolverCCD(SOLVERS["xpbd"](model), **options)


def test_coefficients_may_be_arrays_that_each_step_reads(device):
    model = bullet(10.0, device=device)
    for name, lengths in (("friction", (2, 0)), ("restitution", (model.particle_count,))):
        for length in lengths:
            with pytest.raises(ValueError, match=f"{name} must be a number, or a Warp array of float32 of length"):
                bsc.SolverCCD(SOLVERS["xpbd"](model), **{name: wp.zeros(length, dtype=float, device=device)})
        with pytest.raises(TypeError, match=f"{name} must be a number, or a Warp array of float32, not ndarray"):
            bsc.SolverCCD(SOLVERS["xpbd"](model), **{name: np.zeros(model.particle_count)})
        with pytest.raises(ValueError, match=name):
            bsc.SolverCCD(SOLVERS["xpbd"](model), **{name: wp.full(1, -0.5, dtype=float, device=device)})
    ends = []
    for value in (0.0, 0.7):
        friction = wp.zeros(model.particle_count, dtype=float, device=device)
        solver = bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0), friction=friction, restitution=0.5)
        friction.fill_(value)  # after the constructor has checked it
        number = bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0), friction=value, restitution=0.5)
        for stage in (solver, number):
            rollout = Rollout(model, stage)
            velocities = rollout.states[0].particle_qd.numpy()
            velocities[velocities[:, 2] != 0.0, 0] = 2.0  # it slides where it hits, which friction slows
            rollout.states[0].particle_qd.assign(velocities)
            for _ in range(8):
                rollout.step()
            assert stage.report.totals.steps == 8
            ends.append(rollout.states[0].particle_qd.numpy().copy())
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[2], ends[3])
    assert np.abs(ends[0] - ends[2]).max() > 0.1


@pytest.mark.parametrize("plane", [False, True])
def test_friction_of_shapes_out_of_range_is_refused(plane, device):
    builder = newton.ModelBuilder()
    slippery = newton.ModelBuilder.ShapeConfig(mu=-1.0)
    for collides in (False, True):
        slippery.has_particle_collision = collides
        if plane:
            builder.add_ground_plane(cfg=slippery)
        else:
            builder.add_shape_sphere(-1, radius=0.1, cfg=slippery)
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.2))
    with pytest.raises(ValueError, match=r"shape 1 .* has friction -1\.0"):
        bsc.SolverCCD(newton.solvers.SolverXPBD(builder.finalize(device=device)))


def test_a_frame_in_a_graph_is_the_frame_without(device):
    if not device.is_cuda or not wp.is_conditional_graph_supported():
        pytest.skip("needs a GPU with conditional nodes")
    model = bullet(60.0, device=device)
    plain, captured = (Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model))) for _ in range(2))
    for _ in range(8):
        plain.step()
        captured.step()  # queues grow
    for rollout in (plain, captured):
        rollout.states = model.state(), model.state()

    def frame(rollout):
        for start, end in (rollout.states, rollout.states[::-1]):
            start.clear_forces()
            rollout.solver.step(start, end, rollout.control, None, DT)

    with wp.ScopedCapture(device) as capture:
        frame(captured)
    for _ in range(4):
        frame(plain)
        wp.capture_launch(capture.graph)
        assert captured.solver.report.certified
        assert plain.positions.tobytes() == captured.positions.tobytes()
        assert plain.velocities.tobytes() == captured.velocities.tobytes()
    assert captured.solver.report.totals.uncertified_steps == 0


def leave_capacity_for_one_contact(detector):
    """Makes a detection whose buffers cannot grow overflow as soon as two vertex-face contacts are found."""
    detector.vertex_face.allocate_contacts(1)
    detector.update_capacities()


def test_a_graph_without_room_is_certified_too(device):
    """Captured before anything touches, with room for one contact, it stops the patch all the same."""
    if not device.is_cuda or not wp.is_conditional_graph_supported():
        pytest.skip("needs a GPU with conditional nodes")
    model = bullet(60.0, device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model)))
    leave_capacity_for_one_contact(rollout.solver.work.detector)
    start, end = rollout.states
    with wp.ScopedCapture(device) as capture:
        start.clear_forces()
        rollout.solver.step(start, end, rollout.control, None, DT)
    hits = 0
    for _ in range(8):
        before = rollout.vertices(start)
        wp.capture_launch(capture.graph)
        assert not rollout.find_collisions(before, rollout.vertices(end))
        report = rollout.solver.report
        assert report.certified
        hits += report.predicted_contacts
        wp.copy(start.particle_q, end.particle_q)
        wp.copy(start.particle_qd, end.particle_qd)
    assert hits > 100


def test_captured_steps_without_room_are_certified(device):
    if not device.is_cuda or not wp.is_conditional_graph_supported():
        pytest.skip("needs a GPU with conditional nodes")
    model = bullet(60.0, device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model)))

    def frame():
        for start, end in (rollout.states, rollout.states[::-1]):
            start.clear_forces()
            rollout.solver.step(start, end, rollout.control, None, DT)

    steps = bsc.CapturedSteps(frame, rollout.solver)
    steps()
    leave_capacity_for_one_contact(rollout.solver.work.detector)
    with wp.ScopedCapture(device) as capture:
        frame()
    steps.graph = capture.graph
    for _ in range(5):
        steps()
        assert len(rollout.detector.find_intersections(rollout.positions)) == 0
    totals = rollout.solver.report.totals
    assert (totals.steps, totals.uncertified_steps) == (12, 0)


@pytest.mark.parametrize("support", ["plane", "box"])
def test_cloth_on_something_rigid_is_at_rest(support, device):
    """At small steps too, in which it would fall for several steps through the separation between two contacts."""
    builder = newton.ModelBuilder()
    if support == "plane":
        builder.add_ground_plane()
    else:
        at = wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity())
        builder.add_shape_box(-1, xform=at, hx=0.5, hy=0.5, hz=0.1)
    add_patch(builder, 4, 0.05, (0.0, 0.0, 0.0006))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), friction=0.5)
    start, end = model.state(), model.state()
    speeds = []
    for _ in range(144):
        start.clear_forces()
        solver.step(start, end, None, None, 1.0 / 960.0)
        start, end = end, start
        speeds.append(np.abs(start.particle_qd.numpy()[:, 2]).mean())
    assert np.mean(speeds[96:]) < 5e-4  # m/s
    assert start.particle_q.numpy()[:, 2].min() > 0.0
    report = solver.report
    assert (report.totals.steps, report.totals.uncertified_steps, report.totals.truncated_steps) == (144, 0, 0)
