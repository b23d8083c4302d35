"""The places of a Hessian without contacts, which do not change: sparse rows of 3 x 3 blocks, sums over elements."""

import numpy as np
import warp as wp

from ..elasticity.derivatives import Derivatives
from ..elasticity.elements import SIZES, ElementKind
from ..vector_access import READ_BLOCK
from .sums import sum_of

wp.set_module_options({"enable_backward": False})


_OF_NONE = np.iinfo(np.int64).min


@wp.struct
class Rows:
    """Rows of blocks, one for each unknown, and the corners and blocks of elements that they are the sums of."""

    first: wp.array[int]  # first block of each row, and the end of the last, shape [unknown_count + 1]
    row: wp.array[int]  # row of each block
    column: wp.array[int]  # unknown of each block; the first of a row is that of the diagonal
    first_source: wp.array[int]  # first block of elements in each block of a row, and the end of the last
    # blocks of elements; of bending, -1 less 16 times the element plus 4 times one corner plus the other
    source: wp.array[int]
    first_corner: wp.array[int]  # first corner of elements in each unknown, and the end of the last
    corner: wp.array[int]  # corners of elements


def make_rows(vertices: list[np.ndarray], unknown: np.ndarray, count: int, device: wp.Device) -> Rows:
    """Returns the rows of elements.

    Args:
        vertices: Particles of the elements of each kind, -1 for none, shape [n, size].
        unknown: Unknown of each particle, shape [particle_count].
        count: Number of unknowns.
        device: Where to put them.
    """
    unknown, diagonal = np.asarray(unknown, dtype=np.int64), np.arange(count, dtype=np.int64)  # keys exceed 32 bits
    keys, sources = [diagonal * (count + 1)], [np.full(count, _OF_NONE)]
    corner_rows, corners, first_corner, first_block = [], [], 0, 0
    for kind, (v, size) in enumerate(zip(vertices, SIZES, strict=True)):
        u = np.where(v >= 0, unknown[np.maximum(v, 0)] if len(unknown) else -1, -1)
        exists = (u[:, :, None] >= 0) & (u[:, None, :] >= 0)
        numbers = np.arange(len(v) * size * size).reshape(len(v), size, size)
        numbers = -1 - numbers if kind == ElementKind.BENDING else first_block + numbers
        keys.append((u[:, :, None] * count + u[:, None, :])[exists])
        sources.append(numbers[exists])
        of_corners = first_corner + np.arange(len(v) * size).reshape(len(v), size)
        corner_rows.append(u[u >= 0])
        corners.append(of_corners[u >= 0])
        first_corner += len(v) * size
        first_block += 0 if kind == ElementKind.BENDING else len(v) * size * size
    key, source = np.concatenate(keys), np.concatenate(sources)
    order = np.argsort(key, kind="stable")
    key, source = key[order], source[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    row, column = key[starts] // count, key[starts] % count
    ends = np.append(starts[1:], len(key))
    # the diagonal first in its row, then in order of columns
    order = np.lexsort((column, column != row, row))
    counts = (ends - starts)[order]
    first_source = np.append(0, np.cumsum(counts))
    at = np.repeat(starts[order] - first_source[:-1], counts) + np.arange(len(key))
    source = source[at]
    kept = source != _OF_NONE  # the diagonal has an entry of its own, which is none of an element
    kept_before = np.append(0, np.cumsum(kept))
    corner_row, corner = np.concatenate(corner_rows), np.concatenate(corners)
    by_row = np.argsort(corner_row, kind="stable")

    def array(values):
        return wp.array(values.astype(np.int32), dtype=int, device=device)

    rows = Rows()
    rows.first = array(np.searchsorted(row[order], np.arange(count + 1)))
    rows.row, rows.column = array(row[order]), array(column[order])
    rows.first_source, rows.source = array(kept_before[first_source]), array(source[kept])
    rows.first_corner = array(np.searchsorted(corner_row[by_row], np.arange(count + 1)))
    rows.corner = array(corner[by_row])
    return rows


@wp.func_native(
    snippet=sum_of(
        "wp::mat_t<3, 3, float>",
        9,
        places="rows.source.data",
        term="wp::mat_t<3, 3, float> block;",
        read=READ_BLOCK
        + """
            if (place >= 0) {
                t.block = read_block(derivatives.block.data, place);
            } else {
                const int corner = (-1 - place) >> 2, other = (corner & ~3) + ((-1 - place) & 3);
#if defined(__CUDA_ARCH__)
                const float4 a = ((const float4*)derivatives.turn.data)[corner];
                const float4 b = ((const float4*)derivatives.turn.data)[other];
                const float of_a[3] = {a.x, a.y, a.z}, of_b[3] = {b.x, b.y, b.z};
#else
                const wp::vec4 of_a = derivatives.turn.data[corner], of_b = derivatives.turn.data[other];
#endif
                for (int c = 0; c < 9; ++c) t.block.data[c / 3][c % 3] = of_a[c / 3] * of_b[c % 3];
            }
        """,
        add="for (int c = 0; c < 9; ++c) sum[c] += t.block.data[c / 3][c % 3];",
    )
)
def sum_of_blocks(rows: Rows, derivatives: Derivatives, first: int, end: int, part: int, parts: int) -> wp.mat33:
    """Returns a block of the Hessian of elements [N/m], given its first source and the end."""
    ...


@wp.func_native(
    snippet=sum_of(
        "wp::vec_t<3, float>",
        3,
        places="rows.corner.data",
        term="wp::vec3 force;",
        read="t.force = derivatives.gradient.data[place];",
        add="for (int c = 0; c < 3; ++c) sum[c] += t.force[c];",
    )
)
def sum_of_corners(rows: Rows, derivatives: Derivatives, first: int, end: int, part: int, parts: int) -> wp.vec3:
    """Returns the gradient of the energy of elements by an unknown [N], given its first corner and the end."""
    ...
