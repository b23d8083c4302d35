"""The narrow phase: queued pairs -> culls -> certified classification -> times of impact -> exact stage -> order.

Every stage writes a compact queue for the next, so that no thread waits for a neighbour's harder pair. Counts stay on
the device; they tell if a queue was too small, see :mod:`warp_bsc.kernels.pipeline.queues`.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import warp as wp

from ... import checker
from ...kernels.arcs import Arcs
from ...kernels.pipeline.batch_classification import BATCH as CLASSIFIED
from ...kernels.pipeline.batch_culling import BATCH as CULLED
from ...kernels.pipeline.batch_impacts import BATCH as DECIDED
from ...kernels.signs import FREE, HIT, ROUNDOFF
from ..run.launch import launch, launch_over, launch_over_queue, max_blocks
from ..run.settings import TOLERANCE, UNLIMITED, Count, DistanceKind, Method, PairCounts, PairKind, capacity_for
from ..run.stage_timer import StageTimer
from .batch_kernels import batch_classification_kernel, batch_culling_kernel, batch_impact_kernel
from .contact_buffer import ContactBuffer, HostContacts, make_contact_buffer
from .exact_stage import launch_exact_stage
from .pair_kernels import PairStages, culling_kernel, gather_contacts, pad_keys, pair_kernels

__all__ = ["NarrowPhase", "decide_on_host", "launch_over_kinds", "run_narrow_phases"]


class NarrowPhase:
    """Decides pairs of one kind, on the device.

    Attributes:
        kind: The kind of pair.
        counts: Counts by :class:`Count`, zero before each run, array of int64.
        queue: The pairs to decide, which the caller enqueues; ``counts[Count.QUEUED]`` of them are filled, array of
            vec2i.
        contacts: The contacts in no order; ``counts[Count.CONTACTS]`` rows are filled. Some have turned out to be free.
    """

    def __init__(
        self, kind: PairKind | DistanceKind, counts: wp.array, capacity: int, elements: Sequence[int] | np.ndarray
    ):
        """Allocates the buffers.

        Args:
            kind: The kind of pair.
            counts: Counts by :class:`Count`, array of int64.
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

    def fit_all(self) -> None:
        """Enlarges the buffers so that no run overflows them: all queued pairs may survive and be contacts."""
        self._allocate_survivors(len(self.queue))
        self._allocate_contacts(len(self.queue))

    @property
    def buffers(self) -> list:
        """All buffers that a run writes to and that may be replaced."""
        return [self.queue, self._survivors, self.contacts, self._keys, self._order, *self._for_exact]

    @property
    def capacities(self) -> PairCounts:
        """Capacities for the counts."""
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
        method: Method,
        timed: bool = True,
        tolerance: float = TOLERANCE,
        timer: StageTimer,
    ) -> None:
        """Launches all stages but the sorting over the queued pairs, without synchronizing with a GPU.

        Args:
            x0: Positions at the start of the step, array of vec3 or vec3d.
            x1: Positions at its end, of the same type.
            elements: Vertex indices of the faces (VERTEX_FACE) or edges (EDGE_EDGE), two-dimensional array of int.
            method: One of :data:`METHODS`; with "exact", pairs too wide for the device are left to
                :func:`decide_on_host`.
            timed: Whether to find times of impact, coordinates and normals.
            tolerance: Of the times of impact, as a share of the step.
            timer: Measures the stages.
        """
        run_narrow_phases([(self, elements)], x0, x1, method=method, timed=timed, tolerance=tolerance, timer=timer)

    def stages(self, elements: wp.array) -> PairStages:
        """Returns the buffers as one argument of kernels, with the vertex indices of the faces or edges."""
        stages = PairStages()
        stages.elements, stages.counts = elements, self.counts
        stages.queue, stages.survivors, stages.contacts = self.queue, self._survivors, self.contacts
        stages.keys, stages.order, stages.for_exact = self._keys, self._order, self._for_exact[0]
        stages.second_bits, stages.last_key = self._bits[1], self._last_key
        return stages

    @property
    def _last_key(self) -> int:
        """Sorting key of rows that are no contacts, greater than those of contacts."""
        return 1 << sum(self._bits)

    def decide_exactly(self, x0: wp.array, x1: wp.array, elements: wp.array, *, timed: bool, tolerance: float) -> None:
        """Launches the exact stage over the contacts that the last run has left to it; arguments as of :meth:`run`."""
        launch_exact_stage(
            self.kind,
            x0,
            x1,
            elements,
            timed=timed,
            tolerance=tolerance,
            queues=self._for_exact,
            counts=self.counts,
            filled=Count.FOR_EXACT,
            too_wide={1: Count.TOO_WIDE_1, 2: Count.TOO_WIDE_2, 4: Count.TOO_WIDE_4, 8: Count.TOO_WIDE_8},
            refuted=Count.REFUTED,
            contacts=self.contacts,
            keys=self._keys,
            last_key=self._last_key,
        )

    def sort(self) -> None:
        """Launches the sorting of the contacts by their pairs, without synchronizing with a GPU."""
        entries = len(self.contacts.pairs)
        device = self.counts.device
        if device.is_cpu:
            entries = min(entries, int(self.counts.numpy()[Count.CONTACTS]))
        else:
            inputs, outputs = [self.counts, self._last_key], [self._keys]
            launch_over(pad_keys, entries, inputs=inputs, outputs=outputs, device=device)
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


def launch_over_kinds(
    kernel: wp.Kernel,
    stages: Mapping[PairKind | DistanceKind, PairStages],
    buffer: str,
    *,
    inputs: list,
    block_dim: int,
) -> None:
    """Launches a kernel of a GPU over a buffer of both kinds, or over one after the other if they are too long.

    Args:
        kernel: The kernel; its last arguments are the stages of vertex-face and of edge-edge pairs.
        stages: The stages by kind.
        buffer: Attribute of the stages: the kernel covers the capacity of this buffer, first of vertex-face pairs.
        inputs: Its arguments between the first entry and the stages.
        block_dim: Threads of a block.
    """
    entries = {kind: getattr(s, buffer).shape[0] for kind, s in stages.items()}
    together = [list(stages)] if sum(entries.values()) < 2**31 else [[kind] for kind in stages]
    for kinds in together:
        both = [stages[kind] if kind in kinds else PairStages() for kind in PairKind]
        device = stages[kinds[0]].counts.device
        blocks, dim = max_blocks(device, block_dim), sum(entries[kind] for kind in kinds)
        launch_over(kernel, dim, inputs=inputs, outputs=both, device=device, block_dim=block_dim, max_blocks=blocks)


def run_narrow_phases(
    narrow_phases: Sequence[tuple[NarrowPhase, wp.array]],
    x0: wp.array,
    x1: wp.array,
    *,
    method: Method,
    timed: bool = True,
    tolerance: float = TOLERANCE,
    arcs: "Arcs | None" = None,
    timer: StageTimer,
) -> None:
    """Launches all stages but the sorting over the queued pairs of both kinds, or of one.

    A GPU decides both kinds in the same launches, without synchronizing.

    Args:
        narrow_phases: Narrow phases of different kinds, each with the vertex indices of its elements.
        x0: Positions at the start of the step, array of vec3 or vec3d.
        x1: Positions at its end, of the same type.
        method: As of :meth:`NarrowPhase.run`.
        timed: As of :meth:`NarrowPhase.run`.
        tolerance: As of :meth:`NarrowPhase.run`.
        arcs: Pairs with a turning vertex are left out, for :mod:`.arc_phase`; None if nothing turns.
        timer: Measures the stages.
    """
    on_arcs = arcs is not None
    arcs = Arcs() if arcs is None else arcs
    device = x0.device
    motion = [x0, x1, 0.0 if method == "float" else ROUNDOFF]
    kernels = pair_kernels(x0.dtype)
    stages = {narrow_phase.kind: narrow_phase.stages(elements) for narrow_phase, elements in narrow_phases}

    def launch_on_cpu(kernel_of: Callable, arguments: list, buffer: str, count: Count, batch: int) -> None:
        """Launches the kernel of each kind over the filled entries of a buffer, many at a time."""
        for kind, s in stages.items():
            filled = min(getattr(s, buffer).shape[0], int(s.counts.numpy()[count]))
            kernel, inputs = kernel_of(kind, x0.dtype), [*motion, *arguments]
            launch_over(kernel, -(-filled // batch), inputs=inputs, outputs=[s], device=device, chunk=16)

    with timer.stage("cull"):
        if device.is_cpu:
            cull = functools.partial(batch_culling_kernel, on_arcs=on_arcs)
            launch_on_cpu(cull, [arcs], "queue", Count.QUEUED, CULLED)
        else:
            for kind, s in stages.items():
                kernel = culling_kernel(kind, x0.dtype)
                launch_over_queue(kernel, s.queue, s.counts, Count.QUEUED, inputs=[*motion, arcs], outputs=[s])
    with timer.stage("classify"):
        if device.is_cpu:
            launch_on_cpu(batch_classification_kernel, [], "survivors", Count.SURVIVORS, CLASSIFIED)
        else:
            launch_over_kinds(kernels.classify_survivors, stages, "survivors", inputs=motion, block_dim=64)
    with timer.stage("time of impact"):
        arguments = [timed, tolerance]
        if device.is_cpu:
            launch_on_cpu(batch_impact_kernel, arguments, "for_exact", Count.CONTACTS, DECIDED)
        else:
            inputs = [*motion, *arguments]
            launch_over_kinds(kernels.find_impacts, stages, "for_exact", inputs=inputs, block_dim=32)
    if method == "exact":
        with timer.stage("exact"):
            for narrow_phase, elements in narrow_phases:
                narrow_phase.decide_exactly(x0, x1, elements, timed=timed, tolerance=tolerance)


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
    launch(
        pair_kernels(x0.dtype).find_contact_points,
        len(again),
        inputs=[x0, x1, elements, int(kind), timed_pairs, times],
        outputs=[coordinates, normal],
        device=x0.device,
        record_tape=False,
    )
    contacts.coordinates[again], contacts.normal[again] = coordinates.numpy(), normal.numpy()
