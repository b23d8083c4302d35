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

    def unmatched(self, meshes: Sequence[NamedMesh]) -> list[tuple[str, str]]:
        """Returns the pairs to ignore with a pattern that matches no mesh, given all meshes."""
        return [pair for pair in self.ignore if not all(any(_matches(m, pattern) for m in meshes) for pattern in pair)]

    def ignored_pairs(self, meshes: Sequence[NamedMesh], pairs: np.ndarray) -> np.ndarray:
        """Returns whether each pair of meshes is ignored; arguments and result as of :meth:`counted_pairs`."""
        ignored = np.zeros(len(pairs), dtype=bool)
        if not (self.ignore or self.ignored_names) or not len(pairs):
            return ignored
        used, rows = np.unique(pairs, return_inverse=True)
        a, b = rows.reshape(-1, 2).T
        for patterns in self.ignore:
            first, second = (np.array([_matches(meshes[mesh], pattern) for mesh in used]) for pattern in patterns)
            ignored |= (first[a] & second[b]) | (first[b] & second[a])
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
            first, second = (np.array([_matches(mesh, pattern) for mesh in meshes]) for pattern in self.between)
            a, b = pairs.T
            counted &= (first[a] & second[b]) | (first[b] & second[a])
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


def _matches(mesh, pattern) -> bool:
    # Paths of prims contain no brackets: [12] is instance 12 and, as in a shell, one of the digits 1 and 2.
    instances = re.sub(r"\[(\d+)\]", r"[[]\1]", pattern)
    return any(
        fnmatchcase(text, form) or fnmatchcase(text, form.rstrip("/") + "/*")
        for form in {pattern, instances}
        for text in {mesh.path, mesh.name}
    )
