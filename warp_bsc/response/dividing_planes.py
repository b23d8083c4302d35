"""Dividing planes: what projection cannot keep apart, a plane between the two elements keeps apart for certain.

If one fixed direction separates two elements at the start of a step and at its end, on the same side, it separates them
at all times of a linear motion. After the last projection, near pairs at rest get a plane across the shortest vector
between their elements at the start, and every vertex of the two is projected onto its side; but no pair that moves or
turns together without meeting, which a plane would stop, as it stands still. If contacts are left, they get planes, and
so do all near pairs. Vertices that stand still are on their sides, so that there is a solution for the vertices of all
pairs at once, each by itself. What slides along a plane goes on sliding, unlike what is truncated.

References:
    D. Goldfarb and A. Idnani, A Numerically Stable Dual Method for Solving Strictly Convex Quadratic Programs,
    Mathematical Programming 27, 1983, doi:10.1007/BF02591962.
"""

import warp as wp

from ..kernels.pipeline.queues import take_slot_int
from .buffers import Motion, Vertices
from .constraints import SMALLEST_DISTANCE, inverse_mass_of, relative, to_double, to_single
from .proximities import closest_direction, closest_vector

__all__ = [
    "DividingPlanes",
    "add_dividing_plane",
    "add_plane",
    "allocate_dividing_planes",
    "has_all_planes",
    "position_on_sides",
    "share_of_path",
]

_NONE = wp.constant(-1)
_INCOMPLETE = wp.constant(-2)
"""End of a list that lacks a plane."""
_STEPS = wp.constant(64)
"""Most steps of the projection of a vertex onto its planes: it takes 4 on average, and 21 at most were seen."""
_PARALLEL = wp.constant(wp.float64(1.0e-14))
"""Squared sine up to which a normal counts as one within the span of others."""
_MARGIN = wp.constant(wp.float64(0.2))
"""Least distance from a plane after projection, as a share of the elements' distance at the start."""
_NEAR_MARGIN = wp.constant(wp.float64(0.45))
"""The same of elements that are so near that they may hardly come nearer, step after step: positions are rounded."""
_ROOM = wp.constant(wp.float64(0.05))
"""How much farther than that both are from the plane at the start at least, as a share of their distance."""
_WEDGE = wp.constant(wp.float64(4.0))
"""Most that a vertex may be moved, beyond its path, in multiples of how far the start is below a plane."""
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_FAR = wp.constant(wp.float64(1.0e300))
_SMALLEST = wp.constant(float(2.0**-149))


@wp.struct
class DividingPlanes:
    """Planes that vertices stay above or below, and a list for each vertex of those that concern it.

    The nodes of lists are numbered ``4 plane + corner``, as the planes of two elements have four vertices.
    """

    count: wp.array[int]  # of planes, whether they fit or not
    normal: wp.array[wp.vec3d]
    offset: wp.array[wp.float64]  # coordinate along the normal [m]
    half: wp.array[wp.float64]  # of the minimum distance of both elements [m]; empty without minimum distances
    margin: wp.array[float]  # by which projection exceeds it [m]
    split: wp.array[wp.int8]  # the first corner that stays below
    next: wp.array[int]  # the next node in the list of the same vertex, or the end
    first: wp.array[int]  # node of a vertex, or the end
    kept: wp.array[int]  # the first node when the vertex was moved onto its sides last


def allocate_dividing_planes(
    vertices: int, capacity: int, device: wp.Device, *, keep_distances: bool = False
) -> DividingPlanes:
    """Returns lists without planes for this many vertices, with a capacity for all planes together."""
    planes = DividingPlanes()
    planes.count = wp.zeros(1, dtype=int, device=device)
    planes.normal = wp.empty(capacity, dtype=wp.vec3d, device=device)
    planes.offset = wp.empty(capacity, dtype=wp.float64, device=device)
    planes.half = wp.empty(capacity if keep_distances else 0, dtype=wp.float64, device=device)
    planes.margin = wp.empty(capacity, dtype=float, device=device)
    planes.split = wp.empty(capacity, dtype=wp.int8, device=device)
    planes.next = wp.empty(4 * capacity, dtype=int, device=device)
    planes.first = wp.full(vertices, int(_NONE), dtype=int, device=device)
    planes.kept = wp.full(vertices, int(_NONE), dtype=int, device=device)
    return planes


@wp.func
def _add_node(planes: DividingPlanes, vertex: int, node: int):
    """Puts a node before the list of a vertex."""
    after = wp.atomic_exch(planes.first, vertex, node)
    if node >= 0:
        planes.next[node] = after


@wp.func
def add_plane(
    planes: DividingPlanes,
    corners: wp.vec4i,
    split: int,
    normal: wp.vec3d,
    offset: wp.float64,
    margin: wp.float64,
    half: wp.float64,
):
    """Adds a plane to the lists of up to four vertices; where it does not fit, :func:`has_all_planes` says so.

    Args:
        planes: The planes.
        corners: The vertices, -1 for none. Those before ``split`` stay above the plane, the others below.
        split: The first that stays below.
        normal: Unit normal of the plane.
        offset: Its coordinate along the normal [m].
        margin: Least distance from it after projection, beside ``half`` [m].
        half: Half of the distance that both sides keep from each other [m].
    """
    plane = take_slot_int(planes.count)
    fits = plane < planes.normal.shape[0]
    if fits:
        planes.normal[plane] = normal
        planes.offset[plane] = offset
        planes.margin[plane] = float(margin)
        planes.split[plane] = wp.int8(split)
        if planes.half:
            planes.half[plane] = half
    for j in range(4):
        if corners[j] >= 0:
            _add_node(planes, corners[j], wp.where(fits, 4 * plane + j, _INCOMPLETE))


@wp.func
def has_all_planes(planes: DividingPlanes, vertex: int) -> bool:
    """Returns whether all contacts of a vertex have a plane: of those that touch at the start, there is none."""
    node = planes.first[vertex]
    while node >= 0:
        node = planes.next[node]
    return node != _INCOMPLETE


@wp.func
def _half_space(planes: DividingPlanes, node: int):
    """Returns the normal of a vertex's side of a plane, its least coordinate along it, and the margin."""
    plane = node / 4
    side = wp.where(node % 4 < int(planes.split[plane]), _ONE, -_ONE)
    least = side * planes.offset[plane]
    if planes.half:
        least += planes.half[plane]
    return side * planes.normal[plane], least, wp.float64(planes.margin[plane])


@wp.struct
class _Side:
    """How far one of two elements reaches towards the other, along the vector between them [m]."""

    start: wp.float64  # at the start
    end: wp.float64  # at the end
    fixed: wp.float64  # those of its vertices that cannot be moved, at the end
    reach: wp.float64  # wherever planes may take it
    inverse_mass: wp.float64  # sum over its vertices


@wp.func
def _side(
    motion: Motion,
    vertices: Vertices,
    corners: wp.vec4i,
    begin: int,
    end: int,
    origin: wp.vec3d,
    normal: wp.vec3d,
    half: wp.float64,
) -> _Side:
    """Returns how far the vertices from ``begin`` to ``end`` reach against a normal.

    They reach farther by ``half`` of the distance that they are to keep. Planes take a vertex no farther than the ball
    around its path: this is what projection onto a convex set does to the end of a path that starts in it.
    """
    side = _Side()
    side.reach = _FAR
    side.start = _FAR
    side.end = _FAR
    side.fixed = _FAR
    for j in range(begin, end):
        vertex = corners[j]
        start = to_double(motion.x0[vertex])
        path = to_double(vertices.x1[vertex]) - start
        x0 = wp.dot(normal, start - origin) - half
        x1 = x0 + wp.dot(normal, path)
        side.start = wp.min(side.start, x0)
        side.reach = wp.min(side.reach, _HALF * (x0 + x1 - wp.length(path)))
        side.end = wp.min(side.end, x1)
        inverse_mass = wp.float64(inverse_mass_of(motion, vertex))
        side.inverse_mass += inverse_mass
        if inverse_mass == _ZERO:
            side.fixed = wp.min(side.fixed, x1)
    return side


@wp.func
def add_dividing_plane(
    motion: Motion,
    vertices: Vertices,
    corners: wp.vec4i,
    edges: int,
    separation: wp.float64,
    least: wp.float64,
    planes: DividingPlanes,
    is_contact: bool,
    may_stop: bool,
) -> bool:
    """Adds a plane between two elements to the lists of those of their four vertices that can be moved.

    The plane lies where both would meet at the end by their masses, but between them at the start, and not within a
    vertex that cannot be moved. Elements that touch at the start have none, nor do those without a contact that planes
    cannot bring together.

    Args:
        motion: The motion of the step.
        vertices: The vertices as they were moved so far.
        corners: The vertices of both elements.
        edges: 1 where these are edges, 0 for a vertex and a face.
        separation: Distance that projection moves contacts apart [m].
        least: Distance that the elements are to keep [m]: half of it is on either side.
        planes: The planes, which the new one is added to.
        is_contact: Whether the elements are in contact.
        may_stop: Whether elements get a plane that stops them although their closest points do not meet.

    Returns:
        Whether the elements meet at the end, or nearly, without planes.
    """
    normal = closest_direction(motion, corners, edges)
    origin = to_double(motion.x0[corners[3]])
    split = wp.where(edges == 1, 2, 1)
    half = _HALF * least
    above = _side(motion, vertices, corners, 0, split, origin, normal, half)
    below = _side(motion, vertices, corners, split, 4, origin, -normal, half)
    distance = above.start + below.start
    if not is_contact and (distance <= _ZERO or above.reach + below.reach > _ZERO):
        return False
    movable = wp.vec4i()
    for j in range(4):
        movable[j] = wp.where(inverse_mass_of(motion, corners[j]) > 0.0, corners[j], -1)
    if distance <= _ZERO:
        for j in range(4):
            if movable[j] >= 0:
                _add_node(planes, movable[j], _INCOMPLETE)
        return False
    margin = wp.where(distance < SMALLEST_DISTANCE * separation, _NEAR_MARGIN, _MARGIN) * distance
    least = margin + _ROOM * distance
    share = above.inverse_mass / (above.inverse_mass + below.inverse_mass)
    offset = above.end + share * (-below.end - above.end)
    offset = wp.clamp(offset, least - below.start, above.start - least)
    # last, what cannot be moved decides
    offset = wp.max(wp.min(offset, above.fixed - margin), margin - below.fixed)
    if not may_stop and (above.end < offset or -below.end > offset):
        weights, _between = closest_vector(motion, corners, edges)
        if wp.dot(normal, relative(weights, corners, vertices.x1)) >= half + half + margin:
            return False
    add_plane(planes, movable, split, normal, wp.dot(normal, origin) + offset, margin, half)
    return above.end + below.end < margin


@wp.func
def _is_above(planes: DividingPlanes, vertex: int, x: wp.vec3d) -> bool:
    """Returns whether a position of a vertex is above all of its planes."""
    node = planes.first[vertex]
    while node >= 0:
        normal, least, _margin = _half_space(planes, node)
        if wp.dot(normal, x) <= least:
            return False
        node = planes.next[node]
    return True


@wp.func
def _precedes(a: wp.vec3d, b: wp.vec3d) -> bool:
    """Returns whether a vector comes before another by their first coordinates that differ."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[2] < b[2]


@wp.func
def _steps_towards(normals: wp.mat33d, count: int, normal: wp.vec3d):
    """Returns the part of a normal that is across the first ``count`` normals, and the coefficients of the rest."""
    a = normals[0]
    b = normals[1]
    c = normals[2]
    if count == 0:
        return normal, wp.vec3d()
    if count == 1:
        return wp.cross(a, wp.cross(normal, a)), wp.vec3d(wp.dot(a, normal), _ZERO, _ZERO)
    if count == 2:
        across = wp.cross(a, b)
        size = wp.length_sq(across)
        of_a = wp.dot(wp.cross(normal, b), across) / size
        of_b = wp.dot(wp.cross(a, normal), across) / size
        return (wp.dot(normal, across) / size) * across, wp.vec3d(of_a, of_b, _ZERO)
    bc = wp.cross(b, c)
    volume = wp.dot(a, bc)
    of_b = wp.dot(a, wp.cross(normal, c)) / volume
    of_c = wp.dot(a, wp.cross(b, normal)) / volume
    return wp.vec3d(), wp.vec3d(wp.dot(normal, bc) / volume, of_b, of_c)


@wp.func
def _projected(planes: DividingPlanes, vertex: int, x: wp.vec3d) -> wp.vec3d:
    """Returns the nearest position above the planes of a vertex, whatever their order (Goldfarb and Idnani 1983).

    The planes that the position lies on are at most three, the active ones. The plane that it is farthest below joins
    them; what pushes the wrong way then leaves. If rounding prevents an end, the position is near, but not above all.
    """
    normals = wp.mat33d()
    multipliers = wp.vec3d()
    count = int(0)
    joins = bool(False)  # whether a plane is about to join the active ones
    normal = wp.vec3d()
    height = _ZERO  # least coordinate along it
    multiplier = _ZERO
    left = int(_STEPS)
    while left > 0:
        left -= 1
        if not joins:
            most = _ZERO
            node = planes.first[vertex]
            while node >= 0:
                other, least, margin = _half_space(planes, node)
                missing = least + margin - wp.dot(other, x)
                if missing >= margin and missing >= most:
                    if missing > most or _precedes(other, normal):
                        most = missing
                        normal = other
                        height = least + margin
                node = planes.next[node]
            if most == _ZERO:
                return x
            joins = True
            multiplier = _ZERO
        across, parts = _steps_towards(normals, count, normal)
        rise = wp.dot(across, normal)
        length = _FAR
        if rise > _PARALLEL:
            length = (height - wp.dot(normal, x)) / rise
        leaves = int(_NONE)
        for j in range(count):
            if parts[j] > _ZERO and multipliers[j] < length * parts[j]:
                length = multipliers[j] / parts[j]
                leaves = j
        if length == _FAR:
            return x
        for j in range(count):
            multipliers[j] = multipliers[j] - length * parts[j]
        multiplier += length
        if rise > _PARALLEL:
            x += length * across
        if leaves == _NONE:
            normals[count] = normal
            multipliers[count] = multiplier
            count += 1
            joins = False
        else:
            count -= 1
            for j in range(leaves, count):
                normals[j] = normals[j + 1]
                multipliers[j] = multipliers[j + 1]
    return x


@wp.func
def share_of_path(planes: DividingPlanes, vertex: int, x0: wp.vec3d, x1: wp.vec3d) -> wp.float64:
    """Returns the share of a path, in [0, 1], up to which it is above the planes of its vertex."""
    share = _ONE
    node = planes.first[vertex]
    while node >= 0:
        normal, least, margin = _half_space(planes, node)
        before = wp.dot(normal, x0) - least
        after = wp.dot(normal, x1) - least
        if after <= _ZERO and before > after:
            share = wp.min(share, wp.max(before - margin, _ZERO) / (before - after))
        node = planes.next[node]
    return share


@wp.func
def _towards(x: float, exact: wp.float64, direction: wp.float64) -> float:
    """Returns a rounded coordinate, or its neighbour if that is the one on the side of the exact one that is wanted."""
    error = wp.float64(x) - exact
    if error * direction >= _ZERO:
        return x
    if x == 0.0:
        return wp.where(direction > _ZERO, _SMALLEST, -_SMALLEST)
    bits = wp.cast(x, wp.int32)
    return wp.cast(bits + wp.where((x > 0.0) == (direction > _ZERO), 1, -1), wp.float32)


@wp.func
def _rounded(planes: DividingPlanes, vertex: int, x: wp.vec3d) -> wp.vec3:
    """Returns a position in single precision, rounded upwards from the plane that the nearest one is farthest below."""
    end = to_single(x)
    most = -_FAR
    normal = wp.vec3d()
    node = planes.first[vertex]
    while node >= 0:
        other, least, _margin = _half_space(planes, node)
        missing = least - wp.dot(other, to_double(end))
        if missing > most or (missing == most and _precedes(other, normal)):
            most = missing
            normal = other
        node = planes.next[node]
    for axis in range(3):
        end[axis] = _towards(end[axis], x[axis], normal[axis])
    return end


@wp.func
def _most_correction(planes: DividingPlanes, vertex: int, start: wp.vec3d, end: wp.vec3d) -> wp.float64:
    """Returns how far from the end of its path planes may take a vertex [m]: as far as it is from the start.

    The start is in the convex region above the planes, so that the nearest point of that region is no farther. Planes
    that move, and cannot be moved, may have passed the start: then what lies between is added, and some more, as planes
    that are nearly parallel meet far away.
    """
    below = _ZERO
    node = planes.first[vertex]
    while node >= 0:
        normal, least, margin = _half_space(planes, node)
        below = wp.max(below, least + margin - wp.dot(normal, start))
        node = planes.next[node]
    return wp.length(end - start) + _WEDGE * below


@wp.func
def position_on_sides(planes: DividingPlanes, vertex: int, x0: wp.vec3, x1: wp.vec3):
    """Returns an end of a vertex's path above all of its planes, near to ``x1``, and whether the path was cut for that.

    Where projection does not find one, the path is cut; where rounding leaves none, it ends at ``x0``.
    """
    wanted = to_double(x1)
    if _is_above(planes, vertex, wanted):
        return x1, False
    start = to_double(x0)
    x = _projected(planes, vertex, wanted)
    if wp.length(x - wanted) > _most_correction(planes, vertex, start, wanted):
        x = wanted
    end = to_single(x)
    if _is_above(planes, vertex, to_double(end)):
        return end, False
    end = _rounded(planes, vertex, x)  # elements may be nearer to each other than their coordinates are precise
    if _is_above(planes, vertex, to_double(end)):
        return end, False
    x = to_double(end)
    end = to_single(start + share_of_path(planes, vertex, start, x) * (x - start))
    if _is_above(planes, vertex, to_double(end)):
        return end, True
    return x0, True
