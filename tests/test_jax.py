"""Rollouts as functions of JAX: results are those of the solver, gradients those of central differences."""

import numpy as np
import pytest
import rollouts
from rollouts import DT, STEPS

jax = pytest.importorskip("jax")
import warp_bsc.jax  # noqa: E402


def as_single(values):
    return {name: array.astype(np.float32) for name, array in values.items()}


def test_states_are_those_of_the_solver_bit_for_bit(device):
    solver = rollouts.bouncing_patch(device)
    given = rollouts.arguments(solver.model)
    expected = rollouts.expected_states(solver, *given)
    for states in ("all", "last"):
        result = warp_bsc.jax.rollout(solver, *map(as_single, given), dt=DT, steps=STEPS, states=states)
        for name, values in zip(("particle_q", "particle_qd"), expected, strict=True):
            np.testing.assert_array_equal(np.asarray(result[name]), values if states == "all" else values[-1])


@pytest.mark.parametrize(("states", "every"), [("last", None), ("all", None), ("last", 5)])
def test_gradients_under_jit_are_those_of_central_differences(states, every, device):
    solver = rollouts.bouncing_patch(device)
    state, controls = rollouts.arguments(solver.model)
    rng = np.random.default_rng(1)
    shape = (STEPS, *state["particle_q"].shape) if states == "all" else state["particle_q"].shape
    weights = {name: rng.normal(size=shape).astype(np.float32) for name in state}

    def results_of(state, controls):
        return warp_bsc.jax.rollout(solver, state, controls, dt=DT, steps=STEPS, states=states, every=every)

    def loss(state, controls):
        return sum((weights[name] * array).sum() for name, array in results_of(state, controls).items())

    values = as_single(state), as_single(controls)
    taken = solver.gradients.taken
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(*values)
    assert solver.gradients.taken - taken == (1 if every is None else 2) * STEPS
    for which, name, h in ((0, "particle_q", 2e-5), (0, "particle_qd", 2e-3), (1, "particle_f", 2e-4)):
        direction = rng.normal(size=values[which][name].shape)
        sides = []
        for sign in (1.0, -1.0):
            changed = [dict(state), dict(controls)]
            changed[which][name] = changed[which][name] + sign * h * direction
            result = results_of(*map(as_single, changed))
            sides.append(sum((weights[n] * np.asarray(x).astype(float)).sum() for n, x in result.items()))
        actual = np.asarray(gradients[which][name])
        expected = (sides[0] - sides[1]) / (2.0 * h)
        np.testing.assert_allclose((actual * direction).sum(), expected, atol=0.01 * np.linalg.norm(actual))


def test_a_rollout_without_jit_is_compiled_once(device):
    """What JAX compiles it keeps: memory would grow with each call."""
    solver = rollouts.bouncing_patch(device)
    state, controls = map(as_single, rollouts.arguments(solver.model))
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_values, **_details: compiled.append(name))

    def loss(state):
        return warp_bsc.jax.rollout(solver, state, controls, dt=DT, steps=STEPS)["particle_q"].sum()

    counts = []
    for _ in range(3):
        compiled.clear()
        jax.grad(loss)(state)
        counts.append(sum("backend_compile" in name for name in compiled))
    assert counts[0] > 0 and counts[2] == 0


def test_wrong_use(device):
    solver = rollouts.bouncing_patch(device)
    state, controls = map(as_single, rollouts.arguments(solver.model))
    rollout = warp_bsc.jax.rollout
    with pytest.raises(ValueError, match=r"state\['particle_q'\] must have shape"):
        rollout(solver, {"particle_q": state["particle_q"][1:]}, controls, dt=DT)
    with pytest.raises(TypeError, match=r"state\['particle_q'\] must be of float32, not float64"):
        rollout(solver, {"particle_q": state["particle_q"].astype(float)}, controls, dt=DT)
    with pytest.raises(TypeError, match=r"state\['particle_q'\] must be an array of JAX"):
        rollout(solver, {"particle_q": [0.0]}, controls, dt=DT)
    with pytest.raises(TypeError, match="solver must be a solver"):
        rollout(None, state, controls, dt=DT)
