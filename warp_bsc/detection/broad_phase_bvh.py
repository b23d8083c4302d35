"""The broad phase of a GPU: one traversal of a bounding volume hierarchy over the faces finds all pairs of elements."""

import functools

import warp as wp

from ..kernels.pipeline.boxes import boxes_apart, boxes_overlap, rounded
from ..kernels.pipeline.pairs import owns_edge, owns_vertex
from ..kernels.pipeline.queues import append, is_filled, take_slots, write
from .narrow_phase import Count, roomy

__all__ = ["BvhBroadPhase"]

_CANDIDATES = wp.constant(int(Count.CANDIDATES))
_NEAR = wp.constant(int(Count.NEAR))

_CHUNK = wp.constant(16)
_CHUNK_SLOTS = wp.constant(wp.int64(16))
"""Slots of face pairs that a thread takes at once, in both types: Warp reads a constant that a kernel both converts and
uses as it is before it is set."""

_KERNEL = {"enable_backward": False, "module": "unique"}


@wp.func
def _has_changed(changed: wp.array[int], faces: wp.array2d[int], face: int):
    return changed[faces[face, 0]] + changed[faces[face, 1]] + changed[faces[face, 2]] != 0


@wp.kernel(**_KERNEL)
def _pair_faces(
    bvh: wp.uint64,
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    worlds: wp.array[int],
    faces: wp.array2d[int],
    changed: wp.array[int],
    count: wp.array[wp.int64],
    pairs: wp.array[wp.vec2i],
):
    """Slots are taken by the chunk, because one atomic for each pair takes longer than the traversal."""
    face = wp.tid()
    if changed:
        if not _has_changed(changed, faces, face):
            return
    root = int(-1)
    if worlds:
        root = wp.bvh_get_group_root(bvh, worlds[face])
    query = wp.bvh_query_aabb(bvh, lowers[face], uppers[face], root)
    other = int(0)
    slot = wp.int64(0)
    end = wp.int64(0)
    while wp.bvh_query_next(query, other):
        wanted = face < other
        if changed and other < face:
            wanted = not _has_changed(changed, faces, other)
        if wanted:
            if slot == end:
                slot = take_slots(count, 0, _CHUNK)
                end = slot + _CHUNK_SLOTS
            write(wp.vec2i(face, other), pairs, slot)
            slot += wp.int64(1)
    while slot < end:
        write(wp.vec2i(-1, -1), pairs, slot)
        slot += wp.int64(1)


@wp.struct
class _Mesh:
    """Connectivity, representatives, and the boxes of elements at the start and at the end.

    Boxes are rows of four: the lowest and the highest coordinates at the start, then at the end.
    """

    faces: wp.array2d[int]
    edges: wp.array2d[int]
    face_edges: wp.array2d[int]
    owned: wp.array[int]
    vertex_boxes: wp.array2d[wp.vec3]
    edge_boxes: wp.array2d[wp.vec3]
    face_boxes: wp.array2d[wp.vec3]
    face_lowers: wp.array[wp.vec3]
    face_uppers: wp.array[wp.vec3]


@functools.cache
def _box_elements(dtype):
    """The kernel that boxes moving elements, for one type of position."""

    @wp.kernel(**_KERNEL)
    def box_elements(x0: wp.array[dtype], x1: wp.array[dtype], mesh: _Mesh):
        i = wp.tid()
        if i < mesh.vertex_boxes.shape[0]:
            start = rounded(x0[i])
            end = rounded(x1[i])
            mesh.vertex_boxes[i, 0] = start
            mesh.vertex_boxes[i, 1] = start
            mesh.vertex_boxes[i, 2] = end
            mesh.vertex_boxes[i, 3] = end
        if i < mesh.edges.shape[0]:
            a = mesh.edges[i, 0]
            b = mesh.edges[i, 1]
            mesh.edge_boxes[i, 0] = rounded(wp.min(x0[a], x0[b]))
            mesh.edge_boxes[i, 1] = rounded(wp.max(x0[a], x0[b]))
            mesh.edge_boxes[i, 2] = rounded(wp.min(x1[a], x1[b]))
            mesh.edge_boxes[i, 3] = rounded(wp.max(x1[a], x1[b]))
        if i < mesh.faces.shape[0]:
            a = mesh.faces[i, 0]
            b = mesh.faces[i, 1]
            c = mesh.faces[i, 2]
            low0 = rounded(wp.min(wp.min(x0[a], x0[b]), x0[c]))
            high0 = rounded(wp.max(wp.max(x0[a], x0[b]), x0[c]))
            low1 = rounded(wp.min(wp.min(x1[a], x1[b]), x1[c]))
            high1 = rounded(wp.max(wp.max(x1[a], x1[b]), x1[c]))
            mesh.face_boxes[i, 0] = low0
            mesh.face_boxes[i, 1] = high0
            mesh.face_boxes[i, 2] = low1
            mesh.face_boxes[i, 3] = high1
            mesh.face_lowers[i] = wp.min(low0, low1)
            mesh.face_uppers[i] = wp.max(high0, high1)

    return box_elements


@wp.func
def _low(boxes: wp.array2d[wp.vec3], i: int):
    """The lowest coordinates over the time of the motion."""
    return wp.min(boxes[i, 0], boxes[i, 2])


@wp.func
def _high(boxes: wp.array2d[wp.vec3], i: int):
    """The highest coordinates over the time of the motion."""
    return wp.max(boxes[i, 1], boxes[i, 3])


@wp.func
def _apart(boxes: wp.array2d[wp.vec3], i: int, other_boxes: wp.array2d[wp.vec3], j: int):
    return boxes_apart(
        boxes[i, 0],
        boxes[i, 1],
        boxes[i, 2],
        boxes[i, 3],
        other_boxes[j, 0],
        other_boxes[j, 1],
        other_boxes[j, 2],
        other_boxes[j, 3],
    )


@wp.func
def _next(corner: int):
    return wp.where(corner == 2, 0, corner + 1)


@wp.func
def _has_vertex(faces: wp.array2d[int], face: int, vertex: int):
    return faces[face, 0] == vertex or faces[face, 1] == vertex or faces[face, 2] == vertex


@wp.func
def _overlapping_vertices(mesh: _Mesh, face: int, other: int, keep_apart: bool):
    """Which corners of a face are vertices that it owns and whose boxes overlap that of another face, as bits.

    Those that no axis separates, or all with ``keep_apart``, are bits 3 to 5 as well.
    """
    owned = mesh.owned[face]
    low = mesh.face_lowers[other]
    high = mesh.face_uppers[other]
    found = int(0)
    corners = wp.where(owned & 7 == 0, 0, 3)
    for corner in range(corners):
        if owns_vertex(owned, corner):
            vertex = mesh.faces[face, corner]
            if boxes_overlap(_low(mesh.vertex_boxes, vertex), _high(mesh.vertex_boxes, vertex), low, high):
                if not _has_vertex(mesh.faces, other, vertex):
                    found = found | (1 << corner)
                    if keep_apart or not _apart(mesh.vertex_boxes, vertex, mesh.face_boxes, other):
                        found = found | (8 << corner)
    return found


@wp.func
def _overlapping_edges(mesh: _Mesh, face: int, other: int, keep_apart: bool):
    """Which edges of a face and of another, each of its own, have overlapping boxes: bit 3 i + j for sides i and j.

    Those that no axis separates, or all with ``keep_apart``, are bits 9 to 17 as well.
    """
    owned = mesh.owned[face]
    other_owned = mesh.owned[other]
    found = int(0)
    sides = wp.where(owned >> 3 == 0 or other_owned >> 3 == 0, 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            edge = mesh.face_edges[face, side]
            low = _low(mesh.edge_boxes, edge)
            high = _high(mesh.edge_boxes, edge)
            if boxes_overlap(low, high, mesh.face_lowers[other], mesh.face_uppers[other]):
                a = mesh.faces[face, side]
                b = mesh.faces[face, _next(side)]
                for other_side in range(sides):
                    if owns_edge(other_owned, other_side):
                        other_edge = mesh.face_edges[other, other_side]
                        if boxes_overlap(
                            low, high, _low(mesh.edge_boxes, other_edge), _high(mesh.edge_boxes, other_edge)
                        ):
                            c = mesh.faces[other, other_side]
                            d = mesh.faces[other, _next(other_side)]
                            if a != c and a != d and b != c and b != d:
                                bit = 3 * side + other_side
                                found = found | (1 << bit)
                                if keep_apart or not _apart(mesh.edge_boxes, edge, mesh.edge_boxes, other_edge):
                                    found = found | (512 << bit)
    return found


@wp.func
def _bit_count(bits: int):
    count = int(0)
    while bits != 0:
        bits = bits & (bits - 1)
        count += 1
    return count


@wp.func
def _lowest_bit(bits: int):
    """The place of the lowest bit that is set."""
    return _bit_count((bits & -bits) - 1)


@wp.kernel(**_KERNEL)
def _pair_elements(
    mesh: _Mesh,
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    keep_apart: bool,
    vertex_face_counts: wp.array[wp.int64],
    vertex_face: wp.array[wp.vec2i],
    edge_edge_counts: wp.array[wp.int64],
    edge_edge: wp.array[wp.vec2i],
):
    """First finds all pairs, then takes slots for them, so that the threads of a warp can do so together."""
    i = wp.tid()
    face = int(-1)
    other = int(-1)
    if is_filled(i, face_pairs, face_pair_count, 0):
        face = face_pairs[i][0]
        other = face_pairs[i][1]
    vertices = int(0)
    edges = int(0)
    if face >= 0:
        vertices = _overlapping_vertices(mesh, face, other, keep_apart)
        vertices = vertices | (_overlapping_vertices(mesh, other, face, keep_apart) << 6)
        edges = _overlapping_edges(mesh, face, other, keep_apart)
    take_slots(vertex_face_counts, _CANDIDATES, _bit_count(vertices & 455))
    take_slots(edge_edge_counts, _CANDIDATES, _bit_count(edges & 511))
    # of the rest only what no axis separates
    vertices = ((vertices >> 3) & 7) | ((vertices >> 6) & 56)
    edges = edges >> 9
    slot = take_slots(vertex_face_counts, _NEAR, _bit_count(vertices))
    while vertices != 0:
        corner = _lowest_bit(vertices)
        vertices = vertices & (vertices - 1)
        if corner < 3:
            write(wp.vec2i(mesh.faces[face, corner], other), vertex_face, slot)
        else:
            write(wp.vec2i(mesh.faces[other, corner - 3], face), vertex_face, slot)
        slot += wp.int64(1)
    slot = take_slots(edge_edge_counts, _NEAR, _bit_count(edges))
    while edges != 0:
        bit = _lowest_bit(edges)
        edges = edges & (edges - 1)
        edge = mesh.face_edges[face, bit / 3]
        other_edge = mesh.face_edges[other, bit % 3]
        write(wp.vec2i(wp.min(edge, other_edge), wp.max(edge, other_edge)), edge_edge, slot)
        slot += wp.int64(1)


@wp.func
def _pair_edges_with_face(mesh: _Mesh, face: int, other: int, counts: wp.array[wp.int64], pairs: wp.array[wp.vec2i]):
    """Enqueues the edges that a face owns with another face."""
    owned = mesh.owned[face]
    sides = wp.where(owned >> 3 == 0, 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            edge = mesh.face_edges[face, side]
            a = mesh.faces[face, side]
            b = mesh.faces[face, _next(side)]
            if boxes_overlap(
                _low(mesh.edge_boxes, edge),
                _high(mesh.edge_boxes, edge),
                mesh.face_lowers[other],
                mesh.face_uppers[other],
            ):
                if not _has_vertex(mesh.faces, other, a) and not _has_vertex(mesh.faces, other, b):
                    append(wp.vec2i(edge, other), pairs, counts, _NEAR)


@wp.kernel(**_KERNEL)
def _pair_edges_with_faces(
    mesh: _Mesh,
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    counts: wp.array[wp.int64],
    pairs: wp.array[wp.vec2i],
):
    i = wp.tid()
    if not is_filled(i, face_pairs, face_pair_count, 0):
        return
    face = face_pairs[i][0]
    other = face_pairs[i][1]
    if face >= 0:
        _pair_edges_with_face(mesh, face, other, counts, pairs)
        _pair_edges_with_face(mesh, other, face, counts, pairs)


class BvhBroadPhase:
    """Finds the candidate pairs of a mesh: those that share no vertex and whose swept boxes overlap.

    Only enqueues: counts stay on the device, and the caller provides the queues of the results. Boxes are in single
    precision, rounded so that no overlap is lost.

    Attributes:
        queues: All arrays that a run writes to and that may be replaced.
    """

    def __init__(self, mesh, count):
        """Makes room for the boxes.

        Args:
            mesh: The collision mesh.
            count: Array of one int64, zero before each run.
        """
        device = mesh.device
        self._device = device
        self._worlds = mesh.device_face_world
        self._count = count
        self._mesh = _Mesh()
        self._mesh.faces = mesh.device_faces
        self._mesh.edges = mesh.device_edges
        self._mesh.face_edges = mesh.device_face_edges
        self._mesh.owned = mesh.device_owned
        faces, edges = len(mesh.faces), len(mesh.edges)
        self._mesh.vertex_boxes = wp.empty((mesh.vertex_count, 4), dtype=wp.vec3, device=device)
        self._mesh.edge_boxes = wp.empty((edges, 4), dtype=wp.vec3, device=device)
        self._mesh.face_boxes = wp.empty((faces, 4), dtype=wp.vec3, device=device)
        self._mesh.face_lowers = wp.empty(faces, dtype=wp.vec3, device=device)
        self._mesh.face_uppers = wp.empty(faces, dtype=wp.vec3, device=device)
        self._most = max(mesh.vertex_count, edges, faces)
        self._bvh = None
        self.queues = [wp.empty(8 * faces, dtype=wp.vec2i, device=device)]

    @property
    def capacity(self):
        """How much room there is for what the count counts."""
        return len(self.queues[0])

    def grow(self, count):
        """Makes the queue large enough for the count."""
        if count > self.capacity:
            self.queues = [wp.empty(roomy(count), dtype=wp.vec2i, device=self._device)]

    def pair_elements(
        self, x0, x1, vertex_face_counts, vertex_face, edge_edge_counts, edge_edge, *, refit=False, changed=None
    ):
        """Counts the candidates, and enqueues those that no coordinate axis separates at the start and at the end.

        Args:
            x0: Positions at the start, Warp array of vec3 or vec3d.
            x1: Positions at the end, of the same type.
            vertex_face_counts: By :class:`Count`, array of int64.
            vertex_face: Queue for (vertex, face), array of vec2i.
            edge_edge_counts: By :class:`Count`, array of int64.
            edge_edge: Queue for (edge, edge), the smaller first, array of vec2i.
            refit: Whether to keep the hierarchy of the run before and only refit its boxes, which is as right and
                allocates nothing, but slows down what follows if much has moved.
            changed: Nonzero for each vertex that pairs are wanted of, array of int, of whose faces all pairs are
                found; None for all.
        """
        self._pair_faces(x0, x1, refit, changed)
        self._launch_over_pairs(_pair_elements, False, vertex_face_counts, vertex_face, edge_edge_counts, edge_edge)

    def pair_overlapping_elements(self, vertex_face_counts, vertex_face, edge_edge_counts, edge_edge):
        """Enqueues all candidates of the last run, with arguments as of :meth:`pair_elements`."""
        self._launch_over_pairs(_pair_elements, True, vertex_face_counts, vertex_face, edge_edge_counts, edge_edge)

    def pair_edges_with_faces(self, x, counts, pairs):
        """Enqueues the pairs (edge, face) of one configuration that share no vertex and whose boxes overlap.

        Args:
            x: Positions, Warp array of vec3 or vec3d.
            counts: By :class:`Count`, array of int64.
            pairs: Queue for (edge, face), array of vec2i.
        """
        self._pair_faces(x, x, False)
        self._launch_over_pairs(_pair_edges_with_faces, counts, pairs)

    def _pair_faces(self, x0, x1, refit, changed=None):
        """Boxes all elements, and enqueues the pairs of faces whose swept boxes overlap, each once."""
        faces = len(self._mesh.faces)
        if faces == 0:
            return
        inputs = [x0, x1, self._mesh]
        wp.launch(_box_elements(x0.dtype), self._most, inputs=inputs, device=self._device, record_tape=False)
        boxes = self._mesh.face_lowers, self._mesh.face_uppers
        if self._bvh is None:
            self._bvh = wp.Bvh(*boxes, groups=self._worlds)
        elif refit:
            self._bvh.refit()
        else:
            self._bvh.rebuild()
        inputs = [self._bvh.id, *boxes, self._worlds, self._mesh.faces, changed, self._count, *self.queues]
        wp.launch(_pair_faces, faces, inputs=inputs, device=self._device, record_tape=False)

    def _launch_over_pairs(self, kernel, *arguments):
        (face_pairs,) = self.queues
        inputs = [self._mesh, face_pairs, self._count, *arguments]
        wp.launch(kernel, len(face_pairs), inputs=inputs, device=self._device, record_tape=False)
