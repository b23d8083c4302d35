"""The corners of a moving face or other cell, all that a thread reads to pair its elements, in single precision.

A row has the positions of a vertex at the start and at the end, in 32 bytes, the least that a GPU reads. For boxes with
a padding a row has the three corners of a cell: their boxes, padded by the largest padding of the three. So no box of
an element needs more than comparisons. Where a position is not finite, its part of a row is not a number.
"""

from typing import Any

import warp as wp

from ..boxes import BoxRows, lowered, raised, union_of_boxes

ROW, PADDED_ROW = 8, 36
"""Numbers of the row of a vertex, and of that of a cell with a padding."""
IS_FACE = wp.constant(1 << 6)
"""The cell is a face; the bits below are those of ``owned``, see :func:`..pairs.finite_elements`."""

Corners = wp.types.matrix(shape=(6, 3), dtype=wp.float32)
"""Positions of the corners, row ``2 corner`` at the start and the next at the end, rounded to single precision."""
PaddedCorners = wp.types.matrix(shape=(12, 3), dtype=wp.float32)
"""Padded boxes of the corners, row ``4 corner`` and the next three as :data:`.boxes.BoxRows`."""

# loads of 16 bytes, as neighbouring threads read rows that lie apart
_READ = """
    union { float4 loads[6]; float values[24]; } row;
    for (int k = 0; k < 6; ++k)
        row.loads[k] = reinterpret_cast<const float4*>(rows.data)[2 * (size_t)cell[k / 2] + k % 2];
    wp::mat_t<6, 3, float> corners;
    for (int k = 0; k < 18; ++k)
        corners.data[k / 3][k % 3] = row.values[4 * (k / 3) + k % 3];
    return corners;
"""

_WRITE = """
    union { float4 loads[2]; float values[8]; } row;
    for (int k = 0; k < 8; ++k)
        row.values[k] = k % 4 == 3 ? 0.0f : k < 4 ? start[k] : end[k - 4];
    for (int k = 0; k < 2; ++k)
        reinterpret_cast<float4*>(rows.data)[2 * (size_t)vertex + k] = row.loads[k];
"""

_READ_PADDED = """
    union { float4 loads[9]; float values[36]; } row;
    for (int k = 0; k < 9; ++k)
        row.loads[k] = reinterpret_cast<const float4*>(rows.data)[9 * (size_t)i + k];
    wp::mat_t<12, 3, float> corners;
    for (int k = 0; k < 36; ++k)
        corners.data[k / 3][k % 3] = row.values[k];
    return corners;
"""

_WRITE_PADDED = """
    union { float4 loads[9]; float values[36]; } row;
    for (int k = 0; k < 36; ++k)
        row.values[k] = corners.data[k / 3][k % 3];
    for (int k = 0; k < 9; ++k)
        reinterpret_cast<float4*>(rows.data)[9 * (size_t)i + k] = row.loads[k];
"""

_READ_CELL = """
    union { float4 load; int values[4]; } row;
    row.load = reinterpret_cast<const float4*>(cells.data)[i];
    return wp::vec_t<4, int>(row.values[0], row.values[1], row.values[2], row.values[3]);
"""


@wp.func_native(snippet=_READ)
def read_corners(rows: wp.array2d[wp.float32], cell: wp.vec4i) -> Corners:
    """Returns the positions of the corners of a cell from rows of vertices."""
    ...


@wp.func_native(snippet=_WRITE)
def write_vertex(rows: wp.array2d[wp.float32], vertex: int, start: wp.vec3, end: wp.vec3):
    """Writes the row of a vertex."""
    ...


@wp.func_native(snippet=_READ_PADDED)
def read_padded_corners(rows: wp.array2d[wp.float32], i: int) -> PaddedCorners:
    """Returns the boxes of the corners of a cell from its row."""
    ...


@wp.func_native(snippet=_WRITE_PADDED)
def write_padded_corners(rows: wp.array2d[wp.float32], i: int, corners: PaddedCorners):
    """Writes the row of a cell with a padding."""
    ...


@wp.func_native(snippet=_READ_CELL)
def read_cell(cells: wp.array2d[int], i: int) -> wp.vec4i:
    """Returns a row of four numbers: the three vertices of a cell, and what it represents as bits."""
    ...


@wp.func
def with_padded_corner(corners: PaddedCorners, i: int, x0: Any, x1: Any, padding: wp.float64) -> PaddedCorners:
    """Returns corners with the boxes of corner i at both ends."""
    result = corners
    result[4 * i] = lowered(x0, padding)
    result[4 * i + 1] = raised(x0, padding)
    result[4 * i + 2] = lowered(x1, padding)
    result[4 * i + 3] = raised(x1, padding)
    if not (wp.isfinite(x0) and wp.isfinite(x1)):
        result[4 * i] = wp.vec3(wp.nan, wp.nan, wp.nan)
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
def corner_is_finite(corners: Any, i: int) -> bool:
    """Returns whether the positions of corner i are finite."""
    return not wp.isnan(_corner_box(corners, i)[0][0])


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
