"""SolverImplicit in many worlds: each is stepped as if it were alone, bit for bit, in graphs too."""

import functools

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import add_patch

import warp_bsc as bsc
from warp_bsc.detection.run import launch
from warp_bsc.implicit.contact.flow import Phase

DT = 1.0 / 60.0
STEPS = 8
ARRAYS = ("particle_q", "particle_qd")


def random_world(seed):
    """A cloth that falls on a sphere, each at random poses, beside a plate that a program lifts; some over a plane."""
    random, world = np.random.default_rng(seed), newton.ModelBuilder()
    at = wp.transform(wp.vec3(*random.uniform(-0.02, 0.02, 2), 0.0), wp.quat_identity())
    world.add_shape_sphere(-1, radius=0.1, xform=at)
    if seed % 2:
        world.add_ground_plane(height=-0.05)
    plate = world.add_body(xform=wp.transform(wp.vec3(0.12, 0.0, 0.07), wp.quat_identity()), is_kinematic=True)
    world.add_shape_box(plate, hx=0.05, hy=0.2, hz=0.01)
    add_patch(world, 3, 0.08, (0.0, 0.0, 0.0), velocity=(0.0, 0.0, -2.0))
    q = wp.quat_rpy(*random.uniform(-0.2, 0.2, 2).tolist(), float(random.uniform(0.0, 3.0)))
    pose = wp.transform(wp.vec3(*random.uniform(-0.02, 0.02, 2), 0.16), q)
    world.particle_q = [wp.transform_point(pose, wp.vec3(*x)) for x in world.particle_q]
    world.particle_mass = [m * (1.0 + seed) for m in world.particle_mass]
    return world


def finalize(seeds, device):
    """A model with a world for each seed."""
    builder = newton.ModelBuilder()
    for seed in seeds:
        builder.add_world(random_world(seed))
    return builder.finalize(device=device)


@wp.kernel(enable_backward=False)
def _lift(body_q: wp.array[wp.transform], clock: wp.array[int]):
    world = wp.tid()
    x = wp.transform_get_translation(body_q[world])
    height = 0.07 + 0.003 * float(clock[world])
    body_q[world] = wp.transform(wp.vec3(x[0], x[1], height), wp.transform_get_rotation(body_q[world]))
    clock[world] = clock[world] + 1


class Run:
    """Steps worlds, each with a clock that its plate follows, and keeps what each was after each step."""

    def __init__(self, seeds, device):
        self.model, self.count = finalize(seeds, device), len(seeds)
        self.solver = bsc.SolverImplicit(self.model, friction=0.3, report=["contacts", "worlds"])
        self.states = [self.model.state(), self.model.state()]
        self.clock = wp.zeros(self.count, dtype=int, device=device)
        self.ends = [[] for _ in seeds]

    def launch(self, mask=None):
        start, end = self.states
        wp.launch(_lift, self.count, inputs=[start.body_q, self.clock], device=self.model.device)
        self.solver.step(start, end, None, None, DT, world_mask=mask)
        start.assign(end)

    def keep(self, worlds=None):
        arrays = [getattr(self.states[0], name).numpy() for name in ARRAYS]
        arrays.append(self.solver.report.forces.particle_impulse.numpy())
        results = self.solver.report.worlds.numpy()
        for world in range(self.count) if worlds is None else worlds:
            found = [x.reshape(self.count, -1, 3)[world].copy() for x in arrays]
            self.ends[world].append([*found, *(values[world] for values in results.values())])

    def step(self):
        self.launch()
        self.keep()


def same(one, other):
    """Whether two lists of ends are the same, bit for bit."""
    return len(one) == len(other) and all(all(map(np.array_equal, a, b)) for a, b in zip(one, other, strict=True))


@functools.cache
def stepped(device):
    run = Run(range(6), wp.get_device(device))
    for _ in range(STEPS):
        run.step()
    return run


@pytest.fixture
def together(device):
    """Six worlds in one model, after their steps."""
    return stepped(str(device))


def test_buffers_of_contacts_that_grow_change_no_bit(together):
    """Also where a world waits for larger ones while another one needs new candidates."""
    run, waits = Run(range(6), together.model.device), set()
    newton_method = run.solver.newton_method
    newton_method.keeps_contacts = False  # pairs of worlds that have ended are not sought again
    renew = newton_method.renew_candidates

    def renew_candidates():
        waits.update(newton_method.problem.flow.phase.numpy().tolist())
        renew()

    newton_method.renew_candidates = renew_candidates
    for _ in range(STEPS):
        newton_method.allocate_contacts(1)
        run.step()
    assert waits == {Phase.SEARCH_CANDIDATES, Phase.GROW, Phase.END}
    moved, expected = ([[end[: len(ARRAYS)] for end in ends] for ends in r.ends] for r in (run, together))
    assert all(map(same, moved, expected))


def test_each_world_is_as_alone(together):
    """With impulses, and with results by world that are those of the report of the world alone."""
    most = 0
    for seed in range(6):
        alone = Run([seed], together.model.device)
        for _ in range(STEPS):
            alone.step()
            report, results = alone.solver.report, alone.solver.report.worlds.numpy()
            names = "newton_steps", "last_change", "converged", "arrived", "certified", "predicted_contacts", "strain"
            for name in names:
                assert results[name].tolist() == [getattr(report, name)], name
            most = max(most, len(report.forces.contacts.numpy()["kind"]))
        assert same(alone.ends[0], together.ends[seed]), seed
    assert most > 10
    steps = np.array([[end[-5] for end in ends] for ends in together.ends])
    assert len(np.unique(steps, axis=0)) > 1


def test_a_graph_from_the_first_step_on_does_what_steps_do(together):
    run = Run(range(6), together.model.device)
    with wp.ScopedCapture(run.model.device) as capture:
        run.launch()
    for _ in range(STEPS):
        wp.capture_launch(capture.graph)
        run.keep()
    assert all(map(same, run.ends, together.ends))


def test_a_world_that_is_not_finite_stands_and_disturbs_no_other(together):
    run = Run(range(3), together.model.device)
    run.step()
    x = run.states[0].particle_q.numpy()
    hit = len(x) // 3 + 2
    x[hit] = np.nan
    run.states[0].particle_q.assign(x)
    with pytest.warns(UserWarning, match="not finite"):
        run.step()
        run.solver.report.warn()
    for world in (0, 2):
        assert same(run.ends[world], together.ends[world][:2])
    results, after = run.solver.report.worlds.numpy(), run.states[0].particle_q.numpy()
    assert results["certified"].tolist() == [True, False, True] and not results["converged"][1]
    assert np.flatnonzero(~np.isfinite(after).all(axis=1)).tolist() == [hit]


def test_reset_worlds_start_anew_and_masked_ones_stand(together):
    """At random times, in worlds that take part in random steps: each goes as it went first."""
    run, random = Run(range(6), together.model.device), np.random.default_rng(1)
    first, device, resets = run.model.state(), run.model.device, 0
    for _ in range(12):
        chosen = (random.random(6) < 0.1) | (run.clock.numpy() >= STEPS)
        if chosen.any():
            resets += 1
            for name in (*ARRAYS, "body_q"):
                array = getattr(run.states[0], name)
                values, start = array.numpy().reshape(6, -1), getattr(first, name).numpy().reshape(6, -1)
                array.assign(np.where(chosen[:, None], start, values).reshape(array.numpy().shape))
            run.solver.reset(run.states[0], wp.array([*chosen, False], dtype=bool, device=device))
            run.clock.assign(np.where(chosen, 0, run.clock.numpy()))
            for world in np.flatnonzero(chosen):
                run.ends[world] = []
        taken, clock = random.random(6) < 0.8, run.clock.numpy().copy()
        before = run.states[0].particle_q.numpy().copy()
        run.launch(wp.array([*taken, True], dtype=bool, device=device))
        run.clock.assign(np.where(taken, clock + 1, clock))
        run.keep(np.flatnonzero(taken))
        assert not run.solver.report.worlds.newton_steps.numpy()[~taken].any()
        assert np.array_equal(*(x.reshape(6, -1)[~taken] for x in (before, run.states[0].particle_q.numpy())))
        for one, other in zip(run.ends, together.ends, strict=True):
            assert same(one[-1:], other[len(one) - 1 : len(one)] if one else [])
    assert resets > 3


def test_worlds_on_several_cores_of_a_cpu_are_those_on_one(monkeypatch):
    """More threads than cores too, so that they are interrupted anywhere."""
    ends, taken, launches = [], [], wp.Launch.launch
    monkeypatch.setattr(wp.Launch, "launch", lambda command: taken.append(command.kernel.key) or launches(command))
    for threads in (1, 2, 7):
        taken.clear()
        with launch.cores(threads):
            run = Run(range(5), "cpu")
            for _ in range(STEPS):
                run.step()
        ends.append(run.ends)
        on_cores = {key.split("__")[-1] for key in taken} & {"_advance", "prepare_candidates", "solve_worlds"}
        assert len(on_cores) == (3 if threads > 1 else 0)
    for others in ends[1:]:
        for one, other in zip(ends[0], others, strict=True):
            for before, after in zip(one, other, strict=True):
                assert all(np.array_equal(x, y) for x, y in zip(before, after, strict=True))


def test_a_step_after_one_that_was_interrupted_is_as_if_that_had_not_been(monkeypatch):
    run, other = Run(range(3), "cpu"), Run(range(3), "cpu")
    launches = wp.Launch.launch

    def step(of):
        of.solver.step(*of.states, None, None, DT)

    for last in (2, 6, 10, 14, 16, 18, 20):
        taken = []

        def launch_or_stop(command, last=last, taken=taken):
            taken.append(command.kernel.key)
            if taken.count("_advance") == last:
                raise KeyboardInterrupt
            launches(command)

        with monkeypatch.context() as patch, launch.cores(2), pytest.raises(KeyboardInterrupt):
            patch.setattr(wp.Launch, "launch", launch_or_stop)
            step(run)
        for each in (run, other):
            step(each)
            each.states.reverse()
        for name in ARRAYS:
            arrays = (getattr(each.states[0], name).numpy() for each in (run, other))
            assert np.array_equal(*arrays)
