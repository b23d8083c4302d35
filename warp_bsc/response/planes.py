"""Infinite planes: the solid half-spaces behind them, which vertices stay out of."""

import warp as wp

from .constraints import (
    FIRST_HITS,
    ON_PLANE,
    ROUND,
    Constraints,
    Progress,
    Vertices,
    add_constraint,
    add_contact,
    to_double,
    touch_in,
    widened,
)

__all__ = ["HalfSpaces", "clearance", "collect_penetrations", "place_half_spaces", "time_of_entry"]

_ROUNDOFF = wp.constant(wp.float64(2.0**-50))
_TINY = wp.constant(wp.float64(1e-300))
_ZERO = wp.constant(wp.float64(0.0))

_KERNEL = {"enable_backward": False}


@wp.struct
class HalfSpaces:
    """Half-spaces at the start and at the end of a step, each as the unit normal out of it and its offset.

    Each is convex, and so is what a vertex may move in: one that is outside at both ends is so between.
    """

    start: wp.array[wp.vec4d]
    end: wp.array[wp.vec4d]
    friction: wp.array[float]
    world: wp.array[int]  # -1 for all


@wp.kernel(**_KERNEL)
def place_half_spaces(
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    bodies: wp.array[int],
    body_q: wp.array[wp.transform],
    planes: wp.array[wp.vec4d],
):
    """Puts half-spaces where their bodies are."""
    i = wp.tid()
    point = points[i]
    direction = normals[i]
    if bodies[i] >= 0:
        point = wp.transform_point(body_q[bodies[i]], point)
        direction = wp.transform_vector(body_q[bodies[i]], direction)
    normal = wp.normalize(to_double(direction))
    planes[i] = wp.vec4d(normal[0], normal[1], normal[2], wp.dot(normal, to_double(point)))


@wp.func
def clearance(plane: wp.vec4d, x: wp.vec3):
    """Distance of a point from a half-space [m], negative within, and a bound on the error of what is computed.

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
    """When a vertex enters a half-space, from its clearances at the start and at the end of a step."""
    return wp.min(wp.max(before, _ZERO) / wp.max(before - after, _TINY), wp.float64(1.0))


@wp.kernel(**_KERNEL)
def collect_penetrations(
    vertices: Vertices,
    half_spaces: HalfSpaces,
    constraints: Constraints,
    progress: Progress,
    separation: wp.float64,
    ahead: bool,
):
    """Makes constraints of vertices that may have entered half-spaces; after the last projection, takes down when.

    What is within at the start is moved out as well, but if it cannot be, that is no new contact. Ahead of the first
    detection contacts are counted, but not as found by it.
    """
    vertex = wp.tid()
    world = vertices.world[vertex]
    if vertices.inverse_mass[vertex] == 0.0:
        return
    for i in range(half_spaces.end.shape[0]):
        if half_spaces.world[i] >= 0 and half_spaces.world[i] != world:
            continue
        after, error_after = clearance(half_spaces.end[i], vertices.x1[vertex])
        if after > error_after:
            continue
        before, error_before = clearance(half_spaces.start[i], vertices.x0[vertex])
        if ahead:
            wp.atomic_add(progress.steer, FIRST_HITS, 1)
        elif before >= -error_before:
            add_contact(progress, world)
            vertices.changed[vertex] = 1
        if progress.steer[ROUND] < progress.projections:
            plane = half_spaces.end[i]
            add_constraint(
                vertices,
                constraints,
                wp.vec4i(vertex),
                wp.vec4d(wp.float64(1.0), _ZERO, _ZERO, _ZERO),
                wp.vec3d(plane[0], plane[1], plane[2]),
                plane[3] + widened(separation, progress),
                wp.sqrt(vertices.friction[vertex] * half_spaces.friction[i]),
                1,
                ON_PLANE,
                True,
                _ZERO,
            )
        else:
            touch_in(vertices, vertex, time_of_entry(before, after), ON_PLANE, i)
