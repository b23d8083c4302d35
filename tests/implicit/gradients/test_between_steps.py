"""Gradients of kinematic particles and bodies that a program moves between the steps of a tape."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from gradient_reference import ReferenceSteps
from gradient_scenes import DT

import warp_bsc as bsc
from warp_bsc._private_names.of_warp import paused_tape

WAY = np.array([0.004, 0.002, 0.003])  # of what is held, from a step to the next [m]
STEPS = 3


def held_cloth(device):
    """A cloth that one side holds."""
    builder = newton.ModelBuilder()
    cells = {"dim_x": 3, "dim_y": 3, "cell_x": 0.05, "cell_y": 0.05, "mass": 0.002, "particle_radius": 0.02}
    material = {"tri_ke": 80.0, "tri_ka": 60.0, "tri_kd": 5e-3, "edge_ke": 2e-3, "edge_kd": 1e-4}
    at, flat = wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()
    builder.add_cloth_grid(pos=at, rot=flat, vel=wp.vec3(), fix_left=True, **cells, **material)
    builder.color()
    return builder.finalize(device=device, requires_grad=True)


@wp.kernel
def place(held: wp.array[int], first: wp.array[wp.vec3], way: wp.array[wp.vec3], k: float, x: wp.array[wp.vec3]):
    i = wp.tid()
    x[held[i]] = first[held[i]] + k * way[0]


@wp.kernel
def shift(held: wp.array[int], way: wp.array[wp.vec3], x: wp.array[wp.vec3]):
    x[held[wp.tid()]] += way[0]


@wp.kernel
def add_heights(x: wp.array[wp.vec3], first: int, total: wp.array[float]):
    wp.atomic_add(total, 0, x[first + wp.tid()][2])


def write_outside(scene, state, k):
    """Places what is held where it is after k steps; no tape sees it."""
    values, first = state.particle_q.numpy().copy(), scene.model.particle_q.numpy()
    values[scene.held] = first[scene.held] + np.float32(k * scene.way.numpy()[0])
    with paused_tape():
        state.particle_q.assign(values)


def write_on_tape(scene, state, k):
    inputs = [scene.index, scene.model.particle_q, scene.way, float(k)]
    wp.launch(place, len(scene.held), inputs=inputs, outputs=[state.particle_q], device=scene.model.device)


def shift_on_tape(scene, state, k):
    inputs = [scene.index, scene.way, state.particle_q]
    wp.launch(shift, len(scene.held), inputs=inputs, device=scene.model.device)


def copy_on_tape(scene, state, k):
    """Writes to another array, and copies that."""
    moved = wp.empty_like(state.particle_q, requires_grad=True)
    wp.copy(moved, state.particle_q)
    inputs = [scene.index, scene.model.particle_q, scene.way, float(k)]
    wp.launch(place, len(scene.held), inputs=inputs, outputs=[moved], device=scene.model.device)
    wp.copy(state.particle_q, moved)


class Scene:
    """Steps of a cloth; a function moves what is held of it before each step but the first.

    They are solved in float64 where ``is_exact``: the solver ends them where differences are too rough.
    """

    def __init__(self, device, move=write_outside, *, is_exact=True):
        model = self.model = held_cloth(device)
        self.solver, self.move = bsc.SolverImplicit(model), move
        self.reference = ReferenceSteps(self.solver) if is_exact else None
        n = model.particle_count
        self.held = np.flatnonzero(model.particle_inv_mass.numpy() == 0.0)
        self.index = wp.array(self.held, dtype=int, device=device)
        self.way = wp.array([WAY], dtype=wp.vec3, device=device, requires_grad=True)
        self.weights = np.random.default_rng(3).normal(size=(n, 3)) / n
        self.weights[model.particle_inv_mass.numpy() == 0.0] = 0.0

    def run(self, way=WAY, start=0.0):
        first = self.model.particle_q.numpy().copy()
        first[self.held] += np.float32(start)
        with paused_tape():
            self.way.assign(np.float32([way]))
            self.states = [self.model.state() for _ in range(STEPS + 1)]
            self.solver.reset(self.states[0])
            self.states[0].particle_q.assign(first)
            if self.reference is not None:
                self.reference.begin(None, first, self.model.particle_qd.numpy())
        self.take_steps(self.states)

    def take_steps(self, states):
        for k, (begin, end) in enumerate(itertools.pairwise(states)):
            if k:
                self.move(self, begin, k)
            self.solver.step(begin, end, None, None, DT)

    def backward(self):
        with wp.Tape() as tape:
            self.run()
        seed = wp.array(self.weights, dtype=wp.vec3, device=self.model.device)
        tape.backward(grads={self.states[-1].particle_q: seed})
        return [state.particle_q.grad.numpy()[self.held].sum(axis=0) for state in self.states]

    def assert_gradient(self, gradient, name, value):
        """The gradient by a vector that is an argument of :meth:`run` is that of central differences, along a line."""
        direction, h, losses = np.array([0.6, 0.7, -0.4]), 1e-4, []
        for change in (h * direction, -h * direction):
            with wp.Tape():
                self.run(**{name: value + change})
            end = self.states[-1].particle_q.numpy() if self.reference is None else self.reference.x
            losses.append((self.weights * end.astype(float)).sum())
        assert gradient @ direction == pytest.approx((losses[0] - losses[1]) / (2.0 * h), rel=0.01)


def test_what_a_program_writes_gets_the_gradient_in_its_array(device):
    scene = Scene(device)
    of_states = scene.backward()
    scene.assert_gradient(sum(k * of_states[k] for k in range(1, STEPS)), "way", WAY)
    scene.assert_gradient(of_states[0], "start", 0.0)


@pytest.mark.parametrize("move", [write_on_tape, shift_on_tape, copy_on_tape])
def test_what_the_tape_moves_it_differentiates(move, device):
    scene = Scene(device, move)
    of_states = scene.backward()
    scene.assert_gradient(scene.way.grad.numpy()[0], "way", WAY)
    scene.assert_gradient(of_states[0], "start", 0.0)


def stay(scene, state, k):
    """Moves nothing."""


def test_at_rest_gradients_go_on_and_are_not_known_between_steps(device):
    scene = Scene(device, stay)
    of_states = scene.backward()
    scene.assert_gradient(of_states[0], "start", 0.0)
    assert np.isnan(of_states[1:STEPS]).all()  # a program may have written the same positions
    assert scene.solver.report.gradient_counts.ambiguous_moves == 0


def test_a_loss_between_steps_may_be_of_either_position(device):
    """It reads what the program moves before the next step, or has moved already."""
    scene, total = Scene(device, is_exact=False), wp.zeros(1, dtype=float, device=device, requires_grad=True)

    def move(scene, state, k):
        inputs = [state.particle_q, int(scene.held[0]), total]
        wp.launch(add_heights, 1, inputs=inputs, device=device)
        write_outside(scene, state, k)

    scene.move = move
    with wp.Tape() as tape:
        scene.run()
    free = np.setdiff1d(np.arange(scene.model.particle_count), scene.held)
    with pytest.warns(UserWarning, match="kinematic particles or bodies were moved between steps on a tape"):
        tape.backward(total)
        assert scene.solver.report.gradient_counts.ambiguous_moves == 1  # the second step passes it on to the first
    first, second = (scene.states[k].particle_q.grad.numpy() for k in (0, 1))
    for gradient in (first, second):
        assert np.isnan(gradient[scene.held[0]]).all()
        assert np.isfinite(gradient[scene.held[1:]]).all()
        assert np.isfinite(gradient[free]).all()


def test_two_states_that_take_turns_have_no_array_for_each_gradient(device):
    scene = Scene(device, is_exact=False)
    states = [scene.model.state() for _ in range(2)]
    with wp.Tape() as tape:
        for k in range(STEPS):
            begin, end = states[k % 2], states[(k + 1) % 2]
            if k:
                write_outside(scene, begin, k)
            scene.solver.step(begin, end, None, None, DT)
    seed = wp.array(scene.weights, dtype=wp.vec3, device=device)
    tape.backward(grads={states[STEPS % 2].particle_q: seed})
    assert np.isnan(states[0].particle_q.grad.numpy()[scene.held]).all()
    assert scene.solver.report.gradient_counts.ambiguous_moves == len(scene.held)


def test_in_a_graph_as_without(device):
    def move(scene, state, k):
        with paused_tape():
            write_on_tape(scene, state, k)

    scene = Scene(device, move, is_exact=False)
    scene.backward()  # contacts come in another order in the first run of a solver
    expected, states = scene.backward(), [scene.model.state() for _ in range(STEPS + 1)]
    scene.solver.reset(states[0])
    seed = wp.array(scene.weights, dtype=wp.vec3, device=device)
    with wp.ScopedCapture(device) as capture:
        with wp.Tape() as tape:
            scene.take_steps(states)
        tape.backward(grads={states[-1].particle_q: seed})
    for _ in range(2):
        states[0].assign(scene.model.state())
        tape.zero()
        states[-1].particle_q.grad.assign(seed)
        wp.capture_launch(capture.graph)
        for state, gradient in zip(states, expected, strict=True):
            np.testing.assert_array_equal(state.particle_q.grad.numpy()[scene.held].sum(axis=0), gradient)
