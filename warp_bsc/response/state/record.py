"""The record of a step: everything that its adjoint needs in order to go back through it, last change first."""

import warp as wp

from ..schedule import Loop, SolveStatus, views_of
from .structs import Constraints, Step

wp.set_module_options({"enable_backward": False})


NO_CONTACT = wp.constant(-1)
"""The kind of contact of a path that was not truncated before a contact: its vertex was frozen."""

MAX_OFFSETS = wp.constant(64)
"""Capacity of the offsets, one for each iteration of detect and project."""

OFFSETS = "sweep_offsets", "constraint_offsets", "truncation_offsets"

PER_ENTRY = "constraint", "multiplier", "previous_multiplier", "momentum"

PER_TRUNCATION = "vertex", "end", "body", "pose", "contact", "kind", "within_tolerance", "toi", "coordinates", "normal"
"""Arrays of a record that have an element for each iteration, each entry, and each truncated path."""


@wp.struct
class RecordCounts:
    """Sizes and flags of a record; each field is an array of one element."""

    sweeps: wp.array[int]
    entries: wp.array[int]  # active constraints, summed over the sweeps
    truncations: wp.array[int]  # truncated paths
    dropped: wp.array[int]  # 1 if constraints were dropped
    grazing: wp.array[int]  # contacts whose gradients are clamped


@wp.struct
class StepRecord:
    """What each sweep and each truncation of a step changed. Its arrays are empty where nothing is recorded."""

    counts: RecordCounts
    sweep_ends: wp.array[int]  # entries at the end of a sweep
    constraint: wp.array[int]  # of an entry
    multiplier: wp.array[wp.vec3d]  # before the sweep
    previous_multiplier: wp.array[wp.vec3d]  # before the sweep
    momentum: wp.array[wp.float64]
    sweep_offsets: wp.array[int]  # sweeps at the beginning of an iteration
    constraint_offsets: wp.array[int]  # constraints at the beginning of an iteration
    truncation_offsets: wp.array[int]  # truncated paths at the beginning of an iteration
    vertex: wp.array[int]  # of a truncated path, -1 if it is that of a body
    end: wp.array[wp.vec3]  # of the path before it was truncated [m]
    body: wp.array[int]  # of a truncated path, -1 if it is that of a vertex
    pose: wp.array[wp.transform]  # of the body before its path was truncated
    kind: wp.array[int]  # of the contact that it was truncated before, or NO_CONTACT
    contact: wp.array[wp.vec4i]  # vertices of that contact; or the vertex and a plane
    within_tolerance: wp.array[wp.bool]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@wp.func
def is_recording(record: StepRecord) -> bool:
    """Returns whether the step is recorded."""
    return record.counts.sweeps.shape[0] > 0


@wp.func
def record_entry(
    record: StepRecord,
    place: int,
    constraint: int,
    multiplier: wp.vec3d,
    previous_multiplier: wp.vec3d,
    momentum: wp.float64,
):
    """Records an active constraint as it was before a sweep, by its place in the active set.

    Entries beyond the capacity are not stored; the count of entries includes them.
    """
    entry = record.counts.entries[0] + place
    if entry < record.constraint.shape[0]:
        record.constraint[entry] = constraint
        record.multiplier[entry] = multiplier
        record.previous_multiplier[entry] = previous_multiplier
        record.momentum[entry] = momentum


@wp.func
def end_sweep(record: StepRecord, active: int):
    """Closes a sweep of ``active`` constraints; a sweep of none is not recorded, as it changed nothing."""
    if active == 0:
        return
    sweep = record.counts.sweeps[0]
    entries = record.counts.entries[0] + active
    record.counts.entries[0] = entries
    record.counts.sweeps[0] = sweep + 1
    if sweep < record.sweep_ends.shape[0]:
        record.sweep_ends[sweep] = entries


@wp.func
def truncation_at(record: StepRecord, iteration: int, i: int) -> int:
    """Returns the place of a truncation of an iteration; -1 after its last."""
    entry = record.truncation_offsets[iteration] + i
    if entry >= record.truncation_offsets[iteration + 1]:
        return -1
    return entry


class StepRecorder:
    """Buffers for the record of a step, reused from step to step.

    Attributes:
        record: The buffers, :class:`StepRecord`.
        counts: The elements of ``record.counts`` as one array of int.
    """

    def __init__(self, device: wp.Device, *, max_sweeps: int):
        """Allocates buffers for this many sweeps, and none yet for their entries or for truncations."""
        self._device = device
        self.record = record = StepRecord()
        self.counts = wp.zeros(len(RecordCounts.vars), dtype=int, device=device)
        record.counts = views_of(RecordCounts, self.counts)
        record.sweep_ends = wp.zeros(max_sweeps, dtype=int, device=device)
        for name in OFFSETS:
            setattr(record, name, wp.zeros(int(MAX_OFFSETS), dtype=int, device=device))
        for names in (PER_ENTRY, PER_TRUNCATION):
            self._allocate(names, 0)

    def begin(self) -> StepRecord:
        """Clears the record, and returns it for the next step."""
        self.counts.zero_()
        return self.record

    def reserve_entries(self, more: int) -> StepRecord:
        """Reserves ``more`` entries, and returns the record. Synchronizes with the device."""
        return self._reserve(PER_ENTRY, self.record.counts.entries, more)

    def reserve_truncations(self, more: int) -> StepRecord:
        """Reserves ``more`` truncated paths, and returns the record. Synchronizes with the device."""
        return self._reserve(PER_TRUNCATION, self.record.counts.truncations, more)

    def _reserve(self, names, count, more):
        filled = int(count.numpy()[0])
        old = {name: getattr(self.record, name) for name in names}
        if filled + more > len(old[names[0]]):
            self._allocate(names, 2 * (filled + more))
            for name in names if filled else ():
                wp.copy(getattr(self.record, name), old[name], count=filled)
        return self.record

    def _allocate(self, names, capacity):
        for name in names:
            setattr(self.record, name, wp.empty(capacity, dtype=StepRecord.vars[name].type.dtype, device=self._device))


@wp.kernel
def record_offsets(step: Step, status: SolveStatus, record: StepRecord, after: int):
    """Records the offsets of an iteration, or those after the last; iterations that freeze share one offset."""
    last = status.max_iterations + status.max_truncations + 1
    iteration = status.loop[Loop.ITERATION]
    if after == 1 or iteration <= last:
        i = wp.min(iteration, last) + after
        record.sweep_offsets[i] = record.counts.sweeps[0]
        record.constraint_offsets[i] = step.constraints.count[0]
        record.truncation_offsets[i] = record.counts.truncations[0]


@wp.kernel
def check_complete(constraints: Constraints, record: StepRecord, complete: wp.array[int]):
    """Sets ``complete`` to 1 if everything that a step did fits in these constraints and its record, else to 0."""
    counts = record.counts
    fits = constraints.count[0] <= constraints.vertices.shape[0] and counts.dropped[0] == 0
    fits = fits and counts.sweeps[0] <= record.sweep_ends.shape[0]
    fits = fits and counts.entries[0] <= record.constraint.shape[0]
    fits = fits and counts.truncations[0] <= record.vertex.shape[0]
    complete[0] = wp.where(fits, 1, 0)
