"""Collisions of a motion in which bodies turn: in one pass where turns are small, else by parts of the step."""

import numpy as np
import warp as wp

from ..mesh import changed_mesh
from ..narrow.contact_buffer import ContactRows, contacts_from_host
from ..pipeline import DetectionPipeline
from ..results.collision_finder import CollisionFinder
from ..results.collisions import CapturedCollisions, Collisions
from ..run.phase_timer import PhaseTimer
from ..run.settings import add_counts
from .arc_pipeline import ArcPipeline
from .arc_search import ArcSearch, join_contacts
from .rigid_motion import ArcBounds, RigidMotion


class ArcDetector:
    """Finds the collisions of motions in which bodies turn. It reuses what it has made for the same vertices.

    Attributes:
        at_once: The pipeline of small turns, None before the first motion of these.
    """

    def __init__(self, straight: DetectionPipeline, *, min_distance: float, rings: int):
        """Prepares a detector; buffers are allocated when they are needed.

        Args:
            straight: The pipeline for motions without turns, whose lock is held while results of a graph are read.
            min_distance: As of :class:`.detector.CollisionDetector`.
            rings: The same.
        """
        self._straight = straight
        self._distances = {"min_distance": min_distance, "rings": rings}
        self.at_once: ArcPipeline | None = None
        self._by_parts: tuple[ArcSearch, CollisionFinder | None] | None = None  # the second for vertices without bodies

    def find(self, arcs: RigidMotion, x0: wp.array, x1: wp.array, changed: wp.array | None) -> Collisions:
        """Returns the collisions of a motion of bodies that turn, of one vertex at least.

        Other arguments are those of :meth:`.CollisionFinder.find`, errors those of :meth:`.CollisionDetector.detect`.
        """
        if x0.requires_grad or x1.requires_grad:
            raise ValueError("rigid_motion: x0 and x1 must not require gradients")
        mesh, method, body = self._straight.mesh, self._straight.method, arcs.body
        bounds = ArcBounds(arcs, mesh.device_vertices, x0, x1)
        if self._straight.radius is None and ArcPipeline.is_for(arcs):
            at_once = self.at_once
            if at_once is None or not np.array_equal(at_once.body, body):
                at_once = self.at_once = ArcPipeline(self._straight, bounds)
            at_once.set_motion(bounds)
            at_once.bound(x0, x1)
            found = at_once.finder.find(x0, x1, changed=changed)
            if not at_once.has_unsure_pairs(found._rows):
                return found
        if self._by_parts is None or not np.array_equal(self._by_parts[0].body, body):
            others = None
            if (body[mesh.vertices] < 0).any():
                # pairs with a vertex that turns are left out
                group = np.where(body >= 0, np.uint32(0), np.uint32(1) if mesh.group is None else mesh.group)
                options = {"method": method, "tolerance": self._straight.tolerance, "only_used_vertices": True}
                apart = DetectionPipeline(changed_mesh(mesh, group=group), **self._distances, **options)
                others = CollisionFinder(apart, self._straight.broad_phase.lock)
            self._by_parts = ArcSearch(self._straight, body, **self._distances), others
        search, others = self._by_parts
        timer = PhaseTimer(mesh.device)
        contacts, counts = search.find(bounds, x0, changed, timer)
        if others is not None:
            found = others.find(x0, x1, changed=changed)
            timer.others.append(found._timer)
            for kind, rows in found._rows.items():
                contacts[kind] = join_contacts([contacts[kind], rows.read()])
            counts = add_counts(counts, found._counts.without_filtered())
        buffers = {kind: contacts_from_host(rows, mesh.device) for kind, rows in contacts.items()}
        rows = {kind: ContactRows(buffer, len(buffer.pairs)) for kind, buffer in buffers.items()}
        return Collisions(method != "float", (), None, method, counts, rows, timer)

    def capture(self, arcs: RigidMotion, x0: wp.array, x1: wp.array) -> CapturedCollisions:
        """Adds a detection to the graph that a GPU captures.

        Arguments are those of the last call of :meth:`find`, errors those of :meth:`.CollisionDetector.capture`.
        """
        refusal = "rigid_motion: a graph holds {}; detect outside the graph"
        if self._straight.radius is not None:
            raise NotImplementedError(refusal.format("none with min_distance or radius"))
        at_once = self.at_once
        if at_once is None or at_once.bounds.motion is not arcs:
            if not ArcPipeline.is_for(arcs):
                raise NotImplementedError(refusal.format("turns of at most a quarter of a turn"))
            raise RuntimeError("detect with this rigid_motion once before capturing, which copies them to the device")
        if x0.requires_grad or x1.requires_grad:
            raise ValueError("rigid_motion: x0 and x1 must not require gradients")
        at_once.bound(x0, x1)
        return at_once.finder.capture(x0, x1, at_once.certifies)
