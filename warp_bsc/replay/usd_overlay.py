"""Writes a USD layer over the scene that shows its collisions in usdview and other programs that read USD."""

import os
import secrets
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._atomic_file import OutputFile
from ..usd.layer import just_before, layer_metadata, unused_path
from ..usd.layer_writer import SHAPES, LayerContent, LayerPrim, PrimKind, write_binary_layer, write_text_layer
from ..usd.scene import Scene
from ..usd.segment import Segment
from .outputs import without_last_eighth
from .results import IntervalResult
from .scene_contacts import SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import ScenePairs
from .summary import Summary

__all__ = ["COLORS", "LIFT", "SHOWN_BY", "Overlay"]

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

SHOWN_BY = (
    "Its prims are guides, which programs hide at first: usdview shows them by Display, Display Purposes, Guide; "
    "Blender by Guide among the options of its import; usdrecord by --purposes guide."
)
"""How to see the overlay."""

_MARKER_SIZE = 0.006  # diameter of the marker at a contact point, as a share of that size
_CURVE_WIDTH = 0.0015  # width of the curves, too

_EXTENT = {"extent": "float3[]"}
_MARKERS = _EXTENT | {"positions": "point3f[]", "protoIndices": "int[]"}
_ELEMENTS = {
    "primvars:primA": "int[]",
    "primvars:primB": "int[]",
    "primvars:elementA": "int2[]",
    "primvars:elementB": "int2[]",
}
_CONTACTS = _MARKERS | {"primvars:toi": "float[]"} | _ELEMENTS
_PARTS: dict[str, tuple[PrimKind, dict[str, str]]] = {
    "Polygons": (
        "Mesh",
        _EXTENT | {"faceVertexCounts": "int[]", "faceVertexIndices": "int[]", "points": "point3f[]"},
    ),
    "VertexFace": ("PointInstancer", _CONTACTS),
    "EdgeEdge": ("PointInstancer", _CONTACTS),
    "VertexEdge": ("PointInstancer", _CONTACTS),
    "VertexVertex": ("PointInstancer", _CONTACTS),
    "Intersections": (
        "BasisCurves",
        _EXTENT
        | {"points": "point3f[]", "curveVertexCounts": "int[]", "primvars:primA": "int[]", "primvars:primB": "int[]"},
    ),
    "CurveIntersections": ("PointInstancer", _MARKERS | _ELEMENTS),
    "Inside": ("PointInstancer", _MARKERS | _ELEMENTS),
    "Near": ("PointInstancer", _MARKERS | {"primvars:distance": "float[]"} | _ELEMENTS),
}
"""Prims of the layer: their types, and the types of their attributes that have time samples."""

_ONLY_IF_FOUND = "VertexEdge", "VertexVertex", "CurveIntersections", "Inside", "Near"
"""The prims that a layer contains only if they are not empty at all times."""


class Overlay:
    """A layer whose sublayer is the scene, so that opening the layer shows both. It does not change the scene's prims.

    The prims below ``/Collisions`` are

    - ``Polygons``, a mesh of the polygons that collide, or have an edge or a vertex that collides, as triangles. They
      are lifted by :data:`LIFT` to both sides, move with the scene, and exist from the start of the interval to its
      end;
    - ``VertexFace`` and ``EdgeEdge``, and if curves or points collide ``VertexEdge`` and ``VertexVertex``: markers at
      the contact points of these kinds, from the start of their interval to its end. Each is an instance with the
      primvars ``toi``; ``primA`` and ``primB``, the two meshes, as indices in the attribute ``prims`` of
      ``/Collisions``, which lists their names; ``elementA`` and ``elementB``, the two elements in the prims' own
      numbers: the point and -1 for a vertex, the polygon and -1 for a face, the points at both ends of an edge;
    - ``Intersections``, the curves along which surfaces cut each other at a time of the scene, from that time to the
      next. Each segment in which two triangles meet is a curve, with ``primA`` and ``primB``. Elements that only touch
      have no curve;
    - ``CurveIntersections``, markers where edges of the scene's own curves pass through faces;
    - ``Inside``, markers at a vertex of each part of a mesh that is wholly inside another mesh. They are visible when
      the outer mesh is hidden;
    - ``Near``, markers halfway between the two elements of each proximity, with the primvar ``distance``.

    The last three are missing where there are none. They exist from a time of the scene to the next, and have the
    primvars of contact points except ``toi``.

    Each prim emits light of its own colour by its own material, which overrides the materials of the scene. Contact
    points are instances of a mesh, as Blender does not bind materials to USD's points; Blender shows the curves grey,
    as it does not bind materials to these either.

    Their purpose is guide, so that renders and replays of the layer exclude them. Programs hide guides by default;
    :data:`SHOWN_BY`, which the layer's documentation and the command line repeat, explains how to show them.

    A name that ends in ``.usda`` makes a layer in USD's text format, ``.usdc`` and ``.usd`` a binary one, which is
    smaller. USD interpolates between samples; values that must not move have an empty sample just before the next one.

    USD's own layers hold their whole content in memory. This one writes its samples to a temporary file, the spool, and
    sorts them by attribute at the end, a few megabytes at a time. It does not read the scene again, whose file may have
    become unreadable.

    Attributes:
        file: The file.
    """

    def __init__(self, path: str | os.PathLike, *, scene: Scene):
        """Opens the file.

        Args:
            path: The file, with a name that ends in ``.usda``, ``.usdc`` or ``.usd``.
            scene: The scene.

        Raises:
            OSError: If the file cannot be written.
            ValueError: If its name has another suffix, or the scene has no file.
        """
        suffix = Path(path).suffix
        if suffix not in (".usda", ".usdc", ".usd"):
            raise ValueError(f"{path}: the name of an overlay, a layer of USD, must end in .usda, .usdc or .usd")
        self._is_text = suffix == ".usda"
        self._scene = scene
        self._samples: dict[str, list[_Sample]] = {name: [] for name in _PARTS}
        self._ends = []  # offset in the spool at the end of each complete interval
        self._last: IntervalResult | None = None  # the last complete interval
        self._prims: dict[str, int] = {}  # number of each mesh with a pair, by its name
        self._root_path = unused_path(scene, "/Collisions")
        low, high = _bounds(scene)
        self._size = float(np.linalg.norm(high - low)) or 1.0
        self._metadata = layer_metadata(scene)
        self.file = OutputFile(path)
        self._spool = tempfile.TemporaryFile(buffering=0, dir=self.file.folder)  # noqa: SIM115 (closed when discarded)

    def add(self, result: IntervalResult) -> None:
        """Adds the contacts of an interval, and the intersections and proximities at its start."""
        contacts = result.contacts
        interval = contacts.interval
        self._sample("Polygons", interval.start, *self._find_polygons(contacts))
        for kind, name in enumerate(("VertexFace", "EdgeEdge", "VertexEdge", "VertexVertex")):
            rows = np.flatnonzero(contacts.kind == kind)
            self._sample(name, interval.start, self._find_points(contacts, rows, {"toi": contacts.toi}))
        for name, arrays in self._find_at_rest(result, 0).items():
            self._sample(name, interval.start, arrays)
        self._last = result
        self._ends.append(self._spool.tell())

    def finish(self, summary: Summary) -> None:
        """Writes the layer and moves it to its path."""
        del self._ends[len(summary.intervals) :]
        summary = summary.first(len(self._ends))
        end = summary.intervals[-1].end if summary.intervals else self._scene.times[0]
        last, self._last = self._last, None
        if last and last.summary.end == end > last.summary.start:
            for name, arrays in self._find_at_rest(last, 1).items():
                self._sample(name, end, arrays, interval=len(self._ends) - 1)
        content = self._content(summary, end)
        if self._is_text:
            self.file.truncate(0)
            write_text_layer(content, self.file.write)
        else:
            temporary = Path(self.file.folder, f".warp-bsc-{secrets.token_hex(8)}.tmp")
            write_binary_layer(content, temporary)
            self.file.adopt(temporary)
        self.file.commit()

    def shrink(self) -> bool:
        """Drops the samples of the last intervals."""
        if not self._ends:
            return False
        self._ends = without_last_eighth(self._ends)
        self._last = None
        self._spool.truncate(self._ends[-1] if self._ends else 0)
        return True

    def discard(self) -> None:
        """Removes the temporary files."""
        self._spool.close()
        self.file.discard()

    def _find_polygons(self, contacts: SceneContacts):
        """Returns the mesh of the polygons that collide in an interval, and its points just before the end."""
        segment, faces = contacts.interval.segment, []
        for number, polygons in contacts.colliding_polygons().items():
            mesh = segment.meshes[number]
            first = np.searchsorted(mesh.polygons, polygons)
            last = np.searchsorted(mesh.polygons, polygons, side="right")
            faces += [mesh.faces.start + np.arange(start, stop) for start, stop in zip(first, last, strict=True)]
        if not faces:
            return None, None
        vertices, corners = np.unique(segment.faces[np.concatenate(faces)], return_inverse=True)
        corners = corners.reshape(-1, 3)
        start, stop = (self._lift(x[vertices], corners) for x in (contacts.interval.x0, contacts.interval.x1))
        arrays = {
            "extent": _box(np.concatenate([start, stop])),
            "faceVertexCounts": np.full(2 * len(corners), 3),
            "faceVertexIndices": np.concatenate([corners, corners[:, ::-1] + len(vertices)]).reshape(-1),
            "points": start,
        }
        return arrays, (just_before(contacts.interval.end), stop)

    def _lift(self, x, corners) -> np.ndarray:
        """Returns the points of triangles moved along their normals, first to one side, then to the other."""
        x = x.astype(np.float64)
        a, b, c = np.moveaxis(x[corners], 1, 0)
        across = np.repeat(np.cross(b - a, c - a), 3, axis=0)
        normal = np.stack([np.bincount(corners.reshape(-1), across[:, axis], len(x)) for axis in range(3)], axis=1)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        step = LIFT * self._size * np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
        return np.concatenate([x + step, x - step])

    def _find_at_rest(self, result: IntervalResult, end: int) -> dict[str, dict[str, np.ndarray] | None]:
        """Returns the samples of intersections and proximities at the start of an interval, 0, or at its end, 1."""
        samples = {}
        if result.intersections:
            found = result.intersections[end]
            rows = np.arange(found.inside_rows.start, found.inside_rows.stop)
            samples = {
                "Intersections": self._find_curves(found),
                "CurveIntersections": self._find_points(found, found.of_curves, {}),
                "Inside": self._find_points(found, rows, {}),
            }
        if result.proximities:
            found = result.proximities[end]
            samples["Near"] = self._find_points(found, np.arange(len(found)), {"distance": found.distance})
        return samples

    def _find_points(self, pairs: ScenePairs, rows: np.ndarray, values: dict[str, np.ndarray]):
        """Returns some pairs as points with their values, None without pairs."""
        if not len(rows):
            return None
        prims, indices = self._number_prims(pairs.segment, pairs.meshes[rows]), pairs.indices[rows]
        return {
            "extent": _box(pairs.position[rows], _MARKER_SIZE * self._size / 2),
            "positions": pairs.position[rows],
            "protoIndices": np.zeros(len(rows)),
            **{f"primvars:{name}": value[rows] for name, value in values.items()},
            "primvars:primA": prims[:, 0],
            "primvars:primB": prims[:, 1],
            "primvars:elementA": indices[:, 0],
            "primvars:elementB": indices[:, 1],
        }

    def _find_curves(self, found: SceneIntersections):
        """Returns the segments in which triangles meet as curves, None without any."""
        cuts = found.cuts
        if not len(cuts.points):
            return None
        prims, points = self._number_prims(found.segment, cuts.meshes), cuts.points.reshape(-1, 3)
        return {
            "extent": _box(points, _CURVE_WIDTH * self._size / 2),
            "points": points,
            "curveVertexCounts": np.full(len(cuts.points), 2),
            "primvars:primA": prims[:, 0],
            "primvars:primB": prims[:, 1],
        }

    def _number_prims(self, segment: Segment, meshes: np.ndarray) -> np.ndarray:
        """Returns numbers of meshes of a segment that hold for the whole layer."""
        used, rows = np.unique(meshes, return_inverse=True)
        names = [segment.meshes[mesh].name for mesh in used]
        return np.array([self._prims.setdefault(name, len(self._prims)) for name in names])[rows].reshape(-1, 2)

    def _sample(self, name, time, arrays, moved=None, interval=None):
        """Adds a sample of a prim's attributes to the spool, except an empty one after an empty one.

        Args:
            name: The prim.
            time: Time code.
            arrays: Values by attribute, None for an empty sample.
            moved: A time just before the next sample, and the points at that time.
            interval: Number of the interval that the sample belongs to; default: the one that is added.
        """
        samples = self._samples[name]
        if arrays is None and samples and samples[-1].is_empty:
            return
        types = _PARTS[name][1]
        self._spool.seek(0, os.SEEK_END)
        stored = {attribute: self._store(types[attribute], array) for attribute, array in (arrays or {}).items()}
        after = (moved[0], self._store(types["points"], moved[1])) if moved else None
        samples.append(_Sample(len(self._ends) if interval is None else interval, time, stored, after))

    def _store(self, value_type, array) -> "_Stored":
        """Appends an array to the spool."""
        data = np.ascontiguousarray(array, dtype=SHAPES[value_type][0])
        stored = _Stored(self._spool.tell(), data.nbytes)
        rest = memoryview(data.tobytes())
        while rest:
            rest = rest[self._spool.write(rest) :]
        return stored

    def _load(self, value_type, stored) -> np.ndarray:
        """Reads an array from the spool."""
        dtype, width = SHAPES[value_type]
        self._spool.seek(stored.offset)
        data = self._spool.read(stored.size)
        if len(data) != stored.size:
            raise RuntimeError("the spool of the overlay is truncated")
        return np.frombuffer(data, dtype).reshape((-1, width) if width > 1 else -1)

    def _complete(self, name: str) -> "list[_Sample]":
        """Returns the samples of a prim that belong to complete intervals."""
        return [sample for sample in self._samples[name] if sample.interval < len(self._ends)]

    def _time_samples(self, name, attribute, end) -> Iterator[tuple[float, np.ndarray]]:
        """Yields the time samples of an attribute up to the end of the last interval, in order."""
        value_type = _PARTS[name][1][attribute]
        empty = self._load(value_type, _Stored(0, 0)) if attribute != "extent" else np.zeros((2, 3), np.float32)
        samples = self._complete(name)
        for index, sample in enumerate(samples):
            if sample.is_empty:
                yield sample.time, empty
                continue
            value = self._load(value_type, sample.arrays[attribute])
            yield sample.time, value
            is_last = index + 1 == len(samples)
            following = end if is_last else samples[index + 1].time
            if attribute == "points" and sample.moved:
                yield sample.moved[0], self._load(value_type, sample.moved[1])
            # Between two values USD interpolates, which would show points on the way from one contact to another.
            elif value_type.startswith(("float", "point")) and (before := just_before(following)) > sample.time:
                yield before, value if attribute == "extent" else empty
            if is_last and end > sample.time:
                yield end, empty

    def _content(self, summary: Summary, end: float) -> LayerContent:
        """Returns the content of the layer, given the last time of its intervals."""
        source = Path(os.path.relpath(Path(self._scene.path).resolve(), self.file.path.parent.resolve())).as_posix()
        found = {"complete": summary.is_complete, "hits": summary.hits, "intervals": len(summary.intervals)}
        if summary.intersections:
            found["timesWithIntersections"] = sum(bool(at.crossings + at.touches) for at in summary.intersections)
        if summary.stopped:
            found["stopped"] = summary.stopped
        widths = {"Mesh": 0.0, "PointInstancer": _MARKER_SIZE * self._size, "BasisCurves": _CURVE_WIDTH * self._size}
        return LayerContent(
            metadata=self._metadata,
            documentation=f"Collisions found by warp-bsc replay. {SHOWN_BY} {summary.motion}",
            custom={"collisions": found},
            sublayer=source if source.startswith("../") else f"./{source}",
            root=self._root_path,
            strings={"prims": list(self._prims)},
            prims=[
                LayerPrim(name, kind, attributes, COLORS[name], widths[kind])
                for name, (kind, attributes) in _PARTS.items()
                if name not in _ONLY_IF_FOUND or any(not sample.is_empty for sample in self._complete(name))
            ],
            samples=lambda name, attribute: self._time_samples(name, attribute, end),
        )


@dataclass(frozen=True)
class _Stored:
    """An array in the spool, by its offset and size [bytes]."""

    offset: int
    size: int


@dataclass(frozen=True)
class _Sample:
    """A sample of a prim in the spool.

    Attributes:
        interval: Number of the interval.
        time: Time code.
        arrays: Its arrays, by attribute; none for an empty sample.
        moved: A time just before the next sample, and the points at that time, if they move.
    """

    interval: int
    time: float
    arrays: dict[str, _Stored]
    moved: tuple[float, _Stored] | None

    @property
    def is_empty(self) -> bool:
        """Whether the prim is empty at that time."""
        return not self.arrays


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
