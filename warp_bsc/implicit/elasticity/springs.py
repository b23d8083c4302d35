"""The energy of springs, with damping by the change of their lengths since the start of the step."""

from typing import Any

import warp as wp

from ...response.state.vectors import HALF, ZERO
from .elements import ElementKind, Elements, first_block
from .matrices import identity, store

wp.set_module_options({"enable_backward": False})

_LEAST_LENGTH = wp.constant(wp.float64(1.0e-8))  # as VBD has it


@wp.func
def energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the energy of a spring [J]."""
    a, b = elements.spring_indices[e, 0], elements.spring_indices[e, 1]
    length = wp.max(wp.length(wp.vec3d(x[a]) - wp.vec3d(x[b])), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(wp.vec3d(x0[a]) - wp.vec3d(x0[b])), _LEAST_LENGTH)
    stretch, change = length - wp.float64(elements.spring_rest_length[e]), length - length_0
    energy = wp.float64(elements.spring_stiffness[e]) * stretch * stretch
    return HALF * (energy + wp.float64(elements.spring_damping[e]) / dt * change * change)


@wp.func
def tension_of(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns direction, length and tension of a spring, and the derivative of the tension by the length."""
    a, b = elements.spring_indices[e, 0], elements.spring_indices[e, 1]
    between = wp.vec3d(x[a]) - wp.vec3d(x[b])
    length = wp.max(wp.length(between), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(wp.vec3d(x0[a]) - wp.vec3d(x0[b])), _LEAST_LENGTH)
    stiffness, damping = wp.float64(elements.spring_stiffness[e]), wp.float64(elements.spring_damping[e]) / dt
    tension = stiffness * (length - wp.float64(elements.spring_rest_length[e])) + damping * (length - length_0)
    return between / length, length, tension, stiffness + damping


@wp.func
def store_hessian(
    elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64, is_convex: bool, out: wp.array[Any]
):
    """Writes the Hessian of the energy of a spring, convex or exact, a block for each two corners [N/m]."""
    place = first_block(elements, ElementKind.SPRING, e)
    along, length, tension, stiffness = tension_of(elements, e, x, x0, dt)
    outer = wp.outer(along, along)
    across = tension / length
    if is_convex:
        across = wp.max(across, ZERO)
    block = stiffness * outer + across * (identity() - outer)
    store(out, place, block)
    store(out, place + 1, -block)
    store(out, place + 2, -block)
    store(out, place + 3, block)
