"""The lines of the JSON file of a replay, each written and read back by neighbouring functions.

The first line holds the facts of the replay, names of meshes and prims among them, the last one its sums, each of the
others an interval. The fields of its pairs are columns, by which they are both written and read.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import orjson

from ..usd.interval import Interval
from .results import AnyPairs, IntervalResult
from .scene_contacts import SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import ALL_PHASES, DIAGONAL, EDGE, ELEMENT_WORDS, FACE, KINDS, PHASES, ScenePairs
from .scene_proximities import SceneProximities
from .summary_records import read_summary, summary_fields

_INTERVALS = "intervals"
_COMPLETE = "complete"
_END_OF_INTERVAL = b"],\r\n"
_AT_END = "_at_end"
"""Ending of the names of the lists at the end of an interval, where those of the next interval do not contain them."""


# The first and the last line ---------------------------------------------------------------------------------------


def head_line(facts: dict[str, Any]) -> str:
    """Returns the first line, without its line break."""
    return f'{json.dumps(facts)[:-1]}, "{_INTERVALS}": ['


def read_head(line: bytes) -> dict[str, Any]:
    """Returns the facts in the first line.

    Raises:
        ValueError: If the line is not the first one of a replay's file.
    """
    facts = orjson.loads(line.rstrip() + b"]}")
    if not isinstance(facts, dict) or facts.pop(_INTERVALS, None) != []:
        raise ValueError("not the first line of a replay's JSON file")
    return facts


def tail_line(sums: dict[str, Any]) -> str:
    """Returns the end of the file: the last line, and the end of the line before.

    Args:
        sums: The sums of the replay; the first is ``complete``.
    """
    assert next(iter(sums)) == _COMPLETE
    return "],\n" + json.dumps(sums, allow_nan=False)[1:] + "\n"


def is_tail_line(line: bytes) -> bool:
    """Returns whether a line is the last one."""
    return line.startswith(f'"{_COMPLETE}":'.encode())


def read_tail(line: bytes) -> dict[str, Any]:
    """Returns the sums in the last line.

    Raises:
        ValueError: If the line is damaged.
    """
    return orjson.loads(b"{" + line)


# The pairs of an interval ------------------------------------------------------------------------------------------


class Column(NamedTuple):
    """A field of pairs: written as a value in each row, and read back to an array of the pairs.

    Attributes:
        name: Name of the field.
        write: Returns the values of some rows, given pairs and the rows.
        array: Name of the array; empty if others make it, or it is not stored.
        read: Returns the array, given the values of all rows.
    """

    name: str
    write: Callable[[Any, slice], Sequence[Any]]
    array: str = ""
    read: Callable[[list[Any]], np.ndarray] = np.array


def _numbers(name: str, shape: tuple[int, ...] = (-1,)) -> Column:
    """Returns the column of an array of float64 numbers."""
    return Column(
        name,
        lambda pairs, rows: getattr(pairs, name)[rows].tolist(),
        name,
        lambda values: np.array(values, dtype=np.float64).reshape(shape),
    )


def kind_words(pairs: ScenePairs, rows: slice) -> list[str]:
    """Returns the kinds of some pairs, in words."""
    return [KINDS[kind] for kind in pairs.kind[rows].tolist()]


def phase_words(pairs: AnyPairs, rows: slice) -> list[str | None]:
    """Returns the phases of some pairs, in words; None where a pair has none."""
    assert pairs.phase is not None
    return [ALL_PHASES[phase] if phase >= 0 else None for phase in pairs.phase[rows].tolist()]


def _contact_separate(contacts: SceneContacts, rows: slice) -> list[bool | None]:
    assert contacts.phase is not None and contacts.separate is not None
    phases, separate = contacts.phase[rows].tolist(), contacts.separate[rows].tolist()
    return [one if phase >= 0 else None for phase, one in zip(phases, separate, strict=True)]


_KIND = Column("kind", kind_words, "kind", lambda values: np.array([KINDS.index(kind) for kind in values], np.int64))
_TIME = Column("time", lambda pairs, rows: [pairs.time] * len(pairs.kind[rows]))
_POSITION = _numbers("position", (-1, 3))
_ELEMENTS = (
    Column("elements", lambda pairs, rows: pairs.element_names(rows)),
    Column("indices", lambda pairs, rows: pairs.element_indices(rows)),
    Column("triangle", lambda pairs, rows: pairs.triangles(rows)),
)
"""The fields on the two elements. ``triangle`` is which triangle of its polygon the face is, from 0, or None."""

_CONTACTS = (_KIND, *_ELEMENTS, _numbers("time"), _numbers("toi"), _POSITION, _numbers("normal", (-1, 3)))
_COMPARISON = (
    Column(
        "phase",
        phase_words,
        "phase",
        lambda values: np.array([-1 if phase is None else PHASES.index(phase) for phase in values], dtype=np.int64),
    ),
    Column("separate", _contact_separate, "separate", lambda values: np.array(values, dtype=bool)),
)
"""The fields that contacts have as well if they are compared with the intersections."""

_AT_REST = (_KIND, *_ELEMENTS, _TIME, _POSITION)
_CROSSES = Column(
    "phase", phase_words, "crosses", lambda phases: np.array([phase == "crosses" for phase in phases], bool)
)
_INTERSECTIONS = (*_AT_REST, _CROSSES)
_PROXIMITIES = (*_AT_REST, Column("phase", phase_words), _numbers("distance"))


def _write_pairs(
    name: str, pairs: ScenePairs, of_meshes: np.ndarray, columns: Sequence[Column], which: slice = slice(None)
) -> Iterator[str | bytes]:
    """Yields a member of a JSON object: the list of all pairs, or of some rows of them.

    Args:
        name: Its name.
        pairs: The pairs.
        of_meshes: Numbers in the file of the meshes of their segment.
        columns: The fields after ``mesh``, the numbers of the two meshes.
        which: The rows.
    """
    names = ["mesh", *(column.name for column in columns)]
    yield f', "{name}": ['
    for number, rows in enumerate(pairs.chunks(which)):
        meshes = of_meshes[pairs.meshes[rows]].tolist()
        values = zip(meshes, *(column.write(pairs, rows) for column in columns), strict=True)
        yield (b"," if number else b"") + orjson.dumps([dict(zip(names, row, strict=True)) for row in values])[1:-1]
    yield "]"


def _read_pairs(interval: Interval, rows: list[dict], names: list[str], columns: Sequence[Column]) -> dict[str, Any]:
    """Returns the arrays of pairs of an interval, given the fields of each and the names of the meshes in the file."""
    segment = interval.segment
    numbers = {mesh.name: number for number, mesh in enumerate(segment.meshes)}
    kinds = {word: kind for kind, word in enumerate(ELEMENT_WORDS)}
    meshes = np.array([[numbers[names[mesh]] for mesh in row["mesh"]] for row in rows], dtype=np.int64).reshape(-1, 2)
    elements = [[kinds[element.split()[0]] for element in row["elements"]] for row in rows]
    elements = np.array(elements, dtype=np.int64).reshape(-1, 2)
    indices = [[[*numbers, -1][:2] for numbers in row["indices"]] for row in rows]
    indices = np.array(indices, dtype=np.int64).reshape(-1, 2, 2)
    triangles = np.array([row["triangle"] or 0 for row in rows], dtype=np.int64)
    vertices, faces = np.full_like(indices, -1), np.full_like(meshes, -1)
    for side in range(2):
        of_face, has_two = elements[:, side] == FACE, np.isin(elements[:, side], (EDGE, DIAGONAL))
        faces[of_face, side] = segment.find_faces(meshes[of_face, side], indices[of_face, side, 0], triangles[of_face])
        for end, members in ((0, ~of_face), (1, has_two)):
            vertices[members, side, end] = segment.find_vertices(meshes[members, side], indices[members, side, end])
        vertices[has_two, side] = np.sort(vertices[has_two, side], axis=1)
    arrays = {column.array: column.read([row[column.name] for row in rows]) for column in columns if column.array}
    arrays |= {"elements": elements, "meshes": meshes, "indices": indices, "vertices": vertices, "faces": faces}
    return {"segment": segment} | arrays


# An interval -------------------------------------------------------------------------------------------------------


def interval_line(result: IntervalResult, kinds: Sequence[str], numbers: Mapping[str, int]) -> Iterator[str | bytes]:
    """Yields the text of an interval, without its line break; arguments are those of :func:`.summary_fields`."""
    contacts = result.contacts
    is_joined = contacts.interval.is_joined
    of_meshes = np.array([numbers[mesh.name] for mesh in contacts.segment.meshes], dtype=np.int64)
    yield json.dumps(summary_fields(result.summary, kinds, numbers), allow_nan=False)[:-1]
    is_compared = contacts.phase is not None
    yield from _write_pairs("contacts", contacts, of_meshes, _CONTACTS + _COMPARISON * is_compared)
    for found, ending in zip(result.intersections or (), ("", _AT_END)[: 2 - is_joined], strict=False):
        yield from _write_pairs(f"edges_through_faces{ending}", found, of_meshes, _INTERSECTIONS, found.edge_rows)
        yield from _write_pairs(f"inside{ending}", found, of_meshes, _INTERSECTIONS, found.inside_rows)
    for found, ending in zip(result.proximities or (), ("", _AT_END)[: 2 - is_joined], strict=False):
        yield from _write_pairs(f"proximity_pairs{ending}", found, of_meshes, _PROXIMITIES)
    yield "}"


def is_interval_line(line: bytes) -> bool:
    """Returns whether a line is an interval."""
    return line.startswith(b'{"index":')


def read_interval(line: bytes) -> dict[str, Any]:
    """Returns the fields of an interval.

    Raises:
        ValueError: If the line is damaged.
    """
    return orjson.loads(line.rstrip(_END_OF_INTERVAL))


def needs_following(fields: dict[str, Any]) -> bool:
    """Returns whether the findings at the end of an interval are only in the fields of the next interval."""
    lists = "edges_through_faces", "proximity_pairs"
    return any(name in fields and f"{name}{_AT_END}" not in fields for name in lists)


def read_result(
    interval: Interval, fields: dict[str, Any], following: dict[str, Any] | None, names: list[str]
) -> IntervalResult:
    """Returns the result of an interval, as if it had just been found.

    Args:
        interval: The interval, as the scene yields it.
        fields: Its fields in the file.
        following: Those of the next interval; may be None if the interval does not need them.
        names: Names of the meshes in the file.
    """

    def pairs_at(end: bool, columns: Sequence[Column], *lists: str) -> dict[str, Any]:
        rows = []
        for name in lists:
            own = f"{name}{_AT_END}" if end else name
            rows += fields[own] if own in fields or following is None else following[name]
        return _read_pairs(interval, rows, names, columns)

    moments = ((False, interval.start, interval.x0), (True, interval.end, interval.x1))
    summary = read_summary(fields, interval, names)
    intersections = proximities = None
    if "edges_through_faces" in fields:
        found = []
        for at, (is_end, time, x) in zip(summary.intersections or (), moments, strict=True):
            pairs = pairs_at(is_end, _INTERSECTIONS, "edges_through_faces", "inside")
            found.append(SceneIntersections(**pairs, time=time, x=x, ignored=at.ignored))
        intersections = found[0], found[1]
    if "proximity_pairs" in fields:
        found = [(pairs_at(is_end, _PROXIMITIES, "proximity_pairs"), time) for is_end, time, _ in moments]
        start, end = (SceneProximities(**pairs, time=time) for pairs, time in found)
        proximities = start, end
    rows = fields["contacts"]
    contacts = SceneContacts(
        **_read_pairs(interval, rows, names, _CONTACTS + _COMPARISON * bool(intersections)),
        interval=interval,
        counted=np.ones(len(rows), dtype=bool),
        ignored=summary.ignored,
    )
    return IntervalResult(summary, contacts, intersections, proximities, None)
