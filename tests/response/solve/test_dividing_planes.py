"""Dividing planes: with little or no projection, contacts are kept apart without standing still."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from hypothesis import example, given, settings
from hypothesis import strategies as st
from newton_scenes import DT, SOLVERS, STIFF, Changed, Rollout, add_patch, add_plates, bullet, place_plates
from sample_sizes import cases

import warp_bsc as bsc
from warp_bsc.response.contacts.first_contact import packed_contact
from warp_bsc.response.contacts.planes_between import add_plane, add_solid, has_planes
from warp_bsc.response.solve.vertex_projection import position_on_sides
from warp_bsc.response.state.cluster import BLOCK
from warp_bsc.response.state.status import Loop
from warp_bsc.response.state.structs import DIVIDED, NEVER, NO_NODE, DividingPlanes, Motion, allocate


def staged(model, iterations, inner="vbd"):
    """A rollout with at most this many iterations of projection."""
    return Rollout(model, bsc.SolverCCD(SOLVERS[inner](model), max_iterations=iterations))


def record_wanted(rollout):
    """Returns a list that holds the positions that the inner solver wanted in the last step."""
    inner, wanted = rollout.solver.solver, []
    step = inner.step

    def recorded(state_in, state_out, *arguments, **options):
        step(state_in, state_out, *arguments, **options)
        wanted[:] = [state_out.particle_q.numpy().copy()]

    inner.step = recorded
    return wanted


@pytest.mark.parametrize("iterations", [0, 1])
@pytest.mark.parametrize("speed", [10.0, 60.0])
def test_a_bullet(speed, iterations, device):
    """It is stopped, and without projection no vertex ends farther from where it wanted to be than it began."""
    rollout = staged(bullet(speed, device=device), iterations)
    wanted = record_wanted(rollout)
    hits = 0
    for _ in range(12 if speed < 50.0 else 8):
        start = rollout.positions
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
        assert rollout.solver.report.iterations <= iterations + 33
        missed, path = (np.linalg.norm(x.astype(float) - wanted[0], axis=1) for x in (rollout.positions, start))
        assert iterations > 0 or (missed <= path + 1e-6).all()
    assert rollout.collisions == 0 and hits > 50
    assert rollout.solver.report.totals.frozen_steps == 0


@pytest.mark.parametrize("iterations", [0, 1])
def test_a_tilted_bullet(iterations, device):
    """Edges meet edges, and what slides along a plane goes on sliding."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 12, 0.05, (0.0, 0.0, 0.0), fixed=True)
    tilt = wp.quat_from_axis_angle(wp.vec3(1.0, 0.3, 0.0), 0.4)
    sides = {"dim_x": 8, "dim_y": 8, "cell_x": 0.03, "cell_y": 0.03, "mass": 0.001}
    at, velocity = wp.vec3(-0.12, -0.12, 0.15), wp.vec3(3.0, 0.0, -30.0)
    builder.add_cloth_grid(pos=at, rot=tilt, vel=velocity, **sides, **STIFF)
    builder.color()
    rollout = staged(builder.finalize(device=device), iterations)
    wanted = record_wanted(rollout)
    hits = 0
    for _ in range(8):
        start = rollout.positions
        rollout.step()
        if hits == 0 and iterations == 0:
            slid, wanted_slide = ((x - start)[-81:, 0].mean() for x in (rollout.positions, *wanted))
            assert slid > 0.8 * wanted_slide > 0.0
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
    assert rollout.collisions == 0 and hits > 50
    assert rollout.solver.report.totals.frozen_steps == 0


@pytest.mark.parametrize("iterations", [0, 1])
def test_linear_momentum_is_kept(iterations, device):
    """Free patches that meet off centre change velocities by as much on either side."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 6, 0.05, (0.0, 0.0, 0.0), velocity=(0.5, 0.0, 3.0))
    add_patch(builder, 6, 0.05, (0.09, 0.07, 0.05), velocity=(0.0, -0.5, -2.0))
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model), max_iterations=iterations))
    before, velocities, divided = rollout.momenta()[0], rollout.velocities, 0
    for _ in range(6):
        rollout.step()
        divided += np.count_nonzero(rollout.solver.report.step_results.of_vertices.numpy() & int(DIVIDED))
        assert rollout.solver.report.truncated == rollout.solver.report.frozen == 0
    assert np.linalg.norm(rollout.momenta()[0] - before) < 1e-5 * np.linalg.norm(before)
    assert rollout.collisions == 0 and np.abs(rollout.velocities - velocities).max() > 1.0
    assert divided > 0 or iterations > 0


@pytest.mark.parametrize("iterations", [0, 1])
def test_plates_that_close_on_cloth(iterations, device):
    """They push it flat until they stop."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.03)
    builder.color()
    model = builder.finalize(device=device)
    rollout = Rollout(
        model, bsc.SolverCCD(Changed(model, lambda state: place_plates(state, gap)), max_iterations=iterations)
    )
    hits = 0
    for step in range(8):
        gap = max(0.004, 0.026 - 0.004 * step)
        rollout.step()
        hits += rollout.solver.report.predicted_contacts
        assert rollout.solver.report.certified
        assert np.abs(rollout.positions[:, 2]).max() < 0.5 * gap
    assert rollout.collisions == 0 and hits > 50
    assert rollout.solver.report.totals.frozen_steps == rollout.solver.report.totals.truncated_steps == 0


def test_a_pile_takes_few_rounds(device):
    """Near pairs at rest are divided at once: else most steps take 4 rounds, and one layer after the other up to 14."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.1)
    for layer in range(16):
        add_patch(builder, 5, 0.02, (0.002 * layer, 0.0015 * layer, 0.0002 * (layer + 1)))
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0)))
    rounds = []
    for _ in range(16):
        rollout.step(1.0 / 600.0)
        rounds.append(rollout.solver.report.iterations)
    report = rollout.solver.report
    assert report.totals.uncertified_steps == report.totals.truncated_steps == 0
    assert rollout.collisions == 0 and report.predicted_contacts > 50
    assert max(rounds) <= 4 and np.median(rounds[3:]) <= 2, rounds


@pytest.mark.parametrize("turns", [False, True])
def test_layers_that_move_together_are_not_stopped(turns, device):
    """Two layers near each other fly or turn on as they do alone, while others collide in the same world.

    Planes between them stand still. They would stop a layer that goes farther than the gap in a step.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for height in (0.0, 1e-4):
        add_patch(builder, 4, 0.05, (100.0 * height, 0.0, height), velocity=(0.0, 0.0, 1.0))
    count = builder.particle_count
    for height in (0.0, 1e-4):
        velocity = (0.0, 0.0, 0.1 - 2000.0 * height)
        add_patch(builder, 4, 0.05, (2.0 + 100.0 * height, 0.0, height), velocity=velocity)
    if turns:
        for i in range(count):
            x, _, z = builder.particle_q[i]
            builder.particle_qd[i] = wp.vec3(10.0 * z, 0.0, -10.0 * x)
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(Changed(model)))
    dt = 1.0 / 1920.0
    wanted = 10.0 * dt * rollout.velocities[:count]
    start, hits = rollout.positions[:count], 0
    for _ in range(10):
        rollout.step(dt)
        hits += rollout.solver.report.predicted_contacts
    assert rollout.collisions == 0 and hits > 0
    path = rollout.positions[:count] - start
    assert abs((path * wanted).sum() / (wanted**2).sum() - 1.0) < 1e-3


@wp.kernel(enable_backward=False)
def _divide(
    # in
    motion: Motion,
    normals: wp.array[wp.vec3d],
    offsets: wp.array[wp.float64],
    margins: wp.array[float],
    x0: wp.vec3,
    x1: wp.vec3,
    # out
    planes: DividingPlanes,
    end: wp.array[wp.vec3],
    cut: wp.array[bool],
):
    for i in range(normals.shape[0]):
        add_solid(motion, planes, 0, normals[i], offsets[i], margins[i])
    position, was_cut = position_on_sides(planes, 0, x0, x1)
    end[0] = position
    cut[0] = was_cut


def divide(planes, x0, x1, device):
    """The end of a vertex's path and whether it was cut; planes are normals, least coordinates, margins."""
    normals, offsets, margins = (np.array(values, dtype=float) for values in zip(*planes, strict=True))
    motion = Motion()
    motion.inverse_mass = wp.ones(1, dtype=float, device=device)
    inputs = [motion, wp.array(normals, dtype=wp.vec3d, device=device)]
    inputs += [wp.array(offsets, dtype=wp.float64, device=device), wp.array(margins, dtype=float, device=device)]
    end, cut = wp.empty(1, dtype=wp.vec3, device=device), wp.empty(1, dtype=bool, device=device)
    sizes = {"count": 1, "next": 4 * len(planes), "half": 0}
    lists = allocate(DividingPlanes, len(planes), device, **sizes)
    lists.first.fill_(int(NO_NODE))
    outputs = [lists, end, cut]
    wp.launch(_divide, 1, inputs=[*inputs, wp.vec3(*x0), wp.vec3(*x1)], outputs=outputs, device=device)
    return end.numpy()[0], bool(cut.numpy()[0])


@wp.kernel
def _add_planes(motion: Motion, count: int, planes: DividingPlanes, found: wp.array[bool]):
    for _plane in range(count):
        add_plane(motion, planes, wp.vec4i(0, -1, -1, -1), 1, wp.vec3d(), wp.float64(0.0), wp.float64(0.0))
    has_any, complete = has_planes(planes, 0)
    found[0] = has_any
    found[1] = complete


@pytest.mark.parametrize("count", [0, 2, 3])
def test_planes_that_do_not_fit_take_none_away(count, device):
    """A vertex keeps those that it has, and its planes count as incomplete."""
    motion = Motion()
    motion.inverse_mass = wp.ones(1, dtype=float, device=device)
    lists = allocate(DividingPlanes, 2, device, count=1, next=8, half=0)
    lists.first.fill_(int(NO_NODE))
    found = wp.empty(2, dtype=bool, device=device)
    wp.launch(_add_planes, 1, inputs=[motion, count, lists, found], device=device)
    assert found.numpy().tolist() == [count > 0, count == 2]
    kept, node = 0, int(lists.first.numpy()[0])
    while node != NO_NODE:
        kept, node = kept + 1, int(lists.next.numpy()[node // 2])
    assert kept == min(count, 2)


def unit(*vector):
    return np.array(vector, dtype=float) / np.linalg.norm(vector)


START = (0.0, 0.0, 1.0)


def test_one_plane(device):
    """A position below it goes straight up to the margin; one above it stays."""
    n = unit(0.2, -0.1, 1.0)
    x1 = np.float32([0.3, 0.2, -0.7])
    end, cut = divide([(n, 0.1, 0.01)], START, x1, device)
    np.testing.assert_allclose(end, x1 + (0.11 - n @ x1) * n, atol=1e-7)
    assert not cut
    above = np.float32([0.3, 0.2, 0.2])
    end, cut = divide([(n, 0.1, 0.01)], START, above, device)
    assert end.tobytes() == above.tobytes() and not cut


def test_two_planes(device):
    """Where they are at right angles, a position goes up to both margins."""
    a, b = unit(1.0, 0.0, 1.0), unit(-1.0, 0.0, 1.0)
    x1 = np.float32([0.1, 0.4, -0.5])
    end, cut = divide([(a, 0.2, 0.01), (b, 0.3, 0.02)], START, x1, device)
    np.testing.assert_allclose([a @ end, b @ end, end[1]], [0.21, 0.32, 0.4], atol=1e-6)
    assert not cut


def test_an_acute_wedge(device):
    """Where planes nearly face each other, a position goes up between them all the same."""
    planes = [(unit(1.0, 0.0, 0.01), 0.0, 1e-4), (unit(-1.0, 0.0, 0.01), 0.0, 1e-4)]
    end, cut = divide(planes, START, np.float32([0.3, 0.2, -1.0]), device)
    np.testing.assert_allclose(end, [0.0, 0.2, 1e-4 / planes[0][0][2]], atol=1e-7)
    assert not cut


def test_no_room(device):
    """Where nothing is above all planes, a path ends where it began."""
    planes = [(unit(0.0, 0.0, 1.0), 1.5, 0.01), (unit(0.0, 0.0, -1.0), -0.5, 0.01)]
    for x1 in ((0.3, 0.2, -1.0), (0.3, 0.2, 1.0), (0.3, 0.2, 2.0)):
        end, cut = divide(planes, START, x1, device)
        assert end.tolist() == list(START) and cut


@settings(max_examples=cases(40))
@given(seed=st.integers(0, 2**32 - 1), room=st.sampled_from([1e-9, 1e-10, 1e-11, 1e-12]))
def test_elements_nearer_than_coordinates_are_precise(seed, room, device):
    """A vertex slides along the plane all the same: its end is rounded upwards."""
    rng = np.random.default_rng(seed)
    x0 = np.float32(rng.uniform(0.001, 0.2, 3))
    n = unit(*(rng.choice([-1.0, 1.0], 3) * rng.uniform(0.05, 1.0, 3)))
    slide = 1e-5 * unit(*np.cross(n, rng.standard_normal(3)))
    end, cut = divide([(n, n @ x0.astype(float) - room, 0.9 * room)], x0, np.float32(x0 + slide - 1e-6 * n), device)
    assert not cut
    assert n @ end > n @ x0.astype(float) - room
    np.testing.assert_allclose(end, x0 + slide, rtol=0.0, atol=3e-8)


_NUMBER = st.integers(-8, 8).map(lambda i: i / 8.0)  # of few bits, so that planes are symmetric and equally far


@settings(max_examples=cases(40))
@given(
    normals=st.lists(st.tuples(_NUMBER, _NUMBER, st.integers(1, 8).map(lambda i: i / 8.0)), min_size=2, max_size=4),
    x1=st.tuples(_NUMBER, _NUMBER, st.integers(-8, 4).map(lambda i: i / 8.0)),
    share=st.floats(0.1, 0.9),
)
@example(normals=[(0.5, 0.0, 1.0), (-0.5, 0.0, 1.0)], x1=(0.0, 0.0, -1.0), share=0.5)  # both equally far above
@example(normals=[(0.0, 1.0, 0.5), (0.0, -1.0, 0.5), (1.0, 0.0, 0.5)], x1=(0.0, 0.0, -0.5), share=0.5)
def test_the_order_of_planes_does_not_matter(normals, x1, share, device):
    """Planes between the start of a path and points below them: the end is above all, not farther, always the same."""
    planes = [(unit(*normal), share * (unit(*normal) @ START), 0.01 * unit(*normal)[2]) for normal in normals]
    found = (divide(order, START, x1, device) for order in itertools.permutations(planes))
    ends = {(end.tobytes(), cut) for end, cut in found}
    assert len(ends) == 1
    end = np.frombuffer(ends.pop()[0], dtype=np.float32).astype(float)
    assert all(normal @ end > offset for normal, offset, _ in planes)
    assert np.linalg.norm(end - START) <= np.linalg.norm(np.subtract(x1, START)) + 1e-6


def distance_above(planes, x, margins):
    """The distance from a position to the nearest one above all planes by a share of their margins: on up to three."""
    normals = np.array([normal for normal, _, _ in planes])
    missing = np.array([offset + margins * margin for _, offset, margin in planes]) - normals @ x
    moves = [np.zeros(3)]
    for on in itertools.chain.from_iterable(itertools.combinations(range(len(planes)), n) for n in (1, 2, 3)):
        moves.append(np.linalg.pinv(normals[list(on)]) @ missing[list(on)])
    return min(np.linalg.norm(move) for move in moves if (normals @ move >= missing - 1e-9).all())


@settings(max_examples=cases(60))
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(3, 9), spread=st.sampled_from([0.01, 0.3, 1.0, 3.0]))
def test_the_end_is_the_nearest_position_above_all_planes(seed, count, spread, device):
    """With any number of planes around the start, many of them nearly parallel; the path is never cut."""
    rng = np.random.default_rng(seed)
    normals = np.array([0.0, 0.0, 1.0]) + spread * rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    distances = rng.uniform(0.01, 0.5, count)
    planes = [(n, n @ START - rng.uniform(0.3, 0.9) * d, 0.2 * d) for n, d in zip(normals, distances, strict=True)]
    x1 = np.float32(START + 2.0 * rng.standard_normal(3))
    end, cut = divide(planes, START, x1, device)
    assert not cut and all(normal @ end > offset for normal, offset, _ in planes)
    moved = np.linalg.norm(end - x1.astype(float))
    assert distance_above(planes, x1.astype(float), 0.0) - 1e-6 <= moved
    assert moved <= distance_above(planes, x1.astype(float), 1.0) + 1e-6


@settings(max_examples=cases(40))
@given(seed=st.integers(0, 2**32 - 1), tilt=st.sampled_from([1e-6, 1e-4, 1e-2]))
@example(seed=0, tilt=1e-4)
def test_planes_take_a_vertex_no_farther_than_its_path(seed, tilt, device):
    """Nearly parallel planes that the start is nearer to than their margins, which meet far away."""
    rng = np.random.default_rng(seed)
    low, high = unit(0.0, 0.0, 1.0), unit(*rng.uniform(-tilt, tilt, 2), -1.0)
    x0 = np.float32([0.1, 0.2, 3e-7])
    planes = [(low, 0.0, 5e-6), (high, high @ x0.astype(float) - 2e-6, 5e-7)]
    x1 = x0 + np.float32(1e-5 * rng.standard_normal(3))
    end, _cut = divide(planes, x0, x1, device)
    assert all(normal @ end > offset for normal, offset, _ in planes)
    below = max(offset + margin - normal @ x0.astype(float) for normal, offset, margin in planes)
    most = np.linalg.norm(x1.astype(float) - x0) + 4.0 * below
    assert np.linalg.norm(end - x1.astype(float)) <= most + 1e-7


def test_layers_that_fall_together_follow_each_other(device):
    """Six layers fall on a box, in a step by three times what they are apart: the upper ones end where they want.

    Planes that did not move would stop all of them between their start and that of the layer below.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.1)
    gap, fall = 0.001, 0.003
    for layer in range(6):
        at = (0.004 * layer, 0.003 * layer, gap * (layer + 0.5))
        add_patch(builder, 4, 0.028, at, velocity=(0.0, 0.0, -fall / DT))
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0)))
    start = rollout.positions
    rollout.step()
    report = rollout.solver.report
    assert report.certified and report.truncated == 0 and report.iterations <= 3 and rollout.collisions == 0
    fallen = (start - rollout.positions)[:, 2].reshape(6, -1)
    room = gap * (np.arange(6)[:, None] + 0.5)
    assert (fallen[:3] > 0.6 * room[:3]).all() and (fallen[:3] < room[:3]).all()
    np.testing.assert_allclose(fallen[4:], fall, atol=1e-6)


def test_edges_on_edges_push_nothing_aside(device):
    """Wavy layers fall by twelve gaps, nearly edge on edge: what is across two parallel edges leans sideways."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    gap, fall, layers = 1e-4, 1.2e-3, 6
    for layer in range(layers):
        at = (2e-5 * (layer % 2), 1e-5 * (layer % 3), gap * layer)
        add_patch(builder, 8, 0.01, at, velocity=(0.0, 0.0, -fall / DT if layer else 0.0), fixed=layer == 0)
    heights = np.random.default_rng(0).uniform(-0.15 * gap, 0.15 * gap, len(builder.particle_q))
    builder.particle_q = [(x, y, z + height) for (x, y, z), height in zip(builder.particle_q, heights, strict=True)]
    model = builder.finalize(device=device)
    rollout = Rollout(model, bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=0)))
    start = rollout.positions
    rollout.step()
    assert (
        rollout.solver.report.certified and rollout.solver.report.predicted_contacts > 1000 and rollout.collisions == 0
    )
    aside = np.linalg.norm((rollout.positions - start)[:, :2], axis=1)
    assert aside.max() < 1.2e-5  # with planes across all pairs of edges twice as far


@pytest.mark.parametrize("z, start", [(0.0, 2e-3), (0.0, 0.0), (1e-3, 2e-3)])
def test_what_ends_exactly_in_contact_is_divided(z, start, device):
    """A contact at the very end of a step is one: on the ground, also from there, and on another patch that is held."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane()
    add_patch(builder, 2, 0.05, (0.0, 0.0, start))
    if z:
        add_patch(builder, 4, 0.05, (0.01, 0.02, z), fixed=True)
    builder.color()
    model = builder.finalize(device=device)
    ends = model.particle_q.numpy().copy()
    ends[:9, 2] = z
    solver = bsc.SolverCCD(Changed(model, lambda state: state.particle_q.assign(ends)), max_iterations=0)
    state, end = model.state(), model.state()
    solver.step(state, end, None, None, DT)
    assert solver.report.certified and solver.report.predicted_contacts and not solver.report.frozen
    assert end.particle_q.numpy()[:9, 2].min() > z


@wp.kernel(enable_backward=False)
def _pack_last_contacts(i: int, before_never: wp.array[wp.bool]):
    kind = wp.tid()
    before_never[kind] = packed_contact(wp.float64(1.0), kind, i) < NEVER


@pytest.mark.parametrize("i", [0, 2**28 - 1])
def test_a_contact_at_the_very_end_comes_before_none(i, device):
    """Of each kind that three bits hold."""
    before_never = wp.zeros(8, dtype=wp.bool, device=device)
    wp.launch(_pack_last_contacts, 8, [i], [before_never], device=device)
    assert before_never.numpy().all()


@pytest.mark.slow
def test_what_is_pressed_onto_the_ground_does_not_come_ever_nearer(device):
    """Under a held patch 5 micrometres above, its distance must not fall by a share in each step, down to 0."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane()
    add_patch(builder, 2, 0.05, (1.0, 0.0, 1e-4))
    add_patch(builder, 4, 0.05, (1.01, 0.02, 2e-4), fixed=True)
    for i in range(9, builder.particle_count):
        builder.particle_mass[i] = 0.0
    model, height = builder.finalize(device=device), 2e-4

    def press(state):
        x = state.particle_q.numpy().copy()
        x[:9, 2] -= 1e-4
        x[9:, 2] = height
        state.particle_q.assign(x)

    solver = bsc.SolverCCD(Changed(model, press))
    state, end = model.state(), model.state()
    for _ in range(90):
        height = max(0.8 * height, 5e-6)
        solver.step(state, end, None, None, DT)
        state, end = end, state
    assert solver.report.totals.uncertified_steps == solver.report.totals.frozen_steps == 0
    assert state.particle_q.numpy()[:9, 2].min() > 1e-7


def falling_patches(worlds, device):
    """Patches that fall onto each other by more than they are apart, and onto one that is held at its border."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(world, 4, 0.05, (0.0, 0.0, 0.0), fixed=True)
    for k in range(1, 5):
        add_patch(world, 2, 0.05, (0.003 * k, 0.002 * k, 0.004 * k), velocity=(0.0, 0.0, -0.3 * k))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, worlds)
    builder.color()
    return builder.finalize(device=device)


def test_few_planes_are_passed_over_as_many_are(device):
    """Those of one world by one block of threads, those of many worlds by launches, to the same bits."""
    ends, planes, passes = [], [], []
    for worlds in (1, 8):
        model = falling_patches(worlds, device)
        solver, states = bsc.SolverCCD(Changed(model)), [model.state(), model.state()]
        counts = []
        for _ in range(8):
            solver.step(*states, None, None, DT)
            states.reverse()
            counts.append([solver.work.dividing.count.numpy()[0], solver.work.loop[Loop.PASS].numpy()[0]])
        (most, most_passes), x = np.max(counts, axis=0), states[0].particle_q.numpy()
        planes.append(most)
        passes.append(most_passes)
        ends.append(x.reshape(worlds, -1))
    assert 0 < planes[0] <= BLOCK < planes[1] and min(passes) > 2
    np.testing.assert_array_equal(ends[1], np.repeat(ends[0], 8, axis=0))
