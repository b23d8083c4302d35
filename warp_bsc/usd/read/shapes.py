"""The polygons of meshes, and of USD's shapes as polyhedra. Imports pxr, which is slow: import this where used."""

import functools
import math
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from .samples import may_jump

_SHAPES = (UsdGeom.Cube, UsdGeom.Sphere, UsdGeom.Capsule, UsdGeom.Cylinder, UsdGeom.Cone, UsdGeom.Plane)
_CUBE = [(x, y, z) for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]
_CUBE_SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
_SQUARE = [(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)]


class Polygons:
    """Polygons in the space of a prim, as attributes of that prim describe them.

    Attributes:
        topology_attributes: The attributes that define the polygons.
        point_attributes: The attributes that define the positions of their points.
    """

    topology_attributes: tuple[Usd.Attribute, ...] = ()
    point_attributes: tuple[Usd.Attribute, ...]

    @property
    def may_jump(self) -> bool:
        """Whether points may jump at a time, see :func:`~warp_bsc.usd.read.samples.may_jump`: if value clips hold them.

        USD interpolates other samples; a change of their number is an error.
        """
        return self.point_attributes[0].GetResolveInfo().GetSource() == Usd.ResolveInfoSourceValueClips

    def read_points(self, time: Usd.TimeCode) -> Any:
        """Returns the points, as USD stores them or float64, shape [point_count, 3]; None if there are none."""
        return self.point_attributes[0].Get(time)

    def read_topology(self, time: Usd.TimeCode) -> list[Any]:
        """Returns numbers of corners, the points at the corners and the holes, each None if there are none."""
        return [attribute.Get(time) for attribute in self.topology_attributes]


class MeshPolygons(Polygons):
    """The polygons of a mesh prim."""

    def __init__(self, prim: Usd.Prim):
        """Finds the attributes of a prim."""
        mesh = UsdGeom.Mesh(prim)
        self.topology_attributes = (
            mesh.GetFaceVertexCountsAttr(),
            mesh.GetFaceVertexIndicesAttr(),
            mesh.GetHoleIndicesAttr(),
        )
        self.point_attributes = (mesh.GetPointsAttr(),)


class ShapePolygons(Polygons):
    """A cube, sphere, capsule, cylinder, cone or plane as polygons; the round ones are inscribed polyhedra.

    An inscribed circle of n segments has 1 - 2 pi^2 / (3 n^2) of the area, 99.4% for 32 segments.
    """

    def __init__(self, prim: Usd.Prim, segments: int = 32):
        """Finds the attributes of a prim.

        Args:
            prim: The prim.
            segments: Number of edges around a capsule, cylinder or cone. A sphere is an icosahedron whose edges are
                halved log2(segments / 4) times, rounded.
        """
        self._segments = segments
        self._type = prim.GetTypeName()
        names = "size", "radius", "height", "width", "length", "axis"
        self._attributes = {name: attribute for name in names if (attribute := prim.GetAttribute(name))}
        self.point_attributes = tuple(self._attributes.values())

    @property
    def may_jump(self) -> bool:
        """Whether a size may jump."""
        return may_jump(self.point_attributes)

    def read_points(self, time: Usd.TimeCode) -> np.ndarray:
        """Returns the points."""
        points, _, _ = _unit_shape(self._type, self._segments)
        values = {name: attribute.Get(time) for name, attribute in self._attributes.items()}
        if self._type == "Cube":
            return points * values["size"]
        if self._type == "Sphere":
            return points * values["radius"]
        if self._type == "Plane":
            # the width is along x, or along z if x is the axis; the length is along y, or along z if y is the axis
            x, y, _ = (points * [values["width"], values["length"], 0.0]).T
            nothing = np.zeros_like(x)
            placed = {"X": (nothing, y, -x), "Y": (x, nothing, -y), "Z": (x, y, nothing)}
            return np.stack(placed[values["axis"]], axis=1)
        if self._type == "Capsule":
            halves = np.sign(points[:, 2:]) * [0.0, 0.0, 0.5]
            points = (points - halves) * values["radius"] + halves * values["height"]
        else:
            points = points * [values["radius"], values["radius"], values["height"]]
        return np.roll(points, {"X": 1, "Y": 2, "Z": 0}[values["axis"]], axis=1)

    def read_topology(self, time: Usd.TimeCode) -> list[Any]:
        """Returns numbers of corners, the points at the corners and no holes."""
        _, counts, indices = _unit_shape(self._type, self._segments)
        return [counts, indices, None]


def is_shape(prim: Usd.Prim) -> bool:
    """Returns whether :class:`ShapePolygons` reads a prim."""
    return any(prim.IsA(shape) for shape in _SHAPES)


@functools.cache
def _unit_shape(type_name: str, segments: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns points, numbers of corners and corners of a shape of radius, height and size 1, its axis along z."""
    from trimesh import creation  # noqa: PLC0415 (slow)

    if type_name == "Cube":
        return np.array(_CUBE), np.full(6, 4), np.ravel(_CUBE_SIDES)
    if type_name == "Plane":
        return np.array(_SQUARE), np.full(1, 4), np.arange(4)
    if type_name == "Sphere":
        mesh = creation.icosphere(subdivisions=round(math.log2(segments / 4)))
    elif type_name == "Capsule":
        mesh = creation.capsule(radius=1.0, height=1.0, count=[segments // 2, segments])
    elif type_name == "Cylinder":
        mesh = creation.cylinder(radius=1.0, height=1.0, sections=segments)
    else:
        mesh = creation.cone(radius=1.0, height=1.0, sections=segments)
        mesh.apply_translation([0.0, 0.0, -0.5])
    return np.array(mesh.vertices), np.full(len(mesh.faces), 3), mesh.faces.ravel()
