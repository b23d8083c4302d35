"""Writes a USD layer over the scene that shows its collisions in usdview and other programs that read USD."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from .._version import __version__
from ..usd.scene import Scene
from ..usd.segment import Segment
from ..usd.write.layer import SceneLayer, just_before
from ..usd.write.layer_writer import LayerPrim, LayerScope, PrimKind, define_prims
from .limit import not_listed
from .outputs import ReplayOutput
from .results import IntervalResult
from .sample_spool import Key, Sample, SampleSpool
from .scene_contacts import SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import ScenePairs
from .summary import Summary

COLORS = {
    "Polygons": (0.85, 0.08, 0.06),
    "VertexFace": (1.0, 0.9, 0.2),
    "EdgeEdge": (1.0, 0.5, 0.0),
    "VertexEdge": (1.0, 0.7, 0.1),
    "VertexVertex": (1.0, 0.8, 0.5),
    "Intersections": (0.6, 0.2, 1.0),
    "CurveIntersections": (0.85, 0.35, 1.0),
    "Inside": (0.1, 0.5, 1.0),
    "Near": (0.1, 0.85, 0.4),
}
"""Emitted colours by prim: polygons that collide, contact points by kind, curves along which surfaces cut, points where
curves pass through faces, vertices of parts that are inside others, middles of proximities."""

LIFT = 2e-4
"""Distance of the coloured polygons from those of the scene, as a share of the size of its moving meshes."""

_KINDS = ("VertexFace", "EdgeEdge", "VertexEdge", "VertexVertex")
MOST_PAIRS = 32
"""Largest number of pairs of meshes with a prim of their own; the prim ``Rest`` has the others."""

VARIANTS = {
    "all": tuple(COLORS),
    "collisions": ("Polygons", *_KINDS),
    "intersections": ("Intersections", "CurveIntersections", "Inside"),
    "clearance": ("Near",),
}
"""Variants of the set ``warp_bsc``, besides those that show one pair of meshes alone, and the prims that they show."""

SHOWN_BY = (
    "Its prims are guides, which programs hide at first: usdview shows them by Display, Display Purposes, Guide; "
    "Blender by Guide among the options of its import; usdrecord by --purposes guide."
)
"""How to see the overlay."""

_MARKER_SIZE = 0.006  # diameter of the marker at a contact point, as a share of that size
_CURVE_WIDTH = 0.0015  # width of the curves, too

_EXTENT = {"extent": "float3[]"}
_MARKERS = _EXTENT | {"positions": "point3f[]", "protoIndices": "int[]"}
_PRIMS = dict.fromkeys(("primvars:primA", "primvars:primB"), "int[]")
_ELEMENTS = _PRIMS | dict.fromkeys(("primvars:elementA", "primvars:elementB"), "int2[]")
_CONTACTS = _MARKERS | {"primvars:toi": "float[]"} | _ELEMENTS
_PARTS: dict[str, tuple[PrimKind, dict[str, str]]] = {
    "Polygons": ("Mesh", _EXTENT | {"faceVertexCounts": "int[]", "faceVertexIndices": "int[]", "points": "point3f[]"}),
    **dict.fromkeys(_KINDS, ("PointInstancer", _CONTACTS)),
    "Intersections": ("BasisCurves", _EXTENT | {"points": "point3f[]", "curveVertexCounts": "int[]"} | _PRIMS),
    "CurveIntersections": ("PointInstancer", _MARKERS | _ELEMENTS),
    "Inside": ("PointInstancer", _MARKERS | _ELEMENTS),
    "Near": ("PointInstancer", _MARKERS | {"primvars:distance": "float[]"} | _ELEMENTS),
}
"""Prims below a pair of meshes: their types, and the types of their attributes that have time samples."""

_REST = "Rest"


class Overlay(ReplayOutput):
    """A USD layer whose sublayer is the scene, so that opening it shows both. It does not change the scene's prims.

    ``/Collisions`` has a prim for each pair of meshes, such as ``Coat_with_Body`` or ``Coat_with_itself``, so that a
    pair can be hidden. Its attribute ``meshes`` has their names. The first :data:`MOST_PAIRS` pairs that meet have one,
    those with the most rows in an interval first; ``Rest`` has the others. The variant set ``warp_bsc`` shows all, what
    is of one kind (:data:`VARIANTS`), or one pair alone. Below a pair are these prims, if they are not always empty:

    - ``Polygons``, a mesh of the polygons that collide, or have an edge or a vertex that collides, as triangles. They
      are lifted by :data:`LIFT` to both sides, move with the scene, and exist from the start of the interval to its
      end;
    - ``VertexFace``, ``EdgeEdge``, ``VertexEdge`` and ``VertexVertex``: markers at the contact points of these kinds,
      from the start of their interval to its end. Each is an instance with the primvars ``toi``; ``primA`` and
      ``primB``, the two meshes, as indices in the attribute ``prims`` of ``/Collisions``, which lists their names;
      ``elementA`` and ``elementB``, the two elements in the prims' own numbers: the point and -1 for a vertex, the
      polygon and -1 for a face, the points at both ends of an edge;
    - ``Intersections``, the curves along which surfaces cut each other at a time of the scene, from that time to the
      next. Each segment in which two triangles meet is a curve, with ``primA`` and ``primB``. Elements that only touch
      have no curve;
    - ``CurveIntersections``, markers where edges of the scene's own curves pass through faces;
    - ``Inside``, markers at a vertex of each part of a mesh that is wholly inside another mesh. They are visible when
      the outer mesh is hidden;
    - ``Near``, markers halfway between the two elements of each proximity, with the primvar ``distance``.

    The last three exist from a time of the scene to the next, and have the primvars of contact points except ``toi``.

    Each prim emits light of its own colour by its own material, which overrides the materials of the scene. Contact
    points are instances of a mesh, as Blender does not bind materials to USD's points; Blender shows the curves grey,
    as it does not bind materials to these either.

    Their purpose is guide, so that renders and replays of the layer exclude them. Programs hide guides by default;
    :data:`SHOWN_BY`, which the layer's documentation and the command line repeat, explains how to show them.

    The layer's ``customLayerData`` has the command that finds the same, without the options that choose files and
    processes, and the numbers of findings; ``assetInfo`` of ``/Collisions`` names the scene and the version.

    A name that ends in ``.usda`` makes a layer in USD's text format, ``.usdc`` and ``.usd`` a binary one, which is
    smaller.

    USD's own layers hold their whole content in memory. This one writes its samples to a
    :class:`~warp_bsc.scene_replay.sample_spool.SampleSpool`, and sorts them by attribute at the end, a few megabytes at
    a time. It does not read the scene again, whose file may have become unreadable.
    """

    def __init__(self, path: str | os.PathLike, *, scene: Scene, command: str):
        """Opens the file.

        Args:
            path: The file, with a name that ends in ``.usda``, ``.usdc`` or ``.usd``.
            scene: The scene.
            command: The command that finds the same.

        Raises:
            OSError: If the file cannot be written.
            ValueError: If its name has another suffix, or the scene has no file.
        """
        self._layer = SceneLayer(path, scene, "an overlay, a USD layer,")
        self._scene, self._command = scene, command
        self._last: IntervalResult | None = None  # the last complete interval
        self._prims: dict[str, int] = {}  # number of each mesh with a pair, by its name
        self._pairs: dict[frozenset[str], LayerScope] = {}  # prims of pairs of meshes, by the names of the two
        self._root_path = "/Collisions"
        while scene.stage.GetPrimAtPath(self._root_path):
            self._root_path += "_"
        low, high = _bounds(scene)
        self._size = float(np.linalg.norm(high - low)) or 1.0
        super().__init__(path)
        self._spool = SampleSpool(self.file.folder, {name: types for name, (_, types) in _PARTS.items()})

    def add(self, result: IntervalResult) -> None:
        """Adds the contacts of an interval, and the intersections and proximities at its start."""
        contacts = result.contacts
        found: dict[Key, Sample] = {}
        for pair, rows in self._by_pair(contacts.segment, contacts.meshes):
            of_pair = contacts.take(rows)
            if polygons := self._find_polygons(of_pair):
                found[pair, "Polygons"] = polygons
            for kind, name in enumerate(_KINDS):
                if len(of_kind := np.flatnonzero(of_pair.kind == kind)):
                    found[pair, name] = self._find_points(of_pair, of_kind, {"toi": of_pair.toi})
        self._spool.add(contacts.interval.start, found | self._find_at_rest(result, 0))
        self._last = result

    def finish(self, summary: Summary) -> None:
        """Writes the layer and moves it to its path."""
        self._spool.keep(len(summary.intervals))
        summary = summary.first(self._spool.interval_count)
        end = summary.intervals[-1].end if summary.intervals else self._scene.times[0]
        last, self._last = self._last, None
        if last and last.summary.end == end > last.summary.start:
            self._spool.add_last(end, self._find_at_rest(last, 1))
        missing, keys, root = str(not_listed(summary, with_end=True) or ""), self._spool.keys(), self._root_path
        texts = "Collisions found by warp-bsc replay.", SHOWN_BY, missing, summary.motion, summary.not_checked
        custom = {"collisions": self._facts(summary)}
        with self._layer.writing(self.file, " ".join(filter(None, texts)), custom) as (layer, add):
            asset = {"name": f"Collisions in {Path(self._scene.path).name}", "version": f"warp-bsc {__version__}"}
            scopes, prims = self._scopes({pair for pair, _ in keys}), [self._layer_prim(*key) for key in keys]
            names = {"prims": list(self._prims)}
            define_prims(layer, root, asset, names, scopes, prims, "warp_bsc", _hidden(keys))
            for key, prim in zip(keys, prims, strict=True):
                for attribute, value_type in prim.attributes.items():
                    for time, value in self._spool.time_samples(key, attribute, end):
                        add(f"{root}/{prim.name}.{attribute}", value_type, time, value)

    def shrink(self) -> bool:
        """Drops the samples of the last intervals."""
        self._last = None
        return self._spool.shrink()

    def discard(self) -> None:
        """Removes the temporary files."""
        self._spool.discard()
        super().discard()

    def _by_pair(self, segment: Segment, meshes: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Returns names of the prims of pairs of meshes with their rows, ascending, the pairs with the most rows first.

        Args:
            segment: The segment.
            meshes: Two meshes of the segment in each row, shape [n, 2].
        """
        keys = np.sort(meshes, axis=1)
        pairs, numbers, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
        of_pairs = np.split(np.argsort(numbers.reshape(-1), kind="stable"), np.cumsum(counts)[:-1])
        rows: dict[str, list[np.ndarray]] = {}
        for number in np.argsort(-counts, kind="stable").tolist():
            first, second = (segment.meshes[mesh].name for mesh in pairs[number])
            rows.setdefault(self._prim_of(first, second), []).append(of_pairs[number])
        return [(name, np.sort(np.concatenate(parts))) for name, parts in rows.items()]

    def _prim_of(self, first: str, second: str) -> str:
        """Returns the name of the prim of two meshes."""
        pair = frozenset((first, second))
        if pair in self._pairs:
            return self._pairs[pair].name
        if len(self._pairs) == MOST_PAIRS:
            return _REST
        words = [re.sub(r"\W", "_", name.rpartition("/")[2], flags=re.ASCII) for name in (first, second)]
        name = f"{words[0]}_with_{'itself' if first == second else words[1]}"
        name = f"_{name}" if name[0].isdigit() else name
        unique, number, used = name, 1, {scope.name for scope in self._pairs.values()}
        while unique in used:
            number += 1
            unique = f"{name}_{number}"
        label = f"{first} with {'itself' if first == second else second}"
        self._pairs[pair] = LayerScope(unique, label, {"meshes": list(dict.fromkeys((first, second)))})
        return unique

    def _find_polygons(self, contacts: SceneContacts) -> Sample | None:
        """Returns the mesh of the polygons that collide in an interval, None if there are none."""
        segment, faces = contacts.interval.segment, []
        for number, polygons in contacts.colliding_polygons().items():
            mesh = segment.meshes[number]
            first = np.searchsorted(mesh.polygons, polygons)
            last = np.searchsorted(mesh.polygons, polygons, side="right")
            faces += [mesh.faces.start + np.arange(start, stop) for start, stop in zip(first, last, strict=True)]
        if not faces:
            return None
        vertices, corners = np.unique(segment.faces[np.concatenate(faces)], return_inverse=True)
        corners = corners.reshape(-1, 3)
        start, stop = (self._lift(x[vertices], corners) for x in (contacts.interval.x0, contacts.interval.x1))
        arrays = {
            "extent": _box(np.concatenate([start, stop])),
            "faceVertexCounts": np.full(2 * len(corners), 3),
            "faceVertexIndices": np.concatenate([corners, corners[:, ::-1] + len(vertices)]).reshape(-1),
            "points": start,
        }
        return Sample(arrays, (just_before(contacts.interval.end), stop))

    def _lift(self, x, corners) -> np.ndarray:
        """Returns the points of triangles moved along their normals, first to one side, then to the other."""
        x = x.astype(np.float64)
        a, b, c = np.moveaxis(x[corners], 1, 0)
        across = np.repeat(np.cross(b - a, c - a), 3, axis=0)
        normal = np.stack([np.bincount(corners.reshape(-1), across[:, axis], len(x)) for axis in range(3)], axis=1)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        step = LIFT * self._size * np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        return np.concatenate([x + step, x - step])

    def _find_at_rest(self, result: IntervalResult, end: int) -> dict[Key, Sample]:
        """Returns the samples of intersections and proximities at the start of an interval, 0, or at its end, 1."""
        samples = {}
        if result.intersections:
            found = result.intersections[end]
            inside = np.arange(found.inside_rows.start, found.inside_rows.stop)
            for pair, rows in self._by_pair(found.segment, found.cuts.meshes):
                samples[pair, "Intersections"] = self._find_curves(found, rows)
            for name, rows_of_name in (("CurveIntersections", found.of_curves), ("Inside", inside)):
                for pair, rows in self._by_pair(found.segment, found.meshes[rows_of_name]):
                    samples[pair, name] = self._find_points(found, rows_of_name[rows], {})
        if result.proximities:
            near = result.proximities[end]
            for pair, rows in self._by_pair(near.segment, near.meshes):
                samples[pair, "Near"] = self._find_points(near, rows, {"distance": near.distance})
        return samples

    def _find_points(self, pairs: ScenePairs, rows: np.ndarray, values: dict[str, np.ndarray]) -> Sample:
        """Returns some pairs as points with their values."""
        indices = pairs.indices[rows]
        arrays = {
            "extent": _box(pairs.position[rows], _MARKER_SIZE * self._size / 2),
            "positions": pairs.position[rows],
            "protoIndices": np.zeros(len(rows)),
            **{f"primvars:{name}": value[rows] for name, value in values.items()},
            **self._number_prims(pairs.segment, pairs.meshes[rows]),
            "primvars:elementA": indices[:, 0],
            "primvars:elementB": indices[:, 1],
        }
        return Sample(arrays)

    def _find_curves(self, found: SceneIntersections, rows: np.ndarray) -> Sample:
        """Returns some segments in which triangles meet as curves."""
        cuts = found.cuts
        points = cuts.points[rows].reshape(-1, 3)
        arrays = {
            "extent": _box(points, _CURVE_WIDTH * self._size / 2),
            "points": points,
            "curveVertexCounts": np.full(len(rows), 2),
            **self._number_prims(found.segment, cuts.meshes[rows]),
        }
        return Sample(arrays)

    def _number_prims(self, segment: Segment, meshes: np.ndarray) -> dict[str, np.ndarray]:
        """Returns the primvars with the numbers of two meshes of a segment that hold for the whole layer."""
        used, rows = np.unique(meshes, return_inverse=True)
        names = [segment.meshes[mesh].name for mesh in used]
        both = np.array([self._prims.setdefault(name, len(self._prims)) for name in names])[rows].reshape(-1, 2)
        return dict(zip(("primvars:primA", "primvars:primB"), both.T, strict=True))

    def _facts(self, summary: Summary) -> dict[str, Any]:
        """Returns what programs read of the layer without its prims."""
        facts = {"command": self._command, "complete": summary.is_complete, "hits": summary.hits}
        facts["intervals"] = len(summary.intervals)
        if missing := not_listed(summary, with_end=True):
            facts["limit"] = missing.limit
            facts["collisionsNotListed"] = missing.collisions[0]
        if summary.intersections:
            facts["timesWithIntersections"] = sum(bool(at.crossings + at.touches) for at in summary.intersections)
        found = {"stopped": summary.stopped, "leftOut": self._scene.left_out}
        found["duplicates"] = [span.describe(len(span.meshes)) for span in summary.duplicate_spans]
        found["inversions"] = [span.describe() for span in summary.inversion_spans]
        return facts | {name: fact for name, fact in found.items() if fact}

    def _scopes(self, used: set[str]) -> list[LayerScope]:
        """Returns the prims of pairs of meshes that have findings, the rest last."""
        rest = [LayerScope(_REST, "other pairs of meshes", {})]
        return [scope for scope in (*self._pairs.values(), *rest) if scope.name in used]

    def _layer_prim(self, pair: str, name: str) -> LayerPrim:
        kind, attributes = _PARTS[name]
        widths = {"Mesh": 0.0, "PointInstancer": _MARKER_SIZE * self._size, "BasisCurves": _CURVE_WIDTH * self._size}
        return LayerPrim(f"{pair}/{name}", kind, attributes, name, COLORS[name], widths[kind])


def _hidden(keys: list[Key]) -> dict[str, list[str]]:
    """Returns the prims that each variant hides, given pairs and their prims."""
    pairs = list(dict.fromkeys(pair for pair, _ in keys))
    hidden = {
        variant: [f"{pair}/{name}" for pair, name in keys if name not in shown] for variant, shown in VARIANTS.items()
    }
    # not the pairs themselves: Blender 4.4 crashes where a prim above a point instancer is invisible
    return hidden | {pair: [f"{other}/{name}" for other, name in keys if other != pair] for pair in pairs}


def _box(points, margin=0.0) -> np.ndarray:
    """Returns the corners of the bounding box of points, with a margin around it, shape [2, 3]."""
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])


def _bounds(scene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounding box of the moving meshes at the start, or of all meshes if none moves."""
    interval = scene.interval(0)
    segment, x = interval.segment, interval.x0
    meshes, _ = segment.locate_vertices(np.arange(segment.vertex_count))
    moves = np.array([mesh.moves for mesh in segment.meshes], dtype=bool)[meshes]
    x = x[moves] if moves.any() else x
    return (x.min(axis=0), x.max(axis=0)) if len(x) else (np.zeros(3), np.ones(3))
