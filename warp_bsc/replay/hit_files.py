"""Writes every collision of a replay as JSON or CSV, for programs."""

import csv
import io
import json
import os
from collections.abc import Iterator
from dataclasses import asdict

from ..usd.scene import Scene
from .intervals import IntervalResult
from .outputs import RecordFile
from .scene_contacts import KINDS
from .summary import CERTIFIED_FOR, Summary

__all__ = ["HitsCsv", "HitsJson"]

_FIELDS = ("kind", "meshes", "prims", "elements", "indices", "time", "toi", "position", "normal")


class HitsJson(RecordFile):
    """A JSON file: facts of the scene, every interval with its contacts, then the sums."""

    def __init__(self, path: str | os.PathLike, *, scene: Scene, method: str, device: str):
        """Opens the file.

        Args:
            path: The file's place.
            scene: The scene.
            method: Method of detection.
            device: Name of the Warp device.

        Raises:
            OSError: If it cannot be written.
        """
        super().__init__(path)
        self._facts = {
            "scene": scene.path,
            "method": method,
            "device": device,
            "time_codes_per_second": scene.time_codes_per_second,
            "meters_per_unit": scene.meters_per_unit,
            "up_axis": scene.up_axis,
            "vertices": scene.vertex_count,
            "faces": scene.face_count,
            "meshes": scene.names,
        }

    def head(self) -> str:
        """Returns the text before the first interval."""
        return json.dumps(self._facts)[:-1] + ', "intervals": ['

    def record(self, result: IntervalResult) -> Iterator[str]:
        """Yields the text of an interval with all of its contacts."""
        interval, contacts = result.summary, result.contacts
        fields = {
            "index": interval.index,
            "start": interval.start,
            "end": interval.end,
            "pairs_tested": interval.pairs_tested,
            "hits": interval.hits,
            "vertex_face_hits": interval.vertex_face_hits,
            "edge_edge_hits": interval.edge_edge_hits,
            "earliest": asdict(interval.earliest) if interval.earliest else None,
            "mesh_pairs": _mesh_pairs_to_list(interval.mesh_pairs.items()),
            "certified": interval.certified,
            "stages": asdict(interval.stats),
            "validation": asdict(interval.validation) if interval.validation else None,
        }
        separator = "," if self.record_count else ""
        yield separator + "\n" + json.dumps(fields, allow_nan=False)[:-1] + ', "contacts": ['
        for number, rows in enumerate(contacts.chunks()):
            chunk = json.dumps([dict(zip(_FIELDS, row, strict=True)) for row in _rows(contacts, rows)], allow_nan=False)
            yield (", " if number else "") + chunk[1:-1]
        yield "]}"

    def tail(self, summary: Summary) -> str:
        """Returns the text after the last interval."""
        sums = {
            "complete": summary.is_complete,
            "stopped": summary.stopped,
            "motion": summary.motion,
            "warnings": summary.scene.warnings,
            "left_out": summary.scene.left_out,
            "hits": summary.hits,
            "certified": summary.certified,
            "certified_for": CERTIFIED_FOR,
            "mesh_pairs": _mesh_pairs_to_list(summary.mesh_pairs),
            "validation": asdict(summary.validation) if summary.validation else None,
        }
        return "],\n" + json.dumps(sums, allow_nan=False)[1:] + "\n"


class HitsCsv(RecordFile):
    """A CSV file: a row for each contact, and a last line that begins with # if some are missing."""

    _COLUMNS = (
        "interval", "start", "end", "kind",
        "first_mesh", "first_prim", "first_element", "first_index", "first_index_2",
        "second_mesh", "second_prim", "second_element", "second_index", "second_index_2",
        "time", "toi", "x", "y", "z", "normal_x", "normal_y", "normal_z",
    )  # fmt: skip

    def head(self) -> str:
        """Returns the names of the columns."""
        return _to_csv([self._COLUMNS])

    def record(self, result: IntervalResult) -> Iterator[str]:
        """Yields the rows of an interval."""
        interval, contacts = result.summary, result.contacts
        where = [interval.index, interval.start, interval.end]
        for rows in contacts.chunks():
            yield _to_csv(
                [
                    *where, kind,
                    names[0], prims[0], elements[0], *indices[0], *[""] * (2 - len(indices[0])),
                    names[1], prims[1], elements[1], *indices[1], *[""] * (2 - len(indices[1])),
                    time, toi, *position, *normal,
                ]
                for kind, names, prims, elements, indices, time, toi, position, normal in _rows(contacts, rows)
            )  # fmt: skip

    def tail(self, summary: Summary) -> str:
        """Returns a line on the missing intervals, empty if there are none."""
        if summary.is_complete:
            return ""
        return f"# partial: {len(summary.intervals)} of {summary.interval_count} intervals; {summary.stopped}\n"


def _rows(contacts, rows):
    """Yields the values of :data:`_FIELDS` for some contacts."""
    paths = [mesh.path for mesh in contacts.segment.meshes]
    columns = (contacts.kind, contacts.meshes, contacts.indices, contacts.time, contacts.toi)
    columns = [column[rows].tolist() for column in (*columns, contacts.position, contacts.normal)]
    for names, elements, kind, pair, indices, *measures in zip(
        contacts.mesh_names(rows), contacts.element_names(rows), *columns, strict=True
    ):
        prims = [paths[mesh] for mesh in pair]
        numbers = [both[:1] if both[1] < 0 else both for both in indices]
        yield KINDS[kind], names, prims, elements, numbers, *measures


def _to_csv(rows) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _mesh_pairs_to_list(mesh_pairs) -> list[dict]:
    return [{"meshes": meshes, "hits": hits} for meshes, hits in mesh_pairs]
