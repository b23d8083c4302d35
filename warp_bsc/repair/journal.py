"""The progress of a repair in a file, from which a later run can resume it after it was stopped or killed."""

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..replay.earlier import describe_difference
from ..usd.points_layer import MovedFrame
from ..usd.scene import Scene
from .findings import Finding
from .stretch import RepairedStretch

__all__ = ["Journal"]

_FORMAT = "warp-bsc repair 1"


class Journal:
    """A file with the facts of a run, its findings, and the stretches that are repaired, one after the other.

    A stretch is a line of JSON, and after it the bytes of its frames: the moved vertices, int64, and their positions,
    float64. What was not written whole, as the process was killed, is not read.

    Attributes:
        findings: What was found in each interval; None if that is not known yet.
        count: Number of stretches.
    """

    def __init__(self, path: str | os.PathLike, facts: dict[str, Any], *, resume: bool):
        """Opens the file of an earlier run, or prepares a new one, which replaces it when there are findings.

        Args:
            path: The file.
            facts: Scene and options of the run, which JSON can hold.
            resume: Whether to go on with an earlier run, if there is a file.

        Raises:
            OSError: If the file cannot be read.
            ValueError: If it is not that of a repair, or was written with other options or of other files.
        """
        self.path = Path(path)
        self._facts = json.loads(json.dumps(facts))
        self.findings: list[Finding] | None = None
        self._places: list[int] = []  # where stretches begin
        self._file = None
        if resume and self.path.exists():
            self._open()

    @property
    def count(self) -> int:
        """Number of stretches."""
        return len(self._places)

    def begin(self, findings: list[Finding]) -> None:
        """Writes the file with the findings and no stretch.

        Raises:
            OSError: If that fails.
        """
        self.findings = findings
        self._file = open(self.path, "w+b")  # noqa: SIM115 (closed by close)
        self._write([_line({"format": _FORMAT, "facts": self._facts}), _line([asdict(found) for found in findings])])

    def add(self, stretch: RepairedStretch) -> None:
        """Appends a stretch.

        Raises:
            OSError: If that fails; the file then has the stretches before it.
        """
        assert self._file
        frames = [(frame.time, frame.before, len(frame.vertices)) for frame in stretch.frames]
        parts = [_line(asdict(replace(stretch, frames=())) | {"frames": frames})]
        for frame in stretch.frames:
            parts += [np.asarray(frame.vertices, np.int64).tobytes(), np.asarray(frame.x, np.float64).tobytes()]
        self._file.seek(0, os.SEEK_END)
        place = self._file.tell()
        try:
            self._write(parts)
        except OSError:
            self._file.truncate(place)
            raise
        self._places.append(place)

    def stretches(self, scene: Scene) -> Iterator[RepairedStretch]:
        """Yields the stretches, in order."""
        assert self._file
        for place in self._places:
            self._file.seek(place)
            fields = json.loads(self._file.readline())
            segment = scene.segment(scene.times.index(fields["start"]))
            frames = []
            for time, before, count in fields.pop("frames"):
                vertices = np.frombuffer(self._file.read(8 * count), np.int64)
                x = np.frombuffer(self._file.read(24 * count), np.float64).reshape(-1, 3)
                frames.append(MovedFrame(time, before, segment, vertices, x))
            values = {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
            yield RepairedStretch(frames=tuple(frames), **values)

    def close(self, *, remove: bool) -> None:
        """Closes the file, and removes it if there is nothing to resume."""
        if self._file:
            self._file.close()
            if remove:
                self.path.unlink(missing_ok=True)

    def _open(self) -> None:
        """Reads the facts and the findings of an earlier run, and where its stretches are."""
        self._file = open(self.path, "r+b")  # noqa: SIM115 (closed by close)
        try:
            head = json.loads(self._file.readline())
            if head["format"] != _FORMAT:
                raise ValueError
            facts, findings = head["facts"], json.loads(self._file.readline())
        except (ValueError, KeyError, TypeError):
            self._file.close()
            raise ValueError(f"{self.path}: not a resumable repair of this version") from None
        for fact in self._facts:
            if facts.get(fact) != self._facts[fact]:
                self._file.close()
                difference = describe_difference(fact, facts, self._facts)
                raise ValueError(f"{self.path}: written with other options or files; cannot resume: {difference}")
        self.findings = [_as_finding(fields) for fields in findings]
        size = self._file.seek(0, os.SEEK_END)
        self._file.seek(0)
        self._file.readline()
        self._file.readline()
        while (place := self._file.tell()) < size:
            line = self._file.readline()
            end = size + 1
            if line.endswith(b"\n"):
                end = self._file.tell() + sum(32 * count for *_, count in json.loads(line)["frames"])
            if end > size:  # cut by the end of the process
                self._file.truncate(place)
                return
            self._places.append(place)
            self._file.seek(end)

    def _write(self, parts: list[bytes]) -> None:
        """Appends bytes, and waits until they are on the disk."""
        assert self._file
        for part in parts:
            self._file.write(part)
        self._file.flush()
        os.fsync(self._file.fileno())


def _line(value: Any) -> bytes:
    return json.dumps(value).encode() + b"\n"


def _as_finding(fields: dict[str, Any]) -> Finding:
    """Returns a finding from its fields in JSON."""
    low, high = fields["crossings"]
    pairs = tuple((first, second) for first, second in fields["crossing_meshes"])
    return Finding(**fields | {"crossings": (low, high), "crossing_meshes": pairs})
