"""The broad phase: pairs of mesh elements whose swept boxes overlap, by a bounding volume hierarchy over the faces."""

import functools

import warp as wp

from .kernels.pairs import boxes_overlap, owns_edge, owns_vertex
from .kernels.queues import append, is_filled, take_slots, write
from .launching import launch_over, launch_over_queue

__all__ = ["BroadPhase"]

_LARGEST_FLOAT = wp.constant(wp.float64(3.4028234663852886e38))

_CHUNK = wp.constant(16)

_KERNEL = {"enable_backward": False, "module": "unique"}


@wp.kernel(**_KERNEL)
def _pair_faces(
    first: int,
    bvh: wp.uint64,
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    worlds: wp.array[int],
    counts: wp.array[wp.int64],
    count: int,
    pairs: wp.array[wp.vec2i],
):
    """Slots are taken by the chunk, because one atomic for each pair takes longer than the traversal."""
    face = first + wp.tid()
    root = int(-1)
    if worlds:
        root = wp.bvh_get_group_root(bvh, worlds[face])
    query = wp.bvh_query_aabb(bvh, lowers[face], uppers[face], root)
    other = int(0)
    slot = wp.int64(0)
    end = wp.int64(0)
    while wp.bvh_query_next(query, other):
        if face < other:
            if slot == end:
                slot = take_slots(counts, count, _CHUNK)
                end = slot + wp.int64(_CHUNK)
            write(wp.vec2i(face, other), pairs, slot)
            slot += wp.int64(1)
    while slot < end:
        write(wp.vec2i(-1, -1), pairs, slot)
        slot += wp.int64(1)


@functools.cache
def _swept_boxes(dtype):
    """The kernel that boxes moving elements, for one type of position."""

    @wp.func
    def rounded(x: dtype):
        # to nearest, not outwards: rounding and clamping are monotone, so what overlaps still does
        largest = _LARGEST_FLOAT
        return wp.vec3(
            wp.float32(wp.clamp(wp.float64(x[0]), -largest, largest)),
            wp.float32(wp.clamp(wp.float64(x[1]), -largest, largest)),
            wp.float32(wp.clamp(wp.float64(x[2]), -largest, largest)),
        )

    @wp.kernel(**_KERNEL)
    def swept_boxes(
        first: int,
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        lowers: wp.array[wp.vec3],
        uppers: wp.array[wp.vec3],
    ):
        i = first + wp.tid()
        vertex = elements[i, 0]
        low = wp.min(x0[vertex], x1[vertex])
        high = wp.max(x0[vertex], x1[vertex])
        for j in range(1, elements.shape[1]):
            vertex = elements[i, j]
            low = wp.min(low, wp.min(x0[vertex], x1[vertex]))
            high = wp.max(high, wp.max(x0[vertex], x1[vertex]))
        lowers[i] = rounded(low)
        uppers[i] = rounded(high)

    return swept_boxes


@wp.struct
class _Mesh:
    """What the pairing kernels need of a mesh: connectivity, representatives and boxes."""

    faces: wp.array2d[int]
    face_edges: wp.array2d[int]
    owned: wp.array[int]
    vertex_lowers: wp.array[wp.vec3]
    vertex_uppers: wp.array[wp.vec3]
    edge_lowers: wp.array[wp.vec3]
    edge_uppers: wp.array[wp.vec3]
    face_lowers: wp.array[wp.vec3]
    face_uppers: wp.array[wp.vec3]


@wp.func
def _next(corner: int):
    return wp.where(corner == 2, 0, corner + 1)


@wp.func
def _has_vertex(faces: wp.array2d[int], face: int, vertex: int):
    return faces[face, 0] == vertex or faces[face, 1] == vertex or faces[face, 2] == vertex


@wp.func
def _overlapping_vertices(mesh: _Mesh, face: int, other: int):
    """Which corners of a face are vertices that it owns and that are to be paired with another face, as bits."""
    owned = mesh.owned[face]
    low = mesh.face_lowers[other]
    high = mesh.face_uppers[other]
    found = int(0)
    corners = wp.where(owned & 7 == 0, 0, 3)
    for corner in range(corners):
        if owns_vertex(owned, corner):
            vertex = mesh.faces[face, corner]
            if boxes_overlap(mesh.vertex_lowers[vertex], mesh.vertex_uppers[vertex], low, high):
                if not _has_vertex(mesh.faces, other, vertex):
                    found = found | (1 << corner)
    return found


@wp.func
def _overlapping_edges(mesh: _Mesh, face: int, other: int):
    """Which edges of a face and of another, each of its own, are to be paired: bit 3 i + j for sides i and j."""
    owned = mesh.owned[face]
    other_owned = mesh.owned[other]
    found = int(0)
    sides = wp.where(owned >> 3 == 0 or other_owned >> 3 == 0, 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            edge = mesh.face_edges[face, side]
            low = mesh.edge_lowers[edge]
            high = mesh.edge_uppers[edge]
            if boxes_overlap(low, high, mesh.face_lowers[other], mesh.face_uppers[other]):
                a = mesh.faces[face, side]
                b = mesh.faces[face, _next(side)]
                for other_side in range(sides):
                    if owns_edge(other_owned, other_side):
                        edge = mesh.face_edges[other, other_side]
                        if boxes_overlap(low, high, mesh.edge_lowers[edge], mesh.edge_uppers[edge]):
                            c = mesh.faces[other, other_side]
                            d = mesh.faces[other, _next(other_side)]
                            if a != c and a != d and b != c and b != d:
                                found = found | (1 << (3 * side + other_side))
    return found


@wp.func
def _bit_count(bits: int):
    count = int(0)
    while bits != 0:
        bits = bits & (bits - 1)
        count += 1
    return count


@wp.kernel(**_KERNEL)
def _pair_elements(
    first: int,
    mesh: _Mesh,
    face_pairs: wp.array[wp.vec2i],
    counts: wp.array[wp.int64],
    face_pair_count: int,
    vertex_face_count: int,
    edge_edge_count: int,
    vertex_face: wp.array[wp.vec2i],
    edge_edge: wp.array[wp.vec2i],
):
    """First finds all pairs, then takes slots for them, so that the threads of a warp can do so together."""
    i = first + wp.tid()
    face = int(-1)
    other = int(-1)
    if is_filled(i, face_pairs, counts, face_pair_count):
        face = face_pairs[i][0]
        other = face_pairs[i][1]
    vertices = int(0)
    other_vertices = int(0)
    edges = int(0)
    if face >= 0:
        vertices = _overlapping_vertices(mesh, face, other)
        other_vertices = _overlapping_vertices(mesh, other, face)
        edges = _overlapping_edges(mesh, face, other)
    slot = take_slots(counts, vertex_face_count, _bit_count(vertices) + _bit_count(other_vertices))
    edge_slot = take_slots(counts, edge_edge_count, _bit_count(edges))
    if vertices != 0 or other_vertices != 0:
        corners = int(3)
        for corner in range(corners):
            if (vertices >> corner) & 1 == 1:
                write(wp.vec2i(mesh.faces[face, corner], other), vertex_face, slot)
                slot += wp.int64(1)
            if (other_vertices >> corner) & 1 == 1:
                write(wp.vec2i(mesh.faces[other, corner], face), vertex_face, slot)
                slot += wp.int64(1)
    while edges != 0:
        bit = _bit_count((edges & -edges) - 1)
        edges = edges & (edges - 1)
        edge = mesh.face_edges[face, bit / 3]
        other_edge = mesh.face_edges[other, bit % 3]
        write(wp.vec2i(wp.min(edge, other_edge), wp.max(edge, other_edge)), edge_edge, edge_slot)
        edge_slot += wp.int64(1)


@wp.func
def _pair_edges_with_face(
    mesh: _Mesh, face: int, other: int, counts: wp.array[wp.int64], count: int, pairs: wp.array[wp.vec2i]
):
    """Enqueues the edges that a face owns with another face."""
    owned = mesh.owned[face]
    sides = wp.where(owned >> 3 == 0, 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            edge = mesh.face_edges[face, side]
            a = mesh.faces[face, side]
            b = mesh.faces[face, _next(side)]
            if boxes_overlap(
                mesh.edge_lowers[edge], mesh.edge_uppers[edge], mesh.face_lowers[other], mesh.face_uppers[other]
            ):
                if not _has_vertex(mesh.faces, other, a) and not _has_vertex(mesh.faces, other, b):
                    append(wp.vec2i(edge, other), pairs, counts, count)


@wp.kernel(**_KERNEL)
def _pair_edges_with_faces(
    first: int,
    mesh: _Mesh,
    face_pairs: wp.array[wp.vec2i],
    counts: wp.array[wp.int64],
    face_pair_count: int,
    count: int,
    pairs: wp.array[wp.vec2i],
):
    i = first + wp.tid()
    if not is_filled(i, face_pairs, counts, face_pair_count):
        return
    face = face_pairs[i][0]
    other = face_pairs[i][1]
    if face >= 0:
        _pair_edges_with_face(mesh, face, other, counts, count, pairs)
        _pair_edges_with_face(mesh, other, face, counts, count, pairs)


class BroadPhase:
    """Finds the candidate pairs of a mesh: those that share no vertex and whose swept boxes overlap.

    Only enqueues: counts stay on the device, and the caller provides the queues. Boxes are in single precision,
    rounded so that no overlap is lost.
    """

    def __init__(self, mesh):
        self._device = mesh.device
        self._elements = mesh.device_vertices, mesh.device_edges, mesh.device_faces
        boxes = [
            wp.empty(len(elements), dtype=wp.vec3, device=mesh.device) for elements in self._elements for _ in range(2)
        ]
        self._mesh = _Mesh()
        self._mesh.faces = mesh.device_faces
        self._mesh.face_edges = mesh.device_face_edges
        self._mesh.owned = mesh.device_owned
        self._mesh.vertex_lowers, self._mesh.vertex_uppers = boxes[0:2]
        self._mesh.edge_lowers, self._mesh.edge_uppers = boxes[2:4]
        self._mesh.face_lowers, self._mesh.face_uppers = boxes[4:6]
        self._boxes = boxes
        self._worlds = mesh.device_world
        self._bvh = None

    def pair_faces(self, x0, x1, counts, count, pairs):
        """Boxes all elements, and enqueues the pairs of faces whose swept boxes overlap, each once."""
        *_, faces = self._elements
        if len(faces) == 0:
            return
        for elements, boxes in zip(self._elements, (self._boxes[:2], self._boxes[2:4], self._boxes[4:]), strict=True):
            inputs = [x0, x1, elements]
            launch_over(_swept_boxes(x0.dtype), len(elements), inputs=inputs, outputs=boxes, device=self._device)
        if self._bvh is None:
            self._bvh = wp.Bvh(*self._boxes[4:], groups=self._worlds)
        else:
            self._bvh.rebuild()
        inputs = [self._bvh.id, *self._boxes[4:], self._worlds, counts, count]
        launch_over(_pair_faces, len(faces), inputs=inputs, outputs=[pairs], device=self._device)

    def pair_elements(self, face_pairs, counts, face_pair_count, vertex_face_count, edge_edge_count, queues):
        """Enqueues the candidates, (vertex, face) and (edge, edge) with the smaller first, of pairs of faces."""
        inputs = [self._mesh, face_pairs, counts, face_pair_count, vertex_face_count, edge_edge_count]
        launch_over_queue(_pair_elements, face_pairs, counts, face_pair_count, inputs=inputs, outputs=queues)

    def pair_edges_with_faces(self, face_pairs, counts, face_pair_count, count, pairs):
        """Enqueues the pairs (edge, face) that share no vertex and whose boxes overlap, of pairs of faces."""
        inputs = [self._mesh, face_pairs, counts, face_pair_count, count]
        launch_over_queue(_pair_edges_with_faces, face_pairs, counts, face_pair_count, inputs=inputs, outputs=[pairs])
