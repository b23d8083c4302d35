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
        return np.clip((points - low) * (2**_LEVELS / size), 0, 2**_LEVELS - 1).astype(np.int16)

    cells_of_faces, cells_of_places = cells(columns), cells(places.T if len(places) else columns[:, :1])
    for level in range(1, _LEVELS + 1):
        count, shift = 2**level, _LEVELS - level
        around = np.zeros((count + 2,) * 3, dtype=bool)  # a cell more on each side
        x, y, z = np.unique(cells_of_places >> shift, axis=1)
        for i, j, k in np.ndindex(3, 3, 3):
            around[x + i, y + j, z + k] = True
        x, y, z = (cells_of_faces >> shift) + 1
        near = around[x, y, z]
        near[wanted] = True
        if np.count_nonzero(near) <= most:
            return np.flatnonzero(near)
    return wanted[np.linspace(0, len(wanted) - 1, min(len(wanted), most)).astype(int)]
