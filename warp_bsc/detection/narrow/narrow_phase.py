"""The narrow phase: queued pairs -> culls -> certified classification -> times of impact -> exact phase -> order.

Every phase writes a compact queue for the next, so that no thread waits for a neighbour's harder pair. Counts stay on
the device; they tell if a queue was too small, see :mod:`warp_bsc.kernels.pipeline.queues`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from ...kernels.signs import FREE, UNSURE
from ..run.launch import launch_over, launch_over_queue, max_blocks
from ..run.settings import UNLIMITED, Count, PairCounts, PairKind, capacity_for
from .contact_buffer import ContactBuffer, make_contact_buffer
from .exact_phase import launch_exact_phase
from .pair_kernels import PairBuffers, PairRule, cull_kernel, decide_kernel, gather_contacts, pad_keys

_MANY = 2**22
"""Pairs from which on there is room for half as many survivors and contacts of each at first, which saves memory."""


class NarrowPhase:
    """Decides pairs of one kind, on the device.

    Attributes:
        kind: The kind of pair.
        counts: Counts by :class:`Count`, zero before each run, array of int64.
        queue: The pairs to decide, which the caller enqueues; ``counts[Count.QUEUED]`` of them are filled, array of
            vec2i.
        contacts: The contacts in no order; ``counts[Count.CONTACTS]`` rows are filled. Some have turned out to be free.
    """

    def __init__(self, kind: PairKind, counts: wp.array, capacity: int, elements: Sequence[int] | np.ndarray):
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
        room = min(capacity, max(capacity // 2, _MANY))
        self.allocate_survivors(room // 2 + 64)
        self.allocate_contacts(room // 8 + 64)

    def allocate_survivors(self, capacity: int) -> None:
        """Replaces the queue of pairs that no cull decides."""
        self._survivors = wp.empty(capacity, dtype=wp.vec2i, device=self.counts.device)

    def allocate_contacts(self, capacity: int) -> None:
        """Replaces the contacts, and the buffers of their order and of the exact phase."""
        device = self.counts.device
        keys, order = (wp.empty(2 * capacity, dtype=dtype, device=device) for dtype in (wp.int64, int))
        for_exact = [wp.empty(capacity, dtype=int, device=device) for _ in range(2)]
        # the sort allocates as much later, and does nothing where that fails
        wp.empty(capacity, dtype=wp.uint8, device=device)
        self.contacts, self._keys, self._order = make_contact_buffer(capacity, device), keys, order  # all or none
        self._for_exact = for_exact

    def fit_all(self) -> None:
        """Enlarges the buffers so that no run overflows them: all queued pairs may survive and be contacts."""
        self.allocate_survivors(len(self.queue))
        self.allocate_contacts(len(self.queue))

    @property
    def buffers(self) -> list:
        """All buffers that a run writes to and that may be replaced."""
        return [self.queue, self._survivors, self.contacts, self._keys, self._order, *self._for_exact]

    @property
    def capacities(self) -> PairCounts:
        """Capacities for the counts."""
        unlimited = PairCounts(*[UNLIMITED] * len(Count))
        queue, survivors, contacts = len(self.queue), len(self._survivors), len(self.contacts.pairs)
        return unlimited._replace(queued=queue, survivors=survivors, contacts=contacts)

    def grow(self, counts: PairCounts | None = None) -> bool:
        """Enlarges the buffers that are too small for the counts, with a quarter to spare.

        Args:
            counts: The counts of the last run; None to read them, which synchronizes with the device.

        Returns:
            Whether a buffer was too small.

        Raises:
            ValueError: If a buffer cannot be large enough.
        """
        counts = PairCounts(*self.counts.numpy().tolist()) if counts is None else counts
        overflowed = bool(counts.overflows(self.capacities, self.kind))
        label = self.kind.label
        if counts.queued > len(self.queue):
            capacity = capacity_for(counts.queued, f"{label} queued")
            self.queue = wp.empty(capacity, dtype=wp.vec2i, device=self.counts.device)
        if counts.survivors > len(self._survivors):
            self.allocate_survivors(capacity_for(counts.survivors, f"{label} survivors"))
        if counts.contacts > len(self.contacts.pairs):
            self.allocate_contacts(capacity_for(counts.contacts, f"{label} contacts"))
        return overflowed

    def pair_buffers(self, elements: wp.array) -> PairBuffers:
        """Returns the buffers as one argument of kernels, with the vertex indices of the faces or edges."""
        buffers = PairBuffers()
        buffers.elements, buffers.counts = elements, self.counts
        buffers.queue, buffers.survivors, buffers.contacts = self.queue, self._survivors, self.contacts
        buffers.keys, buffers.order = self._keys, self._order
        buffers.for_exact, buffers.for_search = self._for_exact
        buffers.second_bits, buffers.last_key = self._bits[1], self._last_key
        return buffers

    def counts_by_world(self, worlds: np.ndarray) -> list[PairCounts]:
        """Returns the counts of the last run, without arcs and numbers too wide, by world, given first elements'."""
        total = PairCounts(*self.counts.numpy().tolist())
        contacts, status = (values.numpy()[: total.contacts] for values in (self.contacts.pairs, self.contacts.status))
        pairs = {
            "queued": self.queue.numpy()[: total.queued],
            "survivors": self._survivors.numpy()[: total.survivors],
            "found": contacts[status != FREE],
            "unsure": contacts[status == UNSURE],
            "for_exact": contacts[self._for_exact[0].numpy()[: total.for_exact]],
        }
        counts = [np.bincount(worlds[rows[:, 0]], minlength=worlds.max() + 1).tolist() for rows in pairs.values()]
        return [PairCounts(**dict(zip(pairs, of_world, strict=True))) for of_world in zip(*counts, strict=True)]

    @property
    def _last_key(self) -> int:
        """Sorting key of rows that are no contacts, greater than those of contacts."""
        return 1 << sum(self._bits)

    def decide_exactly(self, x0: wp.array, x1: wp.array, elements: wp.array, *, timed: bool, tolerance: float) -> None:
        """Launches the exact phase over the contacts that the last run has left to it, see :func:`.run_contacts`."""
        options = {"timed": timed, "tolerance": tolerance}
        launch_exact_phase(self.kind, x0, x1, **options, buffers=self.pair_buffers(elements), left=self._for_exact[1])

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


Phases = Sequence[tuple[NarrowPhase, wp.array]]
"""Narrow phases of different kinds, each with the vertex indices of its second elements."""


def buffers_of(phases: Phases) -> dict[PairKind, PairBuffers]:
    """Returns the buffers of narrow phases by kind, as arguments of kernels."""
    return {phase.kind: phase.pair_buffers(elements) for phase, elements in phases}


def launch_culls(
    rule: PairRule, buffers: Mapping[PairKind, PairBuffers], x0: wp.array, x1: wp.array, options: Any
) -> None:
    """Launches a rule from the queue of each kind to its survivors, from both positions and the rule's options."""
    for kind, s in buffers.items():
        kernel = cull_kernel(rule, x0.dtype, int(kind) if rule.culls_by_kind else -1)
        inputs = [x0, x1, options, int(kind)]
        launch_over_queue(kernel, s.queue, s.counts, Count.QUEUED, inputs=inputs, outputs=[s])


def launch_decisions(
    rule: PairRule, buffers: Mapping[PairKind, PairBuffers], x0: wp.array, x1: wp.array, options: Any
) -> None:
    """Launches a rule from the survivors of all kinds to their contacts, as :func:`launch_culls`."""
    kernel, inputs = decide_kernel(rule, x0.dtype), [x0, x1, options]
    launch_over_kinds(kernel, buffers, "survivors", Count.SURVIVORS, inputs=inputs, block_dim=64)


def launch_over_kinds(
    kernel: wp.Kernel,
    buffers: Mapping[PairKind, PairBuffers],
    buffer: str,
    count: Count,
    *,
    inputs: list,
    block_dim: int,
) -> None:
    """Launches a kernel over a buffer of all kinds: on a GPU two at a time, unless they are too long, on a CPU singly.

    Args:
        kernel: The kernel; its last arguments are two kinds of pairs, and the buffers of the one and of the other.
        buffers: The buffers by kind.
        buffer: Attribute of the buffers: the kernel covers the capacity of this buffer, first of the one kind.
        count: Index of the number of entries in it, to which a CPU keeps.
        inputs: Its arguments between the first entry and the kinds.
        block_dim: Threads of a block.
    """
    entries = {kind: getattr(s, buffer).shape[0] for kind, s in buffers.items()}
    kinds, none = list(buffers), PairBuffers()
    while kinds:
        of_launch = kinds[:2]
        device = buffers[kinds[0]].counts.device
        if device.is_cpu or sum(entries[kind] for kind in of_launch) >= 2**31:
            of_launch = kinds[:1]
        kinds = kinds[len(of_launch) :]
        dim = sum(entries[kind] for kind in of_launch)
        if device.is_cpu:
            dim = min(dim, int(buffers[of_launch[0]].counts.numpy()[count]))
        numbers = wp.vec2i(*[int(kind) for kind in of_launch], *[-1] * (2 - len(of_launch)))
        both = [*(buffers[kind] for kind in of_launch), none][:2]
        options = {"device": device, "block_dim": block_dim, "max_blocks": max_blocks(device, block_dim)}
        launch_over(kernel, dim, inputs=[*inputs, numbers], outputs=both, **options)
