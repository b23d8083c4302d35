"""The turns of meshes that only their transforms move: at a constant rate about one axis, from one time to the next.

A turn is found from the transforms that the stage itself has at six times between the two, so that it makes no
difference which operations, parents, pivots or instancers move the mesh, nor how many times it turns. Between samples
OpenUSD interpolates the angles of rotations and the quaternions of orientations, so that they turn at a constant rate;
matrices move points straight, and have no turn.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

BETWEEN = 0.382
"""Where between two times a transform is first tested for a bend; halfway, two whole turns look like none."""
_COUNTED = [2.0**-10, 2.0**-5, 1.0]
"""Where turns are counted: at the first a turn must be less than a half, 512 turns in all, so that its direction is
known; each angle tells the next up to rounding, and so how many whole turns that has."""
_OTHERS = [0.146, 0.618, 0.854]
"""Where else the stage's transforms must be those of the turn; so many turns that they would be miscounted are not."""
_FIT, _ROUNDED, _NEARER = 1e-5, 7e-4, 0.2
"""Largest difference from the turn, as a share of the distance from its axis: USD interpolates in single precision. It
takes angles of orientations from cosines, which near none rounds so much; then straight paths must be that far off."""
_SINGLE = 1e-6
"""Rounding of coordinates in single precision, and of transforms that are straight."""
_SMALL = 1e-9
_LARGEST_CONDITION = 1e6
"""Of transforms that are inverted."""


@dataclass(frozen=True)
class Turn:
    """The turn of a mesh from one time to the next.

    Attributes:
        centre: A point of its axis at the first time, in world space and the scene's unit of length, which moves
            straight; shape [3].
        vector: Unit vector of the axis times the angle [rad], any number of turns, shape [3].
    """

    centre: np.ndarray
    vector: np.ndarray

    def is_like(self, other: "Turn", size: float) -> bool:
        """Returns whether another turn is the same about the same axis, up to rounding at coordinates of a size."""
        angle = np.linalg.norm(self.vector)
        off = other.centre - self.centre
        off = off - (off @ self.vector) * self.vector / angle**2
        return bool(
            np.abs(other.vector - self.vector).max() <= _SMALL * (1.0 + angle) and np.abs(off).max() <= _SINGLE * size
        )


@np.errstate(over="ignore", invalid="ignore")
def find_turns(
    transforms: Callable[[int, float], np.ndarray | None], numbers: list[int]
) -> tuple[dict[int, Turn], list[int]]:
    """Returns the turns of meshes at a constant rate about one axis, by their numbers; and which bend without one.

    Args:
        transforms: Returns the matrix that transforms points of a mesh, as rows, to world space, shape [4, 4]; None or
            not finite if there is none. Arguments are the mesh's number and the time, 0 at the first time and 1 just
            before the second.
        numbers: Numbers of the meshes.
    """

    def read(share: float, numbers: list[int]) -> np.ndarray:
        """Returns matrices at one time, NaN for none: instancers keep those of the last time."""
        found = [transforms(number, share) for number in numbers]
        return np.array([np.full((4, 4), np.nan) if matrix is None else matrix for matrix in found]).reshape(-1, 4, 4)

    ends = [read(share, numbers) for share in (0.0, 1.0, BETWEEN)]
    curved = are_bent(*ends) & np.isfinite(np.stack(ends)).all(axis=(0, 2, 3))
    invertible = np.where(curved[:, None, None], ends[0][:, :3, :3], np.eye(3))
    bent = curved & (np.linalg.cond(invertible) < _LARGEST_CONDITION)
    all_curved, some = ([numbers[i] for i in np.flatnonzero(which)] for which in (curved, bent))
    if not some:
        return {}, all_curved
    shares = [0.0, 1.0, BETWEEN, *_COUNTED[:-1], *_OTHERS]
    matrices = [end[bent] for end in ends] + [read(share, some) for share in shares[len(ends) :]]
    centres, vectors, fit = _fit_turns(np.array(shares), np.stack(matrices, axis=1))
    rows = zip(some, centres, vectors, fit.tolist(), strict=True)
    turns = {number: Turn(centre, vector) for number, centre, vector, fits in rows if fits}
    return turns, [number for number in all_curved if number not in turns]


def are_bent(start: np.ndarray, end: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Returns which transforms, at :data:`BETWEEN` of two others, move points off the straight paths, bool."""
    off = np.abs(between - start - BETWEEN * (end - start))
    size = np.maximum(np.abs(start), np.abs(end))
    parts = [
        off[:, rows].max(axis=(1, 2)) > _SINGLE * size[:, rows].max(axis=(1, 2)) for rows in (slice(3), slice(3, 4))
    ]
    return parts[0] | parts[1]


def _fit_turns(shares: np.ndarray, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the turns of meshes: centres and vectors, each of shape [n, 3], and whether they fit, bool, shape [n].

    ``matrices`` are their transforms, shape [n, k, 4, 4], at ``shares``, those of :data:`_COUNTED` among them, shape
    [k]; the first two are 0 and 1.
    """
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2, 3)))
    matrices = np.where(finite[:, None, None, None], matrices, np.eye(4))
    inverse = np.linalg.inv(matrices[:, :1, :3, :3])
    rotations = np.swapaxes(inverse @ matrices[:, :, :3, :3], 2, 3)  # of columns
    vectors = _rotation_vectors(shares, rotations)
    modelled = _rotations(shares[:, None] * vectors[:, None])
    angles = np.linalg.norm(vectors, axis=1)
    share = shares[:, None]
    bends = modelled - share[..., None] * modelled[:, 1:2] - (1.0 - share[..., None]) * np.eye(3)
    off = np.minimum(_ROUNDED, _NEARER * np.abs(bends).max(axis=(1, 2, 3)))
    relative = np.maximum(_FIT * (1.0 + 0.01 * angles), off)  # angles in degrees are rounded in proportion
    fit = finite & (angles > 0.0) & (np.abs(rotations - modelled).max(axis=(1, 2, 3)) <= relative)
    # origin(t) = (1 - t) origin(0) + t origin(1) + bend(t) (origin(0) - centre)
    origins = matrices[:, :, 3, :3]
    deviations = origins - (1.0 - share) * origins[:, :1] - share * origins[:, 1:2]
    n = len(matrices)
    factors, deviations = bends.reshape(n, -1, 3), deviations.reshape(n, -1, 1)
    levers = np.linalg.pinv(factors, rcond=1e-9) @ deviations
    allowed = relative * np.linalg.norm(levers[..., 0], axis=1) + _SINGLE * np.abs(origins).max(axis=(1, 2))
    fit &= np.abs(factors @ levers - deviations).max(axis=(1, 2)) <= allowed
    return origins[:, 0] - levers[..., 0], vectors, fit


def _rotation_vectors(shares: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Returns the axis times the angle of whole rotations, 0 without an axis, from rotations after shares of them."""
    r = rotations
    skews = [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]]
    skews = 0.5 * np.stack(skews, axis=-1)
    sines = np.linalg.norm(skews, axis=2)
    rows = np.arange(len(r))
    best = sines.argmax(axis=1)
    axes = skews[rows, best] / np.maximum(sines[rows, best], _SMALL)[:, None]
    angles, before = np.zeros(len(r)), 1.0
    for share in _COUNTED:
        at = int(np.flatnonzero(shares == share)[0])
        cosines = 0.5 * (np.trace(r[:, at], axis1=1, axis2=2) - 1.0)
        measured = np.arctan2(np.einsum("ni,ni->n", skews[:, at], axes), cosines)
        whole = np.round((share / before * angles - measured) / (2.0 * np.pi))
        angles, before = measured + 2.0 * np.pi * whole, share
    return np.where((sines[rows, best] > _SMALL)[:, None], angles[:, None] * axes, 0.0)


def _rotations(vectors: np.ndarray) -> np.ndarray:
    """Returns the matrices that rotate columns by rotation vectors [rad], shape [..., 3, 3]."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors / np.where(angle[..., 0] == 0.0, 1.0, angle[..., 0]), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    return np.eye(3) + np.sin(angle) * cross + 2.0 * np.sin(0.5 * angle) ** 2 * (cross @ cross)
