"""Infinite planes: each bounds a solid half-space."""

from typing import Any

import warp as wp

from ...kernels.pairs import PairFilter, groups_meet
from .structs import Motion
from .vectors import ONE, ZERO, to_double

_ROUNDOFF = wp.constant(wp.float64(2.0**-50))
"""Bound on the rounding error of a signed distance, as a share of the sum of its terms."""
_TINY = wp.constant(wp.float64(1e-300))
"""More than what underflow loses [m]."""


@wp.struct
class MovingPlanes:
    """Planes at the start and at the end of a step, each as the unit normal out of its solid and its offset [m].

    Solids are convex, and so is the region of a vertex: a vertex that is outside at both ends is outside between.
    """

    start: wp.array[wp.vec4d]
    end: wp.array[wp.vec4d]
    friction: wp.array[float]
    world: wp.array[int]  # -1 for all
    of_worlds: wp.array2d[int]  # the planes of each world, shape [worlds, n], then -1
    shape: wp.array[int]
    body: wp.array[int]  # that the plane moves with, -1 for none
    shape_filter: PairFilter  # groups and masks of shapes; empty if no pair is left out


@wp.func
def transformed_plane(point: wp.vec3, normal: wp.vec3, body: int, body_q: wp.array[wp.transform]) -> wp.vec4d:
    """Returns a plane where its body is, if it has one, as its unit normal and its offset [m]."""
    if body >= 0:
        point = wp.transform_point(body_q[body], point)
        normal = wp.transform_vector(body_q[body], normal)
    unit = wp.normalize(to_double(normal))
    return wp.vec4d(unit[0], unit[1], unit[2], wp.dot(unit, to_double(point)))


@wp.func
def signed_distance(plane: wp.vec4d, x: Any):
    """Returns the distance of a point from a plane [m], negative in the solid, and a bound on its rounding error.

    Each of three products, and each of three sums, is off by 2^-53 of itself at most, and by 2^-1075 where it
    underflows.
    """
    value = -plane[3]
    magnitude = wp.abs(plane[3])
    for axis in range(3):
        term = plane[axis] * wp.float64(x[axis])
        value += term
        magnitude += wp.abs(term)
    return value, _ROUNDOFF * magnitude + _TINY


@wp.func
def time_of_entry(before: wp.float64, after: wp.float64) -> wp.float64:
    """Returns when a vertex enters a solid, in [0, 1], from its signed distances at the start and end of a step."""
    return wp.min(wp.max(before, ZERO) / wp.max(before - after, _TINY), ONE)


@wp.func
def is_filtered_by_plane(motion: Motion, planes: MovingPlanes, i: int, vertex: int) -> bool:
    """Returns whether groups and masks leave out a vertex and an infinite plane."""
    of_vertices = motion.pair_filter
    if not of_vertices.group:
        return False
    of_shapes = planes.shape_filter
    shape = planes.shape[i]
    return not groups_meet(
        of_vertices.group[vertex], of_vertices.mask[vertex], of_shapes.group[shape], of_shapes.mask[shape]
    )
