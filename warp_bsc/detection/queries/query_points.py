"""The points of pairs of a mesh's elements, in the rows that elementary queries and the exact checker read."""

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..._arguments import as_numpy, checked_choice, checked_shape
from ..run.settings import PairKind

_CORNERS = {"vertex_face": (1, 3), "edge_edge": (2, 2), "vertex_edge": (1, 2), "vertex_vertex": (1, 1)}
"""Number of vertices of both elements, by kind of pair."""


def query_points(
    elements: ArrayLike | wp.array | None,
    pairs: ArrayLike | wp.array,
    x0: ArrayLike | wp.array,
    x1: ArrayLike | wp.array,
    *,
    kind: str | None = None,
) -> np.ndarray:
    """Returns the points of each pair of elements of a moving mesh, a row of an elementary query each.

    The rows are those that :func:`warp_bsc.query_vertex_face`, :func:`warp_bsc.query_edge_edge` and so on, and the
    functions of :mod:`warp_bsc.checker` read. This decides exactly the hits that a detector has found::

        hits = detector.detect(x0, x1)
        rows = bsc.query_points(detector.mesh.edges, hits.edge_edge, x0, x1)
        assert bsc.checker.edge_edge(rows).all()

    Args:
        elements: Vertex indices of the mesh's faces, shape [face_count, 3], for pairs of a vertex and a face; of its
            edges, shape [edge_count, 2], for pairs of two edges or of a vertex and an edge; None for two vertices.
        pairs: Pairs of indices, a vertex by its own and first, integers, shape [n, 2].
        x0: Positions of the vertices at the start, shape [vertex_count, 3].
        x1: Positions at the end, shape [vertex_count, 3], of the same type.
        kind: "vertex_face", "edge_edge", "vertex_edge" or "vertex_vertex". By default that of the elements, for edges
            "edge_edge" as a detector returns it: the smaller edge first, and without a common vertex.

    Returns:
        Positions of the type of ``x0``: for a vertex and a face rows p0 a0 b0 c0 p1 a1 b1 c1, for two edges rows
        a0 b0 c0 d0 a1 b1 c1 d1, shape [n, 8, 3]; for a vertex and an edge p0 a0 b0 p1 a1 b1, shape [n, 6, 3]; for two
        vertices p0 q0 p1 q1, shape [n, 4, 3].

    Raises:
        TypeError: If an argument has another type.
        ValueError: If the elements are not of the kind, positions have another shape or differ in type, or pairs of
            edges are none of a detector and no ``kind`` is given.
        IndexError: If an index of an element or a vertex is out of range.
    """
    x0, x1 = checked_shape(x0, (3,), "x0"), checked_shape(x1, (3,), "x1")
    if x0.dtype != x1.dtype or x0.shape != x1.shape:
        raise ValueError(f"x1 must be as x0, {x0.dtype} {x0.shape}, not {x1.dtype} {x1.shape}")
    count = len(x0)
    vertices = np.arange(count)[:, None]
    elements = vertices if elements is None else _checked_indices(elements, "elements", count)
    if elements.ndim != 2 or elements.shape[1] not in (1, 2, 3):
        raise ValueError(f"elements must have shape (n, 3) for faces or (n, 2) for edges, got {elements.shape}")
    of_elements = ("vertex_vertex", "edge_edge", "vertex_face")[elements.shape[1] - 1]
    name = of_elements if kind is None else checked_choice(kind, "kind", tuple(_CORNERS))
    one, other = _CORNERS[name]
    if other != elements.shape[1]:
        raise ValueError(f"kind must be of elements with {elements.shape[1]} vertices, not {kind}")
    pairs = as_numpy(pairs, "pairs")
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValueError(f"pairs must have shape (n, 2), got {pairs.shape}")
    firsts = elements if one == other else vertices
    _checked_indices(pairs[:, 0], "pairs", len(firsts))
    _checked_indices(pairs[:, 1], "pairs", len(elements))
    first, second = firsts[pairs[:, 0]], elements[pairs[:, 1]]
    if kind is None and name == "edge_edge":
        _check_detected(pairs, first, second)
    corners = np.concatenate([first, second], axis=1)
    return np.concatenate([x0[corners], x1[corners]], axis=1)


def mesh_of_rows(kind: PairKind, points: np.ndarray, device: wp.Device) -> tuple[wp.array, wp.array, np.ndarray]:
    """Returns a mesh in which each pair has vertices of its own: positions, second elements, and the pairs.

    Args:
        kind: The kind of pair.
        points: The points of each pair at one time, float32 or float64, shape [n, kind.points, 3].
        device: The device of the positions and the elements.
    """
    dtype = wp.vec3 if points.dtype == np.float32 else wp.vec3d
    x = wp.array(np.ascontiguousarray(points).reshape(-1, 3), dtype=dtype, device=device)
    elements, pairs = elements_of_rows(kind, np.arange(len(x), dtype=np.int32).reshape(points.shape[:2]))
    return x, wp.array(elements, dtype=int, device=device), pairs


def elements_of_rows(kind: PairKind, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the second elements of pairs that have vertices of their own, and the pairs, each from a row of vertices.

    The elements of two edges are those of all first and second edges. All are int32, as the vertices, C-contiguous.
    """
    rows = np.arange(len(vertices), dtype=np.int32)
    if kind == PairKind.EDGE_EDGE:
        return vertices.reshape(-1, 2), np.stack([2 * rows, 2 * rows + 1], axis=1)
    elements = np.ascontiguousarray(vertices[:, 1:])
    return elements, vertices if kind == PairKind.VERTEX_VERTEX else np.stack([vertices[:, 0], rows], axis=1)


def _check_detected(pairs: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """Raises an error if a detector returns no such pair of edges: those of a vertex and an edge look alike."""
    bad = (pairs[:, 0] >= pairs[:, 1]) | (first[:, :, None] == second[:, None, :]).any(axis=(1, 2))
    if bad.any():
        row = int(np.argmax(bad))
        raise ValueError(
            f"pairs[{row}], {pairs[row].tolist()}, is no pair of edges of a detector, which has the smaller one first "
            "and no common vertex: give kind='vertex_edge' or kind='edge_edge'"
        )


def _checked_indices(given, name, count):
    """Returns indices as NumPy; raises an error if they are not integers in [0, count)."""
    indices = as_numpy(given, name)
    if indices.dtype.kind not in "iu":
        raise ValueError(f"{name} must be integers, got {indices.dtype}")
    if indices.size and not (indices.min() >= 0 and indices.max() < count):
        raise IndexError(f"{name} must be in [0, {count}), got {indices.min()} to {indices.max()}")
    return indices
