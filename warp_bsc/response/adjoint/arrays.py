"""Copies of arrays of structs, and launches of the adjoints of kernels."""

from types import SimpleNamespace

import warp as wp

from ..._private_names.of_warp import empty_struct


def copied(struct, lengths):
    """Returns a struct with copies of some arrays, and all other fields those of ``struct``.

    Args:
        struct: The struct.
        lengths: Names of the arrays to copy; a dictionary says how many elements, None for all.
    """
    into = struct._cls()
    for name in struct._cls.vars:
        setattr(into, name, getattr(struct, name))
    for name, length in lengths.items() if isinstance(lengths, dict) else dict.fromkeys(lengths).items():
        array = getattr(struct, name)
        if length == 0:  # Warp makes no empty slices
            setattr(into, name, wp.empty(0, dtype=array.dtype, device=array.device))
        else:
            setattr(into, name, wp.clone(array if length is None else array[:length]))
    return into


def attach_gradients(struct, names, gradients=None):
    """Replaces arrays of a struct by aliases with gradients, given or new ones; returns the gradients by name."""
    into = SimpleNamespace(**(gradients or {}))
    for name in names:
        array = getattr(struct, name)
        if not hasattr(into, name):
            setattr(into, name, wp.zeros_like(array, requires_grad=False))
        if len(array):
            alias = array[:]
            alias.grad = getattr(into, name)
            setattr(struct, name, alias)
    return into


def launch_adjoint(kernel, dim, inputs, outputs, of_outputs, device):
    """Launches the adjoint of a kernel, given the gradients with respect to its outputs.

    The adjoint does not read or write outputs, so their gradients may stand in for them, except for outputs that
    functions add to.
    """
    wp.launch(
        kernel,
        dim,
        inputs=inputs,
        outputs=outputs,
        adj_inputs=[empty_struct(value) for value in inputs],
        adj_outputs=of_outputs,
        adjoint=True,
        device=device,
    )
