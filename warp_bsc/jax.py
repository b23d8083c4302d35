"""Rollouts of solvers as functions of JAX, with a vector-Jacobian product of their own.

Imported on request only, as it needs JAX: ``import warp_bsc.jax``, or the first use of ``warp_bsc.jax``. Warp's bridge
to JAX differentiates single kernels alone, and what XLA runs cannot keep a tape from one call to another. So a rollout
is a callback on the host: it works under ``jit`` and ``grad``, its arrays pass through the memory of the host, and its
backward pass takes the steps again, on a tape.
"""

import functools
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ._arguments import check_instance
from ._rollout import Rollout, RolloutOptions

try:
    import jax
except ImportError as error:
    raise ImportError("warp_bsc.jax needs JAX: pip install 'warp-bsc[jax]'") from error

__all__ = ["rollout"]


def rollout(
    solver: SolverBase,
    state: Mapping[str, jax.Array],
    controls: Mapping[str, jax.Array] | None = None,
    *,
    dt: float,
    steps: int | None = None,
    states: Literal["last", "all"] = "last",
    every: int | None = None,
) -> dict[str, jax.Array]:
    """Returns the states after steps of a solver, as differentiable functions of the first state and of controls.

    Can be called under :func:`jax.jit` and :func:`jax.grad`, and under :func:`jax.vmap` one after another; forward-mode
    and second derivatives raise an error. The backward pass clears the gradients of arrays of the model. The last 16
    kinds of rollouts are kept, with their solvers.

    Arguments, result and errors are those of :func:`warp_bsc.torch.rollout`, with arrays in place of tensors, on any
    device. With ``every``, the backward pass takes the steps twice.
    """
    check_instance(solver, "solver", SolverBase, "a solver of Newton")
    given = dict(state), dict(controls or {})
    for argument, arrays in zip(("state", "controls"), given, strict=True):
        for name, array in arrays.items():
            check_instance(array, f"{argument}[{name!r}]", (jax.Array, np.ndarray), "an array of JAX")
            if array.dtype != np.float32:
                raise TypeError(f"{argument}[{name!r}] must be of float32, not {array.dtype}")
    shapes = [{name: tuple(array.shape) for name, array in arrays.items()} for arrays in given]
    options = RolloutOptions(solver, dt, steps, states, *shapes, every=every)
    of_shapes = (tuple(x.items()) for x in shapes)
    return _differentiable(solver, options.dt, options.steps, states, options.every, *of_shapes)(*given)


@functools.lru_cache(maxsize=16)
def _differentiable(solver: SolverBase, dt: float, steps: int, states: str, every: int | None, *shapes: tuple):
    """Returns a rollout as a function of the state and the controls, always the same for the same arguments.

    JAX compiles each function that it calls, and keeps what it compiled.
    """
    options = RolloutOptions(solver, dt, steps, states, *map(dict, shapes), every=every)
    rows = (options.steps,) if options.all_states else ()
    results = {
        name: jax.ShapeDtypeStruct((*rows, *options.shape_of(name)), np.float32) for name in options.result_names()
    }
    call = functools.partial(jax.pure_callback, vmap_method="sequential")

    def as_arrays(arrays: dict[str, Any]):
        device = options.solver.model.device
        return {
            name: wp.array(np.asarray(x), dtype=options.dtype_of(name), device=device) for name, x in arrays.items()
        }

    def step(state, controls):
        taken = Rollout(options, as_arrays(state), as_arrays(controls), recorded=False)
        return {
            name: array.numpy() if options.all_states else array.numpy()[0] for name, array in taken.results.items()
        }

    def step_and_go_back(state, controls, of_results):
        taken = Rollout(options, as_arrays(state), as_arrays(controls))
        of_results = {name: x if options.all_states else np.asarray(x)[None] for name, x in of_results.items()}
        gradients = taken.backward(as_arrays(of_results))
        return tuple({name: array.numpy() for name, array in arrays.items()} for arrays in gradients)

    @jax.custom_vjp
    def run(state, controls):
        return call(step, results, state, controls)

    def forward(state, controls):
        return run(state, controls), (state, controls)

    def backward(inputs, of_results):
        like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), inputs)
        return call(step_and_go_back, like, *inputs, of_results)

    run.defvjp(forward, backward)
    return run
