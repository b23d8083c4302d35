"""Runs a detection pipeline, and makes its contacts a result."""

import threading
from collections.abc import Callable

import warp as wp

from ..._arguments import check_finite
from ...kernels.signs import UNSURE
from ..narrow.contact_buffer import ContactBufferPool, ContactRows, contacts_from_host, make_contact_buffer
from ..narrow.on_host import decide_on_host
from ..pipeline import DetectionPipeline
from ..run.launch import retry_until_fits
from ..run.phase_timer import PhaseTimer
from ..run.settings import Counts, PairKind
from .collisions import CapturedCollisions, Collisions
from .differentiable import DifferentiableContacts


class CollisionFinder:
    """Finds collisions by a pipeline. It reuses the buffers of results that are garbage.

    Attributes:
        pipeline: The pipeline.
    """

    def __init__(self, pipeline: DetectionPipeline, lock: threading.RLock):
        """Prepares the results of a pipeline; the lock is held while those of a graph are read."""
        self.pipeline, self._lock = pipeline, lock
        self._device = pipeline.mesh.device
        self._buffers = ContactBufferPool(self._device)
        self._side_stream = wp.Stream(self._device) if self._device.is_cuda else None

    def find(self, x0: wp.array, x1: wp.array, *, changed: wp.array | None = None, **options: bool) -> Collisions:
        """Returns the collisions of a motion.

        Arguments are those of :meth:`.DetectionPipeline.find_contacts`. Positions that are not finite are a ValueError.
        """
        pipeline = self.pipeline

        def launch() -> PhaseTimer:
            timer = PhaseTimer(self._device)
            pipeline.find_contacts(x0, x1, changed=changed, sort=True, timer=timer, **options)
            return timer

        timer = retry_until_fits(launch, pipeline, self._device)
        counts = pipeline.counts
        self.check_counted_finite(x0, x1)
        differentiable = x0.requires_grad or x1.requires_grad
        with timer.phase("sort"):
            contacts = self._ordered_contacts(counts, recycle=not differentiable)
        if pipeline.method == "exact" and any(pairs.too_wide_8 for pairs in counts.pairs.values()):
            with timer.phase("exact"):  # now, while the arrays hold these positions
                for kind, rows in contacts.items():
                    contacts[kind] = self._decide_on_host(kind, rows, x0, x1)
        buffers = {kind: rows.buffer for kind, rows in contacts.items()}
        arrays = self._differentiable(x0, x1, buffers) if differentiable else None
        return Collisions(pipeline.method != "float", (), arrays, pipeline.method, counts, contacts, timer)

    def capture(
        self, x0: wp.array, x1: wp.array, certifies: Callable[[dict[PairKind, ContactRows]], bool] = lambda _: True
    ) -> CapturedCollisions:
        """Adds a detection to the graph that a GPU captures.

        Contacts are sorted when they are read, as the graph would sort the whole capacity; in the graph with gradients.

        Args:
            x0: Positions at the start, as of :meth:`find`.
            x1: Positions at the end, of the same type.
            certifies: Returns whether a replay is certified, given its contacts, where its counts do not exclude it.
        """
        pipeline = self.pipeline
        differentiable = x0.requires_grad or x1.requires_grad
        pipeline.find_contacts(x0, x1, sort=differentiable, side_stream=self._side_stream)
        generation = pipeline.generation

        def read() -> Collisions:
            with self._lock:
                if generation != pipeline.generation:
                    why = "the detector's buffers have grown since this detection was captured"
                    raise RuntimeError(f"{why}: capture again")
                counts = pipeline.counters.read()
                overflows = tuple(pipeline.overflows(counts))
                left_to_host = pipeline.method == "exact" and any(pairs.too_wide_8 for pairs in counts.pairs.values())
                certified = pipeline.method != "float" and not (overflows or counts.not_finite or left_to_host)
                for narrow_phase in pipeline.narrow_phases:
                    narrow_phase.sort()
                contacts = self._ordered_contacts(counts, recycle=True)
                pipeline.counts = counts
                certified = certified and certifies(contacts)
                return Collisions(certified, overflows, arrays, pipeline.method, counts, contacts, PhaseTimer(None))

        arrays = None
        if differentiable:
            whole = {}
            for narrow_phase in pipeline.narrow_phases:
                capacity = len(narrow_phase.contacts.pairs)
                buffer = make_contact_buffer(capacity, self._device)
                whole[narrow_phase.kind] = narrow_phase.ordered_contacts(capacity, buffer)
            arrays = self._differentiable(x0, x1, whole)
        return CapturedCollisions(arrays, read)

    def check_counted_finite(self, x0: wp.array, x1: wp.array) -> None:
        """Raises a ValueError that names a vertex whose position is not finite, if the last run has counted one."""
        if self.pipeline.counts.not_finite:
            for name, x in (("x0", x0), ("x1", x1)):
                check_finite(x.numpy(), name, self.pipeline.mesh.vertices)

    def _ordered_contacts(self, counts: Counts, *, recycle: bool) -> dict[PairKind, ContactRows]:
        """Returns the sorted contacts of each kind of pair, without those that overflowed.

        Args:
            counts: The counts of the detection.
            recycle: Whether to use buffers of earlier results that are garbage, and to let later results use these;
                not where others refer to the arrays. Otherwise the buffers are new, without spare rows.
        """
        contacts, device = {}, self._device
        for narrow_phase in self.pipeline.narrow_phases:
            kind = narrow_phase.kind
            count = min(counts.pairs[kind].collisions, len(narrow_phase.contacts.pairs))
            rows = self._buffers.acquire(count) if recycle else ContactRows(make_contact_buffer(count, device), count)
            narrow_phase.ordered_contacts(count, rows.buffer)
            contacts[kind] = rows
        return contacts

    def _decide_on_host(self, kind: PairKind, rows: ContactRows, x0: wp.array, x1: wp.array) -> ContactRows:
        """Returns the contacts without those that the host refutes; the others get its times and points."""
        contacts = rows.read()
        which = (contacts.decided == UNSURE) | ~contacts.within_tolerance
        elements, radius = self.pipeline.mesh.device_elements(kind), self.pipeline.radius
        decide_on_host(kind, x0, x1, elements, radius, contacts, which)
        buffer = contacts_from_host(contacts.rows(contacts.hit), self._device)
        return ContactRows(buffer, len(buffer.pairs))

    def _differentiable(self, x0, x1, contacts):
        pipeline = self.pipeline
        return DifferentiableContacts(x0, x1, pipeline.mesh, pipeline.tolerance, contacts, pipeline.device_radius)
