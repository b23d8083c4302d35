"""Groups and masks of particles and shapes: which pairs the stage leaves to the inner solver."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from ..._arguments import as_numpy, check_instance, checked_bits

_NAMES = ("particle_group", "particle_mask", "shape_group", "shape_mask")
_MOST_GROUPS = 16
"""Of a model with shapes that collide with shapes, but not with particles."""


@dataclass(frozen=True, eq=False)
class CollisionFilter:
    """Leaves pairs out of a stage unless each of the two has a group that is in the mask of the other, as in Bullet.

    Groups and masks are bits: integers in [0, 2^32), or -1 for all bits; NumPy or Warp arrays with one for each
    particle or shape of the model, or one for all. Edges and faces meet where all of their particles do. A pair that is
    left out is delegated to the inner solver; the stage does not look at it, pushes nothing because of it, counts it in
    ``report.filtered``, and does not certify it. A stage reads the arrays once, when it is made.

    Cloth that does not collide with itself, only with shapes: ``CollisionFilter(particle_group=2, particle_mask=1)``.

    Attributes:
        particle_group: Groups of particles; default: the first, 1.
        particle_mask: Groups of particles and shapes that particles meet; default: all.
        shape_group: Groups of shapes; default: the first, 1.
        shape_mask: Groups of particles and shapes that shapes meet; default: all. Pairs of shapes must meet by Newton's
            flags, groups and filters as well.

    Raises:
        TypeError: If an argument holds no integers.
        ValueError: If it is out of range, or neither one number nor an array of one dimension.
    """

    particle_group: int | np.ndarray | wp.array = 1
    particle_mask: int | np.ndarray | wp.array = -1
    shape_group: int | np.ndarray | wp.array = 1
    shape_mask: int | np.ndarray | wp.array = -1

    def __post_init__(self):
        for name in _NAMES:
            value = as_numpy(getattr(self, name), name, "one integer or an array of integers")
            if value.ndim > 1:
                raise ValueError(f"{name} must be one integer or an array of one dimension, not of shape {value.shape}")
            checked_bits(value, name, value.size)

    def bits_of_particles(self, model: newton.Model) -> tuple[np.ndarray, np.ndarray]:
        """Returns groups and masks of the particles of a model, uint32; errors as of the class if they do not fit."""
        return self._bits("particle", model.particle_count)

    def bits_of_shapes(self, model: newton.Model) -> tuple[np.ndarray, np.ndarray]:
        """Returns groups and masks of the shapes of a model, as :meth:`bits_of_particles`."""
        return self._bits("shape", model.shape_count)

    def _bits(self, what, count):
        names = f"{what}_group", f"{what}_mask"
        group, mask = (checked_bits(getattr(self, n), f"collision_filter.{n}", count) for n in names)
        return group, mask


def checked_filter(collision_filter: Any, model: newton.Model) -> CollisionFilter | None:
    """Returns the argument ``collision_filter``, a :class:`CollisionFilter` that fits a model, or None."""
    if collision_filter is None:
        return None
    check_instance(collision_filter, "collision_filter", CollisionFilter, "a CollisionFilter")
    collision_filter.bits_of_particles(model)
    collision_filter.bits_of_shapes(model)
    return collision_filter


def bits_of_model(
    model: newton.Model, collision_filter: CollisionFilter | None, apart: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns groups and masks of particles and of shapes, uint32, each of shape [2, n]; None if no pair is left out.

    Shapes that are ``apart`` meet other shapes, but no particles, bool, shape [shape_count].

    Raises:
        ValueError: If the filter does not fit the model, or has more than 16 groups where some shapes are apart.
    """
    if collision_filter is None:
        if not apart.any():
            return None
        collision_filter = CollisionFilter()
    particles = np.stack(collision_filter.bits_of_particles(model))
    shapes = np.stack(collision_filter.bits_of_shapes(model))
    if not apart.any():
        return particles, shapes
    # each group becomes two, of what meets particles and of what meets shapes
    used = int(np.bitwise_or.reduce(np.concatenate([particles[0], shapes[0]])))
    groups = [group for group in range(32) if used >> group & 1]
    if len(groups) > _MOST_GROUPS:
        raise ValueError(
            f"collision_filter must have at most {_MOST_GROUPS} groups, not {len(groups)}: shape {np.argmax(apart)} "
            f"({model.shape_label[np.argmax(apart)]!r}) collides with shapes only, which takes the other bits"
        )

    def renumbered(bits: np.ndarray) -> np.ndarray:
        return np.bitwise_or.reduce([(bits >> g & 1) << i for i, g in enumerate(groups)]).astype(np.uint32)

    particles, shapes = renumbered(particles), renumbered(shapes)
    return particles, np.where(apart, 0, shapes).astype(np.uint32) | (shapes << _MOST_GROUPS)
