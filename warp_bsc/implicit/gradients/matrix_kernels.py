"""The matrix of a step: blocks that do not change their places, Jacobians of contacts, and its preconditioner."""

import warp as wp

from ..contact.rows import Rows
from .element_kernels import block

wp.set_module_options({"enable_backward": False})

_ONE = wp.constant(wp.float64(1.0))


@wp.struct
class ContactRows:
    """Jacobians of the forces of contacts, by unknown."""

    offsets: wp.array[int]  # first entry of each unknown, and the end of the last, int32, shape [unknown_count + 1]
    entries: wp.array[int]  # size times an element plus the place of the unknown in it, int32
    unknowns: wp.array2d[int]  # unknowns of elements, -1 for none, int32, shape [n, size]
    jacobian: wp.array3d[wp.vec3d]  # minus blocks of the matrix, see elements.Elements


@wp.struct
class Matrix:
    """The matrix A of a step, scaled: R^T A R, where R R^T are the inverted blocks of the diagonal."""

    offsets: wp.array[int]  # first block of each row, and the end of the last, int32, shape [unknown_count + 1]
    columns: wp.array[int]  # columns of blocks, int32, shape [n]
    # blocks of inertia, elastic forces, and contacts whose unknowns are all of one element, shape [n]
    values: wp.array[wp.mat33d]
    contacts: ContactRows  # blocks of the other contacts
    roots: wp.array[wp.mat33d]  # R by unknown
    # eigenvalues of the blocks of the diagonal that R R^T inverts, one for each column of R
    eigenvalues: wp.array[wp.vec3d]


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const unsigned mask = ((1u << parts) - 1u) << (threadIdx.x & 31u & ~(unsigned)(parts - 1));
    for (int offset = parts / 2; offset > 0; offset /= 2)
        for (int c = 0; c < 3; ++c)
            value[c] += __shfl_xor_sync(mask, value[c], offset);
#endif
    return value;
"""
)
def _sum_of_parts(value: wp.vec3d, parts: int) -> wp.vec3d:
    """Returns the sum of the values of ``parts`` threads that follow each other, a power of 2 below 32, in each."""
    ...


@wp.func
def row_product(matrix: Matrix, i: int, x: wp.array[wp.vec3d], part: int, parts: int) -> wp.vec3d:
    """Returns row i of the product of a matrix with x, in each of the ``parts`` threads that compute it together."""
    product, rows, size = wp.vec3d(), matrix.contacts, matrix.contacts.unknowns.shape[1]
    for k in range(matrix.offsets[i] + part, matrix.offsets[i + 1], parts):
        product += matrix.values[k] * x[matrix.columns[k]]
    for k in range(rows.offsets[i] + part, rows.offsets[i + 1], parts):
        e, row = rows.entries[k] // size, 3 * (rows.entries[k] % size)
        for j in range(size):
            u = rows.unknowns[e, j] + int(0)
            if u >= 0:
                of = x[u] + wp.vec3d()
                product -= wp.vec3d(
                    wp.dot(rows.jacobian[e, row, j], of),
                    wp.dot(rows.jacobian[e, row + 1, j], of),
                    wp.dot(rows.jacobian[e, row + 2, j], of),
                )
    return _sum_of_parts(product, parts)


@wp.kernel
def add_up_rows(
    # in
    transposed: bool,
    inertia: wp.array[wp.float64],
    is_fixed: wp.array[int],
    rows: Rows,
    of_elements: wp.array[wp.mat33d],
    of_bending: wp.array[wp.mat33d],
    # in and out
    diagonal: wp.array[wp.mat33d],
    # out
    values: wp.array[wp.mat33d],
):
    """Adds up the blocks of elements, those of the diagonal, and inertia m / dt^2, 1 for what is fixed.

    Blocks of what is fixed are 0 beside that. The blocks of the diagonal are returned as well.
    """
    u = wp.tid()
    for k in range(rows.first[u], rows.first[u + 1]):
        total = wp.mat33d()
        if k == rows.first[u]:
            total = wp.diag(wp.vec3d(inertia[u])) + wp.where(transposed, wp.transpose(diagonal[u]), diagonal[u])
        if is_fixed[u] == 0 and is_fixed[rows.column[k]] == 0:
            for n in range(rows.first_source[k], rows.first_source[k + 1]):
                source = rows.source[n] + int(0)
                if source >= 0:
                    total += of_elements[source]
                else:
                    total += of_bending[-1 - source]
        values[k] = total
    diagonal[u] = values[rows.first[u]]


@wp.kernel
def factor_blocks(
    # in
    inertia: wp.array[wp.float64],
    blocks: wp.array[wp.mat33d],
    # out
    roots: wp.array[wp.mat33d],
    eigenvalues: wp.array[wp.vec3d],
):
    """Factors the inverse of the symmetric parts of blocks, with eigenvalues made positive and at least the inertia."""
    i = wp.tid()
    block = blocks[i]
    q, values = wp.eig3(wp.float64(0.5) * (block + wp.transpose(block)))
    scale = wp.vec3d()
    for k in range(3):
        values[k] = wp.max(wp.abs(values[k]), inertia[i])
        scale[k] = _ONE / wp.sqrt(values[k])
    eigenvalues[i] = values
    roots[i] = q * wp.diag(scale)


@wp.kernel
def scale_rows(
    # in
    offsets: wp.array[int],
    columns: wp.array[int],
    roots: wp.array[wp.mat33d],
    # in and out
    values: wp.array[wp.mat33d],
):
    """Multiplies the blocks of a matrix by roots from both sides."""
    u = wp.tid()
    for k in range(offsets[u], offsets[u + 1]):
        values[k] = wp.transpose(roots[u]) * values[k] * roots[columns[k]]


@wp.func
def _place_in_row(rows: Rows, u: int, column: int) -> int:
    """Returns the place of a block in row u, -1 if it has none."""
    for k in range(rows.first[u], rows.first[u + 1]):
        if rows.column[k] == column:
            return k
    return -1


@wp.kernel
def find_inside(
    # in
    unknowns: wp.array2d[int],
    is_fixed: wp.array[int],
    rows: Rows,
    # out
    is_inside: wp.array[int],
):
    """Finds contacts whose free unknowns all are of one element, which has places for their blocks."""
    e = wp.tid()
    found = int(1)
    for i in range(unknowns.shape[1]):
        for j in range(unknowns.shape[1]):
            u, v = unknowns[e, i] + int(0), unknowns[e, j] + int(0)
            if found == 1 and u >= 0 and v >= 0:
                if is_fixed[u] == 0 and is_fixed[v] == 0 and _place_in_row(rows, u, v) < 0:
                    found = int(0)
    is_inside[e] = found


@wp.kernel
def add_contacts(
    # in
    transposed: int,
    contacts: ContactRows,
    is_fixed: wp.array[int],
    rows: Rows,
    # in and out
    values: wp.array[wp.mat33d],
    # out
    diagonal: wp.array[wp.mat33d],
):
    """Adds the blocks of contacts inside of elements, or of the transpose, to those of a row; returns its diagonal."""
    u, size = wp.tid(), contacts.unknowns.shape[1]
    for k in range(contacts.offsets[u], contacts.offsets[u + 1]):
        e, i = contacts.entries[k] // size, contacts.entries[k] % size
        for j in range(size):
            v = contacts.unknowns[e, j] + int(0)
            if v >= 0:
                if is_fixed[v] == 0:
                    added = block(contacts.jacobian, e, i, j)
                    if transposed != 0:
                        added = wp.transpose(block(contacts.jacobian, e, j, i))
                    place = _place_in_row(rows, u, v)
                    values[place] = values[place] - added
    diagonal[u] = values[rows.first[u]]


@wp.kernel
def scale_jacobians(
    # in
    transposed: int,
    unknowns: wp.array2d[int],
    is_inside: wp.array[int],
    is_fixed: wp.array[int],
    roots: wp.array[wp.mat33d],
    # in and out
    jacobian: wp.array3d[wp.vec3d],
):
    """Multiplies the blocks of Jacobians, or of their transposes, by roots; those of what is fixed become 0."""
    e, i, j = wp.tid()
    v, w = unknowns[e, i], unknowns[e, j]
    if i > j or v < 0 or w < 0 or is_inside[e] != 0:
        return
    upper, lower = wp.mat33d(), wp.mat33d()
    if is_fixed[v] == 0 and is_fixed[w] == 0:
        upper = wp.transpose(roots[v]) * block(jacobian, e, i, j) * roots[w]
        lower = wp.transpose(roots[w]) * block(jacobian, e, j, i) * roots[v]
    if transposed != 0:
        upper, lower = wp.transpose(lower), wp.transpose(upper)
    for k in range(3):
        jacobian[e, 3 * i + k, j] = upper[k]
        jacobian[e, 3 * j + k, i] = lower[k]


@wp.func
def _lists(unknowns: wp.array2d[int], is_fixed: wp.array[int], is_inside: wp.array[int], inside: int, e: int, i: int):
    """Returns whether an element is listed with the unknown of a place in it."""
    u = unknowns[e, i]
    if u < 0 or is_inside[e] != inside:
        return False
    return is_fixed[u] == 0


@wp.kernel
def count_entries(
    # in
    unknowns: wp.array2d[int],
    is_fixed: wp.array[int],
    is_inside: wp.array[int],
    inside: int,
    # out
    counts: wp.array[int],
):
    """Counts the elements of each free unknown, of those that are ``inside``, 1, or of the others, 0."""
    e, i = wp.tid()
    if _lists(unknowns, is_fixed, is_inside, inside, e, i):
        wp.atomic_add(counts, unknowns[e, i], 1)


@wp.kernel
def list_entries(
    # in
    unknowns: wp.array2d[int],
    is_fixed: wp.array[int],
    is_inside: wp.array[int],
    inside: int,
    # in and out
    ends: wp.array[int],
    # out
    entries: wp.array[int],
):
    """Lists the same elements; ``ends`` are the ends of what is listed."""
    e, i = wp.tid()
    if _lists(unknowns, is_fixed, is_inside, inside, e, i):
        entries[wp.atomic_add(ends, unknowns[e, i], 1)] = unknowns.shape[1] * e + i
