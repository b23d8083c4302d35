"""Gradients of first contacts, by the implicit function theorem.

A contact is a time t and two coordinates x, y at which the gap between the features closes,

    g(t, x, y) = w(t) - x u(t) - y v(t) = 0,

with u, v, w as in :mod:`.polynomials`: (x, y) is (beta, gamma) of a vertex in a face, (s, -r) of two edges. Moving the
points changes the contact by

    e dt - u dx - v dy + (dw - x du - y dv) = 0,  e = dg/dt,

the velocity of one feature relative to the other. So for adjoints adj_t, adj_x, adj_y there is one vector q with

    q . e = adj_t,  -q . u = adj_x,  -q . v = adj_y,

and -q, x q, y q are the adjoints of w, u, v at the time of contact. Of the adjoint of a point there, the share 1 - t
belongs to its start, and t to its end. With n = u x v, N = n / |n| and the dual vectors of u and v,

    q = (adj_t + d . e) / (N . e) N - d,  d = adj_x u* + adj_y v*,  u* = v x n / n^2,  v* = n x u / n^2.

For the time alone q is n / (dY/dt), with Y = w . n: the implicit function theorem for Y(t) = 0. The normal N is a
function of u and v, hence of the time too, which adds to adj_t.

**At the root.** The returned time of impact is a lower bound. Gradients are those at the root of Y within the tolerance
after it, which Newton's method on N . g finds to double precision, with x and y solved for each time.

**Grazing.** Gradients grow without bound where dY/dt = n . e goes to zero: features slide along each other, rest, or
have no plane (parallel edges, a collapsed triangle), or all motion is in one plane. So the divisors are clamped away
from zero, with sigma = 2^-10, and lengths are at least f = 2^-22 of the largest coordinate of the relative motion:

    1 / (N . e)  becomes  N . e / max((N . e)^2, (sigma max(|e|, f))^2),
    1 / n^2      becomes  1 / max(n^2, (sigma max(|u|, f) max(|v|, f))^2).

Gradients of the time are then at most 2^33 over that coordinate, and fade to zero where there is no derivative. Where
one of the clamps has an effect, ``grazing`` is 1. It is 1 as well where the root is not certain: where contact within
the tolerance is not certain, and gradients are those of a contact at the time of impact with the coordinates and the
normal there; and where Y both rises and falls within the tolerance.

Gradients of points in single precision are rounded to it, and at most 2^100. Where the largest coordinate of the
relative motion is 1e-280 or less, or 2^1023 or more, gradients would be out of range: they are zero, and ``grazing``
is 1.
"""

import warp as wp

from .bernstein import mix, restrict_cubic
from .custom_gradients import func_grad
from .motion import Query, query_motion
from .polynomials import VERTEX_FACE, Motion, coplanarity
from .signs import FREE, ONE, ZERO
from .time_of_impact import Impact, approximate_root, clamped_tolerance, mix_vector

SQUARE_SINE = wp.constant(wp.float64(2.0**-20))  # sigma^2
MIN_SQUARE_LENGTH = wp.constant(wp.float64(2.0**-44))  # f^2
_NEWTON_STEPS = wp.constant(8)
_NEWTON_END = wp.constant(wp.float64(2.0**-50))
_CONVERGED = wp.constant(wp.float64(2.0**-40))


@wp.struct
class Touch:
    """A contact and the terms of its gradients, see the module, in the scale of the motion."""

    t: wp.float64
    x: wp.float64
    y: wp.float64
    u: wp.vec3d
    v: wp.vec3d
    n: wp.vec3d
    velocity: wp.vec3d  # e
    normal: wp.vec3d  # unit normal, N or its opposite
    area: wp.float64  # |n|^2, clamped away from zero
    approach: wp.float64  # 1 / (normal . e), clamped away from infinity
    grazing: int  # 1 where a clamp has an effect


@wp.func
def _square_length(x: wp.vec3d) -> wp.float64:
    """Returns the squared length of a vector, at least f^2."""
    return wp.max(wp.length_sq(x), MIN_SQUARE_LENGTH)


@wp.func
def _touch_at(motion: Motion, t: wp.float64, x: wp.float64, y: wp.float64, normal: wp.vec3d, planar: bool) -> Touch:
    """Returns the touch at a time, with given coordinates and normal or, if ``planar``, those in the plane there."""
    at = Touch()
    at.t = t
    at.u = mix_vector(motion.u0, motion.u1, t)
    at.v = mix_vector(motion.v0, motion.v1, t)
    at.n = wp.cross(at.u, at.v)
    square = wp.length_sq(at.n)
    smallest = SQUARE_SINE * _square_length(at.u) * _square_length(at.v)
    at.area = wp.max(square, smallest)
    at.x = x
    at.y = y
    at.normal = normal
    at.grazing = 1
    if planar and square >= smallest:
        w = mix_vector(motion.w0, motion.w1, t)
        at.x = wp.dot(wp.cross(at.v, at.n), w) / square
        at.y = wp.dot(wp.cross(at.n, at.u), w) / square
        at.normal = at.n / wp.sqrt(square)
        if wp.dot(at.normal, normal) < ZERO:
            at.normal = -at.normal
        at.grazing = 0
    at.velocity = motion.w1 - motion.w0 - at.x * (motion.u1 - motion.u0) - at.y * (motion.v1 - motion.v0)
    speed = wp.dot(at.normal, at.velocity)
    slowest = SQUARE_SINE * _square_length(at.velocity)
    at.approach = speed / wp.max(speed * speed, slowest)
    if speed * speed < slowest:
        at.grazing = 1
    return at


@wp.func
def _touch(motion: Motion, found: Impact, tolerance: wp.float64) -> Touch:
    """Returns the touch of a contact, at the root within the tolerance after its time of impact."""
    x = found.coordinates[0]
    y = -found.coordinates[1]
    if motion.kind == VERTEX_FACE:
        x = found.coordinates[1]
        y = found.coordinates[2]
    at = _touch_at(motion, found.toi, x, y, found.normal, found.within_tolerance == 1)
    if at.grazing == 1:
        return at
    last = wp.min(found.toi + clamped_tolerance(tolerance), ONE)
    k = restrict_cubic(coplanarity(motion).k, found.toi, last)
    if k[0] * k[3] < ZERO:
        t = mix(found.toi, last, approximate_root(k))
        at = _touch_at(motion, t, x, y, found.normal, True)
    step = ONE
    for _ in range(_NEWTON_STEPS):
        gap = mix_vector(motion.w0, motion.w1, at.t) - at.x * at.u - at.y * at.v
        step = wp.dot(at.normal, gap) * at.approach
        at = _touch_at(motion, wp.clamp(at.t - step, found.toi, last), x, y, found.normal, True)
        if wp.abs(step) <= _NEWTON_END:
            break
    slopes = wp.vec3d(k[1] - k[0], k[2] - k[1], k[3] - k[2])
    if wp.abs(step) > _CONVERGED or not (wp.min(slopes) > ZERO or wp.max(slopes) < ZERO):
        at.grazing = 1
    return at


@wp.func
def with_gradients(kind: int, query: Query, found: Impact, tolerance: wp.float64) -> Impact:
    """Returns the first contact of a query as a differentiable function of the query's points.

    Args:
        kind: VERTEX_FACE or EDGE_EDGE.
        query: The points.
        found: First contact of these points.
        tolerance: Tolerance of its time of impact.

    Returns:
        The contact ``found``, with ``grazing``; its time, coordinates and normal have gradients.
    """
    result = found
    result.grazing = 0
    if found.status != FREE:
        result.grazing = 1
        if wp.isfinite(query):
            motion = query_motion(kind, query, ZERO)
            if motion.scale > ZERO:
                result.grazing = _touch(motion, found, tolerance).grazing
    return result


@func_grad(with_gradients, Impact)
def _adjoint_of_with_gradients(kind: int, query: Query, found: Impact, tolerance: wp.float64, adj_ret: Impact):
    if found.status != FREE and wp.isfinite(query):
        motion = query_motion(kind, query, ZERO)
        at = _touch(motion, found, tolerance)
        # the normal, along u and v, which move with the time
        turn = adj_ret.normal - wp.dot(at.normal, adj_ret.normal) * at.normal
        turn = wp.dot(at.n, at.normal) / at.area * turn
        adj_u = wp.cross(at.v, turn)
        adj_v = wp.cross(turn, at.u)
        adj_t = adj_ret.toi + wp.dot(adj_u, motion.u1 - motion.u0) + wp.dot(adj_v, motion.v1 - motion.v0)
        adj_x = adj_ret.coordinates[0]
        adj_y = -adj_ret.coordinates[1]
        if kind == VERTEX_FACE:
            adj_x = adj_ret.coordinates[1] - adj_ret.coordinates[0]
            adj_y = adj_ret.coordinates[2] - adj_ret.coordinates[0]
        # d and q as in the module's docstring
        d = (adj_x * wp.cross(at.v, at.n) + adj_y * wp.cross(at.n, at.u)) / at.area
        q = (adj_t + wp.dot(d, at.velocity)) * at.approach * at.normal - d
        adj_u = motion.scale * (adj_u + at.x * q)
        adj_v = motion.scale * (adj_v + at.y * q)
        adj_w = -motion.scale * q
        adj_a = adj_w
        adj_b = -(adj_u + adj_v + adj_w)
        adj_c = adj_u
        adj_d = adj_v
        if kind != VERTEX_FACE:
            adj_a = -(adj_u + adj_w)
            adj_b = adj_u
            adj_c = adj_w - adj_v
        s = ONE - at.t
        wp.adjoint[query] += wp.matrix_from_rows(
            s * adj_a, s * adj_b, s * adj_c, s * adj_d, at.t * adj_a, at.t * adj_b, at.t * adj_c, at.t * adj_d
        )
