"""Points of bodies that turn at a constant rate while one of their points moves straight: their paths are arcs.

With R(t) the rotation by t times the whole turn, about an axis whose direction does not change, a point of such a body
is at

    x(t) = (1 - t) x0 + t x1 + (R(t) - t R(1) - (1 - t) I) r,    r = x0 - centre,

where the centre is any point of the axis at the start. Where x1 is that of a rigid motion, this is that motion: the
centre moves straight. It always begins at x0 and ends at x1. With k the unit vector along the axis, a the angle of the
whole turn, p = k x r and q = k x p,

    x(t) = (1 - t) x0 + t x1 + (sin ta - t sin a) p + (vers ta - t vers a) q,    vers a = 1 - cos a = 2 sin^2(a / 2).

**Chords.** In a part of the motion that lasts h, the chord from its start to its end, with the same parameter, differs
from x by what the linear interpolation of R(t) r differs from R(t) r, whose second derivative has the norm a^2 |p|. The
linear interpolation of a function over h differs from it by at most h^2 / 8 times the largest norm of its second
derivative (componentwise along the difference, Lagrange's remainder): here by (ha)^2 |p| / 8, the sagitta to leading
order and never less. As R(t) r stays on a circle of radius |p|, and its interpolation in the disc, they are at most
2 |p| apart. A point of an edge or a face is a convex combination of its corners with weights that do not change, on
arcs as on chords, and so is its deviation: it is at most the largest one of its corners.

**Bounds.** u is half an ulp of 1, X a bound of |x0| and |x1|. Of k, components have a relative error of 4u, of r, 1u:
p has an error of 13u |r|, q of 26u |r|. a and a / 2 have relative errors of 3u, with t 4u; a sine has 2 ulp, at most
4u: its value has an error of (4 + 4a) u, and vers of (18 + 8a) u. The two factors, of at most 2 and 4, have errors of
(12 + 8a) u and (44 + 16a) u. With the errors of p and q, and of products and sums, the last two terms have at most
(204 + 24a) u |r|; the straight part and the last sum have 2u X and u (X + 6 |r|). The constants below are more than
twice these.
"""

from typing import Any

import warp as wp

from .motion import double

POSITION_ERROR = 8.0
"""Error of :func:`on_arc` for each unit of a bound of the positions, in half ulps of 1."""
LEVER_ERROR = 512.0
"""The same for each unit of the distance from the centre at the start."""
TURN_ERROR = 64.0
"""The same for each unit of that distance and each radian of the turn."""

_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))


@wp.func
def on_arc(x0: Any, x1: Any, centre: wp.vec3d, turn: wp.vec3d, time: wp.float64) -> wp.vec3d:
    """Returns the position of a point of a turning body at a time, with the error that the module bounds.

    Args:
        x0: Position at the start, vec3 or vec3d.
        x1: Position at the end, of the same type.
        centre: A point of the axis at the start.
        turn: The axis times the angle of the whole turn [rad].
        time: The time, 0 at the start and 1 at the end; 1 - time is exact.
    """
    start = double(x0)
    straight = (_ONE - time) * start + time * double(x1)
    angle = wp.length(turn)
    if angle == _ZERO:
        return straight
    axis = turn / angle
    across = wp.cross(axis, start - centre)
    inward = wp.cross(axis, across)
    half = wp.sin(_HALF * (time * angle))
    whole_half = wp.sin(_HALF * angle)
    sine = wp.sin(time * angle) - time * wp.sin(angle)
    versine = _TWO * (half * half - time * (whole_half * whole_half))
    return straight + (sine * across + versine * inward)
