"""The part of a segment that one mesh of the scene becomes."""

from dataclasses import dataclass, field

import numpy as np

__all__ = ["SceneMesh"]


@dataclass(frozen=True)
class SceneMesh:
    """The part of a segment that one mesh of the scene, or the curves or points of a prim, becomes.

    Attributes:
        path: The prim's path.
        name: The path, with the number of the instance if a point instancer places it.
        display_name: Display name in the file, empty if there is none.
        moves: Whether its points or its transform change with time.
        deforms: Whether its points move relative to each other, so that it may collide with itself.
        vertices: Its vertices among those of all meshes, numbered before welding.
        faces: Its faces, among those of all meshes.
        points: Index of each vertex among the prim's points, shape [len(vertices)].
        point_count: Number of the prim's points.
        polygons: Index of the prim's polygon that each face is a part of, ascending, shape [len(faces)].
        polygon_count: Number of the prim's polygons, holes included.
    """

    path: str
    name: str
    display_name: str
    moves: bool
    deforms: bool
    vertices: slice
    faces: slice
    points: np.ndarray = field(repr=False)
    point_count: int
    polygons: np.ndarray = field(repr=False)
    polygon_count: int
