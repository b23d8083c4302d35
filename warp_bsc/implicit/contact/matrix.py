"""The Hessian of a step as conjugate gradients read it: threads that read together find what they read side by side."""

import numpy as np
import warp as wp

from .rows import Rows

wp.set_module_options({"enable_backward": False})

_NONE = -1


@wp.struct
class Matrix:
    """Blocks of rows, which are shared out to the threads of a solve: each has every so many-th block of a row.

    Threads are in groups of so many as read together. The ``k``-th blocks of all threads of a group are side by side,
    component by component.
    """

    width: int  # threads of a group
    group: wp.array[int]  # first group of each world
    # first entry of each group, and the end of the last: as many as its threads have blocks at most
    first: wp.array[int]
    column: wp.array[int]  # unknown of each entry of each thread, -1 where a thread has fewer
    value: wp.array[float]  # components of blocks [N/m]
    place: wp.array[int]  # of each block of rows.Rows, where its first component is


def make_matrix(rows: Rows, of_worlds: np.ndarray, parts: int, device: wp.Device) -> Matrix:
    """Returns the matrix of rows.

    Args:
        rows: The rows.
        of_worlds: First unknown of each world, and the end of the last.
        parts: Threads that share a row, a power of 2.
        device: Where to put it.
    """
    matrix = Matrix()
    matrix.width = 32 if device.is_cuda else 1
    first_block, column = rows.first.numpy().astype(np.int64), rows.column.numpy()
    sizes = np.diff(of_worlds)
    group = np.append(0, np.cumsum(-(-sizes * parts // matrix.width)))
    unknowns = np.arange(len(first_block) - 1)
    world = np.searchsorted(of_worlds, unknowns, side="right") - 1
    row = np.repeat(unknowns, np.diff(first_block))
    number = np.arange(len(column)) - first_block[row]
    in_world = (row - of_worlds[world[row]]) * parts + number % parts
    thread = group[world[row]] * matrix.width + in_world
    entry, of_group, lane = number // parts, thread // matrix.width, thread % matrix.width
    depth = np.zeros(group[-1], dtype=np.int64)
    np.maximum.at(depth, of_group, entry + 1)
    first = np.append(0, np.cumsum(depth))
    entry += first[of_group]
    columns = np.full(first[-1] * matrix.width, _NONE)
    columns[entry * matrix.width + lane] = column

    def array(values):
        return wp.array(values.astype(np.int32), dtype=int, device=device)

    matrix.group, matrix.first, matrix.column = array(group), array(first), array(columns)
    matrix.place = array(9 * entry * matrix.width + lane)
    matrix.value = wp.zeros(9 * len(columns), dtype=float, device=device)
    return matrix


@wp.func
def block_of(matrix: Matrix, k: int) -> wp.mat33:
    """Returns a block of the rows."""
    v, n, place = matrix.value, matrix.width, matrix.place[k]
    return wp.mat33(
        v[place],
        v[place + n],
        v[place + 2 * n],
        v[place + 3 * n],
        v[place + 4 * n],
        v[place + 5 * n],
        v[place + 6 * n],
        v[place + 7 * n],
        v[place + 8 * n],
    )


@wp.func
def set_block(matrix: Matrix, k: int, block: wp.mat33):
    """Writes a block of the rows."""
    place = matrix.place[k]
    for c in range(9):
        matrix.value[place + c * matrix.width] = block[c // 3, c % 3]
