"""The edges of linear curves, and points, with their radii. Imports pxr, which is slow: import this where used."""

import bisect
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from .shapes import Polygons


class Strands(Polygons):
    """The linear curves of a ``UsdGeom.BasisCurves`` prim, or the points of a ``UsdGeom.Points`` prim.

    Errors are ValueErrors; :func:`~.unreadable.reading`, in which all of it is called, names the file and the prim.

    Attributes:
        has_edges: Whether they are curves.
        width_attribute: The attribute that holds their widths.
    """

    def __init__(self, prim: Usd.Prim):
        """Finds the attributes of a prim."""
        self.has_edges = prim.IsA(UsdGeom.BasisCurves)
        self._id_times: list[float] = []  # of the samples of points whose ids change
        self._schema = schema = UsdGeom.BasisCurves(prim) if self.has_edges else UsdGeom.Points(prim)
        self.point_attributes = (schema.GetPointsAttr(),)
        if self.has_edges:
            self.topology_attributes = (schema.GetCurveVertexCountsAttr(),)
        else:
            self._ids = schema.GetIdsAttr()
            self.topology_attributes = (schema.GetPointsAttr(), self._ids)
            if self._ids.ValueMightBeTimeVarying():
                self._id_times = schema.GetPointsAttr().GetTimeSamples()
        # As the schema requires, the primvar precedes the attribute.
        primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("widths")
        self._widths = primvar if primvar and primvar.HasAuthoredValue() else None
        self.width_attribute = self._widths.GetAttr() if self._widths else schema.GetWidthsAttr()

    def read_points(self, time: Usd.TimeCode) -> Any:
        """Returns the points.

        Between two samples with different ids, points with the same id in both move straight; the others stay in place.
        (USD would hold all of them if their number changes.)
        """
        held = self.point_attributes[0].Get(time)
        if not self._id_times:
            return held
        earlier = bisect.bisect_left if time.IsPreTime() else bisect.bisect_right
        following = earlier(self._id_times, time.GetValue())
        if not 0 < following < len(self._id_times):
            return held
        first, last = self._id_times[following - 1 : following + 1]
        ids, next_ids = (np.array(self._ids.Get(sample) or ()) for sample in (first, last))
        points, next_points = (np.array(self.point_attributes[0].Get(sample) or ()) for sample in (first, last))
        if not (len(points) and len(next_points)):
            return held
        if np.array_equal(ids, next_ids) or len(ids) != len(points) or len(next_ids) != len(next_points):
            return held
        _, stays, comes = np.intersect1d(ids, next_ids, return_indices=True)
        share = np.float32((time.GetValue() - first) / (last - first))
        points[stays] = (np.float32(1.0) - share) * points[stays] + share * next_points[comes]
        return points

    def read_topology(self, time: Usd.TimeCode) -> list[Any]:
        """Returns the numbers of points of the curves; for points, their number, and the ids that distinguish them."""
        if self.has_edges:
            return [self.topology_attributes[0].Get(time), None, None]
        points = self.read_points(time)
        return [None if points is None else [len(points)] * bool(len(points)), self._ids.Get(time), None]

    def read_edges(self, counts: np.ndarray, point_count: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the edges of curves, and the curve of each point.

        Args:
            counts: Numbers of points of the curves, shape [curve_count].
            point_count: Number of points.

        Returns:
            The points at both ends of each edge, shape [n, 2], and curves, shape [point_count].

        Raises:
            ValueError: If the numbers do not add up to the number of points, or one is less than 2.
        """
        if not self.has_edges:
            return np.zeros((0, 2), dtype=np.int64), np.full(point_count, -1)
        if counts.min(initial=2) < 2:
            curve = int(np.argmin(counts))
            raise ValueError(f"curve {curve} has {counts[curve]} points; 2 are the fewest")
        if counts.sum() != point_count:
            raise ValueError(f"curveVertexCounts add up to {counts.sum()}, but there are {point_count} points")
        curves = np.repeat(np.arange(len(counts)), counts)
        (first,) = np.nonzero(curves[1:] == curves[:-1])
        edges = np.stack([first, first + 1], axis=1)
        if self._schema.GetWrapAttr().Get() == UsdGeom.Tokens.periodic:
            last = np.cumsum(counts) - 1
            edges = np.concatenate([edges, np.stack([last - counts + 1, last], axis=1)[counts > 2]])
        return edges, curves

    def read_widths(self, time: Usd.TimeCode, curves: np.ndarray) -> np.ndarray:
        """Returns the width at each point, 0 if the file has none, in the space of the prim.

        Args:
            time: Time code.
            curves: Curve of each point, shape [point_count].

        Raises:
            ValueError: If the number of widths is not that of their interpolation, or one is negative or not
                finite.
        """
        value = self._widths.ComputeFlattened(time) if self._widths else self.width_attribute.Get(time)
        if value is None or len(value) == 0:
            return np.zeros(len(curves))
        widths = np.array(value, dtype=np.float64)
        interpolation = self._widths.GetInterpolation() if self._widths else self._schema.GetWidthsInterpolation()
        if interpolation == UsdGeom.Tokens.constant:
            count, rows = 1, np.zeros(len(curves), dtype=np.int64)
        elif interpolation == UsdGeom.Tokens.uniform and self.has_edges:
            count, rows = int(curves.max(initial=-1)) + 1, curves
        else:  # varying and vertex values are at the same points of linear curves
            count, rows = len(curves), np.arange(len(curves))
        if widths.shape != (count,):
            raise ValueError(f"{len(widths)} widths of interpolation {interpolation}, which has {count}")
        if not (np.isfinite(widths) & (widths >= 0.0)).all():
            raise ValueError("widths must be finite and at least 0")
        return widths[rows]


def is_strands(prim: Usd.Prim) -> bool:
    """Returns whether :class:`Strands` reads a prim."""
    if prim.IsA(UsdGeom.BasisCurves):
        return UsdGeom.BasisCurves(prim).GetTypeAttr().Get() == UsdGeom.Tokens.linear
    return prim.IsA(UsdGeom.Points)
