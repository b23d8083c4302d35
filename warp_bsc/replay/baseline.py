"""What an earlier replay of a scene has found, and what is new since."""

import os
from collections import defaultdict

import orjson

from .summary import Summary

__all__ = ["Baseline"]


class Baseline:
    """The times at which meshes collided and intersected in an earlier replay."""

    def __init__(self, path: str | os.PathLike):
        """Reads the JSON file of an earlier replay.

        Args:
            path: The file.

        Raises:
            OSError: If it cannot be read.
            ValueError: If it is not such a file.
        """
        self._spans: dict[str, defaultdict[tuple[str, ...], list[tuple[float, float]]]] = {}
        try:
            sums = _read_sums(path)
            for name in ("collision_spans", "intersections"):
                spans = self._spans[name] = defaultdict(list)
                for span in sums[name]:
                    if span.get("crossings") == 0:  # it only touches
                        continue
                    spans[tuple(sorted(span["meshes"]))].append((span["since"], span["until"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a JSON file of this version's replay") from error

    def new_in(self, summary: Summary) -> list[tuple[tuple[str, str], float, float]]:
        """Returns which meshes collide or cross in a replay and did not in the earlier one at that time.

        Returns:
            Names of two meshes, the start and the end of an interval in which they collide, or one time twice at which
            they cross.
        """
        collisions, intersections = self._spans["collision_spans"], self._spans["intersections"]
        new = [
            (meshes, interval.start, interval.end)
            for interval in summary.intervals
            for meshes in interval.mesh_pairs
            if not any(
                since < interval.end and interval.start < until for since, until in collisions[tuple(sorted(meshes))]
            )
        ]
        new += [
            (meshes, sample.time, sample.time)
            for sample in summary.intersections
            for meshes, (crossings, _) in sample.mesh_pairs.items()
            if crossings
            and not any(since <= sample.time <= until for since, until in intersections[tuple(sorted(meshes))])
        ]
        return new


def _read_sums(path) -> dict:
    """Returns the members after the intervals. The file that a replay writes has them in its last line."""
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        length = 1 << 16
        while True:
            file.seek(max(0, size - length))
            lines = file.read().rstrip().splitlines()
            if len(lines) > 1 or length >= size:
                break
            length *= 2
        if lines and lines[-1].startswith(b'"complete":'):
            return orjson.loads(b"{" + lines[-1])
        file.seek(0)  # another program has written the same content
        return orjson.loads(file.read())
