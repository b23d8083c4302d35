"""Reads PLY files, text and binary. Errors are ValueErrors, which name the line of text."""

import itertools
import re
from collections.abc import Iterator

import numpy as np

from .text_formats import KEPT_NORMALS, Contents, bad_line, coordinates, integers, lines_of

_ORDERS = {b"ascii": "", b"binary_little_endian": "<", b"binary_big_endian": ">"}
_NAMES = {"i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16"}
_NAMES |= {"i4": "int int32", "u4": "uint uint32", "f4": "float float32", "f8": "double float64"}
_TYPES = {name: code for code, names in _NAMES.items() for name in names.split()}
_WANTED = {"vertex": ("x", "y", "z"), "face": ("vertex_indices", "vertex_index")}


def read_ply(data: bytes) -> Contents:
    """Returns the contents of a PLY file."""
    header = re.match(rb"ply[ \t]*\r?\n(.*?\n)end_header[ \t]*\r?\n", data, re.DOTALL)
    form = header and re.search(rb"^format[ \t]+(\w+)", header[1], re.MULTILINE)
    if not header or not form or form[1] not in _ORDERS:
        raise ValueError("it has no header of a PLY file")
    order, at = _ORDERS[form[1]], header.end()
    lines, types = lines_of(data, at), set()
    places, counts, corners, notes = [], [], [], []
    for element, count, properties in _read_header(data, header):
        names = [name for name, _, _ in properties]
        wanted = [names.index(name) for name in _WANTED.get(element, ()) if name in names]
        if element == "vertex":
            types = {properties[row][1] for row in wanted}
            notes = [KEPT_NORMALS] if "nx" in names else []
            if len(wanted) != 3 or types not in ({"f4"}, {"f8"}):
                raise ValueError("its vertices must have x, y and z, all of type float or all of type double")
        for start, run in _runs(data, at, count, properties, order) if order else ():
            if element == "vertex":
                offsets = [run.dtype.fields[names[row]][1] for row in wanted]  # pyright: ignore
                places.append(start + run.itemsize * np.arange(len(run))[:, None] + offsets)
            elif wanted:
                counts += [run[names[wanted[0]]].shape[1]] * len(run)
                corners += run[names[wanted[0]]].ravel().tolist()
            at = start + run.nbytes
        for place in itertools.islice(lines, 0 if order else count):
            if element == "vertex":
                places += coordinates(data, place, wanted)
            elif wanted:
                words = data[slice(*place)].split()[wanted[0] :]
                counts += integers(data, place[0], words, 1)
                corners += integers(data, place[0], words[1:], counts[-1])
    if not types or not places:
        raise ValueError("it has no vertices")
    dtype = np.dtype(order + types.pop())
    if order:
        starts = np.concatenate(places)
        places = np.stack([starts, starts + dtype.itemsize], axis=2)
    return Contents(places, dtype, not order, counts, corners, notes)


def _read_header(data: bytes, header: re.Match) -> list[tuple[str, int, list[tuple[str, str, str]]]]:
    """Returns name, count and properties of the elements: name, type, and type of the length, empty without one."""
    elements = []
    for line in re.finditer(rb"[^\n]+", header[1]):
        try:
            match line[0].decode("latin-1").split():
                case ["element", name, count]:
                    elements.append((name, int(count), []))
                case ["property", "list", length_type, type, name]:
                    elements[-1][2].append((name, _TYPES[type], _TYPES[length_type]))
                case ["property", type, name]:
                    elements[-1][2].append((name, _TYPES[type], ""))
        except (KeyError, ValueError, IndexError):
            raise bad_line(data, header.start(1) + line.start(), f"{line[0]!r} is no element or property") from None
    return elements


def _runs(
    data: bytes, at: int, count: int, properties: list[tuple[str, str, str]], order: str
) -> Iterator[tuple[int, np.ndarray]]:
    """Yields the first byte and the records of runs whose lists are as long as each other's."""
    window = count
    while count:
        layout, lengths = [], []
        try:
            for name, type, length_type in properties:
                if length_type:
                    end = at + np.dtype(layout).itemsize
                    (length,) = np.frombuffer(data, order + length_type, 1, end).tolist()
                    lengths.append(f"length of {name}")
                    layout += [(lengths[-1], order + length_type), (name, order + type, (length,))]
                else:
                    layout.append((name, order + type))
            dtype = np.dtype(layout)
            fitting = min(count, window, (len(data) - at) // max(1, dtype.itemsize))
            records = np.frombuffer(data, dtype, max(1, fitting), at)
        except ValueError:
            raise ValueError("it ends before its last vertex or face, or has a property twice") from None
        differs = np.any([records[name] != records[name][0] for name in lengths], axis=0)
        run = records[: np.argmax(differs)] if np.any(differs) else records
        yield at, run
        at, count, window = at + run.nbytes, count - len(run), 2 * len(run) + 64
