"""What a replay found in a shot, as far as a repair needs it: collisions, intersections, and what comes too near."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._arguments import check_instance, checked_distance
from ...detection.detector import CollisionDetector
from ...detection.mesh import CollisionMesh
from ...replay.results import IntervalResult
from ...replay.scene_contacts import find_contacts
from ...usd.interval import Interval
from ...usd.scene import Scene
from ...usd.segment import Segment
from ...usd.selection import Selection

__all__ = ["Finding", "find_collisions"]

_KEY = np.array([2**31, 1])
"""Makes one number of the numbers of two elements."""


@dataclass(frozen=True)
class Finding:
    """What a replay found in an interval, as far as a repair needs it.

    Attributes:
        hits: Number of pairs that collide.
        near: Number of pairs that come nearer than the minimum distance, colliding ones included, without those that
            are so initially.
        initially_near: Number of pairs that are nearer at the start of an interval that no other one precedes; 0 in
            other intervals.
        crossings: Numbers of edges that meet faces at the start and at the end, which is 0 if it is the same time.
        crossing_meshes: Names of the pairs of meshes that intersect at the start.
        is_joined: Whether the interval starts where the one before ends, with the same meshes.
    """

    hits: int
    near: int
    initially_near: int
    crossings: tuple[int, int]
    crossing_meshes: tuple[tuple[str, str], ...]
    is_joined: bool

    @property
    def is_free(self) -> bool:
        """Whether nothing collides, intersects or comes too near."""
        return not self.hits and not self.near and not any(self.crossings)


def find_collisions(
    scene: Scene, results: Iterable[IntervalResult], *, min_distance: float = 0.0, device: Any = None
) -> Iterator[Finding]:
    """Yields what a repair needs of each interval of a scene.

    Args:
        scene: The scene.
        results: Results of its replay with intersections, in order.
        min_distance: Distance that pairs are to keep between the times too, in the scene's unit of length: 0 or at
            least 2^-1021. It is not looked for between elements that an edge of the mesh joins, nor at curves and
            points. Pairs that are nearer at the first time, or where a mesh jumps or changes its topology, are counted
            there alone.
        device: Warp device or its name; default: Warp's default.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If the distance is out of range, or the scene is broken at some time.
    """
    check_instance(scene, "scene", Scene, "a Scene")
    distance = checked_distance(min_distance, "min_distance")
    return _find_collisions(results, _NearPairs(scene.selection, distance, device) if distance else None)


def _find_collisions(results: Iterable[IntervalResult], near_pairs: "_NearPairs | None") -> Iterator[Finding]:
    """Yields the findings of :func:`find_collisions`."""
    last: Segment | None = None
    for result in results:
        interval, summary = result.contacts.interval, result.summary
        assert summary.intersections is not None
        start, end = (at.crossings + at.touches for at in summary.intersections)
        is_joined = interval.segment is last and not interval.jumps
        last = interval.segment
        near = near_pairs.find(interval, is_joined) if near_pairs else (0, 0)
        yield Finding(
            hits=sum(summary.mesh_pairs.values()),
            near=near[0],
            initially_near=near[1],
            crossings=(start, 0 if interval.is_at_rest else end),
            crossing_meshes=tuple(summary.intersections[0].mesh_pairs),
            is_joined=is_joined,
        )


class _NearPairs:
    """Finds the pairs that come nearer than a distance, interval by interval, without those that are so initially."""

    def __init__(self, selection: Selection, min_distance: float, device: Any):
        self._selection, self._min_distance, self._device = selection, min_distance, device
        self._segment: Segment | None = None
        self._initial = np.zeros(0, np.int64)

    def find(self, interval: Interval, is_joined: bool) -> tuple[int, int]:
        """Returns the number of the pairs in an interval, and of the initial ones if it is not joined to another."""
        segment = interval.segment
        if segment is not self._segment:
            self._segment = segment
            self._mesh = CollisionMesh(segment.faces, segment.vertex_count, device=self._device)
            self._detector = CollisionDetector(self._mesh, method="exact", min_distance=self._min_distance)
        if not is_joined:
            self._initial = self._pairs(interval, interval.x0)
        pairs = self._pairs(interval, interval.x1)
        near = len(pairs) - int(np.isin(pairs, self._initial).sum())
        return near, 0 if is_joined else len(self._initial)

    def _pairs(self, interval: Interval, end: np.ndarray) -> np.ndarray:
        """Returns a number for each pair that is too near on the way to some positions, int64."""
        found = self._detector.detect(interval.x0, end)
        counted = find_contacts(interval, self._mesh, found, self._selection).counted
        vertex_face, edge_edge = (pairs.astype(np.int64) @ _KEY for pairs in (found.vertex_face, found.edge_edge))
        return np.concatenate([vertex_face, -1 - edge_edge])[counted]
