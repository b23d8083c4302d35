"""When a world projects, divides, truncates and freezes: all limits, the predicates on them, and the solve status.

What a world does after the ``n``-th detection of a step, counted from 0, which ``Loop.ITERATION`` is during detection.
The first detection tells slow worlds from fast ones::

                     slow contacts only              a fast, pushing or body contact
    n = 0            project, divide proximities     project
    n = 1 .. 39      divide                          project, with separations times min(1.25^n, 5)
    n = 40 .. 71     divide                          divide
    then             freeze what still collides

Where a contact has no dividing plane, its paths are truncated. In the iteration that follows detection ``n``,
``Loop.ITERATION`` is ``n`` + 1.

When does a step end? When a detection finds no contact and no pair that is too near, or when freezing changes nothing
more. It ends: vertices that stood apart at the start and stand still do not collide.

When is a vertex frozen, that is, kept at its start? If it still collides in the last row, to which a world goes early
if a division moves nothing in it: the next one would find the same contacts. One whose prediction is not finite stays
at its start as well, and is counted apart. Where a vertex collides that was frozen in one of the last ``STUCK_STEPS``
steps, its world divides from ``n = MAX_STUCK_ITERATIONS`` on: a program may force it through something. Where a queue
is too small, which cannot grow in a CUDA graph, :mod:`.contacts.search` finds contacts without queues, and all worlds
go to the third row.

What makes a step uncertified? Contacts that remain, or start positions that are not finite, see :func:`decide`;
predictions that are not finite; contacts on arcs; tetrahedra that still invert where that is prevented; and an end that
a coupled solver has not shown yet: ``state/certificate.py`` has it all.

Where inversions are prevented, the resolved motion goes through the last two rows once more. Each iteration divides
what collides, then cuts paths until no tetrahedron inverts, at most ``MAX_CUTS`` times; in the last row it freezes the
vertices of both. This ends as well: what stands still does not invert.

What is excluded, from resolution and from the certificate? Pairs of elements that crossed or touched at the start, and
vertices that were in the solid of a plane there (``Result.EXCLUDED``). They are counted, and a step with them may be
certified. So may one with tetrahedra that were inverted at the start (``INVERTED``), with contacts of bodies that are
delegated to the inner solver (``BODY_CONTACTS``, see :class:`.contacts.rules.ContactClass`), and with pairs that
filters leave out (``FILTERED``, see :class:`.state.collision_filter.CollisionFilter`).
"""

import warp as wp

from ..detection.run.settings import FILTERED_COUNTS, Counter
from ..kernels.pipeline.queues import has_overflowed
from .state.certificate import certify
from .state.status import Detection, Loop, Result, SolveStatus, clear_detection
from .state.structs import Step
from .tuning import MAX_CUTS, MAX_STUCK_ITERATIONS

wp.set_module_options({"enable_backward": False})

_WIDENING = wp.constant(wp.float64(1.25))
"""Factor by which the separation of new constraints grows with each iteration, so that jams are resolved."""
_WIDEST = wp.constant(wp.float64(5.0))
"""Largest factor on the separation."""
_FIRST_FILTERED, _FILTERED_KINDS = wp.constant(FILTERED_COUNTS.start), wp.constant(len(FILTERED_COUNTS))
_FILTERED_STEP = wp.constant(FILTERED_COUNTS.step)
_LARGEST_COUNT = wp.constant(wp.int64(2**31 - 1))


@wp.func
def divides_after(status: SolveStatus, world: int, iteration: int) -> bool:
    """Returns whether contacts found after ``iteration`` iterations are divided, and not projected."""
    if iteration >= status.max_iterations or (iteration >= MAX_STUCK_ITERATIONS and status.is_stuck[world] == 1):
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
def projects_now(status: SolveStatus, world: int) -> bool:
    """Returns whether this iteration projects vertices of a world: one without contacts stays as it is."""
    iteration = status.loop[Loop.ITERATION]
    return status.contact_iteration[world] == iteration - 1 and not divides_after(status, world, iteration - 1)


@wp.func
def divides_now(status: SolveStatus, world: int) -> bool:
    """Returns whether this iteration divides elements of a world, at first after its last projection.

    A world without contacts stays as it is.
    """
    iteration = status.loop[Loop.ITERATION]
    return status.contact_iteration[world] == iteration - 1 and divides_after(status, world, iteration)


@wp.func
def is_freezing(status: SolveStatus, world: int) -> bool:
    """Returns whether this iteration freezes what still collides in a world."""
    return status.idle[world] > 1 or status.loop[Loop.ITERATION] > status.max_iterations + status.max_divisions


@wp.func
def note_moved(status: SolveStatus, world: int):
    """Notes that this division moves something in a world."""
    if not is_freezing(status, world):
        status.idle[world] = 0


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
    if not is_freezing(status, world):
        wp.atomic_add(status.detection, int(Detection.OPEN), 1)
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
def decide_worlds(counts: wp.array[wp.int64], capacities: wp.array[wp.int64], status: SolveStatus):
    """Takes over what a detection found and left out in each world, before :func:`decide` does so for all."""
    world = wp.tid()
    of_worlds = status.of_worlds
    found = of_worlds.found[world]
    left_out = of_worlds.left_out[world]
    of_worlds.found[world] = 0
    of_worlds.left_out[world] = 0
    if status.loop[Loop.SEARCHING] == 0 and has_overflowed(counts, capacities):
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
def decide(step: Step, counts: wp.array[wp.int64], capacities: wp.array[wp.int64], status: SolveStatus):
    """Decides from the contacts counted whether the motion is certified, and whether another iteration is needed.

    If a queue overflowed, :mod:`.contacts.search` has to find the contacts, and another launch decides.
    """
    loop = status.loop
    detection = status.detection
    results = status.results
    if loop[Loop.SEARCHING] == 0 and has_overflowed(counts, capacities):
        loop[Loop.SEARCHING] = 1
        clear_detection(status)
        loop[Loop.ITERATION] = wp.max(loop[Loop.ITERATION], status.max_iterations)
        return
    loop[Loop.SEARCHING] = 0
    hits = detection[Detection.HITS]
    inverting = results[Result.INVERTING]
    finished = detection[Detection.OPEN] == 0 and detection[Detection.TOO_NEAR] == 0 and inverting == 0
    finished = finished and (hits == 0 or loop[Loop.NEWLY_FROZEN] == 0)
    is_last = loop[Loop.ITERATION] > status.max_iterations + status.max_divisions
    stuck = is_last and loop[Loop.NEWLY_FROZEN] == 0
    results[Result.REMAINING] = hits
    results[Result.EXCLUDED] = detection[Detection.EXCLUDED]
    results[Result.BODY_CONTACTS] = detection[Detection.OF_BODIES]
    if results[Result.COUNTED] == 0:
        results[Result.FILTERED] = _count_filtered(counts, detection[Detection.FILTERED])
    clear_detection(status)
    loop[Loop.NEWLY_FROZEN] = 0
    if results[Result.COUNTED] == 0:
        results[Result.FIRST_HITS] = results[Result.FIRST_HITS] + hits
        results[Result.COUNTED] = 1
    are_finite = counts[Counter.NOT_FINITE] == wp.int64(0)
    certify(results, hits == 0 and inverting == 0 and are_finite)
    loop[Loop.ACTIVE] = wp.where(finished or stuck, 0, 1)
    loop[Loop.ITERATION] = loop[Loop.ITERATION] + loop[Loop.ACTIVE]
    results[Result.ITERATIONS] = results[Result.ITERATIONS] + loop[Loop.ACTIVE]
    loop[Loop.UNFINISHED] = wp.where(loop[Loop.ACTIVE] == 1 or step.constraints.count[0] > 0, 1, 0)


@wp.kernel
def begin_prevention(status: SolveStatus):
    """Begins to cut paths if the resolved motion inverts tetrahedra.

    Where contacts remain, it begins with the iterations that freeze.
    """
    results, loop = status.results, status.loop
    if results[Result.INVERTING] > 0:
        after = wp.where(results[Result.REMAINING] > 0, status.max_divisions, 0)
        loop[Loop.ITERATION] = status.max_iterations + after + 1
        loop[Loop.ACTIVE] = 1
        for world in range(status.idle.shape[0]):
            status.idle[world] = 0
        results[Result.ITERATIONS] = results[Result.ITERATIONS] + 1


@wp.kernel
def decide_cut(first: bool, status: SolveStatus):
    """Decides whether another sweep cuts paths, ``first`` before the first one."""
    loop = status.loop
    loop[Loop.SWEEP] = wp.where(first, 0, loop[Loop.SWEEP] + 1)
    loop[Loop.CUTTING] = wp.where(status.results[Result.INVERTING] > 0 and loop[Loop.SWEEP] < MAX_CUTS, 1, 0)
