"""The energy of edges that bend, by the dihedral angle, with damping by its change since the start of the step.

References:
    R. Bridson, S. Marino and R. Fedkiw, Simulation of Clothing with Folds and Wrinkles, Symposium on Computer
    Animation, 2003 (the gradient of the dihedral angle).
"""

from typing import Any

import warp as wp

from ...response.state.vectors import HALF, ZERO
from .elements import Elements
from .matrices import mat43d

wp.set_module_options({"enable_backward": False})

_TWO = wp.constant(wp.float64(2.0))
_PI = wp.constant(wp.float64(3.141592653589793))
_DEGENERATE = wp.constant(wp.float64(1.0e-6))  # as VBD has it


@wp.func
def _is_degenerate(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    least_normal = wp.min(wp.length(wp.cross(c - a, d - a)), wp.length(wp.cross(d - b, c - b)))
    return wp.min(least_normal, wp.length(d - c)) < _DEGENERATE


@wp.func
def _dihedral_angle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns the angle between the normals of the triangles a, c, d and b, d, c at the edge from c to d."""
    n1, n2, e = wp.cross(c - a, d - a), wp.cross(d - b, c - b), d - c
    return wp.atan2(wp.dot(wp.cross(n1, n2), e) / wp.length(e), wp.dot(n1, n2))


@wp.func
def edge_corners(elements: Elements, e: int, x: wp.array[Any]):
    """Returns the positions of the particles of two triangles: those off their edge, then those of the edge."""
    v = elements.edge_indices
    return wp.vec3d(x[v[e, 0]]), wp.vec3d(x[v[e, 1]]), wp.vec3d(x[v[e, 2]]), wp.vec3d(x[v[e, 3]])


@wp.func
def _change(elements: Elements, e: int, angle: wp.float64, x0: wp.array[Any]):
    """Returns the change of an angle since the start, and the damping of it, 0 where there is none."""
    damping = wp.float64(elements.edge_properties[e, 1])
    if damping <= ZERO:
        return ZERO, ZERO
    p, q, r, s = edge_corners(elements, e, x0)
    if _is_degenerate(p, q, r, s):
        return ZERO, ZERO
    change = angle - _dihedral_angle(p, q, r, s)
    if change > _PI:
        change = change - _TWO * _PI
    elif change < -_PI:
        change = change + _TWO * _PI
    return change, damping


@wp.func
def energy(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the energy of an edge [J]."""
    a, b, c, d = edge_corners(elements, e, x)
    if _is_degenerate(a, b, c, d):
        return ZERO
    angle = _dihedral_angle(a, b, c, d)
    bent = angle - wp.float64(elements.edge_rest_angle[e])
    change, damping = _change(elements, e, angle, x0)
    energy = wp.float64(elements.edge_properties[e, 0]) * bent * bent + damping / dt * change * change
    return HALF * wp.float64(elements.edge_rest_length[e]) * energy


@wp.func
def bend(elements: Elements, e: int, x: wp.array[Any], x0: wp.array[Any], dt: wp.float64):
    """Returns the derivatives of the angle by corners, the energy, and both its derivatives by the angle, or zeros."""
    a, b, c, d = edge_corners(elements, e, x)
    if _is_degenerate(a, b, c, d):
        return mat43d(), ZERO, ZERO, ZERO
    n1, n2, edge = wp.cross(c - a, d - a), wp.cross(d - b, c - b), d - c
    length = wp.length(edge)
    along = edge / length
    m1, m2 = n1 / wp.dot(n1, n1), n2 / wp.dot(n2, n2)
    angle = _dihedral_angle(a, b, c, d)
    bent = angle - wp.float64(elements.edge_rest_angle[e])
    change, damping = _change(elements, e, angle, x0)
    rest, stiffness = wp.float64(elements.edge_rest_length[e]), wp.float64(elements.edge_properties[e, 0])
    energy = HALF * rest * (stiffness * bent * bent + damping / dt * change * change)
    moment = rest * (stiffness * bent + damping / dt * change)
    turn = wp.matrix_from_rows(
        -length * m1,
        -length * m2,
        -(wp.dot(a - d, along) * m1 + wp.dot(b - d, along) * m2),
        wp.dot(a - c, along) * m1 + wp.dot(b - c, along) * m2,
    )
    return turn, energy, moment, rest * (stiffness + damping / dt)
