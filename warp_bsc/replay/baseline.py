"""What an earlier replay of a scene has found, and what is new since."""

import json
import os
from collections import defaultdict
from typing import Any, NamedTuple

import orjson

from .._atomic_file import naming
from .earlier import describe_difference
from .summary import Summary

__all__ = ["Baseline", "NewFinding"]

_WITHOUT_EFFECT = {
    "intersections",
    "strict",
    "allow_missing",
    "validate",
}  # on what is compared; the first is looked at by itself


class NewFinding(NamedTuple):
    """What two meshes do in an interval, or at a time, in which they did not do it in an earlier replay.

    Attributes:
        what: ``"collides"``, ``"crosses"``, ``"is inside"`` or ``"is near"``.
        meshes: Names of the two.
        start: Start of the interval, or the time, as a time code.
        end: End of the interval, or the time.
    """

    what: str
    meshes: tuple[str, str]
    start: float
    end: float


class Baseline:
    """The times at which meshes collided, intersected and were near each other in an earlier replay."""

    def __init__(self, path: str | os.PathLike, *, method: str, min_distance: float | None, options: dict[str, Any]):
        """Reads the JSON file of an earlier replay.

        Args:
            path: The file.
            method: Method of detection of the replays that will be compared with it.
            min_distance: As of :class:`Summary`, of these.
            options: All other options of these, as of :func:`~warp_bsc.replay.hit_files.replay_facts`.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not such a file, or its replay was stopped, had other options, or did not look for
                intersections or distances as large.
        """
        self._spans: dict[str, defaultdict[tuple[str, ...], list[tuple[float, float]]]] = {
            what: defaultdict(list) for what in ("collides", "crosses", "is inside", "is near")
        }
        try:
            with naming(path):
                found = _read(path)
            distance, is_complete = found["min_distance"], found["complete"]
            had = {"method": found["method"], **found["options"]}
            for span in found["collision_spans"]:
                self._add("collides", span)
            for span in found["intersections"]:
                if span["inside"]:
                    self._add("is inside", span)
                elif span["crossings"]:  # others only touch
                    self._add("crosses", span)
            for span in found["proximity_spans"]:
                self._add("is near", span)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a JSON file of this version's replay") from error
        if not is_complete:
            raise ValueError(f"{path}: its replay was stopped, and does not say what there is later")
        if options["intersections"] and not had["intersections"]:
            raise ValueError(f"{path}: its replay had --no-intersections, and does not say what crossed")
        if min_distance is not None and (distance is None or distance < min_distance):
            own = "no --min-distance" if distance is None else f"--min-distance {distance:g}"
            raise ValueError(f"{path}: its replay had {own}, and does not say what was near at {min_distance:g}")
        wanted = json.loads(json.dumps({"method": method, **options}))
        for name in wanted:
            if name not in _WITHOUT_EFFECT and had.get(name) != wanted[name]:
                difference = describe_difference(name, had, wanted)
                raise ValueError(f"{path}: its replay was another one, and cannot be compared: {difference}")

    def new_in(self, summary: Summary) -> list[NewFinding]:
        """Returns what meshes do in a replay and did not do in the earlier one at that time.

        Meshes that crossed at a time, or of which one was inside the other, count as near each other then.
        """
        new = [
            NewFinding("collides", meshes, interval.start, interval.end)
            for interval in summary.intervals
            for meshes in interval.mesh_pairs
            if not any(
                since < interval.end and interval.start < until
                for since, until in self._spans["collides"][tuple(sorted(meshes))]
            )
        ]
        for sample in summary.intersections:
            crossing = [meshes for meshes, (crossings, _) in sample.mesh_pairs.items() if crossings]
            new += self._new_at(sample.time, "crosses", crossing)
            new += self._new_at(sample.time, "is inside", sample.inside)
        for sample in summary.proximities:
            near = [nearest.meshes for nearest in sample.nearest]
            new += self._new_at(sample.time, "is near", near, ("is near", "crosses", "is inside"))
        return new

    def _add(self, what: str, span: dict) -> None:
        self._spans[what][tuple(sorted(span["meshes"]))].append((span["since"], span["until"]))

    def _new_at(self, time, what, pairs, before=()) -> list[NewFinding]:
        """Returns what pairs of meshes do at a time at which they did nothing of ``before``, default: the same."""
        return [
            NewFinding(what, meshes, time, time)
            for meshes in pairs
            if not any(
                since <= time <= until
                for other in before or (what,)
                for since, until in self._spans[other][tuple(sorted(meshes))]
            )
        ]


def _read(path) -> dict:
    """Returns the members before and after the intervals. The file that a replay writes has them in its ends."""
    with open(path, "rb") as file:
        first = file.readline().rstrip()
        size = file.seek(0, os.SEEK_END)
        length = 1 << 16
        while True:
            file.seek(max(0, size - length))
            lines = file.read().rstrip().splitlines()
            if len(lines) > 1 or length >= size:
                break
            length *= 2
        if lines and lines[-1].startswith(b'"complete":'):
            return orjson.loads(first + b"]}") | orjson.loads(b"{" + lines[-1])
        file.seek(0)  # another program has written the same content
        return orjson.loads(file.read())
