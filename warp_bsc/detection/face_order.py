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

_LARGE = wp.constant(4096)
"""Faces of a part that is split along the best of four axes instead of eight, which takes less time."""

_STAMPS = 16
"""Stamps that halving a part takes, at most."""

_MIN_OWN_CLUSTER = 8
"""Connected components with fewer faces share clusters, so that at most three of four places are empty."""

_AXES = wp.constant(wp.types.matrix(shape=(8, 2), dtype=int)(1, 0, 0, 1, 1, 1, 1, -1, 2, 1, 2, -1, 1, 2, 1, -2))
"""Directions in the plane of both coordinates, from pole to pole, along which parts may be split."""


@wp.struct
class _Faces:
    """The faces of a mesh while they are ordered."""

    links: wp.array2d[int]  # the faces that each is linked to at its edges, -1 for none
    order: wp.array[int]
    place_of: wp.array[int]  # in the order
    visited: wp.array[int]  # stamp of the last search that came to a face
    queue: wp.array[int]  # a part in another order, by place, as are the next two
    keys: wp.array[int]
    buckets: wp.array[int]
    distances: wp.array2d[int]  # of each face from four poles


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
                    place = faces.place_of[other]
                    if place >= begin and place < end and faces.visited[other] != stamp:
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
def _find_components(faces: _Faces, starts: wp.array[int], component_count: wp.array[int]):
    """Writes the faces by connected component to the queue, and where each component starts."""
    count = int(0)
    filled = int(0)
    for i in range(faces.order.shape[0]):
        if faces.visited[faces.order[i]] == 0:
            starts[count] = filled
            count += 1
            faces.visited[faces.order[i]] = 1
            faces.queue[filled] = faces.order[i]
            read = int(filled)
            filled += 1
            while read < filled:
                face = faces.queue[read]
                read += 1
                for k in range(faces.links.shape[1]):
                    other = faces.links[face, k]
                    if other >= 0:
                        if faces.visited[other] == 0:
                            faces.visited[other] = 1
                            faces.queue[filled] = other
                            filled += 1
    component_count[0] = count


@wp.func
def _farthest(begin: int, end: int, order: wp.array[int], distances: wp.array2d[int], poles: int):
    """Returns the face of a part that is farthest from the nearest of some poles."""
    farthest = order[begin]
    most = int(-1)
    for i in range(begin, end):
        face = order[i]
        nearest = distances[0, face]
        for pole in range(1, poles):
            nearest = wp.min(nearest, distances[pole, face])
        if nearest > most:
            most = nearest
            farthest = face
    return farthest


@wp.func
def _coordinate(axis: int, face: int, distances: wp.array2d[int]):
    """Returns the coordinate of a face along an axis."""
    u = distances[0, face] - distances[1, face]
    v = distances[2, face] - distances[3, face]
    axes = _AXES
    return axes[axis, 0] * u + axes[axis, 1] * v


@wp.func
def _sort(faces: _Faces, begin: int, end: int, axis: int):
    """Writes the faces of a part to the queue, sorted along an axis, by counting."""
    keys = faces.keys
    buckets = faces.buckets
    lowest = _coordinate(axis, faces.order[begin], faces.distances)
    highest = lowest
    for i in range(begin, end):
        key = _coordinate(axis, faces.order[i], faces.distances)
        lowest = wp.min(lowest, key)
        highest = wp.max(highest, key)
        keys[i] = key
        buckets[i] = 0
    width = (highest - lowest) / (end - begin) + 1
    for i in range(begin, end):
        bucket = begin + (keys[i] - lowest) / width
        keys[i] = bucket
        buckets[bucket] = buckets[bucket] + 1
    place = int(begin)
    for i in range(begin, end):
        size = buckets[i]
        buckets[i] = place
        place += size
    for i in range(begin, end):
        bucket = keys[i]
        faces.queue[buckets[bucket]] = faces.order[i]
        buckets[bucket] = buckets[bucket] + 1


@wp.func
def _count_cut(faces: _Faces, begin: int, split: int, end: int, stamp: int):
    """Returns how many links the two halves of a part in the queue have with one another."""
    for i in range(begin, split):
        faces.visited[faces.queue[i]] = stamp
    cut = int(0)
    for i in range(split, end):
        for k in range(faces.links.shape[1]):
            other = faces.links[faces.queue[i], k]
            if other >= 0:
                place = faces.place_of[other]
                if place >= begin and place < end and faces.visited[other] == stamp:
                    cut += 1
    return cut


@wp.kernel(**NO_GRADIENTS)
def _halve_parts(first: int, faces: _Faces, parts: wp.array[wp.vec2i], stamp: int, splits: wp.array[int]):
    """Orders each part by the half that its faces are in; parts may be halved at once, as no face is in two.

    A part has the places from the first to before the second of its numbers. ``stamp`` is :data:`_STAMPS` more than in
    the launch before.
    """
    i = first + wp.tid()
    begin = parts[i][0]
    end = parts[i][1]
    order = faces.order
    _visit(faces, begin, end, order[begin], stamp, faces.distances[0])
    pole = faces.queue[end - 1]
    for k in range(4):
        if k > 0:
            pole = _farthest(begin, end, order, faces.distances, k)
        _visit(faces, begin, end, pole, stamp + 1 + k, faces.distances[k])
    for k in range(begin, end):
        order[k] = faces.queue[k]
    split = _split_at(begin, end)
    best = int(0)
    least_cut = int(2147483647)
    for axis in range(wp.where(end - begin > _LARGE, 4, 8)):
        _sort(faces, begin, end, axis)
        cut = _count_cut(faces, begin, split, end, stamp + 5 + axis)
        if cut < least_cut:
            least_cut = cut
            best = axis
    _sort(faces, begin, end, best)
    for k in range(begin, end):
        order[k] = faces.queue[k]
        faces.place_of[faces.queue[k]] = k
    splits[i] = split


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
    n = len(faces)
    if n == 0:
        return np.empty(0, dtype=np.int32)

    def on_host(values: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=int, device="cpu")

    links, mesh = _links(faces), _Faces()
    order = np.arange(n) if world is None else np.argsort(world, kind="stable")
    mesh.links, mesh.order, mesh.visited, mesh.queue = map(on_host, (links, order, np.zeros(n), np.zeros(n)))
    starts, count = on_host(np.zeros(n)), on_host(np.zeros(1))
    launch(_find_components, 1, inputs=[mesh, starts, count], device="cpu", record_tape=False)

    # neighbours get numbers close to one another, for the sake of processor caches
    face_of = mesh.queue.numpy()
    number_of = np.empty(n + 1, dtype=np.int32)
    number_of[face_of] = np.arange(n)
    number_of[-1] = -1
    links = number_of[links[face_of]]
    starts = starts.numpy()[: count.numpy()[0]]
    sizes = np.diff(starts, append=n)
    places = _component_places(sizes)
    place_of = np.arange(n) + np.repeat(places[:-1] - starts, sizes)
    numbers = np.full(places[-1], -1, dtype=np.int32)
    numbers[place_of] = np.arange(n)

    device = wp.get_device("cpu")
    mesh.links, mesh.order, mesh.place_of, mesh.visited = map(on_host, (links, numbers, place_of, np.zeros(n)))
    mesh.queue, mesh.keys, mesh.buckets = (wp.empty_like(mesh.order) for _ in range(3))
    mesh.distances = wp.empty((4, n), dtype=int, device=device)
    parts = np.stack([places[:-1], places[:-1] + sizes], axis=1)
    stamp = 1
    while len(parts := parts[parts[:, 1] - parts[:, 0] > CLUSTER]):
        splits = wp.empty(len(parts), dtype=int, device=device)
        inputs = [mesh, wp.array(parts.astype(np.int32), dtype=wp.vec2i, device=device), stamp]
        launch_over(_halve_parts, len(parts), inputs=inputs, outputs=[splits], device=device, chunk=1)
        middle = splits.numpy()
        parts = np.concatenate([np.stack([parts[:, 0], middle], axis=1), np.stack([middle, parts[:, 1]], axis=1)])
        stamp += _STAMPS
    result = mesh.order.numpy()
    return np.where(result < 0, -1, face_of[result])
