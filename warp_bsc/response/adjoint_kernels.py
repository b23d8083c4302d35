"""The small steps of a response as functions that Warp differentiates: what each changes.

Their adjoints are what :mod:`.adjoint` launches; what they do is done by the modules that they name.
"""

import warp as wp

from ..detection.settings import TOLERANCE, Count
from ..kernels.gradients import with_gradients
from ..kernels.pipeline.queues import is_filled
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..kernels.signs import FREE, HIT, UNSURE
from ..kernels.time_of_impact import Impact
from .angular_momentum import HELD, MASS, MOMENTS, Moments, acts, change_by_turn, is_held, moments, torque_of, turns
from .constraints import (
    EDGE_EDGE_CONTACT,
    NEAR_EDGES,
    ON_PLANE,
    SHARE,
    VERTEX_FACE_CONTACT,
    Constraints,
    Contacts,
    Progress,
    Vertices,
    contact_vertices,
    contact_weights,
    feasible,
    feasible_in_contact,
    longest_path,
    relative,
    to_double,
    to_single,
    urgency_of,
    widened,
)
from .planes import HalfSpaces, clearance, time_of_entry
from .projection import accelerated, displaced, starts, takes_back
from .proximities import closest_weights
from .step_record import GRAZING, STANDS, History

__all__ = [
    "CURRENT",
    "CURSOR",
    "FIRST",
    "MARK",
    "NEXT",
    "accelerating",
    "constraining",
    "count_grazing",
    "displacing",
    "entry_of",
    "massing",
    "starting",
    "truncating",
    "turning",
    "twisting",
]

NEXT, CURRENT, FIRST, MARK, CURSOR = (wp.constant(i) for i in range(5))
"""Places in the array that says how far undoing is: the iteration to undo next, the one being undone or -1, the first
of the round, and the mark of the round; and how many places there are."""

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))
_CONTACTS = wp.constant(int(Count.CONTACTS))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.func
def _push(vertices: Vertices, constraints: Constraints, i: int, change: wp.vec3d, push: wp.array[wp.vec3]):
    """Adds what the change of a multiplier does to its vertices, see :func:`.projection.spread`."""
    for j in range(4):
        vertex = constraints.vertices[i][j]
        share = constraints.weights[i][j] * wp.float64(vertices.inverse_mass[vertex])
        wp.atomic_add(push, vertex, to_single(share * change))


@wp.func
def _first_entry(history: History, iteration: int) -> int:
    if iteration == 0:
        return 0
    return history.ends[iteration - 1]


@wp.func
def entry_of(history: History, iteration: int, place: int) -> int:
    """The entry of a constraint that acted in an iteration, by its place; -1 if not so many did."""
    if iteration < 0:
        return -1
    entry = _first_entry(history, iteration) + place
    return wp.where(entry < history.ends[iteration], entry, -1)


@wp.kernel
def displacing(
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    cursor: wp.array[int],
    multiplier_change: wp.array[wp.vec3d],
    reached_change: wp.array[wp.vec3d],
    push: wp.array[wp.vec3],
):
    """What an iteration on positions changes, by :func:`.projection.displace`."""
    entry = entry_of(progress.history, cursor[CURRENT], wp.tid())
    if entry < 0:
        return
    i = progress.history.constraint[entry]
    reached = displaced(vertices, constraints, i, not takes_back(constraints, progress, i))
    before = constraints.reached[i]
    change = reached + progress.history.momentum[entry] * (reached - before) - constraints.displacing[i]
    multiplier_change[i] = change
    reached_change[i] = reached - before
    _push(vertices, constraints, i, change, push)


@wp.kernel
def accelerating(
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    cursor: wp.array[int],
    restitution: wp.float64,
    multiplier_change: wp.array[wp.vec3d],
    reached_change: wp.array[wp.vec3d],
    push: wp.array[wp.vec3],
):
    """What an iteration on velocities changes, by :func:`.projection.accelerate`."""
    entry = entry_of(progress.history, cursor[CURRENT], wp.tid())
    if entry < 0:
        return
    i = progress.history.constraint[entry]
    reached = accelerated(vertices, constraints, i, restitution)
    before = constraints.reached[i]
    change = reached + progress.history.momentum[entry] * (reached - before) - constraints.impulse[i]
    multiplier_change[i] = change
    reached_change[i] = reached - before
    _push(vertices, constraints, i, change, push)


@wp.kernel
def starting(
    vertices: Vertices,
    constraints: Constraints,
    dt: wp.float64,
    impulse: wp.array[wp.vec3d],
    reached: wp.array[wp.vec3d],
    push: wp.array[wp.vec3],
):
    """The impulses to begin with, by :func:`.projection.start_impulses`."""
    i = wp.tid()
    if i < constraints.count[0] and starts(constraints, i):
        first = constraints.displacing[i] * (constraints.urgency[i] / dt)
        impulse[i] = first
        reached[i] = first
        _push(vertices, constraints, i, first, push)


@wp.kernel
def twisting(vertices: Vertices, constraints: Constraints, totals: wp.array2d[wp.float64]):
    """The torques that contacts have added in each world, by :func:`.angular_momentum.sum_torques`."""
    i = wp.tid()
    if i >= constraints.count[0] or not acts(constraints, i):
        return
    world = vertices.world[constraints.vertices[i][0]]
    if is_held(vertices, constraints, i):
        totals[world, HELD] = _ONE
    else:
        torque = torque_of(vertices, constraints, i)
        for axis in range(3):
            wp.atomic_add(totals, world, axis, torque[axis])


@wp.kernel
def massing(vertices: Vertices, totals: wp.array2d[wp.float64]):
    """The moments of what has collided in each world, by :func:`.angular_momentum.sum_bodies`."""
    vertex = wp.tid()
    if turns(vertices, vertex):
        added = moments(vertices, vertex)
        for i in range(MOMENTS):
            wp.atomic_add(totals, vertices.world[vertex], MASS + i, added[i])


@wp.kernel
def turning(vertices: Vertices, totals: wp.array2d[wp.float64], change: wp.array[wp.vec3]):
    """How the turn of each world changes velocities, by :func:`.angular_momentum.turn_vertices`."""
    vertex = wp.tid()
    world = vertices.world[vertex]
    if not turns(vertices, vertex) or totals[world, HELD] != _ZERO:
        return
    torque = wp.vec3d(totals[world, 0], totals[world, 1], totals[world, 2])
    total = Moments(
        totals[world, MASS],
        totals[world, MASS + 1],
        totals[world, MASS + 2],
        totals[world, MASS + 3],
        totals[world, MASS + 4],
        totals[world, MASS + 5],
        totals[world, MASS + 6],
        totals[world, MASS + 7],
        totals[world, MASS + 8],
        totals[world, MASS + 9],
        totals[world, MASS + 10],
    )
    change[vertex] = to_single(change_by_turn(torque, total, to_double(vertices.x1[vertex])))


@wp.func
def _touching(
    vertices: Vertices,
    corners: wp.vec4i,
    kind: int,
    localized: bool,
    toi: wp.float64,
    coordinates: wp.vec3d,
    normal: wp.vec3d,
) -> Impact:
    """A contact as a function of where its vertices are."""
    found = Impact()
    found.status = wp.where(localized, HIT, UNSURE)
    found.localized = wp.where(localized, 1, 0)
    found.toi = toi
    found.coordinates = coordinates
    found.normal = normal
    return with_gradients(
        wp.where(kind == EDGE_EDGE_CONTACT, EDGE_EDGE, VERTEX_FACE),
        to_double(vertices.x0[corners[0]]),
        to_double(vertices.x0[corners[1]]),
        to_double(vertices.x0[corners[2]]),
        to_double(vertices.x0[corners[3]]),
        to_double(vertices.x1[corners[0]]),
        to_double(vertices.x1[corners[1]]),
        to_double(vertices.x1[corners[2]]),
        to_double(vertices.x1[corners[3]]),
        found,
        _TOLERANCE,
    )


@wp.kernel
def constraining(
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    cursor: wp.array[int],
    least: wp.float64,
    weights: wp.array[wp.vec4d],
    normals: wp.array[wp.vec3d],
    separations: wp.array[wp.float64],
    urgencies: wp.array[wp.float64],
):
    """What a round's constraints were made of contacts and near pairs, by :func:`.constraints.collect_contacts`."""
    mark = cursor[MARK]
    i = wp.tid()
    if mark > 0:
        i += progress.history.constraints[mark - 1]
    if i >= progress.history.constraints[mark]:
        return
    corners = constraints.vertices[i]
    origin = constraints.origin[i]
    weight = constraints.weights[i]
    normal = constraints.normal[i]
    separation = constraints.separation[i]
    if origin < ON_PLANE:
        edges = wp.where(origin == EDGE_EDGE_CONTACT, 1, 0)
        coordinates = wp.vec3d(-weight[1], -weight[2], -weight[3])
        if edges == 1:
            coordinates = wp.vec3d(weight[1], -weight[3], _ZERO)
        localized = constraints.localized[i]
        touch = _touching(vertices, corners, origin, localized, constraints.toi[i], coordinates, normal)
        weight = contact_weights(edges, touch.coordinates)
        normal = touch.normal
        if constraints.slow[i] == 1:
            asked = widened(least, progress)
            separation = feasible_in_contact(vertices, corners, weight, normal, asked, least)
    elif origin > ON_PLANE:
        weight = closest_weights(vertices, corners, wp.where(origin == NEAR_EDGES, 1, 0))
        between = relative(weight, corners, vertices.x0)
        distance = wp.length(between)
        normal = between / distance
        separation = feasible(least, distance, least, longest_path(vertices, corners))
    weights[i] = weight
    normals[i] = normal
    separations[i] = separation
    urgencies[i] = urgency_of(vertices, corners, weight, normal, separation)


@wp.kernel
def truncating(
    vertices: Vertices,
    half_spaces: HalfSpaces,
    progress: Progress,
    cursor: wp.array[int],
    dt: wp.float64,
    end: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Where paths are cut, and how fast vertices are then."""
    history = progress.history
    mark = cursor[MARK]
    entry = history.truncations[mark] + wp.tid()
    if entry >= history.truncations[mark + 1]:
        return
    vertex = history.vertex[entry]
    kind = history.kind[entry]
    toi = _ZERO
    if kind == ON_PLANE:
        plane = history.contact[entry][1]
        before, _error = clearance(half_spaces.start[plane], vertices.x0[vertex])
        after, _error_after = clearance(half_spaces.end[plane], vertices.x1[vertex])
        toi = time_of_entry(before, after)
    elif kind != STANDS:
        corners = history.contact[entry]
        toi = _touching(
            vertices,
            corners,
            kind,
            history.localized[entry],
            history.toi[entry],
            history.coordinates[entry],
            history.normal[entry],
        ).toi
    x0 = to_double(vertices.x0[vertex])
    path = SHARE * toi * (to_double(vertices.x1[vertex]) - x0)
    end[entry] = to_single(x0 + path)
    velocity[entry] = to_single(path / dt)


@wp.kernel(enable_backward=False)
def count_grazing(vertices: Vertices, contacts: Contacts, history: History):
    """Counts the contacts whose gradients are clamped, see :mod:`warp_bsc.kernels.gradients`."""
    i = wp.tid()
    if not is_filled(i, contacts.pairs, contacts.counts, _CONTACTS) or int(contacts.status[i]) == FREE:
        return
    corners = contact_vertices(contacts, i)
    if wp.min(corners) >= vertices.movable:
        return
    kind = wp.where(contacts.edges == 1, EDGE_EDGE_CONTACT, VERTEX_FACE_CONTACT)
    at = contacts.coordinates[i]
    touch = _touching(vertices, corners, kind, contacts.localized[i], contacts.toi[i], at, contacts.normal[i])
    wp.atomic_add(history.sizes, GRAZING, touch.grazing)
