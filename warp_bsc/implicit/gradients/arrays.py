"""Copies of arrays of structs, and launches of the adjoints of kernels."""

import warp as wp

from ..._private_names.of_warp import empty_struct, struct_type
from ...response.state.structs import Materials


def copied(struct, names=()):
    """Returns a struct with copies of the arrays of these names, and all other fields those of ``struct``."""
    into = struct_type(struct)()
    into.assign(struct)
    for name in names:
        setattr(into, name, wp.clone(getattr(struct, name)))
    return into


def with_gradients(struct, names=(), **gradients):
    """Returns a struct with aliases of some arrays that have gradients, zeros for ``names``, and their gradients."""
    into, of_struct = copied(struct), struct_type(struct)()
    for name in (*names, *gradients):
        array = getattr(struct, name)
        gradient = gradients[name] if name in gradients else wp.zeros_like(array, requires_grad=False)
        setattr(of_struct, name, gradient)
        setattr(into, name, with_gradient(array, gradient))
    return into, of_struct


def with_gradient(values: wp.array, gradient: wp.array | None) -> wp.array:
    """Returns an array of the same values whose gradient is another array; the values themselves if that is None."""
    if gradient is None or not len(values):
        return values
    alias = values[:]
    alias.grad, alias.retain_grad = gradient, True  # which a store would clear
    return alias


def copied_materials(materials: Materials) -> Materials:
    """Returns materials with a copy of the friction of their pairs, which a program may change."""
    return copied(materials, [] if materials.friction is None else ["friction"])


def materials_with_gradients(materials: Materials, table: wp.array | None):
    """Returns materials whose friction adds to the gradient of a table, and gradients as :func:`with_gradients`."""
    if table is None:
        return with_gradients(materials)
    gradient = wp.zeros_like(table, requires_grad=False) if table.grad is None else table.grad
    return with_gradients(materials, friction=gradient)


def launch_adjoint(kernel, dim, inputs, of_outputs, device):
    """Launches the adjoint of a kernel, given the gradients with respect to the outputs that are not among its inputs.

    The adjoint does not read or write outputs, so their gradients stand in for them. Outputs that functions add to must
    be among the inputs: the adjoint adds to these again.
    """
    adjoints = [empty_struct(value) for value in inputs]
    options = {"outputs": of_outputs, "adj_outputs": of_outputs, "adjoint": True, "device": device}
    wp.launch(kernel, dim, inputs=inputs, adj_inputs=adjoints, **options)
