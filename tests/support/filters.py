"""Groups and masks by brute force: which pairs of a mesh they leave in."""

import numpy as np


def meet(mesh, first, second):
    """Which pairs of elements are left in, given by their vertices, shapes (n, 1 to 3) and (n, 1 to 3)."""
    group, mask = mesh.group.astype(np.int64), mesh.mask.astype(np.int64)
    one, other = first[:, :, None], second[:, None, :]
    return ((group[one] & mask[other]) != 0).all(axis=(1, 2)) & ((group[other] & mask[one]) != 0).all(axis=(1, 2))


def corners_of(mesh, kind, pairs):
    """The vertices of both elements of pairs of a kind, "edge_face" among them, each of shape (n, 1 to 3)."""
    elements = {"vertex": np.arange(mesh.vertex_count)[:, None], "edge": mesh.edges, "face": mesh.faces}
    one, other = kind.split("_")
    return elements[one][pairs[:, 0]], elements[other][pairs[:, 1]]


def left_in(mesh, kind, pairs):
    """The pairs of a kind that the groups and masks of a mesh leave in."""
    return pairs[meet(mesh, *corners_of(mesh, kind, pairs))]


def random_bits(rng, count):
    """One of four groups and masks of one to four, alike for three vertices each but for a tenth of the vertices."""
    group, first, second = (1 << np.repeat(rng.integers(0, 4, count // 3 + 1), 3)[:count] for _ in range(3))
    odd = rng.random(count) < 0.1
    return np.where(odd, group << 1 & 15, group), np.where(odd, 15, first | second)
