"""Points of bodies that turn at a constant rate while one of their points moves straight: their paths are arcs.

With R(t) the rotation by t times the whole turn, about an axis whose direction does not change, a point of such a body
is at

    x(t) = (1 - t) x0 + t x1 + (R(t) - t R(1) - (1 - t) I) r,    r = x0 - centre,

where the centre is any point of the axis at the start. Where x1 is that of a rigid motion, this is that motion: the
centre moves straight. It always begins at x0 and ends at x1. With k the unit vector along the axis, a the angle of the
whole turn, p = k x r and q = k x p,

    x(t) = (1 - t) x0 + t x1 + (sin ta - t sin a) p + (vers ta - t vers a) q,    vers a = 1 - cos a = 2 sin^2(a / 2).

**Chords.** In a part of the motion that lasts h, the chord from its start to its end, with the same parameter, differs
from x by what the linear interpolation of R(t) r differs from R(t) r, whose second derivative has the norm a^2 |p|. The
linear interpolation of a function over h differs from it by at most h^2 / 8 times the largest norm of its second
derivative (componentwise along the difference, Lagrange's remainder): here by (ha)^2 |p| / 8, the sagitta to leading
order and never less. As R(t) r stays on a circle of radius |p|, and its interpolation in the disc, they are at most
2 |p| apart. A point of an edge or a face is a convex combination of its corners with weights that do not change, on
arcs as on chords, and so is its deviation: it is at most the largest one of its corners.

**Parts of a step.** :func:`impact_on_arcs` goes through the step from part to part. A part is free if the chords stay
farther apart than the pair must, by more than the bounds of their deviations together. After a part that is free comes
one twice as long. In another one, the start advances to the time before which chords are free. The next part is about
as long as arcs take from there to a collision, so that the deviation, a square of that, soon vanishes; at most half as
long as the last one.
The search ends with a contact where the bounds are at most half of a tolerance: the arcs come within the tolerance of
a collision. It ends unsure after :data:`MAX_PARTS`.

**Bounds.** u is half an ulp of 1, X a bound of |x0| and |x1|. Of k, components have a relative error of 4u, of r, 1u:
p has an error of 13u |r|, q of 26u |r|. a and a / 2 have relative errors of 3u, with t 4u; a sine has 2 ulp, at most
4u: its value has an error of (4 + 4a) u, and vers of (18 + 8a) u. The two factors, of at most 2 and 4, have errors of
(12 + 8a) u and (44 + 16a) u. With the errors of p and q, and of products and sums, the last two terms have at most
(204 + 24a) u |r|; the straight part and the last sum have 2u X and u (X + 6 |r|). The constants below are more than
twice these. Of the distance from the axis, |p|, the error is below 14u |r|.
"""

from typing import Any

import warp as wp

from .ccd import impact_at_distance
from .closest import contact_at, contact_weights
from .distance import closest_points
from .motion import Query, double, query_motion
from .pairs import distance_of_corners, firsts_of, form_of
from .polynomials import EDGE_EDGE
from .signs import FREE, HALF, HIT, ONE, ROUNDOFF, TWO, UNSURE, ZERO
from .time_of_impact import Impact

POSITION_ERROR = 8.0
"""Error of :func:`on_arc` for each unit of a bound of the positions, in half ulps of 1."""
LEVER_ERROR = 512.0
"""The same for each unit of the distance from the centre at the start."""
TURN_ERROR = 64.0
"""The same for each unit of that distance and each radian of the turn."""

MAX_PARTS = wp.constant(128)
"""Parts of a step after which the search for a contact on arcs stops, unsure."""
DEFAULT_TOLERANCE = wp.constant(wp.float64(2.0**-29))
"""Tolerance of contacts on arcs, as a share of the largest coordinate, where none is given."""

_SHORTEST = wp.constant(wp.float64(2.0**-40))
"""Length of the shortest part; lengths and times are multiples of it."""
_TIME_TOLERANCE = wp.constant(wp.float64(2.0**-20))
_POSITION_ERROR = wp.constant(wp.float64(POSITION_ERROR))
_LEVER_ERROR = wp.constant(wp.float64(LEVER_ERROR))
_TURN_ERROR = wp.constant(wp.float64(TURN_ERROR))
_LEVER_LENGTH_ERROR = wp.constant(wp.float64(32.0))
_UNIT = wp.constant(wp.float64(2.0**-53))
_UP = wp.constant(wp.float64(1.0 + 2.0**-40))
"""Raises a few rounded operations above their exact result."""
_TINY = wp.constant(wp.float64(2.0**-1000))
_STEPS_OF_ROUNDING = wp.constant(wp.float64(32.0))
_AHEAD = wp.constant(wp.float64(3.0))
"""Deviations that a part is expected to close; where motion goes on evenly, two remain."""
_EIGHTH = wp.constant(wp.float64(0.125))


@wp.func
def on_arc(x0: Any, x1: Any, centre: wp.vec3d, turn: wp.vec3d, time: wp.float64) -> wp.vec3d:
    """Returns the position of a point of a turning body at a time, with the error that the module bounds.

    Args:
        x0: Position at the start, vec3 or vec3d.
        x1: Position at the end, of the same type.
        centre: A point of the axis at the start.
        turn: The axis times the angle of the whole turn [rad].
        time: The time, 0 at the start and 1 at the end; 1 - time is exact.
    """
    start = double(x0)
    straight = (ONE - time) * start + time * double(x1)
    angle = wp.length(turn)
    if angle == ZERO:
        return straight
    axis = turn / angle
    across = wp.cross(axis, start - centre)
    inward = wp.cross(axis, across)
    half = wp.sin(HALF * (time * angle))
    whole_half = wp.sin(HALF * angle)
    sine = wp.sin(time * angle) - time * wp.sin(angle)
    versine = TWO * (half * half - time * (whole_half * whole_half))
    return straight + (sine * across + versine * inward)


@wp.struct
class Arcs:
    """The arcs of a mesh's vertices in a step; without arrays all vertices move straight.

    Vertices of one ``rigid_id``, 0 or more, keep their distances: pairs of them with a turning vertex are excluded.
    """

    turning: wp.array[int]  # 1 if a vertex turns, one number; where it is 0, nothing else is read
    body: wp.array[int]  # of each vertex, -1 for those that move straight
    rigid_id: wp.array[int]
    centre: wp.array[wp.vec3d]  # a point of each body's axis at the start
    turn: wp.array[wp.vec3d]  # axis of each body times the angle of its turn [rad]
    bounds: wp.array[wp.vec3d]  # of how far each vertex is from its chord, see arc_bounds
    deviation: wp.array[wp.float64]  # the same over the whole step, one number, 0 for vertices that move straight
    tolerance: wp.float64  # within which pairs may be reported that do not collide; 0 for DEFAULT_TOLERANCE


@wp.func
def any_turns(arcs: Arcs) -> bool:
    """Returns whether a vertex of the mesh turns."""
    if arcs.turning:
        return arcs.turning[0] != 0
    return False


@wp.func
def turns(arcs: Arcs, v: wp.vec4i) -> bool:
    """Returns whether one of the vertices of a pair turns."""
    if not any_turns(arcs):
        return False
    straight = arcs.deviation[v[0]] == ZERO and arcs.deviation[v[1]] == ZERO
    return not (straight and arcs.deviation[v[2]] == ZERO and arcs.deviation[v[3]] == ZERO)


@wp.func
def move_as_one(arcs: Arcs, v: wp.vec4i) -> bool:
    """Returns whether all vertices of a pair keep their distances."""
    first = arcs.rigid_id[v[0]]
    return first >= 0 and arcs.rigid_id[v[1]] == first and arcs.rigid_id[v[2]] == first and arcs.rigid_id[v[3]] == first


@wp.func
def arc_bounds(x0: wp.vec3d, x1: wp.vec3d, centre: wp.vec3d, turn: wp.vec3d) -> wp.vec3d:
    """Returns how far a vertex is from its chord: by sagitta over the whole step, by sagitta at most, and by rounding.

    In a part of the step that lasts h it is at most the sum of the last and the lesser of h^2 times the first and of
    the second. The ends of the chord of the whole step are exact, and so are those of a vertex that stands still.
    """
    angle = wp.length(turn)
    rounding = _POSITION_ERROR * wp.sqrt(wp.float64(3.0)) * wp.max(wp.max(wp.abs(x0)), wp.max(wp.abs(x1)))
    if angle == ZERO:
        return wp.vec3d(ZERO, ZERO, _UP * (_UNIT * rounding) + _TINY)
    r = x0 - centre
    size = _UP * wp.length(r)
    lever = wp.length(wp.cross(turn / angle, r)) + _LEVER_LENGTH_ERROR * _UNIT * size
    rounding += (_LEVER_ERROR + _TURN_ERROR * angle) * size
    sagitta = _EIGHTH * (angle * angle) * lever
    return _UP * wp.vec3d(sagitta, TWO * lever, _UNIT * rounding) + wp.vec3d(ZERO, ZERO, _TINY)


@wp.func
def sagitta_of_part(bounds: wp.vec3d, length: wp.float64) -> wp.float64:
    """Returns the bound of the deviation by sagitta in a part of a step, from bounds as of :func:`arc_bounds`."""
    return _UP * wp.min(length * length * bounds[0], bounds[1])


@wp.func
def _axis_of(arcs: Arcs, vertex: int):
    """Returns centre and turn of a vertex, without a turn if it moves straight."""
    body = arcs.body[vertex]
    if body < 0:
        return wp.vec3d(), wp.vec3d()
    return arcs.centre[body], arcs.turn[body]


@wp.func
def on_arc_of(arcs: Arcs, vertex: int, x0: Any, x1: Any, time: wp.float64) -> wp.vec3d:
    """Returns the position of a vertex at a time, see :func:`on_arc`."""
    centre, turn = _axis_of(arcs, vertex)
    return on_arc(x0, x1, centre, turn, time)


@wp.func
def distance_at(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns the distance of the features of a pair of any kind at rest, and the bound on its error."""
    u = wp.where(kind == EDGE_EDGE, b - a, c - b)
    v = wp.where(kind == EDGE_EDGE, d - c, d - b)
    w = wp.where(kind == EDGE_EDGE, c - a, a - b)
    _at, found, error = closest_points(form_of(kind), u, v, w)
    return found, error


@wp.struct
class _PairBounds:
    """Bounds of how far the elements of a pair are from their chords, see :func:`arc_bounds`."""

    first: wp.vec3d
    second: wp.vec3d
    rounding: wp.float64  # of both
    tolerance: wp.float64


@wp.func
def _bounds_of_pair(kind: int, v: wp.vec4i, largest: wp.float64, arcs: Arcs) -> _PairBounds:
    """Returns the bounds of a pair: of each element, the largest ones of its vertices.

    Args:
        kind: As of :func:`impact_on_arcs`.
        v: The vertices of the pair.
        largest: Its largest coordinate.
        arcs: The arcs.
    """
    bounds = _PairBounds()
    for j in range(4):
        if j < firsts_of(kind):
            bounds.first = wp.max(bounds.first, arcs.bounds[v[j]])
        else:
            bounds.second = wp.max(bounds.second, arcs.bounds[v[j]])
    bounds.rounding = bounds.first[2] + bounds.second[2]
    tolerance = wp.where(arcs.tolerance > ZERO, arcs.tolerance, DEFAULT_TOLERANCE * largest)
    bounds.tolerance = wp.max(tolerance, _STEPS_OF_ROUNDING * bounds.rounding)
    return bounds


@wp.func
def _sagittas(bounds: _PairBounds, length: wp.float64) -> wp.float64:
    """Returns the bound of the deviation of both elements in a part of a step, without rounding."""
    return sagitta_of_part(bounds.first, length) + sagitta_of_part(bounds.second, length)


@wp.func
def _closing_way(kind: int, part: Impact, chords: Query) -> wp.float64:
    """Returns by how much contact points approach each other along the normal on the chords of a part."""
    weights = contact_weights(kind, part.coordinates)
    p = chords[4] - chords[0]
    q = chords[5] - chords[1]
    r = chords[6] - chords[2]
    s = chords[7] - chords[3]
    return -wp.dot(part.normal, weights[0] * p + weights[1] * q + weights[2] * r + weights[3] * s)


@wp.func
def _first_contact(kind: int, part: Impact, chords: Query, rounding: wp.float64) -> Impact:
    """Returns the contact of a part with coordinates and normal as of contacts on straight paths."""
    result = part
    coordinates, normal = contact_at(query_motion(kind, chords, ZERO), part.toi)
    result.coordinates = coordinates
    # where paths graze, velocities do not tell the side, but all until the part began is free
    weights = contact_weights(kind, coordinates)
    between = weights[0] * chords[0] + weights[1] * chords[1] + weights[2] * chords[2] + weights[3] * chords[3]
    result.normal = wp.where(wp.dot(normal, between) < -rounding, -normal, normal)
    return result


@wp.func
def impact_on_arcs(kind: int, v: wp.vec4i, query: Query, arcs: Arcs, min_distance: wp.float64) -> Impact:
    """Returns the first contact of a pair on its arcs; FREE is certain, and HIT within the tolerance of the arcs.

    Args:
        kind: VERTEX_FACE, EDGE_EDGE, VERTEX_EDGE or VERTEX_VERTEX.
        v: The vertices of the pair.
        query: Their positions.
        arcs: The arcs.
        min_distance: Distance that the pair keeps, 0 if it must only not touch.
    """
    result = Impact()
    result.status = UNSURE
    if not wp.isfinite(query):
        return result
    chords = Query()  # of a part
    for j in range(4):
        chords[j] = query[j]
    bounds = _PairBounds()
    start = wp.float64(0.0)
    length = wp.float64(1.0)
    searching = bool(True)
    parts = int(0)
    while searching:
        end = start + length
        for j in range(4):
            chords[4 + j] = query[4 + j]
            if end < ONE:
                chords[4 + j] = on_arc_of(arcs, v[j], query[j], query[4 + j], end)
        deviation = distance_of_corners(kind, v, arcs.deviation)
        if length < ONE:
            deviation = _sagittas(bounds, length) + bounds.rounding
        within = _UP * (min_distance + deviation)
        p, q, r, s = chords[0], chords[1], chords[2], chords[3]
        end_p, end_q, end_r, end_s = chords[4], chords[5], chords[6], chords[7]
        part = impact_at_distance(kind, p, q, r, s, end_p, end_q, end_r, end_s, within, ROUNDOFF, True, _TIME_TOLERANCE)
        parts += 1
        if part.status == FREE:
            start = end
            for j in range(4):
                chords[j] = chords[4 + j]
            length = wp.min(TWO * length, ONE - start)
            if start >= ONE:
                result.status = FREE
                result.toi = TWO
                searching = False
        else:
            if parts == 1:  # most pairs need no more than the first part
                largest = ZERO
                for j in range(8):
                    largest = wp.max(largest, wp.max(wp.abs(query[j])))
                bounds = _bounds_of_pair(kind, v, largest, arcs)
            advance = _SHORTEST * wp.floor(part.toi * length / _SHORTEST)
            found = ZERO
            if advance == ZERO:
                found, _error = distance_at(kind, p, q, r, s)
            is_within = advance == ZERO and found <= min_distance + HALF * bounds.tolerance
            is_within = is_within or TWO * deviation <= bounds.tolerance
            if is_within or parts == MAX_PARTS or length <= _SHORTEST:
                result = part
                if min_distance == ZERO and kind <= EDGE_EDGE:
                    result = _first_contact(kind, part, chords, bounds.rounding)
                result.status = wp.where(is_within, HIT, UNSURE)
                result.within_tolerance = wp.where(is_within, 1, 0)
                result.toi = start + advance
                searching = False
            else:
                speed = _closing_way(kind, part, chords) / length
                length = HALF * length
                if advance > ZERO:
                    # arcs are at most two deviations apart then, and about to meet: a part as long as that takes
                    expected = _SHORTEST * wp.floor(_AHEAD * deviation / speed / _SHORTEST)
                    if expected > ZERO:
                        length = wp.min(length, expected)
                    start += advance
                    length = wp.min(length, ONE - start)
                    for j in range(4):
                        chords[j] = on_arc_of(arcs, v[j], query[j], query[4 + j], start)
                else:
                    # the first part that may be free at all
                    needed = HALF * (found - min_distance) - bounds.rounding
                    while length > _SHORTEST and needed < _sagittas(bounds, length):
                        length = HALF * length
    return result
