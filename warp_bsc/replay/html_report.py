"""Writes a page that shows the collisions of a replay, in one file that needs no network.

The page's parts are in the folder ``page``. Text from the scene's file enters the page as JSON, in which no markup can
begin, and the page's script sets it as text. The content security policy of the page blocks everything else: other
scripts, handlers in attributes, addresses.
"""

import base64
import hashlib
import html
import json
import os
from importlib import resources
from pathlib import Path

import numpy as np

from .._atomic_file import OutputFile
from ..usd.scene import Scene
from .intervals import IntervalResult
from .summary import CERTIFIED_FOR, Summary

__all__ = ["ReportPage"]

_MAX_FACES = 150_000  # in the view in 3D
_MAX_CONTACTS = 20_000
_MAX_ROWS = 10  # of a table
_MAX_DISAGREEMENTS = 200


class ReportPage:
    """A page with a summary, charts, and the worst interval in 3D."""

    def __init__(self, path: str | os.PathLike):
        """Opens the file.

        Raises:
            OSError: If it cannot be written.
        """
        self.file = OutputFile(path)
        self._worst: IntervalResult | None = None

    def add(self, result: IntervalResult) -> None:
        """Keeps an interval if it is the first or has more contacts than all before."""
        if self._worst is None or len(result.contacts) > len(self._worst.contacts):
            self._worst = result

    def finish(self, summary: Summary) -> None:
        """Writes the page and puts it in its place."""
        folder = resources.files("warp_bsc.replay") / "page"
        style = (folder / "page.css").read_text(encoding="utf-8")
        script = "\n".join((folder / name).read_text(encoding="utf-8") for name in ("viewer.js", "page.js"))
        fields = {
            "title": html.escape(_title(summary)),
            "style_hash": _policy_hash(style),
            "script_hash": _policy_hash(script),
            "style": style,
            "script": script,
            "data": _inert(_data(summary, self._worst)),
        }
        page = (folder / "page.html").read_text(encoding="utf-8")
        parts = page.replace("{{", "}}").split("}}")  # text, name, text, name, ...
        self.file.truncate(0)
        self.file.write("".join(fields[part] if index % 2 else part for index, part in enumerate(parts)))
        self.file.commit()

    def shrink(self) -> bool:
        """Drops nothing: the size of the page does not depend on the number of intervals."""
        return False

    def discard(self) -> None:
        """Removes the temporary file."""
        self.file.discard()


def _data(summary: Summary, worst: IntervalResult | None) -> dict:
    """Returns the data that the page's script shows."""
    scene = summary.scene
    displayed = scene.display_names
    tiles = [
        (f"{summary.hits:,}", "colliding pairs"),
        (f"{len(summary.colliding):,} of {len(summary.intervals):,}", "intervals with collisions"),
    ]
    if first := summary.first_contact:
        tiles.append((f"{first.time:.6g}", "time code of the first"))
    tiles += [
        (f"{len(scene.names):,}", "meshes" if len(scene.names) != 1 else "mesh"),
        (f"{scene.face_count:,}", "triangles"),
        ("yes" if summary.certified else "no", f"certified for {CERTIFIED_FOR}"),
    ]
    data = {
        "title": _title(summary),
        "subtitle": f"{scene.path}, time {scene.times[0]:g} to {scene.times[-1]:g}; method {summary.method} on "
        f"{summary.device}",
        "partial": "",
        "tiles": tiles,
        "intervals": [
            (interval.start, interval.end, interval.vertex_face_hits, interval.edge_edge_hits)
            for interval in summary.intervals
        ],
        "toi": summary.toi_counts,
        "stages": list(summary.milliseconds.items()),
        "pairs": [
            {
                "text": first if first == second else f"{first} with {second}",
                "under": "with itself" if first == second else "",
                "hits": hits,
            }
            for (first, second), hits in summary.mesh_pairs[:_MAX_ROWS]
        ],
        "more_pairs": max(0, len(summary.mesh_pairs) - _MAX_ROWS),
        "worst": [
            {
                "start": interval.start,
                "end": interval.end,
                "hits": interval.hits,
                "time": earliest.time,
                "what": _describe(earliest),
            }
            for interval in summary.worst[:_MAX_ROWS]
            if (earliest := interval.earliest)
        ],
        "facts": [
            ("File", scene.path),
            *scene.comments,
            ("Up axis", scene.up_axis),
            ("Metres per unit", f"{scene.meters_per_unit:g}"),
            ("Time codes per second", f"{scene.time_codes_per_second:g}"),
            ("Vertices", f"{scene.vertex_count:,}"),
            *((f"Mesh {name}", displayed[name] or "no display name") for name in scene.names[:_MAX_ROWS]),
        ],
        "notes": [summary.motion, *scene.warnings],
        "validation": None,
        "view": _view(worst, scene) if worst and worst.contacts.interval.segment.meshes else None,
    }
    if not summary.is_complete:
        data["partial"] = (
            f"Partial: {len(summary.intervals)} of {summary.interval_count} intervals were checked; {summary.stopped}."
        )
    if found := summary.validation:
        wrong = len(found.disagreements)
        text = (
            f"{found.hits:,} collisions and {found.others:,} other pairs were asked again of the exact checker: "
            f"{wrong:,} {'disagreement' if wrong == 1 else 'disagreements'}. Floating point had certified "
            f"{found.certified:,} of all {found.answers:,} answers."
        )
        data["validation"] = {"text": text, "disagreements": found.disagreements[:_MAX_DISAGREEMENTS]}
    return data


def _view(result: IntervalResult, scene: Scene) -> dict:
    """Returns the worst interval for the view in 3D: triangles at its start and end, and the contacts."""
    contacts = result.contacts
    interval, segment = contacts.interval, contacts.interval.segment
    start, end = interval.x0.astype(np.float64), interval.x1.astype(np.float64)
    faces = segment.faces
    title = f"time {interval.start:g} to {interval.end:g}, {len(contacts):,} colliding pairs"
    lit = contacts.colliding_faces
    shown = np.arange(len(faces))
    rows = np.arange(len(contacts))
    if len(faces) > _MAX_FACES:
        # Show the faces around the contact nearest to the middle of all.
        places = contacts.position if len(contacts) else start[faces[:, 0]]
        middle = places[np.argmin(np.abs(places - np.median(places, axis=0)).max(axis=1))]
        distance = np.abs(start[faces].mean(axis=1) - middle).max(axis=1)
        shown = np.sort(np.argpartition(distance, _MAX_FACES)[:_MAX_FACES])
        rows = np.flatnonzero(np.abs(contacts.position - middle).max(axis=1) <= distance[shown].max())
        title += f"; the {_MAX_FACES:,} of {len(faces):,} triangles around one place are shown"
    lit = np.intersect1d(lit, shown)
    vertices, corners = np.unique(faces[shown], return_inverse=True)
    number = np.full(len(faces), -1)
    number[shown] = np.arange(len(shown))
    corners = corners.reshape(-1, 3)
    if len(rows) > _MAX_CONTACTS:
        rows = rows[np.linspace(0, len(rows) - 1, _MAX_CONTACTS).astype(int)]
        title += f"; {_MAX_CONTACTS:,} contacts are shown"
    center = (start[vertices].min(axis=0) + start[vertices].max(axis=0)) / 2
    mesh_of_vertex, _ = segment.locate_vertices(vertices)
    return {
        "title": title,
        "from": interval.start,
        "to": interval.end,
        "at": round(float(np.median(contacts.toi)), 3) if len(contacts) else 0.0,
        "up_axis": scene.up_axis,
        "meshes": [{"name": mesh.name, "moves": mesh.moves} for mesh in segment.meshes],
        "start": _packed(start[vertices] - center, np.float32),
        "end": _packed(end[vertices] - center, np.float32),
        "mesh_of_vertex": _packed(mesh_of_vertex, np.uint32),
        "faces": _packed(corners, np.uint32),
        "lit": _packed(corners[number[lit]], np.uint32),
        "contacts": _packed(contacts.position[rows] - center, np.float32),
        "kinds": _packed(contacts.kind[rows], np.uint32),
        "toi": _packed(contacts.toi[rows], np.float32),
    }


def _describe(contact):
    (first, second), (first_element, second_element) = contact.meshes, contact.elements
    return f"{first}, {first_element}, with {'its' if first == second else second + ','} {second_element}"


def _title(summary):
    return f"Collisions in {Path(summary.scene.path).name}"


def _packed(values, dtype) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()).decode()


def _inert(data) -> str:
    """Returns JSON in which no tag and no comment can begin or end."""
    text = json.dumps(data, allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _policy_hash(text) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
