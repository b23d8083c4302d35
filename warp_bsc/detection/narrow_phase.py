"""The narrow phase: pairs that come near -> culls -> certified classification -> times of impact, sorted.

Every stage writes a compact queue for the next, so that no thread waits for a neighbour's harder pair. Counts stay on
the device; a queue that was too small shows in them, see :mod:`warp_bsc.kernels.pipeline.queues`.
"""

import enum
import functools

import numpy as np
import warp as wp

from .. import checker
from ..kernels.classification import classify
from ..kernels.closest import contact_at
from ..kernels.culling import (
    centroid_direction,
    direction_separates,
    edge_edge_boxes_apart,
    vertex_face_boxes_apart,
)
from ..kernels.motion import edge_edge_motion, relative_motion, vertex_face_motion
from ..kernels.pipeline.batch_culling import BATCH, cull_batch_of, lowest_bit
from ..kernels.pipeline.queues import append, is_filled, take_slot
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE, coplanarity
from ..kernels.signs import FREE, HIT, ROUNDOFF, UNSURE, certified_sign_cubic
from ..kernels.time_of_impact import impact
from .exact_stage import launch_exact_stage
from .launch import launch_over, launch_over_queue

__all__ = [
    "METHODS",
    "TOLERANCE",
    "UNLIMITED",
    "Contacts",
    "Count",
    "NarrowPhase",
    "check_method",
    "check_tolerance",
    "decide_exactly",
    "roomy",
]

UNLIMITED = 2**62
"""Capacity for what is only counted."""

METHODS = ("float", "conservative", "exact")
"""What becomes of a pair that floating point cannot certify: its computed signs decide, it counts as a hit, or exact
arithmetic decides."""

TOLERANCE = 2.0**-20
"""Default tolerance of the time of impact, as a share of the step."""

_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}
"""Without fused operations every device computes the same bits."""


def check_method(method):
    """Raises ValueError if there is no such method."""
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, not {method!r}")


def check_tolerance(tolerance):
    """Raises ValueError if the tolerance is out of the range that halving the step reaches."""
    if not 2.0**-38 <= tolerance <= 1.0:
        raise ValueError(f"tolerance must be in [2^-38, 1], not {tolerance!r}")


class Count(enum.IntEnum):
    """Places of the counts of one kind of pair, in the order of the stages.

    Attributes:
        CANDIDATES: Pairs that share no vertex and whose boxes overlap over the time of the motion.
        NEAR: Those of them that no coordinate axis separates at the start and at the end, on the same side.
        SURVIVORS: Those that no cull decides.
        CONTACTS: Those that classification leaves.
        FOUND: Those that are not certified free.
        UNSURE: Those of them that are not certified hits either.
        OPEN: Those of the found that exact arithmetic is to decide or, where that is asked for, to time.
        WIDE: Those of them whose exponents are too far apart for one limb.
        WIDER: Those of them whose exponents are too far apart for two limbs.
        WIDEST: Those of them whose exponents are too far apart for the device.
        REFUTED: Those of the found that exact arithmetic has decided to be free.
    """

    CANDIDATES = 0
    NEAR = 1
    SURVIVORS = 2
    CONTACTS = 3
    FOUND = 4
    UNSURE = 5
    OPEN = 6
    WIDE = 7
    WIDER = 8
    WIDEST = 9
    REFUTED = 10


_NEAR = wp.constant(int(Count.NEAR))
_SURVIVORS = wp.constant(int(Count.SURVIVORS))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_FOUND = wp.constant(int(Count.FOUND))
_UNSURE = wp.constant(int(Count.UNSURE))
_OPEN = wp.constant(int(Count.OPEN))


@functools.cache
def _kernels(kind, dtype):
    """The kernels for one kind of pair and one type of position, each in a module of its own."""
    number = VERTEX_FACE if kind == "vertex_face" else EDGE_EDGE
    motion_of = vertex_face_motion if kind == "vertex_face" else edge_edge_motion
    boxes_apart = vertex_face_boxes_apart if kind == "vertex_face" else edge_edge_boxes_apart

    if kind == "vertex_face":

        @wp.func
        def four_points(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
            face = pair[1]
            return x[pair[0]], x[elements[face, 0]], x[elements[face, 1]], x[elements[face, 2]]
    else:

        @wp.func
        def four_points(x: wp.array[dtype], elements: wp.array2d[int], pair: wp.vec2i):
            first = pair[0]
            second = pair[1]
            return x[elements[first, 0]], x[elements[first, 1]], x[elements[second, 0]], x[elements[second, 1]]

    @wp.kernel(**_KERNEL)
    def cull(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        near: wp.array[wp.vec2i],
        counts: wp.array[wp.int64],
        survivors: wp.array[wp.vec2i],
    ):
        i = first + wp.tid()
        if not is_filled(i, near, counts, _NEAR):
            return
        pair = near[i]
        a0, b0, c0, d0 = four_points(x0, elements, pair)
        a1, b1, c1, d1 = four_points(x1, elements, pair)
        motion = motion_of(a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        y = coplanarity(motion)
        if certified_sign_cubic(y.k, y.bound) != 0:
            return
        if direction_separates(motion, centroid_direction(motion)):
            return
        # last, because what the broad phase calls near passes, in single precision always; but exact at any scale
        if boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1):
            return
        append(pair, survivors, counts, _SURVIVORS)

    cull_batch = cull_batch_of(dtype, kind == "vertex_face")

    @wp.kernel(**_KERNEL)
    def cull_batches(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        near: wp.array[wp.vec2i],
        counts: wp.array[wp.int64],
        survivors: wp.array[wp.vec2i],
    ):
        i = BATCH * (first + wp.tid())
        filled = wp.int32(wp.min(counts[_NEAR], wp.int64(near.shape[0])))
        left = cull_batch(x0, x1, elements, near, i, wp.min(BATCH, filled - i), roundoff)
        while left != wp.uint64(0):
            lane = lowest_bit(left)
            append(near[i + lane], survivors, counts, _SURVIVORS)
            left = left & (left - wp.uint64(1))

    @wp.kernel(**_KERNEL)
    def classify_survivors(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        survivors: wp.array[wp.vec2i],
        counts: wp.array[wp.int64],
        contacts: wp.array[wp.vec2i],
        status: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        if not is_filled(i, survivors, counts, _SURVIVORS):
            return
        pair = survivors[i]
        a0, b0, c0, d0 = four_points(x0, elements, pair)
        a1, b1, c1, d1 = four_points(x1, elements, pair)
        motion = relative_motion(number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
        answer = classify(motion, coplanarity(motion))
        if answer != FREE:
            slot = take_slot(counts, _CONTACTS)
            if slot < wp.int64(contacts.shape[0]):
                contacts[wp.int32(slot)] = pair
                status[wp.int32(slot)] = wp.int8(answer)

    @wp.kernel(**_KERNEL)
    def find_impacts(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        contacts: wp.array[wp.vec2i],
        counts: wp.array[wp.int64],
        status: wp.array[wp.int8],
        answers: wp.array[wp.int8],
        localized: wp.array[wp.bool],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
        keys: wp.array[wp.int64],
        order: wp.array[int],
        first_bits: int,
        second_bits: int,
        undecided: wp.array[int],
    ):
        i = first + wp.tid()
        if i >= contacts.shape[0]:
            return
        order[i] = i
        # stays so where there is no contact, which sorts it behind the others
        keys[i] = wp.int64(1) << wp.int64(first_bits + second_bits)
        if not is_filled(i, contacts, counts, _CONTACTS):
            return
        pair = contacts[i]
        answer = int(status[i])
        if timed or answer != HIT:
            a0, b0, c0, d0 = four_points(x0, elements, pair)
            a1, b1, c1, d1 = four_points(x1, elements, pair)
            motion = relative_motion(number, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            result = impact(motion, coplanarity(motion), answer, tolerance)
            answer = result.status
            status[i] = wp.int8(answer)
            localized[i] = result.localized == 1
            toi[i] = result.toi
            coordinates[i] = result.coordinates
            normal[i] = result.normal
        answers[i] = wp.int8(answer)
        if answer != FREE:
            keys[i] = (wp.int64(pair[0]) << wp.int64(second_bits)) | wp.int64(pair[1])
            take_slot(counts, _FOUND)
            if answer == UNSURE:
                take_slot(counts, _UNSURE)
            if answer == UNSURE or (timed and not localized[i]):
                undecided[wp.int32(take_slot(counts, _OPEN))] = i

    @wp.kernel(**_KERNEL)
    def find_contact_points(
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        contacts: wp.array[wp.vec2i],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        a0, b0, c0, d0 = four_points(x0, elements, contacts[i])
        a1, b1, c1, d1 = four_points(x1, elements, contacts[i])
        motion = relative_motion(number, a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        at, direction = contact_at(motion, toi[i])
        coordinates[i] = at
        normal[i] = direction

    return cull, cull_batches, classify_survivors, find_impacts, find_contact_points


@wp.kernel(**_KERNEL)
def _sort_contacts(
    first: int,
    contacts: wp.array[wp.vec2i],
    counts: wp.array[wp.int64],
    order: wp.array[int],
    status: wp.array[wp.int8],
    answers: wp.array[wp.int8],
    localized: wp.array[wp.bool],
    toi: wp.array[wp.float64],
    coordinates: wp.array[wp.vec3d],
    normal: wp.array[wp.vec3d],
    sorted_pairs: wp.array[wp.vec2i],
    sorted_status: wp.array[wp.int8],
    sorted_answers: wp.array[wp.int8],
    sorted_localized: wp.array[wp.bool],
    sorted_toi: wp.array[wp.float64],
    sorted_coordinates: wp.array[wp.vec3d],
    sorted_normal: wp.array[wp.vec3d],
):
    i = first + wp.tid()
    if not is_filled(i, contacts, counts, _FOUND):
        return
    source = order[i]
    sorted_pairs[i] = contacts[source]
    sorted_status[i] = status[source]
    sorted_answers[i] = answers[source]
    sorted_localized[i] = localized[source]
    sorted_toi[i] = toi[source]
    sorted_coordinates[i] = coordinates[source]
    sorted_normal[i] = normal[source]


class Contacts:
    """Pairs that were not certified free, with what is known of them, in arrays on the device.

    Attributes:
        pairs: (vertex, face) or (edge, edge), array of vec2i.
        status: What floating point could certify, HIT or UNSURE, array of int8.
        answers: The same after exact arithmetic, if the method asks for that: FREE, HIT, or UNSURE for what it leaves
            to the host, array of int8.
        localized: Whether the time is within the tolerance, array of bool.
        toi: Time of impact as a share of the step, array of float64.
        coordinates: Contact coordinates, array of vec3d.
        normal: Unit contact normals, array of vec3d.
    """

    def __init__(self, capacity, device):
        self.pairs = wp.empty(capacity, dtype=wp.vec2i, device=device)
        self.status = wp.empty(capacity, dtype=wp.int8, device=device)
        self.answers = wp.empty(capacity, dtype=wp.int8, device=device)
        self.localized = wp.zeros(capacity, dtype=wp.bool, device=device)
        self.toi = wp.empty(capacity, dtype=wp.float64, device=device)
        self.coordinates = wp.empty(capacity, dtype=wp.vec3d, device=device)
        self.normal = wp.empty(capacity, dtype=wp.vec3d, device=device)

    @property
    def arrays(self):
        """All arrays, in the order of the attributes."""
        return [self.pairs, self.status, self.answers, self.localized, self.toi, self.coordinates, self.normal]

    def read(self, count):
        """The first ``count`` contacts as NumPy arrays by name; ``hit`` is all of them not shown to be free."""
        names = ["pairs", "status", "answers", "localized", "toi", "coordinates", "normal"]
        contacts = {name: array[: int(count)].numpy().copy() for name, array in zip(names, self.arrays, strict=True)}
        contacts["hit"] = contacts["answers"] != FREE
        return contacts


class NarrowPhase:
    """Decides pairs of one kind, on the device.

    Attributes:
        near: Queue of the pairs to decide, to be filled by whoever finds them, array of vec2i.
        counts: Counts by :class:`Count`, array of int64.
        unsorted: The contacts, as many as ``counts[Count.CONTACTS]`` says, of which some have turned out to be free.
        contacts: The contacts, sorted, as many as ``counts[Count.FOUND] - counts[Count.REFUTED]`` says.
    """

    def __init__(self, kind, counts, capacity, elements):
        """Makes queues.

        Args:
            kind: "vertex_face" or "edge_edge".
            counts: Array of int64 with room for :class:`Count`, zero before each run.
            capacity: Room for pairs at first.
            elements: How many first and second elements there are to pair.
        """
        self.kind = kind
        self._bits = [max(1, int(count - 1).bit_length()) for count in elements]
        self.counts = counts
        self.near = wp.empty(capacity, dtype=wp.vec2i, device=counts.device)
        self._reserve_survivors(capacity // 2 + 64)
        self._reserve_contacts(capacity // 8 + 64)

    def _reserve_survivors(self, capacity):
        self._survivors = wp.empty(capacity, dtype=wp.vec2i, device=self.counts.device)

    def _reserve_contacts(self, capacity):
        device = self.counts.device
        self.unsorted = Contacts(capacity, device)
        self.contacts = Contacts(capacity, device)
        self._keys = wp.empty(2 * capacity, dtype=wp.int64, device=device)
        self._order = wp.empty(2 * capacity, dtype=int, device=device)
        self._undecided = [wp.empty(capacity, dtype=int, device=device) for _ in range(2)]

    @property
    def queues(self):
        """All arrays that a run writes to."""
        return [
            self.near,
            self._survivors,
            *self.unsorted.arrays,
            *self.contacts.arrays,
            self._keys,
            self._order,
            *self._undecided,
        ]

    @property
    def capacities(self):
        """How much room there is for what each count counts, in the order of :class:`Count`."""
        rooms = {Count.NEAR: self.near, Count.SURVIVORS: self._survivors, Count.CONTACTS: self.contacts.pairs}
        return [len(rooms[count]) if count in rooms else UNLIMITED for count in Count]

    def overflowed(self, counts):
        """Whether a queue was too small for the counts, NumPy array."""
        return bool((counts > self.capacities).any())

    def grow(self, counts):
        """Makes the queues large enough for the counts, with a quarter to spare."""
        needed = {count: roomy(counts[count]) for count in (Count.NEAR, Count.SURVIVORS, Count.CONTACTS)}
        if counts[Count.NEAR] > len(self.near):
            self.near = wp.empty(needed[Count.NEAR], dtype=wp.vec2i, device=self.counts.device)
        if counts[Count.SURVIVORS] > len(self._survivors):
            self._reserve_survivors(needed[Count.SURVIVORS])
        if counts[Count.CONTACTS] > len(self.contacts.pairs):
            self._reserve_contacts(needed[Count.CONTACTS])

    def run(self, x0, x1, elements, *, method, timed=True, tolerance=TOLERANCE, lap=lambda stage: None):
        """Launches all stages but the sorting over the pairs, without asking the device anything.

        Args:
            x0: Positions at the start of the step, Warp array of vec3 or vec3d.
            x1: Positions at its end, of the same type.
            elements: Vertex indices of the faces (vertex_face) or edges (edge_edge), Warp array of int,
                two-dimensional.
            method: One of :data:`METHODS`; what is too wide for the device is left to :func:`decide_exactly`.
            timed: Whether to find times of impact, coordinates and normals.
            tolerance: Of the times of impact, as a share of the step.
            lap: Called with the name of each stage at its end.
        """
        cull, cull_batches, classify_survivors, find_impacts, _ = _kernels(self.kind, x0.dtype)
        roundoff = 0.0 if method == "float" else ROUNDOFF
        motion = [x0, x1, elements, roundoff]
        counts, found = self.counts, self.unsorted

        inputs = [*motion, self.near, counts]
        if counts.device.is_cpu:
            batches = -(-min(len(self.near), int(counts.numpy()[Count.NEAR])) // BATCH)
            launch_over(cull_batches, batches, inputs=inputs, outputs=[self._survivors], device=counts.device, chunk=16)
        else:
            launch_over_queue(cull, self.near, counts, Count.NEAR, inputs=inputs, outputs=[self._survivors])
        lap("cull")

        inputs = [*motion, self._survivors, counts]
        outputs = [found.pairs, found.status]
        launch_over_queue(classify_survivors, self._survivors, counts, Count.SURVIVORS, inputs=inputs, outputs=outputs)
        lap("classify")

        inputs = [*motion, timed, tolerance, found.pairs, counts]
        outputs = [*found.arrays[1:], self._keys, self._order, *self._bits, self._undecided[0]]
        launch_over_queue(
            find_impacts, found.pairs, counts, Count.CONTACTS, inputs=inputs, outputs=outputs, block_dim=32
        )
        lap("time of impact")
        if method == "exact":
            launch_exact_stage(
                self.kind,
                x0,
                x1,
                elements,
                timed=timed,
                tolerance=tolerance,
                queues=self._undecided,
                counts=counts,
                asked=int(Count.OPEN),
                too_wide=[int(Count.WIDE), int(Count.WIDER), int(Count.WIDEST)],
                refuted=int(Count.REFUTED),
                contacts=[found.pairs, *found.arrays[2:]],
                keys=self._keys,
                last_key=1 << sum(self._bits),
            )
            lap("exact")

    def sort(self):
        """Launches the sorting of the contacts, without asking the device anything."""
        counts, found = self.counts, self.unsorted
        entries = len(found.pairs)
        if counts.device.is_cpu:
            entries = min(entries, int(counts.numpy()[Count.CONTACTS]))
        wp.utils.radix_sort_pairs(self._keys, self._order, entries, end_bit=sum(self._bits) + 1)
        inputs = [found.pairs, counts, self._order, *found.arrays[1:]]
        launch_over_queue(_sort_contacts, found.pairs, counts, Count.FOUND, inputs=inputs, outputs=self.contacts.arrays)


def roomy(count):
    """A capacity for so many entries, with a quarter to spare.

    Raises:
        ValueError: If the entries are more than a queue can have.
    """
    capacity = int(count) + int(count) // 4
    if capacity >= 2**31:
        raise ValueError(f"{count} pairs are more than one call can handle")
    return capacity


def decide_exactly(kind, x0, x1, elements, contacts, ask, *, timed=True):
    """Asks the exact checker about some contacts, on the host, and changes their entries.

    Args:
        kind: "vertex_face" or "edge_edge".
        x0: Positions at the start of the step, Warp array.
        x1: Positions at its end.
        elements: Vertex indices of faces or edges, Warp array.
        contacts: NumPy arrays by name: pairs, hit, and, if timed, localized, toi, coordinates, normal.
        ask: Which contacts, bool, shape [n].
        timed: Whether to find times of impact, coordinates and normals.
    """
    if not ask.any():
        return
    pairs, hit = contacts["pairs"], contacts["hit"]
    corners = elements.numpy()[pairs[ask, 1]]
    first = pairs[ask, :1] if kind == "vertex_face" else elements.numpy()[pairs[ask, 0]]
    corners = np.concatenate([first, corners], axis=1)
    points = np.concatenate([x0.numpy()[corners], x1.numpy()[corners]], axis=1)
    if not timed:
        hit[ask] = getattr(checker, kind)(points)
        return
    toi = contacts["toi"]
    toi[ask] = getattr(checker, f"{kind}_toi")(points)[:, 0]
    hit[ask] = ~np.isnan(toi[ask])
    toi[~hit] = 2.0
    contacts["localized"][ask] = hit[ask]
    again = np.flatnonzero(ask & hit)
    *_, find_contact_points = _kernels(kind, x0.dtype)
    at = wp.empty(len(again), dtype=wp.vec3d, device=x0.device)
    direction = wp.empty_like(at)
    times = wp.array(toi[again], dtype=wp.float64, device=x0.device)
    asked = wp.array(pairs[again], dtype=wp.vec2i, device=x0.device)
    inputs = [x0, x1, elements, asked, times]
    outputs = [at, direction]
    wp.launch(find_contact_points, len(again), inputs=inputs, outputs=outputs, device=x0.device, record_tape=False)
    contacts["coordinates"][again], contacts["normal"][again] = at.numpy(), direction.numpy()
