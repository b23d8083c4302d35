"""The broad phase of a GPU: one traversal of a hierarchy of boxes over the faces finds all pairs of elements.

The hierarchy is made once, from the connectivity of the mesh, see :mod:`.face_order`: patches of connected faces stay
compact however a mesh moves. A run only fits its boxes. Edges that no face has and points have places as well, as faces
that have collapsed: the cells of the mesh are its faces, then these edges, then the points. Cells without neighbours
have no such order, and are compared by brute force in the worst case, 1,024 pairs of cells at a time.
"""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ..kernels.pipeline.bits import lowest_bit
from ..kernels.pipeline.boxes import (
    BoxRows,
    boxes_apart,
    boxes_overlap,
    lowered,
    raised,
    read_box,
    rounded,
    write_box,
)
from ..kernels.pipeline.hierarchy import (
    WIDTH,
    HierarchyLevel,
    changed_children,
    count_places,
    fit_parent,
    from_place,
    lowest_place,
    overlapping_children,
    overlapping_faces,
)
from ..kernels.pipeline.pairs import owns_edge, owns_vertex
from ..kernels.pipeline.queues import append, is_filled, raise_count, take_slot, take_slots, write
from .launch import launch, made_once, most_blocks
from .mesh import CollisionMesh
from .settings import NO_GRADIENTS, Count, capacity_for

__all__ = [
    "BroadPhaseHierarchy",
    "FaceHierarchy",
    "overlapping_edges",
    "overlapping_vertices",
    "traversal_kernel",
]

_CANDIDATES = wp.constant(int(Count.CANDIDATES))
_QUEUED = wp.constant(int(Count.QUEUED))

_WIDTH = wp.constant(WIDTH)

_PAIRS_OF_THREAD = wp.constant(4)
"""Most pairs of faces whose elements a thread pairs."""
_PAIRS_AT_ONCE = wp.constant(1 << 17)
"""Pairs of faces that a GPU works on at once, each by a thread of its own."""
_BITS_OF_PAIR = wp.constant(15)
"""Pairs of elements that two faces can represent: six of vertex and face, nine of edges."""

_UNGROUPED = 8
"""Number of groups up to which their boxes are not worth a launch, and all of them are traversed."""

_WARPS_OF_MULTIPROCESSOR = 64
"""Warps that a multiprocessor of a GPU should have at least in a traversal."""
_MOST_WARPS_OF_CLUSTER = 8
_TRAVERSAL_BLOCK = 64


@wp.struct
class FaceHierarchy:
    """The faces in the order of their places, the boxes of elements, and the nodes above the faces.

    Boxes are rows of four: the lowest and the highest coordinates at the start, then at the end. Those of vertices and
    edges lie beside one another where the face is that represents them: row ``3 place + corner`` or side. Other rows
    are not set.

    Attributes:
        all_faces: Whether all cells are faces.
        only_free: Whether only pairs with a cell that is no face are wanted.
        face_count: Number of faces; greater cells are edges.
        point_start: First cell that is a point.
        order: Cell at each place, -1 for none.
        faces: Vertices of the face at each place.
        face_edges: Edges of the face at each place.
        owned: What the face at each place is the representative of.
        edges: Vertices of each edge.
        vertex_rows: Row of each vertex in ``vertex_boxes``, -1 if no face uses it.
        edge_rows: Row of each edge in ``edge_boxes``.
        vertex_boxes: Boxes of the vertices that each face represents.
        edge_boxes: Boxes of the edges that each face represents.
        face_boxes: Box of the face at each place.
        places: Level of the faces.
        clusters: Level above.
        groups: Highest level; without arrays in a small mesh, where all groups are traversed.
    """

    all_faces: wp.bool
    only_free: wp.bool
    face_count: int
    point_start: int
    order: wp.array[int]
    faces: wp.array2d[int]
    face_edges: wp.array2d[int]
    owned: wp.array[int]
    edges: wp.array2d[int]
    vertex_rows: wp.array[int]
    edge_rows: wp.array[int]
    vertex_boxes: wp.array2d[wp.vec3]
    edge_boxes: wp.array2d[wp.vec3]
    face_boxes: wp.array2d[wp.vec3]
    places: HierarchyLevel
    clusters: HierarchyLevel
    groups: HierarchyLevel


@wp.func
def empty_box() -> BoxRows:
    """A box that overlaps none."""
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    return wp.matrix_from_rows(low, -low, low, -low)


@made_once
def _box_elements(dtype: type, padded: bool) -> wp.Kernel:
    """The kernel that boxes moving elements and clusters, for one type of position, with or without a padding.

    Its threads are the places of faces, then the edges, then the vertices.
    """

    @wp.func
    def padding_of(padding: wp.array[wp.float64], vertex: int) -> wp.float64:
        """Returns the padding of a vertex; without one the array is not read."""
        if wp.static(padded):
            return padding[vertex]
        return wp.float64(0.0)

    @wp.func
    def lowest(x: Any, pad: wp.float64) -> wp.vec3:
        if wp.static(padded):
            return lowered(x, pad)
        return rounded(x)

    @wp.func
    def highest(x: Any, pad: wp.float64) -> wp.vec3:
        if wp.static(padded):
            return raised(x, pad)
        return rounded(x)

    @wp.func
    def is_finite(x0: wp.array[dtype], x1: wp.array[dtype], vertex: int) -> bool:
        return wp.isfinite(x0[vertex]) and wp.isfinite(x1[vertex])

    @wp.func
    def box_of_two(
        x0: wp.array[dtype], x1: wp.array[dtype], padding: wp.array[wp.float64], a: int, b: int, finite: bool
    ) -> BoxRows:
        """Returns the box of two vertices, an empty one if that is not finite."""
        if finite:
            pad = wp.max(padding_of(padding, a), padding_of(padding, b))
            return wp.matrix_from_rows(
                lowest(wp.min(x0[a], x0[b]), pad),
                highest(wp.max(x0[a], x0[b]), pad),
                lowest(wp.min(x1[a], x1[b]), pad),
                highest(wp.max(x1[a], x1[b]), pad),
            )
        return empty_box()

    @wp.kernel(**NO_GRADIENTS)
    def box_elements(
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        changed: wp.array[int],
        checked: wp.array[int],
        padding: wp.array[wp.float64],
        # in and out
        mesh: FaceHierarchy,
        # out
        not_finite: wp.array[wp.int64],
    ):
        i = wp.tid()
        finite = bool(True)  # here, as Warp selects between the values before and after a branch
        places = mesh.order.shape[0]
        if i < places:  # the same for all threads of a warp
            low = wp.vec3(wp.inf, wp.inf, wp.inf)
            high = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
            has_changed = int(0)
            if mesh.order[i] >= 0:
                a = mesh.faces[i, 0]
                b = mesh.faces[i, 1]
                c = mesh.faces[i, 2]
                pad = wp.max(wp.max(padding_of(padding, a), padding_of(padding, b)), padding_of(padding, c))
                low0 = lowest(wp.min(wp.min(x0[a], x0[b]), x0[c]), pad)
                high0 = highest(wp.max(wp.max(x0[a], x0[b]), x0[c]), pad)
                low1 = lowest(wp.min(wp.min(x1[a], x1[b]), x1[c]), pad)
                high1 = highest(wp.max(wp.max(x1[a], x1[b]), x1[c]), pad)
                finite = is_finite(x0, x1, a) and is_finite(x0, x1, b) and is_finite(x0, x1, c)
                if not finite:  # the place covers the other elements that it represents
                    low0 = low
                    high0 = high
                    low1 = low
                    high1 = high
                    for corner in range(3):
                        vertex = mesh.faces[i, corner]
                        if is_finite(x0, x1, vertex):
                            low0 = wp.min(low0, lowest(x0[vertex], pad))
                            high0 = wp.max(high0, highest(x0[vertex], pad))
                            low1 = wp.min(low1, lowest(x1[vertex], pad))
                            high1 = wp.max(high1, highest(x1[vertex], pad))
                low = wp.min(low0, low1)
                high = wp.max(high0, high1)
                box = wp.matrix_from_rows(low0, high0, low1, high1)
                if not finite:
                    box = empty_box()
                write_box(box, mesh.face_boxes, i)
                has_changed = 1
                if changed:
                    has_changed = changed[a] | changed[b] | changed[c]
                if mesh.only_free and mesh.order[i] < mesh.face_count:
                    has_changed = 0
            mesh.places.lowers[i] = low
            mesh.places.uppers[i] = high
            mesh.places.changed[i] = has_changed
            fit_parent(i, low, high, has_changed, mesh.clusters)
            return
        edge = i - places
        if edge < mesh.edges.shape[0]:
            a = mesh.edges[edge, 0]
            b = mesh.edges[edge, 1]
            finite = is_finite(x0, x1, a) and is_finite(x0, x1, b)
            write_box(box_of_two(x0, x1, padding, a, b, finite), mesh.edge_boxes, mesh.edge_rows[edge])
            return
        vertex = edge - mesh.edges.shape[0]
        finite = is_finite(x0, x1, vertex)
        if not_finite:
            if not finite:
                counted = int(1)
                if checked:
                    counted = checked[vertex]
                if counted != 0:
                    raise_count(not_finite, 0, 1)
        row = mesh.vertex_rows[vertex]
        if row >= 0:
            write_box(box_of_two(x0, x1, padding, vertex, vertex, finite), mesh.vertex_boxes, row)

    return box_elements


@wp.kernel(**NO_GRADIENTS)
def _box_groups(clusters: HierarchyLevel, groups: HierarchyLevel):
    i = wp.tid()
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    high = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    has_changed = int(0)
    if i < clusters.lowers.shape[0]:
        low = clusters.lowers[i]
        high = clusters.uppers[i]
        has_changed = clusters.changed[i]
    fit_parent(i, low, high, has_changed, groups)


@made_once
def traversal_kernel(visit: Callable, arguments_type: type) -> wp.Kernel:
    """Returns a kernel that visits the pairs of faces whose swept boxes overlap, each pair once.

    Its parameters are a :class:`FaceHierarchy`, the warps of a cluster and the arguments; launch it with
    :meth:`BroadPhaseHierarchy.traverse`. The boxes must have been fitted.

    Args:
        visit: Function of Warp, ``visit(place: int, first: int, found: wp.uint32, arguments)``: the face at ``place``
            overlaps the face at ``first + k`` for each bit k of ``found``. On a GPU all threads of a warp call it
            together, each for its own face of one cluster, some of them with no bits. A thread may be called for many
            ``first``, or for none.
        arguments_type: Type of the last argument, a struct of Warp.
    """

    @wp.kernel(**NO_GRADIENTS)
    def traverse(mesh: FaceHierarchy, warps_of_cluster: int, arguments: arguments_type):
        i = wp.tid()
        cluster = i / (_WIDTH * warps_of_cluster)
        part = (i / _WIDTH) % warps_of_cluster
        place = cluster * _WIDTH + i % _WIDTH
        low = mesh.clusters.lowers[cluster]
        high = mesh.clusters.uppers[cluster]
        own_group = cluster / _WIDTH
        turn = int(0)
        count = (mesh.clusters.lowers.shape[0] - 1) / _WIDTH + 1
        for first_group in range(own_group, count, _WIDTH):
            groups = wp.uint32(0)
            if mesh.groups.lowers:
                groups = overlapping_children(mesh.clusters, cluster, low, high, mesh.groups, first_group)
            else:
                groups = ~from_place(count - first_group)
            while groups != wp.uint32(0):
                group = first_group + lowest_place(groups)
                groups = groups & (groups - wp.uint32(1))
                clusters = overlapping_children(mesh.clusters, cluster, low, high, mesh.clusters, group * _WIDTH)
                if group == own_group:
                    clusters = clusters & from_place(cluster % _WIDTH)
                while clusters != wp.uint32(0):
                    first = (group * _WIDTH + lowest_place(clusters)) * _WIDTH
                    clusters = clusters & (clusters - wp.uint32(1))
                    if turn % warps_of_cluster == part:
                        faces = overlapping_children(mesh.clusters, cluster, low, high, mesh.places, first)
                        if faces != wp.uint32(0):
                            changed = changed_children(mesh.places, first)
                            found = overlapping_faces(mesh.places, place, first, faces, changed)
                            visit(place, first, found, arguments)
                    turn += 1

    return traverse


@wp.struct
class _FacePairs:
    """The queue of pairs of faces, by place, and its count."""

    pairs: wp.array[wp.vec2i]
    count: wp.array[wp.int64]


@wp.func
def _enqueue_faces(place: int, first: int, found: wp.uint32, queue: _FacePairs):
    slot = take_slots(queue.count, 0, count_places(found))
    while found != wp.uint32(0):
        write(wp.vec2i(place, first + lowest_place(found)), queue.pairs, slot)
        found = found & (found - wp.uint32(1))
        slot += wp.int64(1)


@wp.func
def _overlap(a: BoxRows, b: BoxRows):
    """Whether two boxes overlap over the time of the motion."""
    return boxes_overlap(wp.min(a[0], a[2]), wp.max(a[1], a[3]), wp.min(b[0], b[2]), wp.max(b[1], b[3]))


@wp.func
def _apart(a: BoxRows, b: BoxRows):
    return boxes_apart(a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3])


@wp.func
def _next(corner: int):
    return wp.where(corner == 2, 0, corner + 1)


@wp.func
def _has_vertex(faces: wp.array2d[int], face: int, vertex: int):
    return faces[face, 0] == vertex or faces[face, 1] == vertex or faces[face, 2] == vertex


@wp.func
def _is_face(mesh: FaceHierarchy, place: int) -> bool:
    """Whether the cell at a place is a face; where all are, nothing is read."""
    if mesh.all_faces:
        return True
    return mesh.order[place] < mesh.face_count


@wp.func
def overlapping_vertices(mesh: FaceHierarchy, face: int, other: int, keep_separated: bool):
    """Returns which corners of a face are vertices that it owns and whose boxes overlap that of another face, as bits.

    Those that no axis separates, or all with ``keep_separated``, are bits 3 to 5 as well.
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
            if _overlap(box, other_box) and not _has_vertex(mesh.faces, other, mesh.faces[face, corner]):
                found = found | (1 << corner)
                if keep_separated or not _apart(box, other_box):
                    found = found | (8 << corner)
    return found


@wp.func
def overlapping_edges(mesh: FaceHierarchy, face: int, other: int, keep_separated: bool):
    """Which edges of a face and of another, each of its own, have overlapping boxes: bit 3 i + j for sides i and j.

    Those that no axis separates, or all with ``keep_separated``, are bits 9 to 17 as well.
    """
    owned = mesh.owned[face]
    other_owned = mesh.owned[other]
    found = int(0)
    sides = wp.where(owned >> 3 == 0 or other_owned >> 3 == 0, 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            box = read_box(mesh.edge_boxes, 3 * face + side)
            if boxes_overlap(
                wp.min(box[0], box[2]), wp.max(box[1], box[3]), mesh.places.lowers[other], mesh.places.uppers[other]
            ):
                a = mesh.faces[face, side]
                b = mesh.faces[face, _next(side)]
                for other_side in range(sides):
                    if owns_edge(other_owned, other_side):
                        c = mesh.faces[other, other_side]
                        d = mesh.faces[other, _next(other_side)]
                        if a != c and a != d and b != c and b != d:
                            other_box = read_box(mesh.edge_boxes, 3 * other + other_side)
                            if _overlap(box, other_box):
                                bit = 3 * side + other_side
                                found = found | (1 << bit)
                                if keep_separated or not _apart(box, other_box):
                                    found = found | (512 << bit)
    return found


@wp.kernel(**NO_GRADIENTS)
def _pair_elements(
    mesh: FaceHierarchy,
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    threads: int,
    keep_separated: bool,
    vertex_face_counts: wp.array[wp.int64],
    vertex_face: wp.array[wp.vec2i],
    edge_edge_counts: wp.array[wp.int64],
    edge_edge: wp.array[wp.vec2i],
):
    """First finds all pairs, then takes slots for them: where pairs of faces are many, one atomic of a warp for 128.

    Atomics on one address take turns, so that few of them are better.
    """
    i = wp.tid()
    count = int(wp.min(face_pair_count[0], wp.int64(face_pairs.shape[0])))
    turns = wp.min(wp.max((count - 1) / threads + 1, count / _PAIRS_AT_ONCE), _PAIRS_OF_THREAD)
    first = (i / _WIDTH) * turns * _WIDTH + i % _WIDTH
    if first >= count:
        return
    found = wp.uint64(0)
    candidates = wp.vec2i()  # vertex-face, edge-edge
    queued = wp.vec2i()
    for turn in range(turns):
        at = first + turn * _WIDTH
        if is_filled(at, face_pairs, face_pair_count, 0):
            face = face_pairs[at][0]
            other = face_pairs[at][1]
            vertices = overlapping_vertices(mesh, face, other, keep_separated)
            vertices = vertices | (overlapping_vertices(mesh, other, face, keep_separated) << 6)
            edges = overlapping_edges(mesh, face, other, keep_separated)
            candidates[0] += count_places(wp.uint32(vertices & 455))
            candidates[1] += count_places(wp.uint32(edges & 511))
            # of the rest only what no axis separates
            vertices = ((vertices >> 3) & 7) | ((vertices >> 6) & 56)
            edges = edges >> 9
            queued[0] += count_places(wp.uint32(vertices))
            queued[1] += count_places(wp.uint32(edges))
            found = found | (wp.uint64(vertices | (edges << 6)) << wp.uint64(_BITS_OF_PAIR * turn))
    raise_count(vertex_face_counts, _CANDIDATES, candidates[0])
    raise_count(edge_edge_counts, _CANDIDATES, candidates[1])
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


@wp.func
def _pair_edges_with_face(
    mesh: FaceHierarchy, face: int, other: int, counts: wp.array[wp.int64], pairs: wp.array[wp.vec2i]
):
    """Enqueues the edges that a face owns with another face."""
    owned = mesh.owned[face]
    sides = wp.where(owned >> 3 == 0 or not _is_face(mesh, other), 0, 3)
    for side in range(sides):
        if owns_edge(owned, side):
            row = 3 * face + side
            a = mesh.faces[face, side]
            b = mesh.faces[face, _next(side)]
            if _overlap(read_box(mesh.edge_boxes, row), read_box(mesh.face_boxes, other)):
                if not _has_vertex(mesh.faces, other, a) and not _has_vertex(mesh.faces, other, b):
                    append(wp.vec2i(mesh.face_edges[face, side], mesh.order[other]), pairs, counts, _QUEUED)


@wp.kernel(**NO_GRADIENTS)
def _pair_edges_with_faces(
    mesh: FaceHierarchy,
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
    _pair_edges_with_face(mesh, face, other, counts, pairs)
    _pair_edges_with_face(mesh, other, face, counts, pairs)


@wp.func
def _pair_point(
    mesh: FaceHierarchy,
    place: int,
    other: int,
    keep_separated: bool,
    vertex_edge_counts: wp.array[wp.int64],
    vertex_edge: wp.array[wp.vec2i],
):
    """Enqueues a point with an edge that no face has, if the cells at two places are that."""
    cell = mesh.order[other]
    if mesh.order[place] >= mesh.point_start and cell >= mesh.face_count and cell < mesh.point_start:
        box = read_box(mesh.vertex_boxes, 3 * place)
        other_box = read_box(mesh.edge_boxes, 3 * other)
        if _overlap(box, other_box):
            take_slot(vertex_edge_counts, _CANDIDATES)
            if keep_separated or not _apart(box, other_box):
                append(
                    wp.vec2i(mesh.faces[place, 0], mesh.face_edges[other, 0]), vertex_edge, vertex_edge_counts, _QUEUED
                )


@wp.kernel(**NO_GRADIENTS)
def _pair_points(
    mesh: FaceHierarchy,
    face_pairs: wp.array[wp.vec2i],
    face_pair_count: wp.array[wp.int64],
    keep_separated: bool,
    vertex_edge_counts: wp.array[wp.int64],
    vertex_edge: wp.array[wp.vec2i],
    vertex_vertex_counts: wp.array[wp.int64],
    vertex_vertex: wp.array[wp.vec2i],
):
    i = wp.tid()
    if not is_filled(i, face_pairs, face_pair_count, 0):
        return
    place = face_pairs[i][0]
    other = face_pairs[i][1]
    _pair_point(mesh, place, other, keep_separated, vertex_edge_counts, vertex_edge)
    _pair_point(mesh, other, place, keep_separated, vertex_edge_counts, vertex_edge)
    if mesh.order[place] >= mesh.point_start and mesh.order[other] >= mesh.point_start and place != other:
        box = read_box(mesh.vertex_boxes, 3 * place)
        other_box = read_box(mesh.vertex_boxes, 3 * other)
        if _overlap(box, other_box):
            take_slot(vertex_vertex_counts, _CANDIDATES)
            if keep_separated or not _apart(box, other_box):
                p = mesh.faces[place, 0]
                q = mesh.faces[other, 0]
                append(wp.vec2i(wp.min(p, q), wp.max(p, q)), vertex_vertex, vertex_vertex_counts, _QUEUED)


def _level(count: int, worlds: np.ndarray | None, device: wp.Device) -> HierarchyLevel:
    """Allocates a level of nodes; worlds: the least and the greatest of each, int, shape [2, count], or None."""
    level = HierarchyLevel()
    level.lowers = wp.empty(count, dtype=wp.vec3, device=device)
    level.uppers = wp.empty(count, dtype=wp.vec3, device=device)
    level.changed = wp.zeros(count, dtype=int, device=device)
    if worlds is not None:
        level.first_world, level.last_world = (wp.array(w.astype(np.int32), dtype=int, device=device) for w in worlds)
    return level


def _parents(worlds: np.ndarray | None) -> np.ndarray | None:
    """Returns the least and the greatest world of each parent, from those of the children, shape [2, n]."""
    if worlds is None:
        return None
    first, last = (np.pad(w, (0, -len(w) % WIDTH), mode="edge").reshape(-1, WIDTH) for w in worlds)
    return np.stack([first.min(axis=1), last.max(axis=1)])


def _group_count(places: int) -> int:
    """Returns the number of groups that have boxes."""
    groups = -(-places // (WIDTH * WIDTH))
    return groups if groups > _UNGROUPED else 0


def _make_hierarchy(mesh: CollisionMesh) -> FaceHierarchy:
    """Allocates the hierarchy of a mesh on its device."""
    device, order = mesh.device, mesh.face_order
    hierarchy = FaceHierarchy()

    def by_place(values: np.ndarray) -> wp.array:
        return wp.array(values[order] if len(order) else values, dtype=int, device=device)

    hierarchy.order = wp.array(order, dtype=int, device=device)
    hierarchy.all_faces = len(mesh.cells) == len(mesh.faces)
    hierarchy.only_free = mesh.only_free
    hierarchy.face_count, hierarchy.point_start = len(mesh.faces), len(mesh.faces) + len(mesh.free_edges)
    hierarchy.faces = by_place(mesh.cells)
    hierarchy.face_edges = by_place(mesh.cell_edges)
    hierarchy.owned = by_place(mesh.cell_owned)
    hierarchy.edges = mesh.device_edges
    vertex_rows, edge_rows = np.full(mesh.vertex_count, -1), np.empty(len(mesh.edges))
    filled = np.flatnonzero(order >= 0)
    for i in range(3):
        for rows, elements, bit in ((vertex_rows, mesh.cells, i), (edge_rows, mesh.cell_edges, 3 + i)):
            representing = filled[(mesh.cell_owned[order[filled]] >> bit) & 1 == 1]
            rows[elements[order[representing], i]] = 3 * representing + i
    hierarchy.vertex_rows = wp.array(vertex_rows.astype(np.int32), dtype=int, device=device)
    hierarchy.edge_rows = wp.array(edge_rows.astype(np.int32), dtype=int, device=device)
    hierarchy.vertex_boxes = wp.empty((3 * len(order), 4), dtype=wp.vec3, device=device)
    hierarchy.edge_boxes = wp.empty((3 * len(order), 4), dtype=wp.vec3, device=device)
    hierarchy.face_boxes = wp.empty((len(order), 4), dtype=wp.vec3, device=device)
    worlds = None
    if mesh.world is not None and len(order):
        world = mesh.world[mesh.cells[:, 0]][order]
        # empty places have the worlds of the faces before, which keeps those of nodes
        filled = np.maximum.accumulate(np.where(order >= 0, np.arange(len(order)), 0))
        worlds = np.stack([world[filled], world[filled]])
    clusters, groups = len(order) // WIDTH, _group_count(len(order))
    hierarchy.places = _level(len(order), worlds, device)
    worlds = _parents(worlds)
    hierarchy.clusters = _level(clusters, worlds, device)
    if groups:
        hierarchy.groups = _level(groups, _parents(worlds), device)
    return hierarchy


class BroadPhaseHierarchy:
    """The broad phase by a hierarchy over the faces, see :class:`warp_bsc.detection.broad_phase.BroadPhase`.

    Attributes:
        hierarchy: The hierarchy on the device; a run fits its boxes.
    """

    def __init__(
        self,
        mesh: CollisionMesh,
        count: wp.array,
        *,
        capacity: int | None = None,
        not_finite: wp.array | None = None,
        checked: wp.array | None = None,
        padding: wp.array | None = None,
    ):
        """Allocates the hierarchy and the queue for pairs of faces.

        Args:
            mesh: The mesh.
            count: Number of pairs of faces found, zero before each run, array of one int64.
            capacity: Capacity of the queue at first; default: eight pairs a face.
            not_finite: Number of vertices with a position that is not finite, which a run adds to, array of one int64;
                None to count none.
            checked: Nonzero for each vertex that is counted, array of int; None for all.
            padding: How far the boxes of each vertex and its elements reach beyond them, array of float64, or None.
        """
        self.lock = threading.RLock()
        self._padding = padding
        self._device = device = mesh.device
        self._count = count
        self._not_finite, self._checked = not_finite, checked
        self.hierarchy = _make_hierarchy(mesh)
        places = len(mesh.face_order)
        self._elements = places + len(mesh.edges) + mesh.vertex_count
        self._clusters = places // WIDTH
        self._groups = _group_count(places)
        self._warps_of_cluster = 1
        if device.is_cuda and self._clusters:
            wanted = _WARPS_OF_MULTIPROCESSOR * device.sm_count // self._clusters
            self._warps_of_cluster = max(1, min(_MOST_WARPS_OF_CLUSTER, wanted))
        capacity = 8 * len(mesh.cells) if capacity is None else capacity
        self._face_pairs = wp.empty(capacity, dtype=wp.vec2i, device=device)

    @property
    def buffers(self) -> list[wp.array]:
        """The queue for pairs of faces."""
        return [self._face_pairs]

    @property
    def capacity(self) -> int:
        """Capacity for pairs of faces."""
        return len(self._face_pairs)

    def grow(self, count: int) -> None:
        """Enlarges the queue if it is too small for the count."""
        if count > self.capacity:
            self._face_pairs = wp.empty(capacity_for(count, "face pairs"), dtype=wp.vec2i, device=self._device)

    def pair_elements(
        self,
        x0: wp.array,
        x1: wp.array,
        vertex_face_counts: wp.array,
        vertex_face: wp.array,
        edge_edge_counts: wp.array,
        edge_edge: wp.array,
        *,
        refit: bool = False,
        changed: wp.array | None = None,
        keep_separated: bool = False,
    ) -> None:
        """Counts the candidates, and enqueues those that no coordinate axis separates; always only refits."""
        self._pair_faces(x0, x1, changed)
        self._pair_elements(keep_separated, vertex_face_counts, vertex_face, edge_edge_counts, edge_edge)

    def pair_points(
        self,
        x0: wp.array,
        x1: wp.array,
        vertex_edge_counts: wp.array,
        vertex_edge: wp.array,
        vertex_vertex_counts: wp.array,
        vertex_vertex: wp.array,
        *,
        refit: bool = False,
        changed: wp.array | None = None,
        keep_separated: bool = False,
    ) -> None:
        """Counts and enqueues the candidates of points, from the pairs of cells of :meth:`pair_elements`."""
        queues = [vertex_edge_counts, vertex_edge, vertex_vertex_counts, vertex_vertex]
        self._launch_over_pairs(_pair_points, self.capacity, keep_separated, *queues)

    def pair_overlapping_elements(
        self, vertex_face_counts: wp.array, vertex_face: wp.array, edge_edge_counts: wp.array, edge_edge: wp.array
    ) -> None:
        """Enqueues all candidates of the last run."""
        self._pair_elements(True, vertex_face_counts, vertex_face, edge_edge_counts, edge_edge)

    def pair_edges_with_faces(
        self, x: wp.array, counts: wp.array, pairs: wp.array, *, refit: bool = False, is_end: bool = False
    ) -> None:
        """Enqueues the pairs (edge, face) of one configuration whose boxes overlap; always only refits."""
        self._pair_faces(x, x)
        self._launch_over_pairs(_pair_edges_with_faces, self.capacity, counts, pairs)

    def fit(self, x0: wp.array, x1: wp.array, changed: wp.array | None = None) -> None:
        """Boxes all elements of a motion, and all nodes.

        Args:
            x0: Positions at the start, array of vec3 or vec3d.
            x1: Positions at the end, of the same type.
            changed: Nonzero for each vertex whose pairs are wanted, array of int; None for all.
        """
        inputs, outputs = [x0, x1, changed, self._checked, self._padding, self.hierarchy], [self._not_finite]
        kernel = _box_elements(x0.dtype, self._padding is not None)
        launch(kernel, self._elements, inputs=inputs, outputs=outputs, device=self._device, record_tape=False)
        if self._groups:
            inputs = [self.hierarchy.clusters, self.hierarchy.groups]
            launch(_box_groups, WIDTH * self._groups, inputs=inputs, device=self._device, record_tape=False)

    def traverse(self, kernel: wp.Kernel, arguments: Any) -> None:
        """Launches a kernel of :func:`traversal_kernel` over the hierarchy, whose boxes were fitted, on no tape."""
        threads = self._clusters * self._warps_of_cluster * WIDTH
        inputs = [self.hierarchy, self._warps_of_cluster, arguments]
        launch(kernel, threads, inputs=inputs, device=self._device, block_dim=_TRAVERSAL_BLOCK, record_tape=False)

    def _pair_faces(self, x0, x1, changed=None):
        """Enqueues the pairs of faces whose swept boxes overlap, each once."""
        self.fit(x0, x1, changed)
        queue = _FacePairs()
        queue.pairs, queue.count = self._face_pairs, self._count
        self.traverse(traversal_kernel(_enqueue_faces, _FacePairs), queue)

    def _pair_elements(self, keep_separated, *queues):
        """Enqueues the pairs of elements of all pairs of faces."""
        threads = -(-self.capacity // (int(_PAIRS_OF_THREAD) * WIDTH)) * WIDTH
        self._launch_over_pairs(_pair_elements, threads, threads, keep_separated, *queues)

    def _launch_over_pairs(self, kernel, threads, *arguments):
        inputs = [self.hierarchy, self._face_pairs, self._count, *arguments]
        blocks = most_blocks(self._device, 256)
        launch(kernel, threads, inputs=inputs, device=self._device, max_blocks=blocks, record_tape=False)
