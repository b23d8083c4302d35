"""Kernels that answer queries by every method, and compare the answers, on the device.

A query is eight points and a minimum distance. A vertex and an edge are p a b a, two vertices p q q q, as for
``impact_at_distance``. An answer is FREE, HIT or UNSURE.
"""

import functools

import warp as wp
from compilation import QUICK

from warp_bsc.kernels import ccd_edge_edge, ccd_vertex_face
from warp_bsc.kernels.ccd import impact_at_distance, solve
from warp_bsc.kernels.exact.distance import decide_distance_in
from warp_bsc.kernels.motion import query_of, relative_motion
from warp_bsc.kernels.pairs import form_of
from warp_bsc.kernels.polynomials import VERTEX_FACE
from warp_bsc.kernels.signs import FREE, HIT, UNSURE

UNFUSED = {"enable_backward": False, "module": "unique", "module_options": QUICK | {"fuse_fp": False}}
"""Options of the kernels of the package, in which no multiplication is fused with an addition."""
FUSED = {"enable_backward": False, "module": "unique", "module_options": QUICK}
"""Options of a user's kernel."""

_TOLERANCE = wp.constant(wp.float64(2.0**-20))
_DIGITS = wp.constant(21)
_0 = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))

wp.set_module_options({"enable_backward": False} | QUICK)


@functools.cache
def answer_kernel():
    """The kernel of the methods "float" (with roundoff 0) and "conservative"."""

    @wp.kernel(**UNFUSED)
    def answer_queries(kind: int, roundoff: wp.float64, points: wp.array2d[wp.vec3d], answer: wp.array[int]):
        i = wp.tid()
        x = points[i]
        motion = relative_motion(kind, x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], roundoff)
        answer[i] = solve(motion, False, _TOLERANCE).status

    return answer_queries


@functools.cache
def user_kernel():
    """A kernel that calls the public functions."""

    @wp.kernel(**FUSED)
    def answer_as_user(kind: int, points: wp.array2d[wp.vec3d], answer: wp.array[int]):
        i = wp.tid()
        x = points[i]
        if kind == VERTEX_FACE:
            answer[i] = ccd_vertex_face(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7])
        else:
            answer[i] = ccd_edge_edge(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7])

    return answer_as_user


@functools.cache
def distance_kernel(fused):
    """The kernel of all methods but "exact" with minimum distances, and the times from which the exact one looks on."""

    @wp.kernel(**(FUSED if fused else UNFUSED))
    def answer_distances(
        kind: int,
        roundoff: wp.float64,
        points: wp.array2d[wp.vec3d],
        distance: wp.array[wp.float64],
        answer: wp.array[int],
        toi: wp.array[wp.float64],
    ):
        i = wp.tid()
        x = points[i]
        found = impact_at_distance(
            kind, x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], distance[i], roundoff, False, _TOLERANCE
        )
        answer[i] = found.status
        toi[i] = wp.where(found.toi > _1, _HALF, found.toi)

    return answer_distances


@functools.cache
def exact_distance_kernel(limbs):
    """The kernel that decides queries with minimum distances as far as integers of that width can."""
    decide = decide_distance_in(limbs)

    @wp.kernel(**UNFUSED)
    def decide_distances(
        kind: int,
        points: wp.array2d[wp.vec3d],
        distance: wp.array[wp.float64],
        toi: wp.array[wp.float64],
        time: wp.array[wp.float64],
    ):
        i = wp.tid()
        if time[i] >= _0:
            return
        x = points[i]
        form = form_of(kind)
        query = query_of(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7])
        status = decide(form, query, distance[i], toi[i], _DIGITS, False)
        if status == FREE:
            time[i] = _2
        elif status == HIT:
            time[i] = _0

    return decide_distances


@wp.func
def _differ(first: int, second: int) -> bool:
    """Returns whether two answers are certain and contradict each other."""
    return first + second == FREE + HIT and first != second


@wp.kernel
def count_answers(
    # answers
    computed: wp.array[int],
    certified: wp.array[int],
    of_user: wp.array[int],
    time: wp.array[wp.float64],
    truth: wp.array[int],
    # out
    counts: wp.array3d[wp.int64],
    wrong: wp.array[int],
    wrong_count: wp.array[int],
):
    """Counts queries by their answers, and lists those of which certain answers contradict each other.

    Args:
        computed: Answers of "float", which are not certain.
        certified: Certified answers of "conservative".
        of_user: Those of a user's kernel.
        time: Times of exact arithmetic: negative if it does not decide, 2 of free queries. At the end, its answers.
        truth: The truth where it is known, otherwise UNSURE.
        counts: Numbers of queries, in several copies whose sum counts; by 9 truth + 3 exact + certified, and by
            3 user + computed.
        wrong: Queries with a contradiction, as many as fit.
        wrong_count: How many there are.
    """
    i = wp.tid()
    exact = wp.where(time[i] < _0, UNSURE, wp.where(time[i] < _2, HIT, FREE))
    row = 9 * truth[i] + 3 * exact + certified[i]
    wp.atomic_add(counts, i % counts.shape[0], row, 3 * of_user[i] + computed[i], wp.int64(1))
    if (
        _differ(truth[i], exact)
        or _differ(truth[i], certified[i])
        or _differ(truth[i], of_user[i])
        or _differ(exact, certified[i])
        or _differ(exact, of_user[i])
        or _differ(certified[i], of_user[i])
    ):
        slot = wp.atomic_add(wrong_count, 0, 1)
        if slot < wrong.shape[0]:
            wrong[slot] = i
