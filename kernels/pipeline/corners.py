"""The corners of a moving face or other cell in one row, all that a thread reads to pair its elements.

The first 16 bytes of a row are the label: the three vertices, and bits that say what the cell represents. Then come the
positions of each corner, at the start and at the end; or, for boxes with a padding, its boxes there, padded by the
largest padding of the three. So no box of an element needs more than comparisons in single precision.
"""

from typing import Any

import warp as wp

from ..boxes import BoxRows, lowered, raised, rounded, union_of_boxes

ROW, PADDED_ROW = 24, 40
"""Numbers of a row, without and with a padding."""
IS_FACE = wp.constant(1 << 6)
"""Bit of a label: the cell is a face whose positions are finite. The bits below are those of ``owned``, see
:mod:`.pairs`, of vertices and edges whose positions are finite."""

Corners = wp.types.matrix(shape=(6, 3), dtype=wp.float32)
"""Positions of the corners, row ``2 corner`` at the start and the next at the end, rounded to single precision."""
PaddedCorners = wp.types.matrix(shape=(12, 3), dtype=wp.float32)
"""Padded boxes of the corners, row ``4 corner`` and the next three as :data:`.boxes.BoxRows`."""

_READ = """
    wp::mat_t<ROWS, 3, float> corners;
#if defined(__CUDA_ARCH__)
    // loads of 16 bytes, as neighbouring threads read rows that lie apart
    union { float4 loads[LOADS]; float values[LOADS * 4]; } row;
    const float4* at = reinterpret_cast<const float4*>(rows.data + LENGTH * (size_t)i) + 1;
    for (int k = 0; k < LOADS; ++k)
        row.loads[k] = at[k];
    for (int k = 0; k < 3 * ROWS; ++k)
        corners.data[k / 3][k % 3] = row.values[k];
#else
    const float* at = rows.data + LENGTH * (size_t)i + 4;
    for (int k = 0; k < 3 * ROWS; ++k)
        corners.data[k / 3][k % 3] = at[k];
#endif
    return corners;
"""

_WRITE = """
    union { float4 loads[1 + LOADS]; int words[4]; float values[(1 + LOADS) * 4]; } row;
    for (int k = 0; k < 4; ++k)
        row.words[k] = label[k];
    for (int k = 0; k < 3 * ROWS; ++k)
        row.values[4 + k] = corners.data[k / 3][k % 3];
    float4* at = reinterpret_cast<float4*>(rows.data + LENGTH * (size_t)i);
    for (int k = 0; k < 1 + LOADS; ++k)
        at[k] = row.loads[k];
"""

_READ_LABEL = """
    const int* words = reinterpret_cast<const int*>((const char*)rows.data + rows.strides[0] * (size_t)i);
    return wp::vec_t<4, int>(words[0], words[1], words[2], words[3]);
"""


def _of_rows(snippet: str, *, padded: bool) -> str:
    """Returns a snippet for rows with a padding or without."""
    rows, length = (12, PADDED_ROW) if padded else (6, ROW)
    loads = -(-3 * rows // 4)
    return snippet.replace("ROWS", str(rows)).replace("LENGTH", str(length)).replace("LOADS", str(loads))


@wp.func_native(snippet=_of_rows(_READ, padded=False))
def read_corners(rows: wp.array2d[wp.float32], i: int) -> Corners:
    """Returns the positions of a row."""
    ...


@wp.func_native(snippet=_of_rows(_READ, padded=True))
def read_padded_corners(rows: wp.array2d[wp.float32], i: int) -> PaddedCorners:
    """Returns the boxes of a row."""
    ...


@wp.func_native(snippet=_READ_LABEL)
def read_label(rows: wp.array2d[wp.float32], i: int) -> wp.vec4i:
    """Returns the label of a row: the three vertices and the bits."""
    ...


@wp.func_native(snippet=_of_rows(_WRITE, padded=False))
def write_corners(rows: wp.array2d[wp.float32], i: int, label: wp.vec4i, corners: Corners):
    """Writes a row."""
    ...


@wp.func_native(snippet=_of_rows(_WRITE, padded=True))
def write_padded_corners(rows: wp.array2d[wp.float32], i: int, label: wp.vec4i, corners: PaddedCorners):
    """Writes a row with a padding."""
    ...


@wp.func
def with_corner(corners: Corners, i: int, x0: Any, x1: Any, padding: wp.float64) -> Corners:
    """Returns corners with the positions of corner i at both ends."""
    result = corners
    result[2 * i] = rounded(x0)
    result[2 * i + 1] = rounded(x1)
    return result


@wp.func
def with_corner(corners: PaddedCorners, i: int, x0: Any, x1: Any, padding: wp.float64) -> PaddedCorners:  # noqa: F811, an overload
    """Returns corners with the boxes of corner i at both ends."""
    result = corners
    result[4 * i] = lowered(x0, padding)
    result[4 * i + 1] = raised(x0, padding)
    result[4 * i + 2] = lowered(x1, padding)
    result[4 * i + 3] = raised(x1, padding)
    return result


@wp.func
def _corner_box(corners: Corners, i: int) -> BoxRows:
    start = corners[2 * i]
    end = corners[2 * i + 1]
    return wp.matrix_from_rows(start, start, end, end)


@wp.func
def _corner_box(corners: PaddedCorners, i: int) -> BoxRows:
    return wp.matrix_from_rows(corners[4 * i], corners[4 * i + 1], corners[4 * i + 2], corners[4 * i + 3])


@wp.func
def _box(ends: BoxRows, swept: bool) -> BoxRows:
    """Returns a box at both ends of a motion, or twice that over its time."""
    if swept:
        low = wp.min(ends[0], ends[2])
        high = wp.max(ends[1], ends[3])
        return wp.matrix_from_rows(low, high, low, high)
    return ends


@wp.func
def vertex_box(corners: Any, i: int, swept: bool) -> BoxRows:
    """Returns the box of corner i."""
    return _box(_corner_box(corners, i), swept)


@wp.func
def edge_box(corners: Any, i: int, j: int, swept: bool) -> BoxRows:
    """Returns the box of the edge from corner i to corner j."""
    return _box(union_of_boxes(_corner_box(corners, i), _corner_box(corners, j)), swept)


@wp.func
def face_box(corners: Any, swept: bool) -> BoxRows:
    """Returns the box of the face."""
    ends = union_of_boxes(_corner_box(corners, 0), _corner_box(corners, 1))
    return _box(union_of_boxes(ends, _corner_box(corners, 2)), swept)
