"""Rollouts as functions of PyTorch: results and gradients of Warp, and those of central differences."""

import itertools

import newton
import numpy as np
import pytest
import rollouts
import warp as wp
from rollouts import DT, STEPS

torch = pytest.importorskip("torch")
import warp_bsc.torch  # noqa: E402


def tensors(values, device, requires_grad=True):
    """Arrays by name as tensors of float32."""
    return {
        name: torch.tensor(array, dtype=torch.float32, device=wp.device_to_torch(device), requires_grad=requires_grad)
        for name, array in values.items()
    }


def test_states_are_those_of_the_solver_bit_for_bit(device):
    solver = rollouts.bouncing_patch(device)
    state, controls = rollouts.arguments(solver.model)
    expected = rollouts.expected_states(solver, state, controls)
    given = [tensors(values, device) for values in (state, controls)]
    for states in ("all", "last"):
        result = warp_bsc.torch.rollout(solver, *given, dt=DT, steps=STEPS, states=states)
        for name, values in zip(("particle_q", "particle_qd"), expected, strict=True):
            actual = result[name].detach().cpu().numpy()
            np.testing.assert_array_equal(actual, values if states == "all" else values[-1])
    with torch.no_grad():
        result = warp_bsc.torch.rollout(solver, *given, dt=DT, steps=STEPS)
    assert not result["particle_q"].requires_grad
    np.testing.assert_array_equal(result["particle_q"].cpu().numpy(), expected[0][-1])


@pytest.mark.parametrize(("states", "every"), [("last", None), ("all", None), ("all", 5)])
def test_gradients_are_those_of_central_differences(states, every, device):
    """Of a random function of the states, in random directions of all arguments."""
    solver = rollouts.bouncing_patch(device)
    values = dict(zip(("state", "controls"), rollouts.arguments(solver.model), strict=True))
    given = {argument: tensors(arrays, device) for argument, arrays in values.items()}
    rng = np.random.default_rng(1)
    result = warp_bsc.torch.rollout(solver, **given, dt=DT, steps=STEPS, states=states, every=every)
    weights = {name: rng.normal(size=tuple(array.shape)) for name, array in result.items()}
    loss = sum((tensors(weights, device, False)[name] * array).sum() for name, array in result.items())
    loss.backward(retain_graph=True)
    first = {argument: {n: x.grad.clone() for n, x in arrays.items()} for argument, arrays in given.items()}

    def loss_of(argument, name, change):
        changed = {a: {n: x.copy() for n, x in arrays.items()} for a, arrays in values.items()}
        changed[argument][name] = changed[argument][name] + change
        ends = warp_bsc.torch.rollout(
            solver, **{a: tensors(x, device, False) for a, x in changed.items()}, dt=DT, steps=STEPS, states=states
        )
        return sum((weights[n] * x.cpu().numpy().astype(float)).sum() for n, x in ends.items())

    for argument, arrays in values.items():
        for name, array in arrays.items():
            direction = rng.normal(size=array.shape)
            h = {"particle_q": 2e-5, "particle_qd": 2e-3, "particle_f": 2e-4}[name]
            expected = (loss_of(argument, name, h * direction) - loss_of(argument, name, -h * direction)) / (2.0 * h)
            actual = (first[argument][name].cpu().numpy() * direction).sum()
            scale = np.linalg.norm(first[argument][name].cpu().numpy())
            np.testing.assert_allclose(actual, expected, atol=0.01 * scale, err_msg=f"{argument} {name}")
    loss.backward()  # once more: the gradients are added
    for argument, name in itertools.chain(*([(a, n) for n in arrays] for a, arrays in values.items())):
        torch.testing.assert_close(given[argument][name].grad, 2.0 * first[argument][name])


def test_gradients_are_those_of_a_tape_around_the_solver(device):
    solver = rollouts.bouncing_patch(device)
    model = solver.model
    state = tensors(rollouts.arguments(model)[0], device)
    result = warp_bsc.torch.rollout(solver, state, dt=DT, steps=STEPS)
    result["particle_q"].sum().backward()
    states = [model.state() for _ in range(STEPS + 1)]
    with wp.Tape() as tape:
        for start, end in itertools.pairwise(states):
            start.clear_forces()
            solver.step(start, end, None, None, DT)
    states[-1].particle_q.grad.fill_(1.0)
    tape.backward()
    for name, tensor in state.items():
        np.testing.assert_array_equal(tensor.grad.cpu().numpy(), getattr(states[0], name).grad.numpy())


@pytest.mark.parametrize("every", [1, 4])
def test_states_may_be_kept_now_and_then(every, device):
    """Gradients are those of a tape that keeps all, up to rounding, as contacts may come in another order."""
    solver, found = rollouts.bouncing_patch(device), []
    values = rollouts.arguments(solver.model)
    for kept in (None, every):
        given = [tensors(arrays, device) for arrays in values]
        taken = solver.gradients.taken
        result = warp_bsc.torch.rollout(solver, *given, dt=DT, steps=STEPS, every=kept)
        (result["particle_q"] ** 2).sum().backward()
        assert solver.gradients.taken - taken == (STEPS if kept is None else 2 * STEPS)
        found.append([result["particle_q"].detach(), *(x.grad for arrays in given for x in arrays.values())])
    for all_kept, some_kept in zip(*found, strict=True):
        torch.testing.assert_close(some_kept, all_kept, rtol=1e-4, atol=1e-6)


def test_rollouts_one_after_another_are_one(device):
    """As where a policy acts between them: their results and gradients are those of all steps at once."""
    solver = rollouts.bouncing_patch(device)
    state, controls = rollouts.arguments(solver.model)
    results = []
    for calls in (1, 2):
        given = [tensors(values, device) for values in (state, controls)]
        after, rows = given[0], 2 // calls
        for call in range(calls):
            held = {name: tensor[rows * call : rows * (call + 1)] for name, tensor in given[1].items()}
            after = warp_bsc.torch.rollout(solver, after, held, dt=DT, steps=STEPS // calls)
        (after["particle_q"] ** 2).sum().backward()
        tensors_of_call = [*given[0].values(), *given[1].values()]
        results.append([after["particle_q"].detach(), *(tensor.grad for tensor in tensors_of_call)])
    for one, two in zip(*results, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-7)


def test_wrong_use(device):
    solver = rollouts.bouncing_patch(device)
    n = solver.model.particle_count
    rollout, state = warp_bsc.torch.rollout, tensors(rollouts.arguments(solver.model)[0], device)
    force = torch.zeros((2, n, 3), device=wp.device_to_torch(device))
    for arguments, error, message in (
        ((solver, {"particle_q": force}, None), ValueError, r"state\['particle_q'\] must have shape \(9, 3\)"),
        ((solver, {"q": force}, None), ValueError, "state has no 'q'; it may have particle_q"),
        ((solver, {"body_q": force}, None), ValueError, r"state\['body_q'\]: the model has no such array"),
        ((solver, {"particle_q": np.zeros((n, 3))}, None), TypeError, r"state\['particle_q'\] must be a tensor"),
        ((solver, {"particle_q": force[0].double()}, None), TypeError, "must be of float32, not torch.float64"),
        ((solver, state, {"particle_f": force[:, 1:]}), ValueError, r"controls\['particle_f'\] must have shape"),
        ((solver, state, {"particle_f": force, "particle_qd": force[:1]}), ValueError, "same number of rows"),
        ((solver, state, {"force": force}), ValueError, "controls has no 'force'; it may have particle_f"),
        ((solver, state, None), ValueError, "steps must be given"),
        ((solver.model, state, None), TypeError, "solver must be a solver of Newton"),
    ):
        with pytest.raises(error, match=message):
            rollout(*arguments, dt=DT)
    with pytest.raises(ValueError, match="steps must be a multiple of the 2 rows"):
        rollout(solver, state, {"particle_f": force}, dt=DT, steps=3)
    with pytest.raises(ValueError, match="dt must be"):
        rollout(solver, state, {"particle_f": force}, dt=0.0)
    with pytest.raises(ValueError, match="states must be"):
        rollout(solver, state, {"particle_f": force}, dt=DT, states="first")
    with pytest.raises(ValueError, match="every must be"):
        rollout(solver, state, {"particle_f": force}, dt=DT, every=0)
    with pytest.raises(TypeError, match="solver must be a SolverImplicit with every=2, not a SolverSemiImplicit"):
        rollout(newton.solvers.SolverSemiImplicit(solver.model), state, None, dt=DT, steps=4, every=2)
    plain = rollouts.bouncing_patch(device, requires_grad=False)
    with pytest.raises(ValueError, match="solver: its model has no gradients"):
        rollout(plain, state, {"particle_f": force}, dt=DT)
    result = rollout(solver, state, dt=DT, steps=1)["particle_q"].square().sum()
    (gradient,) = torch.autograd.grad(result, state["particle_q"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_the_example_trains_a_policy(device):
    """Two iterations, through bounces; the whole example ends 1 cm from the mark."""
    import torch_policy  # noqa: PLC0415 (needs PyTorch)

    with wp.ScopedDevice(device):
        history, steered, free, throws = torch_policy.train(2)
    assert len(history) == 2 and history[1] != history[0]
    assert np.isfinite(steered).all() and (steered != free).all() and free.min() > 0.05
    assert throws.solver.report.totals.uncertified_steps == throws.solver.report.unconverged_steps == throws.lost == 0
