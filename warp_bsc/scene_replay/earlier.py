"""Reads the results of a stopped replay from its JSON file, so that a later replay can resume it."""

import json
import os
from collections.abc import Collection, Iterator
from typing import Any

from .._atomic_file import unfinished_path
from ..usd.scene import Scene
from .hit_records import is_interval_line, is_tail_line, needs_following, read_head, read_interval, read_result
from .results import IntervalResult
from .threads import read_ahead


def find_earlier(path: str | os.PathLike, facts: dict[str, Any]) -> "EarlierReplay | None":
    """Returns the earlier replay with the most intervals that has written, or was to write, a JSON file; None for none.

    A killed replay has left its intervals at :func:`~warp_bsc._atomic_file.unfinished_path`. Arguments and errors are
    those of :class:`EarlierReplay`; a ValueError is raised if there are files but no replay that can be resumed.
    """
    found, errors = [], []
    for file in filter(os.path.exists, (unfinished_path(path), path)):
        try:
            found.append(EarlierReplay(file, facts))
        except ValueError as error:
            errors.append(error)
    if errors and not found:
        raise errors[0]
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
            facts: Facts of the replay that resumes it, see :func:`~warp_bsc.scene_replay.hit_files.replay_facts`.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not a replay's file, or was written with other options or for other files.
        """
        self._file = open(path, "rb")  # noqa: SIM115 (closed by close)
        self._may_be_torn = str(path).endswith(".part")
        try:
            earlier_facts = read_head(self._file.readline())
        except ValueError:
            self._file.close()
            raise ValueError(f"{path}: not a resumable replay of this version") from None
        own_facts = json.loads(json.dumps(facts))
        self._names = own_facts["meshes"]
        if difference := find_difference(earlier_facts, own_facts, {"device"}):
            self._file.close()
            raise ValueError(f"{path}: written with other options or files; cannot resume: {difference}")
        start = self._file.tell()
        self.count = sum(map(is_interval_line, self._file))
        self._file.seek(start)

    def results(self, scene: Scene) -> Iterator[IntervalResult]:
        """Yields the results of its intervals, in order, as if they had just been found.

        Positions are read from the scene. The last interval of the file is omitted if the file does not contain the
        intersections at its end, or the replay was killed while it wrote that interval.

        Args:
            scene: The scene, before any interval is read.

        Raises:
            ValueError: If the scene is broken, or the file is damaged.
        """
        intervals = self._intervals()
        fields = next(intervals, None)
        for interval in read_ahead(scene):
            following = next(intervals, None)
            if fields is None or (following is None and needs_following(fields)):
                return
            yield read_result(interval, fields, following, self._names)
            fields = following

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _intervals(self) -> Iterator[dict[str, Any]]:
        """Yields the fields of each interval."""
        for line in self._file:
            if is_tail_line(line):
                return
            try:
                fields = read_interval(line)
            except ValueError:
                if self._may_be_torn:
                    return
                raise
            yield fields


def find_difference(earlier: dict[str, Any], now: dict[str, Any], without: Collection[str] = ()) -> str:
    """Returns in words the first fact that two runs differ in, but for some facts; empty if they are the same."""
    fact = next((fact for fact in now if fact not in without and earlier.get(fact) != now[fact]), None)
    if fact is None:
        return ""
    before, after = earlier.get(fact), now[fact]
    if isinstance(before, dict) and isinstance(after, dict):
        name = next(name for name in after if before.get(name) != after[name])
        return f"{name} was {before.get(name)}, and is {after[name]}"
    if fact == "files":
        return "the scene's files have changed"
    if fact in ("meshes", "prims"):
        return "the scene has other meshes, or another version wrote the file"
    return f"{fact} was {before}, and is {after}"
