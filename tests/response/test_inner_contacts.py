"""Contacts passed on to steps in substeps: the inner solver gets those that the stage does not resolve, no others."""

import newton
import numpy as np
import pytest
import warp as wp
from newton import GeoType
from newton.solvers import SolverBase
from newton_scenes import SOFT, SOLVERS, Rollout, add_patch

import warp_bsc as bsc
from warp_bsc.response.state.mesh import ModelMesh
from warp_bsc.response.substeps import inner_contacts

RATE = 60


def add_drape(builder, n=8, velocity=(0.0, 0.0, 0.0)):
    """Cloth above a fixed sphere, within the reach of Newton's contacts."""
    builder.add_shape_sphere(body=-1, radius=0.15)
    cells = {"dim_x": n, "dim_y": n, "cell_x": 0.5 / n, "cell_y": 0.5 / n, "mass": 0.001}
    at = wp.vec3(-0.25, -0.25, 0.157)
    builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(*velocity), **cells, **SOFT)


def finalized(builder, device):
    builder.color()
    model = builder.finalize(device=device)
    model.soft_contact_ke, model.soft_contact_mu, model.particle_mu = 1e4, 0.5, 0.5
    return model


def roll(model, passes, steps, *, inner="vbd", in_graph=False, **options):
    """Returns a rollout of steps in substeps, with contacts found before each and passed on, or without."""
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS[inner](model), **options))
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts() if passes else None
    start, end = rollout.states

    def two_steps():
        for a, b in ((start, end), (end, start)):
            a.clear_forces()
            if passes:
                pipeline.collide(a, contacts)
            rollout.solver.step(a, b, rollout.control, contacts, 1.0 / RATE)

    if not in_graph:
        for _ in range(steps // 2):
            two_steps()
        return rollout
    model_state = model.state()
    two_steps()  # allocates
    start.assign(model_state)
    rollout.solver.reset(start)
    with wp.ScopedCapture(model.device) as capture:
        two_steps()
    for _ in range(steps // 2):
        wp.capture_launch(capture.graph)
    return rollout


@pytest.mark.parametrize("inner, substeps", [("vbd", "auto"), ("vbd", 8), ("xpbd", 4)])
def test_a_step_is_the_same_with_contacts_passed_on(inner, substeps, device):
    builder = newton.ModelBuilder()
    add_drape(builder)
    model = finalized(builder, device)
    in_any_order = inner == "xpbd" and device.is_cuda  # XPBD adds up floats by atomic operations
    steps = 8 if in_any_order else 16  # contacts soon make such differences larger
    plain, passed = (roll(model, passes, steps, inner=inner, substeps=substeps) for passes in (False, True))
    assert passed.solver.report.totals.substepped_steps > 4 and passed.solver.report.totals.uncertified_steps == 0
    assert passed.solver.report.totals.substepped_steps == plain.solver.report.totals.substepped_steps
    np.testing.assert_allclose(passed.positions, plain.positions, rtol=0.0, atol=1e-5 * in_any_order)
    np.testing.assert_allclose(passed.velocities, plain.velocities, rtol=0.0, atol=1e-3 * in_any_order)


def test_steps_in_which_weight_moves_little_are_short(device):
    """Weight moves by up to 1% of an edge in them, which is 0.0625 m; without gravity there are none."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -10.0))
    add_drape(builder)
    model = finalized(builder, device)
    contacts = inner_contacts.InnerContacts(ModelMesh(model), moves_bodies=False)
    longest = (0.000625 / 10.0) ** 0.5
    assert contacts.is_short(0.99 * longest)
    assert not contacts.is_short(1.01 * longest)
    model.set_gravity((0.0, 0.0, 0.0))
    contacts.read_gravity()
    assert not contacts.is_short(0.99 * longest)


@pytest.mark.parametrize("inner", ["vbd", "xpbd"])
def test_gravity_that_changes_says_which_steps_are_short(inner, device):
    """A short step has all contacts; if it becomes a long one, they are taken out, and from XPBD in both."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -1.0))
    add_drape(builder)
    model = finalized(builder, device)
    solver = bsc.SolverCCD(SOLVERS[inner](model))
    pipeline, states = newton.CollisionPipeline(model), (model.state(), model.state())
    contacts = pipeline.contacts()
    pipeline.collide(states[0], contacts)
    got = []
    inner_step = solver.solver.step
    solver.solver.step = lambda *arguments: got.append(arguments[3]) or inner_step(*arguments)
    solver.step(*states, None, contacts, 1.0 / RATE)
    assert (got[-1] is contacts) == (inner == "vbd")
    model.set_gravity((0.0, 0.0, -10.0))
    solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
    solver.step(*states, None, contacts, 1.0 / RATE)
    assert got[-1].soft_contact_count.numpy()[0] < contacts.soft_contact_count.numpy()[0]


def test_contacts_in_a_graph_are_those_of_each_replay(device):
    if device.is_cuda and not wp.is_conditional_graph_supported():
        pytest.skip("needs conditional nodes")
    builder = newton.ModelBuilder()
    add_drape(builder)
    model = finalized(builder, device)
    plain, captured = (roll(model, True, 16, in_graph=graph, substeps="auto") for graph in (False, True))
    assert captured.solver.report.totals.substepped_steps > 4
    assert captured.positions.tobytes() == plain.positions.tobytes()


def test_worlds_with_contacts_are_like_one_alone(device):
    speeds = 0.0, -3.0
    worlds, alone = newton.ModelBuilder(), []
    for speed in speeds:
        world = newton.ModelBuilder()
        add_drape(world, velocity=(0.0, 0.0, speed))
        worlds.add_world(world)
        builder = newton.ModelBuilder()
        builder.add_world(world)
        alone.append(builder)
    rollouts = [roll(finalized(builder, device), True, 8, substeps="auto") for builder in (worlds, *alone)]
    assert rollouts[0].solver.report.totals.substepped_steps > 2
    expected = np.concatenate([rollout.positions for rollout in rollouts[1:]])
    assert rollouts[0].positions.tobytes() == expected.tobytes()


def packed_particles(model, state, **options):
    """Returns the particles of the contacts that the inner solver gets, and of all."""
    contacts = newton.CollisionPipeline(model).contacts()
    newton.CollisionPipeline(model).collide(state, contacts)
    filtered = inner_contacts.InnerContacts(ModelMesh(model), moves_bodies=options.pop("moves_bodies", False))
    packed = filtered.take_out(contacts, state, **({"leaves_bodies": True} | options))
    assert packed is not None
    kept, found = (c.soft_contact_particle.numpy()[: c.soft_contact_count.numpy()[0]] for c in (packed, contacts))
    return sorted(kept.tolist()), sorted(found.tolist())


def test_what_the_stage_leaves_alone_keeps_its_contacts(device):
    """Single particles, and particles that start in a box or in the ground."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.add_shape_box(-1, xform=wp.transform((0.0, 0.0, 0.2), wp.quat_identity()), hx=0.1, hy=0.1, hz=0.1)
    add_patch(builder, 2, 0.02, (0.0, 0.0, 0.301))  # on the box
    single = builder.add_particle(wp.vec3(0.05, 0.05, 0.302), wp.vec3(), 0.01, radius=0.005)
    first_inside = builder.particle_count
    add_patch(builder, 2, 0.02, (0.0, 0.0, 0.298))  # in the box
    add_patch(builder, 2, 0.02, (0.5, 0.0, 0.001))  # on the ground
    first_below = builder.particle_count
    add_patch(builder, 2, 0.02, (0.7, 0.0, -0.001))  # in the ground
    model = finalized(builder, device)
    kept, found = packed_particles(model, model.state())
    assert found == list(range(model.particle_count))
    assert kept == [single, *range(first_inside, first_inside + 9), *range(first_below, model.particle_count)]


@pytest.mark.parametrize("moves_bodies, leaves_bodies, kinematic", [(0, 1, 0), (1, 1, 0), (0, 0, 0), (0, 1, 1)])
def test_a_body_that_only_the_inner_solver_moves_keeps_its_contacts(moves_bodies, leaves_bodies, kinematic, device):
    builder = newton.ModelBuilder()
    at = wp.transform((0.3, 0.2, 0.1), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.3))
    body = builder.add_body(xform=at, is_kinematic=bool(kinematic))
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.1)
    add_patch(builder, 2, 0.02, (0.3, 0.2, 0.202))
    model = finalized(builder, device)
    options = {"moves_bodies": bool(moves_bodies), "leaves_bodies": bool(leaves_bodies)}
    kept, found = packed_particles(model, model.state(), **options)
    assert len(found) == 9
    assert len(kept) == (9 if leaves_bodies and not moves_bodies and not kinematic else 0)


def test_triangles_of_round_shapes_are_no_deeper_than_said(device):
    """What rests on the triangles has not entered the shape; and 2% of the radius below the surface is inside."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(-1, radius=0.2)
    builder.add_shape_capsule(-1, radius=0.1, half_height=0.4)
    builder.add_shape_cylinder(-1, radius=0.1, half_height=0.4)
    builder.add_shape_cylinder(-1, radius=0.1, half_height=0.2, barrel_radius=0.2)
    builder.add_shape_cone(-1, radius=0.3, half_height=0.2)
    builder.add_shape_ellipsoid(-1, rx=0.1, ry=0.2, rz=0.4)
    builder.add_shape_box(-1, hx=0.1, hy=0.2, hz=0.3)
    builder.add_particle(wp.vec3(), wp.vec3(), 1.0)
    model = builder.finalize(device=device)
    mesh = ModelMesh(model)
    depths = inner_contacts.InnerContacts(mesh, moves_bodies=False)._stage.depth.numpy()
    scale = model.shape_scale.numpy().astype(float)
    x = np.concatenate([np.zeros((1, 3)), mesh.shape_vertices.position]).astype(float)
    for shape, kind in enumerate(map(GeoType, model.shape_type.numpy())):
        faces = mesh.faces[mesh.shape_vertices.shape[mesh.faces[:, 0] - 1] == shape]
        center = x[faces].mean(axis=1)
        a, b, c = scale[shape]
        r = np.linalg.norm(center[:, :2], axis=1)
        if kind == GeoType.SPHERE:
            depth = a - np.linalg.norm(center, axis=1)
        elif kind == GeoType.CAPSULE:
            beyond = np.maximum(np.abs(center[:, 2]) - b, 0.0)
            depth = a - np.hypot(r, beyond)
        elif kind == GeoType.CYLINDER:
            side = c - np.hypot(r - a + np.sqrt(c * c - b * b), center[:, 2]) if c > 0.0 else a - r
            depth = np.minimum(side, b - np.abs(center[:, 2]))
        elif kind == GeoType.CONE:
            side = (a * (b - center[:, 2]) / (2.0 * b) - r) * np.cos(np.arctan2(a, 2.0 * b))
            depth = np.minimum(side, center[:, 2] + b)
        elif kind == GeoType.ELLIPSOID:
            depth = (1.0 - np.linalg.norm(center / scale[shape], axis=1)) * scale[shape].min()
        else:
            depth = np.abs(np.abs(center) - scale[shape]).min(axis=1)
        assert -1e-6 < depth.max() <= depths[shape] + 1e-6, kind
        assert depths[shape] <= 0.02 * scale[shape].max()


def test_forces_are_in_the_rows_of_the_contacts_passed_on(device):
    """Of cloth and a single particle on the ground and a box, the inner solver pushes the particle alone."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1, hx=0.2, hy=0.2, hz=0.1)
    add_patch(builder, 3, 0.04, (0.0, 0.0, 0.103))
    single = builder.add_particle(wp.vec3(0.1, 0.1, 0.102), wp.vec3(), 0.01, radius=0.005)
    add_patch(builder, 3, 0.04, (0.0, -0.1, 0.103))
    model = finalized(builder, device)
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=5), substeps="auto")
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    pipeline.collide(model.state(), contacts)
    count = int(contacts.soft_contact_count.numpy()[0])
    particles = contacts.soft_contact_particle.numpy()[:count]
    assert count > 20 and 0 < particles.tolist().index(single) < count - 1
    observables = solver.observables({SolverBase.ObservableKind.CONTACT_F}, contacts=contacts)
    before = contacts.soft_contact_particle.numpy()
    solver.step(model.state(), model.state(), model.control(), contacts, 1.0 / RATE, observables=observables)
    assert observables.contact_f is not None
    force = observables.contact_f.numpy()[contacts.rigid_contact_max :][:count]
    assert (force[particles == single, 2] < 0.0).all()  # on the box
    assert not force[particles != single].any()
    assert (contacts.soft_contact_particle.numpy() == before).all() and contacts.soft_contact_count.numpy()[0] == count


def test_a_single_particle_rests_on_its_contact(device):
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1, hx=0.2, hy=0.2, hz=0.1)
    add_patch(builder, 3, 0.04, (0.0, 0.0, 0.106))
    single = builder.add_particle(wp.vec3(0.1, 0.1, 0.106), wp.vec3(), 0.01, radius=0.005)
    rollout = roll(finalized(builder, device), True, 20, substeps=2)
    assert rollout.solver.report.totals.substepped_steps > 4
    assert abs(rollout.positions[single, 2] - 0.105) < 5e-4
    assert rollout.positions[:16, 2].min() > 0.1 and rollout.positions[:16, 2].max() < 0.102
