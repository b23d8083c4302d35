"""Steps that a tape takes again on its way back have the gradients, the norms and the totals of steps that it keeps."""

import contextlib
import gc
import itertools
import weakref

import newton
import numpy as np
import pytest
import warp as wp
from gradient_scenes import DT, TILT, add_cloth

import warp_bsc as bsc
from warp_bsc._private_names.of_warp import paused_tape
from warp_bsc.implicit.gradients.step_gradients import RecordedStep

STEPS = 5
WAY = 0.003, 0.001, 0.002  # of what moves, from a step to the next [m]
ROUNDING = 1e-5
"""Largest deviation, relative to the largest component: contacts may come in another order."""


@wp.kernel
def push(forces: wp.array2d[wp.vec3], k: int, particle_f: wp.array[wp.vec3]):
    i = wp.tid()
    wp.atomic_add(particle_f, i, forces[k, i])


@wp.kernel
def shift_particles(held: wp.array[int], way: wp.array[wp.vec3], x: wp.array[wp.vec3]):
    x[held[wp.tid()]] += way[0]


@wp.kernel
def shift_body(way: wp.array[wp.vec3], poses: wp.array[wp.transform]):
    pose = poses[0]
    poses[0] = wp.transform(wp.transform_get_translation(pose) + way[0], wp.transform_get_rotation(pose))


@wp.kernel
def add_loss(x: wp.array[wp.vec3], weights: wp.array[wp.vec3], k: int, loss: wp.array[float]):
    i = wp.tid()
    wp.atomic_add(loss, 0, float(k + 1) * wp.dot(x[i], weights[i]))


class Scene:
    """Steps of a scene, a loss of all their ends, and its gradients with respect to all inputs by name."""

    def __init__(self, builder, device, *, on_tape=True):
        """Finalizes a builder; what a program moves, it moves on the tape or outside."""
        builder.color()
        model = self.model = builder.finalize(device=device, requires_grad=True)
        names = "particle_inv_mass", "gravity", "tri_materials", "shape_material_mu"
        self.arrays = {name: getattr(model, name) for name in names if len(getattr(model, name))}
        for array in self.arrays.values():
            array.requires_grad = True
        self.solver, self.on_tape = bsc.SolverImplicit(model, max_iterations=60, friction=0.3), on_tape
        rng, n = np.random.default_rng(3), model.particle_count
        weights, is_held = rng.normal(size=(n, 3)) / n, model.particle_inv_mass.numpy() == 0.0
        weights[is_held] *= on_tape  # else the loss may be of what is held before it is moved, or after
        self.weights = wp.array(weights, dtype=wp.vec3, device=device)
        self.held = wp.array(np.flatnonzero(is_held), dtype=int, device=device)
        self.moves_body = model.body_count and not model.body_inv_mass.numpy().any()

        def input_of(values):
            return wp.array(values, dtype=wp.vec3, device=device, requires_grad=True)

        self.arrays["forces"] = input_of(1e-3 * rng.normal(size=(STEPS, n, 3)))
        self.arrays["way"] = input_of([WAY])
        self.loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)

    def step(self, k, start, end):
        n, arrays, device = self.model.particle_count, self.arrays, self.model.device
        wp.launch(push, n, inputs=[arrays["forces"], k], outputs=[start.particle_f], device=device)
        if k:
            with contextlib.nullcontext() if self.on_tape else paused_tape():
                if len(self.held):
                    inputs = [self.held, arrays["way"]]
                    wp.launch(shift_particles, len(self.held), inputs=inputs, outputs=[start.particle_q], device=device)
                if self.moves_body:
                    wp.launch(shift_body, 1, inputs=[arrays["way"]], outputs=[start.body_q], device=device)
        self.solver.step(start, end, None, None, DT)
        wp.launch(add_loss, n, inputs=[end.particle_q, self.weights, k], outputs=[self.loss], device=device)

    def begin(self, count):
        states = [self.model.state() for _ in range(count)]
        self.solver.reset(states[0])
        self.loss.zero_()
        for array in self.arrays.values():
            array.grad.zero_()
        return states

    def gradients(self, every=None, *, first=0, last=STEPS):
        """Returns all gradients, of steps that are recorded one by one but for those from ``first`` to ``last``."""
        states = self.begin(STEPS + 1)
        with wp.Tape() as tape:
            for k, (start, end) in enumerate(itertools.pairwise(states)):
                if every is None or not first <= k < last:
                    self.step(k, start, end)
                elif k == first:
                    step, outputs = (lambda i, *ends: self.step(first + i, *ends)), [self.loss]
                    ends = start, states[last]
                    bsc.checkpointed(self.solver, step, *ends, last - first, every=every, outputs=outputs)
        self.ends = [getattr(states[-1], name).numpy() for name in ("particle_q", "particle_qd")]
        self.total = self.loss.numpy()[0]
        tape.backward(self.loss)
        names = "particle_q", "particle_qd", "body_q", "body_qd"
        found = {name: getattr(states[0], name).grad for name in names if getattr(states[0], name) is not None}
        found |= {name: array.grad for name, array in self.arrays.items()}
        return {name: gradient.numpy().copy() for name, gradient in found.items()}


def thrown(device):
    """A cloth that hits a sphere in the second step, and slides on it."""
    builder = newton.ModelBuilder()
    at = wp.transform(wp.vec3(0.01, 0.005, -0.1), wp.quat_identity())
    builder.add_shape_sphere(-1, radius=0.1, xform=at, cfg=newton.ModelBuilder.ShapeConfig(mu=0.4))
    add_cloth(builder, (-0.05, -0.05, 0.02), (0.4, 0.1, -0.6))
    return Scene(builder, device)


def on_box(device):
    """A cloth that falls on a free box, and turns it."""
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.02, 0.01, -0.03), TILT))
    builder.add_shape_box(body, hx=0.03, hy=0.04, hz=0.02)
    add_cloth(builder, (-0.05, -0.05, 0.02), (0.2, 0.1, -0.8))
    return Scene(builder, device)


def crossed(device):
    """A cloth that stands through another one at the start, and leaves it upwards."""
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.05, -0.05, 0.0))
    upright = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.5)
    add_cloth(builder, (-0.04, 0.01, -0.02), (0.1, 0.0, 2.0), rot=upright, cell=0.03)
    return Scene(builder, device)


def on_sheet(device, **options):
    """A cloth that falls on a sheet, two sides of which a program moves."""
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.03, -0.02, 0.012), (0.3, 0.1, -0.6))
    held = dict.fromkeys(["fix_left", "fix_right"], True)
    add_cloth(builder, (-0.08, -0.08, 0.0), rot=wp.quat_identity(), cell=0.08, **held)
    return Scene(builder, device, **options)


def on_moved_box(device, **options):
    """A cloth that falls on a box, which a program moves."""
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, -0.02), TILT), is_kinematic=True, mass=0.0)
    builder.add_shape_box(body, hx=0.1, hy=0.1, hz=0.02, cfg=newton.ModelBuilder.ShapeConfig(density=0.0))
    add_cloth(builder, (-0.05, -0.05, 0.012), (0.2, 0.1, -0.6))
    return Scene(builder, device, **options)


def assert_same(found, expected):
    for name, gradient in expected.items():
        limit = ROUNDING * np.abs(gradient).max()
        np.testing.assert_allclose(found[name], gradient, rtol=0.0, atol=limit, err_msg=name)


@pytest.mark.filterwarnings("error:a program writes the pose", "ignore:edges pass through faces at the start")
@pytest.mark.parametrize("make", [thrown, on_box, crossed, on_sheet, on_moved_box])
def test_gradients_are_those_of_steps_that_the_tape_keeps(make, device):
    """Also where what the tape moves crosses from one segment to another."""
    scene = make(device)
    expected = scene.gradients()
    assert (np.abs(expected["way"]).max() > 0.0) == (make in (on_sheet, on_moved_box))
    ends, total, norms = scene.ends, scene.total, scene.solver.report.gradient_norms
    for every in (1, 2, STEPS, STEPS + 3):
        assert_same(scene.gradients(every), expected)
        for found, end in zip(scene.ends, ends, strict=True):
            np.testing.assert_array_equal(found, end)
        assert scene.total == scene.loss.numpy()[0] == pytest.approx(total, rel=1e-5)
        np.testing.assert_allclose(scene.solver.report.gradient_norms, norms, rtol=1e-5)


@pytest.mark.parametrize("make", [on_sheet, on_moved_box])
def test_what_a_program_moves_outside_of_the_tape_keeps_its_gradient_apart(make, device):
    scene = make(device, on_tape=False)
    expected = scene.gradients()
    for every in (1, 2, STEPS):
        assert_same(scene.gradients(every), expected)
    assert scene.solver.report.gradient_counts.ambiguous_moves == 0
    scene.on_tape = True
    name = "particle_q" if make is on_sheet else "body_q"
    assert np.abs(scene.gradients(2)[name] - expected[name]).max() > 0.1 * np.abs(expected[name]).max()


@pytest.mark.parametrize("on_tape", [True, False])
def test_steps_before_and_after_on_the_same_tape(on_tape, device):
    """Gradients of what moves pass the borders to them."""
    scene = on_sheet(device, on_tape=on_tape)
    expected = scene.gradients()
    for first, last in ((1, 4), (0, 3), (2, STEPS)):
        assert_same(scene.gradients(2, first=first, last=last), expected)


def test_two_states_that_take_turns(device):
    scene = thrown(device)
    expected = scene.gradients()
    first, second = scene.begin(2)
    with wp.Tape() as tape:
        for k, ends in ((0, (first, second)), (2, (second, first))):
            bsc.checkpointed(
                scene.solver,
                lambda i, *states, k=k: scene.step(k + i, *states),
                *ends,
                2 if k == 0 else 3,
                every=1,
                outputs=[scene.loss],
            )
    tape.backward(scene.loss)
    assert_same({"particle_q": first.particle_q.grad.numpy()}, {"particle_q": expected["particle_q"]})
    assert_same({"forces": scene.arrays["forces"].grad.numpy()}, {"forces": expected["forces"]})


def test_a_step_may_take_several_of_the_solver(device):
    scene = thrown(device)

    def step(k, start, end):
        with paused_tape():
            middle = scene.model.state()
        scene.solver.step(start, middle, None, None, 0.5 * DT)
        scene.solver.step(middle, end, None, None, 0.5 * DT)

    found = []
    for is_checkpointed in (False, False, True):
        states = scene.begin(4)
        with wp.Tape() as tape:
            if is_checkpointed:
                bsc.checkpointed(scene.solver, step, states[0], states[-1], 3, every=2)
            else:
                for k, ends in enumerate(itertools.pairwise(states)):
                    step(k, *ends)
        tape.backward(grads={states[-1].particle_q: scene.weights})
        found.append({"particle_qd": states[0].particle_qd.grad.numpy()})
        assert scene.solver.report.gradient_norms.shape == (7, 1)
    assert_same(found[2], found[1])


def test_totals_have_each_step_once(device):
    scene = thrown(device)
    scene.solver.max_iterations = scene.solver.newton_method.max_steps = 1  # so that steps count as not converged
    counts = []
    for every in (None, 2):
        report = scene.solver.report
        before = report.totals.steps, report.unconverged_steps, report.gradient_counts.steps
        with pytest.warns(UserWarning, match="did not converge") if every is None else paused_tape():
            scene.gradients(every)
        after = report.totals.steps, report.unconverged_steps, report.gradient_counts.steps
        counts.append([int(b - a) for a, b in zip(before, after, strict=True)])
    assert counts[0] == counts[1] and counts[0][0] == counts[0][2] == STEPS


def test_steps_go_on_after_the_way_back_as_without(device):
    """What lies between the end of the steps and the next one is not touched by taking them again."""
    ends = []
    for goes_back in (True, False):
        scene = on_sheet(device)
        states = scene.begin(3)
        with wp.Tape() as tape:
            bsc.checkpointed(scene.solver, scene.step, *states[:2], STEPS, every=2, outputs=[scene.loss])
        if goes_back:
            tape.backward(scene.loss)
        scene.step(1, *states[1:])
        ends.append(states[2].particle_q.numpy())
    np.testing.assert_array_equal(*ends)


def test_a_tape_keeps_the_steps_of_one_segment(device):
    """And no arrays that steps make."""
    scene, kept, made = thrown(device), [], []
    gc.collect()
    gc.freeze()  # as in conftest.py: what other tests have left is not looked at in each step

    def step(k, start, end):
        forces = wp.zeros((STEPS, scene.model.particle_count), dtype=wp.vec3, device=device, requires_grad=True)
        wp.launch(push, scene.model.particle_count, inputs=[forces, k], outputs=[start.particle_f], device=device)
        made.append(weakref.ref(forces))
        scene.step(k, start, end)
        gc.collect()
        kept.append(sum(isinstance(x, RecordedStep) for x in gc.get_objects()))

    states = scene.begin(2)
    with wp.Tape() as tape:
        bsc.checkpointed(scene.solver, step, *states, STEPS, every=2, outputs=[scene.loss])
    tape.backward(scene.loss)
    assert max(kept[1:STEPS]) == 0 and max(kept) == 2
    assert not any(array() for array in made) and scene.arrays["forces"] in tape.gradients


@pytest.mark.parametrize("every", [1, 2])
def test_steps_that_end_elsewhere_the_second_time_have_no_gradients(every, device):
    scene, calls = thrown(device), itertools.count()

    def step(k, start, end):
        if next(calls) == STEPS + 1:  # not the first time
            start.particle_qd.fill_(wp.vec3(0.0, 0.0, 0.1))
        scene.step(k, start, end)

    states = scene.begin(2)
    with wp.Tape() as tape:
        bsc.checkpointed(scene.solver, step, *states, STEPS, every=every, outputs=[scene.loss])
    with pytest.warns(UserWarning, match="checkpointed steps ended elsewhere when they were taken again"):
        tape.backward(scene.loss)
    assert scene.solver.report.gradient_counts.unrepeated == 1
    assert np.isnan(states[0].particle_q.grad.numpy()).all()


def test_in_a_graph_as_without():
    scene = thrown("cpu")
    scene.gradients()
    expected = scene.gradients(2)
    states = scene.begin(2)
    with wp.ScopedCapture("cpu") as capture:
        with wp.Tape() as tape:
            bsc.checkpointed(scene.solver, scene.step, *states, STEPS, every=2, outputs=[scene.loss])
        tape.backward(scene.loss)
    for _ in range(2):
        states[0].assign(scene.begin(1)[0])
        tape.zero()
        wp.capture_launch(capture.graph)
        assert_same({"particle_q": states[0].particle_q.grad.numpy()}, {"particle_q": expected["particle_q"]})
        assert_same({"forces": scene.arrays["forces"].grad.numpy()}, {"forces": expected["forces"]})
    assert scene.solver.report.gradient_counts.unrepeated == 0


def test_outside_of_a_tape_steps_are_taken(device):
    scene = thrown(device)
    expected = scene.gradients(2)
    states = scene.begin(2)
    bsc.checkpointed(scene.solver, scene.step, *states, STEPS, outputs=[scene.loss])
    np.testing.assert_array_equal(states[1].particle_q.numpy(), scene.ends[0])
    assert expected and scene.loss.numpy()[0] == scene.total


class TestRefused:
    """Steps that cannot be taken twice."""

    def test_an_array_that_outputs_lacks(self, device):
        scene = thrown(device)
        with pytest.raises(
            ValueError, match=r"outputs must have all .* it writes one of shape \(1,\) and type float32"
        ):
            bsc.checkpointed(scene.solver, scene.step, *scene.begin(2), STEPS)

    def test_no_step_of_the_solver(self, device):
        scene = thrown(device)
        with pytest.raises(ValueError, match="step: it takes no step of the solver"):
            bsc.checkpointed(scene.solver, lambda k, start, end: end.assign(start), *scene.begin(2), STEPS)

    def test_a_model_without_gradients(self, device):
        builder = newton.ModelBuilder()
        add_cloth(builder, (0.0, 0.0, 0.0))
        solver = bsc.SolverImplicit(model := builder.finalize(device=device))
        with pytest.raises(ValueError, match="solver: its model has no gradients"):
            bsc.checkpointed(solver, print, model.state(), model.state(), 1)
