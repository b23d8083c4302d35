"""Continuous collision detection by a floating-point cubic solver, the paper's baseline "El-Topo-float".

Written from the papers below: Provot 1997; Bridson et al. 2002 (Sec. 7.1 and 7.2); Brochu and Bridson 2009. They have
in common:

- the four points are coplanar at the roots of a cubic, here with its coefficients in the power basis;
- its extrema, by the quadratic formula, cut the step into monotone intervals; a change of sign across one of these
  shows that it has one root, which Newton's method finds, with bisection as a safeguard;
- an end of an interval at which the cubic is zero to within a tolerance counts as a root too. So do both ends of the
  step where the whole cubic is: motion in one plane is tested there and nowhere between;
- at each root, earliest first, the closest points of the two features are found. Closer than a tolerance, they collide.

On the 2,324 hand-made queries of Wang et al. 2021 that the tests read (308 collide), it has 88 false positives and 2
false negatives, where El Topo has 242 and 2. It takes about 100 ns a query on one core, where El Topo took 330 to 357
ns on a larger set that contains them: the baseline is not slower than the original.

All arithmetic is in double precision, as in the original. Queries without a root end early: by the same boxes as in
:mod:`warp_bsc.kernels.ccd`, and by the signs at the ends of monotone intervals.

References:
    Xavier Provot. "Collision and Self-Collision Handling in Cloth Model Dedicated to Design Garments." Computer
    Animation and Simulation (1997). https://doi.org/10.1007/978-3-7091-6874-5_13.

    Robert Bridson, Ronald Fedkiw, and John Anderson. "Robust Treatment of Collisions, Contact and Friction for Cloth
    Animation." ACM Transactions on Graphics 21, 3 (2002). https://doi.org/10.1145/566654.566623.

    Tyson Brochu and Robert Bridson. "Robust Topological Operations for Dynamic Explicit Surfaces." SIAM Journal on
    Scientific Computing 31, 4 (2009). https://doi.org/10.1137/080737617.

    Bolun Wang, Zachary Ferguson, Teseo Schneider, Xin Jiang, Marco Attene, and Daniele Panozzo. "A Large-Scale
    Benchmark and an Inclusion-Based Algorithm for Continuous Collision Detection." ACM Transactions on Graphics 40, 5
    (2021). https://doi.org/10.1145/3460775.
"""

from typing import Any

import warp as wp

from ....kernels.culling import edge_edge_boxes_apart, vertex_face_boxes_apart
from ....kernels.signs import FREE, HALF, HIT, ONE, THREE, TWO, ZERO

COPLANAR = wp.constant(wp.float64(1.0e-9))
"""Largest value of the cubic that counts as zero, as a share of the sum of its coefficients' absolute values."""
DISTANCE = wp.constant(wp.float64(1.0e-6))
"""Distance at which features collide, in the unit of the coordinates: a micrometre, if that is a metre."""

_NEWTON_STEPS = wp.constant(40)
_NEWTON_END = wp.constant(wp.float64(1.0e-10))


@wp.struct
class Relative:
    """The differences of the four points at the start, and their changes over the step.

    Vertex p, triangle a b c: u = b - a, v = c - a, w = p - a. Edges a b and c d: u = b - a, v = d - c, w = c - a.
    """

    u: wp.vec3d
    v: wp.vec3d
    w: wp.vec3d
    du: wp.vec3d
    dv: wp.vec3d
    dw: wp.vec3d


@wp.func
def _double(x: Any) -> wp.vec3d:
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def _relative(u0: wp.vec3d, v0: wp.vec3d, w0: wp.vec3d, u1: wp.vec3d, v1: wp.vec3d, w1: wp.vec3d) -> Relative:
    r = Relative()
    r.u = u0
    r.v = v0
    r.w = w0
    r.du = u1 - u0
    r.dv = v1 - v0
    r.dw = w1 - w0
    return r


@wp.func
def _cubic(r: Relative) -> wp.vec4d:
    """Coefficients of w . (u x v) by powers of t, the constant first."""
    n = wp.cross(r.u, r.v)
    dn = wp.cross(r.du, r.v) + wp.cross(r.u, r.dv)
    ddn = wp.cross(r.du, r.dv)
    return wp.vec4d(
        wp.dot(r.w, n),
        wp.dot(r.dw, n) + wp.dot(r.w, dn),
        wp.dot(r.dw, dn) + wp.dot(r.w, ddn),
        wp.dot(r.dw, ddn),
    )


@wp.func
def _value(c: wp.vec4d, t: wp.float64) -> wp.float64:
    return ((c[3] * t + c[2]) * t + c[1]) * t + c[0]


@wp.func
def _extrema(c: wp.vec4d) -> wp.vec2d:
    """Returns the extrema of the cubic in [0, 1] in order; 1 for one that does not exist.

    The roots of 3 c3 t^2 + 2 c2 t + c1 without cancellation: one as a quotient, the other by the product of both.
    """
    first = ONE
    second = ONE
    discriminant = c[2] * c[2] - THREE * c[3] * c[1]
    if discriminant > ZERO:
        q = -(c[2] + wp.where(c[2] < ZERO, -wp.sqrt(discriminant), wp.sqrt(discriminant)))
        a = q / (THREE * c[3])
        b = c[1] / q
        first = wp.where(a > ZERO and a < ONE, a, ONE)
        second = wp.where(b > ZERO and b < ONE, b, ONE)
    return wp.vec2d(wp.min(first, second), wp.max(first, second))


@wp.func
def _root(c: wp.vec4d, start: wp.float64, end: wp.float64, at_start: wp.float64, at_end: wp.float64) -> wp.float64:
    """Returns the root in an interval where the cubic is monotone and changes sign, by Newton's method."""
    low = start
    high = end
    t = start + (end - start) * (at_start / (at_start - at_end))
    for _ in range(_NEWTON_STEPS):
        value = _value(c, t)
        slope = (THREE * c[3] * t + TWO * c[2]) * t + c[1]
        if (value > ZERO) == (at_start > ZERO):
            low = t
        else:
            high = t
        step = value / slope
        t -= step
        if not (low <= t <= high):
            step = HALF * (high - low)
            t = low + step
        if wp.abs(step) <= _NEWTON_END:
            break
    return t


@wp.func
def _to_segment(w: wp.vec3d, u: wp.vec3d) -> wp.float64:
    """Returns the squared distance of a point w from the segment from the origin to u."""
    uu = wp.dot(u, u)
    s = ZERO
    if uu > ZERO:
        s = wp.clamp(wp.dot(w, u) / uu, ZERO, ONE)
    return wp.length_sq(w - s * u)


@wp.func
def _close(vertex_face: bool, r: Relative, t: wp.float64) -> bool:
    """Returns whether the vertex and the triangle, or both edges, are close to each other at a time."""
    u = r.u + t * r.du
    v = r.v + t * r.dv
    w = r.w + t * r.dw
    limit = DISTANCE * DISTANCE
    uu = wp.dot(u, u)
    uv = wp.dot(u, v)
    vv = wp.dot(v, v)
    uw = wp.dot(u, w)
    vw = wp.dot(v, w)
    determinant = uu * vv - uv * uv
    beta = uw * vv - vw * uv
    gamma = vw * uu - uw * uv  # edges have the other direction of v
    other = wp.where(vertex_face, gamma, -gamma)
    most = wp.where(vertex_face, beta + gamma, wp.max(beta, -gamma))
    if determinant > ZERO and beta >= ZERO and other >= ZERO and most <= determinant:
        return wp.length_sq(w - (beta * u + gamma * v) / determinant) <= limit
    if vertex_face:
        return _to_segment(w, u) <= limit or _to_segment(w, v) <= limit or _to_segment(w - u, v - u) <= limit
    return (
        _to_segment(w, u) <= limit
        or _to_segment(w + v, u) <= limit
        or _to_segment(-w, v) <= limit
        or _to_segment(u - w, v) <= limit
    )


@wp.func
def _solve(vertex_face: bool, r: Relative) -> int:
    c = _cubic(r)
    zero = COPLANAR * (wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) + wp.abs(c[3]))
    turns = _extrema(c)
    start = ZERO
    at_start = c[0]
    if wp.abs(at_start) <= zero and _close(vertex_face, r, start):
        return HIT
    for i in range(3):
        end = wp.where(i == 0, turns[0], wp.where(i == 1, turns[1], ONE))
        if end > start:
            at_end = _value(c, end)
            t = end
            found = wp.abs(at_end) <= zero
            if (at_start < ZERO and at_end > ZERO) or (at_start > ZERO and at_end < ZERO):
                t = _root(c, start, end, at_start, at_end)
                found = True
            if found and _close(vertex_face, r, t):
                return HIT
            start = end
            at_start = at_end
    return FREE


@wp.func
def cubic_solver_vertex_face(p0: Any, a0: Any, b0: Any, c0: Any, p1: Any, a1: Any, b1: Any, c1: Any) -> int:
    """Returns whether a moving vertex p comes close to a moving triangle a b c at a root of the cubic: FREE or HIT.

    Points are ``vec3`` or ``vec3d``, finite, at the start (0) and at the end (1) of the step.
    """
    if vertex_face_boxes_apart(p0, a0, b0, c0, p1, a1, b1, c1):
        return FREE
    o0 = _double(a0)
    o1 = _double(a1)
    return _solve(
        True,
        _relative(
            _double(b0) - o0, _double(c0) - o0, _double(p0) - o0, _double(b1) - o1, _double(c1) - o1, _double(p1) - o1
        ),
    )


@wp.func
def cubic_solver_edge_edge(a0: Any, b0: Any, c0: Any, d0: Any, a1: Any, b1: Any, c1: Any, d1: Any) -> int:
    """Returns whether a moving edge a b comes close to a moving edge c d at a root of the cubic: FREE or HIT.

    Points are ``vec3`` or ``vec3d``, finite, at the start (0) and at the end (1) of the step.
    """
    if edge_edge_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
        return FREE
    return _solve(
        False,
        _relative(
            _double(b0) - _double(a0),
            _double(d0) - _double(c0),
            _double(c0) - _double(a0),
            _double(b1) - _double(a1),
            _double(d1) - _double(c1),
            _double(c1) - _double(a1),
        ),
    )
