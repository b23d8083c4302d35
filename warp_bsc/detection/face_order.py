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

_CLUSTER = wp.constant(CLUSTER)
_BUNDLE = wp.constant(BUNDLE)

_LARGE = wp.constant(4096)
"""Faces of a part that is split along the best of four axes instead of eight, which takes less time."""

_STAMPS = 16
"""Stamps that halving a part takes, at most."""

_MIN_OWN_CLUSTER = 8
"""Connected components with fewer faces share clusters, so that at most three of four places are empty."""


@wp.func
def _visit(
    links: wp.array2d[int],
    begin: int,
    end: int,
    seed: int,
    stamp: int,
    order: wp.array[int],
    place_of: wp.array[int],
    # in and out
    visited: wp.array[int],
    # out
    queue: wp.array[int],
    distance: wp.array[int],
):
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
        while visited[face] == stamp:
            face = order[scanned]
            scanned += 1
        visited[face] = stamp
        distance[face] = steps
        queue[filled] = face
        filled += 1
        while read < filled:
            face = queue[read]
            read += 1
            steps = distance[face] + 1
            for k in range(links.shape[1]):
                other = links[face, k]
                if other >= 0:
                    place = place_of[other]
                    if place >= begin and place < end and visited[other] != stamp:
                        visited[other] = stamp
                        distance[other] = steps
                        queue[filled] = other
                        filled += 1


@wp.func
def _split_at(begin: int, end: int):
    """Returns where to split a part near the middle: between bundles or else between clusters."""
    middle = (begin + end) / 2
    quarter = (end - begin) / 4
    split = (middle + _BUNDLE / 2) / _BUNDLE * _BUNDLE
    if split > begin + quarter and split < end - quarter:
        return split
    split = (middle + _CLUSTER / 2) / _CLUSTER * _CLUSTER
    if split >= end:
        split -= _CLUSTER
    return split


@wp.kernel(**NO_GRADIENTS)
def _find_components(
    links: wp.array2d[int],
    # in and out
    order: wp.array[int],
    visited: wp.array[int],
    # out
    starts: wp.array[int],
    component_count: wp.array[int],
    queue: wp.array[int],
):
    """Writes the faces by connected component, and where each component starts."""
    count = int(0)
    filled = int(0)
    for i in range(order.shape[0]):
        if visited[order[i]] == 0:
            starts[count] = filled
            count += 1
            visited[order[i]] = 1
            queue[filled] = order[i]
            read = int(filled)
            filled += 1
            while read < filled:
                face = queue[read]
                read += 1
                for k in range(links.shape[1]):
                    other = links[face, k]
                    if other >= 0:
                        if visited[other] == 0:
                            visited[other] = 1
                            queue[filled] = other
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
    """Returns the coordinate of a face along one of four axes: from pole to pole, and the two between these."""
    u = distances[0, face] - distances[1, face]
    v = distances[2, face] - distances[3, face]
    if axis == 0:
        return u
    if axis == 1:
        return v
    if axis == 2:
        return u + v
    if axis == 3:
        return u - v
    if axis == 4:
        return 2 * u + v
    if axis == 5:
        return 2 * u - v
    if axis == 6:
        return u + 2 * v
    return u - 2 * v


@wp.func
def _sort(
    begin: int,
    end: int,
    axis: int,
    order: wp.array[int],
    distances: wp.array2d[int],
    # scratch
    keys: wp.array[int],
    buckets: wp.array[int],
    # out
    sorted_faces: wp.array[int],
):
    """Sorts the faces of a part along an axis, by counting."""
    lowest = _coordinate(axis, order[begin], distances)
    highest = lowest
    for i in range(begin, end):
        key = _coordinate(axis, order[i], distances)
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
        sorted_faces[buckets[bucket]] = order[i]
        buckets[bucket] = buckets[bucket] + 1


@wp.func
def _count_cut(
    links: wp.array2d[int],
    begin: int,
    split: int,
    end: int,
    stamp: int,
    sorted_faces: wp.array[int],
    place_of: wp.array[int],
    # in and out
    visited: wp.array[int],
):
    """Returns how many links the two halves of a part have with one another."""
    for i in range(begin, split):
        visited[sorted_faces[i]] = stamp
    cut = int(0)
    for i in range(split, end):
        for k in range(links.shape[1]):
            other = links[sorted_faces[i], k]
            if other >= 0:
                place = place_of[other]
                if place >= begin and place < end and visited[other] == stamp:
                    cut += 1
    return cut


@wp.kernel(**NO_GRADIENTS)
def _halve_parts(
    first: int,
    links: wp.array2d[int],
    parts: wp.array[wp.vec2i],
    stamp: int,
    # in and out
    order: wp.array[int],
    place_of: wp.array[int],
    visited: wp.array[int],
    # scratch
    queue: wp.array[int],
    keys: wp.array[int],
    buckets: wp.array[int],
    distances: wp.array2d[int],
    # out
    splits: wp.array[int],
):
    """Orders each part by the half that its faces are in; parts may be halved at once, as no face is in two.

    A part has the places from the first to before the second of its numbers. ``stamp`` is :data:`_STAMPS` more than in
    the launch before.
    """
    i = first + wp.tid()
    begin = parts[i][0]
    end = parts[i][1]
    _visit(links, begin, end, order[begin], stamp, order, place_of, visited, queue, distances[0])
    pole = queue[end - 1]
    for k in range(4):
        if k > 0:
            pole = _farthest(begin, end, order, distances, k)
        _visit(links, begin, end, pole, stamp + 1 + k, order, place_of, visited, queue, distances[k])
    for k in range(begin, end):
        order[k] = queue[k]
    split = _split_at(begin, end)
    best = int(0)
    least_cut = int(2147483647)
    for axis in range(wp.where(end - begin > _LARGE, 4, 8)):
        _sort(begin, end, axis, order, distances, keys, buckets, queue)
        cut = _count_cut(links, begin, split, end, stamp + 5 + axis, queue, place_of, visited)
        if cut < least_cut:
            least_cut = cut
            best = axis
    _sort(begin, end, best, order, distances, keys, buckets, queue)
    for k in range(begin, end):
        order[k] = queue[k]
        place_of[queue[k]] = k
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

    links = _links(faces)
    order = on_host(np.arange(n) if world is None else np.argsort(world, kind="stable"))
    starts, count, queue = on_host(np.zeros(n)), on_host(np.zeros(1)), wp.empty_like(order)
    inputs = [on_host(links), order, on_host(np.zeros(n)), starts, count, queue]
    launch(_find_components, 1, inputs=inputs, device="cpu", record_tape=False)

    # neighbours get numbers close to one another, for the sake of processor caches
    face_of = queue.numpy()
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
    result, links_on_host, place_of, visited = on_host(numbers), on_host(links), on_host(place_of), on_host(np.zeros(n))
    scratch = [*(wp.empty_like(result) for _ in range(3)), wp.empty((4, n), dtype=int, device=device)]
    parts = np.stack([places[:-1], places[:-1] + sizes], axis=1)
    stamp = 1
    while len(parts := parts[parts[:, 1] - parts[:, 0] > CLUSTER]):
        splits = wp.empty(len(parts), dtype=int, device=device)
        inputs = [links_on_host, wp.array(parts.astype(np.int32), dtype=wp.vec2i, device=device), stamp]
        inputs += [result, place_of, visited, *scratch]
        launch_over(_halve_parts, len(parts), inputs=inputs, outputs=[splits], device=device, chunk=1)
        middle = splits.numpy()
        parts = np.concatenate([np.stack([parts[:, 0], middle], axis=1), np.stack([middle, parts[:, 1]], axis=1)])
        stamp += _STAMPS
    return np.where(result.numpy() < 0, -1, face_of[result.numpy()])
