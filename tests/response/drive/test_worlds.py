"""Worlds: each is stepped as if it were alone, may take no part in steps, and has results of its own."""

import warnings

import newton
import numpy as np
import pytest
import warp as wp
from body_scenes import add_body, free
from newton_scenes import DT, SOLVERS, STIFF, Changed, add_crossing_sheets, add_patch, add_plates, bullet
from small_queues import stage

import warp_bsc as bsc

PARTICLES, BODIES = ("particle_q", "particle_qd"), ("body_q", "body_qd")
"""Arrays of a state."""


def random_world(seed):
    """A builder of a cloth that falls on a fixed sphere, a light box that is free, and a plate that a program moves."""
    random = np.random.default_rng(seed)
    world = newton.ModelBuilder()
    at = wp.transform(wp.vec3(*random.uniform(-0.02, 0.02, 2), 0.0), wp.quat_identity())
    world.add_shape_sphere(-1, radius=0.1, xform=at)
    box = world.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.2), wp.quat_rpy(*random.uniform(-0.5, 0.5, 3))))
    world.add_shape_box(box, hx=0.02, hy=0.02, hz=0.02, cfg=newton.ModelBuilder.ShapeConfig(density=50.0))
    plate = world.add_body(xform=wp.transform(wp.vec3(0.08, 0.0, 0.09), wp.quat_identity()), is_kinematic=True)
    world.add_shape_box(plate, hx=0.05, hy=0.2, hz=0.01)
    first = world.particle_count
    add_patch(world, 5, 0.05, (*random.uniform(-0.02, 0.02, 2), 0.11), velocity=(0.0, 0.0, random.uniform(-3.0, 0.0)))
    for i in range(first, world.particle_count):
        world.particle_q[i] = wp.vec3(world.particle_q[i]) + wp.vec3(*random.uniform(-1e-3, 1e-3, 3))
    world.color()
    return world


def finalize(seeds, device):
    """Returns a model with a world for each seed."""
    builder = newton.ModelBuilder()
    for seed in seeds:
        builder.add_world(random_world(seed))
    model = builder.finalize(device=device)
    model.particle_grid, model.particle_max_radius = None, 0.0  # XPBD's own contacts of particles know no worlds
    return model


def new_stage(model, inner, **options):
    """Returns a stage with everything reported, and a separation that is no median over worlds."""
    solver = SOLVERS[inner](model)
    return bsc.SolverCCD(solver, separation=2e-4, friction=0.3, report=["contacts", "worlds"], **options)


def move_plates(state, heights):
    """Moves the plate of each world by a height."""
    body_q = state.body_q.numpy()
    body_q[1::2, 2] = 0.09 + heights
    state.body_q.assign(body_q)


class Worlds:
    """Steps worlds, each with its own clock, which masks stop.

    Attributes:
        ends: For each world, what it was after each step that it took part in.
    """

    def __init__(self, model, solver):
        self.model, self.solver, self.count = model, solver, model.world_count
        self.states, self.control = [model.state(), model.state()], model.control()
        self.clock, self.ends = np.zeros(self.count, dtype=int), [[] for _ in range(self.count)]

    def step(self, active=None):
        mask = None
        taken = np.ones(self.count, dtype=bool) if active is None else np.asarray(active)
        if active is not None:
            mask = wp.array([*active, True], dtype=bool, device=self.model.device)
        start, end = self.states
        move_plates(start, 0.002 * self.clock)
        before = self._read(start)
        self.solver.step(start, end, self.control, None, DT, world_mask=mask)
        self.clock += taken
        after, report = self._read(end), self.solver.report
        results = {name: values.copy() for name, values in report.worlds.numpy().items()}
        impulses = [getattr(report.forces, f"{kind}_impulse").numpy().copy() for kind in ("particle", "body", "shape")]
        for world in range(self.count):
            if taken[world]:
                found = [*after[world], *(x.reshape(self.count, -1, x.shape[-1])[world] for x in impulses)]
                self.ends[world].append([*found, *(values[world] for values in results.values())])
            else:
                assert all(map(np.array_equal, after[world], before[world]))
                assert not any(x.reshape(self.count, -1)[world].any() for x in impulses)
        self.states = [end, start]

    def _read(self, state):
        """Returns the arrays of a state by world."""
        arrays = [getattr(state, name).numpy().copy() for name in (*PARTICLES, *BODIES)]
        return list(zip(*(x.reshape(self.count, -1, x.shape[-1]) for x in arrays), strict=True))


def same(one, other):
    """Returns whether two lists of ends are the same, bit by bit."""
    return len(one) == len(other) and all(all(map(np.array_equal, a, b)) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("inner, substeps", [("vbd", 1), ("xpbd", 2)])
def test_each_world_is_stepped_as_if_it_were_alone(inner, substeps, device):
    """Bit by bit, with impulses, and with results by world that are those of its own report."""
    if inner == "xpbd" and wp.get_device(device).is_cuda:
        pytest.skip("XPBD adds up in any order on a GPU")
    seeds, steps = range(3), 16
    model = finalize(seeds, device)
    together = Worlds(model, new_stage(model, inner, substeps=substeps))
    for _ in range(steps):
        together.step()
    hits = 0
    for seed in seeds:
        model = finalize([seed], device)
        alone = Worlds(model, new_stage(model, inner, substeps=substeps))
        for _ in range(steps):
            alone.step()
            report, results = alone.solver.report, alone.solver.report.worlds.numpy()
            for name in (
                "certified",
                "predicted_contacts",
                "remaining",
                "filtered",
                "truncated",
                "frozen",
                "not_finite",
                "crossings",
            ):
                assert results[name].tolist() == [getattr(report, name)], name
            listed = report.forces.contacts.numpy()["normal_impulse"]
            assert results["max_impulse"][0] == max(listed, default=0.0)
            hits += report.predicted_contacts
        assert same(alone.ends[0], together.ends[seed]), seed
    assert hits > 50


@pytest.mark.parametrize("inner, substeps", [pytest.param("vbd", 1, marks=pytest.mark.slow), ("xpbd", 2)])
def test_a_world_that_takes_no_part_changes_no_bit_and_goes_on_as_if_nothing_had_been(inner, substeps, device):
    model = finalize(range(3), device)
    free = Worlds(model, new_stage(model, inner, substeps=substeps))
    for _ in range(16):
        free.step()
    masked = Worlds(model, new_stage(model, inner, substeps=substeps))
    random = np.random.default_rng(1)
    while min(map(len, masked.ends)) < 14:
        masked.step((random.random(3) < 0.5) & (masked.clock < 16))
    for one, other in zip(masked.ends, free.ends, strict=True):
        assert same(one, other[: len(one)])


def test_resets_of_single_worlds_touch_no_other_world(device):
    """At random times, in worlds that take part in random steps: each starts anew as it started first."""
    model = finalize(range(4), device)
    free = Worlds(model, new_stage(model, "vbd"))
    for _ in range(16):
        free.step()
    worlds, random = Worlds(model, new_stage(model, "vbd")), np.random.default_rng(2)
    first, resets = model.state(), 0
    for _ in range(24):
        chosen = (random.random(4) < 0.1) | (worlds.clock >= 16)
        if chosen.any():
            resets += 1
            state, mask = worlds.states[0], wp.array([*chosen, False], dtype=bool, device=device)
            for name in (*PARTICLES, *BODIES):
                values, start = getattr(state, name).numpy().copy(), getattr(first, name).numpy()
                of_worlds = values.reshape(4, -1, values.shape[-1])
                of_worlds[chosen] = start.reshape(of_worlds.shape)[chosen]
                getattr(state, name).assign(values)
            worlds.solver.reset(state, mask)
            worlds.clock[chosen] = 0
            for world in np.flatnonzero(chosen):
                worlds.ends[world] = []
        worlds.step(random.random(4) < 0.8)
        for one, other in zip(worlds.ends, free.ends, strict=True):
            assert same(one[-1:], other[len(one) - 1 : len(one)] if one else [])
    assert resets > 5


@pytest.mark.parametrize("stage", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_nothing_is_found_in_a_world_that_takes_no_part(stage, device):
    model = bullet(100, device=device, worlds=3)
    solver = stage(Changed(model), report=["worlds"])
    mask = wp.array([False, True, False, True], dtype=bool, device=device)
    queued = []
    for masked in (None, mask):
        state, end, hits = model.state(), model.state(), 0
        for _ in range(2):
            solver.step(state, end, model.control(), None, DT, world_mask=masked)
            results = solver.report.worlds.numpy()
            hits += solver.report.predicted_contacts
            if masked is not None:
                assert results["predicted_contacts"].tolist() == [0, solver.report.predicted_contacts, 0]
                assert results["certified"][[0, 2]].all()
            state, end = end, state
        assert hits > 0
        solver.reset(state)
        queued.append(solver.work.detector.counters.read().edge_edge.queued)
    assert queued[1] <= queued[0] // 3


def test_crossings_of_worlds_that_take_no_part_are_known_when_they_go_on(device):
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_crossing_sheets(world, 0.1)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, 2)
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model), report=["worlds"])
    state, end = model.state(), model.state()
    for active in ((True, False), (False, True), (True, True)):
        mask = wp.array([*active, True], dtype=bool, device=device)
        solver.step(state, end, model.control(), None, DT, world_mask=mask)
        crossings = solver.report.worlds.numpy()["crossings"]
        assert crossings.sum() == solver.report.crossings and (crossings > 0).all()
        state, end = end, state


@pytest.mark.parametrize("stage", [bsc.SolverCCD, bsc.CollisionMonitor])
def test_a_stage_that_is_not_asked_has_no_results_by_world(stage, device):
    model = bullet(1, device=device)
    with pytest.raises(RuntimeError, match=r'report=\["worlds"\]'):
        stage(Changed(model)).report.worlds  # noqa: B018
    with pytest.raises(RuntimeError, match=r'report=\["contacts"\]'):
        stage(Changed(model), report=["worlds"]).report.worlds.max_impulse  # noqa: B018


def test_a_world_with_a_position_that_is_not_finite_is_not_certified(device):
    model = bullet(1, device=device, worlds=2)
    solver = bsc.SolverCCD(Changed(model), report=["worlds"])
    state = model.state()
    positions = state.particle_q.numpy().copy()
    positions[-1] = np.nan
    state.particle_q.assign(positions)
    solver.step(state, model.state(), model.control(), None, DT)
    assert not solver.report.certified
    assert solver.report.worlds.certified.numpy().tolist() == [True, False]


@pytest.mark.parametrize("options", [{}, {"substeps": 4}])
def test_a_velocity_that_is_not_finite_leaves_its_world_alone_uncertified(options, device):
    """In whole steps and in substeps; one warning names the particle."""
    worlds, lost = 4, 2
    model = bullet(20.0, device=device, worlds=worlds)
    particle = lost * model.particle_count // worlds + 5

    def lose(state):
        velocity = state.particle_qd.numpy().copy()
        velocity[particle] = np.nan
        state.particle_qd.assign(velocity)

    solver = bsc.SolverCCD(Changed(model, lose), report=["worlds"], **options)
    state, end = model.state(), model.state()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(3):
            solver.step(state, end, model.control(), None, DT)
            results, report = solver.report.worlds.numpy(), solver.report
            assert not report.certified and report.not_finite == 1 and report.remaining == 0
            assert results["certified"].tolist() == [world != lost for world in range(worlds)]
            assert results["not_finite"].tolist() == [int(world == lost) for world in range(worlds)]
            assert report.uncertified_vertices.tolist() == [particle]
            state, end = end, state
    said = [str(warning.message) for warning in said if "not finite" in str(warning.message)]
    assert len(said) == 1 and f"particle {particle} of world {lost}" in said[0]
    assert report.totals.not_finite_steps == report.totals.uncertified_steps == 3


def test_a_velocity_that_is_not_finite_in_one_substep_is_seen(device):
    """Other substeps are finite, and so is the end of the step."""
    model = bullet(20.0, device=device)
    calls = []

    def lose(state):
        calls.append(0)
        if len(calls) == 3:
            velocity = state.particle_qd.numpy().copy()
            velocity[-1] = np.inf
            state.particle_qd.assign(velocity)

    solver = bsc.SolverCCD(Changed(model, lose), substeps=8, report=["worlds"])
    state, end = model.state(), model.state()
    solver.step(state, end, model.control(), None, DT)
    assert len(calls) == 8 and not solver.report.certified and solver.report.not_finite == 1
    assert not solver.report.worlds.certified.numpy().any() and solver.report.worlds.not_finite.numpy().tolist() == [1]
    assert solver.report.uncertified_vertices.tolist() == [model.particle_count - 1]
    way = end.particle_q.numpy()[-1, 2] - state.particle_q.numpy()[-1, 2]
    assert way == pytest.approx(-20.0 * DT * 2 / 8, rel=1e-4)  # it stands from then on
    assert solver.report.totals.not_finite_steps == solver.report.totals.uncertified_steps == 1


def test_strain_and_what_is_inside_by_world(device):
    """Of a patch whose middle falls on a box in one world, and starts in it in another."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    world.add_shape_box(-1, hx=0.03, hy=0.03, hz=0.1)
    add_patch(world, 2, 0.05, (0.0, 0.0, 0.11))
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, 3)
    count = world.particle_count
    for i in range(count):
        builder.particle_qd[i] = wp.vec3(0.0, 0.0, -10.0)
    for i in range(count, 2 * count):
        builder.particle_q[i] = wp.vec3(*builder.particle_q[i]) - wp.vec3(0.0, 0.0, 0.1)
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(Changed(model), report=["worlds"])
    with pytest.warns(UserWarning, match="edges pass through faces at the start"):
        solver.step(model.state(), model.state(), model.control(), None, DT)
        assert solver.report.crossings > 0
    strain = solver.report.worlds.strain.numpy()
    assert strain[0] > 0.05 and strain[0] == pytest.approx(solver.report.strain)
    assert strain[1:].tolist() == [0.0, 0.0]
    assert solver.report.worlds.inside.tolist() == [0, 1, 0]
    assert solver.report.inside.particles.tolist() == [count + 4]


def test_frozen_and_truncated_vertices_are_counted_by_world(device):
    """Of cloth between plates that leave no space for what moves in one of two worlds."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(world, 0.05)
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.replicate(world, 2)
    for i in range(world.particle_count, builder.particle_count):
        builder.particle_qd[i] = wp.vec3(0.0, 0.0, 3.0 * (-1.0) ** i)
    model = builder.finalize(device=device)
    options = {"max_iterations": 0, "report": ["contacts", "worlds"]}
    solver = bsc.SolverCCD(Changed(model), **options)
    state, end, cut = model.state(), model.state(), 0
    for i in range(6):
        body_q = state.body_q.numpy().copy()
        body_q[2:4, 2] = np.array([-1.0, 1.0]) * (0.05 + 0.5 * (0.05 - 0.01 * i))
        state.body_q.assign(body_q)
        solver.step(state, end, model.control(), None, DT)
        results, report = solver.report.worlds.numpy(), solver.report
        for name in ("predicted_contacts", "remaining", "truncated", "frozen"):
            assert results[name].tolist() == [0, getattr(report, name)]
        assert results["certified"].tolist() == [True, report.certified] and results["max_impulse"][0] == 0.0
        cut += min(report.truncated, report.frozen)
        state, end = end, state
    assert cut > 0


def filtered_worlds(seeds, device):
    """A model with a world for each seed and its filter.

    A cloth and a particle of the second group fly at a box, which stops them before a cloth and a particle of the first
    group. Two bodies meet that are filtered by Newton. The box and the ground are in all worlds.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_ground_plane()
    builder.add_shape_box(-1, xform=wp.transform((0.1, 0.0, 0.05), wp.quat_identity()), hx=0.05, hy=0.05, hz=0.05)
    for seed in seeds:
        random = np.random.default_rng(seed)
        world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        world.add_shape_sphere(-1, xform=wp.transform((-0.1, 0.0, 0.05), wp.quat_identity()), radius=0.05)
        for x in (-0.02, 0.02):
            add_body(world, "box", (x, 0.3, random.uniform(0.1, 0.11)), hx=0.03, hy=0.03, hz=0.03)
            world.body_qd[-1] = wp.spatial_vector(-20.0 * x, 0.0, 0.0, 0.0, 0.0, 0.0)
        world.add_shape_collision_filter_pair(1, 2)
        for height, speed in ((0.03, 0.0), (0.13, 30.0)):
            at = *random.uniform(-0.02, 0.02, 2), height
            add_patch(world, 4, 0.05, at, velocity=(0.0, 0.0, -speed))
            world.add_particle(wp.vec3(*at) + wp.vec3(0.0, 0.0, 0.01), wp.vec3(0.0, 0.0, -1.5 * speed), 0.001)
        builder.add_world(world)
    builder.color()
    model = builder.finalize(device=device)
    group = np.tile(1 << np.repeat([0, 1], 26), len(seeds))
    shapes = [1, 2, *([1, 2, 2] * len(seeds))]
    return model, bsc.CollisionFilter(particle_group=group, particle_mask=2, shape_group=shapes, shape_mask=2)


@pytest.mark.filterwarnings("ignore:a step strained")
@pytest.mark.parametrize(
    "tree, options",
    [
        ("packets", {"substeps": 2}),
        ("packets", None),
        ("faces", {"substeps": 2}),
        ("faces", None),
        ("faces without queues", {}),
    ],
)
def test_filtered_pairs_by_world_are_those_of_each_world_alone(tree, options, monkeypatch, device):
    """And add up to those of all, also without queues, where both are lower bounds; None is of a monitor."""
    if tree == "packets" and wp.get_device(device).is_cuda:
        pytest.skip("of the CPU")

    def filtered(seeds):
        model, collision_filter = filtered_worlds(seeds, device)
        given = {"collision_filter": collision_filter, "min_distance": 0.002, "report": ["worlds"]}
        make = bsc.CollisionMonitor
        if options is not None:
            make, given = bsc.SolverCCD, given | {"bodies": "separated", **options}
        if tree == "packets":
            solver = make(free(model), **given)
        else:
            solver = stage(model, monkeypatch, tiny=tree != "faces", inner=free(model), make=make, **given)
        states, found = [model.state(), model.state()], []
        for _ in range(4):
            solver.step(*states, None, None, DT)
            states.reverse()
            found.append(solver.report.worlds.filtered.numpy().tolist())
            assert sum(found[-1]) == solver.report.filtered
        return np.array(found)

    together = filtered(range(3))
    assert together.any()
    if "without" not in tree:
        assert (together.max(axis=0) > 100).all() and len(np.unique(together, axis=1).T) == 3
        np.testing.assert_array_equal(together, np.concatenate([filtered([seed]) for seed in range(3)], axis=1))


def test_a_graph_reads_the_mask_of_each_replay(device):
    """And its report is that of the same steps outside a graph; a world starts anew between two replays."""
    model, alone = finalize(range(3), device), bsc.CollisionFilter(particle_group=2, particle_mask=1)
    solvers = [new_stage(model, "vbd", collision_filter=alone) for _ in range(2)]
    mask = wp.array([True, True, True, True], dtype=bool, device=device)
    states, control = [[model.state(), model.state()] for _ in range(2)], model.control()

    def take_pair(i):
        for start, end in (states[i], states[i][::-1]):
            solvers[i].step(start, end, control, None, DT, world_mask=mask)

    with pytest.raises(RuntimeError, match="before capturing"), wp.ScopedCapture(device):
        take_pair(0)
    solvers[0] = new_stage(model, "vbd", collision_filter=alone)
    for i in range(2):
        take_pair(i)
    with wp.ScopedCapture(device) as capture:
        take_pair(1)
    random, moved, filtered = np.random.default_rng(3), 0, 0
    for replay in range(6):
        mask.assign([*(random.random(3) < 0.6), True])
        before = states[0][0].particle_q.numpy().copy()
        take_pair(0)
        wp.capture_launch(capture.graph)
        moved += not np.array_equal(before, states[0][0].particle_q.numpy())
        for name in (*PARTICLES, *BODIES):
            assert np.array_equal(*(getattr(ends[0], name).numpy() for ends in states)), name
        reports = [solver.report for solver in solvers]
        for kind in ("particle", "body", "shape"):
            assert np.array_equal(*(getattr(report.forces, f"{kind}_impulse").numpy() for report in reports))
        for one, other in zip(*(report.worlds.numpy().values() for report in reports), strict=True):
            assert np.array_equal(one, other)
        filtered += reports[1].worlds.filtered.numpy()
        for one, other in zip(*(report.forces.contacts.numpy().values() for report in reports), strict=True):
            assert np.array_equal(one, other)
        if replay == 2:
            for i in range(2):
                solvers[i].reset(states[i][0], wp.array([False, True, False, False], dtype=bool, device=device))
    assert moved > 3 and (filtered > 30).all()


def cloth_on_a_sphere(turn, height):
    """A cloth that falls on a fixed sphere, turned about an axis across its border; it may begin in the sphere."""
    world = newton.ModelBuilder()
    world.add_shape_sphere(-1, radius=0.25)
    rotation = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), turn)
    options = {
        "dim_x": 12,
        "dim_y": 12,
        "cell_x": 0.066,
        "cell_y": 0.066,
        "mass": 0.001,
        "vel": wp.vec3(0.0, 0.0, -3.0),
    }
    world.add_cloth_grid(pos=wp.vec3(0.1 * turn - 0.4, -0.4, height), rot=rotation, **options, **STIFF)
    return world


@pytest.mark.parametrize("others", [[(0.1, 0.4), (0.2, 0.4), (0.3, 0.4)], [(-0.4, 0.35)]], ids=["turned", "tangled"])
def test_a_world_moves_alike_beside_some_that_are_turned_or_tangled(others, device):
    """Lengths of edges that differ in the last bits, and crossings elsewhere, change no bit."""
    ends = []
    for places in ([(0.0, 0.35)], [(0.0, 0.35), *others]):
        builder = newton.ModelBuilder()
        for place in places:
            builder.add_world(cloth_on_a_sphere(*place))
        model = builder.finalize(device=device)
        model.particle_grid, model.particle_max_radius = None, 0.0  # XPBD's own contacts of particles know no worlds
        solver = bsc.SolverCCD(newton.solvers.SolverXPBD(model, iterations=10))
        state, end, hits = model.state(), model.state(), 0
        for _ in range(16):
            solver.step(state, end, model.control(), None, DT)
            state, end = end, state
            hits += solver.report.predicted_contacts
        assert hits > 20
        ends.append(state.particle_q.numpy()[:169])
    np.testing.assert_array_equal(*ends)
