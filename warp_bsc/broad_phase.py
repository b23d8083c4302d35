"""The broad phase: pairs of mesh elements whose swept boxes overlap, by a bounding volume hierarchy over the boxes."""

import functools

import warp as wp

__all__ = ["BroadPhase"]

_LARGEST_FLOAT = wp.constant(wp.float64(3.4028234663852886e38))

_KERNEL = {"enable_backward": False, "module": "unique"}


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
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        lowers: wp.array[wp.vec3],
        uppers: wp.array[wp.vec3],
    ):
        i = wp.tid()
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


@wp.func
def _append(pair: wp.vec2i, pairs: wp.array[wp.vec2i], count: wp.array[wp.int64]):
    """Writes a pair where there is room; the count goes on, so that the caller sees what did not fit."""
    slot = wp.atomic_add(count, 0, wp.int64(1))
    if slot < wp.int64(pairs.shape[0]):
        pairs[wp.int32(slot)] = pair


@wp.kernel(**_KERNEL)
def _pair_vertices_with_faces(
    bvh: wp.uint64,
    vertices: wp.array2d[int],
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    faces: wp.array2d[int],
    pairs: wp.array[wp.vec2i],
    count: wp.array[wp.int64],
):
    i = wp.tid()
    vertex = vertices[i, 0]
    query = wp.bvh_query_aabb(bvh, lowers[i], uppers[i])
    face = int(0)
    while wp.bvh_query_next(query, face):
        if faces[face, 0] != vertex and faces[face, 1] != vertex and faces[face, 2] != vertex:
            _append(wp.vec2i(vertex, face), pairs, count)


@wp.kernel(**_KERNEL)
def _pair_edges(
    bvh: wp.uint64,
    edges: wp.array2d[int],
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    pairs: wp.array[wp.vec2i],
    count: wp.array[wp.int64],
):
    edge = wp.tid()
    a = edges[edge, 0]
    b = edges[edge, 1]
    query = wp.bvh_query_aabb(bvh, lowers[edge], uppers[edge])
    other = int(0)
    while wp.bvh_query_next(query, other):
        if edge < other:
            c = edges[other, 0]
            d = edges[other, 1]
            if a != c and a != d and b != c and b != d:
                _append(wp.vec2i(edge, other), pairs, count)


@wp.kernel(**_KERNEL)
def _pair_edges_with_faces(
    bvh: wp.uint64,
    edges: wp.array2d[int],
    lowers: wp.array[wp.vec3],
    uppers: wp.array[wp.vec3],
    faces: wp.array2d[int],
    pairs: wp.array[wp.vec2i],
    count: wp.array[wp.int64],
):
    edge = wp.tid()
    a = edges[edge, 0]
    b = edges[edge, 1]
    query = wp.bvh_query_aabb(bvh, lowers[edge], uppers[edge])
    face = int(0)
    while wp.bvh_query_next(query, face):
        if (
            faces[face, 0] != a
            and faces[face, 1] != a
            and faces[face, 2] != a
            and faces[face, 0] != b
            and faces[face, 1] != b
            and faces[face, 2] != b
        ):
            _append(wp.vec2i(edge, face), pairs, count)


class _Boxes:
    """Swept boxes of one sort of element, and the hierarchy over them."""

    def __init__(self, elements):
        self.elements = elements
        self.lowers = wp.empty(len(elements), dtype=wp.vec3, device=elements.device)
        self.uppers = wp.empty(len(elements), dtype=wp.vec3, device=elements.device)
        self._bvh = None

    def update(self, x0, x1):
        wp.launch(
            _swept_boxes(x0.dtype),
            len(self.elements),
            inputs=[x0, x1, self.elements],
            outputs=[self.lowers, self.uppers],
            device=self.elements.device,
        )

    def hierarchy(self):
        """Builds the hierarchy anew over the boxes as they are, and returns its id."""
        if self._bvh is None:
            self._bvh = wp.Bvh(self.lowers, self.uppers)
        else:
            self._bvh.rebuild()
        return self._bvh.id


class BroadPhase:
    """Finds the candidate pairs of a mesh: those that share no vertex and whose swept boxes overlap."""

    def __init__(self, mesh):
        self._mesh = mesh
        self._vertices = _Boxes(mesh.device_vertices)
        self._edges = _Boxes(mesh.device_edges)
        self._faces = _Boxes(mesh.device_faces)
        self._pairs = {}

    def vertex_face(self, x0, x1):
        """Candidate pairs (vertex, face) of a motion from x0 to x1, Warp array of vec2i, valid until the next call."""
        self._vertices.update(x0, x1)
        self._faces.update(x0, x1)
        return self._find(_pair_vertices_with_faces, self._faces, self._vertices, [self._mesh.device_faces])

    def edge_edge(self, x0, x1):
        """Candidate pairs (edge, edge) of a motion from x0 to x1, smaller first, valid until the next call."""
        self._edges.update(x0, x1)
        return self._find(_pair_edges, self._edges, self._edges, [])

    def edge_face(self, x):
        """Candidate pairs (edge, face) of a configuration, valid until the next call."""
        self._edges.update(x, x)
        self._faces.update(x, x)
        return self._find(_pair_edges_with_faces, self._faces, self._edges, [self._mesh.device_faces])

    def _find(self, kernel, tree, queries, more):
        """Runs a traversal, again with more room if the pairs did not fit."""
        device = self._mesh.device
        count = wp.zeros(1, dtype=wp.int64, device=device)
        pairs = self._pairs.setdefault(kernel, wp.empty(8 * len(queries.elements), dtype=wp.vec2i, device=device))
        if len(queries.elements) == 0:
            return pairs
        inputs = [tree.hierarchy(), queries.elements, queries.lowers, queries.uppers, *more]
        while True:
            wp.launch(kernel, len(queries.elements), inputs=inputs, outputs=[pairs, count], device=device)
            found = int(count.numpy()[0])
            if found <= len(pairs):
                return pairs[:found]
            if found >= 2**31:
                raise ValueError(f"{found} candidate pairs are more than one call can handle (2^31)")
            pairs = wp.empty(found + found // 4, dtype=wp.vec2i, device=device)
            self._pairs[kernel] = pairs
            count.zero_()
