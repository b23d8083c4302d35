"""Compares a replay with an earlier one of the scene: which collisions, intersections and proximities are new."""

import json
import os
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args

import orjson

from .._atomic_file import naming
from .earlier import find_difference
from .hit_records import is_tail_line, read_head, read_tail
from .summary import Summary

Event = Literal["collides", "crosses", "is inside", "is near", "are duplicates", "inverts"]
"""What meshes may do in a replay."""

_SPANS: dict[Event, str] = {
    "collides": "collision_spans",
    "is near": "proximity_spans",
    "are duplicates": "duplicate_spans",
    "inverts": "inversion_spans",
}
_WITHOUT_EFFECT = {"intersections", "strict", "allow_missing", "validate", "limit", "ignore", "triage"}
"""The options that do not change what is compared; ``intersections`` and what is ignored are checked by themselves."""


class NewFinding(NamedTuple):
    """An interval, or a time, in which meshes do something that they did not do then in an earlier replay.

    Attributes:
        what: ``"collides"``, ``"crosses"``, ``"is inside"``, ``"is near"``, ``"are duplicates"`` or ``"inverts"``.
        meshes: Names of the two, of all duplicates, or of the one whose tetrahedra are inverted.
        start: Start of the interval, or the time, as a time code.
        end: End of the interval, or the time.
    """

    what: Event
    meshes: tuple[str, ...]
    start: float
    end: float


class Baseline:
    """The times at which meshes collided, intersected and were near each other in an earlier replay.

    Attributes:
        path: The file of that replay.
    """

    def __init__(self, path: str | os.PathLike, *, method: str, clearance: float | None, options: dict[str, Any]):
        """Reads the JSON file of an earlier replay.

        Args:
            path: The file.
            method: Method of detection of the replays that will be compared with it.
            clearance: Their clearance, as of :class:`Summary`.
            options: Their other options, as of :func:`~warp_bsc.scene_replay.hit_files.replay_facts`.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not the file of a complete replay with the same options, with intersections if these
                are compared, and with at least the same clearance.
        """
        self.path = os.fspath(path)
        self._spans: dict[str, defaultdict[tuple[str, ...], list[tuple[float, float]]]] = {
            event: defaultdict(list) for event in get_args(Event)
        }
        try:
            with naming(path):
                found = _read(path)
            own_clearance, is_complete = found["clearance"], found["complete"]
            earlier = {"method": found["method"], **found["options"]}
            no_more_ignored = _ignored(earlier) - _ignored(options)
            self._names = found["meshes"]
            for span in found["intersections"]:
                if span["inside"] or span["crossings"]:  # others only touch
                    self._add("is inside" if span["inside"] else "crosses", span)
            for event, name in _SPANS.items():
                for span in found[name]:
                    self._add(event, span)
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{path}: not a JSON file of this version's replay") from error
        if not is_complete:
            raise ValueError(f"{path}: its replay was stopped; the baseline must be complete")
        if options["intersections"] and not earlier["intersections"]:
            raise ValueError(f"intersections: {path} lists none, as its replay did not look for them")
        if clearance is not None and own_clearance is None:
            raise ValueError(f"clearance: {path} lists no proximities, as its replay had no clearance")
        if clearance is not None and own_clearance < clearance:
            raise ValueError(f"clearance: {path} lists proximities up to {own_clearance:g}, less than {clearance:g}")
        if no_more_ignored:
            first = " with ".join(min(no_more_ignored))
            raise ValueError(f"{path}: its replay ignored pairs that this one does not; cannot compare: {first}")
        now = json.loads(json.dumps({"method": method, **options}))
        if difference := find_difference(earlier, now, _WITHOUT_EFFECT):
            raise ValueError(f"{path}: written with other options; cannot compare: {difference}")

    def new_in(self, summary: Summary) -> list[NewFinding]:
        """Returns what meshes do in a replay and did not do in the earlier one at that time."""
        found: list[NewFinding] = []

        def add(what: Event, meshes: Iterable[tuple[str, ...]], start: float, end: float) -> None:
            found.extend(NewFinding(what, names, start, end) for names in meshes)

        for at in summary.intervals:
            add("collides", at.mesh_pairs, at.start, at.end)
            add("are duplicates", at.duplicates, at.start, at.end)
            add("inverts", (mesh.meshes for mesh in at.inverted), at.start, at.end)
        for at in summary.intersections:
            add("crosses", (meshes for meshes, (crossings, _) in at.mesh_pairs.items() if crossings), at.time, at.time)
            add("is inside", at.inside, at.time, at.time)
        for at in summary.proximities:
            add("is near", (nearest.meshes for nearest in at.nearest), at.time, at.time)
        return [finding for finding in found if self.lacks(finding)]

    def lacks(self, finding: NewFinding) -> bool:
        """Returns whether the meshes did not do that at that time in the earlier replay.

        Meshes that crossed at a time, or one of which was inside the other, were near each other then. Duplicates may
        have been more.
        """
        what, meshes, start, end = finding
        if what == "are duplicates":
            found = self._spans[what].items()
            spans = [span for names, spans in found if set(names) >= {*meshes} for span in spans]
            return not any(since <= start and end <= until for since, until in spans)
        events = [what, *(("crosses", "is inside") if what == "is near" else ())]
        spans = [span for event in events for span in self._spans[event].get(tuple(sorted(meshes)), ())]
        if what == "collides":  # intervals that only meet are two
            return not any(since < end and start < until for since, until in spans)
        return not any(since <= start <= until for since, until in spans)

    def _add(self, event: Event, span: dict) -> None:
        meshes = tuple(sorted(self._names[mesh] for mesh in span["mesh"]))
        self._spans[event][meshes].append((span["since"], span["until"]))


def _ignored(options: dict[str, Any]) -> set[tuple[str, ...]]:
    """Returns the patterns of what is ignored, given the options of a replay: an earlier one, or this one."""
    return {tuple(pair) for pair in options["ignore"]} | {tuple(entry["meshes"]) for entry in options["triage"]}


def _read(path: str | os.PathLike) -> dict[str, Any]:
    """Returns the facts and the sums of a JSON file, from its first and last line if a replay has written it."""
    with open(path, "rb") as file:
        first = file.readline()
        size = file.seek(0, os.SEEK_END)
        length = 1 << 16
        while True:
            file.seek(max(0, size - length))
            lines = file.read().rstrip().splitlines()
            if len(lines) > 1 or length >= size:
                break
            length *= 2
        if lines and is_tail_line(lines[-1]):
            return read_head(first) | read_tail(lines[-1])
        file.seek(0)  # another program has written the same content
        return orjson.loads(file.read())
