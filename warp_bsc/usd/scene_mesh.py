"""The part of a segment that one mesh of the scene becomes, and where elements of the segment are in their prims."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class SceneMesh:
    """The part of a segment that one mesh of the scene, or the curves or points of a prim, becomes.

    Attributes:
        path: The prim's path.
        name: The path, with the number of the instance if a point instancer places it.
        moves: Whether its points or its transform change with time.
        deforms: Whether its points move relative to each other, so that it may collide with itself.
        vertices: Its vertices among those of all meshes, numbered before welding.
        faces: Its faces, among those of all meshes.
        points: Index of each vertex among the prim's points, shape [len(vertices)].
        point_count: Number of the prim's points.
        polygons: Index of the prim's polygon that each face is a part of, ascending, shape [len(faces)].
    """

    path: str
    name: str
    moves: bool
    deforms: bool
    vertices: slice
    faces: slice
    points: np.ndarray = field(repr=False)
    point_count: int
    polygons: np.ndarray = field(repr=False)


class InPrims:
    """The mesh of each vertex or face, and its index among the points or polygons of its prim, shared by instances."""

    def __init__(self, indices: list[np.ndarray]):
        """Joins the indices of the elements of each mesh, given the same array for meshes that share them."""
        counts = [len(array) for array in indices]
        self._mesh_of = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        distinct_arrays = {id(array): array for array in indices}
        self._indices = np.concatenate([np.zeros(0, dtype=np.int64), *distinct_arrays.values()])
        starts = np.cumsum([0, *map(len, distinct_arrays.values())])
        start_of = dict(zip(distinct_arrays, starts.tolist(), strict=False))
        starts = np.array([start_of[id(array)] for array in indices], dtype=np.int64)
        self._shifts = starts - np.cumsum([0, *counts])[:-1]

    def meshes(self, elements: np.ndarray) -> np.ndarray:
        """Returns the mesh of each element, int64."""
        return self._mesh_of[elements].astype(np.int64)

    def locate(self, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mesh of each element, and its index in the prim."""
        meshes = self.meshes(elements)
        return meshes, self._indices[elements + self._shifts[meshes]]
