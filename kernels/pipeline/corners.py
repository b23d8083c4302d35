"""The corners of a moving face or other cell in one row, all that a thread reads to pair its elements.

A row has 24 numbers. The first 16 bytes are the label: the three vertices, and bits that say what the cell represents.
Then come the positions of each corner, at the start and at the end: in single precision, or in double precision with
the paddings of the three vertices after them.
"""

from typing import Any

import warp as wp

from .boxes import BoxRows, lowered, raised, rounded

ROW = 24
"""Numbers of a row."""
IS_FACE = wp.constant(1 << 6)
"""Bit of a label: the cell is a face whose positions are finite. The bits below are those of ``owned``, see
:mod:`.pairs`, of vertices and edges whose positions are finite."""

Corners = wp.types.matrix(shape=(6, 3), dtype=wp.float32)
"""Positions of the corners, row ``2 corner`` at the start and the next at the end, rounded to single precision."""
PaddedCorners = wp.types.matrix(shape=(6, 3), dtype=wp.float64)
"""The same in double precision, for boxes with a padding."""

_READ = """
    wp::mat_t<6, 3, TYPE> corners;
#if defined(__CUDA_ARCH__)
    // loads of 16 bytes, as neighbouring threads read rows that lie apart
    union { float4 loads[LOADS]; TYPE values[LOADS * 16 / sizeof(TYPE)]; } row;
    const float4* at = reinterpret_cast<const float4*>(rows.data + 24 * (size_t)i) + 1;
    for (int k = 0; k < LOADS; ++k)
        row.loads[k] = at[k];
    for (int k = 0; k < 18; ++k)
        corners.data[k / 3][k % 3] = row.values[k];
#else
    const TYPE* at = rows.data + 24 * (size_t)i + 16 / sizeof(TYPE);
    for (int k = 0; k < 18; ++k)
        corners.data[k / 3][k % 3] = at[k];
#endif
    return corners;
"""

_WRITE = """
    union { float4 loads[1 + LOADS]; int words[4]; TYPE values[(1 + LOADS) * 16 / sizeof(TYPE)]; } row;
    for (int k = 0; k < 4; ++k)
        row.words[k] = label[k];
    for (int k = 0; k < 18; ++k)
        row.values[16 / sizeof(TYPE) + k] = corners.data[k / 3][k % 3];
PADDINGS
    float4* at = reinterpret_cast<float4*>(rows.data + 24 * (size_t)i);
    for (int k = 0; k < 1 + LOADS; ++k)
        at[k] = row.loads[k];
"""

_READ_LABEL = """
    const int* words = reinterpret_cast<const int*>(rows.data + 24 * (size_t)i);
    return wp::vec_t<4, int>(words[0], words[1], words[2], words[3]);
"""


@wp.func_native(snippet=_READ.replace("TYPE", "float").replace("LOADS", "5"))
def read_corners(rows: wp.array2d[wp.float32], i: int) -> Corners:
    """Returns the positions of a row."""
    ...


@wp.func_native(snippet=_READ.replace("TYPE", "double").replace("LOADS", "9"))
def read_padded_corners(rows: wp.array2d[wp.float64], i: int) -> PaddedCorners:
    """Returns the positions of a row in double precision."""
    ...


@wp.func_native(snippet=_READ_LABEL)
def read_label(rows: wp.array2d[wp.float32], i: int) -> wp.vec4i:
    """Returns the label of a row: the three vertices and the bits."""
    ...


@wp.func_native(snippet=_READ_LABEL)
def read_padded_label(rows: wp.array2d[wp.float64], i: int) -> wp.vec4i:
    """Returns the label of a row in double precision."""
    ...


@wp.func_native(snippet=_WRITE.replace("TYPE", "float").replace("LOADS", "5").replace("PADDINGS", ""))
def write_corners(rows: wp.array2d[wp.float32], i: int, label: wp.vec4i, corners: Corners, paddings: wp.vec3d):
    """Writes a row; in single precision it has no paddings."""
    ...


@wp.func_native(
    snippet=_WRITE.replace("TYPE", "double")
    .replace("LOADS", "11")
    .replace("PADDINGS", "    for (int k = 0; k < 3; ++k)\n        row.values[20 + k] = paddings[k];")
)
def write_padded_corners(
    rows: wp.array2d[wp.float64], i: int, label: wp.vec4i, corners: PaddedCorners, paddings: wp.vec3d
):
    """Writes a row in double precision."""
    ...


@wp.func
def paddings_of(rows: wp.array2d[wp.float64], i: int) -> wp.vec3d:
    """Returns the paddings of the corners of a row in double precision."""
    return wp.vec3d(rows[i, 20], rows[i, 21], rows[i, 22])


@wp.func
def stored(x: Any, corners: Corners) -> wp.vec3:
    """Returns a position as rows of a type store it."""
    return rounded(x)


@wp.func
def stored(x: Any, corners: PaddedCorners) -> wp.vec3d:  # noqa: F811, an overload
    """Returns a position as rows of a type store it."""
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def _low(x: wp.vec3, padding: wp.float64) -> wp.vec3:
    return x


@wp.func
def _low(x: wp.vec3d, padding: wp.float64) -> wp.vec3:
    return lowered(x, padding)


@wp.func
def _high(x: wp.vec3, padding: wp.float64) -> wp.vec3:
    return x


@wp.func
def _high(x: wp.vec3d, padding: wp.float64) -> wp.vec3:
    return raised(x, padding)


@wp.func
def _box(low0: Any, high0: Any, low1: Any, high1: Any, padding: wp.float64, swept: bool) -> BoxRows:
    """Returns the box at both ends of a motion, or twice that over its time."""
    if swept:
        low = _low(wp.min(low0, low1), padding)
        high = _high(wp.max(high0, high1), padding)
        return wp.matrix_from_rows(low, high, low, high)
    return wp.matrix_from_rows(_low(low0, padding), _high(high0, padding), _low(low1, padding), _high(high1, padding))


@wp.func
def vertex_box(corners: Any, paddings: wp.vec3d, i: int, swept: bool) -> BoxRows:
    """Returns the box of corner i."""
    start = corners[2 * i]
    end = corners[2 * i + 1]
    return _box(start, start, end, end, paddings[i], swept)


@wp.func
def edge_box(corners: Any, paddings: wp.vec3d, i: int, j: int, swept: bool) -> BoxRows:
    """Returns the box of the edge from corner i to corner j."""
    return _box(
        wp.min(corners[2 * i], corners[2 * j]),
        wp.max(corners[2 * i], corners[2 * j]),
        wp.min(corners[2 * i + 1], corners[2 * j + 1]),
        wp.max(corners[2 * i + 1], corners[2 * j + 1]),
        wp.max(paddings[i], paddings[j]),
        swept,
    )


@wp.func
def face_box(corners: Any, paddings: wp.vec3d, swept: bool) -> BoxRows:
    """Returns the box of the face."""
    return _box(
        wp.min(wp.min(corners[0], corners[2]), corners[4]),
        wp.max(wp.max(corners[0], corners[2]), corners[4]),
        wp.min(wp.min(corners[1], corners[3]), corners[5]),
        wp.max(wp.max(corners[1], corners[3]), corners[5]),
        wp.max(wp.max(paddings[0], paddings[1]), paddings[2]),
        swept,
    )
