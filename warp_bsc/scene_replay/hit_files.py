"""Writes every collision and every intersection of a replay as JSON or CSV, for programs."""

import csv
import io
import math
import os
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import orjson

from .._version import __version__
from ..detection.run.settings import SURFACE_KINDS, PairKind
from ..usd.scene import Scene
from .hit_records import head_line, interval_line, kind_words, phase_words, tail_line
from .limit import not_listed
from .outputs import RecordFile
from .results import AnyPairs, IntervalResult
from .scene_contacts import SceneContacts
from .scene_pairs import ELEMENT_WORDS
from .scene_proximities import SceneProximities
from .summary import CERTIFIED_FOR, Summary
from .summary_records import mesh_pairs_to_list, with_numbers

_SAVE_SECONDS = 20.0
_FOUND = "duplicate_spans", "inversion_spans", "proximity_spans", "nearest"


def replay_facts(
    scene: Scene, *, method: str, device: str, clearance: float | None, options: dict[str, Any]
) -> dict[str, Any]:
    """Returns the facts of a replay that are known at its start: its scene, method and options.

    Args:
        scene: The scene.
        method: Method of detection.
        device: Name of the Warp device.
        clearance: As of :class:`Summary`.
        options: The other options that the results depend on.
    """
    return {
        "version": __version__,
        "scene": scene.path,
        "files": [
            {"path": path, "bytes": size, "modified_ns": changed}
            for path, (size, changed) in sorted(scene.files.versions().items())
        ],
        "method": method,
        "device": device,
        "clearance": clearance,
        "options": options,
        "time_codes_per_second": scene.time_codes_per_second,
        "meters_per_unit": scene.meters_per_unit,
        "up_axis": scene.up_axis,
        "vertices": scene.vertex_count,
        "faces": scene.face_count,
        "meshes": scene.names,
        "prims": [scene.paths[name] for name in scene.names],
    }


class HitsJson(RecordFile):
    """A JSON file: facts of the replay, every interval with its contacts and intersections, then the sums.

    It names meshes and their prims once, in the lists ``meshes`` and ``prims``; everywhere else ``mesh`` has the
    numbers of two meshes in these lists::

        found = json.load(open("hits.json"))
        for contact in found["intervals"][0]["contacts"]:
            print([found["prims"][mesh] for mesh in contact["mesh"]], contact["elements"], contact["time"])

    An interval lists the intersections, parts inside others and proximities at its start; if the next interval may
    start elsewhere, or there is none, those at its end as well. :mod:`~warp_bsc.scene_replay.hit_records` has the
    lines.

    The file holds no measured times, so that it is the same for any number of processes.
    :class:`~warp_bsc.scene_replay.earlier.EarlierReplay` reads it, or the part of it that a killed process leaves at
    :func:`~warp_bsc._atomic_file.unfinished_path`.
    """

    def __init__(self, path: str | os.PathLike, *, facts: dict[str, Any], has_strands: bool, earlier_count: int = 0):
        """Opens the file.

        Args:
            path: The file.
            facts: What :func:`replay_facts` returns.
            has_strands: Whether the scene has curves or points.
            earlier_count: Number of intervals in the file of an earlier replay, which this one does not replace before
                it has as many.

        Raises:
            OSError: If it cannot be written.
        """
        super().__init__(path)
        self._facts = facts
        self._numbers = {name: number for number, name in enumerate(facts["meshes"])}
        self._earlier_count = earlier_count
        self._saved_at = -math.inf
        self._kinds = [kind.label for kind in PairKind if has_strands or kind in SURFACE_KINDS]

    def add(self, result: IntervalResult) -> None:
        """Appends an interval; saves the file at the first one, and then every 20 seconds."""
        super().add(result)
        if self.file.is_stream or self.record_count < self._earlier_count:
            return
        if time.monotonic() - self._saved_at >= _SAVE_SECONDS:
            self.file.save()
            self._saved_at = time.monotonic()

    def head(self) -> str:
        """Returns the text before the first interval."""
        return head_line(self._facts)

    def record(self, result: IntervalResult) -> Iterator[str | bytes]:
        """Yields the text of an interval with all of its contacts."""
        yield ("," if self.record_count else "") + "\n"
        yield from interval_line(result, self._kinds, self._numbers)

    def tail(self, summary: Summary) -> str:
        """Returns the text after the last interval."""
        numbers = self._numbers
        sums = {
            "complete": summary.is_complete,
            "stopped": summary.stopped,
            "motion": summary.motion,
            "warnings": summary.scene.warnings,
            "left_out": summary.scene.left_out,
            "hits": summary.hits,
            "not_listed": asdict(missing) if (missing := not_listed(summary, with_end=summary.is_complete)) else None,
            "certified": summary.certified,
            "certified_for": CERTIFIED_FOR,
            "mesh_pairs": mesh_pairs_to_list(summary.mesh_pairs, numbers),
            "collision_spans": [with_numbers(span, numbers) for span in summary.collision_spans],
            "ignored": [with_numbers(pair, numbers) for pair in summary.ignored],
            "intersections": [
                with_numbers(span, numbers) | {"trend": span.trend} for span in summary.intersection_spans
            ],
            **{name: [with_numbers(found, numbers) for found in getattr(summary, name)] for name in _FOUND},
            "validation": asdict(summary.validation) if summary.validation else None,
        }
        return tail_line(sums)


class HitsCsv(RecordFile):
    """A CSV file: a row for each contact, intersection and proximity, and last lines with # on what is missing.

    Rows of intersections have the kind "edge-face", no time of impact and no normal. Their time is the interval's
    start, in the last interval its end too. A part of a mesh that is inside another mesh has the phase "inside" and the
    kind "vertex-face": a vertex of the part and a face of the other mesh. Proximities have the phase "near" and a
    distance, no time of impact and no normal.
    """

    _COLUMNS = (
        "interval", "start", "end", "kind",
        "first_mesh", "first_prim", "first_element", "first_index", "first_index_2",
        "second_mesh", "second_prim", "second_element", "second_index", "second_index_2",
        "time", "toi", "x", "y", "z", "normal_x", "normal_y", "normal_z", "phase", "separate", "distance",
    )  # fmt: skip

    def __init__(self, path: str | os.PathLike, *, scene: Scene):
        """Opens the file.

        Raises:
            OSError: If it cannot be written.
        """
        super().__init__(path)
        self._last_index = len(scene) - 1

    def head(self) -> str:
        """Returns the names of the columns."""
        return ",".join(self._COLUMNS) + "\n"

    def record(self, result: IntervalResult) -> Iterator[str]:
        """Yields the rows of an interval."""
        interval = result.summary
        where = f"{interval.index},{interval.start},{interval.end}"
        for pairs in result.pairs(is_last=interval.index == self._last_index):
            yield from _csv_rows(where, pairs)

    def tail(self, summary: Summary) -> str:
        """Returns lines on rows that a limit leaves out, missing intervals and parts that are left out, if any are."""
        limited = str(not_listed(summary, with_end=summary.is_complete) or "")
        lines = "".join(f"# left out: {reason}\n" for reason in summary.scene.left_out)
        lines += "".join(f"# inverted: {span.describe()}\n" for span in summary.inversion_spans)
        lines += f"# limit: {limited}\n" * bool(limited)
        if not summary.is_complete:
            lines += f"# partial: {len(summary.intervals)} of {len(summary.scene)} intervals; {summary.stopped}\n"
        return lines


def _csv_rows(where: str, pairs: AnyPairs) -> Iterator[str]:
    """Yields rows of a CSV file, given the text of the columns of the interval.

    Their texts are made column by column, many times faster than value by value.
    """
    meshes = pairs.segment.meshes
    names = {mesh: _csv_text(meshes[mesh].name, meshes[mesh].path) for mesh in np.unique(pairs.meshes).tolist()}
    for rows in pairs.chunks():
        first, second = (_csv_sides(pairs, rows, side, names) for side in range(2))
        columns = zip(kind_words(pairs, rows), *_csv_measures(pairs, rows), first, second, strict=True)
        yield "".join([f"{where},{kind},{a},{b},{measures},{end}\n" for kind, measures, end, a, b in columns])


def _csv_sides(pairs: AnyPairs, rows: slice, side: int, names: dict[int, str]) -> list[str]:
    """Returns the columns of one side of some pairs: mesh and prim, by mesh, then element, and one or two indices."""
    columns = pairs.meshes[rows, side], pairs.elements[rows, side], *pairs.indices[rows, side].T
    return [
        f"{names[mesh]},{ELEMENT_WORDS[element]} {a},{a},"
        if b < 0
        else f"{names[mesh]},{ELEMENT_WORDS[element]} {a}-{b},{a},{b}"
        for mesh, element, a, b in zip(*(column.tolist() for column in columns), strict=True)
    ]


def _csv_measures(pairs: AnyPairs, rows: slice) -> tuple[list[str], list[str]]:
    """Returns texts of some pairs: the columns from the time to the normal, and those from the phase on."""
    if isinstance(pairs, SceneContacts):
        measures = _numbers_to_csv(pairs.time[rows], pairs.toi[rows], pairs.position[rows], pairs.normal[rows])
        if pairs.phase is None or pairs.separate is None:
            return measures, [",,"] * len(measures)
        phases = zip(phase_words(pairs, rows), pairs.separate[rows].tolist(), strict=True)
        return measures, [f"{phase},{separate}," if phase else ",," for phase, separate in phases]
    measures = [f"{pairs.time},,{point},,," for point in _numbers_to_csv(pairs.position[rows])]
    distances = _numbers_to_csv(pairs.distance[rows]) if isinstance(pairs, SceneProximities) else [""] * len(measures)
    return measures, [f"{phase},,{at}" for phase, at in zip(phase_words(pairs, rows), distances, strict=True)]


def _numbers_to_csv(*columns: np.ndarray) -> list[str]:
    """Returns the numbers of each row of some columns, with commas between."""
    if not len(columns[0]):
        return []
    numbers = np.column_stack(columns)
    return orjson.dumps(numbers, option=orjson.OPT_SERIALIZE_NUMPY).decode()[2:-2].split("],[")


def _csv_text(*values: str) -> str:
    """Returns texts as columns."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(values)
    return text.getvalue()
