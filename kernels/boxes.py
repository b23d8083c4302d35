"""Axis-aligned boxes of moving elements, in single precision, without missing an overlap of the exact boxes."""

from typing import Any

import warp as wp

BoxRows = wp.types.matrix(shape=(4, 3), dtype=wp.float32)
"""The box of a moving element: the lowest and the highest coordinates at the start, then at the end."""

_LARGEST_FLOAT = wp.constant(wp.float64(3.4028234663852886e38))


@wp.func
def rounded(x: Any) -> wp.vec3:
    """Returns a corner in single precision, to nearest, because rounding and clamping keep the order of coordinates.

    Boxes that overlap still do; boxes that are apart still are, or touch.
    """
    largest = _LARGEST_FLOAT
    return wp.vec3(
        wp.float32(wp.clamp(wp.float64(x[0]), -largest, largest)),
        wp.float32(wp.clamp(wp.float64(x[1]), -largest, largest)),
        wp.float32(wp.clamp(wp.float64(x[2]), -largest, largest)),
    )


@wp.func
def lowered(x: Any, padding: wp.float64) -> wp.vec3:
    """Returns a corner moved down by a padding, in single precision, rounded as by :func:`rounded`.

    Both roundings keep order: boxes of elements overlap that are at most the sum of their paddings apart.
    """
    return rounded(wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2])) - wp.vec3d(padding))


@wp.func
def raised(x: Any, padding: wp.float64) -> wp.vec3:
    """Returns a corner moved up by a padding, see :func:`lowered`."""
    return rounded(wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2])) + wp.vec3d(padding))


@wp.func
def empty_box() -> BoxRows:
    """Returns a box that overlaps none."""
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    return wp.matrix_from_rows(low, -low, low, -low)


@wp.func
def union_of_boxes(a: BoxRows, b: BoxRows) -> BoxRows:
    """Returns the smallest box around two."""
    return wp.matrix_from_rows(wp.min(a[0], b[0]), wp.max(a[1], b[1]), wp.min(a[2], b[2]), wp.max(a[3], b[3]))


@wp.func
def boxes_apart(
    low0: Any, high0: Any, low1: Any, high1: Any, other_low0: Any, other_high0: Any, other_low1: Any, other_high1: Any
) -> bool:
    """Returns whether an axis separates two boxes at the start (0) and the end (1), on one side: then it always does.

    Exact at any scale, as only the signs of differences matter. Branches would be mispredicted.
    """
    below = wp.min(other_low0 - high0, other_low1 - high1)
    above = wp.min(low0 - other_high0, low1 - other_high1)
    return wp.float64(wp.max(wp.max(below, above))) > wp.float64(0.0)


@wp.func_native(
    snippet="""
    wp::mat_t<4, 3, wp::float32> box;
#if defined(__CUDA_ARCH__)
    // three loads of 16 bytes instead of twelve of four, as neighbouring threads read boxes that lie apart
    const float4* at = reinterpret_cast<const float4*>(boxes.data + 4 * (size_t)i);
    const float4 a = at[0], b = at[1], c = at[2];
    const float values[12] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
    for (int k = 0; k < 12; ++k)
        box.data[k / 3][k % 3] = values[k];
#else
    for (int k = 0; k < 12; ++k)
        box.data[k / 3][k % 3] = boxes.data[4 * (size_t)i + k / 3][k % 3];
#endif
    return box;
"""
)
def read_box(boxes: wp.array2d[wp.vec3], i: int) -> BoxRows:
    """Returns a row of an array of boxes, shape [n, 4], which is contiguous and begins at a multiple of 16 bytes."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    float4* at = reinterpret_cast<float4*>(boxes.data + 4 * (size_t)i);
    at[0] = make_float4(box.data[0][0], box.data[0][1], box.data[0][2], box.data[1][0]);
    at[1] = make_float4(box.data[1][1], box.data[1][2], box.data[2][0], box.data[2][1]);
    at[2] = make_float4(box.data[2][2], box.data[3][0], box.data[3][1], box.data[3][2]);
#else
    for (int k = 0; k < 12; ++k)
        boxes.data[4 * (size_t)i + k / 3][k % 3] = box.data[k / 3][k % 3];
#endif
"""
)
def write_box(box: BoxRows, boxes: wp.array2d[wp.vec3], i: int):
    """Writes a row of an array of boxes, see :func:`read_box`."""
    ...
