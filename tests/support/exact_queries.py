"""Asks exact arithmetic of a given width about queries, whatever floating point can say of them."""

import functools

import numpy as np
import warp as wp
from compilation import QUICK

from warp_bsc.kernels.exact.first_contact import decide_in
from warp_bsc.kernels.exact.polygon import spread
from warp_bsc.kernels.motion import query_of

_0 = wp.constant(wp.float64(0.0))


@functools.cache
def exact_kernel(limbs):
    """The kernel that decides, in so many limbs, those queries whose time is negative: too wide for fewer."""
    decide = decide_in(limbs)

    @wp.kernel(enable_backward=False, module="unique", module_options=QUICK)
    def decide_queries(
        kind: int,
        points: wp.array2d[wp.vec3d],
        timed: bool,
        digits: int,
        time: wp.array[wp.float64],
        bits: wp.array[int],
    ):
        i = wp.tid()
        if time[i] >= _0:
            return
        x = points[i]
        query = query_of(x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7])
        _, width = spread(kind, query)
        bits[i] = width
        time[i] = decide(kind, query, timed, digits)

    return decide_queries


def decide_exactly(kind, points, limbs, *, timed=False, digits=20, device=None):
    """Decides queries in integers of so many limbs a coordinate, one thread each.

    Args:
        kind: "vertex_face" or "edge_edge".
        points: Queries, NumPy array of shape [n, 8, 3].
        limbs: Width, a key of ``BITS``.
        timed: Whether to find times.
        digits: Binary digits of the times.
        device: Warp device; default: Warp's default.

    Returns:
        Times (2 of free queries, negative ones of those too wide), float64 of shape [n], and the bits that each
        query's coordinates take, int of shape [n].
    """
    n = len(points)
    time = wp.full(n, -1.0, dtype=wp.float64, device=device)
    bits = wp.zeros(n, dtype=int, device=device)
    points = wp.array(np.asarray(points, dtype=np.float64), dtype=wp.vec3d, device=device)
    inputs = [int(kind == "edge_edge"), points, timed, digits]
    wp.launch(exact_kernel(limbs), n, inputs=inputs, outputs=[time, bits], device=device)
    return time.numpy(), bits.numpy()
