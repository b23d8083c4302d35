"""The record of a step: everything that its adjoint needs in order to go back through it, last change first."""

from typing import Literal

import warp as wp

from .status import Loop, SolveStatus, views_of
from .structs import Constraints, Step, add_zeros

wp.set_module_options({"enable_backward": False})


NO_CONTACT = wp.constant(-1)
"""The kind of contact of a path that was not truncated before a contact: its vertex was frozen."""

MAX_OFFSETS = wp.constant(64)
"""Capacity of the offsets, one for each iteration of detect and project."""

OFFSETS = "sweep_offsets", "constraint_offsets", "truncation_offsets"
"""Arrays of a record that have an element for each iteration."""

_PER_TRUNCATION = "vertex", "end", "body", "pose", "contact", "kind", "within_tolerance", "toi", "coordinates", "normal"

GROWING = {"entries": ("constraint", "multiplier", "previous_multiplier", "momentum"), "truncations": _PER_TRUNCATION}
"""Arrays of a record that have an element for each entry or each truncated path, by the name of their count."""


@wp.struct
class RecordCounts:
    """Sizes and flags of a record; each field is an array of one element."""

    sweeps: wp.array[int]
    entries: wp.array[int]  # active constraints, summed over the sweeps
    truncations: wp.array[int]  # truncated paths
    dropped: wp.array[int]  # 1 if constraints were dropped
    grazing: wp.array[int]  # contacts whose gradients are clamped
    complete: wp.array[int]  # of a copy for an adjoint, 1 if nothing is missing


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
        self.record = record = StepRecord()
        self.counts = wp.zeros(len(RecordCounts.vars), dtype=int, device=device)
        record.counts = views_of(RecordCounts, self.counts)
        add_zeros(record, ["sweep_ends"], max_sweeps, device)
        add_zeros(record, OFFSETS, int(MAX_OFFSETS), device)
        for names in GROWING.values():
            add_zeros(record, names, 0, device)
        self._retired: list[dict[str, wp.array]] = []

    def reserve(self, kind: Literal["entries", "truncations"], more: int) -> None:
        """Reserves ``more`` entries or truncated paths, which synchronizes; does nothing in a CUDA graph."""
        if self.counts.device.is_capturing:
            return
        names, filled = GROWING[kind], int(getattr(self.record.counts, kind).numpy()[0])
        old = {name: getattr(self.record, name) for name in names}
        if filled + more > len(old[names[0]]):
            self._retired.append(old)  # a CUDA graph may still write to it
            add_zeros(self.record, names, 2 * (filled + more), self.counts.device)
            for name in names if filled else ():
                wp.copy(getattr(self.record, name), old[name], count=filled)


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
def check_complete(constraints: Constraints, record: StepRecord):
    """Sets whether the record is complete: whether all that a step did fits in these constraints and in the record."""
    counts = record.counts
    fits = constraints.count[0] <= constraints.vertices.shape[0] and counts.dropped[0] == 0
    fits = fits and counts.sweeps[0] <= record.sweep_ends.shape[0]
    fits = fits and counts.entries[0] <= record.constraint.shape[0]
    fits = fits and counts.truncations[0] <= record.vertex.shape[0]
    counts.complete[0] = wp.where(fits, 1, 0)
