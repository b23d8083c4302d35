"""Collisions along the arcs of turning bodies: chords over parts of the step, with the deviation as minimum distance.

In a part of the step, no pair collides on its arcs whose chords stay farther apart than the bounds of their deviations
together, see :mod:`warp_bsc.kernels.arcs`. Parts are halved for the vertices of the other pairs, until these bounds are
at most half of the tolerance: then the pair is reported, whose arcs come within twice the bounds of each other. Pairs
without a turning body are those of :mod:`.detector` alone, and pairs within a rigid body stay as they are. Turns of up
to a quarter, without minimum distances, take less time in one pass, see :mod:`.arc_pipeline`.
"""

import dataclasses
import functools

import numpy as np
import warp as wp

from ..narrow.contact_buffer import HostContacts, empty_contacts, read_contacts
from ..narrow.on_host import pair_distances
from ..pipeline import DetectionPipeline
from ..run.launch import retry_until_fits
from ..run.phase_timer import PhaseTimer
from ..run.settings import Counts, PairKind, add_counts
from .rigid_motion import ArcBounds

_COARSE = 0.25
"""Largest deviation in the parts that a search begins with, as a share of the mean edge of turning bodies: boxes then
are not much larger than those of their elements."""


class ArcSearch:
    """Finds the pairs with a turning body that collide, or come near, along arcs. It reuses its buffers."""

    def __init__(self, straight: DetectionPipeline, body: np.ndarray, *, min_distance: float, rings: int):
        """Allocates the buffers on the mesh's device.

        Args:
            straight: The pipeline for motions without turns. The methods "conservative" and "exact" decide alike here,
                as the tolerance is wider than any doubt.
            body: Body of each vertex, -1 for those that move straight, int32, shape [vertex_count].
            min_distance: As of :class:`.detector.CollisionDetector`.
            rings: As of :class:`.detector.CollisionDetector`.
        """
        self.body = body
        self._mesh = mesh = straight.mesh
        options = {"method": "float" if straight.method == "float" else "conservative", "tolerance": straight.tolerance}
        options |= {"min_distance": min_distance, "rings": rings, "only_used_vertices": True}
        self._pipeline = DetectionPipeline(mesh, body=body, **options)
        self._elements = {n.kind: mesh.elements(n.kind) for n in self._pipeline.narrow_phases}

    def find(
        self, bounds: ArcBounds, x0: wp.array, changed: wp.array | None, timer: PhaseTimer
    ) -> tuple[dict[PairKind, HostContacts], Counts]:
        """Returns the contacts of each kind of pair, the first of each pair, and the counts of all parts together.

        Other arguments than the motion and its bounds are those of :meth:`.DetectionPipeline.find_contacts`.
        """
        self._bounds, self._timer = bounds, timer
        self._deviation = functools.cache(bounds.deviation)  # by level
        self._pipeline.set_bodies(bounds.body)
        self._counts: Counts | None = None
        self._found: dict[PairKind, list[HostContacts]] = {kind: [] for kind in self._elements}
        self._keys = {kind: np.zeros(0, dtype=np.int64) for kind in self._elements}
        level = self._first_level(x0)
        for part in range(2**level):
            self._search(level, part, changed)
        assert self._counts is not None
        return {kind: join_contacts(found) for kind, found in self._found.items()}, self._counts

    def _first_level(self, x0: wp.array) -> int:
        """Returns the number of halvings after which deviations are small against edges, or within the tolerance."""
        mesh, lever = self._mesh, self._bounds.lever
        of_bodies = mesh.edges[(lever[mesh.edges] > 0.0).any(axis=1)]
        size = lever.max(initial=0.0)
        if len(of_bodies):
            ends = x0.numpy()[of_bodies].astype(np.float64)
            size = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean()
        level, most = 0, max(0.25 * self._bounds.tolerance, _COARSE * float(size))
        while self._deviation(level).max(initial=0.0) > most:
            level += 1
        return level

    def _search(self, level: int, part: int, changed: wp.array | None) -> None:
        """Adds the contacts of a part of the step, the number ``part`` of those that last 2^-level, that are new."""
        left = np.zeros(self._mesh.vertex_count, dtype=bool)
        for kind, contacts in self._detect(level, part, changed).items():
            keys = contacts.pairs.astype(np.int64) @ np.array([2**31, 1])
            is_new = contacts.hit & ~np.isin(keys, self._keys[kind])
            corners, within = pair_distances(kind, self._elements[kind], contacts.pairs, self._deviation(level))
            ends = 2.0 * within <= self._bounds.tolerance  # arcs are that much farther apart than their chords
            left[corners[is_new & ~ends, 0]] = True  # one vertex of a pair suffices to find it again
            found = contacts.rows(is_new & ends)
            # a sum that is rounded up would be late
            found.toi = np.maximum(np.nextafter((part + found.toi) * 2.0**-level, -np.inf), part * 2.0**-level)
            if len(found.pairs):
                self._found[kind].append(found)
                self._keys[kind] = np.concatenate([self._keys[kind], keys[is_new & ends]])
        if left.any():
            vertices = wp.array(left, dtype=int, device=self._mesh.device)
            for half in range(2):
                self._search(level + 1, 2 * part + half, vertices)

    def _detect(self, level: int, part: int, changed: wp.array | None) -> dict[PairKind, HostContacts]:
        """Returns the pairs whose chords come within their deviations in a part of the step, of each kind."""
        pipeline, timer = self._pipeline, self._timer
        pipeline.add_to_radius(self._deviation(level))
        start, end = (self._bounds.place((part + i) * 2.0**-level) for i in range(2))
        find = functools.partial(pipeline.find_contacts, start, end, changed=changed, timer=timer)
        retry_until_fits(find, pipeline, self._mesh.device)
        # what floating point has left to exact arithmetic stays as it is
        pairs = {kind.label: counts._replace(for_exact=0) for kind, counts in pipeline.counts.pairs.items()}
        counts = dataclasses.replace(pipeline.counts, **pairs)
        self._counts = counts if self._counts is None else add_counts(self._counts, counts)
        with timer.phase("sort"):
            return {
                phase.kind: read_contacts(phase.contacts, int(pipeline.counts.pairs[phase.kind].contacts))
                for phase in pipeline.narrow_phases
            }


def join_contacts(parts: list[HostContacts]) -> HostContacts:
    """Returns contacts of different pairs together, sorted by their pairs."""
    parts = [part for part in parts if len(part.pairs)]
    if not parts:
        return empty_contacts()
    names = [field.name for field in dataclasses.fields(HostContacts)]
    joined = HostContacts(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    return joined.rows(np.lexsort((joined.pairs[:, 1], joined.pairs[:, 0])))
