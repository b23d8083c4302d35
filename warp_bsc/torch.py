"""Rollouts of solvers as functions of PyTorch, so that they stand in a graph of autograd beside networks.

Imported on request only, as it needs PyTorch: ``import warp_bsc.torch``, or the first use of ``warp_bsc.torch``.
"""

import contextlib
from collections.abc import Mapping
from typing import Any, Literal

import warp as wp
from newton.solvers import SolverBase

from ._arguments import check_instance
from ._rollout import Rollout, RolloutOptions

try:
    import torch
except ImportError as error:
    raise ImportError("warp_bsc.torch needs PyTorch: pip install 'warp-bsc[torch]'") from error

__all__ = ["rollout"]


def rollout(
    solver: SolverBase,
    state: Mapping[str, torch.Tensor],
    controls: Mapping[str, torch.Tensor] | None = None,
    *,
    dt: float,
    steps: int | None = None,
    states: Literal["last", "all"] = "last",
    every: int | None = None,
) -> dict[str, torch.Tensor]:
    """Returns the states after steps of a solver, as differentiable functions of the first state and of controls.

    The result can be the state of the next call, so that a policy acts between two of them::

        for _ in range(60):
            forces = policy(state["particle_q"], state["particle_qd"])
            state = warp_bsc.torch.rollout(solver, state, {"particle_f": forces[None]}, dt=1.0 / 600.0, steps=10)

    Each call records a tape of Warp, which holds its states until autograd drops its graph. Its backward pass clears
    the gradients of arrays of the model. Second derivatives raise an error.

    Args:
        solver: A solver that is differentiable, such as a :class:`.SolverImplicit`; its model must be finalized with
            ``requires_grad=True``.
        state: Tensors by name: ``particle_q`` [m] and ``particle_qd`` [m/s], shape [particle_count, 3], ``body_q``,
            shape [body_count, 7], and ``body_qd`` [m/s, rad/s], shape [body_count, 6]. Others are those of the model.
        controls: Tensors by name, each with a row for a step, or for an equal number of steps, which hold it. Forces
            ``particle_f`` [N], shape [rows, particle_count, 3], and ``body_f`` [N, N m], shape [rows, body_count, 6],
            act in each step. Velocities ``particle_qd`` and ``body_qd`` are added to those of the state before the
            first step of a row. Arrays of ``newton.Control`` of floats, such as ``joint_f``, are set.
        dt: Length of a step [s].
        steps: Steps, a multiple of the rows of controls; default: one a row.
        states: Whether the result is the ``"last"`` state or ``"all"``, each tensor then with a row a step.
        every: Steps between two states that are kept, as of :func:`.checkpointed`, of a :class:`.SolverImplicit`: the
            backward pass takes the steps again, so many at a time. Default: all states are kept.

    Returns:
        The tensors of the last state by name, those that the model has; or of all states, shape [steps, ...].

    Raises:
        TypeError: If an argument has another type, or a tensor is not of float32.
        ValueError: If a number is out of range, a name is unknown, or a shape or device is not that of the model.
    """
    check_instance(solver, "solver", SolverBase, "a solver of Newton")
    given = {"state": dict(state), "controls": dict(controls or {})}
    for argument, tensors in given.items():
        for name, tensor in tensors.items():
            _check_tensor(f"{argument}[{name!r}]", tensor, solver.model.device)
    shapes = [{name: tuple(tensor.shape) for name, tensor in tensors.items()} for tensors in given.values()]
    options = RolloutOptions(solver, dt, steps, states, *shapes, every=every)
    names = [list(tensors) for tensors in given.values()]
    tensors = [tensor for tensors in given.values() for tensor in tensors.values()]
    recorded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    results: Any = _Rollout.apply(options, names, recorded, *tensors)
    return dict(zip(options.result_names(), results, strict=True))


def _check_tensor(name, tensor, device):
    check_instance(tensor, name, torch.Tensor, "a tensor of PyTorch")
    if tensor.dtype is not torch.float32:
        raise TypeError(f"{name} must be of float32, not {tensor.dtype}")
    if wp.device_from_torch(tensor.device) != device:
        raise ValueError(f"{name} must be on the device of the model, {device}, not on {tensor.device}")


class _Rollout(torch.autograd.Function):
    """A rollout, of tensors of the state and then of controls."""

    @staticmethod
    def forward(ctx: Any, options: RolloutOptions, names: list[list[str]], recorded: bool, *tensors: torch.Tensor):
        device = options.solver.model.device
        arrays = [_as_array(x, options.dtype_of(n)) for x, n in zip(tensors, names[0] + names[1], strict=True)]
        state = dict(zip(names[0], arrays, strict=False))
        controls = dict(zip(names[1], arrays[len(names[0]) :], strict=True))
        with _stream_of_torch(device):
            taken = Rollout(options, state, controls, recorded=recorded)
        ctx.options, ctx.taken = options, taken
        ctx.set_materialize_grads(False)
        results = [wp.to_torch(array, requires_grad=False) for array in taken.results.values()]
        return tuple(results if options.all_states else [result[0] for result in results])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *of_results: torch.Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        options, taken = ctx.options, ctx.taken
        gradients = {}
        for name, gradient in zip(options.result_names(), of_results, strict=True):
            if gradient is not None:
                rows = gradient if options.all_states else gradient[None]
                gradients[name] = _as_array(rows, options.dtype_of(name))
        with _stream_of_torch(options.solver.model.device):
            of_state, of_controls = taken.backward(gradients)
        arrays = [*of_state.values(), *of_controls.values()]
        return None, None, None, *(wp.to_torch(array, requires_grad=False) for array in arrays)


def _as_array(tensor, dtype):
    """Returns a tensor as an array of vectors, without a copy if it is contiguous."""
    return wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False)


def _stream_of_torch(device):
    """Makes Warp work on PyTorch's stream on a GPU, so that each finds what the other has written."""
    if not device.is_cuda:
        return contextlib.nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(wp.device_to_torch(device))))
