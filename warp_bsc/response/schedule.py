"""When a world projects, divides, truncates and freezes: all limits, the predicates on them, and the solve status.

What a world does after the ``n``-th detection of a step, counted from 0, which ``Loop.ITERATION`` is during detection.
The first detection tells slow worlds from fast ones::

                     slow contacts only              a fast, pushing or body contact
    n = 0            project, divide proximities     project
    n = 1 .. 39      divide (recorded: project)      project, target widened 1.25 times each n, at most 5 times
    n = 40 .. 71     divide                          divide (both recorded: truncate, n = 40 .. 47)
    then             freeze what still collides

Where a contact has no dividing plane, its paths are truncated instead.

When does a step end? When a detection finds no contact and no pair that is too near, or when freezing changes nothing
more. It ends: vertices that stood apart at the start and stand still do not collide.

When is a vertex frozen, that is, left at its start? If it still collides in the last row; if its prediction is not
finite; with all others, if the last detection was incomplete. A detection is incomplete if a queue was too small, and
queues cannot grow in a CUDA graph. :mod:`.contacts.search` then finds contacts without queues, and all worlds go to the
third row. Recorded steps cannot be searched, and freeze at once.

What makes a step uncertified? Contacts that are left, a last detection that was incomplete, or start positions that are
not finite, see :func:`decide`; and predictions that are not finite, whatever stands in their place. Where inversions
are prevented, tetrahedra that still invert as well.

Where inversions are prevented, the resolved motion goes through the last two rows once more. Each iteration divides
what collides, then cuts paths until no tetrahedron inverts, at most ``MAX_CUTS`` times; in the last row it freezes the
vertices of both. This ends as well: what stands still does not invert.

What is excluded? Contacts of elements that crossed or touched at the start, and vertices that were in the solid of a
plane there. They are counted, but not resolved, and a step with them may be certified. The same holds for tetrahedra
that were inverted at the start, for contacts of bodies that are left to the inner solver, see
:class:`.contacts.rules.ContactClass`, and for pairs that filters leave out, see
:class:`.state.collision_filter.CollisionFilter`.
"""

from enum import IntEnum

import warp as wp

from ..detection.run.settings import FILTERED_COUNTS
from ..kernels.pipeline.queues import has_overflowed
from .state.structs import Step

wp.set_module_options({"enable_backward": False})

MAX_ITERATIONS = 40
"""Iterations of detect and project, after which vertices that still collide are divided."""
MAX_SLOW_ITERATIONS = 1
"""The same in worlds without fast contacts: division hardly moves slow elements, and costs no sweeps."""
MAX_DIVISIONS = 32
"""Iterations of detect and divide, after which vertices that still collide are frozen, see :mod:`.solve.division`."""
MAX_PASSES = wp.constant(4)
"""Passes over dividing planes in each division: layers that fall together by more than they are apart need several."""
MAX_CUTS = wp.constant(64)
"""Sweeps over tetrahedra that cut paths, before a detection looks for what collides for that."""
MAX_TRUNCATIONS = wp.constant(8)
"""Iterations of detect and truncate of a recorded step, after which vertices that still collide are frozen."""
MAX_SWEEPS, SWEEPS_PER_BATCH = wp.constant(40), wp.constant(4)
"""Sweeps over constraints, in each iteration on positions, and at the end on velocities; and the sweeps over one active
set, after which the device checks whether a constraint is still active."""
SLOW_POSITION_SWEEPS = 4
"""Sweeps on positions over constraints that move no body in worlds without fast contacts: division resolves what they
leave. Velocities need more, as a sweep passes an impulse on by a layer."""
MAX_SWEEPS_PER_STEP = 1 + (MAX_ITERATIONS + 1) * int(MAX_SWEEPS)
"""Sweeps of a step: one ahead of the detection, those of all iterations, and those on velocities."""
_WIDENING = wp.constant(wp.float64(1.25))
"""Factor by which the separation of new constraints grows with each iteration, so that jams are resolved."""
_WIDEST = wp.constant(wp.float64(5.0))
"""Largest factor on the separation."""
_FIRST_FILTERED, _FILTERED_KINDS = wp.constant(FILTERED_COUNTS.start), wp.constant(len(FILTERED_COUNTS))
_FILTERED_STEP = wp.constant(FILTERED_COUNTS.step)
_LARGEST_COUNT = wp.constant(wp.int64(2**31 - 1))


class Loop(IntEnum):
    """What the conditions of the loop over iterations read: elements of :attr:`SolveStatus.loop`."""

    RECOUNT = 0  # 1 if crossings may have changed since they were counted
    ACTIVE = 1  # 1 while another iteration is needed
    UNFINISHED = 2  # 1 if the first detection leaves something to do
    ITERATION = 3  # detections so far, less one; from max_iterations on, all worlds divide
    PROJECTING = 4  # 1 if the last detection added constraints
    NEWLY_FROZEN = 5  # vertices and bodies that this iteration froze
    MORE_SWEEPS = 6  # 1 while another batch of sweeps is needed
    SWEEP = 7  # sweeps so far
    PASS = 8  # passes over dividing planes so far
    MORE_PASSES = 9  # 1 while another is needed
    CUTTING = 10  # 1 while tetrahedra invert, and paths are to be cut again


class Detection(IntEnum):
    """Counters of the detection in progress: elements of :attr:`SolveStatus.detection`."""

    HITS = 0  # contacts
    EXCLUDED = 1  # contacts of elements that crossed or touched at the start
    OF_BODIES = 2  # contacts between bodies, which are left to the inner solver
    TOO_NEAR = 3  # 1 if a pair ends nearer than its separation, but not in contact
    FILTERED = 4  # contacts of shapes that do not collide by Newton's filters, and with planes that are filtered


class Result(IntEnum):
    """Results of a step: elements of :attr:`SolveStatus.results`."""

    CERTIFIED = 0  # 1 if the last detection was complete and found no contact
    UNDETECTED = 1  # 1 if the last detection was incomplete
    COUNTED = 2  # 1 once all contacts of the predicted motion are counted
    FIRST_HITS = 3  # contacts of the predicted motion
    REMAINING = 4  # contacts that the last detection found
    EXCLUDED = 5  # contacts that the last detection found and excluded
    BODY_CONTACTS = 6  # contacts between bodies that the last detection found
    ITERATIONS = 7  # of detect and project or divide
    TRUNCATED = 8  # 1 if a path was cut
    FROZEN = 9  # 1 if a vertex or a body was frozen
    NOT_FINITE = 10  # particles whose predicted position or velocity was not finite
    CROSSINGS = 11  # edges that cross faces at the start
    FILTERED = 12  # pairs of the predicted motion that filters left out
    INVERTING = 13  # tetrahedra that the motion inverts or may invert, if they are looked at
    INVERTED = 14  # those that were or may have been inverted at the start
    NEW_CROSSINGS = 15  # by which crossings of an edge are more than at the start of the step before, in all edges


@wp.struct
class WorldCounts:
    """Contacts, filtered pairs and tetrahedra by world, shape [worlds]; empty if the report is not asked for worlds."""

    found: wp.array[int]  # by the detection in progress
    hits: wp.array[int]  # of the predicted motion
    remaining: wp.array[int]  # that the last detection found
    left_out: wp.array[int]  # by the detection in progress, see Detection.FILTERED
    left_out_pairs: wp.array[wp.int64]  # pairs of elements that groups and masks left out of the last detection
    filtered: wp.array[int]  # pairs of the predicted motion that filters left out, both of these
    inverting: wp.array[int]  # tetrahedra, see Result.INVERTING
    inverted: wp.array[int]  # see Result.INVERTED


@wp.struct
class SolveStatus:
    """How far a step is, and its limits."""

    loop: wp.array[int]  # elements of Loop
    detection: wp.array[int]  # of Detection
    results: wp.array[int]  # of Result
    contact_iteration: wp.array[int]  # of each world, the iteration after which it last had a contact
    is_fast: wp.array[int]  # of each world, 1 if predicted paths of fast or pushing elements or bodies collide
    crossings: wp.array[int]  # of each world, edges that cross faces at the start
    of_worlds: WorldCounts
    max_iterations: int
    max_slow_iterations: int
    max_truncations: int  # or divisions
    slow_position_sweeps: int


def single_elements(values: wp.array) -> list[wp.array]:
    """Returns views of the single elements of an array, which conditions on the device and the host can read."""
    return [values[i : i + 1] for i in range(len(values))]


def views_of(struct_type: type, values: wp.array):
    """Returns a struct whose fields, in their order, are views of one element each of an array."""
    struct = struct_type()
    for name, element in zip(struct_type.vars, single_elements(values), strict=True):
        setattr(struct, name, element)
    return struct


def allocate_status(worlds: int, device: wp.Device, *, max_iterations: int, recorded: bool) -> SolveStatus:
    """Returns a cleared status.

    Where steps may be ``recorded``, all sweeps are made, and paths are truncated, not divided.
    """
    status = SolveStatus()
    for name, fields in (("loop", Loop), ("detection", Detection), ("results", Result)):
        setattr(status, name, wp.zeros(len(fields), dtype=int, device=device))
    for name in ("contact_iteration", "is_fast", "crossings"):
        setattr(status, name, wp.zeros(worlds, dtype=int, device=device))
    status.max_iterations = max_iterations
    status.max_slow_iterations = MAX_ITERATIONS if recorded else MAX_SLOW_ITERATIONS
    status.max_truncations = int(MAX_TRUNCATIONS) if recorded else MAX_DIVISIONS
    status.slow_position_sweeps = int(MAX_SWEEPS) if recorded else SLOW_POSITION_SWEEPS
    return status


@wp.func
def _clear_detection(status: SolveStatus):
    for i in range(status.detection.shape[0]):
        status.detection[i] = 0


@wp.func
def clear_status(status: SolveStatus):
    """Clears everything for a step, except for the crossings, of the last step until recounted, and RECOUNT."""
    _clear_detection(status)
    for i in range(status.loop.shape[0]):
        if i != Loop.RECOUNT:
            status.loop[i] = 0
    for j in range(status.results.shape[0]):
        if j != Result.CROSSINGS and j != Result.NEW_CROSSINGS:
            status.results[j] = 0


@wp.func
def is_dividing(status: SolveStatus, world: int, iteration: int) -> bool:
    """Returns whether contacts found after ``iteration`` iterations are divided, or truncated, and not projected."""
    if iteration >= status.max_iterations:
        return True
    return iteration >= status.max_slow_iterations and status.is_fast[world] == 0


@wp.func
def divides_proximities(status: SolveStatus, world: int) -> bool:
    """Returns whether this iteration, after its projection, divides proximities of a world without fast contacts."""
    iteration = status.loop[Loop.ITERATION]
    if status.contact_iteration[world] != iteration - 1 or status.is_fast[world] == 1:
        return False
    return iteration == status.max_slow_iterations


@wp.func
def is_projecting(status: SolveStatus, world: int) -> bool:
    """Returns whether this iteration projects vertices of a world: one without contacts stays as it is."""
    iteration = status.loop[Loop.ITERATION]
    return status.contact_iteration[world] == iteration - 1 and not is_dividing(status, world, iteration - 1)


@wp.func
def is_divided(status: SolveStatus, world: int) -> bool:
    """Returns whether this iteration divides elements of a world, at first after its last projection.

    A world without contacts stays as it is.
    """
    iteration = status.loop[Loop.ITERATION]
    return status.contact_iteration[world] == iteration - 1 and is_dividing(status, world, iteration)


@wp.func
def is_freezing(status: SolveStatus) -> bool:
    """Returns whether this iteration freezes what still collides."""
    return status.loop[Loop.ITERATION] > status.max_iterations + status.max_truncations


@wp.func
def is_reversible(status: SolveStatus, is_slow: bool) -> bool:
    """Returns whether a constraint may pull back what it pushed too far, which keeps vertices near the prediction.

    Constraints of fast elements only push after the first iteration, which leaves space where contacts come back.
    """
    return status.loop[Loop.ITERATION] == 1 or is_slow


@wp.func
def widened(separation: wp.float64, status: SolveStatus) -> wp.float64:
    """Returns the separation of constraints that are added in this iteration [m]."""
    return separation * wp.min(wp.pow(_WIDENING, wp.float64(status.loop[Loop.ITERATION])), _WIDEST)


@wp.func
def count_contact(status: SolveStatus, world: int):
    """Counts a contact that a detection found."""
    wp.atomic_add(status.detection, int(Detection.HITS), 1)
    status.contact_iteration[world] = status.loop[Loop.ITERATION]
    if status.of_worlds.found:
        wp.atomic_add(status.of_worlds.found, world, 1)


@wp.func
def count_filtered(status: SolveStatus, world: int):
    """Counts a contact that a detection found, but that a filter leaves out."""
    wp.atomic_add(status.detection, int(Detection.FILTERED), 1)
    if status.of_worlds.left_out:
        wp.atomic_add(status.of_worlds.left_out, world, 1)


@wp.func
def count_inversion(status: SolveStatus, world: int, at_start: bool):
    """Counts a tetrahedron that the motion inverts, or one that was inverted ``at_start``."""
    wp.atomic_add(status.results, wp.where(at_start, int(Result.INVERTED), int(Result.INVERTING)), 1)
    if status.of_worlds.inverting:
        if at_start:
            wp.atomic_add(status.of_worlds.inverted, world, 1)
        else:
            wp.atomic_add(status.of_worlds.inverting, world, 1)


@wp.func
def _count_in_32_bits(count: wp.int64) -> int:
    return int(wp.min(count, _LARGEST_COUNT))


@wp.kernel
def decide_worlds(counts: wp.array[wp.int64], capacities: wp.array[wp.int64], can_search: bool, status: SolveStatus):
    """Takes over what a detection found and left out in each world, before :func:`decide` does so for all."""
    world = wp.tid()
    of_worlds = status.of_worlds
    found = of_worlds.found[world]
    left_out = of_worlds.left_out[world]
    of_worlds.found[world] = 0
    of_worlds.left_out[world] = 0
    if can_search and status.results[Result.UNDETECTED] == 0 and has_overflowed(counts, capacities):
        return  # a search finds them again
    if status.results[Result.COUNTED] == 0:
        of_worlds.hits[world] += found
        of_worlds.filtered[world] = _count_in_32_bits(of_worlds.left_out_pairs[world] + wp.int64(left_out))
    of_worlds.remaining[world] = found


@wp.func
def _count_filtered(counts: wp.array[wp.int64], contacts: int) -> int:
    """Returns the pairs that filters left out of a detection, by its counts, and contacts that were left out later."""
    filtered = wp.int64(contacts)
    for kind in range(_FILTERED_KINDS):
        filtered += counts[_FIRST_FILTERED + kind * _FILTERED_STEP]
    return _count_in_32_bits(filtered)


@wp.kernel
def decide(
    step: Step, counts: wp.array[wp.int64], capacities: wp.array[wp.int64], can_search: bool, status: SolveStatus
):
    """Decides from the contacts counted whether the motion is certified, and whether another iteration is needed.

    If a queue overflowed, the detection is incomplete. With ``can_search`` it is to be completed by
    :mod:`.contacts.search`, and decided upon by another launch.
    """
    loop = status.loop
    detection = status.detection
    results = status.results
    overflowed = has_overflowed(counts, capacities)
    if can_search and overflowed and results[Result.UNDETECTED] == 0:
        results[Result.UNDETECTED] = 1
        _clear_detection(status)
        loop[Loop.ITERATION] = wp.max(loop[Loop.ITERATION], status.max_iterations)
        return
    overflowed = overflowed and not can_search
    hits = detection[Detection.HITS]
    inverting = results[Result.INVERTING]
    finished = hits == 0 and detection[Detection.TOO_NEAR] == 0 and inverting == 0
    stuck = is_freezing(status) and loop[Loop.NEWLY_FROZEN] == 0
    results[Result.REMAINING] = hits
    results[Result.EXCLUDED] = detection[Detection.EXCLUDED]
    results[Result.BODY_CONTACTS] = detection[Detection.OF_BODIES]
    if results[Result.COUNTED] == 0:
        results[Result.FILTERED] = _count_filtered(counts, detection[Detection.FILTERED])
    _clear_detection(status)
    loop[Loop.NEWLY_FROZEN] = 0
    if results[Result.COUNTED] == 0:
        results[Result.FIRST_HITS] = results[Result.FIRST_HITS] + hits
        results[Result.COUNTED] = 1
    certified = hits == 0 and inverting == 0 and not overflowed and counts[0] == wp.int64(0)
    results[Result.CERTIFIED] = wp.where(certified, 1, 0)
    results[Result.UNDETECTED] = wp.where(overflowed, 1, 0)
    loop[Loop.ACTIVE] = wp.where(finished or overflowed or stuck, 0, 1)
    loop[Loop.ITERATION] = loop[Loop.ITERATION] + loop[Loop.ACTIVE]
    results[Result.ITERATIONS] = results[Result.ITERATIONS] + loop[Loop.ACTIVE]
    loop[Loop.UNFINISHED] = wp.where(loop[Loop.ACTIVE] == 1 or overflowed or step.constraints.count[0] > 0, 1, 0)


@wp.kernel
def begin_prevention(status: SolveStatus):
    """Begins to cut paths if the resolved motion inverts tetrahedra.

    Where contacts are left, it begins with the iterations that freeze. It leaves a step whose detection was incomplete
    as it is, with all vertices at their start.
    """
    results, loop = status.results, status.loop
    if results[Result.INVERTING] > 0 and results[Result.UNDETECTED] == 0:
        after = wp.where(results[Result.REMAINING] > 0, status.max_truncations, 0)
        loop[Loop.ITERATION] = status.max_iterations + after + 1
        loop[Loop.ACTIVE] = 1
        results[Result.ITERATIONS] = results[Result.ITERATIONS] + 1


@wp.kernel
def decide_cut(first: bool, status: SolveStatus):
    """Decides whether another sweep cuts paths, ``first`` before the first one."""
    loop = status.loop
    loop[Loop.SWEEP] = wp.where(first, 0, loop[Loop.SWEEP] + 1)
    loop[Loop.CUTTING] = wp.where(status.results[Result.INVERTING] > 0 and loop[Loop.SWEEP] < MAX_CUTS, 1, 0)


@wp.func
def begin_sweeps(status: SolveStatus):
    """Clears the count of sweeps; there is none in an iteration that divides, or truncates."""
    loop = status.loop
    loop[Loop.SWEEP] = 0
    loop[Loop.MORE_SWEEPS] = wp.where(loop[Loop.ACTIVE] == 0 or loop[Loop.PROJECTING] == 1, 1, 0)
    loop[Loop.PROJECTING] = 0


@wp.kernel
def start_sweeps(status: SolveStatus):
    """Launches :func:`begin_sweeps`."""
    begin_sweeps(status)
