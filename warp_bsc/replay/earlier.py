"""Reads the results of a stopped replay from its JSON file, so that a later one can go on."""

import json
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import orjson

from .._atomic_file import unfinished_path
from ..detection.collisions import DetectionStats, StageCounts
from ..detection.settings import DistanceKind
from ..usd.interval import Interval
from ..usd.scene import Scene
from .results import IntervalResult, summarize
from .scene_contacts import PHASES, SceneContacts
from .scene_intersections import SceneIntersections
from .scene_pairs import DIAGONAL, EDGE, ELEMENT_WORDS, FACE, KINDS
from .scene_proximities import SceneProximities
from .threads import read_ahead
from .validation import Validation

__all__ = ["EarlierReplay", "describe_difference", "find_earlier"]

_END_OF_LINE = b"],\r\n"


def find_earlier(path: str | os.PathLike, facts: dict[str, Any]) -> "EarlierReplay | None":
    """Returns the earlier replay with the most intervals whose JSON file was to be at a path; None if there is none.

    A replay that was killed has left its intervals at :func:`~warp_bsc._atomic_file.unfinished_path`.

    Args:
        path: The file.
        facts: As of :class:`EarlierReplay`.

    Raises:
        OSError: As of :class:`EarlierReplay`.
        ValueError: As of :class:`EarlierReplay`, if no file there is of a replay that could go on.
    """
    found, refusals = [], []
    for place in filter(os.path.exists, (unfinished_path(path), path)):
        try:
            found.append(EarlierReplay(place, facts))
        except ValueError as error:
            refusals.append(error)
    if refusals and not found:
        raise refusals[0]
    found.sort(key=lambda earlier: earlier.count)
    for shorter in found[:-1]:
        shorter.close()
    return found[-1] if found else None


class EarlierReplay:
    """The intervals that a stopped replay has finished.

    Attributes:
        count: Number of these intervals in its file. The last one may be incomplete.
    """

    def __init__(self, path: str | os.PathLike, facts: dict[str, Any]):
        """Opens the JSON file of the stopped replay.

        Args:
            path: The file.
            facts: Facts of the replay that goes on, see :func:`~warp_bsc.replay.hit_files.replay_facts`.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not such a file, or its replay was another one: of other files, with other options.
        """
        self._file = open(path, "rb")  # noqa: SIM115 (closed by close)
        self._may_be_torn = str(path).endswith(".part")
        try:
            own = orjson.loads(self._file.readline().rstrip() + b"]}")
            wanted = json.loads(json.dumps(facts))
            if not isinstance(own, dict) or own.pop("intervals", None) != []:
                raise ValueError
        except ValueError:
            self._file.close()
            raise ValueError(f"{path}: not a JSON file of this version's replay, which could go on") from None
        for fact in wanted:
            if fact != "device" and own.get(fact) != wanted[fact]:
                self._file.close()
                raise ValueError(
                    f"{path}: its replay was another one, and cannot go on: {describe_difference(fact, own, wanted)}"
                )
        start = self._file.tell()
        self.count = sum(line.startswith(b'{"index":') for line in self._file)
        self._file.seek(start)

    def results(self, scene: Scene) -> Iterator[IntervalResult]:
        """Yields the results of its intervals, in order, as if they had just been found.

        Positions are read from the scene. The last interval of the file is missing if the file does not say what
        intersects at its end, or the replay was killed while it wrote that interval.

        Args:
            scene: The scene, of which no interval has been read.

        Raises:
            ValueError: If the scene is broken, or the file is damaged.
        """
        records = self._records()
        record = next(records, None)
        for interval in read_ahead(scene):
            following = next(records, None)
            if record is None or (following is None and _needs_following(record)):
                return
            yield _rebuild(interval, record, following)
            record = following

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _records(self) -> Iterator[dict]:
        """Yields the fields of each interval."""
        for line in self._file:
            if line.startswith(b'"complete":'):
                return
            try:
                record = orjson.loads(line.rstrip(_END_OF_LINE))
            except ValueError:
                if self._may_be_torn:
                    return
                raise
            yield record


def _needs_following(record: dict) -> bool:
    """Returns whether what was found at the end of an interval is in the record of the next one only."""
    return ("edges_through_faces" in record and "edges_through_faces_at_end" not in record) or (
        "near_pairs" in record and "near_pairs_at_end" not in record
    )


def _rebuild(interval: Interval, record: dict, following: dict | None) -> IntervalResult:
    """Returns the result of an interval, given its fields and those of the next one."""

    def at_end(name: str) -> list[dict]:
        own = f"{name}_at_end"
        return record[own] if following is None or own in record else following[name]

    intersections = proximities = None
    if "edges_through_faces" in record:
        intersections = (
            _rebuild_intersections(
                interval, record["edges_through_faces"] + record["inside"], interval.start, interval.x0
            ),
            _rebuild_intersections(
                interval, at_end("edges_through_faces") + at_end("inside"), interval.end, interval.x1
            ),
        )
    if "near_pairs" in record:
        proximities = (
            _rebuild_proximities(interval, record["near_pairs"], interval.start),
            _rebuild_proximities(interval, at_end("near_pairs"), interval.end),
        )
    contacts = _rebuild_contacts(interval, record, bool(intersections))
    # a scene without curves and points has no record of their pairs
    counts = {kind.label: StageCounts(**record["stages"].get(kind.label, {})) for kind in DistanceKind}
    validation = record["validation"]
    if validation:
        validation = Validation(**validation | {"disagreements": tuple(validation["disagreements"])})
    summary = summarize(
        contacts,
        intersections,
        proximities,
        certified=record["certified"],
        stats=DetectionStats(**counts, milliseconds={}),
        validation=validation,
    )
    return IntervalResult(summary, contacts, intersections, proximities, None)


def _rebuild_contacts(interval: Interval, record: dict, is_compared: bool) -> SceneContacts:
    rows, phases = record["contacts"], {None: -1} | {phase: number for number, phase in enumerate(PHASES)}
    return SceneContacts(
        **_rebuild_pairs(interval, rows),
        interval=interval,
        kind=np.array([KINDS.index(row["kind"]) for row in rows], dtype=np.int64),
        toi=np.array([row["toi"] for row in rows], dtype=np.float64),
        time=np.array([row["time"] for row in rows], dtype=np.float64),
        normal=np.array([row["normal"] for row in rows], dtype=np.float64).reshape(-1, 3),
        counted=np.ones(len(rows), dtype=bool),
        ignored={(first, second): hits for (first, second), hits in (pair.values() for pair in record["ignored"])},
        separate=np.array([row["separate"] for row in rows], dtype=bool) if is_compared else None,
        phase=np.array([phases[row["phase"]] for row in rows], dtype=np.int64) if is_compared else None,
    )


def _rebuild_intersections(interval: Interval, rows: list[dict], time: float, x: np.ndarray) -> SceneIntersections:
    crosses = np.array([row["phase"] == "crosses" for row in rows], dtype=bool)
    return SceneIntersections(**_rebuild_pairs(interval, rows), time=time, crosses=crosses, x=x)


def _rebuild_proximities(interval: Interval, rows: list[dict], time: float) -> SceneProximities:
    return SceneProximities(
        **_rebuild_pairs(interval, rows),
        time=time,
        kind=np.array([KINDS.index(row["kind"]) for row in rows], dtype=np.int64),
        distance=np.array([row["distance"] for row in rows], dtype=np.float64),
    )


def _rebuild_pairs(interval: Interval, rows: list[dict]) -> dict[str, Any]:
    """Returns the fields of :class:`~warp_bsc.replay.scene_pairs.ScenePairs`, given those of the file."""
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
        "position": np.array([row["position"] for row in rows], dtype=np.float64).reshape(-1, 3),
    }


def describe_difference(fact: str, own: dict, wanted: dict) -> str:
    """Returns in words how a fact of two replays differs, given both their facts."""
    before, now = own.get(fact), wanted[fact]
    if isinstance(before, dict) and isinstance(now, dict):
        name = next(name for name in now if before.get(name) != now[name])
        return f"{name} was {before.get(name)}, and is {now[name]}"
    if fact == "files":
        return "the scene's files have changed"
    return f"{fact} was {before}, and is {now}"
