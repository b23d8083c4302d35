"""Pairs that are near each other at the start of a step: constraints before they become contacts."""

import warp as wp

from ..detection.settings import Count
from ..kernels.closest import closest_coordinates
from ..kernels.pipeline.pairs import vertices_of_pair
from ..kernels.pipeline.queues import is_filled
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from .constraints import (
    NEAR_EDGES,
    NEAR_VERTEX_FACE,
    Constraints,
    Progress,
    Vertices,
    add_constraint,
    feasible,
    is_projecting,
    is_slow,
    longest_path,
    relative,
    to_double,
)

__all__ = ["NearPairs", "closest_weights", "collect_near_pairs", "forget_near_pairs"]

_QUEUED = wp.constant(int(Count.QUEUED))
_REACH = wp.constant(wp.float64(1.5))
"""Within how many separations pairs are near, whatever they do: neighbours in a stack."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_KERNEL = {"enable_backward": False}


@wp.struct
class NearPairs:
    """The candidate pairs of one kind."""

    edges: int  # 1 where they are of edges: EDGE_EDGE, else VERTEX_FACE
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]


@wp.func
def _are_positive(a: wp.float64, b: wp.float64) -> bool:
    return a > _ZERO and b > _ZERO


@wp.func
def closest_weights(vertices: Vertices, corners: wp.vec4i, edges: int) -> wp.vec4d:
    """Weights of the four vertices in the vector between the closest points of two elements at the start."""
    a = to_double(vertices.x0[corners[0]])
    b = to_double(vertices.x0[corners[1]])
    c = to_double(vertices.x0[corners[2]])
    d = to_double(vertices.x0[corners[3]])
    if edges == 1:
        at = closest_coordinates(EDGE_EDGE, b - a, d - c, c - a)
        return wp.vec4d(_ONE - at[0], at[0], at[1] - _ONE, -at[1])
    at = closest_coordinates(VERTEX_FACE, c - b, d - b, a - b)
    return wp.vec4d(_ONE, at[0] + at[1] - _ONE, -at[0], -at[1])


@wp.func
def _is_within(weights: wp.vec4d, edges: int) -> bool:
    """Whether closest points are within both elements, not on their borders."""
    if edges == 1 and not _are_positive(weights[0], weights[1]):
        return False
    return _are_positive(-weights[2], -weights[3]) and (edges == 1 or weights[1] < _ZERO)


@wp.kernel(**_KERNEL)
def collect_near_pairs(
    vertices: Vertices, near: NearPairs, constraints: Constraints, progress: Progress, separation: wp.float64
):
    """Makes constraints of the slow pairs that one of the two could bridge, where the other is held up.

    In a stack that falls on something, only the lowest contact is found at first: all the others come as soon as what
    is below stands still, and without this they would be found one layer a round. Only pairs whose closest points are
    within both elements are taken, because elsewhere they soon are those of other elements.
    """
    i = wp.tid()
    if not is_filled(i, near.pairs, near.counts, _QUEUED):
        return
    corners = vertices_of_pair(near.edges, near.elements, near.pairs[i])
    if wp.min(corners) >= vertices.movable or not is_projecting(progress, vertices.world[corners[0]]):
        return
    if is_slow(vertices, corners, near.edges) == 0:
        return
    weights = closest_weights(vertices, corners, near.edges)
    if not _is_within(weights, near.edges):
        return
    between = relative(weights, corners, vertices.x0)
    distance = wp.length(between)
    path = longest_path(vertices, corners)
    if distance == _ZERO or distance > wp.max(path, _REACH * separation):
        return
    friction = wp.sqrt(vertices.friction[corners[0]] * vertices.friction[corners[3]])
    asked = feasible(separation, distance, separation, path)
    origin = wp.where(near.edges == 1, NEAR_EDGES, NEAR_VERTEX_FACE)
    add_constraint(vertices, constraints, corners, weights, between / distance, asked, friction, 1, origin, True, _ZERO)


@wp.kernel(**_KERNEL)
def forget_near_pairs(
    constraints: Constraints,
    kept: wp.array[int],
    needed: int,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
):
    """Forgets them all, those from ``kept`` on, if some are missing, or if contacts might not find room behind them.

    They only save rounds; but which of them had found room would be left to chance.
    """
    missing = constraints.count[0] > constraints.vertices.shape[0] - needed
    for i in range(counts.shape[0]):
        missing = missing or counts[i] > capacities[i]
    if missing:
        constraints.count[0] = kept[0]
