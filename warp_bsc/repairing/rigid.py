"""Groups of vertices that move as a whole, such as buttons and buckles: each keeps its shape of the input."""

import numpy as np

_SLIGHT = 0.01
"""Weight of all vertices of a group that are not pushed, as a share of that of those that are."""
_ROUNDINGS = 8.0
"""Distance from a rigid motion, in roundings of the coordinates of a group, up to which its positions stay."""


class RigidGroups:
    """Groups of vertices of a surface.

    Attributes:
        of: Group of each vertex, -1 for none, int, shape [n].
        vertices: The vertices of groups, int, shape [m].
        links: Pairs of vertices that connect each group, int, shape [k, 2].
    """

    def __init__(self, of: np.ndarray):
        """Finds the vertices of each group, given the group of each vertex."""
        self.of, self.vertices = of, np.flatnonzero(of >= 0)
        _, first, group = np.unique(of[self.vertices], return_index=True, return_inverse=True)
        self._group, self._count = group.reshape(-1), len(first)
        links = np.stack([self.vertices[first][self._group], self.vertices], axis=1)
        self.links = links[links[:, 0] != links[:, 1]]

    def placed(self, x: np.ndarray, home: np.ndarray, rounding: np.ndarray) -> np.ndarray:
        """Returns positions at which each group is rotated and moved as a whole from the input, nearest to given ones.

        Those of groups that are rigid up to rounding stay; ``rounding`` is the error of each coordinate of vertices of
        groups, shape [m, 3].
        """
        fitted = self.fitted(x, home, np.ones(len(self.vertices)))
        off, allowed = np.zeros(self._count), np.zeros(self._count)
        np.maximum.at(off, self._group, np.abs(fitted - x[self.vertices]).max(axis=1))
        np.maximum.at(allowed, self._group, _ROUNDINGS * rounding.max(axis=1))
        return self._with(x, fitted, off > allowed)

    def carried(self, x: np.ndarray, home: np.ndarray, pushed: np.ndarray) -> np.ndarray:
        """Returns positions at which groups follow those of their vertices that are pushed, and else move least."""
        leads = pushed[self.vertices]
        share = np.bincount(self._group, leads, self._count) / np.bincount(self._group)
        weights = np.where(leads, 1.0, _SLIGHT * share[self._group])
        return self._with(x, self.fitted(x, home, weights), share > 0.0)

    def least(self, values: np.ndarray) -> np.ndarray:
        """Returns values of vertices, shape [n], with the least one of each group for all of its vertices."""
        least = np.full(self._count, np.inf)
        np.minimum.at(least, self._group, values[self.vertices])
        values = values.copy()
        values[self.vertices] = least[self._group]
        return values

    def _with(self, x: np.ndarray, fitted: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Returns positions with those that are fitted, shape [m, 3], of some of the groups, bool."""
        rows, result = which[self._group], x.copy()
        result[self.vertices[rows]] = fitted[rows]
        return result

    def fitted(self, x: np.ndarray, home: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Returns the positions of groups after the rotation and move that weighted squares are least with (Kabsch)."""
        group, count = self._group, self._count
        total = np.maximum(np.bincount(group, weights, count), 1e-300)

        def means(values):
            return np.stack([np.bincount(group, weights * v, count) / total for v in values.T], axis=1)

        before, after = home[self.vertices], x[self.vertices]
        middle = means(after)
        before = before - means(before)[group]
        products = (before[:, :, None] * (after - middle[group])[:, None, :]).reshape(-1, 9)
        u, _, vt = np.linalg.svd(means(products).reshape(-1, 3, 3))
        u[:, :, 2] *= np.where(np.linalg.det(u @ vt) < 0.0, -1.0, 1.0)[:, None]  # no reflection
        return middle[group] + np.einsum("ij,ijk->ik", before, (u @ vt)[group])
