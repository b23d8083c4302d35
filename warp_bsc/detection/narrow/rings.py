"""Rings of edges: the vertices of a mesh within a number of edges of each other, whose elements are always near."""

import numpy as np
import warp as wp

from ..._arguments import checked_integer
from ..._sorted_keys import distinct, expand_ranges
from ..mesh import CollisionMesh

_MAX_NEIGHBOURS = 256
"""Vertices within the rings of one, on average: each candidate compares its vertices with these."""

_MAX_PAIRS = 2**22
"""Largest number of pairs of vertices of a mesh that is too small for that average."""


@wp.struct
class Rings:
    """The other vertices within a number of edges of each vertex; without arrays there are none."""

    starts: wp.array[int]  # where those of each vertex start in ``neighbours``, and its length at last
    neighbours: wp.array[int]  # the vertices


@wp.func
def are_within_rings(corners: wp.vec4i, firsts: int, rings: Rings) -> bool:
    """Returns whether one of the first corners of a pair, 1 or 2, is within the rings of one of the others."""
    if not rings.starts:
        return False
    for first in range(firsts):
        vertex = corners[first]
        for i in range(rings.starts[vertex], rings.starts[vertex + 1]):
            for second in range(firsts, 4):
                if rings.neighbours[i] == corners[second]:
                    return True
    return False


def make_rings(mesh: CollisionMesh, rings: int) -> Rings:
    """Returns the vertices within ``rings`` edges of each vertex of a mesh, on its device.

    Args:
        mesh: The mesh.
        rings: Number of edges, at least 0.

    Raises:
        TypeError: If the number is no integer.
        ValueError: If it is negative, or vertices have more than 256 others within it on average, and more than 2^22
            together.
    """
    rings = checked_integer(rings, "rings")
    result = Rings()
    if rings == 0:
        return result
    n = mesh.vertex_count
    most = min(max(_MAX_PAIRS, _MAX_NEIGHBOURS * n), 2**31 - 1)
    # each pair (vertex, neighbour) is one number; those of a ring are neighbours of the ring before it
    ring = distinct(np.concatenate([mesh.edges, mesh.edges[:, ::-1]]).astype(np.int64) @ np.array([n, 1]))
    first, second = np.divmod(ring, max(1, n))
    starts, before = np.searchsorted(first, np.arange(n + 1)), np.arange(n) * (n + 1)
    reached = [ring]
    while len(reached) < rings and len(ring):
        vertices, neighbours = np.divmod(ring, n)
        degrees = np.diff(starts)[neighbours]
        if sum(map(len, reached)) > most or degrees.sum() > 2 * most:
            break
        rows, places = expand_ranges(starts[neighbours], starts[neighbours + 1])
        further = distinct(vertices[rows] * n + second[places])
        further = np.setdiff1d(further, ring, assume_unique=True)
        ring, before = np.setdiff1d(further, before, assume_unique=True), ring
        reached.append(ring)
    pairs = np.sort(np.concatenate(reached))
    if len(pairs) > most or (len(reached) < rings and len(ring)):
        near = f"{len(pairs)} pairs of its {n} vertices are within {len(reached)} edges"
        raise ValueError(f"rings must be less for this mesh, not {rings}: {near}, more than can be excluded")
    vertices, neighbours = np.divmod(pairs, max(1, n))
    result.starts = wp.array(np.searchsorted(vertices, np.arange(n + 1)), dtype=int, device=mesh.device)
    result.neighbours = wp.array(neighbours, dtype=int, device=mesh.device)
    return result
