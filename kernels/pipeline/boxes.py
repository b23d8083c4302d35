"""Axis-aligned boxes of moving elements, in single precision, none of which misses what the positions do."""

from typing import Any

import warp as wp

_LARGEST_FLOAT = wp.constant(wp.float64(3.4028234663852886e38))


@wp.func
def rounded(x: Any) -> wp.vec3:
    """A corner in single precision: to nearest, because rounding and clamping keep the order of coordinates.

    Boxes that overlap still do, and what lies apart still does or touches.
    """
    largest = _LARGEST_FLOAT
    return wp.vec3(
        wp.float32(wp.clamp(wp.float64(x[0]), -largest, largest)),
        wp.float32(wp.clamp(wp.float64(x[1]), -largest, largest)),
        wp.float32(wp.clamp(wp.float64(x[2]), -largest, largest)),
    )


@wp.func
def boxes_overlap(low: wp.vec3, high: wp.vec3, other_low: wp.vec3, other_high: wp.vec3) -> bool:
    """Whether two closed boxes overlap."""
    return (
        low[0] <= other_high[0]
        and low[1] <= other_high[1]
        and low[2] <= other_high[2]
        and other_low[0] <= high[0]
        and other_low[1] <= high[1]
        and other_low[2] <= high[2]
    )


@wp.func
def boxes_apart(
    low0: Any, high0: Any, low1: Any, high1: Any, other_low0: Any, other_high0: Any, other_low1: Any, other_high1: Any
) -> bool:
    """Whether an axis separates two boxes at the start (0) and at the end (1), on the same side: then it always does.

    Exact at any scale: of a difference only the sign matters. Branches would be mispredicted.
    """
    below = wp.min(other_low0 - high0, other_low1 - high1)
    above = wp.min(low0 - other_high0, low1 - other_high1)
    return wp.float64(wp.max(wp.max(below, above))) > wp.float64(0.0)
