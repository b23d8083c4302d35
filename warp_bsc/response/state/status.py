"""How far a step is: what the conditions of its loop read, counters of a detection, and results."""

from enum import IntEnum

import warp as wp

wp.set_module_options({"enable_backward": False})


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
    SEARCHING = 11  # 1 if a queue was too small, until contacts are found without queues


class Detection(IntEnum):
    """Counters of the detection in progress: elements of :attr:`SolveStatus.detection`."""

    HITS = 0  # contacts
    EXCLUDED = 1  # contacts of elements that crossed or touched at the start
    OF_BODIES = 2  # contacts between bodies, which are delegated to the inner solver
    TOO_NEAR = 3  # 1 if a pair ends nearer than its separation, but not in contact
    FILTERED = 4  # contacts of shapes that do not collide by Newton's filters, and with planes that are filtered
    OPEN = 5  # contacts in worlds that do not freeze yet


class Result(IntEnum):
    """Results of a step: elements of :attr:`SolveStatus.results`."""

    CERTIFIED = 0  # 1 if the last detection found no contact
    COUNTED = 1  # 1 once all contacts of the predicted motion are counted
    FIRST_HITS = 2  # contacts of the predicted motion
    REMAINING = 3  # contacts that the last detection found
    EXCLUDED = 4  # contacts that the last detection found and excluded
    BODY_CONTACTS = 5  # contacts between bodies that the last detection found
    ITERATIONS = 6  # of detect and project or divide
    TRUNCATED = 7  # 1 if a path was cut
    FROZEN = 8  # 1 if a vertex or a body was frozen
    NOT_FINITE = 9  # particles whose predicted position or velocity was not finite
    CROSSINGS = 10  # edges that cross faces at the start
    FILTERED = 11  # pairs of the predicted motion that filters left out
    INVERTING = 12  # tetrahedra that the motion inverts or may invert, if they are looked at
    INVERTED = 13  # those that were or may have been inverted at the start
    NEW_CROSSINGS = 14  # by which crossings of an edge are more than at the start of the step before, in all edges


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
    idle: wp.array[int]  # of each world, divisions in succession that move nothing, with this one; it freezes from 2 on
    is_stuck: wp.array[int]  # of each world, 1 if a vertex collides that was frozen lately
    is_fast: wp.array[int]  # of each world, 1 if predicted paths of fast or pushing elements or bodies collide
    crossings: wp.array[int]  # of each world, edges that cross faces at the start
    of_worlds: WorldCounts
    max_iterations: int
    max_slow_iterations: int
    max_divisions: int
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


@wp.func
def clear_detection(status: SolveStatus):
    """Clears the counters of a detection."""
    for i in range(status.detection.shape[0]):
        status.detection[i] = 0


@wp.func
def clear_status(status: SolveStatus):
    """Clears everything for a step, except for the crossings, of the last step until recounted, and RECOUNT."""
    clear_detection(status)
    for i in range(status.loop.shape[0]):
        if i != Loop.RECOUNT:
            status.loop[i] = 0
    for j in range(status.results.shape[0]):
        if j != Result.CROSSINGS and j != Result.NEW_CROSSINGS:
            status.results[j] = 0


@wp.func
def has_sweeps(status: SolveStatus) -> bool:
    """Returns whether there are sweeps: there is none in an iteration that only divides."""
    return status.loop[Loop.ACTIVE] == 0 or status.loop[Loop.PROJECTING] == 1


@wp.kernel
def start_sweeps(status: SolveStatus):
    """Clears the count of sweeps of which each is launched."""
    status.loop[Loop.SWEEP] = 0
    status.loop[Loop.MORE_SWEEPS] = wp.where(has_sweeps(status), 1, 0)
