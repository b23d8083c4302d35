"""The progress of a repair in a file, from which a later run can resume it after it was stopped or killed."""

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ...scene_replay.earlier import find_difference
from ...usd.scene import Scene
from ...usd.write.points_layer import MovedFrame
from .findings import Finding
from .stretch import RepairedStretch

_FORMAT = "warp-bsc repair 3"


class Journal:
    """A file with the facts of a run, its findings, and the stretches that are repaired, one after the other.

    A stretch is a line of JSON, and after it the bytes of its frames: the moved vertices, int64, and their positions,
    float64. What was not written whole, as the process was killed, is not read.

    Attributes:
        findings: What was found in each interval; None if that is not known yet.
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
    def is_open(self) -> bool:
        """Whether there is a file: :meth:`begin` or a resumed run has opened it, and it is not closed."""
        return self._file is not None and not self._file.closed

    def begin(self, findings: list[Finding]) -> None:
        """Writes the file with the findings and no stretch.

        Raises:
            OSError: If that fails.
        """
        self.findings = findings
        self._file = open(self.path, "w+b", buffering=0)  # noqa: SIM115 (closed by close)
        self._write([_line({"format": _FORMAT, "facts": self._facts}), _line([asdict(found) for found in findings])])

    def add(self, stretch: RepairedStretch) -> None:
        """Appends a stretch.

        Raises:
            OSError: If that fails. The file can then only be closed.
        """
        assert self._file
        frames = [(frame.time, frame.before, len(frame.vertices)) for frame in stretch.frames]
        parts = [_line(asdict(replace(stretch, frames=())) | {"frames": frames})]
        for frame in stretch.frames:
            parts += [np.asarray(frame.vertices, np.int64).tobytes(), np.asarray(frame.x, np.float64).tobytes()]
        self._file.seek(0, os.SEEK_END)
        place = self._file.tell()
        self._write(parts)
        self._places.append(place)

    def stretches(self, scene: Scene) -> Iterator[RepairedStretch]:
        """Yields the stretches, in order."""
        if not self._places:
            return
        with open(self.path, "rb") as file:
            for place in self._places:
                file.seek(place)
                yield self._read(file, scene)

    def _read(self, file: BinaryIO, scene: Scene) -> RepairedStretch:
        """Returns the stretch that begins where a file is."""
        fields = json.loads(file.readline())
        segment = scene.segment(scene.times.index(fields["start"]))
        frames = []
        for time, before, count in fields.pop("frames"):
            vertices = np.frombuffer(file.read(8 * count), np.int64)
            x = np.frombuffer(file.read(24 * count), np.float64).reshape(-1, 3)
            frames.append(MovedFrame(time, before, segment, vertices, x))
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
        return RepairedStretch(frames=tuple(frames), **values)

    def close(self, *, remove: bool) -> None:
        """Closes the file, and removes it if there is nothing to resume."""
        if self._file:
            self._file.close()
            if remove:
                self.path.unlink(missing_ok=True)

    def _open(self) -> None:
        """Reads the facts and the findings of an earlier run, and where its stretches are."""
        with open(self.path, "rb") as file:
            try:
                head = json.loads(file.readline())
                if head["format"] != _FORMAT:
                    raise ValueError
                facts, findings = head["facts"], json.loads(file.readline())
            except (ValueError, KeyError, TypeError):
                raise ValueError(f"{self.path}: not a resumable repair of this version") from None
            if difference := find_difference(facts, self._facts):
                raise ValueError(f"{self.path}: written with other options or files; cannot resume: {difference}")
            self.findings = [_as_finding(fields) for fields in findings]
            end = file.tell()
            size = file.seek(0, os.SEEK_END)
            while end < size:
                file.seek(end)
                line = file.readline()
                if not line.endswith(b"\n"):
                    break
                stop = file.tell() + sum(32 * count for *_, count in json.loads(line)["frames"])
                if stop > size:
                    break
                self._places.append(end)
                end = stop
        self._file = open(self.path, "r+b", buffering=0)  # noqa: SIM115 (closed by close)
        self._file.truncate(end)  # the rest was cut by the end of the process

    def _write(self, parts: list[bytes]) -> None:
        """Appends bytes, and waits until they are on the disk."""
        assert self._file
        rest = memoryview(b"".join(parts))
        while rest:
            rest = rest[self._file.write(rest) :]
        os.fsync(self._file.fileno())


def _line(value: Any) -> bytes:
    return json.dumps(value).encode() + b"\n"


def _as_finding(fields: dict[str, Any]) -> Finding:
    """Returns a finding from its fields in JSON."""
    pairs = {name: tuple(map(tuple, fields[name])) for name in ("crossing_meshes", "unrepaired_pairs", "ignored_pairs")}
    values: dict[str, Any] = fields | pairs | {"crossings": tuple(fields["crossings"])}
    return Finding(**values)
