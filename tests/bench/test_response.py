"""Measurements of contact: the measures on states made by hand, and that all scenes run in all configurations."""

from dataclasses import replace
from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from step_forces import forces_of_elastic

from warp_bsc.bench.crossings import CrossingCounter
from warp_bsc.bench.elastic_energy import ElasticEnergy
from warp_bsc.bench.measure.response import (
    CONFIGURATIONS,
    CONVERGED,
    REFERENCE,
    SCENES,
    SEMI_IMPLICIT_STEPS,
    ResponseRun,
    measure_response,
)
from warp_bsc.bench.scenes import contact as response_scenes
from warp_bsc.bench.scenes.contact import NotRunnable, build_scene
from warp_bsc.bench.scenes.simulation import Samples, Simulation, energy_gained, largest_stretch, total_energy
from warp_bsc.implicit.gradients.elastic import Elastic


def run(scene, configuration, *, device, **options):
    found = measure_response(scene, configuration, device=device, **options)
    assert (found.scene, found.configuration, found.problem) == (scene, configuration, None)
    return found


def measure(scene, configuration, **options):
    return SimpleNamespace(**run(scene, configuration, **options).measured)


def test_the_largest_stretch_of_an_edge():
    x = np.array([[0, 0, 0], [3, 0, 0], [0, 2, 0]], dtype=np.float32)
    edges, lengths = np.array([[0, 1], [0, 2]]), np.array([2.0, 4.0])
    assert largest_stretch(x, edges, lengths) == pytest.approx(0.5)
    assert largest_stretch(x, edges[1:], lengths[1:]) == pytest.approx(-0.5)


def test_the_energy_of_masses_in_two_worlds():
    x, v = np.array([[0, 0, 1], [0, 0, 2], [5, 0, -1]]), np.array([[3, 0, 4], [0, 0, 0], [0, 1, 0]])
    gravity = np.array([[0.0, 0.0, -10.0]] * 3)
    found = total_energy(x, v, np.array([2.0, 1.0, 4.0]), gravity, np.array([0, 0, 1]), 2)
    assert found == pytest.approx([2 * 12.5 + 20 + 20, 2 - 40])


def test_energy_is_gained_above_the_least_so_far():
    energy = np.array([[5.0, 1.0], [3.0, 1.0], [4.0, 0.5], [2.0, 3.0], [2.5, 0.0]])
    assert energy_gained(energy) == pytest.approx(2.5)  # of the second world
    assert energy_gained(energy[:, :1]) == pytest.approx(1.0)
    assert energy_gained(energy, [(3, 1)]) == pytest.approx(1.0)
    assert energy_gained(energy, [(0, 1), (3, 1), (4, 0)]) == pytest.approx(1.0)
    assert energy_gained(energy[::-1], [(0, 0)]) == pytest.approx(3.0)


def test_samples_of_a_state(device):
    """A ball of 2 kg that turns, and a spring stretched by a half whose first particle is held."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -10.0))
    for x in (0.0, 1.0):
        builder.add_particle(wp.vec3(x, 0.0, 0.0), wp.vec3(), x)
    builder.add_spring(0, 1, 8.0, 0.0, 0.0)
    inertia = wp.mat33(*np.diag([3.0, 3.0, 3.0]).ravel().tolist())
    builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0)), mass=2.0, inertia=inertia, lock_inertia=True)
    at = wp.transform(wp.vec3(0.0, 0.0, 7.0))
    builder.add_body(xform=at, mass=2.0, inertia=inertia, lock_inertia=True, is_kinematic=True)
    model = builder.finalize(device=device)
    state, samples = model.state(), Samples(model)
    state.particle_q.assign(np.array([[0, 0, 0], [1.5, 0, 0]], dtype=np.float32))
    state.particle_qd.assign(np.array([[9, 0, 0], [0, 2, 0]], dtype=np.float32))
    state.body_qd.assign(np.array([[1, 0, 0, 0, 2, 0], [4, 0, 0, 0, 0, 0]], dtype=np.float32))
    assert samples.add(state)
    assert (samples.stretch, samples.speed) == (pytest.approx([0.5]), pytest.approx([2.0]))
    ball = 2.0 * 10.0 * 1.0 + 0.5 * 2.0 * 1.0 + 0.5 * 3.0 * 4.0
    kinematic = 0.0 if model.body_inv_mass.numpy()[1] == 0.0 else 2.0 * 70.0 + 0.5 * 2.0 * 16.0
    assert samples.energy[0] == pytest.approx([0.5 * 1.0 * 4.0 + 0.5 * 8.0 * 0.25 + ball + kinematic])
    state.particle_q.assign(np.array([[0, 0, 0], [np.nan, 0, 0]], dtype=np.float32))
    assert not samples.add(state)
    assert len(samples.stretch) == 1


def elements(device):
    """In world 0 a spring, a triangle and a tetrahedron, in world 1 two triangles at an edge; all at rest."""
    first, second = newton.ModelBuilder(), newton.ModelBuilder()
    for x in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)] * 2:
        first.add_particle(wp.vec3(*x), wp.vec3(), 1.0)
    first.add_spring(0, 1, 6.0, 0.0, 0.0)
    first.add_triangle(0, 1, 2, tri_ke=3.0, tri_ka=5.0, tri_kd=0.0)
    first.add_tetrahedron(4, 5, 6, 7, k_mu=3.0, k_lambda=5.0, k_damp=0.0)
    for x in [(1, 0, 0), (-1, 0, 0), (0, -1, 0), (0, 1, 0)]:
        second.add_particle(wp.vec3(*x), wp.vec3(), 1.0)
    second.add_edge(0, 1, 2, 3, edge_ke=0.5, edge_kd=0.0)
    scene = newton.ModelBuilder()
    scene.add_world(first)
    scene.add_world(second)
    scene.color()
    return scene.finalize(device=device)


def test_the_elastic_energy_of_elements_by_hand(device):
    """Twice as long along x: of mu, half of its 3 more, less its excess of 1; of lambda + mu, half of 1."""
    model = elements(device)
    energy, x = ElasticEnergy(model), model.particle_q.numpy()
    assert energy.of(x) == pytest.approx([0.0, 0.0], abs=1e-12)
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    assert energy.of(x @ turn.T + (1.0, 2.0, 3.0)) == pytest.approx([0.0, 0.0], abs=1e-12)
    density = 0.5 * 3.0 * 3.0 - 3.0 + 0.5 * 8.0
    stretched = x.copy()
    stretched[1, 0], stretched[5, 0] = 2.0, 2.0
    assert energy.of(stretched) == pytest.approx([0.5 * 6.0 + density / 2.0 + density / 6.0, 0.0])
    bent = x.copy()
    bent[9] = (0.0, 0.0, 1.0)  # by a right angle, along an edge of length 2
    assert energy.of(bent) == pytest.approx([0.0, 0.5 * 0.5 * 2.0 * (0.5 * np.pi) ** 2])


def test_forces_are_minus_the_derivative_of_the_elastic_energy(device):
    """The forces are those by which gradients go through steps of SolverImplicit."""
    model = elements(device)
    energy, x = ElasticEnergy(model), model.particle_q.numpy().astype(np.float64)
    x += np.random.default_rng(4).normal(0.0, 0.1, x.shape)
    at = wp.array(x, dtype=wp.vec3d, device=device)
    forces = forces_of_elastic(Elastic(model, np.arange(len(x)), len(x)), len(x), 1.0, at, at)
    derivative = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[i] = 1e-6
        derivative[i] = (energy.of(x + step).sum() - energy.of(x - step).sum()) / 2e-6
    assert np.abs(derivative).max() > 1.0
    np.testing.assert_allclose(forces, -derivative, atol=1e-6)


def test_no_energy_is_gained_in_flight_nor_by_a_swing(device):
    """Two masses that swing about a centre in free fall, by the closed form of both motions."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -10.0))
    for x in (0.0, 1.0):
        builder.add_particle(wp.vec3(x, 0.0, 0.0), wp.vec3(), 0.5)
    builder.add_spring(0, 1, 100.0, 0.0, 0.0)
    model = builder.finalize(device=device)
    state, samples, rate = model.state(), Samples(model), 20.0  # the square root of twice the stiffness by the mass
    for time in np.linspace(0.0, 0.5, 21):
        place, speed = 0.1 * np.sin(rate * time), 0.1 * rate * np.cos(rate * time)
        height, fall = 3.0 * time - 5.0 * time**2, 3.0 - 10.0 * time
        x, v = [[-place, 0, height], [1 + place, 0, height]], [[-speed, 0, fall], [speed, 0, fall]]
        state.particle_q.assign(np.array(x, dtype=np.float32))
        state.particle_qd.assign(np.array(v, dtype=np.float32))
        assert samples.add(state)
    energy = np.array(samples.energy)
    assert energy == pytest.approx(2 * 0.5 * 0.5 * (9.0 + 4.0), rel=1e-5)
    assert energy_gained(energy) < 1e-4


def test_the_distance_of_runs():
    found = ResponseRun("fold", "vbd", "implicit", measured={"rate": 60})
    at, moved = (replace(found, early=np.array([[0.0, 0.0, z], [1.0, 0.0, 0.0]])) for z in (0.0, 0.004))
    assert at.distance_from(moved) == pytest.approx(2.0)
    other_steps = replace(moved, measured={"rate": 120})
    assert at.distance_from(found) is found.distance_from(at) is at.distance_from(other_steps) is None


def test_no_scene_begins_with_a_crossing(device):
    assert tuple(response_scenes.SCENES) == SCENES
    for name in SCENES:
        with wp.ScopedDevice(device):
            scene = build_scene(name, "vbd")
            state = scene.model.state()
        assert CrossingCounter(scene.model, strands=scene.strands).count(state) == 0, name
        assert 100 < scene.model.tri_count <= 2000, name
        if scene.motion and scene.motion.poses:  # they begin where the model has them
            assert np.allclose(scene.motion.poses(0.0), state.body_q.numpy(), atol=1e-6), name
        if scene.motion and scene.motion.positions:
            held = state.particle_q.numpy()[list(scene.motion.held)]
            assert np.allclose(scene.motion.positions(0.0), held, atol=1e-6), name


@pytest.mark.parametrize("solver", ["xpbd", "style3d", "semi-implicit"])
def test_every_scene_is_built_for_a_solver_or_says_why_not(solver, device):
    missing = set()
    for name in SCENES:
        with wp.ScopedDevice(device):
            try:
                build_scene(name, solver)
            except NotRunnable:
                missing.add(name)
    expected = {
        "xpbd": set(),
        "style3d": {"tube_cone", "soft_bowl", "pile", "press", "press_tight", "ropes", "ball_two_way"},
        "semi-implicit": {"ball", "ball_two_way"},
    }
    assert missing == expected[solver]


@pytest.mark.parametrize("solver", ["vbd", "semi-implicit"])
def test_the_length_of_steps(solver, device):
    options = {"solver": solver, "device": device, "seconds": 0.02, "reference_rate": 1900}
    own = 60 if solver == "vbd" else 60 * SEMI_IMPLICIT_STEPS
    for rate, expected in ((None, own), (240, 240)):
        assert measure("box_edge", "plain", rate=rate, **options).rate == expected
    assert measure("box_edge", REFERENCE, rate=240, **options).rate == max(1900, own)


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_each_configuration_runs(configuration, device):
    frames = []
    options = {"seconds": 0.1, "reference_rate": 120, "progress": lambda *done: frames.append(done)}
    found = measure("box_edge", configuration, device=device, **options)
    rate = 120 if configuration == REFERENCE else 60
    assert (found.rate, found.steps, found.device) == (rate, rate // 10, str(device))
    assert frames == [(step, found.steps) for step in range(0, found.steps + 1, 2)]
    times = found.milliseconds
    assert 0.0 < times["median"] <= times["worst"] and times["mean"] <= times["worst"]
    assert 0.0 <= found.stretch_at_end <= found.stretch_at_most < 30.0
    assert found.rest_speed > 100.0  # it falls
    assert found.energy_gained is not None
    if configuration in ("plain", "self-contact"):
        assert found.uncertified_steps is None
    else:
        assert (found.crossings, found.uncertified_steps) == (0, 0)
        assert found.collisions == (None if configuration == REFERENCE else 0)
    assert found.spread is None


def test_a_program_moves_bodies_and_particles(device):
    """A fast ball takes the cloth with it, which it passes without the stage."""
    ball = measure("ball", "stage", device=device, seconds=0.05)
    assert ball.energy_gained is None
    assert (ball.crossings, ball.collisions, ball.uncertified_steps) == (0, 0, 0)
    assert ball.stretch_at_most > 5.0
    passing = measure("ball", "plain", device=device, seconds=0.05)
    assert passing.stretch_at_most < ball.stretch_at_most
    assert passing.collisions > 10
    assert passing.crossings == 0  # it is beyond the cloth at the end


def test_newton_steps_are_limited_unless_the_run_is_the_converged_one(device, monkeypatch):
    """After as many steps as are compared, here fewer, while cubes meet."""
    monkeypatch.setattr("warp_bsc.bench.measure.response.EARLY_STEPS", 14)
    limited, converged = (run("pile", name, device=device, seconds=14 / 60) for name in ("implicit", CONVERGED))
    assert limited.measured["steps"] == converged.measured["steps"] == 14
    assert [limited.measured[name] for name in ("crossings", "collisions", "uncertified_steps")] == [0, 0, 0]
    assert 1e-2 < limited.distance_from(converged) < 100.0
    assert converged.distance_from(converged) == 0.0


def test_worlds_are_reset(device):
    """They fall for two steps since then, the others for six."""
    with wp.ScopedDevice(device):
        scene = replace(build_scene("worlds", "vbd"), resets={0.05: (2, 5)})
        simulation = Simulation(scene, "vbd", 60, stage_options={})
        assert simulation.run(0.1, lambda *_: None) == 6
    speed = -simulation.states[0].particle_qd.numpy()[:, 2].reshape(8, -1).mean(axis=1)
    assert speed[[2, 5]] == pytest.approx(2 * 9.81 / 60, rel=1e-2)
    assert speed[[3, 4, 6, 7]] == pytest.approx(6 * 9.81 / 60, rel=1e-2)
    samples = simulation.samples
    assert samples.restarts == [(5, 2), (5, 5)]
    falling = np.array(samples.energy)[:, 1:]  # the first has met its sphere
    restarts = [(step, world - 1) for step, world in samples.restarts]
    assert energy_gained(falling, restarts) < 1e-6 and energy_gained(falling) > 1e-3
    assert simulation.stage.report.totals.uncertified_steps == 0


def test_a_small_offset_of_the_start(device):
    frames = []
    options = {"seconds": 0.1, "perturb": 1e-6, "progress": lambda *done: frames.append(done)}
    found = measure("box_edge", "stage", device=device, **options)
    assert found.spread["distance"] == 1e-6
    assert 0.0 <= found.spread["stretch_at_end"] < 1.0
    assert 0.0 <= found.spread["stretch_at_most"] < 1.0
    assert frames[-1] == (12, 12)
    assert measure("box_edge", "plain", device=device, seconds=0.1, perturb=1e-6).spread is None


def test_what_a_solver_cannot_run(device):
    assert measure_response("pile", "stage", solver="style3d", device=device).problem == "Style3D has no tetrahedra"
    run = measure_response("sphere", "self-contact", solver="xpbd", device=device)
    assert (run.measured, run.problem) == (None, "only VBD has contacts between particles of cloth")
    run = measure_response("sphere", "implicit", solver="xpbd", device=device)
    assert (run.measured, run.problem) == (None, "SolverImplicit takes the place of VBD")


def test_the_explicit_solver_takes_small_steps(device):
    found = measure("box_edge", "plain", solver="semi-implicit", device=device, seconds=0.005)
    assert (found.rate, found.steps) == (60 * SEMI_IMPLICIT_STEPS, 10)


def test_positions_that_are_not_finite(device, monkeypatch):
    build = response_scenes.SCENES["box_edge"]

    def build_broken(builder):
        scene = build(builder)
        scene.model.particle_qd.fill_(np.nan)
        return scene

    monkeypatch.setitem(response_scenes.SCENES, "box_edge", build_broken)
    problem = measure_response("box_edge", "plain", device=device, seconds=0.1).problem
    assert problem == "positions are not finite after step 1 of 6"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "cube"}, "scene must be one of sphere, .*, not 'cube'"),
        ({"configuration": "both"}, "configuration must be one of plain, .*, not 'both'"),
        ({"solver": "mpm"}, "solver must be one of vbd, xpbd, style3d, semi-implicit, not 'mpm'"),
        ({"seconds": 0.0}, "seconds must be finite and more than 0, not 0.0"),
        ({"rate": 0}, "rate must be at least 1, not 0"),
        ({"reference_rate": 0}, "reference_rate must be at least 1, not 0"),
        ({"perturb": np.inf}, "perturb must be finite and more than 0, not inf"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        measure_response(**{"scene": "sphere", "configuration": "plain"} | options)
