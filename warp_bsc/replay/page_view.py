"""Chooses the triangles that the view of a page shows, where a scene has too many."""

import numpy as np

__all__ = ["choose_faces"]

_LEVELS = 7  # the finest grid has 2^7 cells along an axis


def choose_faces(corners: np.ndarray, places: np.ndarray, wanted: np.ndarray, most: int) -> np.ndarray:
    """Returns the faces to show: all, or those in cells of a grid around some places, of the coarsest grid that fits.

    Args:
        corners: A corner of each face, shape [face_count, 3].
        places: The places that are to be seen, shape [n, 3].
        wanted: Faces that are shown before others, ascending.
        most: The most faces to return.

    Returns:
        Faces, ascending.
    """
    if len(corners) <= most:
        return np.arange(len(corners))
    columns = np.ascontiguousarray(corners.T)  # fast along the rows
    low = columns.min(axis=1)[:, None]
    size = max(float((columns.max(axis=1, keepdims=True) - low).max()), np.finfo(np.float32).tiny)

    def cells(points):
        return np.clip((points - low) * (2**_LEVELS / size), 0, 2**_LEVELS - 1).astype(np.int32)

    def numbers(cells, level):
        return np.ravel_multi_index(tuple(cells >> (_LEVELS - level)), (2**level,) * 3)

    cells_of_faces, cells_of_places = cells(columns), cells(places.T if len(places) else columns[:, :1])
    cells_of_places = np.stack(np.unravel_index(np.unique(numbers(cells_of_places, _LEVELS)), (2**_LEVELS,) * 3))
    finest = np.bincount(numbers(cells_of_faces, _LEVELS), minlength=8**_LEVELS)  # faces by cell
    for level in range(1, _LEVELS + 1):
        count, shift = 2**level, _LEVELS - level
        around = np.zeros((count + 2,) * 3, dtype=bool)  # a cell more on each side
        x, y, z = cells_of_places >> shift
        for i, j, k in np.ndindex(3, 3, 3):
            around[x + i, y + j, z + k] = True
        around = around[1:-1, 1:-1, 1:-1].reshape(-1)
        faces_of_cells = finest.reshape((count, 2**shift) * 3).sum(axis=(1, 3, 5)).reshape(-1)
        others = np.count_nonzero(~around[numbers(cells_of_faces[:, wanted], level)])
        if faces_of_cells[around].sum() + others <= most:
            near = around[numbers(cells_of_faces, level)]
            near[wanted] = True
            return np.flatnonzero(near)
    return wanted[np.linspace(0, len(wanted) - 1, min(len(wanted), most)).astype(int)]
