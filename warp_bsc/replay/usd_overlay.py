"""A USD layer over the scene, which shows its collisions in usdview and any other program that reads USD."""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._atomic_file import OutputFile
from .scene_contacts import KINDS
from .summary import Outcome

__all__ = ["Overlay"]

COLORS = {"vertex-face": (0.9, 0.1, 0.1), "edge-edge": (1.0, 0.55, 0.0)}
"""Of the contact points, by their kind."""

LIT = (0.95, 0.25, 0.2)
"""Colour of the polygons that collide."""

_UNLIT = (0.6, 0.6, 0.6)  # of a mesh without a colour
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
    """A layer in USD's text format whose sublayer is the scene, so that both are seen when it is opened.

    Contact points are one ``UsdGeom.Points``, its samples at the start of each interval being what meets in it, and
    have the primvars ``toi``, ``elementA`` and ``elementB``. Polygons that collide are coloured from the start of the
    interval to that of the next.

    USD's own layers hold all that is written to them in memory. Here samples wait in a temporary file, and are sorted
    by attribute at the end.
    """

    def __init__(self, path, *, scene):
        """Opens the file.

        Args:
            path: Its place, a ``.usda`` or ``.usd`` file.
            scene: The scene.

        Raises:
            OSError: If it cannot be written.
            ValueError: If it is not such a file, or one that the scene is read from.
        """
        self.path = Path(path)
        if self.path.suffix not in (".usda", ".usd"):
            raise ValueError(f"{path}: the overlay is USD in text form, its name must end in .usda or .usd")
        used = [layer.realPath for layer in scene.stage.GetUsedLayers()]
        if self.path.exists() and any(name and os.path.samefile(name, path) for name in used if os.path.exists(name)):
            raise ValueError(f"{path}: the scene is read from this file, the overlay must be another")
        self._scene = scene
        self._output = OutputFile(path)
        self._spool = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 (closed when discarded)
        self._samples = {}  # by prim and attribute: time, place in the spool and length of each
        self._times = []  # starts of the intervals that are whole
        self._colored = {}  # by the prim's path: the last sample of its colours
        self._polygon_counts = {}  # of the meshes in the interval before
        self._uncolored = False
        self._opened = set()  # instances that must have prims of their own to be coloured
        self._root_path = "/Collisions"
        while scene.stage.GetPrimAtPath(self._root_path):
            self._root_path += "_"
        self._contacts_path = f"{self._root_path}/Contacts"
        low, high = _bounds(scene)
        self._width = _POINT_SIZE * float(np.linalg.norm(high - low)) or 1e-3

    def add(self, interval, contacts):
        """Take the contacts of an interval.

        Raises:
            OSError: If there is no room for them.
        """
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
        self._times.append(interval.start)

    def finish(self, outcome: Outcome):
        """Write the layer and put it in its place.

        Raises:
            OSError: If there is no room. The last intervals are left out then, and the layer is in its place all the
                same, unless there is no room even for that.
        """
        shortage = None
        count = len(self._times)
        while True:
            try:
                self._write(outcome.first(count))
                break
            except OSError as error:
                if count == 0:
                    raise
                shortage = error
                count //= 2
                self._output.truncate(0)
        self._output.commit()
        if shortage:
            raise shortage

    def discard(self):
        """Leave nothing behind, unless the file is finished."""
        self._spool.close()
        self._output.discard()

    def _sample(self, prim, name, time, texts, polygons=0):
        """Let a sample of an attribute wait in the spool, with the number of a mesh's polygons if some are lit."""
        place = self._spool.seek(0, os.SEEK_END)
        separator = ""
        for text in texts:
            rest = memoryview((separator + text).encode())
            while rest:
                rest = rest[self._spool.write(rest) :]
            separator = ", "
        self._samples.setdefault((prim, name), []).append((time, place, self._spool.tell() - place, polygons))

    def _color(self, interval, contacts):
        """Let the colours of all meshes wait that change at the start of an interval."""
        meshes = {mesh.path: mesh for mesh in contacts.segment.meshes if mesh.path == mesh.name}
        lit = {}
        for number, polygons in contacts.colliding_polygons().items():
            mesh = contacts.segment.meshes[number]
            if mesh.path in meshes:
                lit[mesh.path] = polygons
            else:
                self._uncolored = True
        for path in {*self._colored, *lit} & meshes.keys():
            state = meshes[path].polygon_count, lit.get(path, np.zeros(0, dtype=np.int64))
            old = self._colored.get(path)
            if old is None:
                self._open_instances(path)
                old = _Colored(-np.inf, (self._polygon_counts.get(path, state[0]), state[1][:0]))
            if old.state[0] == state[0] and np.array_equal(old.state[1], state[1]):
                continue
            # Colours are interpolated: up to the interval before they must stay what they were.
            if self._times and old.time < self._times[-1]:
                self._sample_colors(path, self._times[-1], old.state)
            self._sample_colors(path, interval.start, state)
            self._colored[path] = _Colored(interval.start, state)
        self._polygon_counts = {path: mesh.polygon_count for path, mesh in meshes.items()}

    def _sample_colors(self, path, time, state):
        count, lit = state
        text = _color_text(_unlit_colors(self._scene.stage, path, count, time), count, lit)
        self._sample(path, _DISPLAY_COLOR, time, [text], count if len(lit) else 0)

    def _open_instances(self, path):
        """Note the instances that a prim is in: below these, only their prototype has colours."""
        prim = self._scene.stage.GetPrimAtPath(path)
        while prim.IsInstanceProxy():
            prim = prim.GetParent()
            if prim.IsInstance():
                self._opened.add(str(prim.GetPath()))

    def _write(self, outcome):
        """Write the whole layer, of the intervals of an outcome."""
        times = self._times[: len(outcome.intervals)]
        end = outcome.intervals[-1].end if outcome.intervals else self._scene.times[0]
        parts = {path: [] for path in sorted(self._opened)}
        for (path, name), samples in self._samples.items():
            kept = [sample for sample in samples if times and sample[0] <= times[-1]]
            if kept:
                parts.setdefault(path, []).append((name, kept))
        writer = _Writer(self._output)
        writer.write(self._head(outcome))
        self._write_prims(writer, "", _tree(parts), parts, (times[-1] if times else end, end))
        writer.flush()

    def _head(self, outcome) -> str:
        """The layer's metadata: that of the scene, which sublayers do not hand on."""
        stage, scene = self._scene.stage, self._scene
        roots = [prim.GetName() for prim in stage.GetPseudoRoot().GetChildren()]
        default = stage.GetDefaultPrim().GetName() if stage.HasDefaultPrim() else roots[0]
        start, end = scene.times[0], scene.times[-1]
        if stage.HasAuthoredTimeCodeRange():
            start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        doc = f"Collisions found by warp-bsc replay. {outcome.motion}"
        if self._uncolored:
            doc += " Polygons of point instancers are not coloured: their instances are one prim."
        source = Path(os.path.relpath(Path(scene.path).resolve(), self.path.parent.resolve())).as_posix()
        asset = source if source.startswith("../") else f"./{source}"
        complete = "true" if outcome.is_complete else "false"
        stopped = f"\n            string stopped = {_quote(outcome.stopped)}" if outcome.stopped else ""
        return f"""#usda 1.0
(
    customLayerData = {{
        dictionary collisions = {{
            bool complete = {complete}
            int hits = {outcome.hits}
            int intervals = {len(outcome.intervals)}{stopped}
        }}
    }}
    defaultPrim = {_quote(default)}
    doc = {_quote(doc)}
    endTimeCode = {end!r}
    framesPerSecond = {stage.GetFramesPerSecond()!r}
    metersPerUnit = {scene.meters_per_unit!r}
    startTimeCode = {start!r}
    subLayers = [
        @@@{asset}@@@
    ]
    timeCodesPerSecond = {stage.GetTimeCodesPerSecond()!r}
    upAxis = "{scene.up_axis}"
)
"""

    def _write_prims(self, writer, path, tree, parts, last):
        """Write the prims below a path, from a tree of their names."""
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
                self._write_attribute(writer, indent + "    ", below, attribute, samples, last)
            self._write_prims(writer, below, children, parts, last)
            writer.write(f"{indent}}}\n")

    def _write_attribute(self, writer, indent, path, name, samples, last):
        """Write an attribute's samples, and what it is once the last interval has ended."""
        last_start, end = last
        if path == self._contacts_path:
            value_type, interpolation = _CONTACTS[name]
            after = [(end, "(0, 0, 0), (0, 0, 0)" if name == "extent" else "")]
        else:
            value_type, interpolation = "color3f[]", "uniform"
            after = []
            if count := samples[-1][3]:
                if samples[-1][0] < last_start:
                    samples = [*samples, (last_start, *samples[-1][1:])]
                after = [(end, _color_text(_unlit_colors(self._scene.stage, path, count, end), count, []))]
            writer.write(f"{indent}int[] {name}:indices = None\n")  # the scene's own
        writer.write(f"{indent}{value_type} {name}")
        if interpolation:
            writer.write(f' (\n{indent}    interpolation = "{interpolation}"\n{indent})\n{indent}{value_type} {name}')
        writer.write(".timeSamples = {\n")
        for time, place, length, _ in samples:
            writer.write(f"{indent}    {time!r}: [")
            self._spool.seek(place)
            for size in [_COPIED] * (length // _COPIED) + [length % _COPIED]:
                writer.write_bytes(self._spool.read(size))
            writer.write("],\n")
        for time, value in after:
            writer.write(f"{indent}    {time!r}: [{value}],\n")
        writer.write(f"{indent}}}\n")


class _Writer:
    """Writes many short texts as a few long ones."""

    def __init__(self, output):
        self._output = output
        self._waiting, self._length = [], 0

    def write(self, text):
        self.write_bytes(text.encode())

    def write_bytes(self, data):
        self._waiting.append(data)
        self._length += len(data)
        if self._length >= _COPIED:
            self.flush()

    def flush(self):
        self._output.write(b"".join(self._waiting))
        self._waiting, self._length = [], 0


@dataclass(frozen=True)
class _Colored:
    """The last sample of a mesh's colours: its time, the number of polygons and which of them are lit."""

    time: float
    state: tuple[int, np.ndarray]


def _unlit_colors(stage, path, count, time) -> np.ndarray:
    """The colours of a mesh's polygons in the scene, shape [count, 3] or, if they are all the same, [1, 3]."""
    from pxr import UsdGeom  # noqa: PLC0415 (slow)

    primvar = UsdGeom.Gprim(stage.GetPrimAtPath(path)).GetDisplayColorPrimvar()
    values = primvar.ComputeFlattened(time) if primvar and primvar.HasValue() else None
    if not values:
        return np.array([_UNLIT])
    colors = np.array(values, dtype=np.float64)
    if primvar.GetInterpolation() == UsdGeom.Tokens.uniform and len(colors) == count:
        return colors
    return colors.mean(axis=0, keepdims=True)


def _color_text(colors, count, lit) -> str:
    """The colours of a mesh's polygons, those lit being :data:`LIT`."""
    table, numbers = np.unique(colors, axis=0, return_inverse=True)
    texts = np.array([_tuples([color]) for color in [*table, LIT]], dtype=object)
    numbers = np.broadcast_to(numbers.reshape(-1), count).copy()
    numbers[lit] = len(table)
    return ", ".join(texts[numbers])


def _element_texts(contacts, rows, side) -> str:
    """The first or the second elements of some contacts, with the names of their meshes."""
    both = zip(contacts.mesh_names(rows), contacts.element_names(rows), strict=True)
    return ", ".join(_quote(f"{names[side]} {elements[side]}") for names, elements in both)


def _tree(paths) -> dict:
    """Names of prims by those of their parents."""
    tree = {}
    for path in paths:
        place = tree
        for name in path.strip("/").split("/"):
            place = place.setdefault(name, {})
    return tree


def _tuples(rows) -> str:
    return ", ".join(f"({x:.9g}, {y:.9g}, {z:.9g})" for x, y, z in np.asarray(rows, dtype=np.float32).tolist())


def _quote(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    if escaped.isprintable():
        return f'"{escaped}"'
    return '"' + "".join(c if c.isprintable() else f"\\x{ord(c):02x}" if ord(c) < 128 else "?" for c in escaped) + '"'


def _bounds(scene) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest corner of what moves at first, or of all if nothing does yet."""
    segment, x, _ = scene.interval(0)
    meshes, _ = segment.locate_vertices(np.arange(segment.vertex_count))
    moves = np.array([mesh.moves for mesh in segment.meshes], dtype=bool)[meshes]
    x = x[moves] if moves.any() else x
    return (x.min(axis=0), x.max(axis=0)) if len(x) else (np.zeros(3), np.ones(3))
