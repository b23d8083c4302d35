"""The narrow phase of a response with minimum distances: pairs that come too near, and proximities.

A pair may come as near as its minimum distance, the sum of two radii, see :mod:`.distance`, or as it was at the
start, if it was nearer, less the rounding of distances. On arcs of bodies that turn, it comes nearer by a 64th, but not
at the end of the step. Pairs that an edge of the mesh joins must only not touch:
neighbours are always near. Proximities are the other pairs that come within the reach beyond these distances.
"""

from typing import Any

import numpy as np
import warp as wp

from ....kernels.arcs import Arcs, distance_at, impact_on_arcs, move_as_one
from ....kernels.ccd import impact_at_distance
from ....kernels.min_distance import clears_at_once, closest_at
from ....kernels.motion import doubles, motion_and_distance, query_at
from ....kernels.pairs import ABOVE_SUM, distance_of_corners, ends_of, firsts_of
from ....kernels.signs import FREE, ROUNDOFF, TWO, ZERO
from ....kernels.time_of_impact import Impact
from ...mesh import CollisionMesh
from ...run.launch import made_once
from ...run.phase_timer import PhaseTimer
from ...run.settings import TOLERANCE
from ..narrow_phase import Phases, buffers_of, launch_culls, launch_decisions
from ..pair_kernels import PairRule
from ..rings import Rings, are_within_rings, make_rings

KEPT = wp.constant(wp.float64(1.0 - 2.0**-20))
"""Share of its distance at the start that a pair must keep which starts within its minimum distance.

The search certifies it for a pair at rest, also where that is pressed from both sides, and moves by rounding.
"""
SHARE_ON_ARCS = wp.constant(wp.float64(1.0 - 2.0**-6))
"""Share of its minimum distance that a pair keeps on arcs, between the start and the end of the step."""

_RINGS = 1


@wp.struct
class MinDistances:
    """The minimum distances of a mesh; without arrays there are none."""

    radius: wp.array[wp.float64]  # of each vertex, half of the minimum distance included [m]
    of_planes: wp.array[wp.float64]  # of each infinite plane, half of the minimum distance included [m]
    reach: wp.float64  # largest distance of proximities beyond their minimum distance [m]
    rings: Rings  # vertices whose elements have no minimum distance
    rigid_id: wp.array[int]  # rigid body of each vertex, by any number; pairs within one are skipped; -1 for none


def make_min_distances(
    mesh: CollisionMesh, radius: np.ndarray, *, of_planes: np.ndarray, reach: float, rigid_id: np.ndarray
) -> MinDistances:
    """Returns the minimum distances of a mesh on its device, see :class:`MinDistances`.

    Args:
        mesh: The mesh.
        radius: Radius of each vertex, float64, shape [vertex_count].
        of_planes: Radius of each infinite plane, float64, shape [plane_count].
        reach: Largest distance of proximities beyond their minimum distance.
        rigid_id: As of :class:`MinDistances`, int, shape [vertex_count].
    """
    distances = MinDistances()
    distances.radius = wp.array(radius, dtype=wp.float64, device=mesh.device)
    distances.of_planes = wp.array(of_planes, dtype=wp.float64, device=mesh.device)
    distances.reach = reach
    distances.rings = make_rings(mesh, _RINGS)
    distances.rigid_id = wp.array(rigid_id, dtype=int, device=mesh.device)
    return distances


@wp.func
def distances_of_pair(
    distances: MinDistances, kind: int, corners: wp.vec4i, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d
):
    """Returns the distance of a pair at the start, from its points there, and its minimum distance in the step [m].

    The first is a lower bound; it is 0 if the elements may touch. The second is less, unless the first is 0.
    """
    found, error = distance_at(kind, a, b, c, d)
    start = wp.max(found - TWO * error, ZERO)
    if are_within_rings(corners, firsts_of(kind), distances.rings):
        return start, ZERO
    return start, wp.min(distance_of_corners(kind, corners, distances.radius), KEPT * start)


@wp.func
def impact_on_arcs_at_distance(
    kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any], arcs: Arcs, kept: wp.float64
) -> Impact:
    """Returns the first time at which a pair comes nearer on its arcs than it may, as of :func:`.impact_on_arcs`.

    It keeps its minimum distance ``kept`` at the end of the step, and :data:`SHARE_ON_ARCS` of it on the way. A pair
    that rests at its distance would otherwise have to be followed in ever shorter parts.
    """
    query = query_at(x0, x1, v)
    found, error = distance_at(kind, query[4], query[5], query[6], query[7])
    least = wp.where(found - error >= kept, SHARE_ON_ARCS * kept, kept)
    return impact_on_arcs(kind, v, query, arcs, least)


@wp.struct
class Options:
    """Options of the rules."""

    distances: MinDistances
    arcs: Arcs  # of bodies that turn
    proximities: bool  # whether to report proximities
    tolerance: wp.float64  # of the times of impact, as a share of the step


@made_once
def _rule(turning: bool) -> PairRule:
    """Returns the rule of the pairs with a turning vertex, or of the others.

    Kernels for both take more registers, which costs more than launches over queues in which nothing turns.
    """

    @wp.func
    def excludes(options: Options, kind: int, v: wp.vec4i) -> bool:
        body = options.distances.rigid_id[v[0]]
        if body >= 0 and options.distances.rigid_id[v[3]] == body:
            return True
        if wp.static(turning):
            return move_as_one(options.arcs, v)
        return False

    @wp.func
    def clears(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]) -> bool:
        a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
        distances = options.distances
        distance = distance_of_corners(kind, v, distances.radius) + distances.reach
        reach = distances.reach
        if wp.static(turning):
            deviation = distance_of_corners(kind, v, options.arcs.deviation)
            distance = ABOVE_SUM * (distance + deviation)
            reach = ABOVE_SUM * (reach + deviation)
        motion, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, distance, ROUNDOFF)
        if clears_at_once(motion, scaled):
            return True
        if are_within_rings(v, firsts_of(kind), distances.rings):
            _same, scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, reach, ROUNDOFF)
            return clears_at_once(motion, scaled)
        return False

    @wp.func
    def decide(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]):
        a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
        distances = options.distances
        tolerance = options.tolerance
        a, b, c, d = doubles(a0, b0, c0, d0)
        start, kept = distances_of_pair(distances, kind, v, a, b, c, d)
        result = Impact()
        if wp.static(turning):
            result = impact_on_arcs_at_distance(kind, v, x0, x1, options.arcs, kept)
        else:
            result = impact_at_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, kept, ROUNDOFF, True, tolerance)
        is_contact = result.status != FREE
        if options.proximities:
            reach = distances.reach
            if not are_within_rings(v, firsts_of(kind), distances.rings):
                reach += distance_of_corners(kind, v, distances.radius)
            if start < reach:
                is_contact = True
                motion, _scaled = motion_and_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, reach, ROUNDOFF)
                coordinates, normal = closest_at(kind, motion, ZERO)
                result.coordinates = coordinates
                result.normal = normal
            elif not wp.static(turning) or result.status == FREE:
                near = impact_at_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, reach, ROUNDOFF, True, tolerance)
                is_contact = near.status != FREE
                result.coordinates = near.coordinates
                result.normal = near.normal
        return result, is_contact

    return PairRule(Options, excludes, clears, decide, turning=turning)


def run_approaches(
    phases: Phases,
    x0: wp.array,
    x1: wp.array,
    distances: MinDistances,
    *,
    proximities: bool,
    tolerance: float = TOLERANCE,
    arcs: "Arcs | None" = None,
    timer: PhaseTimer,
) -> None:
    """Launches all phases over the queued pairs, without synchronizing with a GPU; contacts are not sorted.

    The status of a proximity is FREE. Times of impact are those at which a pair comes nearer than it may, 2 if it does
    not. With ``proximities``, coordinates and normals are those at which the pair comes within reach, at the start if
    it is within reach then: they depend continuously on the motion, and the direction to move the pair apart vanishes
    with the distance that it is to be moved.

    Arguments are those of :func:`.run_contacts` and the :class:`Options`.
    """
    # pairs with a turning vertex last; on the CPU only where there are some
    some_turn = arcs is not None and not (x0.device.is_cpu and not arcs.turning.numpy()[0])
    rules = [_rule(turning) for turning in ((False, True) if some_turn else (False,))]
    options = Options()
    options.distances, options.proximities, options.tolerance = distances, proximities, tolerance
    if arcs is not None:
        options.arcs = arcs
    buffers = buffers_of(phases)
    with timer.phase("cull"):
        for rule in rules:
            launch_culls(rule, buffers, x0, x1, options)
    with timer.phase("classify"):
        for rule in rules:
            launch_decisions(rule, buffers, x0, x1, options)
