"""Reads OBJ, OFF and STL files, and the lines of text files. Errors are ValueErrors, which name the line."""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

KEPT_NORMALS = "its normals are kept, also where vertices move"
_DOUBLE = np.dtype(np.float64)
_OBJ_STATEMENT = re.compile(rb"(?:^|(?<=\r))(?:\xef\xbb\xbf)?[ \t]*(v|f)[ \t]+([^\r\n#]*)", re.MULTILINE)
_OBJ_UNCHECKED = re.compile(rb"^[ \t]*(?:l|p|curv|curv2|surf)[ \t]", re.MULTILINE)
_STL_VERTEX = re.compile(rb"^[ \t]*vertex\b([^\r\n]*)", re.MULTILINE)
_LINE = re.compile(rb"[^\r\n]*[^\s][^\r\n]*")
_WORD = re.compile(rb"\S+")


class Contents(NamedTuple):
    """The contents of a file.

    Attributes:
        places: The first byte of x, y and z of each point, and the byte after it.
        dtype: Type of these numbers.
        is_text: Whether they are text.
        counts: Number of corners of each polygon.
        corners: The points of all corners.
        notes: What is not checked, or kept although it may not fit other positions.
        finish: Returns the bytes with what else depends on the positions, given those in which they are replaced.
    """

    places: Sequence | np.ndarray
    dtype: np.dtype
    is_text: bool
    counts: Sequence | np.ndarray
    corners: Sequence | np.ndarray
    notes: list[str]
    finish: Callable[[bytes], bytes] = bytes


def read_obj(data: bytes) -> Contents:
    """Returns the contents of an OBJ file."""
    text = data.replace(b"\\\r\n", b"   ").replace(b"\\\n", b"  ")  # as long as before
    places, counts, corners = [], [], []
    for statement in _OBJ_STATEMENT.finditer(text):
        if statement[1] == b"v":
            places += coordinates(text, statement.span(2))
            continue
        words = [word.split(b"/", 1)[0] for word in statement[2].split()]
        counts.append(len(words))
        for number in integers(text, statement.start(), words, len(words)):
            corners.append(number - 1 if number >= 0 else number + len(places) // 3)
    notes = [KEPT_NORMALS] if re.search(rb"^[ \t]*vn[ \t]", data, re.MULTILINE) else []
    if unchecked := len(_OBJ_UNCHECKED.findall(data)):
        notes.append(f"lines, points, curves and surfaces are not checked: {unchecked:,}")
    return Contents(places, _DOUBLE, True, counts, corners, notes)


def read_off(data: bytes) -> Contents:
    """Returns the contents of an OFF file in text form."""
    text = re.sub(rb"#[^\r\n]*", lambda comment: b" " * len(comment[0]), data)  # as long as before
    header = re.match(rb"\s*(?:ST)?C?(N?)OFF\b", text)
    if not header:
        raise ValueError("it does not begin with OFF")
    lines = lines_of(text, header.end())
    start, end = next(lines)
    vertex_count, face_count = integers(text, start, text[start:end].split(), 2)
    places = [place for _ in range(vertex_count) for place in coordinates(text, next(lines))]
    counts, corners = [], []
    for _ in range(face_count):
        start, end = next(lines)
        words = text[start:end].split()
        counts += integers(text, start, words, 1)
        corners += integers(text, start, words[1:], counts[-1])
    return Contents(places, _DOUBLE, True, counts, corners, [KEPT_NORMALS] if header[1] else [])


def read_stl(data: bytes) -> Contents:
    """Returns the contents of an STL file, binary or text."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:
        starts = 96 + 50 * np.arange(count)[:, None] + 4 * np.arange(9)
        places = np.stack([starts, starts + 4], axis=2)
        return Contents(places, np.dtype("<f4"), False, np.full(count, 3), np.arange(3 * count), [KEPT_NORMALS])
    if not data.lstrip().startswith(b"solid"):
        raise ValueError("it is neither a text STL nor a binary one of the length that its count of facets says")
    places = [place for vertex in _STL_VERTEX.finditer(data) for place in coordinates(data, vertex.span(1))]
    *counts, rest = (len(_STL_VERTEX.findall(loop)) for loop in data.split(b"endloop"))
    if rest:
        raise ValueError("it ends within a facet")
    return Contents(places, _DOUBLE, True, counts, range(sum(counts)), [KEPT_NORMALS])


def first_of_each(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rows that are the first with their value, ascending, and for each row the number of its value."""
    _, first, numbers = np.unique(values, axis=0, return_index=True, return_inverse=True)
    order = np.sort(first)
    return order, np.searchsorted(order, first[numbers.reshape(-1)])  # NumPy 2.0 shapes it otherwise


def lines_of(text: bytes, at: int) -> Iterator[tuple[int, int]]:
    """Yields the places of the lines that are not empty, from a byte on; an error in place of the end."""
    for line in _LINE.finditer(text, at):
        yield line.span()
    raise ValueError("it ends before its last vertex or face")


def coordinates(text: bytes, place: tuple[int, int], columns: Sequence[int] = (0, 1, 2)) -> list[tuple[int, int]]:
    """Returns the places of three numbers of a line."""
    words = [word.span() for word in _WORD.finditer(text, *place)]
    try:
        found = [words[column] for column in columns]
        for start, end in found:
            float(text[start:end])
    except (IndexError, ValueError):
        raise bad_line(text, place[0], "a vertex must have three coordinates, all of them numbers") from None
    return found


def integers(text: bytes, at: int, words: Sequence[bytes], count: int) -> list[int]:
    """Returns the integers that the first words of a line are."""
    try:
        return [int(words[i]) for i in range(count)]
    except (IndexError, ValueError):
        raise bad_line(text, at, "a count or a corner of a face is missing or no integer") from None


def bad_line(data: bytes, at: int, problem: str) -> ValueError:
    """Returns an error that names the line of a byte."""
    return ValueError(f"line {data[:at].count(10) + 1}: {problem}")
