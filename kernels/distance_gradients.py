"""Gradients of the time at which two features come within a distance, by the implicit function theorem.

At the time t two points of the features, closest to each other, are the distance d apart: |x| = d, with the vector x
between them and the unit normal N = x / |x|. As the points are closest, moving them within their features changes |x|
in the second order only. So with their weights w_i in x = sum w_i p_i held fixed (in a vertex and a face 1 and minus
the barycentric coordinates), and with the velocity e of the one point relative to the other,

    dt = -N . sum w_i dp_i / (N . e).

The start of a point has the share 1 - t of dp_i, its end the share t. The returned time is a lower bound; gradients are
those at the root of |x| = d within the tolerance after it, which Newton's method finds. Where several pairs of points
are closest, as on parallel edges, gradients are those of one pair.

**Grazing.** Gradients grow without bound where N . e goes to zero. As in :mod:`.gradients`, 1 / (N . e) becomes
N . e / max((N . e)^2, (sigma max(|e|, f))^2), with sigma = 2^-10 and f = 2^-22 of the largest coordinate of the
relative motion. Where this has an effect ``grazing`` is 1, and also where the root is not certain to be within the
tolerance, or is not found there. Features that are nearer than the distance at the start have the time 0, and gradients
of zero.
"""

import warp as wp

from .closest import between
from .custom_gradients import func_grad
from .distance import nearest_pair
from .gradients import MIN_SQUARE_LENGTH, SQUARE_SINE
from .motion import Query, query_motion
from .polynomials import VERTEX_FACE, Motion
from .signs import FREE, ONE, ZERO
from .time_of_impact import Impact, clamped_tolerance, mix_vector

_NEWTON_STEPS = wp.constant(8)
_CONVERGED = wp.constant(wp.float64(2.0**-40))


@wp.struct
class _Reach:
    """The time at which a distance is reached and the terms of its gradient, in the scale of the motion."""

    time: wp.float64
    weights: wp.vec4d
    slope: wp.vec3d  # minus the normal over its product with the velocity: the derivative of the time by x
    grazing: int


@wp.func
def _reach(motion: Motion, distance: wp.float64, found: Impact, tolerance: wp.float64) -> _Reach:
    """Returns when a distance is reached, at the root within the tolerance after the time that was found."""
    reach = _Reach()
    reach.time = found.toi
    reach.grazing = 1
    last = wp.min(found.toi + clamped_tolerance(tolerance), ONE)
    steps = int(_NEWTON_STEPS)  # not a constant, as the body would be repeated
    for i in range(steps):
        t = reach.time
        u = mix_vector(motion.u0, motion.u1, t)
        v = mix_vector(motion.v0, motion.v1, t)
        w = mix_vector(motion.w0, motion.w1, t)
        nearest = nearest_pair(motion.kind, u, v, w)
        at = wp.vec2d(nearest[0], nearest[1])
        gap = between(motion.kind, at, u, v, w)
        size = wp.length(gap)
        if size == ZERO:
            reach.slope = wp.vec3d()
            return reach
        normal = gap / size
        velocity = between(motion.kind, at, motion.u1 - motion.u0, motion.v1 - motion.v0, motion.w1 - motion.w0)
        speed = wp.dot(normal, velocity)
        slowest = SQUARE_SINE * wp.max(wp.length_sq(velocity), MIN_SQUARE_LENGTH)
        approach = speed / wp.max(speed * speed, slowest)
        reach.weights = wp.vec4d(ONE, at[0] + at[1] - ONE, -at[0], -at[1])
        if motion.kind != VERTEX_FACE:
            reach.weights = wp.vec4d(ONE - at[0], at[0], at[1] - ONE, -at[1])
        reach.slope = -approach * normal
        step = (distance - size) * approach
        if i == 0 and t == ZERO and size < distance:  # from the start
            reach.slope = wp.vec3d()
            return reach
        if wp.abs(step) <= _CONVERGED:
            reach.grazing = wp.where(found.within_tolerance == 1 and speed < ZERO and speed * speed >= slowest, 0, 1)
            return reach
        reach.time = wp.clamp(t + step, found.toi, last)
    return reach


@wp.func
def with_distance_gradients(
    kind: int, query: Query, distance: wp.float64, found: Impact, tolerance: wp.float64
) -> Impact:
    """Returns the first contact of a query with a minimum distance, with a time that is differentiable by the points.

    Args:
        kind: VERTEX_FACE, also of a vertex and an edge or two vertices, or EDGE_EDGE.
        query: The points.
        distance: The minimum distance.
        found: First contact of these points.
        tolerance: Tolerance of its time of impact.

    Returns:
        The contact ``found``, with ``grazing``; its time has gradients, its coordinates and normal have none.
    """
    result = found
    result.grazing = 0
    if found.status != FREE:
        result.grazing = 1
        if wp.isfinite(query):
            motion = query_motion(kind, query, ZERO)
            if motion.scale > ZERO:
                result.grazing = _reach(motion, distance * motion.scale, found, tolerance).grazing
    return result


@func_grad(with_distance_gradients, Impact)
def _adjoint_of_with_distance_gradients(
    kind: int, query: Query, distance: wp.float64, found: Impact, tolerance: wp.float64, adj_ret: Impact
):
    if found.status != FREE and wp.isfinite(query):
        motion = query_motion(kind, query, ZERO)
        if motion.scale > ZERO:
            reach = _reach(motion, distance * motion.scale, found, tolerance)
            slope = adj_ret.toi * motion.scale * reach.slope
            before = ONE - reach.time
            after = reach.time
            gradient = Query()
            for i in range(4):
                gradient[i] = before * reach.weights[i] * slope
                gradient[4 + i] = after * reach.weights[i] * slope
            wp.adjoint[query] += gradient
