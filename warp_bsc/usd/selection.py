"""Selects the meshes of a scene, and the pairs of them, that are checked."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Literal, Protocol, get_args

import numpy as np

from .._arguments import checked_choice, checked_flag, checked_strings, given

Purpose = Literal["default", "render", "proxy", "guide"]
"""A purpose of prims in USD."""

PURPOSES: tuple[str, ...] = get_args(Purpose)
"""All purposes."""


class NamedMesh(Protocol):
    """A mesh that patterns are matched with: the path of its prim, and its name with the number of its instance."""

    @property
    def path(self) -> str: ...  # noqa: D102

    @property
    def name(self) -> str: ...  # noqa: D102


@dataclass(frozen=True)
class Meant:
    """Meshes that are meant to meet, as an entry of a triage file says.

    Attributes:
        meshes: Patterns of two meshes, which are meant to meet each other, or of one, which may meet all others.
        reason: Why, in words.
        who: Who has said so.
        date: When, such as "2026-11-29".
    """

    meshes: tuple[str, ...]
    reason: str
    who: str
    date: str

    def __str__(self) -> str:
        """Returns the reason, and who has given it when."""
        return f"{self.reason} ({self.who}, {self.date})"


@dataclass(frozen=True)
class Selection:
    """Selects the meshes of a scene, and the pairs of them, that are checked.

    Patterns are those of a shell: ``*`` matches any part of a path. A pattern selects the prims that it matches and all
    prims below them. It is matched with the paths of meshes, and with the names of meshes in instances, for example
    ``"/World/Leaves[3]/Leaf"``.

    Attributes:
        prims: Patterns of the meshes that are checked; all if there is no pattern.
        exclude: Patterns of the meshes that are excluded.
        self_collisions: Whether a mesh is checked with itself.
        between: Two patterns: only pairs of a mesh of the first and a mesh of the second are checked.
        purposes: Purposes of the meshes that are checked.
        ignore: Pairs of patterns: collisions of a mesh of the first and a mesh of the second are only counted.
        triage: Meshes that are meant to meet, which are ignored in the same way, as
            :func:`warp_bsc.read_triage` returns them.
        ignored_names: Pairs of names of meshes that are ignored in the same way, each pair sorted.
        ignored_inside: Pairs of names of a mesh and another one that it may be inside.

    Raises:
        TypeError: If an argument has another type; a single string is not a sequence of patterns.
        ValueError: If a pair does not have two entries, or a purpose is unknown.
    """

    prims: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    self_collisions: bool = True
    between: tuple[str, str] | None = None
    purposes: tuple[Purpose, ...] = ("default", "render")
    ignore: tuple[tuple[str, str], ...] = ()
    triage: tuple[Meant, ...] = ()
    ignored_names: frozenset[tuple[str, str]] = frozenset()
    ignored_inside: frozenset[tuple[str, str]] = frozenset()

    def __post_init__(self):
        """Checks the attributes, and converts them to tuples and sets."""
        checked: dict[str, object] = {}
        for name in ("prims", "exclude", "purposes"):
            checked[name] = checked_strings(getattr(self, name), name)
        for purpose in checked_strings(self.purposes, "purposes"):
            checked_choice(purpose, "purposes", PURPOSES)
        checked["self_collisions"] = checked_flag(self.self_collisions, "self_collisions")
        if self.between is not None:
            checked["between"] = _checked_pair(self.between, "between")
        checked["ignore"] = _checked_pairs(self.ignore, "ignore")
        if not isinstance(self.triage, tuple) or not all(isinstance(entry, Meant) for entry in self.triage):
            raise TypeError(f"triage must be a tuple of entries, as read_triage returns, not {given(self.triage)}")
        for name in ("ignored_names", "ignored_inside"):
            checked[name] = frozenset(_checked_pairs(getattr(self, name), name))
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def includes(self, mesh: NamedMesh) -> bool:
        """Returns whether the patterns select a mesh, regardless of its purpose."""
        return (
            (not self.prims or any(_matches(mesh, pattern) for pattern in self.prims))
            and not any(_matches(mesh, pattern) for pattern in self.exclude)
            and (self.between is None or any(_matches(mesh, pattern) for pattern in self.between))
        )

    def check_patterns(self, meshes: Sequence[NamedMesh]) -> None:
        """Checks that every pattern matches a mesh, given all meshes.

        Raises:
            ValueError: If a pattern matches none.
        """
        for name in ("prims", "exclude", "between"):
            for pattern in getattr(self, name) or ():
                if not any(_matches(mesh, pattern) for mesh in meshes):
                    raise ValueError(f"{name}: no mesh matches {pattern}")

    @property
    def chooses_pairs(self) -> bool:
        """Whether some pairs of meshes may not be checked, or may be ignored."""
        return bool(self.between or self.ignore or self.triage or self.ignored_names or not self.self_collisions)

    def unmatched(self, meshes: Sequence[NamedMesh]) -> list[str]:
        """Returns what is to be ignored and has a pattern that matches no mesh, in words, given all meshes."""
        texts = []
        for name, entries in {"ignore": self.ignore, "triage": [entry.meshes for entry in self.triage]}.items():
            if bad := [
                entry for entry in entries if not all(any(_matches(m, pattern) for m in meshes) for pattern in entry)
            ]:
                texts.append(f"{name}: entries that match no meshes: {len(bad)}, the first is {' '.join(bad[0])}")
        return texts

    def meant(self, first: NamedMesh, second: NamedMesh) -> Meant | None:
        """Returns the first entry of the triage by which two meshes are meant to meet, None without one."""
        both, a, b = (first, second), np.array([0]), np.array([int(first.name != second.name)])
        return next((entry for entry in self.triage if _are_of(entry.meshes, both, a, b).any()), None)

    def ignored_pairs(self, meshes: Sequence[NamedMesh], pairs: np.ndarray) -> np.ndarray:
        """Returns whether each pair of meshes is ignored; arguments and result as of :meth:`counted_pairs`."""
        ignored = np.zeros(len(pairs), dtype=bool)
        if not (self.ignore or self.triage or self.ignored_names) or not len(pairs):
            return ignored
        used, rows = np.unique(pairs, return_inverse=True)
        a, b = rows.reshape(-1, 2).T
        for patterns in (*self.ignore, *(entry.meshes for entry in self.triage)):
            ignored |= _are_of(patterns, [meshes[mesh] for mesh in used], a, b)
        if self.ignored_names:
            keys, rows = np.unique(np.sort(pairs, axis=1) @ np.array([len(meshes), 1]), return_inverse=True)
            names = (sorted(meshes[number].name for number in divmod(key, len(meshes))) for key in keys.tolist())
            ignored |= np.array([tuple(pair) in self.ignored_names for pair in names])[rows]
        return ignored

    def may_be_inside(self, meshes: Sequence[NamedMesh], pairs: np.ndarray) -> np.ndarray:
        """Returns whether the first mesh of each pair may be inside the second; arguments of :meth:`counted_pairs`."""
        if not self.ignored_inside or not len(pairs):
            return np.zeros(len(pairs), dtype=bool)
        return np.array([(meshes[a].name, meshes[b].name) in self.ignored_inside for a, b in pairs.tolist()])

    def counted_pairs(self, meshes: Sequence[NamedMesh], pairs: np.ndarray) -> np.ndarray:
        """Returns whether each pair of meshes is checked, or would be if it were not ignored.

        Args:
            meshes: The meshes.
            pairs: Indices of meshes, shape [n, 2].

        Returns:
            Bool array of shape [n].
        """
        counted = np.ones(len(pairs), dtype=bool)
        if not self.self_collisions:
            counted &= pairs[:, 0] != pairs[:, 1]
        if self.between:
            counted &= _are_of(self.between, meshes, *pairs.T)
        return counted


def _checked_pair(values, name) -> tuple[str, str]:
    pair = checked_strings(values, name)
    if len(pair) != 2:
        raise ValueError(f"{name} must be pairs of two strings, not {given(pair)}")
    return pair[0], pair[1]


def _checked_pairs(values, name) -> tuple[tuple[str, str], ...]:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise TypeError(f"{name} must be pairs of strings, not {given(values)}")
    return tuple(_checked_pair(pair, name) for pair in values)


def _are_of(patterns: tuple[str, ...], meshes: Sequence[NamedMesh], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns which pairs are of a mesh of the first pattern and one of the second, bool, shape [n].

    With a single pattern they are of two meshes, at least one of which matches it. ``a`` and ``b`` are the indices of
    the meshes of the pairs, shape [n].
    """
    first, last = (np.array([_matches(mesh, pattern) for mesh in meshes]) for pattern in (patterns[0], patterns[-1]))
    if len(patterns) == 1:
        return (first[a] | first[b]) & (a != b)
    return (first[a] & last[b]) | (first[b] & last[a])


def _matches(mesh, pattern) -> bool:
    # Paths of prims contain no brackets: [12] is instance 12 and, as in a shell, one of the digits 1 and 2.
    instances = re.sub(r"\[(\d+)\]", r"[[]\1]", pattern)
    return any(
        fnmatchcase(text, form) or fnmatchcase(text, form.rstrip("/") + "/*")
        for form in {pattern, instances}
        for text in {mesh.path, mesh.name}
    )
