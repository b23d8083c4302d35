"""The kernels of the repair: gradients of contours, and springs that keep the shape of the input."""

import warp as wp

from ..kernels.signs import HALF, ONE, TWO, ZERO

wp.set_module_options({"enable_backward": False})

_TINY = wp.constant(wp.float64(1.0e-300))
_FLATTEST = wp.constant(wp.float64(0.05))
"""Sine of the smallest angle between an edge and a face with which a gradient is computed."""


@wp.func
def _direction(v: wp.vec3d) -> wp.vec3d:
    """Returns a vector of length 1, or 0 for 0."""
    return v / wp.max(wp.length(v), _TINY)


@wp.kernel
def grow_ring(edges: wp.array2d[int], ring: int, ring_of: wp.array[int]):
    """Puts vertices into the next ring that an edge joins with a ring up to this one, in any order of threads."""
    i = wp.tid()
    a, b = edges[i, 0], edges[i, 1]
    if ring_of[a] <= ring:
        wp.atomic_min(ring_of, b, ring + 1)
    if ring_of[b] <= ring:
        wp.atomic_min(ring_of, a, ring + 1)


@wp.kernel
def contour_gradients(
    # mesh
    x: wp.array[wp.vec3d],
    edges: wp.array2d[int],
    faces: wp.array2d[int],
    # in
    pairs: wp.array[wp.vec2i],
    starts: wp.array[int],
    opposite: wp.array[int],
    # out
    along: wp.array[wp.float64],
    coordinates: wp.array[wp.vec3d],
    gradient: wp.array[wp.vec3d],
):
    """Finds where an edge passes through a face, and the direction in which it leaves soonest.

    The vertices across the edge in its faces are ``opposite[starts[i]:starts[i + 1]]``. For an edge with direction E
    through a face with normal N, and the direction R of the contour into a face of the edge, the gradient of the length
    of the contour is the sum of R - 2 (E.R)/(E.N) N over its faces (Volino and Magnenat-Thalmann 2006). It is scaled
    down to length 1 where it is longer.
    """
    i = wp.tid()
    edge = pairs[i][0]
    face = pairs[i][1]
    p = x[edges[edge, 0]]
    q = x[edges[edge, 1]]
    a = x[faces[face, 0]]
    u = x[faces[face, 1]] - a
    v = x[faces[face, 2]] - a
    n = wp.cross(u, v)
    normal = _direction(n)
    e = _direction(q - p)
    from_p = wp.dot(p - a, normal)
    s = wp.clamp(from_p / wp.where(from_p == wp.dot(q - a, normal), ONE, from_p - wp.dot(q - a, normal)), ZERO, ONE)
    w = p + s * (q - p) - a
    nn = wp.max(wp.dot(n, n), _TINY)
    beta = wp.clamp(wp.dot(wp.cross(w, v), n) / nn, ZERO, ONE)
    gamma = wp.clamp(wp.dot(wp.cross(u, w), n) / nn, ZERO, ONE - beta)
    along[i] = s
    coordinates[i] = wp.vec3d(ONE - beta - gamma, beta, gamma)
    steep = wp.dot(e, normal)
    steep = wp.where(steep < ZERO, wp.min(steep, -_FLATTEST), wp.max(steep, _FLATTEST))
    total = wp.vec3d()
    for k in range(starts[i], starts[i + 1]):
        inward = x[opposite[k]] - p
        inward -= wp.dot(inward, e) * e
        r = _direction(wp.cross(normal, wp.cross(e, inward)))
        if wp.dot(r, inward) < ZERO:
            r = -r
        total += r - TWO * wp.dot(e, r) / steep * normal
    gradient[i] = total / wp.max(wp.length(total), ONE)


@wp.struct
class Planes:
    """Planes that keep the elements of contacts apart, by vertex."""

    # where the places of each row of vertices begin, and their number at last, array of int; None if there are no
    # planes
    starts: wp.array[int]
    places: wp.array[int]  # contacts of the vertices, each as 4 times its number plus that of the corner, array of int
    vertices: wp.array[wp.vec4i]  # corners of each contact, those of the second element last, array of vec4i
    # coordinates of the contact in the elements, those of the second one negative, array of vec4d
    weights: wp.array[wp.vec4d]
    normals: wp.array[wp.vec3d]  # normals, array of vec3d
    gaps: wp.array[wp.float64]  # distances along the normal, array of float64
    # reciprocal sums of the squared weights of corners that may move, array of float64
    mobilities: wp.array[wp.float64]


@wp.func
def _shortfall(x: wp.array[wp.vec3d], planes: Planes, contact: int) -> wp.float64:
    """Returns how much a contact lacks of its distance, negative where nothing is lacking."""
    corners = planes.vertices[contact]
    weights = planes.weights[contact]
    between = wp.vec3d()
    for corner in range(4):
        between += weights[corner] * x[corners[corner]]
    return planes.gaps[contact] - wp.dot(between, planes.normals[contact])


@wp.func
def _move(planes: Planes, place: int, short: wp.float64) -> wp.vec3d:
    """Returns the move of a corner that makes up for what its contact lacks, shared with the other corners."""
    contact = place / 4
    weight = planes.weights[contact][place % 4]
    return weight * short * planes.mobilities[contact] * planes.normals[contact]


@wp.func
def _push(i: int, x: wp.array[wp.vec3d], planes: Planes):
    """Returns the mean move of a vertex that puts its contacts at their distances, shared with the other corners."""
    total = wp.vec3d()
    count = ZERO
    first = int(0)
    last = int(0)
    if planes.starts:
        first = planes.starts[i]
        last = planes.starts[i + 1]
    for k in range(first, last):
        short = _shortfall(x, planes, planes.places[k] / 4)
        if short > ZERO:
            total += _move(planes, planes.places[k], short)
            count += ONE
    return total / wp.max(count, ONE)


@wp.kernel
def find_shortfalls(
    # in
    x: wp.array[wp.vec3d],
    planes: Planes,
    # out
    shortfalls: wp.array[wp.float64],
):
    """Writes how much each contact lacks of its distance."""
    i = wp.tid()
    shortfalls[i] = _shortfall(x, planes, i)


@wp.kernel
def move_apart(
    # in
    vertices: wp.array[int],
    planes: Planes,
    shortfalls: wp.array[wp.float64],
    # in and out
    x: wp.array[wp.vec3d],
):
    """Moves vertices by the mean of the moves that put their contacts at their distances."""
    i = wp.tid()
    total = wp.vec3d()
    count = ZERO
    for k in range(planes.starts[i], planes.starts[i + 1]):
        short = shortfalls[planes.places[k] / 4]
        if short > ZERO:
            total += _move(planes, planes.places[k], short)
            count += ONE
    x[vertices[i]] += total / wp.max(count, ONE)


@wp.kernel
def relax_springs(
    # springs
    rows: wp.array[int],
    vertices: wp.array[int],
    starts: wp.array[int],
    ends: wp.array[int],
    lengths: wp.array[wp.float64],
    weights: wp.array[wp.float64],
    planes: Planes,
    # in
    slack: wp.float64,
    momentum: wp.float64,
    x: wp.array[wp.vec3d],
    # in and out
    relaxed: wp.array[wp.vec3d],
):
    """Moves each vertex towards the lengths of its springs, and out of planes: one Jacobi sweep with momentum.

    The output has the positions before the last sweep: a share of that move is made once more.

    The springs of vertex ``vertices[i]`` lead to ``ends[starts[i]:starts[i + 1]]``, for each i of ``rows``, or each
    i. Lengths within ``slack``, a share, of their rest length stay.
    """
    i = wp.tid()
    if rows:
        i = rows[i]
    vertex = vertices[i]
    p = x[vertex]
    total = wp.vec3d()
    weight = ZERO
    for k in range(starts[i], starts[i + 1]):
        along = x[ends[k]] - p
        length = wp.length(along)
        wanted = wp.clamp(length, lengths[k] * (ONE - slack), lengths[k] * (ONE + slack))
        total += weights[k] * (length - wanted) * _direction(along)
        weight += weights[k]
    last = p - relaxed[vertex]
    relaxed[vertex] = p + HALF * total / wp.max(weight, _TINY) + _push(i, x, planes) + momentum * last


@wp.kernel
def spread_moves(
    # springs
    vertices: wp.array[int],
    starts: wp.array[int],
    ends: wp.array[int],
    # in
    given: wp.array[bool],
    moves: wp.array[wp.vec3d],
    # out
    smoothed: wp.array[wp.vec3d],
):
    """Moves each vertex as its neighbours move, in the mean, and given vertices as before: one Jacobi sweep."""
    i = wp.tid()
    vertex = vertices[i]
    total = wp.vec3d()
    for k in range(starts[i], starts[i + 1]):
        total += moves[ends[k]]
    mean = total / wp.float64(wp.max(starts[i + 1] - starts[i], 1))
    smoothed[vertex] = wp.where(given[vertex], moves[vertex], mean)


@wp.kernel
def find_closest(
    # mesh
    surface: wp.uint64,
    # in
    points: wp.array[wp.vec3],
    # out
    closest: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
):
    """Finds the point of a surface that is closest to each point, and the normal of its face."""
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(surface, points[i], wp.inf)
    closest[i] = wp.mesh_eval_position(surface, query.face, query.u, query.v)
    normals[i] = wp.mesh_eval_face_normal(surface, query.face)


@wp.kernel
def find_exits(
    # mesh
    surface: wp.uint64,
    # in
    points: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # out
    distances: wp.array2d[float],
):
    """Finds how far each point is from a surface along each direction, infinite if it does not meet it."""
    i, j = wp.tid()
    query = wp.mesh_query_ray(surface, points[i], directions[j], wp.inf)
    distances[i, j] = wp.where(query.result, query.t, wp.inf)
