"""Writes a USD layer over the scene that shows its collisions in usdview and any other program that reads USD."""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._atomic_file import OutputFile
from ..usd.layer import display_colors, find_instances_above, just_before, layer_metadata, unused_path
from ..usd.scene import Scene
from .intervals import IntervalResult
from .outputs import without_last_eighth
from .scene_contacts import KINDS
from .summary import Summary

__all__ = ["Overlay"]

COLORS = {"vertex-face": (0.9, 0.1, 0.1), "edge-edge": (1.0, 0.55, 0.0)}
"""Colours of the contact points by kind."""

LIT = (0.95, 0.25, 0.2)
"""Colour of the polygons that collide."""

_UNLIT = (0.6, 0.6, 0.6)  # colour of a mesh that has none
_DISPLAY_COLOR = "primvars:displayColor"
_POINT_SIZE = 0.006  # diameter of a contact point, as a share of the scene's size

_COPIED = 1 << 20  # bytes that are copied at once

_CONTACTS = {
    "extent": ("float3[]", None),
    "points": ("point3f[]", None),
    "primvars:displayColor": ("color3f[]", "vertex"),
    "primvars:toi": ("float[]", "vertex"),
    "primvars:elementA": ("string[]", "vertex"),
    "primvars:elementB": ("string[]", "vertex"),
}
"""Attributes of the contact points that have time samples: their types and interpolations."""


class Overlay:
    """A layer in USD's text format whose sublayer is the scene, so that opening the layer shows both.

    The contact points are one ``UsdGeom.Points`` with the primvars ``toi``, ``elementA`` and ``elementB``. It has a
    sample at the start of each interval, with the contacts of that interval. Polygons that collide are coloured from
    the start of the interval to the start of the next. USD interpolates between samples, so every sample is repeated
    just before the next.

    USD's own layers hold their whole content in memory. This one keeps its samples in a temporary file, the spool, and
    sorts them by attribute at the end. It does not read the scene then, whose file may have become unreadable.

    Attributes:
        file: The file.
    """

    def __init__(self, path: str | os.PathLike, *, scene: Scene):
        """Opens the file.

        Args:
            path: The file's place, a ``.usda`` or ``.usd`` file.
            scene: The scene.

        Raises:
            OSError: If the file cannot be written.
            ValueError: If its name has another suffix.
        """
        if Path(path).suffix not in (".usda", ".usd"):
            raise ValueError(f"{path}: the overlay is USD in text form, its name must end in .usda or .usd")
        self._scene = scene
        self._samples: dict[tuple[str, str], list[_Sample]] = {}  # by prim and attribute
        self._ends = []  # where each complete interval ends in the spool
        self._last_start: float | None = None  # of the last interval added
        self._colored = {}  # by path of the prim: the number of polygons in the last sample, and the lit ones
        self._unlit = {}  # by path of the prim: the colours in the scene
        self._polygon_counts = {}  # by path: the number of polygons in the last interval added
        self._uncolored = False
        self._opened = set()  # native instances that must get prims of their own to be coloured
        self._root_path = unused_path(scene, "/Collisions")
        self._contacts_path = f"{self._root_path}/Contacts"
        low, high = _bounds(scene)
        self._width = _POINT_SIZE * float(np.linalg.norm(high - low)) or 1e-3
        self._metadata = layer_metadata(scene)
        self.file = OutputFile(path)
        self._spool = tempfile.TemporaryFile(buffering=0, dir=self.file.folder)  # noqa: SIM115 (closed when discarded)

    def add(self, result: IntervalResult) -> None:
        """Adds the contacts of an interval."""
        interval, contacts = result.summary, result.contacts
        prim = self._contacts_path
        size = self._width / 2
        points = contacts.position.astype(np.float32)
        corners = [points.min(axis=0) - size, points.max(axis=0) + size] if len(points) else np.zeros((2, 3))
        colors = np.array([COLORS[kind] for kind in KINDS])[contacts.kind]
        toi = contacts.toi.astype(np.float32)
        chunks = contacts.chunks()
        for name, texts in {
            "extent": [_tuples(corners)],
            "points": (_tuples(points[rows]) for rows in chunks),
            "primvars:displayColor": (_tuples(colors[rows]) for rows in chunks),
            "primvars:toi": (", ".join(f"{value:.9g}" for value in toi[rows].tolist()) for rows in chunks),
            "primvars:elementA": (_element_texts(contacts, rows, 0) for rows in chunks),
            "primvars:elementB": (_element_texts(contacts, rows, 1) for rows in chunks),
        }.items():
            self._sample(prim, name, interval.start, texts)
        self._color(interval, contacts)
        self._last_start = interval.start
        self._ends.append(self._spool.tell())

    def finish(self, summary: Summary) -> None:
        """Writes the layer and puts it in its place."""
        del self._ends[len(summary.intervals) :]
        self.file.truncate(0)
        self._write(summary.first(len(self._ends)))
        self.file.commit()

    def shrink(self) -> bool:
        """Drops the samples of the last intervals."""
        if not self._ends:
            return False
        self._ends = without_last_eighth(self._ends)
        self._spool.truncate(self._ends[-1] if self._ends else 0)
        return True

    def discard(self) -> None:
        """Removes the temporary files."""
        self._spool.close()
        self.file.discard()

    def _sample(self, prim, name, time, texts, lit_count=0):
        """Adds a sample of an attribute to the spool."""
        place = self._spool.seek(0, os.SEEK_END)
        separator = ""
        for text in texts:
            rest = memoryview((separator + text).encode())
            while rest:
                rest = rest[self._spool.write(rest) :]
            separator = ", "
        sample = _Sample(time, place, self._spool.tell() - place, lit_count)
        self._samples.setdefault((prim, name), []).append(sample)

    def _color(self, interval, contacts):
        """Adds the colours of all meshes whose colours change at the start of an interval."""
        meshes = {mesh.path: mesh for mesh in contacts.interval.segment.meshes if mesh.path == mesh.name}
        lit = {}
        for number, polygons in contacts.colliding_polygons().items():
            mesh = contacts.interval.segment.meshes[number]
            if mesh.path in meshes:
                lit[mesh.path] = polygons
            else:
                self._uncolored = True
        for path in sorted({*self._colored, *lit} & meshes.keys()):
            count, polygons = meshes[path].polygon_count, lit.get(path, np.zeros(0, dtype=np.int64))
            if path not in self._colored:
                self._opened.update(find_instances_above(self._scene, path))
                if self._last_start is not None:
                    self._sample_colors(path, self._last_start, self._polygon_counts.get(path, count), polygons[:0])
            old_count, old_polygons = self._colored.get(path, (None, None))
            if old_count != count or not np.array_equal(old_polygons, polygons):
                self._sample_colors(path, interval.start, count, polygons)
                self._colored[path] = count, polygons
        self._polygon_counts = {path: mesh.polygon_count for path, mesh in meshes.items()}

    def _sample_colors(self, path, time, count, lit):
        colors = display_colors(self._scene, path, time)
        self._unlit[path] = np.array([_UNLIT]) if colors is None else colors
        text = _color_text(self._unlit[path], count, lit)
        self._sample(path, _DISPLAY_COLOR, time, [text], count if len(lit) else 0)

    def _write(self, summary):
        """Writes the whole layer for the intervals of a summary."""
        spool_end = self._ends[-1] if self._ends else 0
        parts = {path: [] for path in sorted(self._opened)}
        for (path, name), samples in self._samples.items():
            kept = [sample for sample in samples if sample.place < spool_end]
            if kept:
                parts.setdefault(path, []).append((name, kept))
        writer = _Writer(self.file)
        writer.write(self._head(summary))
        end = summary.intervals[-1].end if summary.intervals else self._scene.times[0]
        self._write_prims(writer, "", _tree(parts), parts, end)
        writer.flush()

    def _head(self, summary) -> str:
        """Returns the layer's metadata as text."""
        doc = f"Collisions found by warp-bsc replay. {summary.motion}"
        if self._uncolored:
            doc += " Polygons of point instancers are not coloured: their instances are one prim."
        source = Path(os.path.relpath(Path(self._scene.path).resolve(), self.file.path.parent.resolve())).as_posix()
        asset = source if source.startswith("../") else f"./{source}"
        complete = "true" if summary.is_complete else "false"
        stopped = f"\n            string stopped = {_quote(summary.stopped)}" if summary.stopped else ""
        metadata = "\n    ".join(f"{name} = {_literal(value)}" for name, value in self._metadata.items())
        return f"""#usda 1.0
(
    customLayerData = {{
        dictionary collisions = {{
            bool complete = {complete}
            int hits = {summary.hits}
            int intervals = {len(summary.intervals)}{stopped}
        }}
    }}
    doc = {_quote(doc)}
    {metadata}
    subLayers = [
        @@@{asset}@@@
    ]
)
"""

    def _write_prims(self, writer, path, tree, parts, end):
        """Writes the prims below a path, from a tree of their names."""
        indent = "    " * path.count("/")
        for name, children in tree.items():
            below = f"{path}/{name}"
            kind = {self._root_path: "def Scope", self._contacts_path: "def Points"}.get(below, "over")
            opened = " (\n" + indent + "    instanceable = false\n" + indent + ")" if below in self._opened else ""
            writer.write(f'\n{indent}{kind} "{name}"{opened}\n{indent}{{\n')
            if below == self._contacts_path:
                writer.write(f"{indent}    float[] widths = [{self._width:.9g}] (\n")
                writer.write(f'{indent}        interpolation = "constant"\n{indent}    )\n')
            for attribute, samples in parts.get(below, ()):
                self._write_attribute(writer, indent + "    ", below, attribute, samples, end)
            self._write_prims(writer, below, children, parts, end)
            writer.write(f"{indent}}}\n")

    def _write_attribute(self, writer, indent, path, name, samples, end):
        """Writes an attribute's samples, and its value after the last interval."""
        if path == self._contacts_path:
            value_type, interpolation = _CONTACTS[name]
            after = "(0, 0, 0), (0, 0, 0)" if name == "extent" else ""
        else:
            value_type, interpolation = "color3f[]", "uniform"
            lit_count = samples[-1].lit_count
            after = _color_text(self._unlit[path], lit_count, []) if lit_count else None
            writer.write(f"{indent}int[] {name}:indices = None\n")  # the scene's own
        writer.write(f"{indent}{value_type} {name}")
        if interpolation:
            writer.write(f' (\n{indent}    interpolation = "{interpolation}"\n{indent})\n{indent}{value_type} {name}')
        writer.write(".timeSamples = {\n")
        following = [*((sample.time, sample.length) for sample in samples[1:]), (end, len(after or ""))]
        for sample, (time, length) in zip(samples, following, strict=True):
            self._write_sample(writer, indent, sample.time, sample)
            # USD interpolates if both have values, and would show points on the way from one contact to another.
            if sample.length and length and (before := just_before(time)) > sample.time:
                if interpolation == "vertex":
                    writer.write(f"{indent}    {before!r}: [],\n")
                else:
                    self._write_sample(writer, indent, before, sample)
        if after is not None:
            writer.write(f"{indent}    {end!r}: [{after}],\n")
        writer.write(f"{indent}}}\n")

    def _write_sample(self, writer, indent, time, sample):
        writer.write(f"{indent}    {time!r}: [")
        self._spool.seek(sample.place)
        for size in [_COPIED] * (sample.length // _COPIED) + [sample.length % _COPIED]:
            writer.write_bytes(self._spool.read(size))
        writer.write("],\n")


class _Writer:
    """Writes many short texts as a few long ones."""

    def __init__(self, output):
        self.file = output
        self._waiting, self._length = [], 0

    def write(self, text):
        self.write_bytes(text.encode())

    def write_bytes(self, data):
        self._waiting.append(data)
        self._length += len(data)
        if self._length >= _COPIED:
            self.flush()

    def flush(self):
        self.file.write(b"".join(self._waiting))
        self._waiting, self._length = [], 0


@dataclass(frozen=True)
class _Sample:
    """A sample in the spool: its time, its place and length there, and the number of polygons if any is lit."""

    time: float
    place: int
    length: int
    lit_count: int


def _color_text(colors, count, lit) -> str:
    """Returns the colours of a mesh's polygons as text, :data:`LIT` for the lit ones."""
    if len(colors) != count:
        colors = colors.mean(axis=0, keepdims=True)
    table, numbers = np.unique(colors, axis=0, return_inverse=True)
    texts = np.array([_tuples([color]) for color in [*table, LIT]], dtype=object)
    numbers = np.broadcast_to(numbers.reshape(-1), count).copy()
    numbers[lit] = len(table)
    return ", ".join(texts[numbers])


def _element_texts(contacts, rows, side) -> str:
    """Returns the first or the second elements of some contacts as text, with the names of their meshes."""
    both = zip(contacts.mesh_names(rows), contacts.element_names(rows), strict=True)
    return ", ".join(_quote(f"{names[side]} {elements[side]}") for names, elements in both)


def _tree(paths) -> dict:
    """Returns the names of prims as a tree of dictionaries."""
    tree = {}
    for path in paths:
        place = tree
        for name in path.strip("/").split("/"):
            place = place.setdefault(name, {})
    return tree


def _tuples(rows) -> str:
    return ", ".join(f"({x:.9g}, {y:.9g}, {z:.9g})" for x, y, z in np.asarray(rows, dtype=np.float32).tolist())


def _literal(value: str | float) -> str:
    """Returns a string or a number in the syntax of USD's text format."""
    return _quote(value) if isinstance(value, str) else repr(value)


def _quote(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    if escaped.isprintable():
        return f'"{escaped}"'
    return '"' + "".join(c if c.isprintable() else f"\\x{ord(c):02x}" if ord(c) < 128 else "?" for c in escaped) + '"'


def _bounds(scene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounding box of the moving meshes at first, or of all meshes if none moves yet."""
    interval = scene.interval(0)
    segment, x = interval.segment, interval.x0
    meshes, _ = segment.locate_vertices(np.arange(segment.vertex_count))
    moves = np.array([mesh.moves for mesh in segment.meshes], dtype=bool)[meshes]
    x = x[moves] if moves.any() else x
    return (x.min(axis=0), x.max(axis=0)) if len(x) else (np.zeros(3), np.ones(3))
