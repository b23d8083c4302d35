"""Mesh files by frame: what patterns of names stand for, and where the files of each frame are written to."""

import fnmatch
import glob
import os
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

PATTERNS = "#*?["
"""Characters of names that stand for several files: # for a digit of the number of the frame, others as in a shell."""


class Frames(NamedTuple):
    """The files of one or several frames.

    Attributes:
        names: The files or patterns, as they were given.
        numbers: Numbers of the frames, ascending; 0 alone without a pattern.
        paths: For each frame, the file of each name.
    """

    names: list[str]
    numbers: list[int]
    paths: list[list[str]]

    @property
    def are_several(self) -> list[bool]:
        """Whether each name stands for another file at each frame."""
        return [len(self.numbers) > 1 and len(set(paths)) > 1 for paths in zip(*self.paths, strict=True)]

    def matching(self, patterns: Iterable[str], option: str) -> list[bool]:
        """Returns whether each name matches one of some patterns.

        Raises:
            ValueError: If a pattern matches no name; ``option`` is where it was given.
        """
        found = [False] * len(self.names)
        for pattern in patterns:
            matching = [name == pattern or fnmatch.fnmatchcase(name, pattern) for name in self.names]
            if not any(matching):
                raise ValueError(f"{option}: no file matches {pattern}")
            found = [a or b for a, b in zip(found, matching, strict=True)]
        return found

    def outputs(self, keep: Iterable[str], output: str, read: Iterable[str] = ()) -> list[list[str | None]]:
        """Returns where each file is written to, None for those that are not.

        Args:
            keep: Patterns of names that are not written. One file for several frames is not written either.
            output: A folder, which need not exist if it ends in a slash, a file, or a name with # for the digits of the
                frame.
            read: Other files that are read.

        Raises:
            ValueError: If a pattern matches no name, or files would be written to one place, over one that is read, or
                in another format.
        """
        kept = [len(self.numbers) > 1 and not several for several in self.are_several]
        kept = [a or b for a, b in zip(kept, self.matching(keep, "--keep"), strict=True)]
        into = _is_folder(output) or os.path.isdir(output)
        if kept.count(False) != 1 and not into:
            raise ValueError(f"{output}: must be a folder, as not one file may move; --keep names obstacles")
        if len(self.numbers) > 1 and not into and "#" not in os.path.basename(output):
            raise ValueError(f"{output}: must be a folder, or have # in place of the digits of the frame")

        def written(path: str, number: int) -> str:
            if into:
                return os.path.join(output, os.path.basename(path))
            return re.sub("#+", lambda run: f"{number:0{len(run[0])}}", output) if len(self.numbers) > 1 else output

        found = [
            [None if is_kept else written(path, number) for path, is_kept in zip(paths, kept, strict=True)]
            for number, paths in zip(self.numbers, self.paths, strict=True)
        ]
        taken = {os.path.realpath(path) for paths in (*self.paths, read) for path in paths}
        for paths, outputs in zip(self.paths, found, strict=True):
            for path, to in zip(paths, outputs, strict=True):
                if to is None:
                    continue
                if os.path.realpath(to) in taken:
                    raise ValueError(f"{to}: named twice, or read; write to another file")
                taken.add(os.path.realpath(to))
                if os.path.splitext(to)[1].lower() != os.path.splitext(path)[1].lower():
                    raise ValueError(f"{to}: must end as {path} does, of which only coordinates are replaced")
        return found


def make_folder(output: str) -> None:
    """Makes the folder that an output is if it ends in a slash.

    Raises:
        OSError: If that fails.
    """
    if _is_folder(output):
        os.makedirs(output, exist_ok=True)


def find_frames(names: Sequence[str]) -> Frames:
    """Returns the files that names stand for; a name without a pattern stands for one file at all frames.

    The number of a frame is what # stand for, else the last number in the name of a file.

    Raises:
        FileNotFoundError: If no file matches a pattern.
        ValueError: If a file has no number, or one that another one has, or a pattern lacks a frame of another one.
    """
    are_patterns = [not os.path.exists(name) and any(character in name for character in PATTERNS) for name in names]
    found = [(name, _numbered(name) if is_one else {}) for name, is_one in zip(names, are_patterns, strict=True)]
    numbers = sorted({number for _, files in found for number in files}) or [0]
    for name, files in found:
        if missing := [number for number in numbers if files and number not in files]:
            raise ValueError(f"{name}: there is no file for frame {missing[0]}")
    return Frames(list(names), numbers, [[files.get(number, name) for name, files in found] for number in numbers])


def _is_folder(output: str) -> bool:
    return output.endswith(("/", os.sep))


def _numbered(pattern: str) -> dict[int, str]:
    """Returns the files that match a pattern, by their numbers."""
    form = re.sub(r"(?:\\#)+", lambda run: f"([0-9]{{{len(run[0]) // 2},}})", fnmatch.translate(pattern))
    found: dict[int, str] = {}
    for path in sorted(glob.glob(re.sub("#+", "*", pattern))):
        match = re.match(form, path)
        digits = list(match.groups()[:1]) if match else []
        if match and not digits:
            digits = re.findall("[0-9]+", os.path.splitext(os.path.basename(path))[0])[-1:]
            if not digits:
                raise ValueError(f"{path}: its name has no number of a frame")
        for number in map(int, digits):
            if found.setdefault(number, path) != path:
                raise ValueError(f"{path}: has the number of {found[number]}")
    if not found:
        raise FileNotFoundError(f"{pattern}: no file matches")
    return found
