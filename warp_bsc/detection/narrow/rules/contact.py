"""The narrow phase of contacts: culls -> certified classification -> times of impact -> exact phase.

Every phase writes a compact queue for the next, so that no thread waits for a neighbour's harder pair.
"""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from ....kernels.arcs import Arcs, turns
from ....kernels.classification import classify
from ....kernels.culling import centroid_direction, direction_separates, edge_edge_boxes_apart, vertex_face_boxes_apart
from ....kernels.motion import edge_edge_motion, relative_motion, vertex_face_motion
from ....kernels.pairs import ends_of, points_of_pair
from ....kernels.pipeline.batch_classification import BATCH as CLASSIFIED
from ....kernels.pipeline.batch_culling import BATCH as CULLED
from ....kernels.pipeline.batch_impacts import BATCH as DECIDED
from ....kernels.pipeline.queues import is_filled, take_slot
from ....kernels.polynomials import VERTEX_FACE, Motion, coplanarity
from ....kernels.signs import FREE, HIT, ROUNDOFF, UNSURE, certified_sign_cubic
from ....kernels.time_of_impact import Impact, impact
from ...run.launch import launch_together, made_once
from ...run.phase_timer import PhaseTimer
from ...run.settings import NO_FUSED_OPERATIONS, TOLERANCE, Count, Method
from ..batch_kernels import batch_classification_kernel, batch_culling_kernel, batch_impact_kernel
from ..narrow_phase import Phases, buffers_of, launch_culls, launch_decisions, launch_over_kinds
from ..pair_kernels import (
    PairBuffers,
    PairRule,
    add_open_contact,
    count_found,
    write_decision,
    write_impact,
)


@wp.struct
class Options:
    """Options of the rule."""

    roundoff: wp.float64  # roundoff of floating point, 0 if its computed signs decide
    arcs: Arcs  # pairs with a turning vertex are left out, for :mod:`.arc`


@wp.func
def _excludes(options: Options, kind: int, v: wp.vec4i) -> bool:
    return turns(options.arcs, v)


@wp.func
def _never_coplanar(motion: Motion) -> bool:
    """Returns whether a motion is certainly free, as its points are never coplanar, or a direction separates them."""
    y = coplanarity(motion)
    if certified_sign_cubic(y.k, y.bound) != 0:
        return True
    return direction_separates(motion, centroid_direction(motion))


@wp.func
def _clears(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]) -> bool:
    a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
    if kind == VERTEX_FACE:
        apart = _never_coplanar(vertex_face_motion(a0, b0, c0, d0, a1, b1, c1, d1, options.roundoff))
        # last, because in single precision queued pairs always pass; but exact at any scale
        return apart or vertex_face_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1)
    apart = _never_coplanar(edge_edge_motion(a0, b0, c0, d0, a1, b1, c1, d1, options.roundoff))
    return apart or edge_edge_boxes_apart(a0, b0, c0, d0, a1, b1, c1, d1)


@wp.func
def _decide(options: Options, kind: int, v: wp.vec4i, x0: wp.array[Any], x1: wp.array[Any]):
    a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
    result = Impact()
    motion = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, options.roundoff)
    result.status = classify(motion, coplanarity(motion))
    return result, result.status != FREE


# fewer registers than the 252 that the compiler takes, so that twice as many warps hide its latency; one kernel to cull
# both kinds takes an eighth more, which costs more than a launch
_RULE = PairRule(Options, _excludes, _clears, _decide, add=add_open_contact, culls_by_kind=True, max_registers=128)


_MANY = 2**16
"""Contacts, if there is room for more, whose times a GPU finds in two passes: most need a short search."""


@wp.func
def _contact_at(i: int, queued: bool, kind: int, buffers: PairBuffers):
    """Returns the row, the status and the vertices of a contact, or of one that is left to the search; -1 for none."""
    row = i
    count = wp.where(queued, int(Count.SUBDIVIDED), int(Count.CONTACTS))
    if not is_filled(i, buffers.contacts.pairs, buffers.counts, count):
        return -1, 0, wp.vec4i()
    if queued:
        row = buffers.for_search[i]
    vertices = points_of_pair(kind, buffers.elements, buffers.contacts.pairs[row])
    return row, int(buffers.contacts.status[row]), vertices


@wp.func
def _finish(i: int, result: Impact, is_sought: bool, timed: bool, simple: bool, buffers: PairBuffers):
    """Writes and counts what is decided of a contact, and enqueues it for the exact phase if that is needed."""
    if is_sought:
        if simple and result.within_tolerance == 0:
            buffers.for_search[wp.int32(take_slot(buffers.counts, Count.SUBDIVIDED))] = i
            return
        write_impact(i, result, buffers)
    write_decision(i, result.status, buffers)
    if result.status == FREE:
        return
    count_found(result.status, buffers)
    if result.status == UNSURE or (timed and not buffers.contacts.within_tolerance[i]):
        buffers.for_exact[wp.int32(take_slot(buffers.counts, Count.FOR_EXACT))] = i


@made_once
def _impact_kernel(dtype: type, simple: bool) -> wp.Kernel:
    """Returns the kernel that finds the times of impact of contacts on a GPU, for one type of position.

    That for ``simple`` ones is for all contacts. The other one is too, or for those that it has ``queued``.
    """
    limits = {"cuda_max_registers": 128} if simple else {}

    @wp.kernel(**NO_FUSED_OPERATIONS, **limits)
    def find_impacts(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        # in
        roundoff: wp.float64,
        timed: bool,
        tolerance: wp.float64,
        queued: bool,
        kinds: wp.vec2i,
        # in and out
        one: PairBuffers,
        other: PairBuffers,
    ):
        i = first + wp.tid()
        is_one = i < one.contacts.pairs.shape[0]
        kind = kinds[0]
        row = int(-1)
        status = int(0)
        v = wp.vec4i()
        if is_one:
            row, status, v = _contact_at(i, queued, kind, one)
        else:
            kind = kinds[1]
            row, status, v = _contact_at(i - one.contacts.pairs.shape[0], queued, kind, other)
        if row < 0:
            return
        result = Impact()
        result.status = status
        is_sought = timed or status != HIT
        if is_sought:
            a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
            motion = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, roundoff)
            result = impact(motion, coplanarity(motion), status, tolerance, wp.static(simple))
        if is_one:
            _finish(row, result, is_sought, timed, wp.static(simple), one)
        else:
            _finish(row, result, is_sought, timed, wp.static(simple), other)

    return find_impacts


def decides_in_batches(device: wp.Device) -> bool:
    """Returns whether pairs are decided many at a time, by SIMD instructions; a test runs those of a GPU on a CPU."""
    return device.is_cpu


def run_contacts(
    phases: Phases,
    x0: wp.array,
    x1: wp.array,
    *,
    method: Method,
    timed: bool = True,
    tolerance: float = TOLERANCE,
    arcs: "Arcs | None" = None,
    boxes_meet: bool = False,
    timer: PhaseTimer,
) -> None:
    """Launches all phases but the sorting over the queued pairs of both kinds, or of one.

    A GPU decides both kinds in the same launches, without synchronizing.

    Args:
        phases: Narrow phases of different kinds, each with the vertex indices of its elements.
        x0: Positions at the start of the step, array of vec3 or vec3d.
        x1: Positions at its end, of the same type.
        method: One of :data:`METHODS`; with "exact", pairs too wide for the device are delegated to
            :func:`.decide_on_host`.
        timed: Whether to find times of impact, coordinates and normals.
        tolerance: Of the times of impact, as a share of the step.
        arcs: Pairs with a turning vertex are left out, for :mod:`.arc`; None if nothing turns.
        boxes_meet: Whether no axis separates the unpadded boxes of any pair at both ends, in single precision.
        timer: Measures the phases.
    """
    options = Options()
    options.roundoff = 0.0 if method == "float" else ROUNDOFF
    if arcs is not None:
        options.arcs = arcs
    buffers, in_batches = buffers_of(phases), decides_in_batches(x0.device)
    motion = [x0, x1, options.roundoff]

    def launch_batches(kernel_of: Callable, others: list, buffer: str, count: Count, batch: int) -> None:
        """Launches the kernels of all kinds over the filled entries of a buffer, many at a time, on a CPU."""
        kernels = []
        for kind, s in buffers.items():
            filled = min(getattr(s, buffer).shape[0], int(s.counts.numpy()[count]))
            kernels.append((kernel_of(kind, x0.dtype), -(-filled // batch), [*motion, *others], [s]))
        launch_together(kernels, device=x0.device, chunk=16)

    with timer.phase("cull"):
        if in_batches:
            cull = functools.partial(batch_culling_kernel, on_arcs=arcs is not None)
            others = [boxes_meet and x0.dtype is wp.vec3, Arcs() if arcs is None else arcs]
            launch_batches(cull, others, "queue", Count.QUEUED, CULLED)
        else:
            launch_culls(_RULE, buffers, x0, x1, options)
    with timer.phase("classify"):
        if in_batches:
            launch_batches(batch_classification_kernel, [], "survivors", Count.SURVIVORS, CLASSIFIED)
        else:
            launch_decisions(_RULE, buffers, x0, x1, options)
    with timer.phase("time of impact"):
        if in_batches:
            launch_batches(batch_impact_kernel, [timed, tolerance], "for_exact", Count.CONTACTS, DECIDED)
        else:
            are_many = max(len(phase.contacts.pairs) for phase, _elements in phases) > _MANY
            for simple in [True, False] if are_many else [False]:
                kernel = _impact_kernel(x0.dtype, simple)
                inputs = [*motion, timed, tolerance, are_many and not simple]
                launch_over_kinds(kernel, buffers, "for_exact", Count.CONTACTS, inputs=inputs, block_dim=32)
    if method == "exact":
        with timer.phase("exact"):
            for phase, elements in phases:
                phase.decide_exactly(x0, x1, elements, timed=timed, tolerance=tolerance)
