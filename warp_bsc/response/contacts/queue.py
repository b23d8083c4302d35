"""Queues of a detection as kernels take them: candidates, or contacts with their times of impact."""

import warp as wp

from ...detection.pipeline import DetectionPipeline
from ...detection.run.settings import Count
from ...kernels.pairs import points_of_pair
from ...kernels.pipeline.queues import filled_entries, is_filled


@wp.struct
class PairQueue:
    """The pairs of one kind that a detection found, unsorted; those of candidates have no times of impact."""

    kind: int  # VERTEX_FACE, EDGE_EDGE, VERTEX_EDGE or VERTEX_VERTEX
    count: int  # index in counts of the number of pairs, a Count
    elements: wp.array2d[int]  # faces or edges, see points_of_pair
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]
    status: wp.array[wp.int8]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@wp.func
def has_pair(queue: PairQueue, i: int) -> bool:
    """Returns whether a queue has a pair ``i``."""
    return is_filled(i, queue.pairs, queue.counts, queue.count)


@wp.func
def pair_count(queue: PairQueue) -> int:
    """Returns the number of pairs in a queue."""
    return filled_entries(queue.pairs, queue.counts, queue.count)


@wp.func
def vertices_of(queue: PairQueue, i: int) -> wp.vec4i:
    """Returns the four vertices of a pair, those of its first element first; see :func:`points_of_pair`."""
    return points_of_pair(queue.kind, queue.elements, queue.pairs[i])


def queues_of(detector: DetectionPipeline, *, candidates: bool = False) -> list[PairQueue]:
    """Returns the contacts that a detection found, or its candidates: vertex-face, edge-edge, then those of points."""
    queues = []
    for narrow_phase in detector.narrow_phases:
        queue, found = PairQueue(), narrow_phase.contacts
        queue.kind, queue.counts = int(narrow_phase.kind), narrow_phase.counts
        queue.elements = detector.mesh.device_elements(narrow_phase.kind)
        queue.count = int(Count.QUEUED if candidates else Count.CONTACTS)
        if candidates:
            queue.pairs = narrow_phase.queue
        else:
            for name in ("pairs", "status", "toi", "coordinates", "normal"):
                setattr(queue, name, getattr(found, name))
        queues.append(queue)
    return queues
