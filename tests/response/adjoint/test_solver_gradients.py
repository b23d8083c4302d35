"""Gradients through the collision stage: against central differences, flagged where they are of no use, and lasting."""

import gc
import itertools
import weakref

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import Still, add_square

import warp_bsc as bsc
from warp_bsc.response.adjoint.adjoint import RecordedStep, StepAdjoint
from warp_bsc.response.state.record import StepRecorder

DT = 1.0 / 600.0
STEPS = 40
SOFT = {"tri_ke": 50.0, "tri_ka": 50.0, "tri_kd": 5e-2, "edge_ke": 1e-2, "edge_kd": 1e-3, "particle_radius": 0.005}
OBLIQUE = np.array([1.0, 0.6, 0.8], dtype=np.float32)
"""Direction in which the final centre is looked at, so that no component of the gradient is small."""
THROW = np.array([0.7, 0.3, -2.0], dtype=np.float32)


@wp.kernel
def throw(velocity: wp.array[wp.vec3], thrown: int, rest: wp.array[wp.vec3], particle_qd: wp.array[wp.vec3]):
    particle = wp.tid()
    if particle < thrown:
        particle_qd[particle] = velocity[0]
    else:
        particle_qd[particle] = rest[particle]


@wp.kernel
def add_to_centre(particle_q: wp.array[wp.vec3], thrown: int, direction: wp.vec3, centre: wp.array[float]):
    wp.atomic_add(centre, 0, wp.dot(particle_q[wp.tid()], direction) / float(thrown))


class Throw:
    """A small patch of cloth is thrown at a tilted sheet that is held."""

    def __init__(self, device, *, steps=STEPS, projections=40, requires_grad=True, **options):
        builder = newton.ModelBuilder()
        add_square(builder, 2, 0.03, (0.25, 0.0, -0.0025), (0.6190, -0.7751, 0.1268), 0.5911, **SOFT)
        self.thrown = builder.particle_count
        held = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
        add_square(builder, 1, 1.0, (0.0, 0.0, 0.0), (1.0, 0.4, 0.0), 0.25, **held, **SOFT)
        self.model = model = builder.finalize(device=device, requires_grad=requires_grad)
        model.particle_ke = model.particle_kd = model.particle_kf = 0.0
        model.particle_grid = None
        inner = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        self.solver = bsc.SolverCCD(inner, contact_layer=False, max_iterations=projections, **options)
        self.states = [model.state() for _ in range(steps + 1)]
        self.control = model.control()
        self.velocity = wp.zeros(1, dtype=wp.vec3, device=device, requires_grad=requires_grad)
        self.centre = wp.zeros(1, dtype=float, device=device, requires_grad=requires_grad)
        self.hits = 0

    def forward(self):
        model, states = self.model, self.states
        states[0].particle_q.assign(model.particle_q)
        inputs, outputs = [self.velocity, self.thrown, model.particle_qd], [states[0].particle_qd]
        wp.launch(throw, model.particle_count, inputs=inputs, outputs=outputs, device=model.device)
        for start, end in itertools.pairwise(states):
            start.clear_forces()
            self.solver.step(start, end, self.control, None, DT)
            if not model.device.is_capturing:
                self.hits += self.solver.report.predicted_contacts
        self.centre.zero_()
        inputs, outputs = [states[-1].particle_q, self.thrown, wp.vec3(*OBLIQUE)], [self.centre]
        wp.launch(add_to_centre, self.thrown, inputs=inputs, outputs=outputs, device=model.device)

    def backward(self):
        tape = wp.Tape()
        with tape:
            self.forward()
        tape.backward(self.centre)
        return tape

    def gradient(self, velocity):
        self.velocity.assign(velocity[None])
        tape = self.backward()
        gradient = self.velocity.grad.numpy()[0].copy()
        tape.zero()
        return gradient

    def centre_of(self, velocity):
        self.velocity.assign(velocity[None])
        self.forward()
        positions = self.states[-1].particle_q.numpy()[: self.thrown].astype(float)
        return positions.mean(axis=0) @ OBLIQUE


CASES = {
    "projection": {"friction": 0.0, "restitution": 0.0},
    "friction": {"friction": 0.3, "restitution": 0.0},
    "restitution": {"friction": 0.3, "restitution": 0.5},
    "truncation": {"friction": 0.0, "restitution": 0.0, "projections": 0},
}


@pytest.mark.parametrize("case", CASES)
def test_gradient_of_a_rollout_is_that_of_central_differences(case, device):
    scene = Throw(device, **CASES[case])
    gradient = scene.gradient(THROW)
    assert scene.hits >= 10
    assert (scene.solver.report.totals.truncated_steps > 0) == (case == "truncation")
    assert scene.solver.report.totals.uncertified_steps == 0
    h = 3e-3
    central = [
        (
            scene.centre_of((THROW + h * axis).astype(np.float32))
            - scene.centre_of((THROW - h * axis).astype(np.float32))
        )
        / (2.0 * h)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(gradient, central, rtol=0.01)


def test_tape_does_not_change_what_a_step_does(device):
    scene = Throw(device, friction=0.3, steps=10)
    scene.velocity.assign(THROW[None])
    scene.forward()
    untaped = [state.particle_q.numpy().copy() for state in scene.states]
    scene.backward()
    for state, expected in zip(scene.states, untaped, strict=True):
        np.testing.assert_array_equal(state.particle_q.numpy(), expected)


def crossing_triangles():
    """Two free triangles, whose edges cross, at the start and where they want to be."""
    start = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.4, -0.5, 0.02), (0.5, 0.4, 0.03), (0.9, -0.4, 0.5)]
    wanted = np.array(start) + np.outer([0, 0, 0, 1, 1, 1], (0.02, 0.01, -0.06))
    return [*range(6)], start, wanted


def vertex_in_face():
    """Two free triangles, one of which sticks a corner through the other."""
    start = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.3, 0.3, 0.1), (0.8, 0.9, 0.5), (-0.2, 0.6, 0.6)]
    wanted = np.array(start) + np.outer([0, 0, 0, 1, 1, 1], (0.002, 0.001, -0.17))
    return [*range(6)], start, wanted


def on_the_ground():
    """A triangle that slides into the ground."""
    start = [(0.0, 0.0, 0.02), (1.0, 0.1, 0.06), (0.2, 0.9, 0.04)]
    wanted = np.array(start) + np.array([(0.03, 0.01, -0.05), (0.02, 0.02, -0.04), (0.03, 0.0, -0.07)])
    return [*range(3)], start, wanted


@pytest.mark.parametrize("projections", [40, 0])
@pytest.mark.parametrize("friction, restitution", [(0.0, 0.0), (0.3, 0.5)])
@pytest.mark.parametrize("motion", [crossing_triangles, vertex_in_face, on_the_ground])
def test_gradient_of_a_step_is_that_of_central_differences(motion, friction, restitution, projections, device):
    indices, start, wanted = motion()
    builder = newton.ModelBuilder()
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*vertex) for vertex in start],
        indices=indices,
        density=1.0,
    )
    if motion is on_the_ground:
        builder.add_ground_plane()
    model = builder.finalize(device=device, requires_grad=True)
    options = {"friction": friction, "restitution": restitution, "max_iterations": projections}
    solver = bsc.SolverCCD(Still(model), contact_layer=False, **options)
    random = np.random.default_rng(0)
    n, dt = len(start), 0.01
    first = [np.array(start), wanted, (wanted - start) / dt + random.normal(scale=0.1, size=(n, 3))]
    first = [values.astype(np.float32).astype(float) for values in first]
    states = model.state(), model.state()
    arrays = states[0].particle_q, states[1].particle_q, states[1].particle_qd

    def end(values):
        for array, value in zip(arrays, values, strict=True):
            array.assign(value.astype(np.float32))
        solver.step(*states, None, None, dt)
        return [states[1].particle_q.numpy().astype(float), states[1].particle_qd.numpy().astype(float)]

    moved = end(first)[0]
    assert np.abs(moved - wanted).max() > 1e-3
    assert (solver.report.truncated > 0) == (projections == 0)
    for _ in range(3):
        cotangents = [random.normal(size=(n, 3)), dt * random.normal(size=(n, 3))]
        for array, value in zip(arrays, first, strict=True):
            array.assign(value.astype(np.float32))
        tape = wp.Tape()
        with tape:
            solver.step(*states, None, None, dt)
        arrays[0].grad.zero_()
        for array, cotangent in zip(arrays[1:], cotangents, strict=True):
            array.grad.assign(cotangent.astype(np.float32))
        tape.backward()
        gradients = [array.grad.numpy().astype(float) for array in arrays]
        # steps of single precision, which a difference of single precision is exact for
        for which, h in ((0, 2.0**-14), (1, 2.0**-14), (2, 2.0**-7)):
            direction = random.integers(-2, 3, size=(n, 3))
            sides = []
            for sign in (1.0, -1.0):
                values = [value.copy() for value in first]
                values[which] += sign * h * direction
                sides.append(sum((e * c).sum() for e, c in zip(end(values), cotangents, strict=True)))
            expected = (sides[0] - sides[1]) / (2.0 * h)
            scale = np.linalg.norm(gradients[which]) + 1e-3
            np.testing.assert_allclose((gradients[which] * direction).sum(), expected, rtol=2e-3, atol=5e-3 * scale)


def test_velocities_of_what_is_gripped_have_the_gradient_of_central_differences(device):
    """Of a triangle between two fixed ones, nearer than it may be: pushes that move nothing allow the friction."""
    start = [(-2, -1.5, -0.0092), (2.5, -1.4, -0.0093), (0.1, 2.8, -0.0094), (-1.9, 1.6, 0.0095), (2.2, 1.7, 0.0092)]
    start += [(0.2, -2.6, 0.0093), (0.0, 0.0, 0.0003), (0.5, 0.06, 0.0), (0.1, 0.4, -0.0002)]
    builder = newton.ModelBuilder()
    at = {"pos": wp.vec3(), "rot": wp.quat_identity(), "vel": wp.vec3(), "scale": 1.0, "density": 1.0}
    builder.add_cloth_mesh(vertices=[wp.vec3(*vertex) for vertex in start], indices=[*range(9)], **at)
    builder.particle_mass[:6] = 6 * [0.0]
    model = builder.finalize(device=device, requires_grad=True)
    friction = wp.array([0.001], dtype=float, device=device, requires_grad=True)
    solver = bsc.SolverCCD(Still(model), contact_layer=False, friction=friction, restitution=0.0, min_distance=0.01)
    random, (state, end), dt = np.random.default_rng(5), (model.state() for _ in range(2)), 0.01
    wanted, cotangent = state.particle_q.numpy().astype(float), np.zeros((9, 3))
    wanted[6:] += [(0.01, 0.002, 1e-4), (0.012, 0.004, -1e-4), (0.009, 0.003, 2e-4)]
    velocity = (wanted - state.particle_q.numpy()) / dt
    cotangent[6:] = random.normal(size=(3, 3))

    def step(coefficient, change=0.0):
        friction.assign(np.float32([coefficient]))
        end.particle_q.assign(wanted.astype(np.float32))
        end.particle_qd.assign((velocity + change).astype(np.float32))
        solver.step(state, end, None, None, dt)
        return (end.particle_qd.numpy()[6:] * cotangent[6:]).sum(), end.particle_qd.numpy()[6:]

    _, held = step(0.001)
    assert np.abs(held).max() < 0.2 and np.abs(velocity[6:]).max() > 1.0  # it does not move
    with wp.Tape() as tape:
        step(0.001)
    friction.grad.zero_()
    end.particle_qd.grad.assign(cotangent.astype(np.float32))
    tape.backward()
    direction = np.zeros((9, 3))
    direction[6:] = random.normal(size=(3, 3))
    for found, unit, along in (
        (friction.grad.numpy()[0], 1.0, 0.0),
        ((end.particle_qd.grad.numpy() * direction).sum(), 0.0, direction),
    ):
        central = []  # results jump where the active set changes: by the best of several lengths
        for exponent in range(8, 13):
            h = 2.0**-exponent * (0.001 if unit else 1.0)
            ends = [step(0.001 + sign * h * unit, sign * h * along)[0] for sign in (1.0, -1.0)]
            central.append((ends[0] - ends[1]) / (2.0 * h))
        assert np.abs(found / np.array(central) - 1.0).min() < 2e-3, central


def test_grazing_contacts_are_flagged_and_gradients_finite(device):
    """A triangle glides over another at a slope of a thousandth of a degree."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    start = [(-5, -5, 0), (5, -5, 0), (0, 5, 0), (0.0, 0.0, 1e-6), (0.1, 0.0, 0.1), (0.0, 0.1, 0.1)]
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*vertex) for vertex in start],
        indices=[*range(6)],
        density=1.0,
    )
    model = builder.finalize(device=device, requires_grad=True)
    solver = bsc.SolverCCD(Still(model))
    states = model.state(), model.state()
    positions = states[1].particle_q.numpy()
    positions[3:] += np.array((0.5, 0.0, -1e-5), dtype=np.float32)
    states[1].particle_q.assign(positions)
    with wp.Tape() as tape:
        solver.step(*states, None, None, 0.01)
    assert solver.report.predicted_contacts > 0
    assert solver.report.gradient_counts.grazing > 0
    assert "grazing" in str(solver.report)
    states[1].particle_q.grad.fill_(1.0)
    states[1].particle_qd.grad.fill_(1.0)
    tape.backward()
    for array in (states[0].particle_q, states[1].particle_q, states[1].particle_qd):
        assert np.isfinite(array.grad.numpy()).all()
        assert np.abs(array.grad.numpy()).max() < 1e6


@pytest.mark.slow
def test_many_tape_iterations_take_no_more_memory(device):
    resource = pytest.importorskip("resource")  # of POSIX
    scene = Throw(device, friction=0.3, steps=1)
    down = np.array((0.0, 0.0, -9.0), dtype=np.float32)

    def used():
        if wp.get_device(device).is_cuda:
            return wp.get_mempool_used_mem_current(device)
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    for i in range(120):
        scene.gradient(down)
        if i == 60:
            before = used()
    assert scene.hits > 120
    assert used() - before < 2**19


def test_a_record_that_grows_keeps_the_arrays_that_a_graph_may_write_to(device):
    recorder = StepRecorder(wp.get_device(device), max_sweeps=4)
    kept = []
    for more in (4, 40):
        recorder.reserve("entries", more)
        kept.append(weakref.ref(recorder.record.multiplier))
    gc.collect()
    assert kept[0]() is not None and len(kept[0]()) < len(kept[1]())


def test_state_at_the_start_must_be_kept(device):
    scene = Throw(device, steps=1)
    with wp.Tape(), pytest.raises(ValueError, match="state_out must not be state_in"):
        scene.solver.step(scene.states[0], scene.states[0], scene.control, None, DT)


def test_without_requires_grad_a_tape_stays_empty_of_the_stage(device):
    scene = Throw(device, steps=3, requires_grad=False)
    recorded = []
    for stage in (scene.solver, scene.solver.solver):
        with wp.Tape() as tape:
            scene.states[0].particle_q.assign(scene.model.particle_q)
            stage.step(scene.states[0], scene.states[1], scene.control, None, DT)
        recorded.append(len(tape.launches))
    assert recorded[0] == recorded[1]


def test_gradient_in_a_cuda_graph(device):
    if not wp.get_device(device).is_cuda:
        pytest.skip("a CUDA graph needs a GPU")
    table = wp.array([[0.3]], dtype=float, device=device, requires_grad=True)
    scene = Throw(device, friction=bsc.FrictionTable(table))
    scene.velocity.assign(THROW[None])
    tape = scene.backward()
    eager = scene.velocity.grad.numpy()[0].copy(), table.grad.numpy()[0, 0].copy()
    tape.zero()
    with wp.ScopedCapture(device) as capture:
        tape = scene.backward()
    for _ in range(2):
        scene.velocity.grad.zero_()
        tape.zero()
        wp.capture_launch(capture.graph)
        np.testing.assert_allclose(scene.velocity.grad.numpy()[0], eager[0], rtol=1e-4)
        np.testing.assert_allclose(table.grad.numpy()[0, 0], eager[1], rtol=1e-4)
    assert scene.solver.report.gradient_counts.lost_steps == 0


def test_an_incomplete_record_gives_nan(device):
    """As in a CUDA graph whose buffers are too small."""
    table = wp.array([[0.3]], dtype=float, device=device, requires_grad=True)
    scene = Throw(device, friction=bsc.FrictionTable(table), steps=1)
    scene.velocity.assign(np.float32([[0.0, 0.0, -9.0]]))
    scene.backward()
    table.grad.zero_()
    solver = scene.solver
    work = solver.work
    recorded = RecordedStep(work, DT)
    arrays = [wp.zeros(scene.model.particle_count, dtype=wp.vec3, device=device) for _ in range(3)]
    StepAdjoint(recorded).backward(*arrays)
    assert all(np.isfinite(array.numpy()).all() for array in [*arrays, table.grad])
    recorded.counts.complete.zero_()
    for name in ("constraint", "multiplier", "previous_multiplier", "momentum"):  # nothing may be read out of bounds
        setattr(recorded.restored.record, name, getattr(recorded.restored.record, name)[:1])
    StepAdjoint(recorded).backward(*arrays)
    assert all(np.isnan(array.numpy()).all() for array in [*arrays, table.grad])
