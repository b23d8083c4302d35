"""The broad phase on the CPU: wide BVHs of packets of eight boxes, one for each kind of element."""

import threading
from collections.abc import Sequence

import numpy as np
import warp as wp

from ..mesh import CollisionMesh
from ..run.launch import launch, launch_together
from ..run.settings import UNLIMITED
from .face_hierarchy import round_kernel
from .wide_tree import WideTree, fit_trees, sort_trees


class BroadPhaseSimd:
    """The broad phase by wide BVHs, one for each kind of element, see :data:`.broad_phase.BroadPhase`.

    Its methods are those of :class:`.BroadPhaseHierarchy`. It pairs elements directly, and has no queue for pairs of
    faces. Points and the edges that no face has, whose pairs count with a minimum distance only, have trees of their
    own. For a mesh with ``only_free``, only the trees of these edges and of vertices that no face has are paired with
    the others.
    """

    buffers: tuple[wp.array, ...] = ()
    capacity: int = UNLIMITED

    def __init__(
        self,
        mesh: CollisionMesh,
        count: wp.array,
        *,
        not_finite: wp.array | None = None,
        checked: wp.array | None = None,
        padding: wp.array | None = None,
    ):
        """Allocates trees over the elements of a mesh; arguments as of :class:`.BroadPhaseHierarchy`."""
        self._vertex_count, self._checked, self._not_finite = mesh.vertex_count, checked, not_finite
        self.lock = threading.RLock()
        self._filtered_of_worlds: wp.array | None = None
        shared = mesh.world, padding, mesh.pair_filter

        def of_vertices(vertices: np.ndarray) -> WideTree:
            return WideTree(vertices.reshape(-1, 1), vertices, *shared)

        def of_edges(edges: np.ndarray) -> WideTree:
            return WideTree(mesh.edges[edges], edges, *shared)

        self._used = mesh.vertices if len(mesh.vertices) < mesh.vertex_count else slice(None)
        self._faces = WideTree(mesh.faces, np.arange(len(mesh.faces)), *shared)
        self._edges_of_faces = self._points = self._free_edges = None
        if mesh.only_free:
            self._vertices = of_vertices(np.setdiff1d(mesh.vertices, mesh.faces))
            self._edges = of_edges(mesh.free_edges)
            self._edges_of_faces = of_edges(np.delete(np.arange(len(mesh.edges)), mesh.free_edges))
        else:
            self._vertices = of_vertices(mesh.vertices)
            self._edges = of_edges(np.arange(len(mesh.edges)))
        if len(mesh.points):
            self._points, self._free_edges = of_vertices(mesh.points), of_edges(mesh.free_edges)

    def grow(self, count: int) -> None:
        """Does nothing, as there is no queue."""

    def count_filtered_by_world(self, counts: wp.array) -> None:
        """Makes runs count the pairs that groups and masks leave out by world as well."""
        self._filtered_of_worlds = counts

    def pair_elements(
        self, x0: wp.array, x1: wp.array, *out: wp.array, changed: wp.array | None = None, keep_separated: bool = False
    ) -> None:
        """Enqueues the candidates."""
        trees = [self._vertices, self._edges, self._faces]
        if self._edges_of_faces:
            trees.append(self._edges_of_faces)
        self._build(trees, x0, x1, changed)
        options = {"keep_separated": keep_separated, "filtered_of_worlds": self._filtered_of_worlds}
        pairings = [self._vertices.pairing(self._faces, *out[:2], **options)]
        pairings.append(self._edges.pairing(self._edges, *out[2:4], ordered=True, **options))
        if self._edges_of_faces:
            pairings.append(self._edges.pairing(self._edges_of_faces, *out[2:4], ordered=True, **options))
        if self._points and self._free_edges and out[4:]:
            self._build([self._points, self._free_edges], x0, x1, changed)
            pairings.append(self._points.pairing(self._free_edges, *out[4:6], **options))
            pairings.append(self._points.pairing(self._points, *out[6:], ordered=True, **options))
        launch_together(pairings, device=x0.device, chunk=64)
        if self._not_finite is not None and not all(np.isfinite(x.numpy()).all() for x in (x0, x1)):
            inputs, outputs = [x0, x1, self._checked], [None, self._not_finite]
            options = {"device": x0.device, "record_tape": False}
            launch(round_kernel(x0.dtype), self._vertex_count, inputs=inputs, outputs=outputs, **options)

    def pair_elements_again(self, x0: wp.array, x1: wp.array, *out: wp.array) -> None:
        """Enqueues as with ``keep_separated``, in a run of its own."""
        self.pair_elements(x0, x1, *out, keep_separated=True)

    def pair_vertices_with_faces(self, counts: wp.array, pairs: wp.array) -> None:
        """Enqueues the (vertex, face) whose boxes in the last run overlap, with arguments as of the others."""
        pairings = [self._vertices.pairing(self._faces, counts, pairs, keep_separated=True)]
        launch_together(pairings, device=pairs.device, chunk=64)

    def pair_edges_with_faces(self, x: wp.array, counts: wp.array, pairs: wp.array, *, is_end: bool = False) -> None:
        """Enqueues the pairs (edge, face) of one configuration that share no vertex and whose boxes overlap."""
        if not is_end:
            self._build([self._edges, self._faces], x, x)
        pairings = [self._edges.pairing(self._faces, counts, pairs, at_end=True)]
        launch_together(pairings, device=pairs.device, chunk=64)

    def _build(self, trees: Sequence[WideTree], x0: wp.array, x1: wp.array, changed: wp.array | None = None) -> None:
        """Fits the boxes of trees to a motion; sorts trees that never were, or whose boxes have become loose."""
        if all(tree.is_sorted for tree in trees):
            fit_trees(trees, x0, x1, changed)
            if not any(tree.is_loose for tree in trees):
                return
        sort_trees(trees, x0, x1, self._used)
        fit_trees(trees, x0, x1, changed)
