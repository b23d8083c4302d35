"""The filter before exact arithmetic: floating point with proven bounds."""

import numpy as np

from .coordinates import corners_of, decompose, decompose_with_distance, flattened, scale_to_floats
from .polynomials import dot, triangle_areas, triangle_weights

_PIECES = 8  # into which the filter cuts the step
_MARGIN = 1e-10  # more than the error of any value in the filter, see triangles_may_touch
_HALVINGS = 7  # of the step in the filter of minimum distances
_DISTANCE_MARGIN = 1e-12  # more than the error of any value in it, see polygons_near


def triangles_may_touch(points, pairs):
    """Returns which triangles of queries need exact arithmetic, bool (n, triangles): False is proven to be free.

    A triangle stays clear of the origin when along some axis its corners have one strict sign at both ends, thus
    always; or when in each piece of the step its volume has one strict sign, or one of n.X, n.Y and n.Z is negative.

    The bound, u = 2^-53: coordinates are scaled to at most 1, and in a piece each is mid + half s, |s| <= 1, with mid
    and half at most 1 and off by at most 4 u. Written out, the volume has 6 * 2^3 products of three of these numbers,
    with less than 24 roundings each: it is off by less than 48 (3 * 4 + 24) u < 1e-12. A weight has 3 * 24 * 8 = 576
    products of four, with less than 48 roundings each: it is off by less than 576 (4 * 4 + 48) u < 1e-11. The rest of
    _MARGIN is for the rounding of the sums of absolute values.
    """
    # |points| <= 1 cannot overflow. What underflows here is off by less than 2^-1022, nothing beside a size of 2^-500.
    corners = corners_of(scale_to_floats(*decompose(flattened(points))).reshape(points.shape), pairs)
    # Differences have the sign of the exact ones, or are 0.
    sides = np.sign(corners).sum(axis=(2, 3))
    may_touch = (np.abs(sides) < 6).all(axis=-1)

    size = np.abs(corners).max(axis=(2, 3, 4), initial=0.0)
    filtered = may_touch & (size > 2.0**-500)
    corners = np.ldexp(corners[filtered], -np.frexp(size[filtered])[1][:, None, None, None])
    # From here on a triangle is three corners of three coordinates, each a polynomial in s.
    start, end = np.ascontiguousarray(corners.transpose(2, 1, 3, 0))
    unsure = np.zeros(len(corners), dtype=bool)
    half = (end - start) * (0.5 / _PIECES)
    for piece in range(_PIECES):
        time = (piece + 0.5) / _PIECES
        mid = (1.0 - time) * start + time * end
        x, y, z = ([[mid[i, j], half[i, j]] for j in range(3)] for i in range(3))
        areas = triangle_areas(x, y, z)
        volume, *weights = dot(x, areas[0]), *triangle_weights(areas)
        free = np.abs(volume[0]) > _variation(volume)
        for weight in weights:
            free |= -weight[0] > _variation(weight)
        unsure |= ~free
    may_touch[filtered] = unsure
    return may_touch


def polygons_near(points, pairs, distance):
    """Returns which queries are not proven to be free, and which are proven to collide; two bool arrays (n,).

    In a part of the step a polygon stays farther than d from the origin when along a fixed direction g all its corners
    are farther than d at both ends, thus always. It is within d when one of its points is, at one time. Where both
    fail in a part, its halves are tried.

    The bound, u = 2^-53: coordinates and d are scaled to at most 1, and the components of g are at most 1. A corner is
    the difference of two coordinates, interpolated: off by less than 10 u in each component, and a product with g by
    less than 100 u. The weights of a point of the polygon add up to 1 within 4 u, so that it is off by less than 40 u.
    """
    scaled = scale_to_floats(*decompose_with_distance(points, distance))
    corners, limit = corners_of(scaled[:, :-1].reshape(points.shape), pairs), scaled[:, -1]
    hit = np.zeros(len(points), dtype=bool)
    queries, starts, width = np.arange(len(points)), np.zeros(len(points)), 1.0
    for _ in range(_HALVINGS):
        of_part, far = corners[queries], limit[queries] + _DISTANCE_MARGIN

        def at(time, ends=of_part):
            return (1.0 - time)[:, None, None] * ends[:, :, 0] + time[:, None, None] * ends[:, :, 1]

        low, middle, high = at(starts), at(starts + 0.5 * width), at(starts + width)
        nearest = _nearest_point(middle)
        hit[queries[np.linalg.norm(nearest, axis=1) + _DISTANCE_MARGIN <= limit[queries]]] = True
        size = np.abs(nearest).max(axis=1, keepdims=True)
        g = np.divide(nearest, size, out=np.zeros_like(nearest), where=size > 1e-100)
        along = np.minimum(*((g[:, None] * end).sum(axis=2).min(axis=1) for end in (low, high)))
        unsure = ~(along > far * np.linalg.norm(g, axis=1) + _DISTANCE_MARGIN) & ~hit[queries]
        queries, starts, width = np.repeat(queries[unsure], 2), np.repeat(starts[unsure], 2), 0.5 * width
        starts[1::2] += width
    near = hit.copy()
    near[queries] = True
    return near, hit


def _nearest_point(polygons):
    """Returns about the nearest point to the origin of each polygon, shape (n, corners, 3): one of its points."""
    best, smallest = polygons[:, 0], (polygons[:, 0] ** 2).sum(axis=1)

    def compare(candidates):
        nonlocal best, smallest
        square = (candidates**2).sum(axis=1)
        best = np.where((square < smallest)[:, None], candidates, best)
        smallest = np.minimum(smallest, square)

    n = polygons.shape[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        for i in range(n if n > 2 else n - 1):
            q, e = polygons[:, i], polygons[:, (i + 1) % n] - polygons[:, i]
            s = np.nan_to_num(-(q * e).sum(axis=1) / (e * e).sum(axis=1), nan=0.0)
            compare(q + s.clip(0.0, 1.0)[:, None] * e)
        for i in range(1, n - 1):
            x, y, z = (polygons[:, j] for j in (0, i, i + 1))
            areas = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
            weights = (areas * areas.sum(axis=1, keepdims=True)).sum(axis=2)
            weights = np.where((weights >= 0.0).all(axis=1, keepdims=True), weights, np.nan)
            weights /= weights.sum(axis=1, keepdims=True)
            inside = np.isfinite(weights).all(axis=1)
            weights[~inside] = 1.0, 0.0, 0.0
            compare((weights[:, :, None] * np.stack([x, y, z], axis=1)).sum(axis=1))
    return best


def _variation(f):
    """Returns how far a polynomial can be from its value at 0 for |s| <= 1, rounding included."""
    return sum(np.abs(coefficient) for coefficient in f[1:]) + _MARGIN
