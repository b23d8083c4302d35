"""The exact stage: wide integers decide, on the device, what floating point leaves open.

Contacts that the stage before has put in a queue are decided in integers of one limb a coordinate, see
:mod:`warp_bsc.kernels.exact.decision`. Those whose exponents are too far apart for that go to the next queue, for two
limbs, and so on to eight, which take every query in single precision. What is too wide for that too is counted, and
left to the host. Each width has a kernel of its own, so that the usual one stays small.
"""

import functools
import math

import warp as wp

from ..kernels.closest import contact_at
from ..kernels.exact.first_contact import NONE, TOO_WIDE, decide_in
from ..kernels.exact.polygon import BITS
from ..kernels.motion import double, relative_motion
from ..kernels.pipeline.pairs import vertices_of_pair
from ..kernels.pipeline.queues import take_slot
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ..kernels.signs import FREE, HIT
from ..kernels.time_of_impact import LEAST_DIGITS
from .launch import launch_over_queue

__all__ = ["launch_exact_stage"]

_KERNEL = {"enable_backward": False, "module": "unique", "module_options": {"fuse_fp": False}}
"""Without fused operations every device computes the same bits."""


@functools.cache
def _kernel(dtype, limbs):
    """The kernel for one type of position and one width, in a module of its own."""
    decide = decide_in(limbs)

    @wp.kernel(**_KERNEL)
    def decide_contacts(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        kind: int,
        timed: bool,
        digits: int,
        queue: wp.array[int],
        counts: wp.array[wp.int64],
        filled: int,
        too_wide: int,
        refuted: int,
        contacts: wp.array[wp.vec2i],
        answer: wp.array[wp.int8],
        localized: wp.array[wp.bool],
        toi: wp.array[wp.float64],
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
        keys: wp.array[wp.int64],
        last_key: wp.int64,
        left: wp.array[int],
    ):
        slot = first + wp.tid()
        if wp.int64(slot) >= counts[filled]:
            return
        i = queue[slot]
        v = vertices_of_pair(kind, elements, contacts[i])
        time = decide(
            kind,
            double(x0[v[0]]),
            double(x0[v[1]]),
            double(x0[v[2]]),
            double(x0[v[3]]),
            double(x1[v[0]]),
            double(x1[v[1]]),
            double(x1[v[2]]),
            double(x1[v[3]]),
            timed,
            digits,
        )
        if time == TOO_WIDE:
            left[wp.int32(take_slot(counts, too_wide))] = i
        elif time == NONE:
            answer[i] = wp.int8(FREE)
            keys[i] = last_key
            take_slot(counts, refuted)
        else:
            answer[i] = wp.int8(HIT)
            if timed:
                # where floating point has given up is a lower bound too
                time = wp.max(time, toi[i])
                motion = relative_motion(
                    kind,
                    x0[v[0]],
                    x0[v[1]],
                    x0[v[2]],
                    x0[v[3]],
                    x1[v[0]],
                    x1[v[1]],
                    x1[v[2]],
                    x1[v[3]],
                    wp.float64(0.0),
                )
                at, direction = contact_at(motion, time)
                localized[i] = True
                toi[i] = time
                coordinates[i] = at
                normal[i] = direction

    return decide_contacts


def launch_exact_stage(
    kind, x0, x1, elements, *, timed, tolerance, queues, counts, asked, too_wide, refuted, contacts, keys, last_key
):
    """Decides contacts exactly, without asking the device anything.

    Args:
        kind: "vertex_face" or "edge_edge".
        x0: Positions at the start of the step, Warp array of vec3 or vec3d.
        x1: Positions at its end, of the same type.
        elements: Vertex indices of the faces or edges, two-dimensional Warp array of int.
        timed: Whether to find times of impact, coordinates and normals of what is decided to collide.
        tolerance: Of the times of impact, as a share of the step.
        queues: Contacts to decide, by their number, and room for those that are too wide; both are written to.
        counts: Counts of the narrow phase, Warp array of int64.
        asked: Place of the number of contacts to decide in it.
        too_wide: Places of the numbers of those too wide for each width.
        refuted: Place of the number of those decided to be free.
        contacts: Arrays of the contacts: pairs, answer, localized, toi, coordinates, normal.
        keys: By which contacts are sorted, Warp array of int64.
        last_key: Key of a contact that is none.
    """
    number = VERTEX_FACE if kind == "vertex_face" else EDGE_EDGE
    digits = max(LEAST_DIGITS, math.ceil(-math.log2(tolerance)))
    queue, left = queues
    for limbs, too_wide_for_it in zip(BITS, too_wide, strict=True):
        inputs = [x0, x1, elements, int(number), timed, digits, queue, counts, asked, too_wide_for_it, refuted]
        outputs = [*contacts, keys, last_key, left]
        kernel = _kernel(x0.dtype, limbs)
        launch_over_queue(kernel, queue, counts, asked, inputs=inputs, outputs=outputs, block_dim=64)
        queue, left, asked = left, queue, too_wide_for_it
