"""Which meshes of a scene are checked, and which pairs of them."""

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

__all__ = ["PURPOSES", "Selection"]

PURPOSES = ("default", "render", "proxy", "guide")
"""The purposes that USD knows."""


@dataclass(frozen=True)
class Selection:
    """Which meshes of a scene are checked, and which pairs of them.

    Patterns are those of a shell, ``*`` standing for any part of a path. A pattern stands for the prims that it
    matches and for all below them. Meshes are known by their paths, and those that point instancers place by their
    names too, such as ``"/World/Leaves[3]/Leaf"``. What has both is given as an object with ``path`` and ``name``.

    Attributes:
        prims: Patterns of the meshes that are checked; all, if there is none.
        exclude: Patterns of meshes that are not.
        self_collisions: Whether a mesh is checked with itself.
        between: Two patterns: only pairs of a mesh of the first and a mesh of the second are checked.
        purposes: Purposes of the meshes that are checked.
    """

    prims: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    self_collisions: bool = True
    between: tuple[str, str] | None = None
    purposes: tuple[str, ...] = ("default", "render")

    def includes(self, mesh) -> bool:
        """Whether a mesh is checked at all, its purpose aside."""
        return (
            (not self.prims or any(_matches(mesh, pattern) for pattern in self.prims))
            and not any(_matches(mesh, pattern) for pattern in self.exclude)
            and (self.between is None or any(_matches(mesh, pattern) for pattern in self.between))
        )

    def check_patterns(self, meshes):
        """See to it that every pattern matches one of all meshes.

        Raises:
            ValueError: If one does not.
        """
        named = {"--prims": self.prims, "--exclude": self.exclude, "--between": self.between or ()}
        for option, patterns in named.items():
            for pattern in patterns:
                if not any(_matches(mesh, pattern) for mesh in meshes):
                    raise ValueError(f"{option} {pattern}: there is no such mesh")

    def counted_pairs(self, meshes, pairs: np.ndarray) -> np.ndarray:
        """Which pairs of meshes are checked.

        Args:
            meshes: The meshes.
            pairs: Indices of meshes, shape [n, 2].

        Returns:
            Booleans, shape [n].
        """
        counted = np.ones(len(pairs), dtype=bool)
        if not self.self_collisions:
            counted &= pairs[:, 0] != pairs[:, 1]
        if self.between:
            first, second = (np.array([_matches(mesh, pattern) for mesh in meshes]) for pattern in self.between)
            a, b = pairs.T
            counted &= (first[a] & second[b]) | (first[b] & second[a])
        return counted


def _matches(mesh, pattern):
    # No prim's path has brackets: a number in such is that of an instance, or else one of some digits.
    instances = re.sub(r"\[(\d+)\]", r"[[]\1]", pattern)
    return any(
        fnmatchcase(text, form) or fnmatchcase(text, form.rstrip("/") + "/*")
        for form in {pattern, instances}
        for text in {mesh.path, mesh.name}
    )
