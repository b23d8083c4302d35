"""Asks exact arithmetic of a given width about queries, whatever floating point can say of them."""

import functools

import numpy as np
import warp as wp
from compilation import QUICK

from warp_bsc.kernels.exact.first_contact import decide_in
from warp_bsc.kernels.exact.polygon import spread

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
        a0 = points[i, 0]
        b0 = points[i, 1]
        c0 = points[i, 2]
        d0 = points[i, 3]
        a1 = points[i, 4]
        b1 = points[i, 5]
        c1 = points[i, 6]
        d1 = points[i, 7]
        _, width = spread(kind, a0, b0, c0, d0, a1, b1, c1, d1)
        bits[i] = width
        time[i] = decide(kind, a0, b0, c0, d0, a1, b1, c1, d1, timed, digits)

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
