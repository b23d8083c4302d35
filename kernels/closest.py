"""Closest points of the two features of a query at one time: separating directions, contact coordinates and normal.

None of this is certified: culling accepts any direction, and coordinates are rounded like any other result.
"""

import warp as wp

from .pairs import firsts_of
from .polynomials import EDGE_EDGE, VERTEX_EDGE, VERTEX_FACE, VERTEX_VERTEX, Motion

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
FLAT = wp.constant(wp.float64(1.0e-24))
_PARALLEL = wp.constant(wp.float64(1.0e-12))
"""Squared sine up to which edges, or two sides of a face, count as parallel."""


@wp.func
def ratio(x: wp.float64, y: wp.float64) -> wp.float64:
    """Returns x / y, clamped to [0, 1]; 0 where y is zero, the squared length of a collapsed edge."""
    if y > _ZERO:
        return wp.clamp(x / y, _ZERO, _ONE)
    return _ZERO


@wp.func
def _closest_vertex_face(u: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.vec2d:
    """Returns (beta, gamma) of the point of the triangle 0, u, v that is closest to w."""
    n = wp.cross(u, v)
    beta = wp.dot(wp.cross(w, v), n)
    gamma = wp.dot(wp.cross(u, w), n)
    nn = wp.dot(n, n)
    if nn > _ZERO and beta >= _ZERO and gamma >= _ZERO and beta + gamma <= nn:
        return wp.vec2d(beta / nn, gamma / nn)
    s_u = ratio(wp.dot(w, u), wp.dot(u, u))
    s_v = ratio(wp.dot(w, v), wp.dot(v, v))
    s_uv = ratio(wp.dot(w - u, v - u), wp.dot(v - u, v - u))
    to_u = wp.length_sq(w - s_u * u)
    to_v = wp.length_sq(w - s_v * v)
    to_uv = wp.length_sq(w - u - s_uv * (v - u))
    if to_u <= to_v and to_u <= to_uv:
        return wp.vec2d(s_u, _ZERO)
    if to_v <= to_uv:
        return wp.vec2d(_ZERO, s_v)
    return wp.vec2d(_ONE - s_uv, s_uv)


@wp.func
def _closest_edge_edge(u: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.vec2d:
    """Returns (s, r) of the closest points s u and w + r v of two segments."""
    uu = wp.dot(u, u)
    vv = wp.dot(v, v)
    uv = wp.dot(u, v)
    uw = wp.dot(u, w)
    vw = wp.dot(v, w)
    s = ratio(uw * vv - uv * vw, uu * vv - uv * uv)
    r = ratio(uv * s - vw, vv)
    return wp.vec2d(ratio(uv * r + uw, uu), r)


@wp.func
def closest_coordinates(kind: int, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.vec2d:
    """Returns the coordinates of the closest points: (beta, gamma) of the triangle, or (s, r) along the edges."""
    if kind == VERTEX_FACE:
        return _closest_vertex_face(u, v, w)
    return _closest_edge_edge(u, v, w)


@wp.func
def between(kind: int, coordinates: wp.vec2d, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
    """Returns the vector from the second feature (face, edge c d) to the first (vertex, edge a b) at coordinates."""
    if kind == VERTEX_FACE:
        return w - coordinates[0] * u - coordinates[1] * v
    return coordinates[0] * u - coordinates[1] * v - w


@wp.func
def unit_scale(x: wp.vec3d) -> wp.vec3d:
    """Returns a vector divided by its largest component, so that squares do not underflow; zero stays zero."""
    size = wp.max(wp.abs(x))
    if size > _ZERO:
        return x / size
    return x


@wp.func
def contact_at(motion: Motion, time: wp.float64):
    """Returns coordinates and normal of a contact at its time.

    Returns:
        Coordinates (vertex-face: barycentric in the face; edge-edge: s along a b, r along c d, 0), and the unit
        normal, which points against the velocity of the vertex or of edge a b relative to the other feature.
        Parallel edges and collapsed triangles have no plane: their normal is along that velocity.
    """
    u = (_ONE - time) * motion.u0 + time * motion.u1
    v = (_ONE - time) * motion.v0 + time * motion.v1
    w = (_ONE - time) * motion.w0 + time * motion.w1
    closest = closest_coordinates(motion.kind, u, v, w)
    velocity = unit_scale(
        between(motion.kind, closest, motion.u1 - motion.u0, motion.v1 - motion.v0, motion.w1 - motion.w0)
    )
    unit_u = unit_scale(u)
    unit_v = unit_scale(v)
    normal = wp.cross(unit_u, unit_v)
    if wp.length_sq(normal) <= FLAT * wp.length_sq(unit_u) * wp.length_sq(unit_v):
        normal = velocity
    if wp.length_sq(normal) == _ZERO:
        normal = wp.vec3d(_ZERO, _ZERO, _ONE)
    if wp.dot(normal, velocity) > _ZERO:
        normal = -normal
    coordinates = wp.vec3d(closest[0], closest[1], _ZERO)
    if motion.kind == VERTEX_FACE:
        coordinates = wp.vec3d(_ONE - closest[0] - closest[1], closest[0], closest[1])
    return coordinates, wp.normalize(normal)


@wp.func
def contact_weights(kind: int, c: wp.vec3d) -> wp.vec4d:
    """Returns the weights of four points in the vector between contact points, by kind and coordinates of a contact."""
    if kind == EDGE_EDGE:
        return wp.vec4d(_ONE - c[0], c[0], c[1] - _ONE, -c[1])
    if kind == VERTEX_EDGE:
        return wp.vec4d(_ONE, c[0] - _ONE, -c[0], _ZERO)
    if kind == VERTEX_VERTEX:
        return wp.vec4d(_ONE, -_ONE, _ZERO, _ZERO)
    return wp.vec4d(_ONE, -c[0], -c[1], -c[2])


@wp.func
def closest_weights(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec4d:
    """Returns the weights of four points in the vector between the closest points of two elements."""
    if kind == EDGE_EDGE:
        at = closest_coordinates(EDGE_EDGE, b - a, d - c, c - a)
        return wp.vec4d(_ONE - at[0], at[0], at[1] - _ONE, -at[1])
    at = closest_coordinates(VERTEX_FACE, c - b, d - b, a - b)
    return wp.vec4d(_ONE, at[0] + at[1] - _ONE, -at[0], -at[1])


@wp.func
def weights_across(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns where the line across two elements meets them.

    Returns:
        The weights of the four points in the vector between the two points, the unit vector across both elements, from
        the second to the first, and the distance along it, which is 0 unless both points are within the elements: only
        then are they their closest points.
    """
    u = wp.where(kind == EDGE_EDGE, b - a, c - b)
    v = wp.where(kind == EDGE_EDGE, d - c, d - b)
    w = wp.where(kind == EDGE_EDGE, c - a, a - b)
    n = wp.cross(u, v)
    nn = wp.length_sq(n)
    s = wp.dot(wp.cross(w, v), n)
    r = wp.dot(wp.cross(u, w), n)
    weights = wp.vec4d()
    if nn <= _PARALLEL * wp.length_sq(u) * wp.length_sq(v) or not (s > _ZERO and s < nn):
        return weights, n, _ZERO
    height = wp.dot(w, n)
    s /= nn
    r /= nn
    if kind == EDGE_EDGE:
        height = -height
        r = -r
        weights = wp.vec4d(_ONE - s, s, r - _ONE, -r)
    else:
        weights = wp.vec4d(_ONE, s + r - _ONE, -s, -r)
    size = wp.sqrt(nn)
    n *= wp.sign(height) / size
    if r > _ZERO and weights[firsts_of(kind)] < _ZERO:
        return weights, n, wp.abs(height) / size
    return weights, n, _ZERO
