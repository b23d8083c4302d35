"""An order of a mesh's faces in which neighbours are near: each run of faces is a compact, connected patch."""

import numpy as np
import warp as wp

from ..kernels.pipeline.hierarchy import WIDTH
from .run.launch import launch, launch_over
from .run.settings import NO_GRADIENTS

CLUSTER = WIDTH
"""Places of a cluster."""

BUNDLE = WIDTH * CLUSTER
"""Places of a bundle."""

_STAMPS = 5
"""Stamps that halving a part takes."""

_MIN_OWN_CLUSTER = 8
"""Connected components with fewer faces share clusters, so that at most three of four places are empty."""

_Counts = wp.types.vector(length=8, dtype=int)

_AXES = wp.constant(wp.types.matrix(shape=(8, 2), dtype=int)(1, 0, 0, 1, 1, 1, 1, -1, 2, 1, 2, -1, 1, 2, 1, -2))
"""Directions in the plane of both coordinates, from pole to pole, along which parts may be split."""

_LARGE = wp.constant(4096)
"""Faces of a part that is split along the best of four axes instead of eight, which takes less time."""


@wp.struct
class _Faces:
    """The faces of a mesh while they are ordered."""

    links: wp.array2d[int]  # the faces of its part that each is linked to at its edges, -1 for none
    order: wp.array[int]
    visited: wp.array[int]  # stamp of the last search that came to a face
    queue: wp.array[int]  # a part in another order, by place, as are the next four
    u: wp.array[int]
    v: wp.array[int]
    keys: wp.array[int]
    buckets: wp.array[int]
    distances: wp.array2d[int]  # of each face from four poles
    halves: wp.array[int]  # bits of each face: whether it would be in the second half along an axis


@wp.func
def _visit(faces: _Faces, begin: int, end: int, seed: int, stamp: int, distance: wp.array[int]):
    """Writes the faces of a part to a queue, breadth first from a seed, and their distances.

    The part is ``order[begin:end]``. Faces that the seed does not reach follow, in pieces, as if they were next to the
    last.
    """
    filled = int(begin)
    read = int(begin)
    scanned = int(begin)
    face = int(seed)
    steps = int(0)
    while filled < end:
        while faces.visited[face] == stamp:
            face = faces.order[scanned]
            scanned += 1
        faces.visited[face] = stamp
        distance[face] = steps
        faces.queue[filled] = face
        filled += 1
        while read < filled:
            face = faces.queue[read]
            read += 1
            steps = distance[face] + 1
            for k in range(faces.links.shape[1]):
                other = faces.links[face, k]
                if other >= 0:
                    if faces.visited[other] != stamp:
                        faces.visited[other] = stamp
                        distance[other] = steps
                        faces.queue[filled] = other
                        filled += 1


@wp.func
def _split_at(begin: int, end: int):
    """Returns where to split a part near the middle: between bundles or else between clusters."""
    middle = (begin + end) / 2
    quarter = (end - begin) / 4
    split = (middle + BUNDLE / 2) / BUNDLE * BUNDLE
    if split > begin + quarter and split < end - quarter:
        return split
    split = (middle + CLUSTER / 2) / CLUSTER * CLUSTER
    if split >= end:
        split -= CLUSTER
    return split


@wp.kernel(**NO_GRADIENTS)
def _visit_all(faces: _Faces):
    """Writes all faces by connected component to the queue, breadth first."""
    _visit(faces, 0, faces.order.shape[0], faces.order[0], 1, faces.distances[0])


@wp.func
def _farthest(faces: _Faces, begin: int, end: int, poles: int):
    """Returns the face of a part that is farthest from the nearest of some poles; uses the keys."""
    farthest = faces.order[begin]
    most = int(-1)
    for i in range(begin, end):
        face = faces.order[i]
        nearest = faces.distances[poles - 1, face]
        if poles > 1:
            nearest = wp.min(nearest, faces.keys[i])
        faces.keys[i] = nearest
        if nearest > most:
            most = nearest
            farthest = face
    return farthest


@wp.func
def _fill_buckets(faces: _Faces, begin: int, end: int, axis: int):
    """Writes the bucket along an axis, as the key, of the face at each place of a part, and how many faces each has."""
    axes = _AXES
    lowest, highest = int(2147483647), int(-2147483647)
    for i in range(begin, end):
        key = axes[axis, 0] * faces.u[faces.order[i]] + axes[axis, 1] * faces.v[faces.order[i]]
        lowest = wp.min(lowest, key)
        highest = wp.max(highest, key)
        faces.keys[i] = key
        faces.buckets[i] = 0
    shift = int(0)
    while (highest - lowest) >> shift >= end - begin:
        shift += 1
    for i in range(begin, end):
        bucket = begin + ((faces.keys[i] - lowest) >> shift)
        faces.keys[i] = bucket
        faces.buckets[bucket] = faces.buckets[bucket] + 1


@wp.func
def _mark_half(faces: _Faces, begin: int, split: int, end: int, axis: int):
    """Sets the bit of an axis in those faces of a part that would be in its second half, sorted along the axis."""
    _fill_buckets(faces, begin, end, axis)
    middle = int(begin)
    left = split - begin  # places of the first half
    while faces.buckets[middle] <= left:
        left -= faces.buckets[middle]
        middle += 1
    for i in range(begin, end):
        bucket = faces.keys[i]
        is_second = bucket > middle
        if bucket == middle:
            is_second = left <= 0
            left -= 1
        bits = wp.where(axis == 0, 0, faces.halves[faces.order[i]])
        faces.halves[faces.order[i]] = bits | (int(is_second) << axis)


@wp.func
def _halve(faces: _Faces, begin: int, split: int, end: int):
    """Sorts a part along the axis whose halves share the fewest edges, and cuts the links between these."""
    axes = wp.where(end - begin > _LARGE, 4, 8)
    for axis in range(axes):
        _mark_half(faces, begin, split, end, axis)
    cuts = _Counts()  # links from the second half to the first
    for i in range(begin, end):
        face = faces.order[i]
        for k in range(faces.links.shape[1]):
            other = faces.links[face, k]
            if other >= 0:
                cut = faces.halves[face] & ~faces.halves[other]
                if cut != 0:
                    for axis in range(axes):
                        cuts[axis] += (cut >> axis) & 1
    best = int(0)
    for axis in range(1, axes):
        if cuts[axis] < cuts[best]:
            best = axis
    _fill_buckets(faces, begin, end, best)
    place = int(begin)
    for i in range(begin, end):
        size = faces.buckets[i]
        faces.buckets[i] = place
        place += size
    for i in range(begin, end):
        bucket = faces.keys[i]
        faces.queue[faces.buckets[bucket]] = faces.order[i]
        faces.buckets[bucket] = faces.buckets[bucket] + 1
    for i in range(begin, end):
        face = faces.queue[i]
        faces.order[i] = face
        for k in range(faces.links.shape[1]):
            other = faces.links[face, k]
            if other >= 0:
                if ((faces.halves[face] ^ faces.halves[other]) >> best) & 1 != 0:
                    faces.links[face, k] = -1


@wp.kernel(**NO_GRADIENTS)
def _halve_parts(first: int, faces: _Faces, parts: wp.array[wp.vec2i], stamp: int, splits: wp.array[int]):
    """Orders each part by the half that its faces are in; parts may be halved at once, as no face is in two.

    A part has the places from the first to before the second of its numbers. ``stamp`` is :data:`_STAMPS` more than in
    the launch before.
    """
    part = first + wp.tid()
    begin = parts[part][0]
    end = parts[part][1]
    _visit(faces, begin, end, faces.order[begin], stamp, faces.distances[0])
    pole = faces.queue[end - 1]
    for k in range(4):
        if k > 0:
            pole = _farthest(faces, begin, end, k)
        _visit(faces, begin, end, pole, stamp + 1 + k, faces.distances[k])
    for i in range(begin, end):
        face = faces.queue[i]
        faces.order[i] = face
        faces.u[face] = faces.distances[0, face] - faces.distances[1, face]
        faces.v[face] = faces.distances[2, face] - faces.distances[3, face]
    split = _split_at(begin, end)
    _halve(faces, begin, split, end)
    splits[part] = split


def _links(faces: np.ndarray) -> np.ndarray:
    """Returns the faces that each face is linked to at its edges, int32, shape [face_count, 6], -1 for none.

    The faces of an edge form a chain in the order of their indices, so that an edge of many faces costs no more than
    one of two.
    """
    links = np.full((len(faces), 6), -1, dtype=np.int32)
    first, second = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(first, second).astype(np.int64) << 32 | np.maximum(first, second)
    sides = np.argsort(keys, kind="stable")
    sides = sides[first[sides] != second[sides]]
    linked = keys[sides[1:]] == keys[sides[:-1]]
    before, after = sides[:-1][linked], sides[1:][linked]
    links[before // 3, 2 * (before % 3)] = after // 3
    links[after // 3, 2 * (after % 3) + 1] = before // 3
    return links


def _component_places(sizes: np.ndarray) -> np.ndarray:
    """Returns the place at which each connected component starts, and the number of places at last.

    Components of at least :data:`_MIN_OWN_CLUSTER` faces start at a cluster of their own. Smaller ones follow one
    another without a gap.
    """
    small = sizes < _MIN_OWN_CLUSTER
    joins = np.zeros(len(sizes), dtype=bool)
    joins[1:] = small[1:] & small[:-1]
    # runs of components without a gap; each run starts at a cluster
    run = np.cumsum(~joins) - 1
    run_sizes = np.bincount(run, weights=sizes).astype(np.int64)
    run_places = np.concatenate([[0], np.cumsum(-(-run_sizes // CLUSTER) * CLUSTER)])
    before = np.cumsum(sizes) - sizes
    first_of_run = np.flatnonzero(~joins)
    return np.append(run_places[run] + before - before[first_of_run][run], run_places[-1])


def order_faces(faces: np.ndarray, world: np.ndarray | None = None) -> np.ndarray:
    """Returns the faces in an order in which each cluster of places is a compact patch of one connected component.

    Connectivity alone decides, so that the order stays good however the mesh moves. Each component is bisected until
    its parts fit in clusters. Breadth-first searches from four faces at its rim, far from one another, give each face
    coordinates, the differences of its distances from two opposite ones. Of several directions in these coordinates
    the one is halved whose halves share the fewest edges. Time grows with ``n log n``.

    Args:
        faces: Vertex indices of the faces, int32, shape [face_count, 3].
        world: World of each face, int32, shape [face_count]; None if all are in one. Worlds follow one another.

    Returns:
        Face at each place, -1 for none, int32, shape [a multiple of CLUSTER]; up to four times as many as faces.
    """
    if not (n := len(faces)):
        return np.empty(0, dtype=np.int32)

    def on_host(values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=int, device="cpu")

    links, mesh = _links(faces), _Faces()
    order = np.arange(n) if world is None else np.argsort(world, kind="stable")
    mesh.links, mesh.order, mesh.visited, mesh.queue = map(on_host, (links, order, np.zeros(n), np.zeros(n)))
    mesh.distances = wp.empty((4, n), dtype=int, device="cpu")
    launch(_visit_all, 1, inputs=[mesh], device="cpu", record_tape=False)

    # neighbours get numbers close to one another, for the sake of processor caches
    face_of = mesh.queue.numpy()
    number_of = np.empty(n + 1, dtype=np.int32)
    number_of[face_of] = np.arange(n)
    number_of[-1] = -1
    links = number_of[links[face_of]]
    # the first face of a component has no link to one before it
    starts = np.flatnonzero((links.view(np.uint32) >= np.arange(n)[:, None]).all(axis=1))
    sizes = np.diff(starts, append=n)
    places = _component_places(sizes)
    place_of = np.arange(n) + np.repeat(places[:-1] - starts, sizes)
    numbers = np.full(places[-1], -1, dtype=np.int32)
    numbers[place_of] = np.arange(n)

    mesh.links, mesh.order, mesh.visited, mesh.halves = map(on_host, (links, numbers, np.zeros(n), np.zeros(n)))
    mesh.queue, mesh.u, mesh.v, mesh.keys, mesh.buckets = (wp.empty_like(mesh.order) for _ in range(5))
    parts = np.stack([places[:-1], places[:-1] + sizes], axis=1)
    stamp = 1
    while len(parts := parts[parts[:, 1] - parts[:, 0] > CLUSTER]):
        splits = wp.empty(len(parts), dtype=int, device="cpu")
        inputs = [mesh, wp.array(parts.astype(np.int32), dtype=wp.vec2i, device="cpu"), stamp]
        launch_over(_halve_parts, len(parts), inputs=inputs, outputs=[splits], device=wp.get_device("cpu"), chunk=1)
        middle = splits.numpy()
        parts = np.concatenate([np.stack([parts[:, 0], middle], axis=1), np.stack([middle, parts[:, 1]], axis=1)])
        stamp += _STAMPS
    return np.where((order := mesh.order.numpy()) < 0, -1, face_of[order])
