"""Queries that aim at trouble: degenerate, nearly degenerate and badly scaled vertex-face and edge-edge pairs.

A generator takes (rng, n, kind, dtype), kind "vertex_face" or "edge_edge", dtype float32 or float64, and returns finite
points of shape (n, 8, 3) in the order of the queries: p a b c or a b c d at the start, then at the end. GENERATORS has
them all by name.

Most work with the gap of a pair: sum(w_i x_i) for signed weights w, which is p - (w_a a + w_b b + w_c c) for a vertex
and a face and c + r (d - c) - (a + s (b - a)) for two edges. A pair touches when some weights in range make it zero.
Coordinates, weights and times are multiples of small powers of two wherever the contact is to be exact, in float32 too.
"""

import numpy as np

_MOVER = {"vertex_face": [0], "edge_edge": [2, 3]}  # the points that a gap moves with


def _lattice(rng, n, size=8):
    """Returns four points with integer coordinates up to size, shape (n, 4, 3)."""
    return rng.integers(-size, size + 1, (n, 4, 3)).astype(np.float64)


def _face_weights(rng, n, corners):
    """Returns weights of the first so many corners of a face, multiples of 1/4 that add up to 1, shape (n, 3)."""
    cuts = np.sort(rng.integers(0, 5, (n, corners - 1)), axis=1)
    weights = np.diff(cuts, axis=1, prepend=0, append=4) / 4.0
    return np.pad(weights, ((0, 0), (0, 3 - corners)))


def _signed_weights(kind, face=None, s=None, r=None):
    """Returns the weights of the gap, shape (n, 4)."""
    if kind == "vertex_face":
        return np.concatenate([np.ones((len(face), 1)), -face], axis=1)
    return np.stack([s - 1.0, -s, 1.0 - r, r], axis=1)


def _weights(rng, n, kind):
    """Returns signed weights of random features, corners and edges among them, multiples of 1/4, shape (n, 4)."""
    if kind == "vertex_face":
        return _signed_weights(kind, face=_face_weights(rng, n, 3))
    s, r = rng.integers(0, 5, (2, n)) / 4.0
    return _signed_weights(kind, s=s, r=r)


def _gap(points, weights):
    return np.einsum("ni,nij->nj", weights, points)


def _with_gap(points, weights, kind, gap=0.0):
    """Returns the points with the mover translated until the gap is the one given."""
    points = points.copy()
    points[:, _MOVER[kind]] += (gap - _gap(points, weights))[:, None]
    return points


def _times(rng, n):
    """Returns times in [0, 1], multiples of 1/8, the ends as often as all others."""
    return np.where(rng.random(n) < 0.5, rng.integers(0, 2, n), rng.integers(1, 8, n) / 8.0)


def _motion(position, velocity, time):
    """Returns queries whose points are at the position, shape (n, 4, 3), at the time, shape (n,), with the velocity."""
    time = np.reshape(time, (-1, 1, 1))
    return np.concatenate([position - time * velocity, position + (1.0 - time) * velocity], axis=1)


def _moved_by_an_ulp(rng, points, mask):
    """Returns the points with the coordinates in the mask moved to the next float, up or down."""
    target = np.where(rng.random(points.shape) < 0.5, np.inf, -np.inf).astype(points.dtype)
    return np.where(mask, np.nextafter(points, target), points)


def exact_contacts(rng, n, kind, dtype):
    """Returns queries with exact contact at a known time, which need not be the first one.

    Returns:
        (points, times), times float64 of shape (n,).
    """
    weights = _weights(rng, n, kind)
    time = _times(rng, n)
    return _motion(_with_gap(_lattice(rng, n), weights, kind), _lattice(rng, n), time).astype(dtype), time


def uniform(rng, n, kind, dtype):
    """All coordinates uniform in [-1, 1]."""
    return rng.uniform(-1.0, 1.0, (n, 8, 3)).astype(dtype)


def mostly_hits(rng, n, kind, dtype):
    """Pairs that pass through each other well inside both features, so that nearly all collide."""
    if kind == "vertex_face":
        weights = _signed_weights(kind, face=0.1 + 0.7 * rng.dirichlet((1.0, 1.0, 1.0), n))
    else:
        s, r = rng.uniform(0.1, 0.9, (2, n))
        weights = _signed_weights(kind, s=s, r=r)
    offset = rng.uniform(-1.0, 1.0, (n, 3))
    start = _with_gap(rng.uniform(-1.0, 1.0, (n, 4, 3)), weights, kind, offset)
    end = _with_gap(rng.uniform(-1.0, 1.0, (n, 4, 3)), weights, kind, -offset * rng.uniform(0.2, 2.0, (n, 1)))
    return np.concatenate([start, end], axis=1).astype(dtype)


def near_degenerate(rng, n, kind, dtype):
    """Sliver triangles and nearly parallel edges, by 2^-1 to 2^-60, at both ends of a step through each other."""
    thickness = 2.0 ** rng.uniform(-60.0, -1.0, (n, 1))
    weights = _weights(rng, n, kind)
    offset = rng.uniform(-1.0, 1.0, (n, 3))
    ends = []
    for gap in (offset, -offset):
        points = rng.uniform(-1.0, 1.0, (n, 4, 3))
        shift = thickness * rng.uniform(-1.0, 1.0, (n, 3)) + rng.uniform(-1.0, 1.0, (n, 1)) * (
            points[:, 2] - points[:, 1] if kind == "vertex_face" else points[:, 1] - points[:, 0]
        )
        points[:, 3] = points[:, 1 if kind == "vertex_face" else 2] + shift
        ends.append(_with_gap(points, weights, kind, gap))
    return np.concatenate(ends, axis=1).astype(dtype)


def coplanar(rng, n, kind, dtype):
    """Motion in one plane exactly, parallel to axes or oblique; every other query touches at some time."""
    along = rng.integers(-3, 4, (n, 2, 3)).astype(np.float64)
    axis_aligned = rng.random(n) < 0.5
    first = rng.integers(0, 3, n)
    along[axis_aligned] = np.stack([np.eye(3)[first], np.eye(3)[(first + 1) % 3]], axis=1)[axis_aligned]
    weights = _weights(rng, n, kind)
    position, velocity = _lattice(rng, n), _lattice(rng, n)
    aimed = rng.random(n) < 0.5
    position[aimed] = _with_gap(position, weights, kind)[aimed]
    planar = _motion(position, velocity, _times(rng, n))[..., :2]
    shift = np.where(axis_aligned, 1.0, 0.0)[:, None, None] * rng.integers(-8, 9, (n, 1, 3))
    return (planar @ along + shift).astype(dtype)


def almost_coplanar(rng, n, kind, dtype):
    """Motion in one plane, then up to three of the coordinates off by some ulp."""
    points = coplanar(rng, n, kind, dtype)
    mask = rng.random(points.shape) < rng.choice([1, 2, 3], (n, 1, 1)) / 24.0
    for _ in range(3):
        points = _moved_by_an_ulp(rng, points, mask & (rng.random(points.shape) < 0.7))
    return points


def one_ulp_apart(rng, n, kind, dtype):
    """Exact contact, then one of the coordinates moved to the next float."""
    points, _ = exact_contacts(rng, n, kind, dtype)
    mask = np.arange(24) == rng.integers(0, 24, (n, 1))
    return _moved_by_an_ulp(rng, points, mask.reshape(n, 8, 3))


def mixed_scales(rng, n, kind, dtype):
    """Scales from 1e-30 to 1e30: one for each query, for each of its points, or for each coordinate."""
    points = mostly_hits(rng, n, kind, np.float64)
    shapes = np.stack(
        [np.broadcast_to(rng.uniform(-30.0, 30.0, (n, *shape)), (n, 8, 3)) for shape in ((1, 1), (8, 1), (8, 3))]
    )
    return (points * 10.0 ** shapes[rng.integers(0, 3, n), np.arange(n)]).astype(dtype)


def integer_lattice(rng, n, kind, dtype):
    """Integer coordinates from -2 to 2."""
    return rng.integers(-2, 3, (n, 8, 3)).astype(dtype)


def shared_coordinates(rng, n, kind, dtype):
    """Random points that have coordinates of one another, and points that repeat, at one end or throughout."""
    points = uniform(rng, n, kind, dtype)
    rows = np.arange(n)
    for _ in range(6):
        axis = rng.integers(0, 3, n)
        points[rows, rng.integers(0, 8, n), axis] = points[rows, rng.integers(0, 8, n), axis]
    # A point of the second half takes the place of one of the first, then another one also at the end of the step.
    once = rng.random(n) < 0.5
    target, source = rng.integers(0, 8, (2, n))
    points[rows[once], target[once]] = points[rows[once], source[once]]
    throughout = rng.random(n) < 0.3
    target, source = rng.integers(0, 4, (2, n))
    for end in (0, 4):
        points[rows[throughout], target[throughout] + end] = points[rows[throughout], source[throughout] + end]
    return points


def resting_contact(rng, n, kind, dtype):
    """One plane at t = 0, so that k0 = 0: held, carried along, lifting or sliding; two thirds of them touch there."""
    position = _lattice(rng, n)
    weights = _weights(rng, n, kind)
    beside = rng.random(n) < 1 / 3
    # Weights out of range put the pair in one plane without contact.
    weights[beside] += rng.integers(1, 3, (beside.sum(), 1)) * np.array(
        [0.0, -1.0, 1.0, 0.0] if kind == "vertex_face" else [-1, 1, 0, 0]
    )
    position = _with_gap(position, weights, kind)
    velocity = np.zeros((n, 4, 3))
    how = rng.integers(0, 4, n)[:, None, None]
    carried = np.broadcast_to(rng.integers(-4, 5, (n, 1, 3)), velocity.shape)
    lifted, slid = velocity.copy(), velocity.copy()
    lifted[:, _MOVER[kind]] = rng.integers(-4, 5, (n, 1, 3))
    slid[:, _MOVER[kind]] = (rng.integers(-1, 2, (n, 1)) * (position[:, 1] - position[:, 2]))[:, None]
    velocity = np.select([how == 1, how == 2, how == 3], [carried, lifted, slid], velocity)
    return _motion(position, velocity, np.zeros(n)).astype(dtype)


def grazing(rng, n, kind, dtype):
    """Contact without relative velocity along the normal, a double root, exactly or with one coordinate an ulp off."""
    weights = _weights(rng, n, kind)
    position = _with_gap(_lattice(rng, n, 4), weights, kind)
    in_plane = rng.integers(-1, 2, (2, n, 1))
    i, j, k = (1, 2, 3) if kind == "vertex_face" else (0, 1, 3)
    third = position[:, 1] if kind == "vertex_face" else position[:, 2]
    slide = in_plane[0] * (position[:, j] - position[:, i]) + in_plane[1] * (position[:, k] - third)
    velocity = _with_gap(_lattice(rng, n, 4), weights, kind, slide)
    points = _motion(position, velocity, _times(rng, n)).astype(dtype)
    mask = (np.arange(24) == rng.integers(0, 24, (n, 1))) & (rng.random((n, 1)) < 0.5)
    return _moved_by_an_ulp(rng, points, mask.reshape(n, 8, 3))


def collapsing(rng, n, kind, dtype):
    """Triangles that are segments or points, edges that are parallel or points, once or always; most touch then."""
    position, velocity = _lattice(rng, n, 4), _lattice(rng, n, 4)
    always = rng.random(n) < 0.3
    to_point = rng.random(n) < 0.4
    ratio = rng.integers(-2, 3, (n, 1)).astype(np.float64)
    for points, rows in ((position, np.ones(n, dtype=bool)), (velocity, always)):
        i, j, k = (1, 2, 3) if kind == "vertex_face" else (0, 1, 3)
        base = points[:, i] if kind == "vertex_face" else points[:, 2]
        points[rows, k] = (base + ratio * (points[:, j] - points[:, i]))[rows]
        points[rows & to_point, j] = points[rows & to_point, i]
        both = rows & to_point & (ratio[:, 0] > 0)
        points[both, k] = base[both]
    aimed = rng.random(n) < 0.7
    position[aimed] = _with_gap(position, _weights(rng, n, kind), kind)[aimed]
    return _motion(position, velocity, _times(rng, n)).astype(dtype)


def touching(rng, n, kind, dtype):
    """Exact contact of vertex and vertex or vertex and edge, at t = 0, t = 1 or between."""
    if kind == "vertex_face":
        face = rng.permuted(_face_weights(rng, n, 2), axis=1)
        weights = _signed_weights(kind, face=face)
    else:
        corner, anywhere = rng.integers(0, 2, n).astype(np.float64), rng.integers(0, 5, n) / 4.0
        swap = rng.random(n) < 0.5
        weights = _signed_weights(kind, s=np.where(swap, anywhere, corner), r=np.where(swap, corner, anywhere))
    return _motion(_with_gap(_lattice(rng, n), weights, kind), _lattice(rng, n), _times(rng, n)).astype(dtype)


def subnormal_and_huge(rng, n, kind, dtype):
    """Exact contacts, half of them one ulp apart, scaled to subnormal or huge numbers, by query or by point."""
    points = exact_contacts(rng, n, kind, np.float64)[0]
    info = np.finfo(dtype)
    small, huge = info.minexp - info.nmant + 3, info.maxexp - 6  # The points are multiples of 2^-3 below 2^6.
    of_query = rng.integers(0, 2, (n, 1, 1))
    of_point = np.where(rng.random((n, 1, 1)) < 0.3, rng.integers(0, 2, (n, 8, 1)), of_query)
    points = np.ldexp(points, np.where(of_point == 0, small, huge)).astype(dtype)
    mask = (np.arange(24) == rng.integers(0, 24, (n, 1))) & (rng.random((n, 1)) < 0.5)
    return _moved_by_an_ulp(rng, points, mask.reshape(n, 8, 3))


GENERATORS = {
    generator.__name__: generator
    for generator in (
        uniform,
        mostly_hits,
        near_degenerate,
        coplanar,
        almost_coplanar,
        one_ulp_apart,
        mixed_scales,
        integer_lattice,
        shared_coordinates,
        resting_contact,
        grazing,
        collapsing,
        touching,
        subnormal_and_huge,
    )
}
