"""Defaults that gradients can be trusted with: the layer, its thickness, bodies, minimum distances and substeps."""

import newton
import numpy as np
import pytest
import test_contact_layer as layers
import warp as wp
from newton_scenes import Rollout
from test_contact_layer import DT, FREE, SOFT, STEPS, add_square, semi_implicit

import warp_bsc as bsc

THROWS = {"sphere": (-0.1, 0.0, -2.2), "box": (-0.4, 0.3, -2.6), "sheet": (-0.3, 0.4, -2.4)}
LENGTH = 1e-3  # of central differences [m/s]


def throw_by_default(device, target, worlds, monkeypatch, *, steps, dt, **options):
    """Throws behind a stage with default arguments and others; the layer is there as the model has gradients."""
    monkeypatch.setattr(layers, "layered", lambda inner, **physics: bsc.SolverCCD(inner, **physics, **options))
    monkeypatch.setattr(layers, "STEPS", steps)
    monkeypatch.setattr(layers, "DT", dt)
    return layers.Throws(device, target, worlds, requires_grad=True)


OPTIONS = {
    "default": {},
    "substeps": {"substeps": 2},
    "distance": {"min_distance": 0.002},
    "radius": {"particle_radius": 0.001},
}


RUNS = [(target, "default") for target in THROWS]
RUNS += [
    pytest.param(*run, marks=pytest.mark.slow)
    for run in (("sphere", "substeps"), ("sheet", "distance"), ("box", "radius"))
]


@pytest.mark.parametrize("target, options", RUNS)
def test_a_tape_is_within_a_thousandth_of_central_differences(target, options, device, monkeypatch):
    """Of the largest component, in all; within three thousandths in each that is at least a fifth of the largest."""
    velocity, substeps = np.array(THROWS[target], dtype=np.float32), OPTIONS[options].get("substeps", 1)
    changed = velocity + LENGTH * np.concatenate([np.eye(3), -np.eye(3)])
    changed = changed.astype(np.float32).astype(float)
    gradients, thicknesses = [], []
    for worlds in (6, 1):
        arguments = {"steps": STEPS // substeps, "dt": substeps * DT} | OPTIONS[options]
        scene = throw_by_default(device, target, worlds, monkeypatch, **arguments)
        if worlds == 1:
            gradients.append(scene.gradients(velocity))
        else:
            centres = scene.centres(changed)
            lengths = np.diagonal(changed[:3] - changed[3:])
            gradients.append(((centres[:3] - centres[3:]) / lengths[:, None]).T)
        report = scene.solver.report
        assert (
            report.totals.uncertified_steps
            == report.gradient_counts.layer_passed_steps
            == report.gradient_counts.lost_steps
            == 0
        )
        thicknesses.append(report.layer_thickness)
    assert thicknesses[0] == thicknesses[1]
    expected, actual = gradients
    errors, sizes = np.abs(actual - expected), np.abs(expected)
    assert (errors <= 1e-3 * sizes.max()).all(), errors / sizes.max()
    large = sizes >= 0.2 * sizes.max()
    assert (errors <= 3e-3 * sizes)[large].all(), errors / sizes
    assert np.abs(expected - np.eye(3) * STEPS * DT).max() > 0.2 * STEPS * DT  # of a patch that met its target


@pytest.mark.parametrize(
    "height, speed, expected", [(0.02, 0.5, 0.01), (0.02, 4.0, 0.018), (1.0, 0.0, 0.018), (None, 4.0, 0.018)]
)
def test_the_first_step_chooses_the_thickness(height, speed, expected, device):
    """By speeds and by what gravity adds on the way to the ground; a captured first step too, however often it runs."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0) if height is None else (0.0, 0.0, -9.81))
    add_square(builder, 3, 0.04, (0.0, 0.0, height or 0.0), velocity=(0.0, 0.0, -speed), **FREE)
    add_square(builder, 3, 0.04, (0.0, 0.0, (height or 0.0) + 0.3), **FREE)
    if height is not None:
        builder.add_ground_plane()
    model = builder.finalize(device=device)
    for captures in (False, True):
        solver = bsc.SolverCCD(bsc.ContactLayer(semi_implicit(model)))
        assert solver.report.layer_thickness == solver.solver.thickness == pytest.approx(0.01, rel=4e-3)
        states = model.state(), model.state()
        if captures:
            with wp.ScopedCapture(device) as capture:
                solver.step(*states, None, None, DT)
            for _ in range(2):
                wp.capture_launch(capture.graph)
                states[0].particle_qd.zero_()  # slow from then on
        else:
            for _ in range(2):
                solver.step(*states, None, None, DT)
                states[0].particle_qd.zero_()
        assert solver.report.layer_thickness == pytest.approx(expected, rel=4e-3)
    given = bsc.ContactLayer(semi_implicit(model), thickness=0.005)
    given.step(model.state(), model.state(), None, None, DT)
    assert given.thickness == pytest.approx(0.005)


@pytest.mark.parametrize("substeps", [1, 2])
def test_steps_that_pass_the_layer_are_counted(substeps, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_square(builder, 3, 0.04, (0.0, 0.0, 0.06), velocity=(0.0, 0.0, -30.0), **FREE)
    below = wp.transform(wp.vec3(0.0, 0.0, -0.02), wp.quat_identity())
    builder.add_shape_box(-1, xform=below, hx=0.2, hy=0.2, hz=0.02)
    model = builder.finalize(device=device, requires_grad=True)
    solver = bsc.SolverCCD(semi_implicit(model), substeps=substeps)
    rollout = Rollout(solver.model, solver)
    collided, dt = 0, substeps * DT
    with pytest.warns(UserWarning, match="contacts passed the contact layer in one step.* or raise substeps"):
        for _ in range(4):
            rollout.step(dt)
            collided += solver.report.predicted_contacts > 0
    assert solver.report.gradient_counts.layer_passed_steps == collided == 1
    assert "contacts passed the contact layer in 1 steps; contact layer of 17.9 mm" in str(solver.report)


@pytest.mark.parametrize("bodies", ["pushed", "ignored"])
def test_pushes_conserve_the_momentum_of_bodies(bodies, device):
    """Linear momentum; angular momentum to the first order of the step. A body that is left keeps every bit."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_square(builder, 4, 0.03, (0.02, 0.01, 0.04), (1.0, 0.3, 0.0), 0.2, (0.1, 0.2, -1.0), **FREE)
    turned = wp.quat_from_axis_angle(wp.vec3(0.0, 0.6, 0.8), 0.3)
    body = builder.add_body(xform=wp.transform(wp.vec3(), turned))
    builder.add_shape_box(body, hx=0.04, hy=0.05, hz=0.01, cfg=newton.ModelBuilder.ShapeConfig(density=200.0, mu=0.4))
    model = builder.finalize(device=device)
    inner = semi_implicit(model)
    inner.angular_damping = 0.0
    layer = bsc.ContactLayer(inner, friction=0.4, restitution=0.5, thickness=0.012, bodies=bodies)
    solver = bsc.SolverCCD(layer, friction=0.4, restitution=0.5, bodies=bodies)
    rollout = Rollout(model, solver)
    first = rollout.states[0].body_q.numpy().copy(), rollout.states[0].body_qd.numpy().copy()

    def momenta(state):
        mass = model.particle_mass.numpy().astype(float)[:, None]
        x, v = state.particle_q.numpy().astype(float), state.particle_qd.numpy().astype(float)
        pose, twist = state.body_q.numpy()[0], state.body_qd.numpy()[0].astype(float)
        rotation = np.array(wp.quat_to_matrix(wp.quat(*pose[3:].tolist()))).reshape(3, 3).astype(float)
        inertia = rotation @ model.body_inertia.numpy()[0].astype(float) @ rotation.T
        of_body = model.body_mass.numpy()[0] * twist[:3]
        angular = (mass * np.cross(x, v)).sum(axis=0) + np.cross(pose[:3], of_body) + inertia @ twist[3:]
        return (mass * v).sum(axis=0) + of_body, angular

    start = momenta(rollout.states[0])
    for _ in range(40):
        rollout.step(DT)
        assert solver.report.certified and (solver.report.predicted_contacts == 0 or bodies == "ignored")
    ends = rollout.states[0].body_q.numpy(), rollout.states[0].body_qd.numpy()
    if bodies == "ignored":
        for end, values in zip(ends, first, strict=True):
            np.testing.assert_array_equal(end, values)
        return
    assert np.abs(ends[1]).max() > 0.05
    for axis, (after, before) in enumerate(zip(momenta(rollout.states[0]), start, strict=True)):
        size = np.linalg.norm(start[0]) * (1.0, 0.06)[axis]
        np.testing.assert_allclose(after, before, atol=(1e-5, 0.03)[axis] * size)


def test_forces_of_the_program_act_in_all_substeps(device):
    """With their gradients: as in two steps in which the program sets them itself."""
    results = []
    for substeps in (1, 2):
        builder = newton.ModelBuilder()
        add_square(builder, 3, 0.04, (0.0, 0.0, 0.013), velocity=(0.3, 0.0, -1.0), **SOFT)
        builder.add_ground_plane()
        model = builder.finalize(device=device, requires_grad=True)
        solver = bsc.SolverCCD(semi_implicit(model), friction=0.3, restitution=0.2, substeps=substeps)
        force = wp.full(model.particle_count, wp.vec3(0.002, 0.001, -0.003), dtype=wp.vec3, device=device)
        states = [model.state() for _ in range(3 if substeps == 1 else 2)]
        for state in states:
            state.clear_forces()
            state.particle_f.assign(force)
        with wp.Tape() as tape:
            for i in range(len(states) - 1):
                solver.step(states[i], states[i + 1], None, None, 2.0 * DT / (len(states) - 1))
        states[-1].particle_q.grad.fill_(wp.vec3(1.0, 2.0, 3.0))
        tape.backward()
        of_force = sum(state.particle_f.grad.numpy() for state in states[:-1])
        of_start = [states[0].particle_q.grad.numpy(), states[0].particle_qd.grad.numpy()]
        results.append([states[-1].particle_q.numpy(), states[-1].particle_qd.numpy(), of_force, *of_start])
    for alone, in_substeps in zip(*results, strict=True):
        np.testing.assert_allclose(in_substeps, alone, rtol=1e-5, atol=1e-7 * np.abs(alone).max())
    assert np.abs(results[0][2]).max() > 0.0


@pytest.mark.parametrize("requires_grad", [False, True])
def test_substeps_behind_a_layer_are_steps_of_their_own(requires_grad, device):
    """The same as that many steps, bit for bit, also if the state at the end is that at the start."""
    ends = []
    for substeps in (1, 3):
        builder = newton.ModelBuilder()
        add_square(builder, 3, 0.04, (0.0, 0.0, 0.013), velocity=(0.3, 0.0, -1.0), **SOFT)
        builder.add_ground_plane()
        model = builder.finalize(device=device, requires_grad=requires_grad)
        solver = bsc.SolverCCD(bsc.ContactLayer(semi_implicit(model)), substeps=substeps)
        state = model.state()
        for _ in range(12 if substeps == 1 else 4):
            state.clear_forces()
            solver.step(state, state, None, None, 3.0 * DT if substeps > 1 else 3.0 * DT / 3)
        assert solver.report.totals.steps == (12 if substeps == 1 else 4)
        ends.append([state.particle_q.numpy(), state.particle_qd.numpy()])
    for alone, in_substeps in zip(*ends, strict=True):
        np.testing.assert_array_equal(in_substeps, alone)
    if requires_grad:
        with wp.Tape(), pytest.raises(ValueError, match="on a tape, state_out must not be state_in"):
            solver.step(state, state, None, None, DT)
