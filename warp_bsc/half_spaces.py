"""Infinite planes: the solid half-spaces behind them, which vertices stay out of."""

import warp as wp

from .constraints import (
    FIRST_HITS,
    PROJECTED,
    PROJECTIONS,
    ROUND,
    TIMES,
    Progress,
    Vertices,
    add_contact,
    is_projecting,
    push_and_change,
    to_double,
    to_single,
)

__all__ = ["HalfSpaces", "collect_penetrations", "place_half_spaces", "project_out_of_half_spaces"]

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
def _clearance(plane: wp.vec4d, x: wp.vec3):
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
def _concerns(half_spaces: HalfSpaces, i: int, world: int) -> bool:
    return half_spaces.world[i] < 0 or half_spaces.world[i] == world


@wp.kernel(**_KERNEL)
def project_out_of_half_spaces(
    vertices: Vertices,
    half_spaces: HalfSpaces,
    progress: Progress,
    separation: wp.float64,
    restitution: wp.float64,
):
    """Moves vertices out of half-spaces, to the separation, before the first round and in each that projects."""
    vertex = wp.tid()
    world = vertices.world[vertex]
    first = progress.steer[ROUND] == 0
    if vertices.inverse_mass[vertex] == 0.0 or not (first or is_projecting(progress, world)):
        return
    for i in range(half_spaces.end.shape[0]):
        x1 = vertices.x1[vertex]
        clearance, error = _clearance(half_spaces.end[i], x1)
        if clearance <= error and _concerns(half_spaces, i, world):
            plane = half_spaces.end[i]
            push, change = push_and_change(
                wp.vec3d(plane[0], plane[1], plane[2]),
                separation - clearance,
                to_double(x1) - to_double(vertices.x0[vertex]),
                to_double(vertices.velocity[vertex]),
                to_double(vertices.wanted_velocity[vertex]),
                wp.sqrt(wp.float64(vertices.friction[vertex]) * wp.float64(half_spaces.friction[i])),
                restitution,
            )
            vertices.x1[vertex] = to_single(to_double(x1) + push)
            vertices.velocity[vertex] = to_single(to_double(vertices.velocity[vertex]) + change)
            vertices.done[vertex] = vertices.done[vertex] | PROJECTED
            if first:
                wp.atomic_add(progress.steer, FIRST_HITS, 1)


@wp.kernel(**_KERNEL)
def collect_penetrations(vertices: Vertices, half_spaces: HalfSpaces, progress: Progress):
    """Counts vertices that may have entered half-spaces, and takes down when; what was within before is left there."""
    vertex = wp.tid()
    if vertices.inverse_mass[vertex] == 0.0:
        return
    for i in range(half_spaces.end.shape[0]):
        if _concerns(half_spaces, i, vertices.world[vertex]):
            before, error_before = _clearance(half_spaces.start[i], vertices.x0[vertex])
            after, error_after = _clearance(half_spaces.end[i], vertices.x1[vertex])
            if before >= -error_before and after <= error_after:
                add_contact(progress, vertices.world[vertex])
                if progress.steer[ROUND] >= PROJECTIONS:
                    part = wp.max(before, _ZERO) / wp.max(before - after, _TINY)
                    wp.atomic_min(vertices.time, vertex, int(wp.floor(TIMES * wp.min(part, wp.float64(1.0)))))
