"""Projects a vertex onto its sides of dividing planes, which :mod:`.plane_placement` places.

Loops over the list of a vertex read the next node before they use the plane of this one: a GPU waits for both at once.

References:
    D. Goldfarb and A. Idnani, A Numerically Stable Dual Method for Solving Strictly Convex Quadratic Programs,
    Mathematical Programming 27, 1983, doi:10.1007/BF02591962.
"""

import warp as wp

from ..contacts.planes_between import FAR
from ..state.structs import NO_NODE, DividingPlanes
from ..state.vectors import ONE, ZERO, to_double, to_single
from ..tuning import MAX_PLANE_STEPS, WEDGE

wp.set_module_options({"enable_backward": False})

_PARALLEL = wp.constant(wp.float64(1.0e-14))
"""Squared sine up to which a normal counts as one within the span of others."""
_ROUNDING = wp.constant(wp.float64(1.0e-6))
"""Share by which a path to the nearest point may exceed the one to a point that is as near."""
_SMALLEST = wp.constant(float(2.0**-149))
"""The smallest number in single precision."""


@wp.func
def _half_space(planes: DividingPlanes, node: int):
    """Returns the normal of a vertex's side of a plane, its least coordinate along it, and the margin."""
    plane = node / 8
    side = wp.where(node % 2 == 0, ONE, -ONE)
    place = planes.place[plane]
    least = side * place[3]
    if planes.half:
        least += planes.half[plane]
    return side * wp.vec3d(place[0], place[1], place[2]), least, wp.float64(planes.margin[plane])


@wp.func
def _is_above(planes: DividingPlanes, vertex: int, x: wp.vec3d) -> bool:
    """Returns whether a position of a vertex is above all of its planes."""
    node = planes.first[vertex]
    while node >= 0:
        normal, least, _margin = _half_space(planes, node)
        node = planes.next[node / 2]
        if wp.dot(normal, x) <= least:
            return False
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
        return wp.cross(a, wp.cross(normal, a)), wp.vec3d(wp.dot(a, normal), ZERO, ZERO)
    if count == 2:
        across = wp.cross(a, b)
        size = wp.length_sq(across)
        of_a = wp.dot(wp.cross(normal, b), across) / size
        of_b = wp.dot(wp.cross(a, normal), across) / size
        return (wp.dot(normal, across) / size) * across, wp.vec3d(of_a, of_b, ZERO)
    bc = wp.cross(b, c)
    volume = wp.dot(a, bc)
    of_b = wp.dot(a, wp.cross(normal, c)) / volume
    of_c = wp.dot(a, wp.cross(b, normal)) / volume
    return wp.vec3d(), wp.vec3d(wp.dot(normal, bc) / volume, of_b, of_c)


@wp.func
def _projected(planes: DividingPlanes, vertex: int, x: wp.vec3d) -> wp.vec3d:
    """Returns the nearest position above the planes of a vertex, whatever their order (Goldfarb and Idnani 1983).

    The position lies on at most three planes, the active ones. The plane that it is farthest below joins them; planes
    that then pull leave. If rounding prevents an end, the position is near, but not above all planes.
    """
    normals = wp.mat33d()
    multipliers = wp.vec3d()
    count = int(0)
    joins = bool(False)  # whether a plane is about to join the active ones
    normal = wp.vec3d()
    height = ZERO  # least coordinate along it
    multiplier = ZERO
    left = int(MAX_PLANE_STEPS)
    while left > 0:
        left -= 1
        if not joins:
            most = ZERO
            node = planes.first[vertex]
            while node >= 0:
                other, least, margin = _half_space(planes, node)
                node = planes.next[node / 2]
                missing = least + margin - wp.dot(other, x)
                if missing >= margin and missing >= most:
                    if missing > most or _precedes(other, normal):
                        most = missing
                        normal = other
                        height = least + margin
            if most == ZERO:
                return x
            joins = True
            multiplier = ZERO
        across, parts = _steps_towards(normals, count, normal)
        rise = wp.dot(across, normal)
        length = FAR
        if rise > _PARALLEL:
            length = (height - wp.dot(normal, x)) / rise
        leaves = int(NO_NODE)
        for j in range(count):
            if parts[j] > ZERO and multipliers[j] < length * parts[j]:
                length = multipliers[j] / parts[j]
                leaves = j
        if length == FAR:
            return x
        for j in range(count):
            multipliers[j] = multipliers[j] - length * parts[j]
        multiplier += length
        if rise > _PARALLEL:
            x += length * across
        if leaves == NO_NODE:
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
    share = ONE
    node = planes.first[vertex]
    while node >= 0:
        normal, least, margin = _half_space(planes, node)
        node = planes.next[node / 2]
        before = wp.dot(normal, x0) - least
        after = wp.dot(normal, x1) - least
        if after <= ZERO and before > after:
            share = wp.min(share, wp.max(before - margin, ZERO) / (before - after))
    return share


@wp.func
def _towards(x: float, exact: wp.float64, direction: wp.float64) -> float:
    """Returns a rounded coordinate, or its neighbour if on that side of the exact one."""
    error = wp.float64(x) - exact
    if error * direction >= ZERO:
        return x
    if x == 0.0:
        return wp.where(direction > ZERO, _SMALLEST, -_SMALLEST)
    bits = wp.cast(x, wp.int32)
    return wp.cast(bits + wp.where((x > 0.0) == (direction > ZERO), 1, -1), wp.float32)


@wp.func
def _rounded(planes: DividingPlanes, vertex: int, x: wp.vec3d) -> wp.vec3:
    """Returns a position in single precision, rounded upwards from the plane that the nearest one is farthest below."""
    end = to_single(x)
    most = -FAR
    normal = wp.vec3d()
    node = planes.first[vertex]
    while node >= 0:
        other, least, _margin = _half_space(planes, node)
        node = planes.next[node / 2]
        missing = least - wp.dot(other, to_double(end))
        if missing > most or (missing == most and _precedes(other, normal)):
            most = missing
            normal = other
    for axis in range(3):
        end[axis] = _towards(end[axis], x[axis], normal[axis])
    return end


@wp.func
def _most_correction(planes: DividingPlanes, vertex: int, start: wp.vec3d, end: wp.vec3d) -> wp.float64:
    """Returns how far from the end of its path planes may take a vertex [m]: as far as it is from the start.

    The start is in the convex region above the planes, so that the nearest point of that region is no farther, except
    for rounding. Planes that nothing can move may have passed the start: then what lies between is added, and some
    more, as planes that are nearly parallel meet far away.
    """
    below = ZERO
    node = planes.first[vertex]
    while node >= 0:
        normal, least, margin = _half_space(planes, node)
        node = planes.next[node / 2]
        below = wp.max(below, least + margin - wp.dot(normal, start))
    return (ONE + _ROUNDING) * wp.length(end - start) + WEDGE * below


@wp.func
def position_on_sides(planes: DividingPlanes, vertex: int, x0: wp.vec3, x1: wp.vec3):
    """Returns an end of a vertex's path above all of its planes, near to ``x1``, and whether the path was cut for that.

    Where projection does not find one, the way from ``x0`` is cut; where rounding leaves none, it ends there.
    """
    predicted = to_double(x1)
    if _is_above(planes, vertex, predicted):
        return x1, False
    start = to_double(x0)
    x = _projected(planes, vertex, predicted)
    if wp.length(x - predicted) > _most_correction(planes, vertex, start, predicted):
        x = predicted
    end = to_single(x)
    if _is_above(planes, vertex, to_double(end)):
        return end, False
    end = _rounded(planes, vertex, x)  # elements may be nearer to each other than their coordinates are precise
    if _is_above(planes, vertex, to_double(end)):
        return end, False
    return position_on_way(planes, vertex, x0, end), True


@wp.func
def position_on_way(planes: DividingPlanes, vertex: int, x0: wp.vec3, x1: wp.vec3) -> wp.vec3:
    """Returns how far a way is above all planes of a vertex: an end of it, or ``x0`` where rounding leaves none."""
    start = to_double(x0)
    way = to_double(x1) - start
    share = share_of_path(planes, vertex, start, start + way)
    if share == ZERO:
        return x0
    if share == ONE:
        return x1
    end = to_single(start + share * way)
    if _is_above(planes, vertex, to_double(end)):
        return end
    return x0
