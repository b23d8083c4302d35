"""The narrow phase: queued pairs -> culls -> certified classification -> times of impact -> exact stage -> order.

Every stage writes a compact queue for the next, so that no thread waits for a neighbour's harder pair. Counts stay on
the device; a queue that was too small shows in them, see :mod:`warp_bsc.kernels.pipeline.queues`.
"""

import dataclasses

import numpy as np
import warp as wp

from .. import checker
from ..kernels.pipeline.batch_culling import BATCH
from ..kernels.signs import FREE, HIT, ROUNDOFF
from .contact_buffer import ContactBuffer, HostContacts, make_contact_buffer
from .exact_stage import launch_exact_stage
from .kernels import gather_contacts, pair_kernels
from .launch import launch_over, launch_over_queue
from .settings import TOLERANCE, UNLIMITED, Count, PairCounts, PairKind, capacity_for
from .stage_timer import StageTimer

__all__ = ["NarrowPhase", "decide_on_host"]


class NarrowPhase:
    """Decides pairs of one kind, on the device.

    Attributes:
        kind: The kind of pair.
        counts: Counts by :class:`Count`, zero before each run, array of int64.
        queue: The pairs to decide, which the caller enqueues; ``counts[Count.QUEUED]`` of them are filled, array of
            vec2i.
        contacts: The contacts in no order; ``counts[Count.CONTACTS]`` rows are filled. Some have turned out to be free.
    """

    def __init__(self, kind: PairKind, counts: wp.array, capacity: int, elements: tuple[int, int]):
        """Allocates the buffers.

        Args:
            kind: The kind of pair.
            counts: Array of int64 with a place for each :class:`Count`.
            capacity: Capacity for pairs at first.
            elements: Numbers of first and of second elements that pairs may have.
        """
        self.kind = kind
        self._bits = [max(1, int(count - 1).bit_length()) for count in elements]
        self.counts = counts
        self.queue = wp.empty(capacity, dtype=wp.vec2i, device=counts.device)
        self._allocate_survivors(capacity // 2 + 64)
        self._allocate_contacts(capacity // 8 + 64)

    def _allocate_survivors(self, capacity: int) -> None:
        self._survivors = wp.empty(capacity, dtype=wp.vec2i, device=self.counts.device)

    def _allocate_contacts(self, capacity: int) -> None:
        device = self.counts.device
        self.contacts = make_contact_buffer(capacity, device)
        self._keys = wp.empty(2 * capacity, dtype=wp.int64, device=device)
        self._order = wp.empty(2 * capacity, dtype=int, device=device)
        self._for_exact = [wp.empty(capacity, dtype=int, device=device) for _ in range(2)]

    @property
    def buffers(self) -> list:
        """All buffers that a run writes to and that may be replaced."""
        return [self.queue, self._survivors, self.contacts, self._keys, self._order, *self._for_exact]

    @property
    def capacities(self) -> PairCounts:
        """Capacities for what is counted."""
        unlimited = PairCounts(*[UNLIMITED] * len(Count))
        queue, survivors, contacts = len(self.queue), len(self._survivors), len(self.contacts.pairs)
        return dataclasses.replace(unlimited, queued=queue, survivors=survivors, contacts=contacts)

    def grow(self, counts: PairCounts | None = None) -> bool:
        """Enlarges the buffers that are too small for the counts, with a quarter to spare.

        Args:
            counts: The counts of the last run; None to read them, which synchronizes with the device.

        Returns:
            Whether a buffer was too small.

        Raises:
            ValueError: If a buffer cannot be large enough.
        """
        counts = PairCounts.of(self.counts.numpy()) if counts is None else counts
        overflowed = bool(counts.overflows(self.capacities, self.kind))
        label = self.kind.label
        if counts.queued > len(self.queue):
            capacity = capacity_for(counts.queued, f"{label} queued")
            self.queue = wp.empty(capacity, dtype=wp.vec2i, device=self.counts.device)
        if counts.survivors > len(self._survivors):
            self._allocate_survivors(capacity_for(counts.survivors, f"{label} survivors"))
        if counts.contacts > len(self.contacts.pairs):
            self._allocate_contacts(capacity_for(counts.contacts, f"{label} contacts"))
        return overflowed

    def run(
        self,
        x0: wp.array,
        x1: wp.array,
        elements: wp.array,
        *,
        method: str,
        timed: bool = True,
        tolerance: float = TOLERANCE,
        timer: StageTimer,
    ) -> None:
        """Launches all stages but the sorting over the queued pairs, without synchronizing with a GPU.

        Args:
            x0: Positions at the start of the step, array of vec3 or vec3d.
            x1: Positions at its end, of the same type.
            elements: Vertex indices of the faces (VERTEX_FACE) or edges (EDGE_EDGE), two-dimensional array of int.
            method: One of :data:`METHODS`; pairs too wide for the device are left to :func:`decide_on_host`.
            timed: Whether to find times of impact, coordinates and normals.
            tolerance: Of the times of impact, as a share of the step.
            timer: Measures the stages.
        """
        kernels = pair_kernels(self.kind, x0.dtype)
        roundoff = 0.0 if method == "float" else ROUNDOFF
        motion = [x0, x1, elements, roundoff]
        counts, contacts = self.counts, self.contacts

        with timer.stage("cull"):
            inputs, outputs = [*motion, self.queue], [counts, self._survivors]
            if counts.device.is_cpu:
                batches = -(-min(len(self.queue), int(counts.numpy()[Count.QUEUED])) // BATCH)
                launch_over(
                    kernels.cull_batches, batches, inputs=inputs, outputs=outputs, device=counts.device, chunk=16
                )
            else:
                launch_over_queue(kernels.cull, self.queue, counts, Count.QUEUED, inputs=inputs, outputs=outputs)

        with timer.stage("classify"):
            launch_over_queue(
                kernels.classify_survivors,
                self._survivors,
                counts,
                Count.SURVIVORS,
                inputs=[*motion, self._survivors],
                outputs=[counts, contacts],
            )

        with timer.stage("time of impact"):
            launch_over_queue(
                kernels.find_impacts,
                contacts.pairs,
                counts,
                Count.CONTACTS,
                inputs=[*motion, timed, tolerance, *self._bits],
                outputs=[counts, contacts, self._keys, self._order, self._for_exact[0]],
                block_dim=32,
            )

        if method == "exact":
            with timer.stage("exact"):
                launch_exact_stage(
                    self.kind,
                    x0,
                    x1,
                    elements,
                    timed=timed,
                    tolerance=tolerance,
                    queues=self._for_exact,
                    counts=counts,
                    filled=Count.FOR_EXACT,
                    too_wide=[Count.TOO_WIDE_1, Count.TOO_WIDE_2, Count.TOO_WIDE_8],
                    refuted=Count.REFUTED,
                    contacts=contacts,
                    keys=self._keys,
                    last_key=1 << sum(self._bits),
                )

    def sort(self) -> None:
        """Launches the sorting of the contacts by their pairs, without synchronizing with a GPU."""
        entries = len(self.contacts.pairs)
        if self.counts.device.is_cpu:
            entries = min(entries, int(self.counts.numpy()[Count.CONTACTS]))
        wp.utils.radix_sort_pairs(self._keys, self._order, entries, end_bit=sum(self._bits) + 1)

    def ordered_contacts(self, rows: int, buffer: ContactBuffer) -> ContactBuffer:
        """Copies the first contacts in their order, after :meth:`sort`, without synchronizing with a GPU.

        Args:
            rows: Number of contacts; those without one have the pair (-1, -1).
            buffer: Buffer to copy to, with at least that many rows.

        Returns:
            The buffer.
        """
        inputs = [self.counts, self._order, self.contacts]
        launch_over(gather_contacts, rows, inputs=inputs, outputs=[buffer], device=self.counts.device)
        return buffer


def decide_on_host(
    kind: PairKind,
    x0: wp.array,
    x1: wp.array,
    elements: wp.array,
    contacts: HostContacts,
    which: np.ndarray,
    *,
    timed: bool = True,
) -> None:
    """Decides some contacts with the exact checker, on the host, and changes their rows.

    Args:
        kind: The kind of pair.
        x0: Positions at the start of the step, Warp array.
        x1: Positions at its end.
        elements: Vertex indices of faces or edges, Warp array.
        contacts: The contacts.
        which: Which of them to decide, bool, shape [n].
        timed: Whether to find times of impact, coordinates and normals.
    """
    if not which.any():
        return
    pairs = contacts.pairs
    corners = elements.numpy()[pairs[which, 1]]
    first = pairs[which, :1] if kind == PairKind.VERTEX_FACE else elements.numpy()[pairs[which, 0]]
    corners = np.concatenate([first, corners], axis=1)
    points = np.concatenate([x0.numpy()[corners], x1.numpy()[corners]], axis=1)
    if not timed:
        contacts.decided[which] = np.where(getattr(checker, kind.label)(points), HIT, FREE)
        return
    toi = contacts.toi
    toi[which] = getattr(checker, f"{kind.label}_toi")(points)[:, 0]
    contacts.decided[which] = np.where(np.isnan(toi[which]), FREE, HIT)
    toi[~contacts.hit] = 2.0
    contacts.within_tolerance[which] = contacts.hit[which]
    again = np.flatnonzero(which & contacts.hit)
    coordinates = wp.empty(len(again), dtype=wp.vec3d, device=x0.device)
    normal = wp.empty_like(coordinates)
    times = wp.array(toi[again], dtype=wp.float64, device=x0.device)
    timed_pairs = wp.array(pairs[again], dtype=wp.vec2i, device=x0.device)
    wp.launch(
        pair_kernels(kind, x0.dtype).find_contact_points,
        len(again),
        inputs=[x0, x1, elements, timed_pairs, times],
        outputs=[coordinates, normal],
        device=x0.device,
        record_tape=False,
    )
    contacts.coordinates[again], contacts.normal[again] = coordinates.numpy(), normal.numpy()
