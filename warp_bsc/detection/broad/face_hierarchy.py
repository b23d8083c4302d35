"""A hierarchy of boxes over the faces of a mesh, and its traversal on a GPU.

The hierarchy is made once, from the connectivity of the mesh, see :mod:`.face_order`: patches of connected faces stay
compact however a mesh moves. A run only fits boxes; those of faces are coded in those of their clusters, in 16 bytes.
Edges that no face has and points have places as well, as faces that have collapsed: the cells of the mesh are its
faces, then these edges, then the points. Cells without neighbours are in no order, and in the worst case are compared
by brute force, 1,024 pairs of cells at a time.

Each node has 32 children: faces, clusters, bundles, and groups, all of which a traversal tests with each cluster.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ...kernels.boxes import BoxRows, empty_box, read_box, rounded, union_of_boxes
from ...kernels.pairs import PairFilter
from ...kernels.pipeline.corners import (
    PADDED_ROW,
    ROW,
    PaddedCorners,
    corner_is_finite,
    read_cell,
    read_corners,
    read_padded_corners,
    vertex_box,
    with_padded_corner,
    write_padded_corners,
    write_vertex,
)
from ...kernels.pipeline.hierarchy import (
    NOWHERE,
    SOUGHT,
    WIDTH,
    HierarchyLevel,
    bits_from,
    child_step,
    code_of_child,
    coded_box,
    codes_apart,
    completing,
    first_child,
    lowest_set_bit,
    read_coded,
    same_world,
    union_of_warp,
    unseparated_children,
    write_node,
)
from ...kernels.pipeline.queues import raise_count
from ..mesh import CollisionMesh
from ..run.launch import made_once
from ..run.settings import NO_GRADIENTS

FEW_NODES = 8
"""Nodes of a level above the clusters up to which all are traversed: their boxes would take longer than they save."""

_FLAGS = wp.constant(wp.uint32(30))
"""Place of a face's flags in the first number of its coded box."""


@wp.struct
class FaceHierarchy:
    """The faces in the order of their places, the boxes of elements, and the nodes above the faces.

    Boxes are rows of four: the lowest and the highest coordinates at the start, then at the end; or twice those over
    the time of the motion, if pairs that an axis separates at both ends are sought as well.
    """

    only_free: wp.bool  # whether pairs of two faces are left out
    pair_filter: PairFilter  # pairs of elements that are left out
    # how many of them each world has; without an array they are not counted by world
    filtered_of_worlds: wp.array[wp.int64]
    face_count: int  # number of faces; greater cells are edges
    point_start: int  # first cell that is a point
    order: wp.array[int]  # cell at each place, -1 for none
    # vertices of the cell at each place, and what it represents, see kernels.pipeline.corners
    faces: wp.array2d[int]
    face_edges: wp.array2d[int]  # edges of the face at each place
    edges: wp.array2d[int]  # vertices of each edge
    corners: wp.array2d[wp.float32]  # rows of vertices, or with a padding those of the cell at each place
    swept: wp.bool  # whether boxes are those over the time of the motion
    places: HierarchyLevel  # level of the faces; where a position is not finite, boxes cover the others
    clusters: HierarchyLevel  # level above
    bundles: HierarchyLevel  # level above the clusters; without arrays in a small mesh, where all are traversed
    groups: HierarchyLevel  # level above the bundles; without arrays likewise


@made_once
def round_kernel(dtype: type) -> wp.Kernel:
    """Returns the kernel that counts the vertices that are not finite, and writes the rows of all if there are any."""

    @wp.kernel(**NO_GRADIENTS)
    def round_positions(
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        checked: wp.array[int],
        # out
        rows: wp.array2d[wp.float32],
        not_finite: wp.array[wp.int64],
    ):
        vertex = wp.tid()
        start = rounded(x0[vertex])
        end = rounded(x1[vertex])
        if not (wp.isfinite(x0[vertex]) and wp.isfinite(x1[vertex])):
            start = wp.vec3(wp.nan, wp.nan, wp.nan)
            counted = int(1)
            if checked:
                counted = checked[vertex]
            if not_finite and counted != 0:
                raise_count(not_finite, 0, 1)
        if rows:
            write_vertex(rows, vertex, start, end)

    return round_positions


@wp.func
def _box_of(corners: Any, swept: bool) -> BoxRows:
    """Returns the box of the corners of a cell that are finite."""
    box = empty_box()
    for j in range(3):
        if corner_is_finite(corners, j):
            box = union_of_boxes(box, vertex_box(corners, j, swept))
    return box


@wp.func
def _box_at(mesh: FaceHierarchy, place: int) -> BoxRows:
    """Returns the box of the cell at a place, from the rows of its vertices."""
    if mesh.order[place] < 0:
        return empty_box()
    return _box_of(read_corners(mesh.corners, read_cell(mesh.faces, place)), mesh.swept)


@wp.func
def _padded_box_at(mesh: FaceHierarchy, place: int) -> BoxRows:
    """Returns the box of the cell at a place, from its own row."""
    if mesh.order[place] < 0:
        return empty_box()
    return _box_of(read_padded_corners(mesh.corners, place), mesh.swept)


@wp.func
def _flags_of(mesh: FaceHierarchy, changed: wp.array[int], cell: int, vertices: wp.vec4i) -> int:
    """Returns the flags of a cell: where pairs of two faces are left out, faces are not paired with all others."""
    flags = int(SOUGHT)
    if cell < 0:
        return 0
    if mesh.only_free and cell < mesh.face_count:
        flags = 1
    if changed:
        if (changed[vertices[0]] | changed[vertices[1]] | changed[vertices[2]]) == 0:
            flags = flags & 2
    return flags


@made_once
def fit_kernel(dtype: type, padded: bool) -> wp.Kernel:
    """Returns the kernel that writes the boxes of faces and clusters, and with a padding the rows of the cells.

    Args:
        dtype: Type of the positions, which only boxes with a padding are computed from; others from rows of vertices.
        padded: Whether boxes have a padding.
    """
    box_at = _padded_box_at if padded else _box_at

    @wp.kernel(**NO_GRADIENTS)
    def fit(
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        changed: wp.array[int],
        padding: wp.array[wp.float64],
        # in and out
        mesh: FaceHierarchy,
    ):
        i = wp.tid()
        if child_step() == 1 and i % WIDTH != 0:  # on a CPU the first thread of 32 does it all
            return
        first = i - i % WIDTH
        box = empty_box()
        united = empty_box()
        flags = int(0)
        for place in range(first + first_child(), first + WIDTH, child_step()):
            cell = read_cell(mesh.faces, place)
            if wp.static(padded):
                pad = wp.max(wp.max(padding[cell[0]], padding[cell[1]]), padding[cell[2]])
                corners = PaddedCorners()
                for j in range(3):
                    corners = with_padded_corner(corners, j, x0[cell[j]], x1[cell[j]], pad)
                write_padded_corners(mesh.corners, place, corners)
            box = box_at(mesh, place)
            united = union_of_boxes(united, box)
            flags = flags | _flags_of(mesh, changed, mesh.order[place], cell)
        cluster_box = write_node(mesh.clusters, i / WIDTH, united, flags)
        for place in range(first + first_child(), first + WIDTH, child_step()):
            if child_step() == 1:
                box = box_at(mesh, place)
            coded = coded_box(box, cluster_box)
            if box[0][0] > box[1][0]:
                coded = wp.vec4ui(NOWHERE)
            flags = _flags_of(mesh, changed, mesh.order[place], read_cell(mesh.faces, place))
            coded[0] = coded[0] | (wp.uint32(flags) << _FLAGS)
            for row in range(4):
                mesh.places.coded[place, row] = coded[row]

    return fit


@wp.kernel(**NO_GRADIENTS)
def box_parents(
    # in
    children: HierarchyLevel,
    # out
    parents: HierarchyLevel,
):
    """Boxes bundles or groups."""
    i = wp.tid()
    if child_step() == 1 and i % WIDTH != 0:  # on a CPU the first thread of 32 does it all
        return
    box = empty_box()
    flags = int(0)
    first = i - i % WIDTH
    for child in range(first + first_child(), wp.min(first + WIDTH, children.boxes.shape[0]), child_step()):
        box = union_of_boxes(box, read_box(children.boxes, child))
        flags = flags | children.flags[child]
    write_node(parents, i / WIDTH, box, flags)


@wp.func
def _nodes_to_visit(clusters: HierarchyLevel, cluster: int, box: BoxRows, level: HierarchyLevel, first: int, end: int):
    """Returns which of 32 nodes of a level, from the first on, to visit for a cluster, as bits; all without boxes."""
    if level.boxes:
        return unseparated_children(clusters, cluster, box, level, first)
    return ~bits_from(end - first)


@made_once
def traversal_kernel(visit: Callable, arguments_type: type, padded: bool, **module_options: int) -> wp.Kernel:
    """Returns a kernel that visits the pairs of faces whose coded boxes no axis separates at both ends, each pair once.

    Its parameters are a :class:`FaceHierarchy`, the first cluster, the warps of a cluster and the arguments; launch it
    with :meth:`BroadPhaseHierarchy.traverse`. The boxes must have been fitted.

    Args:
        visit: Device function, ``visit(place: int, first: int, found: wp.uint32, arguments)``: the face at ``place``
            is paired with that at ``first + k`` for each bit k of ``found``. On a GPU all threads of a warp call it
            together, each for its own face of one cluster, some with no bits; a thread for many ``first`` or none.
        arguments_type: Type of the last argument, a struct of Warp.
        padded: Whether boxes have a padding.
        module_options: Options of the kernel's module.
    """
    box_at = _padded_box_at if padded else _box_at

    @wp.func
    def visit_cluster(
        mesh: FaceHierarchy,
        cluster: int,
        cluster_box: BoxRows,
        place: int,
        box: BoxRows,
        other: int,
        arguments: arguments_type,
    ):
        """Visits the faces of another cluster, the same or a later one, that no axis separates from a face of a first.

        All threads of a warp test those of them together that the box of the first is not separated from.
        """
        first = other * WIDTH
        node = read_box(mesh.clusters.boxes, other)
        coded_cluster = coded_box(cluster_box, node)
        coded = wp.vec4ui()
        near = wp.uint32(0)
        changed = wp.uint32(0)
        paired = wp.uint32(0)
        for child in range(first_child(), WIDTH, child_step()):
            coded = read_coded(mesh.places.coded, first + child)
            bit = wp.uint32(1) << wp.uint32(child)
            if not codes_apart(coded_cluster, coded):
                if same_world(mesh.clusters, cluster, mesh.places, first + child):
                    near = near | bit
            flags = int(coded[0] >> _FLAGS)
            changed = changed | wp.where(flags & 1 != 0, bit, wp.uint32(0))
            paired = paired | wp.where(flags & 2 != 0, bit, wp.uint32(0))
        changed = union_of_warp(changed)
        paired = union_of_warp(paired)
        left = union_of_warp(near) & completing(mesh.clusters.flags[cluster], changed, paired)
        if left == wp.uint32(0):
            return
        sought = completing(int(mesh.places.coded[place, 0] >> _FLAGS), changed, paired)
        if first <= place:
            own = wp.uint32(1) << wp.uint32(place - first)
            sought = sought & ~(own | (own - wp.uint32(1)))
        coded_own = coded_box(box, node)
        found = wp.uint32(0)
        while left != wp.uint32(0):
            bit = left & (~left + wp.uint32(1))
            left = left ^ bit
            child = lowest_set_bit(bit)
            coded_other = code_of_child(coded, child)
            if child_step() == 1:
                coded_other = read_coded(mesh.places.coded, first + child)
            if not codes_apart(coded_own, coded_other):
                if (sought & bit) != wp.uint32(0) and same_world(mesh.places, place, mesh.places, first + child):
                    found = found | bit
        visit(place, first, found, arguments)

    @wp.kernel(**NO_GRADIENTS, module_options=module_options)
    def traverse(mesh: FaceHierarchy, first_cluster: int, warps_of_cluster: int, arguments: arguments_type):
        i = wp.tid()
        cluster = first_cluster + i / (WIDTH * warps_of_cluster)
        part = (i / WIDTH) % warps_of_cluster
        place = cluster * WIDTH + i % WIDTH
        cluster_box = read_box(mesh.clusters.boxes, cluster)
        box = box_at(mesh, place)
        own_bundle = cluster / WIDTH
        own_group = own_bundle / WIDTH
        turn = int(0)
        bundle_end = (mesh.clusters.boxes.shape[0] - 1) / WIDTH + 1
        group_end = (bundle_end - 1) / WIDTH + 1
        for first_group in range(own_group, group_end, WIDTH):
            groups = _nodes_to_visit(mesh.clusters, cluster, cluster_box, mesh.groups, first_group, group_end)
            while groups != wp.uint32(0):
                group = first_group + lowest_set_bit(groups)
                groups = groups & (groups - wp.uint32(1))
                first_bundle = group * WIDTH
                bundles = _nodes_to_visit(mesh.clusters, cluster, cluster_box, mesh.bundles, first_bundle, bundle_end)
                if group == own_group:
                    bundles = bundles & bits_from(own_bundle % WIDTH)
                while bundles != wp.uint32(0):
                    bundle = first_bundle + lowest_set_bit(bundles)
                    bundles = bundles & (bundles - wp.uint32(1))
                    clusters = unseparated_children(mesh.clusters, cluster, cluster_box, mesh.clusters, bundle * WIDTH)
                    if bundle == own_bundle:
                        clusters = clusters & bits_from(cluster % WIDTH)
                    while clusters != wp.uint32(0):
                        other = bundle * WIDTH + lowest_set_bit(clusters)
                        clusters = clusters & (clusters - wp.uint32(1))
                        if turn % warps_of_cluster == part:
                            visit_cluster(mesh, cluster, cluster_box, place, box, other, arguments)
                        turn += 1

    return traverse


def _level(count: int, worlds: np.ndarray | None, device: wp.Device, *, of_faces: bool = False) -> HierarchyLevel:
    """Allocates a level of nodes; worlds: the lowest and the highest of each, int, shape [2, count], or None."""
    level = HierarchyLevel()
    if of_faces:
        level.coded = wp.empty((count, 4), dtype=wp.uint32, device=device)
    else:
        level.boxes = wp.empty((count, 4), dtype=wp.vec3, device=device)
        level.flags = wp.zeros(count, dtype=int, device=device)
    if worlds is not None:
        level.first_world, level.last_world = (wp.array(w.astype(np.int32), dtype=int, device=device) for w in worlds)
    return level


def _parents(worlds: np.ndarray | None) -> np.ndarray | None:
    """Returns the lowest and the highest world of each parent, from those of the children, shape [2, n]."""
    if worlds is None:
        return None
    first, last = (np.pad(w, (0, -len(w) % WIDTH), mode="edge").reshape(-1, WIDTH) for w in worlds)
    return np.stack([first.min(axis=1), last.max(axis=1)])


def parent_count(children: int) -> int:
    """Returns the number of parents of some clusters or bundles, 0 if they have no boxes."""
    parents = -(-children // WIDTH)
    return parents if parents > FEW_NODES else 0


def make_hierarchy(mesh: CollisionMesh, *, padded: bool) -> FaceHierarchy:
    """Allocates the hierarchy of a mesh on its device, for boxes with a padding or without."""
    device, order = mesh.device, mesh.face_order
    hierarchy = FaceHierarchy()
    hierarchy.only_free, hierarchy.pair_filter = mesh.only_free, mesh.pair_filter
    hierarchy.face_count, hierarchy.point_start = len(mesh.faces), len(mesh.faces) + len(mesh.free_edges)
    hierarchy.order, hierarchy.faces, hierarchy.face_edges = mesh.device_places
    hierarchy.edges = mesh.device_edges
    rows = (len(order), PADDED_ROW) if padded else (mesh.vertex_count, ROW)
    hierarchy.corners = wp.empty(rows, dtype=wp.float32, device=device)
    worlds = None
    if mesh.world is not None and len(order):
        world = mesh.world[mesh.cells[:, 0]][order]
        # empty places have the worlds of the faces before, which keeps those of nodes
        filled = np.maximum.accumulate(np.where(order >= 0, np.arange(len(order)), 0))
        worlds = np.stack([world[filled], world[filled]])
    count = len(order)
    hierarchy.places = _level(count, worlds, device, of_faces=True)
    count, worlds = count // WIDTH, _parents(worlds)
    hierarchy.clusters = _level(count, worlds, device)
    for name in ("bundles", "groups"):
        count, worlds = parent_count(count), _parents(worlds)
        if count:
            setattr(hierarchy, name, _level(count, worlds, device))
    return hierarchy
