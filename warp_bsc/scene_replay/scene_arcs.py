"""The arcs of an interval: the turns of its meshes as the motion of bodies."""

import numpy as np

from ..detection.arcs.rigid_motion import RigidMotion
from ..usd.interval import Interval

_TOLERANCE = 2.0**-16
"""Distance within which meshes that turn are reported, as a share of the largest distance of a point from its axis."""
_LARGEST_COORDINATE = 2.0**500


def arcs_of(interval: Interval) -> RigidMotion | None:
    """Returns the motion of the vertices of the meshes that turn in an interval, a body a mesh; None if none does.

    A vertex that is welded to a mesh with another turn, or with none, moves straight: at both ends it is where both
    meshes have it, and in between it can only be on one of their paths.
    """
    segment = interval.segment
    turns = interval.turns
    size = float(max(np.abs(interval.x0).max(initial=0.0), np.abs(interval.x1).max(initial=0.0)))
    if not turns or size > _LARGEST_COORDINATE:
        return None
    numbers = np.array(sorted(turns))
    body_of_mesh = np.full(len(segment.meshes), -1)
    body_of_mesh[numbers] = np.arange(len(numbers))
    body = np.full(segment.vertex_count, -1)
    for number in numbers.tolist():
        body[segment.vertices_of(number)] = body_of_mesh[number]
    centre, vector = (np.array([getattr(turns[n], name) for n in numbers.tolist()]) for name in ("centre", "vector"))

    (turning,) = np.nonzero(body >= 0)
    rows, meshes = segment.meshes_at_vertices(turning)
    others = body_of_mesh[meshes]
    pairs = np.unique(np.stack([body[turning[rows]], others], axis=1)[others != body[turning[rows]]], axis=0)
    differ = {
        (one, other)
        for one, other in pairs.tolist()
        if other < 0 or not turns[int(numbers[one])].is_like(turns[int(numbers[other])], size)
    }
    if differ:
        is_welded = [pair in differ for pair in zip(body[turning[rows]].tolist(), others.tolist(), strict=True)]
        body[turning[rows[is_welded]]] = -1

    levers = np.linalg.norm(np.cross(vector[body], interval.x0.astype(np.float64) - centre[body]), axis=1)
    lever = (levers / np.linalg.norm(vector, axis=1)[body])[body >= 0].max(initial=0.0)
    if lever == 0.0:
        return None
    return RigidMotion(body, centre, vector, tolerance=max(_TOLERANCE * float(lever), 2.0**-40 * size))
