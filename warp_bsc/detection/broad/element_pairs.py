"""The pairs of elements that two faces of a hierarchy represent: kernels that enqueue those whose boxes overlap."""

from typing import NamedTuple

import warp as wp

from ...kernels.bits import lowest_bit
from ...kernels.boxes import BoxRows
from ...kernels.pairs import finite_elements, is_filtered
from ...kernels.pipeline.corners import (
    IS_FACE,
    Corners,
    PaddedCorners,
    corner_is_finite,
    edge_box,
    face_box,
    read_cell,
    read_corners,
    read_padded_corners,
    vertex_box,
)
from ...kernels.pipeline.hierarchy import WIDTH, are_apart, count_set_bits, lowest_set_bit
from ...kernels.pipeline.queues import append, filled_entries, is_filled, raise_count, take_slot, take_slots, write
from ..run.launch import made_once
from ..run.settings import NO_GRADIENTS, Count
from .face_hierarchy import FaceHierarchy

_PAIRS_OF_THREAD = wp.constant(4)
"""Most pairs of faces whose elements a thread pairs at once."""
_PAIRS_AT_ONCE = wp.constant(1 << 17)
"""Pairs of faces that a GPU works on at once, each by a thread of its own."""
_VERTEX_FACE_BITS = wp.constant(63)
_BITS_OF_PAIR = wp.constant(15)
"""Pairs of elements that two faces can represent: six of vertex and face, nine of edges."""


@wp.struct
class Pairs:
    """A queue of pairs, and its counts: of pairs of faces by place one, of pairs of elements those by Count."""

    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]


@wp.func
def _corners(faces: wp.array2d[int], face: int) -> wp.vec3i:
    return wp.vec3i(faces[face, 0], faces[face, 1], faces[face, 2])


@wp.func
def _side(faces: wp.array2d[int], face: int, i: int) -> wp.vec3i:
    a = faces[face, i]
    b = faces[face, wp.where(i == 2, 0, i + 1)]
    return wp.vec3i(a, b, b)


@wp.func
def _count_filtered(mesh: FaceHierarchy, place: int, count: int):
    """Counts pairs of elements of the cell at a place that a filter leaves out by world, if that is to be known."""
    if mesh.filtered_of_worlds and count > 0:
        world = int(0)
        if mesh.places.first_world:
            world = mesh.places.first_world[place]
        wp.atomic_add(mesh.filtered_of_worlds, world, wp.int64(count))


@wp.func
def _corners_with(vertices: wp.vec3i, vertex: int) -> int:
    """Returns which corners of a cell are a vertex, as bits."""
    return (
        wp.where(vertices[0] == vertex, 1, 0)
        | wp.where(vertices[1] == vertex, 2, 0)
        | wp.where(vertices[2] == vertex, 4, 0)
    )


@wp.func
def _sides_at(corners: int) -> int:
    """Returns which sides of a face have one of some corners, as bits; side j goes from corner j to the next."""
    return (corners | (corners >> 1) | (corners << 2)) & 7


@wp.func
def filtered_pairs(mesh: FaceHierarchy, place: int, other: int, pairs: int) -> int:
    """Returns which of some pairs of the elements of two faces a filter leaves out, as bits."""
    filtered = int(0)
    if mesh.pair_filter.group:
        left = pairs
        while left != 0:
            bit = lowest_set_bit(wp.uint32(left))
            left = left & (left - 1)
            element = wp.vec3i()
            against = wp.vec3i()
            if bit < 3:
                element = wp.vec3i(mesh.faces[place, bit])
                against = _corners(mesh.faces, other)
            elif bit < 6:
                element = wp.vec3i(mesh.faces[other, bit - 3])
                against = _corners(mesh.faces, place)
            else:
                element = _side(mesh.faces, place, (bit - 6) / 3)
                against = _side(mesh.faces, other, (bit - 6) % 3)
            if is_filtered(mesh.pair_filter, element, against):
                filtered = filtered | (1 << bit)
    return filtered


class PairFunctions(NamedTuple):
    """Device functions for the elements of two faces, ``f(mesh: FaceHierarchy, place: int, other: int) -> int``.

    They return pairs of elements that the two represent, that share no vertex and that no axis separates, as bits.

    Attributes:
        vertex_face_pairs: Bits 0 to 2: corners of the first with the second face; 3 to 5: of the second with the first.
        element_pairs: These, and bit 6 + 3 i + j: side i of the first with side j of the second.
        edge_face_pairs: Bits 0 to 2: sides of the first with the second face; 3 to 5: of the second with the first.
        point_pair: Whether no axis separates a point, the first, from a point or an edge that no face has: 1 or 0.
    """

    vertex_face_pairs: wp.Function
    element_pairs: wp.Function
    edge_face_pairs: wp.Function
    point_pair: wp.Function


@made_once
def pair_functions(padded: bool, swept: bool) -> PairFunctions:
    """Returns the functions for boxes with a padding or without, over the time of the motion or at both ends."""

    @wp.struct
    class Cell:
        """What a thread reads of the cell at a place."""

        vertices: wp.vec3i
        elements: int  # what of it is finite, as bits, see :mod:`warp_bsc.kernels.pipeline.corners`
        corners: PaddedCorners if padded else Corners

    @wp.func
    def cell_at(mesh: FaceHierarchy, place: int) -> Cell:
        cell = Cell()
        read = read_cell(mesh.faces, place)
        if wp.static(padded):
            cell.corners = read_padded_corners(mesh.corners, place)
        else:
            cell.corners = read_corners(mesh.corners, read)
        cell.vertices = wp.vec3i(read[0], read[1], read[2])
        a_finite = corner_is_finite(cell.corners, 0)
        b_finite = corner_is_finite(cell.corners, 1)
        c_finite = corner_is_finite(cell.corners, 2)
        cell.elements = finite_elements(read[3], a_finite, b_finite, c_finite)
        return cell

    @wp.func
    def common_corners(a: Cell, b: Cell) -> int:
        """Returns which corners of a cell are vertices of another, as bits."""
        common = int(0)
        for i in range(3):
            if _corners_with(b.vertices, a.vertices[i]) != 0:
                common = common | (1 << i)
        return common

    @wp.func
    def corners_near(a: Cell, box: BoxRows) -> int:
        """Returns which corners no axis separates from a box, as bits."""
        found = int(0)
        for i in range(3):
            if not are_apart(vertex_box(a.corners, i, wp.static(swept)), box):
                found = found | (1 << i)
        return found

    @wp.func
    def sides_near(a: Cell, sought: int, box: BoxRows) -> int:
        """Returns which of some sides no axis separates from a box, as bits."""
        found = int(0)
        for i in range(3):
            if i < 2 or sought >= 4:  # of hardly any face the last one
                if not are_apart(edge_box(a.corners, i, (i + 1) % 3, wp.static(swept)), box):
                    found = found | (1 << i)
        return sought & found

    @wp.func
    def corners_with_face(a: Cell, b: Cell) -> int:
        """Returns the corners of a cell with the face b."""
        sought = a.elements & 7 & ~common_corners(a, b)
        if sought == 0 or b.elements & IS_FACE == 0:
            return 0
        return sought & corners_near(a, face_box(b.corners, wp.static(swept)))

    @wp.func
    def sides_with_face(a: Cell, b: Cell) -> int:
        """Returns the sides of a cell with the face b."""
        sought = (a.elements >> 3) & 7 & ~_sides_at(common_corners(a, b))
        if sought == 0 or b.elements & IS_FACE == 0:
            return 0
        return sides_near(a, sought, face_box(b.corners, wp.static(swept)))

    @wp.func
    def vertex_face_pairs(mesh: FaceHierarchy, place: int, other: int) -> int:
        a = cell_at(mesh, place)
        b = cell_at(mesh, other)
        return corners_with_face(a, b) | (corners_with_face(b, a) << 3)

    @wp.func
    def edge_face_pairs(mesh: FaceHierarchy, place: int, other: int) -> int:
        a = cell_at(mesh, place)
        b = cell_at(mesh, other)
        return sides_with_face(a, b) | (sides_with_face(b, a) << 3)

    @wp.func
    def element_pairs(mesh: FaceHierarchy, place: int, other: int) -> int:
        a = cell_at(mesh, place)
        b = cell_at(mesh, other)
        found = corners_with_face(a, b) | (corners_with_face(b, a) << 3)
        for i in range(3):
            common = _corners_with(b.vertices, a.vertices[i]) | _corners_with(b.vertices, a.vertices[(i + 1) % 3])
            sought = (b.elements >> 3) & 7 & ~_sides_at(common)
            if (a.elements >> (3 + i)) & 1 == 1 and sought != 0:
                box = edge_box(a.corners, i, (i + 1) % 3, wp.static(swept))
                found = found | (sides_near(b, sought, box) << (6 + 3 * i))
        return found

    @wp.func
    def point_pair(mesh: FaceHierarchy, place: int, other: int) -> int:
        a = cell_at(mesh, place)
        b = cell_at(mesh, other)
        needed = wp.where(mesh.order[other] >= mesh.point_start, 1, 8)
        if a.elements & 1 == 0 or b.elements & needed == 0:
            return 0
        box = vertex_box(a.corners, 0, wp.static(swept))
        # the ends of a point are one vertex
        other_box = edge_box(b.corners, 0, 1, wp.static(swept))
        return wp.where(are_apart(box, other_box), 0, 1)

    return PairFunctions(vertex_face_pairs, element_pairs, edge_face_pairs, point_pair)


@made_once
def pair_elements_kernel(padded: bool, swept: bool) -> wp.Kernel:
    """Returns the kernel that enqueues the candidates of pairs of faces, for boxes as of :func:`pair_functions`.

    A thread first finds all its pairs, then takes slots for them: where pairs of faces are many, a warp makes one
    atomic operation for 128 of them. Atomic operations on one address are serialized, so that fewer are faster.
    """
    unseparated_pairs = pair_functions(padded, swept).element_pairs

    @wp.func
    def pair_some(mesh: FaceHierarchy, face_pairs: Pairs, first: int, turns: int, vertex_face: Pairs, edge_edge: Pairs):
        """Enqueues the candidates of some pairs of faces: ``first``, and each that is a warp further."""
        found = wp.uint64(0)
        queued = wp.vec2i()  # vertex-face, edge-edge
        filtered = wp.vec2i()
        for turn in range(turns):
            at = first + turn * WIDTH
            if is_filled(at, face_pairs.pairs, face_pairs.counts, 0):
                face = face_pairs.pairs[at][0]
                other = face_pairs.pairs[at][1]
                pairs = unseparated_pairs(mesh, face, other)
                if mesh.pair_filter.group:
                    left_out = filtered_pairs(mesh, face, other, pairs)
                    pairs = pairs & ~left_out
                    filtered[0] += count_set_bits(wp.uint32(left_out & _VERTEX_FACE_BITS))
                    filtered[1] += count_set_bits(wp.uint32(left_out & ~_VERTEX_FACE_BITS))
                    _count_filtered(mesh, face, count_set_bits(wp.uint32(left_out)))
                queued[0] += count_set_bits(wp.uint32(pairs & _VERTEX_FACE_BITS))
                queued[1] += count_set_bits(wp.uint32(pairs & ~_VERTEX_FACE_BITS))
                found = found | (wp.uint64(pairs) << wp.uint64(_BITS_OF_PAIR * turn))
        if mesh.pair_filter.group:
            raise_count(vertex_face.counts, Count.FILTERED, filtered[0])
            raise_count(edge_edge.counts, Count.FILTERED, filtered[1])
        vertex_face_slot = take_slots(vertex_face.counts, Count.QUEUED, queued[0])
        edge_edge_slot = take_slots(edge_edge.counts, Count.QUEUED, queued[1])
        while found != wp.uint64(0):
            bit = lowest_bit(found)
            found = found & (found - wp.uint64(1))
            at = first + (bit / _BITS_OF_PAIR) * WIDTH
            bit = bit % _BITS_OF_PAIR
            face = face_pairs.pairs[at][0]
            other = face_pairs.pairs[at][1]
            if bit < 3:
                write(wp.vec2i(mesh.faces[face, bit], mesh.order[other]), vertex_face.pairs, vertex_face_slot)
                vertex_face_slot += wp.int64(1)
            elif bit < 6:
                write(wp.vec2i(mesh.faces[other, bit - 3], mesh.order[face]), vertex_face.pairs, vertex_face_slot)
                vertex_face_slot += wp.int64(1)
            else:
                edge = mesh.face_edges[face, (bit - 6) / 3]
                other_edge = mesh.face_edges[other, (bit - 6) % 3]
                write(wp.vec2i(wp.min(edge, other_edge), wp.max(edge, other_edge)), edge_edge.pairs, edge_edge_slot)
                edge_edge_slot += wp.int64(1)

    @wp.kernel(**NO_GRADIENTS, cuda_max_registers=96)
    def pair_elements(mesh: FaceHierarchy, face_pairs: Pairs, vertex_face: Pairs, edge_edge: Pairs, threads: int):
        i = wp.tid()
        count = filled_entries(face_pairs.pairs, face_pairs.counts, 0)
        turns = wp.clamp(count / _PAIRS_AT_ONCE, 1, _PAIRS_OF_THREAD)
        for first in range((i / WIDTH) * turns * WIDTH + i % WIDTH, count, turns * threads):
            pair_some(mesh, face_pairs, first, turns, vertex_face, edge_edge)

    return pair_elements


@made_once
def pair_edges_with_faces_kernel(padded: bool, swept: bool) -> wp.Kernel:
    """Returns the kernel that enqueues the edges that two faces represent, each with the other face."""
    unseparated_pairs = pair_functions(padded, swept).edge_face_pairs

    @wp.kernel(**NO_GRADIENTS)
    def pair_edges_with_faces(mesh: FaceHierarchy, face_pairs: Pairs, edge_face: Pairs, threads: int):
        for i in range(wp.tid(), filled_entries(face_pairs.pairs, face_pairs.counts, 0), threads):
            left = unseparated_pairs(mesh, face_pairs.pairs[i][0], face_pairs.pairs[i][1])
            while left != 0:
                bit = lowest_set_bit(wp.uint32(left))
                left = left & (left - 1)
                place = face_pairs.pairs[i][bit / 3]
                other = face_pairs.pairs[i][1 - bit / 3]
                side = bit % 3
                if is_filtered(mesh.pair_filter, _side(mesh.faces, place, side), _corners(mesh.faces, other)):
                    take_slot(edge_face.counts, Count.FILTERED)
                else:
                    pair = wp.vec2i(mesh.face_edges[place, side], mesh.order[other])
                    append(pair, edge_face.pairs, edge_face.counts, Count.QUEUED)

    return pair_edges_with_faces


@made_once
def pair_points_kernel(padded: bool, swept: bool) -> wp.Kernel:
    """Returns the kernel that enqueues the points among two cells, with an edge that no face has or another point."""
    is_unseparated = pair_functions(padded, swept).point_pair

    @wp.func
    def pair_point(mesh: FaceHierarchy, place: int, other: int, vertex_edge: Pairs, vertex_vertex: Pairs):
        """Enqueues a point with an edge that no face has or another point, if the cells at two places are that."""
        cell = mesh.order[other]
        if mesh.order[place] < mesh.point_start or cell < mesh.face_count or place == other:
            return
        if is_unseparated(mesh, place, other) == 0:
            return
        p = mesh.faces[place, 0]
        q = mesh.faces[other, 0]
        is_point = cell >= mesh.point_start
        if is_filtered(mesh.pair_filter, wp.vec3i(p), _corners(mesh.faces, other)):
            if is_point:
                take_slot(vertex_vertex.counts, Count.FILTERED)
            else:
                take_slot(vertex_edge.counts, Count.FILTERED)
            _count_filtered(mesh, place, 1)
        elif is_point:
            append(wp.vec2i(wp.min(p, q), wp.max(p, q)), vertex_vertex.pairs, vertex_vertex.counts, Count.QUEUED)
        else:
            append(wp.vec2i(p, mesh.face_edges[other, 0]), vertex_edge.pairs, vertex_edge.counts, Count.QUEUED)

    @wp.kernel(**NO_GRADIENTS)
    def pair_points(mesh: FaceHierarchy, face_pairs: Pairs, vertex_edge: Pairs, vertex_vertex: Pairs, threads: int):
        for i in range(wp.tid(), filled_entries(face_pairs.pairs, face_pairs.counts, 0), threads):
            place = face_pairs.pairs[i][0]
            other = face_pairs.pairs[i][1]
            if mesh.order[place] < mesh.point_start:
                place = face_pairs.pairs[i][1]
                other = face_pairs.pairs[i][0]
            pair_point(mesh, place, other, vertex_edge, vertex_vertex)

    return pair_points
