"""From pairs of faces to pairs of elements: representative triangles (Curtis et al. 2008).

Every vertex and every edge belongs to one face that has it, its representative. Two elements with overlapping boxes
have representatives with overlapping boxes, so that one traversal over faces finds all pairs, each of them once.
"""

import warp as wp


@wp.func
def owns_vertex(owned: int, corner: int) -> bool:
    """Whether a face is the representative of the vertex at a corner."""
    return (owned >> corner) & 1 == 1


@wp.func
def owns_edge(owned: int, side: int) -> bool:
    """Whether a face is the representative of the edge from corner ``side`` to the next."""
    return (owned >> (3 + side)) & 1 == 1
