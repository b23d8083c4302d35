"""What a replay found in a shot, as far as a repair needs it: collisions, intersections, and what comes too near."""

from collections.abc import Iterable, Iterator, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..._arguments import check_instance, checked_distance, checked_strings
from ...detection.detector import CollisionDetector
from ...detection.mesh import CollisionMesh
from ...scene_replay.results import IntervalResult
from ...scene_replay.scene_contacts import find_contacts
from ...usd.interval import Interval
from ...usd.scene import Scene
from ...usd.segment import Segment
from ...usd.selection import Selection
from ..contacts import keys_of

MeshPair = tuple[str, str]
"""Names of two meshes."""

INVERTED = "inverted tetrahedra"
"""The name of their number, see :func:`count_found`."""


@dataclass(frozen=True)
class Finding:
    """What a replay found in an interval, as far as a repair needs it.

    Two meshes that are kept, and a kept mesh with itself, count in ``kept_hits`` alone: no repair can free them.

    Attributes:
        hits: Number of pairs that collide.
        near: Number of pairs that come nearer than the minimum distance, colliding ones included, without those that
            are so initially.
        initially_near: Number of pairs that are nearer at the start of an interval that no other one precedes; 0 in
            other intervals.
        crossings: Numbers of edges that meet faces at the start and at the end, which is 0 if it is the same time.
        crossing_meshes: Names of the pairs of meshes that intersect at the start.
        is_joined: Whether the interval starts where the one before ends, with the same meshes.
        unrepaired_pairs: In the first interval the pairs of meshes that stay as they are, each sorted: they cross at
            its start. The other attributes do not count them. Empty in other intervals.
        unrepaired_hits: Number of pairs that collide of meshes that stay as they are.
        kept_hits: Number of those of meshes that are kept.
        ignored_pairs: Pairs of meshes that collide and are ignored.
        inverted: Number of tetrahedra that invert or are inverted; None if no mesh has any.
    """

    hits: int
    near: int
    initially_near: int
    crossings: tuple[int, int]
    crossing_meshes: tuple[MeshPair, ...]
    is_joined: bool
    unrepaired_pairs: tuple[MeshPair, ...] = ()
    unrepaired_hits: int = 0
    kept_hits: int = 0
    ignored_pairs: tuple[MeshPair, ...] = ()
    inverted: int | None = None

    @property
    def is_free(self) -> bool:
        """Whether nothing that is to be repaired collides, intersects or comes too near."""
        return not self.hits and not self.near and not any(self.crossings)


def count_found(findings: list[Finding], min_distance: float) -> dict[str, int]:
    """Returns the numbers of collisions and intersections, and of others that there may be, by their names."""
    crossings = sum(finding.crossings[0] for finding in findings) + findings[-1].crossings[1]
    counts = {"collisions": sum(finding.hits for finding in findings), "intersections": crossings}
    if min_distance:
        counts[f"pairs nearer than {min_distance:g}"] = sum(finding.near for finding in findings)
    if findings[0].unrepaired_pairs:
        number = sum(finding.unrepaired_hits for finding in findings)
        counts["collisions of meshes that cross at the first frame"] = number
    if any(finding.inverted is not None for finding in findings):
        counts[INVERTED] = sum(finding.inverted or 0 for finding in findings)
    return counts


def kept_meshes(scene: Scene, keep: Iterable[str] = ()) -> dict[str, str]:
    """Returns the meshes of a scene that a repair does not move, and why, by their names.

    Args:
        scene: The scene.
        keep: Patterns of meshes, as those of a selection, that are obstacles.

    Raises:
        TypeError: If ``keep`` is not a sequence of strings.
        ValueError: If a pattern matches no mesh.
    """
    kept = dict.fromkeys(matching_meshes(scene, keep, "keep"), "it is to be kept")
    prims = [scene.prim_of(name) for name in scene.names]
    is_still = scene.is_still and not any(prim.times for prim in prims)  # all may be moved then
    reasons = {prim.name: prim.why_not_written if is_still else prim.why_not_repaired for prim in prims}
    return {name: why for name, why in reasons.items() if why} | kept


def matching_meshes(scene: Scene, patterns: Iterable[str], what: str) -> list[str]:
    """Returns the names of the meshes of a scene that patterns match; errors are those of :func:`kept_meshes`."""
    patterns = checked_strings(patterns, what)
    prims = [scene.prim_of(name) for name in scene.names]
    for pattern in patterns:
        if not any(Selection(prims=(pattern,)).includes(prim) for prim in prims):
            raise ValueError(f"{what}: no mesh matches {pattern}")
    return [prim.name for prim in prims if patterns and Selection(prims=patterns).includes(prim)]


def closed_meshes(scene: Scene) -> set[str]:
    """Returns the names of the meshes without a border at the first time, which are bodies rather than cloth."""
    segment = scene.segment(0)
    low, high = np.sort(segment.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2).astype(np.int64).T
    mesh = np.repeat(segment.locate_faces(np.arange(len(segment.faces)))[0], 3)
    edges, edge = np.unique(low * segment.vertex_count + high, return_inverse=True)
    sides, count = np.unique(mesh * len(edges) + edge, return_counts=True)  # of one mesh: two may share a seam
    return {segment.meshes[n].name for n in np.setdiff1d(mesh, sides[count == 1] // max(1, len(edges)))}


def find_collisions(
    scene: Scene,
    results: Iterable[IntervalResult],
    *,
    keep: Iterable[str] = (),
    unrepaired_pairs: Iterable[MeshPair] | None = None,
    min_distance: float = 0.0,
    device: Any = None,
) -> Iterator[Finding]:
    """Yields what a repair needs of each interval of a scene.

    Args:
        scene: The scene.
        results: Results of its replay with intersections, in order.
        keep: Patterns of meshes that the repair does not move, as of :func:`~.repair_shot.repair_shot`.
        unrepaired_pairs: Names of the pairs of meshes that stay as they are, each sorted; default: two different
            meshes that cross at the first time, which are mostly meant to, such as the parts of a body.
        min_distance: Distance that pairs are to keep between the times too, in the scene's unit of length: 0 or at
            least 2^-1021. It is not looked for between elements that an edge of the mesh joins, nor at curves and
            points. Pairs that are nearer at the first time, or where a mesh jumps or changes its topology, are counted
            there alone.
        device: Warp device or its name; default: Warp's default.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If the distance is out of range, a pattern matches no mesh, or the scene is broken at some time.
    """
    check_instance(scene, "scene", Scene, "a Scene")
    kept = kept_meshes(scene, keep).keys()
    distance = checked_distance(min_distance, "min_distance")
    unrepaired = None if unrepaired_pairs is None else frozenset(unrepaired_pairs)
    return _find_collisions(results, scene.selection, kept, unrepaired, distance, device)


def _find_collisions(results, selection, kept, unrepaired, min_distance, device) -> Iterator[Finding]:
    """Yields the findings of :func:`find_collisions`, whose arguments have been checked."""
    last: Segment | None = None
    near_pairs = None
    for result in results:
        interval, summary = result.contacts.interval, result.summary
        assert summary.intersections is not None
        start, end = ({p: n for p, n in at.mesh_pairs.items() if not kept >= {*p}} for at in summary.intersections)
        hits = {pair: number for pair, number in summary.mesh_pairs.items() if not kept >= {*pair}}
        if unrepaired is None:
            unrepaired = frozenset(tuple(sorted(p)) for p, (crosses, _) in start.items() if crosses and p[0] != p[1])
        if last is None and min_distance:
            selection = replace(selection, ignored_names=selection.ignored_names | unrepaired)
            near_pairs = _NearPairs(selection, kept, min_distance, device)
        is_unrepaired = {pair: tuple(sorted(pair)) in unrepaired for pair in (*start, *end, *hits)}
        is_joined = interval.segment is last and not interval.jumps
        near = near_pairs.find(interval, is_joined) if near_pairs else (0, 0)
        counted, unrepaired_hits = (sum(hits[p] for p in hits if is_unrepaired[p] == which) for which in (False, True))
        low, high = (sum(sum(at[p]) for p in at if not is_unrepaired[p]) for at in (start, end))
        yield Finding(
            hits=counted,
            near=near[0],
            initially_near=near[1],
            crossings=(low, 0 if interval.is_at_rest else high),
            crossing_meshes=tuple(pair for pair in start if not is_unrepaired[pair]),
            is_joined=is_joined,
            unrepaired_pairs=tuple(sorted(unrepaired)) if last is None else (),
            unrepaired_hits=unrepaired_hits,
            kept_hits=sum(summary.mesh_pairs.values()) - counted - unrepaired_hits,
            ignored_pairs=tuple(summary.ignored),
            inverted=sum(f.number for f in summary.inverted) if interval.segment.tetrahedra.names else None,
        )
        last = interval.segment


class _NearPairs:
    """Finds the pairs that come nearer than a distance, interval by interval, without those that are so initially."""

    def __init__(self, selection: Selection, kept: Set[str], min_distance: float, device: Any):
        self._selection, self._kept = selection, kept
        self._min_distance, self._device = min_distance, device
        self._segment: Segment | None = None
        self._initial = np.zeros(0, np.int64)

    def find(self, interval: Interval, is_joined: bool) -> tuple[int, int]:
        """Returns the number of the pairs in an interval, and of the initial ones if it is not joined to another."""
        segment = interval.segment
        if segment is not self._segment:
            self._segment = segment
            self._mesh = CollisionMesh(segment.faces, segment.vertex_count, device=self._device)
            self._detector = CollisionDetector(self._mesh, method="exact", min_distance=self._min_distance)
            self._is_kept = np.array([mesh.name in self._kept for mesh in segment.meshes])
        if not is_joined:
            self._initial = self._pairs(interval, interval.x0)
        pairs = self._pairs(interval, interval.x1)
        near = len(pairs) - int(np.isin(pairs, self._initial).sum())
        return near, 0 if is_joined else len(self._initial)

    def _pairs(self, interval: Interval, end: np.ndarray) -> np.ndarray:
        """Returns a number for each pair that is too near on the way to some positions, int64."""
        found = self._detector.detect(interval.x0, end)
        (contacts,) = find_contacts([interval], self._mesh, found, self._selection)
        return keys_of(found)[contacts.counted][~self._is_kept[contacts.meshes].all(axis=1)]
