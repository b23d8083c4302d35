"""Rings of edges: which vertices of a mesh are so few edges apart that their elements are always near."""

import numpy as np
import warp as wp

from .mesh import CollisionMesh

__all__ = ["Rings", "are_within_rings", "make_rings"]


@wp.struct
class Rings:
    """The vertices within some edges of each vertex, but itself; without arrays there are none.

    Attributes:
        starts: Where those of each vertex start in ``neighbours``, and its length at last.
        neighbours: The vertices.
    """

    starts: wp.array[int]
    neighbours: wp.array[int]


@wp.func
def are_within_rings(corners: wp.vec4i, firsts: int, rings: Rings) -> bool:
    """Whether one of the first corners of a pair, 1 or 2, is within the rings of one of the others."""
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
    """Returns the vertices within so many edges of each vertex of a mesh, on its device.

    Args:
        mesh: The mesh.
        rings: Number of edges, at least 0.

    Raises:
        ValueError: If the number is no integer of at least 0.
    """
    if int(rings) != rings or rings < 0:
        raise ValueError(f"rings must be an integer of at least 0, not {rings!r}")
    result = Rings()
    if rings == 0:
        return result
    n = mesh.vertex_count
    edges = np.unique(np.concatenate([mesh.edges, mesh.edges[:, ::-1]]).astype(np.int64), axis=0)
    starts = np.searchsorted(edges[:, 0], np.arange(n + 1))
    reached = edges
    for _ in range(rings - 1):
        # every pair (vertex, neighbour) goes on to the neighbours of that neighbour
        degrees = np.diff(starts)[reached[:, 1]]
        first = np.repeat(starts[reached[:, 1]] - (np.cumsum(degrees) - degrees), degrees)
        ends = edges[first + np.arange(degrees.sum()), 1]
        more = np.stack([np.repeat(reached[:, 0], degrees), ends], axis=1)
        reached = np.unique(np.concatenate([reached, more[more[:, 0] != more[:, 1]]]), axis=0)
    result.starts = wp.array(np.searchsorted(reached[:, 0], np.arange(n + 1)), dtype=int, device=mesh.device)
    result.neighbours = wp.array(reached[:, 1], dtype=int, device=mesh.device)
    return result
