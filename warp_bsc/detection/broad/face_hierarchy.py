"""A hierarchy of boxes over the faces of a mesh, and its traversal on a GPU.

The hierarchy is made once, from the connectivity of the mesh, see :mod:`.face_order`: patches of connected faces stay
compact however a mesh moves. A run only fits its boxes. Edges that no face has and points have places as well, as faces
that have collapsed: the cells of the mesh are its faces, then these edges, then the points. Cells without neighbours
are in no order, and in the worst case are compared by brute force, 1,024 pairs of cells at a time.
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from ...kernels.boxes import BoxRows, read_box, union_of_boxes, write_box
from ...kernels.pairs import PairFilter, finite_elements
from ...kernels.pipeline.corners import (
    IS_FACE,
    PADDED_ROW,
    ROW,
    Corners,
    PaddedCorners,
    face_box,
    vertex_box,
    with_corner,
    write_corners,
    write_padded_corners,
)
from ...kernels.pipeline.hierarchy import (
    WIDTH,
    HierarchyLevel,
    bits_from,
    changed_children,
    fit_parent,
    lowest_set_bit,
    unseparated_children,
    unseparated_faces,
)
from ...kernels.pipeline.queues import raise_count
from ..mesh import CollisionMesh
from ..run.launch import made_once
from ..run.settings import NO_GRADIENTS

_FEW_BUNDLES = 8
"""Number of bundles up to which all of them are traversed: their boxes would take longer than they save."""


@wp.struct
class FaceHierarchy:
    """The faces in the order of their places, the boxes of elements, and the nodes above the faces.

    Boxes are rows of four: the lowest and the highest coordinates at the start, then at the end; or twice those over
    the time of the motion, if pairs that an axis separates at both ends are sought as well.

    Attributes:
        only_free: Whether pairs of two faces are left out.
        pair_filter: Pairs of elements that are left out.
        filtered_of_worlds: How many of them each world has; without an array they are not counted by world.
        face_count: Number of faces; greater cells are edges.
        point_start: First cell that is a point.
        order: Cell at each place, -1 for none.
        faces: Vertices of the face at each place.
        face_edges: Edges of the face at each place.
        owned: The elements whose representative the face at each place is.
        edges: Vertices of each edge.
        corners: Corners of the face at each place, see :mod:`warp_bsc.kernels.pipeline.corners`.
        places: Level of the faces; where a position is not finite, boxes cover the others.
        clusters: Level above.
        bundles: Highest level; without arrays in a small mesh, where all are traversed.
    """

    only_free: wp.bool
    pair_filter: PairFilter
    filtered_of_worlds: wp.array[wp.int64]
    face_count: int
    point_start: int
    order: wp.array[int]
    faces: wp.array2d[int]
    face_edges: wp.array2d[int]
    owned: wp.array[int]
    edges: wp.array2d[int]
    corners: wp.array2d[wp.float32]
    places: HierarchyLevel
    clusters: HierarchyLevel
    bundles: HierarchyLevel


@wp.func
def empty_box() -> BoxRows:
    """Returns a box that overlaps none."""
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    return wp.matrix_from_rows(low, -low, low, -low)


@made_once
def fit_kernel(dtype: type, padded: bool) -> wp.Kernel:
    """Returns the kernel that writes the corners of moving faces, and the boxes of faces and clusters.

    Its threads are the places of faces, then the vertices, of which it counts those that are not finite.

    Args:
        dtype: Type of the positions.
        padded: Whether boxes have a padding.
    """
    corners_type = PaddedCorners if padded else Corners

    @wp.func
    def padding_of(padding: wp.array[wp.float64], a: int, b: int, c: int) -> wp.float64:
        """Returns the largest padding of three vertices; without paddings the array is not read."""
        if wp.static(padded):
            return wp.max(wp.max(padding[a], padding[b]), padding[c])
        return wp.float64(0.0)

    @wp.func
    def write_row(mesh: FaceHierarchy, i: int, label: wp.vec4i, corners: corners_type):
        if wp.static(padded):
            write_padded_corners(mesh.corners, i, label, corners)
        else:
            write_corners(mesh.corners, i, label, corners)

    @wp.func
    def is_finite(x0: wp.array[dtype], x1: wp.array[dtype], vertex: int) -> bool:
        return wp.isfinite(x0[vertex]) and wp.isfinite(x1[vertex])

    @wp.kernel(**NO_GRADIENTS)
    def fit(
        # in
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        changed: wp.array[int],
        checked: wp.array[int],
        padding: wp.array[wp.float64],
        swept: bool,
        # in and out
        mesh: FaceHierarchy,
        # out
        not_finite: wp.array[wp.int64],
    ):
        i = wp.tid()
        places = mesh.order.shape[0]
        if i >= places:
            vertex = i - places
            if not is_finite(x0, x1, vertex):
                counted = int(1)
                if checked:
                    counted = checked[vertex]
                if counted != 0:
                    raise_count(not_finite, 0, 1)
            return
        box = empty_box()  # the same branch for all threads of a warp from here on
        has_changed = int(0)
        if mesh.order[i] >= 0:
            a = mesh.faces[i, 0]
            b = mesh.faces[i, 1]
            c = mesh.faces[i, 2]
            pad = padding_of(padding, a, b, c)
            corners = with_corner(corners_type(), 0, x0[a], x1[a], pad)
            corners = with_corner(corners, 1, x0[b], x1[b], pad)
            corners = with_corner(corners, 2, x0[c], x1[c], pad)
            a_finite = is_finite(x0, x1, a)
            b_finite = is_finite(x0, x1, b)
            c_finite = is_finite(x0, x1, c)
            owned = mesh.owned[i]
            if a_finite and b_finite and c_finite:
                box = face_box(corners, swept)
                owned = owned | wp.where(mesh.order[i] < mesh.face_count, IS_FACE, 0)
            else:  # the place covers what it represents and is finite
                owned = finite_elements(owned, a_finite, b_finite, c_finite)
                if a_finite:
                    box = union_of_boxes(box, vertex_box(corners, 0, swept))
                if b_finite:
                    box = union_of_boxes(box, vertex_box(corners, 1, swept))
                if c_finite:
                    box = union_of_boxes(box, vertex_box(corners, 2, swept))
            write_row(mesh, i, wp.vec4i(a, b, c, owned), corners)
            has_changed = 1
            if changed:
                has_changed = changed[a] | changed[b] | changed[c]
            if mesh.only_free and mesh.order[i] < mesh.face_count:
                has_changed = 0
        write_box(box, mesh.places.boxes, i)
        mesh.places.changed[i] = has_changed
        fit_parent(i, box, has_changed, mesh.clusters)

    return fit


@wp.kernel(**NO_GRADIENTS)
def box_bundles(
    # in
    clusters: HierarchyLevel,
    # out
    bundles: HierarchyLevel,
):
    """Boxes the bundles."""
    i = wp.tid()
    box = empty_box()
    has_changed = int(0)
    if i < clusters.boxes.shape[0]:
        box = read_box(clusters.boxes, i)
        has_changed = clusters.changed[i]
    fit_parent(i, box, has_changed, bundles)


@made_once
def traversal_kernel(visit: Callable, arguments_type: type) -> wp.Kernel:
    """Returns a kernel that visits the pairs of faces whose boxes no axis separates at both ends, each pair once.

    Its parameters are a :class:`FaceHierarchy`, the warps of a cluster and the arguments; launch it with
    :meth:`BroadPhaseHierarchy.traverse`. The boxes must have been fitted.

    Args:
        visit: Device function, ``visit(place: int, first: int, found: wp.uint32, arguments)``: the face at ``place``
            is paired with that at ``first + k`` for each bit k of ``found``. On a GPU all threads of a warp call it
            together, each for its own face of one cluster, some of them with no bits. A thread may call it for many
            ``first``, or for none.
        arguments_type: Type of the last argument, a struct of Warp.
    """

    @wp.kernel(**NO_GRADIENTS)
    def traverse(mesh: FaceHierarchy, warps_of_cluster: int, arguments: arguments_type):
        i = wp.tid()
        cluster = i / (WIDTH * warps_of_cluster)
        part = (i / WIDTH) % warps_of_cluster
        place = cluster * WIDTH + i % WIDTH
        box = read_box(mesh.places.boxes, place)
        cluster_box = read_box(mesh.clusters.boxes, cluster)
        own_bundle = cluster / WIDTH
        turn = int(0)
        count = (mesh.clusters.boxes.shape[0] - 1) / WIDTH + 1
        for first_bundle in range(own_bundle, count, WIDTH):
            bundles = wp.uint32(0)
            if mesh.bundles.boxes:
                bundles = unseparated_children(mesh.clusters, cluster, cluster_box, mesh.bundles, first_bundle)
            else:
                bundles = ~bits_from(count - first_bundle)
            while bundles != wp.uint32(0):
                bundle = first_bundle + lowest_set_bit(bundles)
                bundles = bundles & (bundles - wp.uint32(1))
                clusters = unseparated_children(mesh.clusters, cluster, cluster_box, mesh.clusters, bundle * WIDTH)
                if bundle == own_bundle:
                    clusters = clusters & bits_from(cluster % WIDTH)
                while clusters != wp.uint32(0):
                    first = (bundle * WIDTH + lowest_set_bit(clusters)) * WIDTH
                    clusters = clusters & (clusters - wp.uint32(1))
                    if turn % warps_of_cluster == part:
                        faces = unseparated_children(mesh.clusters, cluster, cluster_box, mesh.places, first)
                        if faces != wp.uint32(0):
                            changed = changed_children(mesh.places, first)
                            found = unseparated_faces(mesh.places, place, box, first, faces, changed)
                            visit(place, first, found, arguments)
                    turn += 1

    return traverse


def _level(count: int, worlds: np.ndarray | None, device: wp.Device) -> HierarchyLevel:
    """Allocates a level of nodes; worlds: the lowest and the highest of each, int, shape [2, count], or None."""
    level = HierarchyLevel()
    level.boxes = wp.empty((count, 4), dtype=wp.vec3, device=device)
    level.changed = wp.zeros(count, dtype=int, device=device)
    if worlds is not None:
        level.first_world, level.last_world = (wp.array(w.astype(np.int32), dtype=int, device=device) for w in worlds)
    return level


def _parents(worlds: np.ndarray | None) -> np.ndarray | None:
    """Returns the lowest and the highest world of each parent, from those of the children, shape [2, n]."""
    if worlds is None:
        return None
    first, last = (np.pad(w, (0, -len(w) % WIDTH), mode="edge").reshape(-1, WIDTH) for w in worlds)
    return np.stack([first.min(axis=1), last.max(axis=1)])


def bundle_count(places: int) -> int:
    """Returns the number of bundles that have boxes."""
    bundles = -(-places // (WIDTH * WIDTH))
    return bundles if bundles > _FEW_BUNDLES else 0


def make_hierarchy(mesh: CollisionMesh, *, padded: bool) -> FaceHierarchy:
    """Allocates the hierarchy of a mesh on its device, for boxes with a padding or without."""
    device, order, places = mesh.device, mesh.face_order, mesh.device_places
    hierarchy = FaceHierarchy()
    hierarchy.only_free, hierarchy.pair_filter = mesh.only_free, mesh.pair_filter
    hierarchy.face_count, hierarchy.point_start = len(mesh.faces), len(mesh.faces) + len(mesh.free_edges)
    hierarchy.order, hierarchy.faces, hierarchy.face_edges = places.order, places.faces, places.face_edges
    hierarchy.owned, hierarchy.edges = places.owned, mesh.device_edges
    hierarchy.corners = wp.empty((len(order), PADDED_ROW if padded else ROW), dtype=wp.float32, device=device)
    worlds = None
    if mesh.world is not None and len(order):
        world = mesh.world[mesh.cells[:, 0]][order]
        # empty places have the worlds of the faces before, which keeps those of nodes
        filled = np.maximum.accumulate(np.where(order >= 0, np.arange(len(order)), 0))
        worlds = np.stack([world[filled], world[filled]])
    clusters, bundles = len(order) // WIDTH, bundle_count(len(order))
    hierarchy.places = _level(len(order), worlds, device)
    worlds = _parents(worlds)
    hierarchy.clusters = _level(clusters, worlds, device)
    if bundles:
        hierarchy.bundles = _level(bundles, _parents(worlds), device)
    return hierarchy
