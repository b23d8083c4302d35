"""The points of pairs of a mesh's elements, in the rows that elementary queries and the exact checker read."""

import numpy as np

__all__ = ["query_points"]


def query_points(elements: np.ndarray, pairs: np.ndarray, x0: np.ndarray, x1: np.ndarray) -> np.ndarray:
    """Returns the eight points of each pair of elements of a moving mesh, a row of an elementary query each.

    The rows are those that :func:`warp_bsc.query_vertex_face`, :func:`warp_bsc.query_edge_edge` and the functions of
    :mod:`warp_bsc.checker` read. This decides exactly the hits that a detector has found::

        hits = detector.detect(x0, x1)
        rows = bsc.query_points(detector.mesh.edges, hits.edge_edge, x0, x1)
        assert bsc.checker.edge_edge(rows).all()

    Args:
        elements: Vertex indices of the mesh's faces, shape [face_count, 3], for pairs of a vertex and a face; or of its
            edges, shape [edge_count, 2], for pairs of two edges.
        pairs: (vertex, face) or (edge, edge), shape [n, 2].
        x0: Positions of the vertices at the start, shape [vertex_count, 3].
        x1: Positions at the end, shape [vertex_count, 3], of the same type.

    Returns:
        Positions of the type of ``x0``, shape [n, 8, 3]: rows p0 a0 b0 c0 p1 a1 b1 c1 of a vertex and a face, or rows
        a0 b0 c0 d0 a1 b1 c1 d1 of two edges.

    Raises:
        ValueError: If the elements are neither faces nor edges.
        IndexError: If there is no such element or vertex.
    """
    if elements.ndim != 2 or elements.shape[1] not in (2, 3):
        raise ValueError(f"elements must have shape (n, 3) for faces or (n, 2) for edges, got {elements.shape}")
    first = pairs[:, :1] if elements.shape[1] == 3 else elements[pairs[:, 0]]
    corners = np.concatenate([first, elements[pairs[:, 1]]], axis=1)
    return np.concatenate([x0[corners], x1[corners]], axis=1)
