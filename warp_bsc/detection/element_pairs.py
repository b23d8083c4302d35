"""The pairs of elements that two faces of a hierarchy represent: kernels that enqueue those whose boxes overlap."""

import warp as wp

from ..kernels.pipeline.bits import lowest_bit
from ..kernels.pipeline.boxes import read_box
from ..kernels.pipeline.hierarchy import WIDTH, are_apart, count_set_bits
from ..kernels.pipeline.pairs import is_filtered, owns_edge, owns_vertex
from ..kernels.pipeline.queues import append, filled_entries, is_filled, raise_count, take_slot, take_slots, write
from .face_hierarchy import FaceHierarchy
from .settings import NO_GRADIENTS, Count

__all__ = ["pair_edges_with_faces", "pair_elements", "pair_points", "unseparated_edges", "unseparated_vertices"]

_FILTERED = wp.constant(int(Count.FILTERED))
_QUEUED = wp.constant(int(Count.QUEUED))

_WIDTH = wp.constant(WIDTH)

_PAIRS_OF_THREAD = wp.constant(4)
"""Most pairs of faces whose elements a thread pairs at once."""
_PAIRS_AT_ONCE = wp.constant(1 << 17)
"""Pairs of faces that a GPU works on at once, each by a thread of its own."""
_BITS_OF_PAIR = wp.constant(15)
"""Pairs of elements that two faces can represent: six of vertex and face, nine of edges."""


@wp.func
def _next(corner: int):
    return wp.where(corner == 2, 0, corner + 1)


@wp.func
def _has_vertex(faces: wp.array2d[int], face: int, vertex: int):
    return faces[face, 0] == vertex or faces[face, 1] == vertex or faces[face, 2] == vertex


@wp.func
def _corners(faces: wp.array2d[int], face: int) -> wp.vec3i:
    return wp.vec3i(faces[face, 0], faces[face, 1], faces[face, 2])


@wp.func
def _is_face(mesh: FaceHierarchy, place: int) -> bool:
    """Returns whether the cell at a place is a face; where all are, nothing is read."""
    if mesh.all_faces:
        return True
    return mesh.order[place] < mesh.face_count


@wp.func
def _count_filtered(mesh: FaceHierarchy, place: int, count: int):
    """Counts pairs of elements of the cell at a place that a filter leaves out by world, if that is to be known."""
    if mesh.filtered_of_worlds and count > 0:
        world = int(0)
        if mesh.places.first_world:
            world = mesh.places.first_world[place]
        wp.atomic_add(mesh.filtered_of_worlds, world, wp.int64(count))


@wp.func
def unseparated_vertices(mesh: FaceHierarchy, face: int, other: int):
    """Returns which corners of a face are vertices that it owns and no axis separates from another face, as bits.

    Those that a filter leaves out are bits 3 to 5 instead.
    """
    owned = mesh.owned[face]
    found = int(0)
    if owned & 7 == 0 or not _is_face(mesh, other):
        return found
    other_box = read_box(mesh.face_boxes, other)
    corners = int(3)  # not a constant, as the body would be repeated
    for corner in range(corners):
        if owns_vertex(owned, corner):
            box = read_box(mesh.vertex_boxes, 3 * face + corner)
            vertex = mesh.faces[face, corner]
            if not are_apart(box, other_box) and not _has_vertex(mesh.faces, other, vertex):
                if is_filtered(mesh.pair_filter, wp.vec3i(vertex), _corners(mesh.faces, other)):
                    found = found | (8 << corner)
                else:
                    found = found | (1 << corner)
    return found


@wp.func
def unseparated_edges(mesh: FaceHierarchy, face: int, other: int):
    """Returns which edges that two faces own no axis separates: bit 3 i + j for sides i and j.

    Those that a filter leaves out are bits 9 to 17 instead.
    """
    owned = mesh.owned[face]
    other_owned = mesh.owned[other]
    found = int(0)
    sides = wp.where(owned >> 3 == 0 or other_owned >> 3 == 0, 0, 3)
    place_box = read_box(mesh.places.boxes, other)
    for side in range(sides):
        if owns_edge(owned, side):
            box = read_box(mesh.edge_boxes, 3 * face + side)
            if not are_apart(box, place_box):
                a = mesh.faces[face, side]
                b = mesh.faces[face, _next(side)]
                for other_side in range(sides):
                    if owns_edge(other_owned, other_side):
                        c = mesh.faces[other, other_side]
                        d = mesh.faces[other, _next(other_side)]
                        if a != c and a != d and b != c and b != d:
                            other_box = read_box(mesh.edge_boxes, 3 * other + other_side)
                            if not are_apart(box, other_box):
                                bit = 3 * side + other_side
                                if is_filtered(mesh.pair_filter, wp.vec3i(a, b, b), wp.vec3i(c, d, d)):
                                    found = found | (512 << bit)
                                else:
                                    found = found | (1 << bit)
    return found


@wp.func
def _pair_elements(
    mesh: FaceHierarchy,
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    first: int,
    turns: int,
    # counts, in and out, and queues
    vertex_face_counts: wp.array[wp.int64],
    vertex_face: wp.array[wp.vec2i],
    edge_edge_counts: wp.array[wp.int64],
    edge_edge: wp.array[wp.vec2i],
):
    """Enqueues the candidates of some pairs of faces: ``first``, and each that is a warp further."""
    found = wp.uint64(0)
    queued = wp.vec2i()  # vertex-face, edge-edge
    filtered = wp.vec2i()
    for turn in range(turns):
        at = first + turn * _WIDTH
        if is_filled(at, face_pairs, face_pair_count, 0):
            face = face_pairs[at][0]
            other = face_pairs[at][1]
            vertices = unseparated_vertices(mesh, face, other)
            vertices = vertices | (unseparated_vertices(mesh, other, face) << 6)
            edges = unseparated_edges(mesh, face, other)
            filtered_vertices = count_set_bits(wp.uint32(vertices & 0o7070))
            filtered_edges = count_set_bits(wp.uint32(edges >> 9))
            filtered[0] += filtered_vertices
            filtered[1] += filtered_edges
            _count_filtered(mesh, face, filtered_vertices + filtered_edges)
            vertices = (vertices & 7) | ((vertices >> 3) & 56)
            edges = edges & 511
            queued[0] += count_set_bits(wp.uint32(vertices))
            queued[1] += count_set_bits(wp.uint32(edges))
            found = found | (wp.uint64(vertices | (edges << 6)) << wp.uint64(_BITS_OF_PAIR * turn))
    if mesh.pair_filter.group:
        raise_count(vertex_face_counts, _FILTERED, filtered[0])
        raise_count(edge_edge_counts, _FILTERED, filtered[1])
    vertex_face_slot = take_slots(vertex_face_counts, _QUEUED, queued[0])
    edge_edge_slot = take_slots(edge_edge_counts, _QUEUED, queued[1])
    while found != wp.uint64(0):
        bit = lowest_bit(found)
        found = found & (found - wp.uint64(1))
        at = first + (bit / _BITS_OF_PAIR) * _WIDTH
        bit = bit % _BITS_OF_PAIR
        face = face_pairs[at][0]
        other = face_pairs[at][1]
        if bit < 3:
            write(wp.vec2i(mesh.faces[face, bit], mesh.order[other]), vertex_face, vertex_face_slot)
            vertex_face_slot += wp.int64(1)
        elif bit < 6:
            write(wp.vec2i(mesh.faces[other, bit - 3], mesh.order[face]), vertex_face, vertex_face_slot)
            vertex_face_slot += wp.int64(1)
        else:
            edge = mesh.face_edges[face, (bit - 6) / 3]
            other_edge = mesh.face_edges[other, (bit - 6) % 3]
            write(wp.vec2i(wp.min(edge, other_edge), wp.max(edge, other_edge)), edge_edge, edge_edge_slot)
            edge_edge_slot += wp.int64(1)


# fewer registers than the 96 that the compiler takes, so that more warps hide the latency of memory
@wp.kernel(**NO_GRADIENTS, cuda_max_registers=64)
def pair_elements(
    mesh: FaceHierarchy,
    # in
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    # counts, in and out, and queues
    vertex_face_counts: wp.array[wp.int64],
    vertex_face: wp.array[wp.vec2i],
    edge_edge_counts: wp.array[wp.int64],
    edge_edge: wp.array[wp.vec2i],
    threads: int,
):
    """Enqueues the candidates of pairs of faces.

    A thread first finds all its pairs, then takes slots for them: where pairs of faces are many, a warp makes one
    atomic operation for 128 of them. Atomic operations on one address are serialized, so that fewer are faster.
    """
    i = wp.tid()
    count = filled_entries(face_pairs, face_pair_count, 0)
    turns = wp.clamp(count / _PAIRS_AT_ONCE, 1, _PAIRS_OF_THREAD)
    for first in range((i / _WIDTH) * turns * _WIDTH + i % _WIDTH, count, turns * threads):
        _pair_elements(
            mesh,
            face_pairs,
            face_pair_count,
            first,
            turns,
            vertex_face_counts,
            vertex_face,
            edge_edge_counts,
            edge_edge,
        )


@wp.func
def _pair_edges_with_face(
    mesh: FaceHierarchy,
    face: int,
    other: int,
    # in and out
    counts: wp.array[wp.int64],
    # out
    pairs: wp.array[wp.vec2i],
):
    """Enqueues the edges that a face owns with another face."""
    owned = mesh.owned[face]
    sides = wp.where(owned >> 3 == 0 or not _is_face(mesh, other), 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            row = 3 * face + side
            a = mesh.faces[face, side]
            b = mesh.faces[face, _next(side)]
            if not are_apart(read_box(mesh.edge_boxes, row), read_box(mesh.face_boxes, other)):
                if not _has_vertex(mesh.faces, other, a) and not _has_vertex(mesh.faces, other, b):
                    if is_filtered(mesh.pair_filter, wp.vec3i(a, b, b), _corners(mesh.faces, other)):
                        take_slot(counts, _FILTERED)
                    else:
                        append(wp.vec2i(mesh.face_edges[face, side], mesh.order[other]), pairs, counts, _QUEUED)


@wp.kernel(**NO_GRADIENTS)
def pair_edges_with_faces(
    mesh: FaceHierarchy,
    # in
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    # in and out
    counts: wp.array[wp.int64],
    # out
    pairs: wp.array[wp.vec2i],
    threads: int,
):
    """Enqueues the edges that two faces own, each with the other face, where their boxes overlap."""
    for i in range(wp.tid(), filled_entries(face_pairs, face_pair_count, 0), threads):
        face = face_pairs[i][0]
        other = face_pairs[i][1]
        _pair_edges_with_face(mesh, face, other, counts, pairs)
        _pair_edges_with_face(mesh, other, face, counts, pairs)


@wp.func
def _pair_point(
    mesh: FaceHierarchy,
    place: int,
    other: int,
    # in and out
    vertex_edge_counts: wp.array[wp.int64],
    # out
    vertex_edge: wp.array[wp.vec2i],
):
    """Enqueues a point with an edge that no face has, if the cells at two places are that."""
    cell = mesh.order[other]
    if mesh.order[place] >= mesh.point_start and cell >= mesh.face_count and cell < mesh.point_start:
        box = read_box(mesh.vertex_boxes, 3 * place)
        other_box = read_box(mesh.edge_boxes, 3 * other)
        if not are_apart(box, other_box):
            point = mesh.faces[place, 0]
            if is_filtered(mesh.pair_filter, wp.vec3i(point), _corners(mesh.faces, other)):
                take_slot(vertex_edge_counts, _FILTERED)
                _count_filtered(mesh, place, 1)
                return
            append(wp.vec2i(point, mesh.face_edges[other, 0]), vertex_edge, vertex_edge_counts, _QUEUED)


@wp.func
def _pair_two_points(
    mesh: FaceHierarchy,
    place: int,
    other: int,
    # in and out
    vertex_vertex_counts: wp.array[wp.int64],
    vertex_vertex: wp.array[wp.vec2i],
):
    """Enqueues two points, if the cells at two places are that."""
    if mesh.order[place] >= mesh.point_start and mesh.order[other] >= mesh.point_start and place != other:
        box = read_box(mesh.vertex_boxes, 3 * place)
        other_box = read_box(mesh.vertex_boxes, 3 * other)
        if not are_apart(box, other_box):
            p = mesh.faces[place, 0]
            q = mesh.faces[other, 0]
            if is_filtered(mesh.pair_filter, wp.vec3i(p), wp.vec3i(q)):
                take_slot(vertex_vertex_counts, _FILTERED)
                _count_filtered(mesh, place, 1)
                return
            append(wp.vec2i(wp.min(p, q), wp.max(p, q)), vertex_vertex, vertex_vertex_counts, _QUEUED)


@wp.kernel(**NO_GRADIENTS)
def pair_points(
    mesh: FaceHierarchy,
    # in
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    # counts, in and out, and queues
    vertex_edge_counts: wp.array[wp.int64],
    vertex_edge: wp.array[wp.vec2i],
    vertex_vertex_counts: wp.array[wp.int64],
    vertex_vertex: wp.array[wp.vec2i],
    threads: int,
):
    """Enqueues the points among two cells, with an edge that no face has or with another point."""
    for i in range(wp.tid(), filled_entries(face_pairs, face_pair_count, 0), threads):
        place = face_pairs[i][0]
        other = face_pairs[i][1]
        _pair_point(mesh, place, other, vertex_edge_counts, vertex_edge)
        _pair_point(mesh, other, place, vertex_edge_counts, vertex_edge)
        _pair_two_points(mesh, place, other, vertex_vertex_counts, vertex_vertex)
