"""Reads GLB files, glTF 2.0 in one binary file. Errors are ValueErrors that name what cannot be kept exactly."""

import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from .text_formats import KEPT_NORMALS, Contents, first_of_each

_BLANKS = re.compile(r"[ \t\r\n]*")
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TRIANGLES: dict[int, Callable[[np.ndarray], list[np.ndarray]]] = {  # corners of each, by mode, given their numbers
    4: lambda i: [i[0::3], i[1::3], i[2::3]],
    5: lambda i: [i[:-2], i[1:-1] + i[:-2] % 2, i[2:] - i[:-2] % 2],
    6: lambda i: [i[1:-1], i[2:], 0 * i[2:]],
}


def read_glb(data: bytes) -> Contents:
    """Returns the contents of a GLB file: vertices and faces of all primitives, in the order of meshes."""
    try:
        return _Glb(data).contents()
    except (KeyError, IndexError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"its JSON is not as glTF 2.0 says: {type(error).__name__}: {error}") from None


class _Glb:
    """The chunks of a file."""

    def __init__(self, data: bytes):
        size, length = (int.from_bytes(data[at : at + 4], "little") for at in (8, 12))
        if data[:4] != b"glTF" or data[4:8] != bytes([2, 0, 0, 0]) or data[16:20] != b"JSON":
            raise ValueError("it has no header of a GLB file of glTF 2.0")
        self._start = self._end = 28 + length  # of the binary chunk
        if data[24 + length : self._start] == b"BIN\0":
            self._end += int.from_bytes(data[20 + length : 24 + length], "little")
        if max(size, 20 + length) > len(data) or self._end > max(size, self._start):
            raise ValueError("it is shorter than its header says")
        self._data, self._text = data, data[20 : 20 + length].decode()
        self._gltf = json.loads(self._text)
        self._positions: dict[int, int] = {}  # first point of each accessor of positions

    def contents(self) -> Contents:
        """Returns what a reader returns."""
        gltf, others, counts, corners = self._gltf, set(), [], [np.zeros(0, np.int64)]
        points, skipped = 0, 0
        for number, mesh in enumerate(gltf.get("meshes", ())):
            for index, primitive in enumerate(mesh["primitives"]):
                where = f"mesh {number}, primitive {index}"
                if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                    raise ValueError(f"{where}: it is compressed by Draco; write the file without compression")
                attributes, mode = primitive["attributes"], primitive.get("mode", 4)
                others.update(value for key, value in attributes.items() if key != "POSITION")
                others.update(value for target in primitive.get("targets", ()) for value in target.values())
                if mode not in _TRIANGLES or "POSITION" not in attributes:
                    skipped += 1
                    continue
                accessor = attributes["POSITION"]
                x = self._array(accessor, f"{where}: its positions")
                if x.dtype != np.float32 or x.shape[1] != 3:
                    raise ValueError(f"{where}: its positions are quantised; write the file without quantisation")
                if accessor not in self._positions:
                    self._positions[accessor] = points
                    points += len(x)
                at = np.arange(len(x))
                if "indices" in primitive:
                    at = self._array(primitive["indices"], f"{where}: its indices")[:, 0].astype(np.int64)
                    at[at >= len(x)] = -1 << 60  # no vertex, also not of another primitive
                if mode == 4 and len(at) % 3:
                    raise ValueError(f"{where}: the number of its corners is not divisible by three")
                numbers = np.stack(_TRIANGLES[mode](np.arange(len(at))), axis=1)
                corners.append(self._positions[accessor] + at[numbers].reshape(-1))
                counts += [3] * len(numbers)
        if both := others & self._positions.keys():
            raise ValueError(f"accessor {min(both)} has positions, and something else that would move with them")
        places, numbers = self._places(points)
        notes = [KEPT_NORMALS] * ('"NORMAL"' in self._text)
        notes += [f"primitives that are no triangles are not checked: {skipped:,}"] * bool(skipped)
        if any(gltf.get(key) for key in ("skins", "animations")) or '"targets"' in self._text:
            notes.append("skins, morph targets and animations are kept, and not applied")
        notes += self._notes_on_transforms()
        corners = np.concatenate(corners)
        corners[corners >= 0] = numbers[corners[corners >= 0]]
        return Contents(places, np.dtype("<f4"), False, counts, corners, notes, self._with_bounds)

    def _array(self, number: int, what: str, data: bytes | None = None) -> np.ndarray:
        """Returns an accessor's elements in place, shape [count, width]."""
        accessor = self._gltf["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"{what} are in a sparse accessor; write the file without these")
        start, stride, count, size = self._span(number, what)
        dtype = np.dtype(_TYPES[accessor["componentType"]])
        shape, strides = (count, size // dtype.itemsize), (stride, dtype.itemsize)
        return np.ndarray(shape, dtype, data or self._data, start, strides)

    def _span(self, number: int, what: str) -> tuple[int, int, int, int]:
        """Returns an accessor's first byte in the file, the bytes from one element to the next, count, and size."""
        accessor = self._gltf["accessors"][number]
        view = self._gltf["bufferViews"][accessor["bufferView"]]
        if any("meshopt" in name for name in view.get("extensions", {})):
            raise ValueError(f"{what} are compressed by meshopt; write the file without compression")
        if view["buffer"] or "uri" in self._gltf["buffers"][0]:
            raise ValueError(f"{what} are in another file; write all of it in one .glb")
        size = np.dtype(_TYPES[accessor["componentType"]]).itemsize * _WIDTHS[accessor["type"]]
        offsets = view.get("byteOffset", 0), accessor.get("byteOffset", 0)
        stride, count = view.get("byteStride", size), accessor["count"]
        end = self._start + offsets[0] + view["byteLength"]
        start = self._start + sum(offsets)
        if min(offsets) < 0 or count < 1 or stride < size or start + stride * (count - 1) + size > min(end, self._end):
            raise ValueError(f"{what} (accessor {number}) are not within the file's binary data")
        return start, stride, count, size

    def _places(self, points: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the places of the coordinates of all points in the file, each once, and the number of each point."""
        starts = np.zeros(points, np.int64)
        for number, first in self._positions.items():
            start, stride, count, _ = self._span(number, "positions")
            starts[first : first + count] = start + stride * np.arange(count)
        order, numbers = first_of_each(starts)
        places = starts[order, None] + 4 * np.arange(3)
        starts = np.unique(starts)
        if (np.diff(starts) < 12).any():
            raise ValueError("positions of its primitives overlap in the binary data")
        for number, accessor in enumerate(self._gltf.get("accessors", ())):
            if points and number not in self._positions and "bufferView" in accessor:
                start, stride, count, size = self._span(number, "the elements")
                rows = start + stride * np.arange(count)
                before = np.searchsorted(starts, rows + size) - 1  # the last position that starts before its end
                if ((before >= 0) & (starts[before] + 12 > rows)).any():
                    raise ValueError(f"accessor {number} has bytes of positions, and would move with them")
        return np.stack([places, places + 4], axis=2), numbers

    def _notes_on_transforms(self) -> list[str]:
        """Returns what is to be said of the transforms of nodes; raises a ValueError if they differ."""
        nodes = self._gltf.get("nodes", [])
        parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", ())}

        def world(number: int) -> np.ndarray:
            own = _matrix(nodes[number])
            return world(parents[number]) @ own if number in parents else own

        drawn = [number for number, node in enumerate(nodes) if "mesh" in node]
        for number in drawn:
            where = f"node {number} ({nodes[number].get('name', 'without a name')})"
            if "EXT_mesh_gpu_instancing" in nodes[number].get("extensions", {}):
                raise ValueError(f"{where} draws instances of its mesh, which cannot move one by one")
            if not np.array_equal(world(number), world(drawn[0])):
                raise ValueError(
                    f"{where} has another transform than node {drawn[0]}; apply the transforms to the positions first"
                )
        if not drawn or np.array_equal(world(drawn[0]), np.eye(4)):
            return []
        return ["coordinates and distances are those before the transform of its nodes"]

    def _with_bounds(self, data: bytes) -> bytes:
        """Returns the file with the least and largest coordinates of its accessors of positions as they are now."""
        edits, text = [], self._text
        root = _members(text, _after_blanks(text, 0))
        accessors = _members(text, root["accessors"][0])
        for number in self._positions:
            new, old = self._array(number, "", data), self._array(number, "")
            if np.array_equal(new, old, equal_nan=True):
                continue
            accessor = _members(text, accessors[number][0])
            for key, values in (("min", np.fmin.reduce(new)), ("max", np.fmax.reduce(new))):
                spans = _members(text, accessor[key][0]).values() if key in accessor else ()
                for (start, end), value in zip(spans, values.tolist(), strict=False):
                    if np.float32(text[start:end]) != np.float32(value):
                        edits.append((start, end, repr(value)))
        parts, at = [], 0
        for start, end, number in sorted(edits):
            parts += text[at:start], number
            at = end
        chunk = "".join([*parts, text[at:]]).encode()
        chunk += b" " * (-len(chunk) % 4)
        sizes = [int.from_bytes(data[8:12], "little") + len(chunk) - (self._start - 28), len(chunk)]
        head = [data[:8], *(size.to_bytes(4, "little") for size in sizes), data[16:20]]
        return b"".join([*head, chunk, data[self._start - 8 :]]) if edits else data


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Returns the transform of a node to its parent, shape [4, 4]."""
    from trimesh.transformations import quaternion_matrix, translation_matrix  # noqa: PLC0415 (slow)

    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    scale = np.diag([*node.get("scale", (1, 1, 1)), 1])
    return translation_matrix(node.get("translation", (0, 0, 0))) @ quaternion_matrix((w, x, y, z)) @ scale


def _members(text: str, at: int) -> dict[str | int, tuple[int, int]]:
    """Returns the first character and that after the last of the members of an object or array at a place of JSON."""
    decode, is_object, found = json.JSONDecoder().raw_decode, text[at] == "{", {}
    at = _after_blanks(text, at + 1)
    while text[at] not in "]}":
        key = len(found)
        if is_object:
            key, at = decode(text, at)
            at = _after_blanks(text, _after_blanks(text, at) + 1)  # and the colon
        _, end = decode(text, at)
        found[key] = at, end
        at = _after_blanks(text, end)
        at = _after_blanks(text, at + 1) if text[at] == "," else at
    return found


def _after_blanks(text: str, at: int) -> int:
    return _BLANKS.match(text, at).end()  # pyright: ignore (it always matches)
