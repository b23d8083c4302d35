"""Passes over dividing planes, which move with the elements that they divide.

If one fixed direction separates two elements at the start of a step and at its end, on the same side, it separates them
at all times of a linear motion: where along it the plane lies at the end is free. Each vertex has an end of its path
that it wants, and one that it has reached, at first its start. A pass places each plane between what its two elements
have reached, as near as it may be to where they would meet, and then moves each vertex to the position above its planes
that is nearest to what it wants. What it had reached is above them, so that a solution exists for all pairs at once,
and each vertex finds it by itself, see :mod:`.vertex_projection`. Sheets that fall together, even by more than they are
apart, follow each other in a few passes. Elements that slide along a plane go on sliding.
"""

import warp as wp

from ...kernels.pipeline.queues import take_slot_int
from ..contacts.planes_between import FAR
from ..contacts.rules import inverse_mass_of
from ..schedule import divides_after, divides_now
from ..state.cluster import BLOCK, wait_for_block
from ..state.status import Loop, SolveStatus
from ..state.structs import CUT_SHORT, FROZEN, NO_NODE, NOT_PLACED, PLACED, DividingPlanes, Step
from ..state.vectors import HALF, ZERO, to_double
from ..tuning import CLOSE_MARGIN, CLOSE_TOGETHER, FAR_APART, MARGIN, MAX_PASSES, SLACK
from .vertex_projection import position_on_sides, position_on_way

wp.set_module_options({"enable_backward": False})


@wp.func
def want(planes: DividingPlanes, vertex: int, end: wp.vec3):
    """Makes the end of a path that was cut or frozen the one that a vertex wants."""
    planes.placed[vertex] = PLACED
    planes.wanted[vertex] = end


@wp.kernel
def begin_passes(step: Step, planes: DividingPlanes, particles: int, worlds: int, status: SolveStatus):
    """Lets each particle begin at its start, and want the end that it had when it got its first plane."""
    i = wp.tid()
    if i == 0:
        status.loop[Loop.PROJECTING] = 0  # sweeps are over; the next detection says whether there are others
        status.loop[Loop.PASS] = 0
        status.loop[Loop.MORE_PASSES] = wp.where(planes.count[0] > BLOCK, 1, 0)
    if i < worlds:
        before = status.loop[Loop.ITERATION] - 1
        if status.contact_iteration[i] == before and divides_after(status, i, before):
            status.idle[i] = status.idle[i] + 1  # until something moves
        planes.moved[i] = 0
        planes.missed[i] = 0
    if i < particles and planes.first[i] != NO_NODE:
        planes.listed[take_slot_int(planes.listed_count)] = i
        planes.reached[i] = step.motion.x0[i]
        if planes.placed[i] == NOT_PLACED:
            want(planes, i, step.vertices.x1[i])


@wp.struct
class _Side:
    """How far one of two elements reaches towards the other, along the normal of a plane [m]."""

    reached: wp.float64  # at the ends of paths that its vertices have reached
    wanted: wp.float64  # at those that they want
    fixed: wp.float64  # those of its vertices that cannot be moved, at the end
    inverse_mass: wp.float64  # sum over its vertices
    rests: bool  # whether all that can be moved is where it wants to be


@wp.func
def _side(
    step: Step, planes: DividingPlanes, corners: wp.vec4i, begin: int, end: int, normal: wp.vec3d, half: wp.float64
) -> _Side:
    """Returns how far the vertices from ``begin`` to ``end`` reach against a normal, and ``half`` of a distance more.

    Vertices of bodies are at their start until all planes are placed: a body moves as a whole.
    """
    side = _Side()
    side.reached = FAR
    side.wanted = FAR
    side.fixed = FAR
    side.rests = True
    for j in range(begin, end):
        vertex = corners[j]
        inverse_mass = wp.float64(inverse_mass_of(step.motion, vertex))
        wanted, reached = wp.vec3(), wp.vec3()
        if inverse_mass == ZERO or planes.placed[vertex] == NOT_PLACED:
            wanted = step.vertices.x1[vertex]
            reached = wp.where(inverse_mass == ZERO, wanted, step.motion.x0[vertex])
        else:
            wanted = planes.wanted[vertex]
            reached = planes.reached[vertex]
        height = wp.dot(normal, to_double(reached)) - half
        side.reached = wp.min(side.reached, height)
        side.wanted = wp.min(side.wanted, wp.dot(normal, to_double(wanted)) - half)
        side.inverse_mass += inverse_mass
        side.rests = side.rests and wp.length_sq(wanted - reached) == 0.0
        if inverse_mass == ZERO:
            side.fixed = wp.min(side.fixed, height)
    return side


@wp.func
def _place_plane(step: Step, planes: DividingPlanes, status: SolveStatus, plane: int):
    if planes.vertices[plane][3] < 0:
        return
    corners = planes.vertices[plane]
    place = planes.place[plane]
    normal = wp.vec3d(place[0], place[1], place[2])
    split = int(planes.split[plane])
    half = ZERO
    if planes.half:
        half = planes.half[plane]
    above = _side(step, planes, corners, 0, split, normal, half)
    below = _side(step, planes, corners, split, 4, -normal, half)
    if above.rests and below.rests and status.loop[Loop.PASS] > 1:  # if read too early, it is placed for nothing
        return
    start = wp.min(planes.distance[plane], FAR_APART * step.separation)
    margin = wp.where(start < CLOSE_TOGETHER * step.separation, CLOSE_MARGIN, MARGIN) * start
    least = margin + SLACK * start
    share = above.inverse_mass / (above.inverse_mass + below.inverse_mass)
    offset = above.wanted + share * (-below.wanted - above.wanted)
    distance = above.reached + below.reached
    if distance > ZERO:
        if HALF * distance < least:
            least = HALF * distance
            margin = least
        offset = wp.clamp(offset, least - below.reached, above.reached - least)
    # last, what cannot be moved decides
    place[3] = wp.max(wp.min(offset, above.fixed - margin), margin - below.fixed)
    planes.place[plane] = place
    planes.margin[plane] = float(margin)


@wp.kernel
def place_planes(step: Step, planes: DividingPlanes, status: SolveStatus, threads: int):
    """Places each plane where both elements would meet by their masses, but between what they have reached.

    Nor is it within a vertex that cannot be moved, which may have passed what the other has reached. Elements come no
    nearer to each other than a share of their distance at the start, or of ``FAR_APART`` separations.
    """
    loop = status.loop
    if wp.tid() == 0:
        loop[Loop.PASS] = loop[Loop.PASS] + 1
        loop[Loop.MORE_PASSES] = 0
    for plane in range(wp.tid(), wp.min(planes.count[0], planes.place.shape[0]), threads):
        _place_plane(step, planes, status, plane)


@wp.func
def _move_to_sides(step: Step, planes: DividingPlanes, tolerance: wp.float64, status: SolveStatus, particle: int):
    """Moves a particle as near to where it wants to end as its planes let it come.

    A world needs another pass if one of its particles is not there, and one has moved by more than the tolerance.
    """
    world = step.motion.world[particle]
    if planes.first[particle] < 0 or not divides_now(status, world):
        return
    if step.motion.inverse_mass[particle] == 0.0 or step.vertices.outcome[particle] & FROZEN != 0:
        return
    passes = status.loop[Loop.PASS]
    if planes.moved[world] < passes - 1 or planes.missed[world] < passes - 1:
        return
    reached = planes.reached[particle]
    wanted = planes.wanted[particle]
    end = reached
    if passes == 1:  # later, when a plane has moved, what remains of the way is mostly across it
        exact, cut = position_on_sides(planes, particle, reached, wanted)
        end = exact
        planes.placed[particle] = wp.where(cut, CUT_SHORT, PLACED)
    elif wp.length_sq(wanted - reached) > 0.0:
        end = position_on_way(planes, particle, reached, wanted)
    planes.reached[particle] = end
    if passes == MAX_PASSES:
        return
    if wp.length(end - reached) > float(tolerance):
        planes.moved[world] = passes
    if wp.length_sq(end - wanted) > 0.0:
        planes.missed[world] = passes
        status.loop[Loop.MORE_PASSES] = 1


@wp.kernel
def move_to_sides(step: Step, planes: DividingPlanes, tolerance: wp.float64, status: SolveStatus):
    """Moves each particle as near to where it wants to end as its planes let it come."""
    _move_to_sides(step, planes, tolerance, status, wp.tid())


@wp.kernel(module="unique", enable_backward=False, launch_bounds=BLOCK)
def pass_over_few_planes(step: Step, planes: DividingPlanes, tolerance: wp.float64, status: SolveStatus, threads: int):
    """Makes all passes over planes of which each thread of a block has one at most, in less time than launches."""
    thread, particles = wp.tid(), int(planes.listed_count[0])
    count = wp.min(planes.count[0], planes.place.shape[0])
    more = count > 0 and planes.count[0] <= BLOCK
    while more:
        wait_for_block()
        if thread == 0:
            status.loop[Loop.PASS] = status.loop[Loop.PASS] + 1
            status.loop[Loop.MORE_PASSES] = 0
        wait_for_block()
        for plane in range(thread, count, threads):
            _place_plane(step, planes, status, plane)
        wait_for_block()
        for i in range(thread, particles, threads):
            _move_to_sides(step, planes, tolerance, status, planes.listed[i])
        wait_for_block()
        more = status.loop[Loop.MORE_PASSES] == 1
    if thread == 0:
        planes.listed_count[0] = 0
