"""A detection in which bodies turn by small angles: one pass, also in a CUDA graph, see :mod:`.arc`."""

import numpy as np
import warp as wp

from ...kernels.arcs import Arcs
from ...kernels.motion import double
from ...kernels.signs import UNSURE
from ..narrow.contact_buffer import ContactRows
from ..narrow.on_host import pair_distances
from ..narrow.rules.arc import allocate_arcs, bound_arc
from ..pipeline import DetectionPipeline
from ..results.collision_finder import CollisionFinder
from ..run.launch import launch, made_once
from ..run.settings import NO_FUSED_OPERATIONS, PairKind
from .rigid_motion import ArcBounds, RigidMotion

_LARGEST_TURN = 0.5 * np.pi
"""Turn up to which one pass takes less time than parts of the step: its boxes reach beyond chords by the deviation over
the whole step, which is at most 0.31 of the distance from the axis."""


@made_once
def _bound_arcs(dtype: type) -> wp.Kernel:
    """Returns the kernel that bounds the arcs of all vertices, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def bound_arcs(x0: wp.array[dtype], x1: wp.array[dtype], arcs: Arcs):
        vertex = wp.tid()
        bound_arc(arcs, vertex, double(x0[vertex]), double(x1[vertex]))

    return bound_arcs


class ArcPipeline:
    """The pipeline of a detection with arcs.

    Attributes:
        pipeline: The pipeline, whose contacts include those on arcs.
        finder: Finds collisions by it, once :meth:`bound` has bounded their arcs.
        body: Body of each vertex that it is for, int32, shape [vertex_count].
        bounds: The motion that it was set to last.
    """

    def __init__(self, straight: DetectionPipeline, bounds: ArcBounds):
        """Allocates buffers.

        Args:
            straight: The pipeline for motions without turns, whose lock it shares; without radii.
            bounds: A motion of bodies.
        """
        motion = bounds.motion
        self.body, self.bounds = motion.body, bounds
        options = {"method": straight.method, "tolerance": straight.tolerance, "only_used_vertices": True}
        self._arcs = allocate_arcs(motion.body, len(motion.centre), straight.mesh.device)
        self.pipeline = DetectionPipeline(straight.mesh, arcs=self._arcs, **options)
        self.finder = CollisionFinder(self.pipeline, straight.broad_phase.lock)

    @staticmethod
    def is_for(motion: RigidMotion) -> bool:
        """Returns whether one pass decides a motion in less time than parts of the step."""
        return bool((np.linalg.norm(motion.turn, axis=1) <= _LARGEST_TURN).all())

    def has_unsure_pairs(self, contacts: dict[PairKind, ContactRows]) -> bool:
        """Returns whether the last run reports a pair on arcs that took too many parts of the step to decide.

        It may be farther from a collision than the tolerance.
        """
        turns, mesh = self.body >= 0, self.pipeline.mesh
        for kind, counts in self.pipeline.counts.pairs.items():
            if counts.unsure:
                rows = contacts[kind].read()
                corners, _distance = pair_distances(kind, mesh.elements(kind), rows.pairs, self.bounds.lever)
                if (turns[corners].any(axis=1) & (rows.status == UNSURE)).any():
                    return True
        return False

    def set_motion(self, bounds: ArcBounds) -> None:
        """Copies centres, turns, tolerance and rigid bodies of a motion of the same bodies to the device."""
        self.bounds = bounds
        self._arcs.rigid_id.assign(bounds.body)
        self._arcs.centre.assign(bounds.motion.centre)
        self._arcs.turn.assign(bounds.motion.turn)
        self._arcs.tolerance = bounds.tolerance

    def certifies(self, contacts: dict[PairKind, ContactRows]) -> bool:
        """Returns whether the last run of a CUDA graph proves its result, by its bodies and, if exact, its pairs.

        All bodies within which pairs are left out must have been rigid.
        """
        body = self.bounds.body
        are_rigid = bool(self.bounds.are_rigid()[body[body >= 0]].all())
        return are_rigid and not (self.pipeline.method == "exact" and self.has_unsure_pairs(contacts))

    def bound(self, x0: wp.array, x1: wp.array) -> None:
        """Bounds the arcs from one configuration to another; before each run, also in a CUDA graph."""
        arcs = self._arcs
        if x0.device.is_capturing:
            self.bounds.measure(x0, x1)
        arcs.turning.zero_()
        inputs = [x0, x1, arcs]
        launch(_bound_arcs(x0.dtype), len(x0), inputs=inputs, device=x0.device, record_tape=False)
