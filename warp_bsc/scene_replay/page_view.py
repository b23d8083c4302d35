"""What the view of a page shows of a scene with too many triangles: some of them, and an outline of all."""

from typing import NamedTuple

import numpy as np

from ..usd.segment import Segment

_LEVELS = 7  # the finest grid has 2^7 cells along an axis


def choose_faces(corners: np.ndarray, positions: np.ndarray, first: np.ndarray, most: int) -> np.ndarray:
    """Returns the faces to show: all, or those in cells around some positions, of the coarsest grid that fits.

    If the cells of the finest grid have too many, they are those around the cell with the most positions.

    Args:
        corners: A corner of each face, shape [face_count, 3].
        positions: The positions to show, shape [n, 3].
        first: Faces that are shown even if they are elsewhere, as long as there is space; ascending.
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
    keys, counts = np.unique(numbers(shown, _LEVELS), return_counts=True)
    shown = np.stack(np.unravel_index(keys, (2**_LEVELS,) * 3))
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
    most_crowded = (shown[:, counts.argmax()] + 0.5)[:, None]
    away = np.abs((columns - low) * (2**_LEVELS / size) - most_crowded).max(axis=0)
    return np.sort(np.argpartition(away, most - 1)[:most])


class Outline(NamedTuple):
    """The faces of a segment, merged to fewer ones.

    Attributes:
        vertices: The vertices of the segment that are its corners, ascending, shape [n].
        faces: Its faces, indices in ``vertices``, shape [m, 3].
    """

    vertices: np.ndarray
    faces: np.ndarray


def find_outline(segment: Segment, x: np.ndarray, most: int) -> Outline:
    """Returns an outline of a segment: the vertices of a mesh in one cell of a grid become one of them.

    Args:
        segment: The segment.
        x: Positions of its vertices, shape [vertex_count, 3].
        most: Largest number of faces; the grid is as fine as it permits, approximately.
    """
    places = (x - x.min(axis=0)).astype(np.float64)
    a, b, c = places[segment.faces].transpose(1, 0, 2)
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    size = max(np.sqrt(2.0 * area / most), 1e-4 * float(places.max()), np.finfo(np.float32).tiny)
    while True:
        columns = [*np.floor(places / size).astype(np.int64).T, segment.vertex_meshes]
        cells = np.zeros(len(x), dtype=np.int64)
        for column in columns:
            cells = np.unique(cells * (int(column.max()) + 1) + column, return_inverse=True)[1].reshape(-1)
        faces = np.sort(cells[segment.faces], axis=1)
        faces = np.unique(faces[(faces[:, 0] < faces[:, 1]) & (faces[:, 1] < faces[:, 2])], axis=0)
        if len(faces) <= most:
            break
        size *= 1.1 * np.sqrt(len(faces) / most)
    count = np.bincount(cells)
    middle = np.stack([np.bincount(cells, column) for column in places.T], axis=1) / count[:, None]
    order = np.lexsort((np.square(places - middle[cells]).sum(axis=1), cells))
    nearest = order[np.searchsorted(cells[order], np.arange(len(count)))]  # of a cell's vertices to their middle
    vertices, corners = np.unique(nearest[faces], return_inverse=True)
    return Outline(vertices, corners.reshape(-1, 3))
