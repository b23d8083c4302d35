"""The points of pairs of a mesh's elements, in the rows that elementary queries and the exact checker read."""

import numpy as np

from .._arguments import as_numpy, checked_shape

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
        TypeError: If an argument is no array of numbers.
        ValueError: If the elements are neither faces nor edges, or positions have another shape or differ in type.
        IndexError: If an index of an element or a vertex is out of range.
    """
    x0, x1 = checked_shape(x0, (3,), "x0"), checked_shape(x1, (3,), "x1")
    if x0.dtype != x1.dtype or x0.shape != x1.shape:
        raise ValueError(f"x1 must be as x0, {x0.dtype} {x0.shape}, not {x1.dtype} {x1.shape}")
    elements, pairs = _checked_indices(elements, "elements", len(x0)), as_numpy(pairs, "pairs")
    if elements.ndim != 2 or elements.shape[1] not in (2, 3):
        raise ValueError(f"elements must have shape (n, 3) for faces or (n, 2) for edges, got {elements.shape}")
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValueError(f"pairs must have shape (n, 2), got {pairs.shape}")
    of_faces = elements.shape[1] == 3
    _checked_indices(pairs[:, 0], "pairs", len(x0) if of_faces else len(elements))
    _checked_indices(pairs[:, 1], "pairs", len(elements))
    first = pairs[:, :1] if of_faces else elements[pairs[:, 0]]
    corners = np.concatenate([first, elements[pairs[:, 1]]], axis=1)
    return np.concatenate([x0[corners], x1[corners]], axis=1)


def _checked_indices(given, name, count):
    """Returns indices as NumPy; raises an error if they are not integers in [0, count)."""
    indices = as_numpy(given, name)
    if indices.dtype.kind not in "iu":
        raise ValueError(f"{name} must be integers, got {indices.dtype}")
    if indices.size and not (indices.min() >= 0 and indices.max() < count):
        raise IndexError(f"{name} must be in [0, {count}), got {indices.min()} to {indices.max()}")
    return indices
