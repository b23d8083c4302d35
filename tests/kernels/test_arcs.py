"""Positions on arcs, and their distance from chords, against 60 digits."""

from decimal import Decimal

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import warp as wp
from arc_truth import path

import warp_bsc as bsc
from warp_bsc.detection.arcs.rigid_motion import ArcBounds


def bounds_of(x0, x1, centre, turn, device):
    """The bounds of one body with one vertex a row, each with a centre and a turn of its own; any end is taken."""
    motion = bsc.RigidMotion(np.arange(len(x0)), centre, turn)
    ends = [wp.array(x, dtype=wp.vec3 if x.dtype == np.float32 else wp.vec3d, device=device) for x in (x0, x1)]
    return ArcBounds(motion, wp.array(np.arange(len(x0)), dtype=int, device=device), *ends)


def error_of(computed, exact):
    return float(sum((a - c) ** 2 for a, c in zip(exact, computed, strict=True)).sqrt())


def random_motion(rng, n, dtype):
    """Points, centres and turns of all sizes, from less than a nanoradian to hundreds of turns."""
    scale = 10.0 ** rng.uniform(-6, 6, (n, 1))
    x0 = (scale * rng.uniform(-1, 1, (n, 3)) + rng.choice([0.0, 1e4], (n, 1))).astype(dtype)
    x1 = (scale * rng.uniform(-1, 1, (n, 3))).astype(dtype)
    turn = rng.standard_normal((n, 3))
    turn *= 10.0 ** rng.uniform(-9, 3, (n, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
    turn[::7, 1:] = 0.0
    return x0, x1, x0 + scale * rng.uniform(-1, 1, (n, 3)), turn


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_positions_are_within_the_bound_of_their_rounding(dtype, device):
    rng = np.random.default_rng(3)
    x0, x1, centre, turn = random_motion(rng, 60, dtype)
    bounds = bounds_of(x0, x1, centre, turn, device)
    bound = bounds.deviation(1000)  # the rounding alone
    largest = 0.0
    for time in (0.0, 1.0, 0.5, 2.0**-40, 5.0 / 32.0, 1.0 - 2.0**-30):
        x = bounds.place(time).numpy()
        for i in range(len(x0)):
            exact = path(x0[i], x1[i], centre[i], turn[i], time)
            largest = max(largest, error_of([Decimal(float(v)) for v in x[i]], exact) / bound[i])
    assert 1e-3 < largest < 0.5  # the bound is more than twice what the proof needs


@hypothesis.given(st.integers(0, 2**32 - 1), st.integers(0, 12))
def test_arcs_are_within_the_bound_of_their_chords(seed, level):
    rng = np.random.default_rng(seed)
    x0, x1, centre, turn = random_motion(rng, 4, np.float64)
    bounds = bounds_of(x0, x1, centre, turn, wp.get_device("cpu"))
    bound = bounds.deviation(level)
    part, share = int(rng.integers(2**level)), float(rng.choice([0.5, rng.uniform()]))
    start, end = (bounds.place((part + i) * 2.0**-level).numpy() for i in range(2))
    for i in range(len(x0)):
        exact = path(x0[i], x1[i], centre[i], turn[i], (part + share) * 2.0**-level)
        share_of = Decimal((part + share) * 2.0**-level) * 2**level - part
        chord = [
            (1 - share_of) * Decimal(float(a)) + share_of * Decimal(float(b))
            for a, b in zip(start[i], end[i], strict=True)
        ]
        assert error_of(chord, exact) <= bound[i]


def test_the_bound_is_tight_for_short_arcs(device):
    """In the middle of a part that turns by less than a degree, the arc is at more than 0.99 of the bound."""
    x0, centre = np.array([[3.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 5.0]])
    turn = np.array([[0.0, 0.0, 1.0]])
    x1 = np.array([[1.0 + 2.0 * np.cos(1.0), 2.0 * np.sin(1.0), 0.0]])
    bounds = bounds_of(x0, x1, centre, turn, device)
    for level in range(6, 12):
        start, end = (bounds.place(i * 2.0**-level).numpy()[0] for i in range(2))
        deviation = np.linalg.norm(bounds.place(2.0 ** -(level + 1)).numpy()[0] - 0.5 * (start + end))
        assert 0.99 * bounds.deviation(level)[0] < deviation <= bounds.deviation(level)[0]
