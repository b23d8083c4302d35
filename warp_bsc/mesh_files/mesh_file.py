"""Triangle meshes in files, as the files have them, which can be written again with other positions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._atomic_file import naming
from .glb import read_glb
from .ply import read_ply
from .text_formats import first_of_each, read_obj, read_off, read_stl

READERS = {".glb": read_glb, ".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl}
"""The function that reads the files whose names end so."""


class MeshFile:
    """A mesh in a file.

    Attributes:
        path: The file.
        x: Positions of the vertices in the order of the file, float32 if it declares them so, else float64, shape
            [n, 3]. In an STL file, corners in one place are one vertex.
        faces: Vertices of triangles, integers, shape [m, 3]. A polygon is a fan from its first corner.
        polygons: Face of the file that each triangle is part of, int, shape [m].
        notes: What of the file is not checked, or is kept although it does not fit other positions.
    """

    def __init__(self, path: str):
        """Reads a file.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not as its format says, or a coordinate of a vertex of a face is not finite.
        """
        self.path = path
        suffix = Path(path).suffix.lower()
        if suffix not in READERS:
            raise ValueError(f"{path}: the name of a mesh file must end in {', '.join(READERS)}")
        with naming(path):
            self._data = Path(path).read_bytes()
        try:
            places, self._dtype, self._is_text, counts, corners, notes, self._finish = READERS[suffix](self._data)
            self._places = np.asarray(places, np.int64).reshape(-1, 3, 2)
            counts, corners = np.asarray(counts, np.int64), np.asarray(corners, np.int64)
            self._points = points = self._read_points()
            _check(points, counts, corners)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{path}: {error}") from None
        self.notes = notes + ["polygons are checked as fans from the first corner"] * bool((counts > 3).any())
        self.x, self._vertices = points, np.arange(len(points))
        if suffix == ".stl":
            order, self._vertices = first_of_each(points)  # so that frames of one soup have the same faces
            self.x = points[order]
        in_face = counts - 2
        self.polygons = np.repeat(np.arange(len(counts)), in_face)
        first = (np.cumsum(counts) - counts)[self.polygons]
        second = first + 1 + np.arange(len(first)) - (np.cumsum(in_face) - in_face)[self.polygons]
        self.faces = self._vertices[corners[np.stack([first, second, second + 1], axis=1)]]

    def with_positions(self, x: np.ndarray) -> bytes:
        """Returns the bytes of the file with other positions of its vertices; those that are equal keep their bytes."""
        points = x[self._vertices]
        changed = (points != self._points) & ~np.isnan(points)  # of unused vertices
        places, values = self._places[changed], points[changed].astype(self._dtype)
        if not self._is_text:
            data = np.frombuffer(self._data, np.uint8).copy()
            data[places[:, :1] + np.arange(self._dtype.itemsize)] = values[:, None].view(np.uint8)
            return self._finish(data.tobytes())
        parts, at = [], 0
        for row in np.argsort(places[:, 0]):
            parts += self._data[at : places[row, 0]], repr(values[row].item()).encode()
            at = places[row, 1]
        return b"".join([*parts, self._data[at:]])

    def _read_points(self) -> np.ndarray:
        """Returns the coordinates at all places."""
        if self._is_text:
            numbers = [float(self._data[start:end]) for start, end in self._places.reshape(-1, 2).tolist()]
            with np.errstate(over="ignore"):
                return np.array(numbers).reshape(-1, 3).astype(self._dtype)
        rows = self._places[..., :1] + np.arange(self._dtype.itemsize)
        return np.frombuffer(self._data, np.uint8)[rows].view(self._dtype)[..., 0].astype(self._dtype.newbyteorder("="))


class MeshScene:
    """The meshes of several files as one.

    Attributes:
        files: The files.
        x: Positions of the vertices of all files, float64 unless all are float32, shape [n, 3].
        faces: Vertices of all triangles, int64, shape [m, 3].
        file_of: Number of the file of each vertex, shape [n].
    """

    def __init__(self, paths: Sequence[str]):
        """Reads the files, with the errors of :class:`MeshFile`."""
        self.files = [MeshFile(path) for path in paths]
        counts = [len(file.x) for file in self.files]
        self._starts = np.cumsum(counts) - counts
        self.x = np.concatenate([file.x for file in self.files])
        self.faces = np.concatenate([file.faces + at for file, at in zip(self.files, self._starts, strict=True)])
        self.file_of = np.repeat(np.arange(len(counts)), counts)
        self._polygons = np.concatenate([file.polygons for file in self.files])

    def of_files(self, values: np.ndarray) -> list[np.ndarray]:
        """Returns values of all vertices by file."""
        return [values[self.file_of == number] for number in range(len(self.files))]

    def element(self, kind: str, number: Any) -> dict[str, Any]:
        """Returns a vertex, an edge or a face with its numbers in its file, from 0, the file, and a point of it.

        Args:
            kind: "vertex", "edge" or "face".
            number: The vertex, the ends of the edge, or the number of the triangle.
        """
        first = self.faces[number, 0] if kind == "face" else np.ravel(number)[0]
        file = self.file_of[first]
        local = self._polygons[number] if kind == "face" else number - self._starts[file]
        return {kind: np.asarray(local).tolist(), "of": self.files[file].path, "at": self.x[first].tolist()}


def is_mesh_file(path: str) -> bool:
    """Returns whether a path ends as the name of a mesh file does."""
    return Path(path).suffix.lower() in READERS


def _check(points: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> None:
    """Raises a ValueError if there are no faces, or a corner is no vertex, or at one that is not finite."""
    if not len(counts):
        raise ValueError("it has no faces")
    bad = counts < 3
    bad[np.repeat(np.arange(len(counts)), counts)[(corners < 0) | (corners >= len(points))]] = True
    if bad.any():
        raise ValueError(
            f"face {np.argmax(bad)}, counted from 0, has less than three corners, or one that is no vertex"
        )
    bad = ~np.isfinite(points[corners]).all(axis=1)
    if bad.any():
        vertex = corners[np.argmax(bad)]
        raise ValueError(f"vertex {vertex}, counted from 0, has a coordinate that is not finite: {points[vertex]}")
