"""Steps of SolverImplicit on tapes: states that are used again, what programs write between steps, graphs, worlds."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from gradient_scenes import DT, TILT, add_cloth, block_on_plane, cloth_on_edge, cloth_on_sheet

import warp_bsc as bsc

STATE = "particle_q", "particle_qd"


def take_steps(program, states, tape):
    """Takes all steps of a program on a tape."""
    with tape:
        for start, end in itertools.pairwise(states):
            program.solver.step(start, end, None, None, DT)


def gradients_of(state):
    return [getattr(state, name).grad.numpy().copy() for name in STATE]


def test_a_tape_changes_nothing_of_a_step(device):
    """Bit for bit. A model that requires no gradients is not solved as closely."""
    ends = []
    for requires_grad, on_tape in ((True, True), (True, False), (False, False)):
        program = cloth_on_sheet(device)
        program.run()
        states = program.states
        if not on_tape:
            program.model.requires_grad = requires_grad
            radii = program.arrays["particle_radius"]
            solver = bsc.SolverImplicit(program.model, max_iterations=60, friction=0.3, particle_radius=radii)
            assert (solver.gradients is None) != requires_grad
            states = program.begin(program.inputs)
            solver.reset(states[0])
            for k, (start, end) in enumerate(itertools.pairwise(states)):
                program.write(start, program.inputs, k)
                solver.step(start, end, None, None, DT)
        ends.append([getattr(states[-1], name).numpy() for name in STATE])
    for of_tape, without, of_plain in zip(*ends, strict=True):
        np.testing.assert_array_equal(of_tape, without)
        np.testing.assert_allclose(of_plain, without, atol=5e-3)


def test_distances_that_require_no_gradients_get_none(device):
    """The others stay what they are."""
    program = cloth_on_sheet(device)
    program.run()  # contacts come in another order in the first run of a solver
    radii, found = program.arrays["particle_radius"], []
    for requires_grad in (True, False):
        radii.requires_grad = requires_grad
        program.run()
        program.tape.backward(grads=program.seeds())
        found.append(gradients_of(program.states[0]))
        assert (radii.grad is not None) == requires_grad
        assert not requires_grad or radii.grad.numpy().any()
    for with_some, without in zip(*found, strict=True):
        np.testing.assert_array_equal(with_some, without)


def test_two_states_that_take_turns(device):
    """Bit for bit on a CPU; on a GPU, contacts come in another order in each run, and sums of gradients round."""
    program = cloth_on_edge(device)
    program.run()  # contacts come in another order in the first run of a solver
    expected = program.gradients()
    states = program.begin(program.inputs)[:2]
    take_steps(program, [states[k % 2] for k in range(program.steps + 1)], tape := wp.Tape())
    program.states = [states[program.steps % 2]]
    tape.backward(grads=program.seeds())
    share = 0.0 if wp.get_device(device).is_cpu else 1e-6
    for name, gradient in zip(STATE, gradients_of(states[0]), strict=True):
        np.testing.assert_allclose(gradient, expected[name], rtol=0.0, atol=share * np.abs(expected[name]).max())


@wp.kernel
def add_heights(x: wp.array[wp.vec3], weight: float, total: wp.array[float]):
    wp.atomic_add(total, 0, weight * x[wp.tid()][2])


def test_a_loss_of_all_steps_is_the_sum_of_those_of_each(device):
    program, expected = cloth_on_edge(device), 0.0
    n, up = program.model.particle_count, np.array([0.0, 0.0, 1.0])
    for steps in range(1, program.steps + 1):
        states = program.begin(program.inputs)[: steps + 1]
        take_steps(program, states, tape := wp.Tape())
        seed = wp.array(np.tile(steps * up, (n, 1)), dtype=wp.vec3, device=device)
        tape.backward(grads={states[-1].particle_q: seed})
        expected += np.array(gradients_of(states[0]))
    states, total = program.begin(program.inputs), wp.zeros(1, dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        for k, (start, end) in enumerate(itertools.pairwise(states)):
            program.solver.step(start, end, None, None, DT)
            wp.launch(add_heights, n, inputs=[end.particle_q, float(k + 1), total], device=device)
    tape.backward(total)
    np.testing.assert_allclose(gradients_of(states[0]), expected, atol=1e-5 * np.abs(expected).max())


@wp.kernel
def place(held: wp.array[int], first: wp.array[wp.vec3], way: wp.array[wp.vec3], k: float, x: wp.array[wp.vec3]):
    i = wp.tid()
    x[held[i]] = first[i] + k * way[0]


@wp.kernel
def shift(held: wp.array[int], way: wp.array[wp.vec3], x: wp.array[wp.vec3]):
    x[held[wp.tid()]] += way[0]


@wp.kernel
def set_pose(first: wp.array[wp.transform], way: wp.array[wp.vec3], k: float, poses: wp.array[wp.transform]):
    at = wp.transform_get_translation(first[0]) + k * way[0]
    poses[0] = wp.transform(at, wp.transform_get_rotation(first[0]))


@pytest.mark.parametrize("how", ["place", "shift"])
def test_particles_that_the_tape_moves_pass_gradients_to_what_moves_them(how, device):
    """They are those that the places get if no tape sees them written."""
    program = cloth_on_sheet(device)
    places = program.inputs["places"]
    expected = sum(k * of_places.sum(axis=0) for k, of_places in enumerate(program.gradients()["places"]))
    held = wp.array(np.flatnonzero(~program.free), dtype=int, device=device)
    first = wp.array(places[0], dtype=wp.vec3, device=device)
    way = wp.array([(places[1] - places[0])[0]], dtype=wp.vec3, device=device, requires_grad=True)
    states = program.states = program.begin(program.inputs)
    with wp.Tape() as tape:
        for k, (start, end) in enumerate(itertools.pairwise(states)):
            if how == "place":
                inputs = [held, first, way, float(k)]
                wp.launch(place, len(held), inputs=inputs, outputs=[start.particle_q], device=device)
            elif k:
                wp.launch(shift, len(held), inputs=[held, way, start.particle_q], device=device)
            program.solver.step(start, end, None, None, DT)
    tape.backward(grads=program.seeds())
    np.testing.assert_allclose(way.grad.numpy()[0], expected, atol=1e-3 * np.abs(expected).max())


def test_bodies_that_the_tape_moves_pass_gradients_to_what_moves_them(device):
    program = block_on_plane(device)
    way = np.float32([[0.002, 0.001, 0.0001]])
    poses = program.inputs["poses"]
    poses[:] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    poses[:, 0, :3] = np.arange(program.steps)[:, None] * way
    expected = sum(k * of_poses[0, :3] for k, of_poses in enumerate(program.gradients()["poses"]))
    first = wp.array(poses[0], dtype=wp.transform, device=device)
    way = wp.array(way, dtype=wp.vec3, device=device, requires_grad=True)
    states = program.states = program.begin(program.inputs)
    with wp.Tape() as tape:
        for k, (start, end) in enumerate(itertools.pairwise(states)):
            wp.launch(set_pose, 1, inputs=[first, way, float(k)], outputs=[start.body_q], device=device)
            program.solver.step(start, end, None, None, DT)
    tape.backward(grads=program.seeds())
    np.testing.assert_allclose(way.grad.numpy()[0], expected, atol=1e-4 * np.abs(expected).max())


def test_gradients_in_a_graph_are_those_without():
    program = cloth_on_edge("cpu")
    program.run()  # as above
    expected, ends = program.gradients(), [getattr(program.states[-1], name).numpy().copy() for name in STATE]
    states = program.states = program.begin(program.inputs)
    seeds = program.seeds()
    with wp.ScopedCapture("cpu") as capture:
        take_steps(program, states, tape := wp.Tape())
        tape.backward(grads=seeds)
    begun = program.begin(program.inputs)
    for _ in range(2):
        states[0].assign(begun[0])
        program.solver.reset(states[0])
        tape.zero()
        for array, seed in seeds.items():
            array.grad.assign(seed)
        wp.capture_launch(capture.graph)
        for name, end in zip(STATE, ends, strict=True):
            np.testing.assert_array_equal(getattr(states[-1], name).numpy(), end)
        for name, gradient in zip(STATE, gradients_of(states[0]), strict=True):
            np.testing.assert_array_equal(gradient, expected[name])
        np.testing.assert_array_equal(program.model.tri_materials.grad.numpy(), expected["tri_materials"])


@pytest.mark.slow
def test_many_tapes_take_no_more_memory(device):
    resource = pytest.importorskip("resource")  # of POSIX
    program = cloth_on_edge(device)

    def used():
        if wp.get_device(device).is_cuda:
            return wp.get_mempool_used_mem_current(device)
        return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    for i in range(160):
        program.gradients()
        if i == 80:
            before = used()
    assert used() - before < 2**20


def falling(heights, device, **options):
    """A tape of three steps of a cloth over a box in each world, and the gradient of weighted ends."""
    builder = newton.ModelBuilder()
    for height in heights:
        world = newton.ModelBuilder()
        world.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), TILT), hx=0.2, hy=0.03, hz=0.1)
        add_cloth(world, (-0.05, -0.03, height), (0.3, 0.2, -0.5))
        builder.add_world(world)
    builder.color()
    model = builder.finalize(device=device, requires_grad=True)
    model.tri_materials.requires_grad = True
    solver = bsc.SolverImplicit(model, friction=0.3, **options)
    states = [model.state() for _ in range(4)]
    with wp.Tape() as tape:
        for start, end in itertools.pairwise(states):
            solver.step(start, end, None, None, DT)
    n = model.particle_count // len(heights)
    weights = np.tile(np.random.default_rng(3).normal(size=(n, 3)), (len(heights), 1))
    tape.backward(grads={states[-1].particle_q: wp.array(weights, dtype=wp.vec3, device=device)})
    found = *gradients_of(states[0]), model.tri_materials.grad.numpy()
    return solver, [array.reshape(len(heights), -1) for array in found]


def test_worlds_have_the_gradients_that_each_has_alone(device):
    """Up to rounding: contacts come in another order."""
    heights = 0.008, 0.011, 0.3
    solver, together = falling(heights, device)
    assert solver.newton_method.problem.contacts.count.numpy()[:2].all()
    for world, height in enumerate(heights):
        for alone, of_worlds in zip(falling([height], device)[1], together, strict=True):
            np.testing.assert_allclose(of_worlds[world], alone[0], rtol=1e-5, atol=1e-6 * np.abs(alone[0]).max())


@pytest.mark.filterwarnings("ignore:a linear solve of a gradient")
def test_worlds_whose_steps_did_not_converge_have_no_gradients(device):
    """The other one falls freely."""
    with pytest.warns(UserWarning, match="did not converge, or left contacts .* gradients are NaN in its world"):
        solver, gradients = falling((0.008, 0.3), device, max_iterations=3)
        assert solver.report.gradient_counts.unsolved > 0  # on a GPU, the first number that is read warns
    assert solver.report.unconverged_steps > 0
    for of_worlds in gradients[:2]:
        assert np.isnan(of_worlds[0]).all() and np.isfinite(of_worlds[1]).all()


class TestRefused:
    """Steps that a tape cannot record."""

    def test_a_state_that_ends_where_it_starts(self, device):
        program = cloth_on_edge(device)
        state = program.model.state()
        with pytest.raises(ValueError, match="state_out must not be state_in"), wp.Tape():
            program.solver.step(state, state, None, None, DT)
        program.solver.step(state, state, None, None, DT)

    def test_a_part_of_the_worlds(self, device):
        program = cloth_on_edge(device)
        mask = wp.ones(2, dtype=bool, device=device)
        with pytest.raises(NotImplementedError, match="world_mask: steps on a tape are of all worlds"), wp.Tape():
            program.solver.step(program.model.state(), program.model.state(), None, None, DT, world_mask=mask)
