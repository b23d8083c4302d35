"""The turns of meshes that only their transforms move: at a constant rate about one axis, from one time to the next.

A turn is found from the transforms that the stage itself has at 16 times between the two, so that it makes no
difference which operations, parents, pivots or instancers move the mesh, nor how many times it turns. Between samples
OpenUSD interpolates the angles of rotations and the quaternions of orientations, so that they turn at a constant rate;
matrices move points straight, and have no turn.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["Turn", "find_turns"]

_FIRST = 0.382
"""Where between the two times a transform is first tested for a turn; halfway, two whole turns look like none."""
_HALVINGS = 10
"""At 2^-10 of the time a turn must be less than a half, so that its direction is known: 512 turns in all."""
_DOUBLED = [2.0**-n for n in range(_HALVINGS, 0, -1)]
_OTHERS = [0.146, 0.236, 0.618, 0.707, 0.854]
"""Where else the stage's transforms must be those of the turn."""
_FIT = 1e-5
"""Largest difference from the turn, as a share of the distance from its axis: USD interpolates in single precision."""
_SINGLE = 1e-6
"""Rounding of coordinates in single precision, and of transforms that are straight."""
_SMALL = 1e-9


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


def find_turns(transforms: Callable[[int, float], np.ndarray | None], numbers: list[int]) -> dict[int, Turn]:
    """Returns the turns of those meshes that turn at a constant rate about one axis, by their numbers.

    Args:
        transforms: Returns the matrix that transforms points of a mesh, as rows, to world space, shape [4, 4]; None or
            not finite if there is none. Arguments are the mesh's number and the time, 0 at the first time and 1 just
            before the second.
        numbers: Numbers of the meshes.
    """

    def read(share: float, numbers: list[int]) -> dict[int, np.ndarray]:
        # all meshes at one time before the next time, since instancers keep those of the last time
        found = {number: transforms(number, share) for number in numbers}
        return {number: value for number, value in found.items() if value is not None and np.isfinite(value).all()}

    ends = [read(share, numbers) for share in (0.0, 1.0, _FIRST)]
    bent = [number for number in numbers if all(number in end for end in ends) and not _is_straight(*_at(ends, number))]
    if not bent:
        return {}
    shares = sorted({*_DOUBLED, *_OTHERS})
    between = [read(share, bent) for share in shares]
    turns = {}
    for number in bent:
        if all(number in found for found in between):
            matrices = dict(zip([0.0, 1.0, _FIRST, *shares], _at([*ends, *between], number), strict=True))
            if turn := _turn_of(matrices):
                turns[number] = turn
    return turns


def _at(found: list[dict[int, np.ndarray]], number: int) -> list[np.ndarray]:
    return [matrices[number] for matrices in found]


def _is_straight(start: np.ndarray, end: np.ndarray, between: np.ndarray) -> bool:
    """Returns whether a transform between two others moves points on the straight paths from one to the other."""
    off = np.abs(between - start - _FIRST * (end - start))
    size = np.maximum(np.abs(start), np.abs(end))
    return all(off[rows].max() <= _SINGLE * size[rows].max() for rows in (slice(0, 3), slice(3, 4)))


def _turn_of(matrices: dict[float, np.ndarray]) -> Turn | None:
    """Returns the turn that has the given transforms, by the time; None if there is none."""
    start = matrices[0.0]
    if abs(np.linalg.det(start[:3, :3])) < 1e-30 or np.linalg.cond(start[:3, :3]) > 1e6:
        return None
    inverse = np.linalg.inv(start[:3, :3])
    rotations = {share: (inverse @ matrix[:3, :3]).T for share, matrix in matrices.items()}  # of columns
    vector = _rotation_vector(rotations)
    if vector is None:
        return None
    size = 1.0 + np.linalg.norm(vector) * 1e-2  # angles in degrees are rounded in proportion
    if any(np.abs(rotations[share] - _rotation(share * vector)).max() > _FIT * size for share in rotations):
        return None
    # origin(t) = (1 - t) origin(0) + t origin(1) + bend(t) (origin(0) - centre)
    origins = {share: matrix[3, :3] for share, matrix in matrices.items()}
    whole = _rotation(vector)
    bends = {share: _rotation(share * vector) - share * whole - (1.0 - share) * np.eye(3) for share in matrices}
    straight = {share: (1.0 - share) * origins[0.0] + share * origins[1.0] for share in matrices}
    factors = np.concatenate([bends[share] for share in matrices])
    deviations = np.concatenate([origins[share] - straight[share] for share in matrices])
    lever = np.linalg.lstsq(factors, deviations, rcond=1e-9)[0]
    allowed = _FIT * size * np.linalg.norm(lever) + _SINGLE * max(np.abs(origin).max() for origin in origins.values())
    if np.abs(factors @ lever - deviations).max() > allowed:
        return None
    return Turn(origins[0.0] - lever, vector)


def _rotation_vector(rotations: dict[float, np.ndarray]) -> np.ndarray | None:
    """Returns the axis times the angle of the whole rotation, from rotations after shares of it; None without one."""
    skews = {
        share: 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
        for share, r in rotations.items()
    }
    sines = {share: np.linalg.norm(skew) for share, skew in skews.items()}
    best = max(sines, key=lambda share: sines[share])
    if sines[best] < _SMALL:
        return None
    axis = skews[best] / sines[best]
    angle = 0.0
    for share in (*_DOUBLED, 1.0):
        r = rotations[share]
        measured = np.arctan2(skews[share] @ axis, 0.5 * (np.trace(r) - 1.0))
        angle = measured + 2.0 * np.pi * np.round((2.0 * angle - measured) / (2.0 * np.pi))
    return angle * axis


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Returns the matrix that rotates columns by a rotation vector [rad]."""
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + 2.0 * np.sin(0.5 * angle) ** 2 * cross @ cross
