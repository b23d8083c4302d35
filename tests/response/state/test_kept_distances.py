"""A stage with a minimum distance: exact queries say of each step, as stored, what came nearer than it may."""

import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import (
    DT,
    SOLVERS,
    Changed,
    DistanceRollout,
    Rollout,
    add_patch,
    add_plates,
    add_rope,
    place_plates,
    strands,
)
from small_queues import stage

import warp_bsc as bsc


def bullet(speed, device):
    """A patch shot at a smaller sheet that is held at its border."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 8, 0.05, (0.0, 0.0, 0.0), fixed=True)
    add_patch(builder, 5, 0.03, (0.011, 0.017, 0.08), velocity=(0.4, 0.0, -speed))
    builder.color()
    return builder.finalize(device=device)


@pytest.mark.parametrize("iterations", [0, 40])
@pytest.mark.parametrize("speed", [5.0, 60.0])
def test_a_bullet(speed, iterations, device):
    """It stops at the distance, by projection, and by planes alone."""
    model, distance = bullet(speed, device), 0.012
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), min_distance=distance, max_iterations=iterations)
    rollout = DistanceRollout(model, solver, distance)
    hits = 0
    for _ in range(8 if speed < 50.0 else 4):
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
    assert hits > 20 and rollout.near == rollout.approaches == rollout.collisions == 0
    assert rollout.solver.report.totals.frozen_steps == 0


def test_ropes_and_points(device):
    """They keep the sum of their radii from each other and from cloth, by springs and particles without faces."""
    model = strands(device)
    solver = bsc.SolverCCD(
        newton.solvers.SolverXPBD(model, iterations=2), particle_radius=model.particle_radius, friction=0.3
    )
    assert len(solver.mesh.free_edges) == 18 and len(solver.mesh.points) == 3
    rollout = DistanceRollout(model, solver, radius=model.particle_radius.numpy())
    hits = 0
    for _ in range(12):
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
    assert hits > 40 and rollout.near == rollout.approaches == 0


def construct(model, make=bsc.SolverCCD, **options):
    """Returns what the construction of a stage warns of."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        make(Changed(model), **options)
    assert all(warning.filename == __file__ for warning in said)
    return [str(warning.message) for warning in said]


@pytest.mark.parametrize("make", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_ropes_and_points_without_a_distance_are_named(make, device):
    (said,) = construct(strands(device, worlds=2), make)
    assert said.startswith("36 springs and 6 particles without faces and springs take no part")
    assert "min_distance='model'" in said
    for options in ({"min_distance": 0.0}, {"min_distance": "model"}, {"particle_radius": 0.004}):
        assert not construct(strands(device), make, **options)


def test_only_what_could_meet_something_is_named(device):
    """Not cloth, nor a particle that is alone in its world, is not active, or that a filter leaves out."""

    def loose(count, worlds=1, cloth=False, **options):
        world = newton.ModelBuilder()
        world.add_ground_plane()
        for i in range(count):
            world.add_particle(wp.vec3(0.1 * i, 0.0, 1.0), wp.vec3(), 0.01, **options)
        if cloth:
            add_patch(world, 2, 0.04, (0.0, 0.0, 0.5))
        builder = newton.ModelBuilder()
        builder.replicate(world, worlds)
        builder.color()
        return builder.finalize(device=device)

    assert not construct(loose(0, cloth=True)) and not construct(loose(1, worlds=3))
    assert construct(loose(2))[0].startswith("2 particles") and construct(loose(1, cloth=True))[0].startswith("1 part")
    assert not construct(loose(2, cloth=True, flags=0))
    mask = np.array([0] + [1] * 9)
    assert not construct(loose(1, cloth=True), collision_filter=bsc.CollisionFilter(particle_mask=mask))


def test_without_queues(device, monkeypatch):
    """Where queues of a graph are too small, the search without them keeps the distances of all kinds of pairs."""
    model = strands(device)
    radius = model.particle_radius.numpy()
    rollout = DistanceRollout(
        model, stage(model, monkeypatch, tiny=True, inner="xpbd", particle_radius=radius), radius=radius
    )
    hits = 0
    for _ in range(8):
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
    assert hits > 20 and rollout.near == rollout.approaches == 0


def test_worlds(device):
    """Two worlds in one place move like one world alone, bit for bit."""
    ends = []
    for worlds in (1, 2):
        model = strands(device, worlds)
        rollout = Rollout(
            model, bsc.SolverCCD(Changed(model), particle_radius=0.004)
        )  # XPBD knows no worlds of particles
        for _ in range(6):
            rollout.step()
            assert rollout.solver.report.certified
        assert rollout.solver.report.predicted_contacts > 0
        ends.append(rollout.positions)
    np.testing.assert_array_equal(ends[1], np.concatenate([ends[0]] * 2))


def test_what_starts_nearer_moves_apart(device):
    """Sheets at 0.7 of the distance that are pushed together come no nearer, and end up farther apart."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    distance = 0.012
    add_patch(builder, 4, 0.04, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.4))
    add_patch(builder, 4, 0.04, (0.013, 0.007, 0.7 * distance), velocity=(0.0, 0.0, -0.4))
    builder.color()
    model = builder.finalize(device=device)

    def push(state):
        velocity = np.repeat([[0.0, 0.0, 0.4], [0.0, 0.0, -0.4]], 25, axis=0)
        state.particle_qd.assign(velocity.astype(np.float32))

    rollout = DistanceRollout(model, bsc.SolverCCD(Changed(model, push), min_distance=distance), distance)
    counts = []
    for _ in range(40):
        before = rollout.near
        rollout.step()
        assert rollout.solver.report.certified
        counts.append(rollout.near - before)
    assert counts[0] > 100 and counts[-1] == 0 and rollout.approaches == 0


def test_infinite_planes(device):
    """Cloth stops at the distance above one; what starts nearer comes no nearer."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane()
    add_patch(builder, 3, 0.04, (0.0, 0.0, 0.03), velocity=(0.0, 0.0, -2.0))
    add_patch(builder, 3, 0.04, (0.5, 0.0, 0.004), velocity=(0.0, 0.0, -2.0))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(SOLVERS["xpbd"](model), min_distance=0.01))
    for _ in range(8):
        rollout.step()
        assert rollout.solver.report.certified
        heights = rollout.positions[:, 2].reshape(2, 16)
        assert heights[0].min() > 0.01 and heights[1].min() >= 0.004
    assert heights[0].max() < 0.02


@pytest.mark.parametrize("options", [{}, {"substeps": 3}])
def test_plates_bodies_and_coupled_steps(options, device):
    """Kinematic plates that close on cloth, and a box that falls onto a sheet, keep the distance as shapes."""
    distance = 0.006
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.04)
    body = builder.add_body(xform=wp.transform(wp.vec3(0.6, 0.0, 0.05), wp.quat_identity()))
    builder.add_shape_box(body, hx=0.03, hy=0.03, hz=0.03)
    builder.joint_qd[-4] = -2.0
    add_patch(builder, 5, 0.04, (0.61, 0.01, 0.0), fixed=True)
    builder.color()
    model = builder.finalize(device=device)
    velocity = model.body_qd.numpy()
    velocity[2, :3] = (0.0, 0.0, -2.0)
    model.body_qd.assign(velocity)

    class Falling(Changed):
        def step(self, state_in, state_out, control, contacts, dt):
            poses, twists = state_in.body_q.numpy(), state_in.body_qd.numpy()
            super().step(state_in, state_out, control, contacts, dt)
            poses[2, :3] += dt * twists[2, :3]
            state_out.body_q.assign(poses)
            state_out.body_qd.assign(twists)
            place_plates(state_out, gap)

    rollout = DistanceRollout(model, bsc.SolverCCD(Falling(model), min_distance=distance, **options), distance)
    hits = 0
    for step in range(6):
        gap = max(0.022, 0.04 - 0.004 * step)
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
    assert hits > 20 and rollout.approaches == 0


@pytest.mark.parametrize(("gap", "lifts"), [(2.5, True), pytest.param(1.5, False, marks=pytest.mark.slow)])
def test_kinematic_fingers_lift_cloth_by_the_gap_of_the_guide(gap, lifts, device):
    """With a layer in between, a gap of 2.5 distances holds it; below 2 distances there is no space for it."""
    distance, half, steps = 0.004, 0.01, 10
    builder = newton.ModelBuilder()
    for side in (-1.0, 1.0):
        at = wp.transform(wp.vec3(0.0, 0.0, 0.03 * side), wp.quat_identity())
        builder.add_shape_box(builder.add_body(xform=at, is_kinematic=True), hx=0.02, hy=0.02, hz=half)
    add_patch(builder, 4, 0.02, (0.0, 0.0, 0.0))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10), min_distance=distance, friction=0.5)
    states, height, fastest = [model.state(), model.state()], 0.0, 0.0
    for step in range(2 * steps):
        share = min(1.0, (step + 1) / steps)
        height += 0.003 * (step >= steps)
        apart = half + 0.5 * (0.04 + share * (gap * distance - 0.04))
        poses = [[0.0, 0.0, height + side * apart, 0.0, 0.0, 0.0, 1.0] for side in (-1.0, 1.0)]
        states[0].body_q.assign(np.float32(poses))
        solver.step(*states, None, None, 1.0 / 60.0)
        states.reverse()
        fastest = max(fastest, np.linalg.norm(states[0].particle_qd.numpy(), axis=1).max())
    middle = states[0].particle_q.numpy()[12]
    assert bool(solver.report.penetrated) == (not lifts) and (solver.report.totals.uncertified_steps == 0) == lifts
    if lifts:
        assert abs(middle[2] - height) < 0.5 * distance and fastest < 2.5


def test_what_touches_at_the_start_is_set_aside(device):
    """A rope through another one is left to the inner solver, and the steps are certified without this pair."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_rope(builder, [[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]], velocity=(0.0, 0.0, 0.1))
    add_rope(builder, [[0.0, -0.05, 0.0], [0.0, 0.05, 0.0]])
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model), particle_radius=0.004))
    rollout.step()
    assert rollout.solver.report.certified and rollout.solver.report.excluded == 1


def test_nothing_is_the_same_without_a_distance(device):
    """A distance of 0 is none: the same bits, and no springs or loose particles."""
    ends = []
    for options in ({}, {"min_distance": 0.0}):
        model = strands(device)
        rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=2), **options))
        assert len(rollout.solver.mesh.free_edges) == len(rollout.solver.mesh.points) == 0
        for _ in range(6):
            rollout.step()
        ends.append(rollout.positions)
    np.testing.assert_array_equal(*ends)


def test_a_monitor_counts_approaches(device):
    model = bullet(60.0, device)
    hits = []
    for distance in (None, 0.012):
        rollout = Rollout(model, bsc.CollisionMonitor(SOLVERS["vbd"](model), min_distance=distance))
        rollout.step()
        hits.append(rollout.solver.report.predicted_contacts)
        assert rollout.solver.report.certified == (hits[-1] == 0)
    assert hits[1] > hits[0]


def test_springs_that_take_part(device):
    """Those of cloth and those along two others do not; a tether from cloth to a particle does."""
    builder = newton.ModelBuilder()
    add_patch(builder, 1, 0.1, (0.0, 0.0, 0.0), add_springs=True)
    add_rope(builder, [[0.2, 0.0, 0.0], [0.3, 0.0, 0.0], [0.4, 0.01, 0.0]])
    builder.add_spring(4, 6, 1.0, 0.0, 0.0)  # against bending
    builder.add_spring(3, 4, 1.0, 0.0, 0.0)
    builder.add_particle(wp.vec3(1.0, 0.0, 0.0), wp.vec3(), 1.0)
    model = builder.finalize(device=device)
    mesh = bsc.SolverCCD(newton.solvers.SolverXPBD(model), min_distance=0.01).mesh
    assert mesh.edges[mesh.free_edges].tolist() == [[3, 4], [4, 5], [5, 6]]
    assert mesh.points.tolist() == [7]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_distance": -1.0}, "min_distance must be finite and at least 0"),
        ({"particle_radius": np.ones(3)}, r"particle_radius must be one number or have shape \(59,\)"),
        ({"particle_radius": np.nan}, "particle_radius must be finite and at least 0"),
    ],
)
def test_bad_distances_are_refused(options, message, device):
    model = strands(device)
    with pytest.raises(ValueError, match=message):
        bsc.SolverCCD(newton.solvers.SolverXPBD(model), **options)


def radii_of(solver):
    """The radii of vertices and planes that a solver keeps."""
    kept = solver.mesh.distances
    return kept.radius.numpy().copy(), kept.of_planes.numpy().copy()


def test_arrays_are_read_again_in_each_step(device):
    """As numbers in a solver that is made anew; what is no distance counts as 0."""
    builder = newton.ModelBuilder()
    add_patch(builder, 3, 0.05, (0.0, 0.0, 0.05))
    add_rope(builder, [(0.05 * i, 0.0, 0.2) for i in range(4)])
    builder.add_ground_plane()
    builder.add_shape_sphere(-1, radius=0.01)
    builder.color()
    model = builder.finalize(device=device)
    least, radii = (wp.full(n, 1e-3, dtype=float, device=device) for n in (1, model.particle_count))
    solver = bsc.SolverCCD(newton.solvers.SolverXPBD(model), min_distance=least, particle_radius=radii)
    states = model.state(), model.state()
    values = np.float32(np.random.default_rng(1).uniform(1e-3, 2e-3, model.particle_count))
    for minimum in (np.float32(0.004), np.float32(0.0)):
        least.fill_(minimum)
        radii.assign(values)
        solver.step(*states, None, None, DT)
        other = bsc.SolverCCD(newton.solvers.SolverXPBD(model), min_distance=float(minimum), particle_radius=values)
        for found, expected in zip(radii_of(solver), radii_of(other), strict=True):
            assert np.array_equal(found, expected)
    least.fill_(np.nan)
    radii.assign([-1.0, np.nan, *values[2:]])
    solver.step(*states, None, None, DT)
    expected = np.zeros(solver.mesh.vertex_count)
    expected[2 : len(values)] = values[2:]
    assert np.array_equal(radii_of(solver)[0], expected) and not radii_of(solver)[1].any()


@pytest.mark.parametrize("options", [{"min_distance": "model"}, {}])
def test_distances_of_a_model_with_gradients_are_read_again(options, device):
    """By default those of springs and particles without faces alone."""
    builder = newton.ModelBuilder()
    add_patch(builder, 3, 0.05, (0.0, 0.0, 0.05))
    add_rope(builder, [(0.05 * i, 0.0, 0.2) for i in range(4)])
    builder.add_ground_plane()
    builder.color()
    model = builder.finalize(device=device, requires_grad=True)
    solver = bsc.SolverImplicit(model, **options)
    before = radii_of(solver)
    model.particle_radius.assign(model.particle_radius.numpy() + np.float32(1e-3))
    model.shape_margin.fill_(2e-3)
    solver.step(model.state(), model.state(), None, None, DT)
    after = bsc.SolverImplicit(model, **options)
    for found, old, expected in zip(radii_of(solver), before, radii_of(after), strict=True):
        assert np.array_equal(found, expected)
        assert (found != old).any() == ("min_distance" in options or len(found) == solver.mesh.vertex_count)
    is_face = np.isin(np.arange(solver.mesh.vertex_count), solver.mesh.faces)
    assert radii_of(solver)[0][is_face].any() == ("min_distance" in options)


def test_bodies_alone(device):
    """Boxes that fall onto each other and onto a table, in a model without particles, keep the distance."""
    distance = 0.01
    builder = newton.ModelBuilder()
    table = wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity())
    builder.add_shape_box(-1, xform=table, hx=0.3, hy=0.3, hz=0.1)
    for i in range(2):
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.3 * i)
        body = builder.add_body(xform=wp.transform(wp.vec3(0.01 * i, 0.02 * i, 0.06 + 0.1 * i), turn))
        builder.add_shape_box(body, hx=0.04, hy=0.05, hz=0.03)
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(newton.solvers.SolverXPBD(model), min_distance=distance, bodies="separated")
    states, mesh = (model.state(), model.state()), solver.mesh
    x = wp.empty(mesh.vertex_count, dtype=wp.vec3, device=device)
    finder, rounds = bsc.CollisionDetector(mesh), 0
    for step in range(60):
        states[0].clear_forces()
        solver.step(*states, model.control(), None, DT)
        states = states[::-1]
        rounds += solver.report.iterations
        assert solver.report.certified
        if step % 20 == 19:
            mesh.positions(states[0].particle_q, states[0].body_q, x)
            near = finder.find_proximities(x, distance)
            of_edges = mesh.shape_vertices.body[mesh.edges[:, 0]]
            first = mesh.shape_vertices.body[near.vertex_face[:, 0]], of_edges[near.edge_edge[:, 0]]
            second = mesh.shape_vertices.body[mesh.faces[near.vertex_face[:, 1], 0]], of_edges[near.edge_edge[:, 1]]
            assert (np.concatenate(first) == np.concatenate(second)).all()
    assert rounds > 20
