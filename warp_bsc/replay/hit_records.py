"""The lines of the JSON file of a replay, each written and read back by neighbouring functions.

The first line holds the facts of the replay, the last one its sums, each of the others an interval. The fields of its
pairs are columns, by which they are both written and read.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import orjson

from ..detection.collisions import DetectionStats, StageCounts
from ..detection.settings import DistanceKind
from ..usd.interval import Interval
from .results import IntersectionSummary, IntervalResult, summarize
from .scene_contacts import PHASES, SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import DIAGONAL, EDGE, ELEMENT_WORDS, FACE, KINDS, ScenePairs
from .scene_proximities import SceneProximities
from .validation import Validation

__all__ = [
    "head_line",
    "intersection_kinds",
    "intersection_phases",
    "interval_line",
    "is_interval_line",
    "is_tail_line",
    "mesh_pairs_to_list",
    "needs_following",
    "read_head",
    "read_interval",
    "read_result",
    "read_tail",
    "tail_line",
]

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
        array: Name of the array; empty if :func:`_read_elements` makes it, or it is not stored.
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


def intersection_kinds(intersections: SceneIntersections, rows: slice) -> list[str]:
    """Returns the kinds of some intersections, in words."""
    edges = intersections.edge_rows.stop
    return ["edge-face" if row < edges else "vertex-face" for row in range(*rows.indices(len(intersections)))]


def intersection_phases(intersections: SceneIntersections, rows: slice) -> list[str]:
    """Returns what the elements of some intersections do, in words."""
    crosses, edges = intersections.crosses[rows].tolist(), intersections.edge_rows.stop
    numbers = range(*rows.indices(len(intersections)))
    return [
        "inside" if row >= edges else "crosses" if passes else "touches"
        for row, passes in zip(numbers, crosses, strict=True)
    ]


def _contact_phases(contacts: SceneContacts, rows: slice) -> list[str | None]:
    assert contacts.phase is not None
    return [PHASES[phase] if phase >= 0 else None for phase in contacts.phase[rows].tolist()]


def _contact_separate(contacts: SceneContacts, rows: slice) -> list[bool | None]:
    assert contacts.phase is not None and contacts.separate is not None
    phases, separate = contacts.phase[rows].tolist(), contacts.separate[rows].tolist()
    return [one if phase >= 0 else None for phase, one in zip(phases, separate, strict=True)]


def _same(value: Callable[[Any], Any]) -> Callable[[Any, slice], list[Any]]:
    """Returns what writes one value of the pairs in all rows."""
    return lambda pairs, rows: [value(pairs)] * len(range(*rows.indices(len(pairs))))


_KIND = Column(
    "kind",
    lambda pairs, rows: [KINDS[kind] for kind in pairs.kind[rows].tolist()],
    "kind",
    lambda values: np.array([KINDS.index(kind) for kind in values], dtype=np.int64),
)
_POSITION = _numbers("position", (-1, 3))
_ELEMENTS = (
    Column("meshes", lambda pairs, rows: pairs.mesh_names(rows)),
    Column("prims", lambda pairs, rows: pairs.mesh_paths(rows)),
    Column("elements", lambda pairs, rows: pairs.element_names(rows)),
    Column("indices", lambda pairs, rows: pairs.element_indices(rows)),
    Column("triangle", lambda pairs, rows: pairs.triangles(rows)),
)
"""The fields on the two elements. ``triangle`` is which triangle of its polygon the face is, from 0, or None."""

_CONTACTS = (_KIND, *_ELEMENTS, _numbers("time"), _numbers("toi"), _POSITION, _numbers("normal", (-1, 3)))
_COMPARISON = (
    Column(
        "phase",
        _contact_phases,
        "phase",
        lambda values: np.array([-1 if phase is None else PHASES.index(phase) for phase in values], dtype=np.int64),
    ),
    Column("separate", _contact_separate, "separate", lambda values: np.array(values, dtype=bool)),
)
"""The fields that contacts have as well if they are compared with the intersections."""

_INTERSECTIONS = (
    Column("kind", intersection_kinds),
    *_ELEMENTS,
    Column("time", _same(lambda pairs: pairs.time)),
    _POSITION,
    Column(
        "phase",
        intersection_phases,
        "crosses",
        lambda values: np.array([phase == "crosses" for phase in values], dtype=bool),
    ),
)
_PROXIMITIES = (
    _KIND,
    *_ELEMENTS,
    Column("time", _same(lambda pairs: pairs.time)),
    _POSITION,
    Column("phase", _same(lambda _: "near")),
    _numbers("distance"),
)


def _write_pairs(
    name: str, pairs: ScenePairs, columns: Sequence[Column], which: slice = slice(None)
) -> Iterator[str | bytes]:
    """Yields a member of a JSON object: the list of all pairs, or of some rows of them."""
    names = [column.name for column in columns]
    yield f', "{name}": ['
    for number, rows in enumerate(pairs.chunks(which)):
        values = zip(*(column.write(pairs, rows) for column in columns), strict=True)
        yield (b"," if number else b"") + orjson.dumps([dict(zip(names, row, strict=True)) for row in values])[1:-1]
    yield "]"


def _read_pairs(interval: Interval, rows: list[dict], columns: Sequence[Column]) -> dict[str, Any]:
    """Returns the arrays of pairs of an interval, given the fields of each."""
    arrays = {column.array: column.read([row[column.name] for row in rows]) for column in columns if column.array}
    return _read_elements(interval, rows) | arrays


def _read_elements(interval: Interval, rows: list[dict]) -> dict[str, Any]:
    """Returns the arrays that :data:`_ELEMENTS` describe, and the segment."""
    segment = interval.segment
    numbers = {mesh.name: number for number, mesh in enumerate(segment.meshes)}
    kinds = {word: kind for kind, word in enumerate(ELEMENT_WORDS)}
    meshes = np.array([[numbers[name] for name in row["meshes"]] for row in rows], dtype=np.int64).reshape(-1, 2)
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
    return {
        "segment": segment,
        "elements": elements,
        "meshes": meshes,
        "indices": indices,
        "vertices": vertices,
        "faces": faces,
    }


# An interval -------------------------------------------------------------------------------------------------------


def interval_line(result: IntervalResult, kinds: Sequence[str]) -> Iterator[str | bytes]:
    """Yields the text of an interval, without its line break.

    Args:
        result: The result.
        kinds: Labels of the kinds of pair whose numbers are written.
    """
    interval, contacts = result.summary, result.contacts
    is_joined = contacts.interval.is_joined
    fields = {
        "index": interval.index,
        "start": interval.start,
        "end": interval.end,
        "pairs_tested": interval.pairs_tested,
        "hits": interval.hits,
        **{f"{kind}_hits": getattr(interval, f"{kind}_hits") for kind in kinds},
        "earliest": asdict(interval.earliest) if interval.earliest else None,
        "mesh_pairs": mesh_pairs_to_list(interval.mesh_pairs.items()),
        "ignored": mesh_pairs_to_list(interval.ignored.items()),
        "certified": interval.certified,
        "stages": {kind: asdict(getattr(interval.stats, kind)) for kind in kinds},
        "validation": asdict(interval.validation) if interval.validation else None,
    }
    if interval.intersections:
        start, end = interval.intersections
        fields["separate_hits"] = interval.separate_hits
        fields["phases"] = dict(zip(PHASES, interval.phases or (), strict=True))
        fields["intersections"] = {"start": _intersection_counts(start), "end": _intersection_counts(end)}
    if interval.proximities:
        fields["proximities"] = dict(zip(("start", "end"), map(asdict, interval.proximities), strict=True))
    yield json.dumps(fields, allow_nan=False)[:-1]
    is_compared = contacts.phase is not None
    yield from _write_pairs("contacts", contacts, _CONTACTS + _COMPARISON * is_compared)
    for found, ending in zip(result.intersections or (), ("", _AT_END)[: 2 - is_joined], strict=False):
        yield from _write_pairs(f"edges_through_faces{ending}", found, _INTERSECTIONS, found.edge_rows)
        yield from _write_pairs(f"inside{ending}", found, _INTERSECTIONS, found.inside_rows)
    for found, ending in zip(result.proximities or (), ("", _AT_END)[: 2 - is_joined], strict=False):
        yield from _write_pairs(f"proximity_pairs{ending}", found, _PROXIMITIES)
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


def read_result(interval: Interval, fields: dict[str, Any], following: dict[str, Any] | None) -> IntervalResult:
    """Returns the result of an interval, as if it had just been found.

    Args:
        interval: The interval, as the scene yields it.
        fields: Its fields in the file.
        following: Those of the next interval; may be None if the interval does not need them.
    """

    def rows_at(end: bool, *names: str) -> list[dict]:
        rows = []
        for name in names:
            own = f"{name}{_AT_END}" if end else name
            rows += fields[own] if own in fields or following is None else following[name]
        return rows

    moments = ((False, interval.start, interval.x0), (True, interval.end, interval.x1))
    intersections = proximities = None
    if "edges_through_faces" in fields:
        start, end = (
            SceneIntersections(
                **_read_pairs(interval, rows_at(is_end, "edges_through_faces", "inside"), _INTERSECTIONS),
                time=time,
                x=x,
            )
            for is_end, time, x in moments
        )
        intersections = start, end
    if "proximity_pairs" in fields:
        start, end = (
            SceneProximities(**_read_pairs(interval, rows_at(is_end, "proximity_pairs"), _PROXIMITIES), time=time)
            for is_end, time, _ in moments
        )
        proximities = start, end
    rows = fields["contacts"]
    contacts = SceneContacts(
        **_read_pairs(interval, rows, _CONTACTS + _COMPARISON * bool(intersections)),
        interval=interval,
        counted=np.ones(len(rows), dtype=bool),
        ignored=_mesh_pairs_from_list(fields["ignored"]),
    )
    # a scene without curves and points has no counts of their pairs
    counts = {kind.label: StageCounts(**fields["stages"].get(kind.label, {})) for kind in DistanceKind}
    validation = fields["validation"]
    if validation:
        validation = Validation(**validation | {"disagreements": tuple(validation["disagreements"])})
    summary = summarize(
        contacts,
        intersections,
        proximities,
        certified=fields["certified"],
        stats=DetectionStats(**counts, milliseconds={}),
        validation=validation,
    )
    return IntervalResult(summary, contacts, intersections, proximities, None)


def _intersection_counts(found: IntersectionSummary) -> dict[str, Any]:
    """Returns the numbers of the intersections at one time."""
    pairs = [
        {"meshes": meshes, "crossings": crossings, "touches": touches}
        for meshes, (crossings, touches) in found.mesh_pairs.items()
    ]
    inside = [{"meshes": meshes, "parts": parts} for meshes, parts in found.inside.items()]
    return asdict(found) | {"mesh_pairs": pairs, "inside": inside}


def mesh_pairs_to_list(mesh_pairs: Iterable[tuple[tuple[str, str], int]]) -> list[dict[str, Any]]:
    """Returns numbers of colliding pairs, given by two meshes, as a list of objects."""
    return [{"meshes": meshes, "hits": hits} for meshes, hits in mesh_pairs]


def _mesh_pairs_from_list(mesh_pairs: list[dict[str, Any]]) -> dict[tuple[str, str], int]:
    """Returns the numbers in a list of :func:`mesh_pairs_to_list`, by two meshes."""
    return {(first, second): pair["hits"] for pair in mesh_pairs for first, second in [pair["meshes"]]}
