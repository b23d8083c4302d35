"""Chooses the triangles that the view of a page shows, where a scene has too many."""

import numpy as np

__all__ = ["choose_faces"]

_LEVELS = 7  # the finest grid has 2^7 cells along an axis


def choose_faces(corners: np.ndarray, positions: np.ndarray, first: np.ndarray, most: int) -> np.ndarray:
    """Returns the faces to show: all, or those in cells around some positions, of the coarsest grid that fits.

    Args:
        corners: A corner of each face, shape [face_count, 3].
        positions: The positions to show, shape [n, 3].
        first: Faces that are shown before others, ascending.
        most: Largest number of faces to return.

    Returns:
        Faces, ascending.
    """
    if len(corners) <= most:
        return np.arange(len(corners))
    columns = np.ascontiguousarray(corners.T)  # faster to reduce
    low = columns.min(axis=1)[:, None]
    size = max(float((columns.max(axis=1, keepdims=True) - low).max()), np.finfo(np.float32).tiny)

    def cells(points):
        return np.clip((points - low) * (2**_LEVELS / size), 0, 2**_LEVELS - 1).astype(np.int32)

    def numbers(cells, level):
        return np.ravel_multi_index(tuple(cells >> (_LEVELS - level)), (2**level,) * 3)

    cells_of_faces, shown = cells(columns), cells(positions.T if len(positions) else columns[:, :1])
    shown = np.stack(np.unravel_index(np.unique(numbers(shown, _LEVELS)), (2**_LEVELS,) * 3))
    finest = np.bincount(numbers(cells_of_faces, _LEVELS), minlength=8**_LEVELS)  # faces by cell
    for level in range(1, _LEVELS + 1):
        count, shift = 2**level, _LEVELS - level
        around = np.zeros((count + 2,) * 3, dtype=bool)  # with a margin of one cell
        x, y, z = shown >> shift
        for i, j, k in np.ndindex(3, 3, 3):
            around[x + i, y + j, z + k] = True
        around = around[1:-1, 1:-1, 1:-1].reshape(-1)
        faces_of_cells = finest.reshape((count, 2**shift) * 3).sum(axis=(1, 3, 5)).reshape(-1)
        others = np.count_nonzero(~around[numbers(cells_of_faces[:, first], level)])
        if faces_of_cells[around].sum() + others <= most:
            near = around[numbers(cells_of_faces, level)]
            near[first] = True
            return np.flatnonzero(near)
    return first[np.linspace(0, len(first) - 1, min(len(first), most)).astype(int)]
