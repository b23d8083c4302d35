"""Friction by pair of materials: a symmetric table of coefficients, and the materials of particles and shapes."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from ..._arguments import as_numpy, checked_integers, checked_number


@dataclass(frozen=True, eq=False)
class FrictionTable:
    """Coefficients of friction by pair of materials, in place of the geometric mean of those of the two sides.

    Each particle and each shape has a material, a number. The entry of two materials is the coefficient of contacts
    between them; where it is negative, they have none of their own, and the coefficients of the two sides count. So one
    shape may be slippery for one cloth and rough for another. An edge or a face between particles of several materials
    has that of one of its vertices.

    Cloth that slides on the first shape and sticks to the second, and for which everything else is as without a table::

        table = [[-1.0, 0.1, 0.9], [0.1, -1.0, -1.0], [0.9, -1.0, -1.0]]
        SolverCCD(solver, friction=FrictionTable(table, particle_material=0, shape_material=[1, 2]))

    Attributes:
        coefficients: Coefficients, shape [n, n], symmetric. A Warp array of float32 on the device of the model is read
            again in each step, in CUDA graphs too, and may require gradients. Only entries on and above the diagonal
            are read, and have gradients; a NaN that a program writes counts as negative.
        particle_material: Material of each particle, integers in [0, n), shape [particle_count], or one for all. A
            stage reads the materials once, when it is made.
        shape_material: Material of each shape, shape [shape_count], or one for all.
        particle_mu: Coefficients of particles, for pairs that have none of their own, as ``friction`` of
            :class:`.solver_ccd.SolverCCD` without a table.

    Raises:
        TypeError: If coefficients are no numbers, or materials no integers.
        ValueError: If coefficients are not finite, not symmetric or not square, or a material is out of range.
    """

    coefficients: wp.array | np.ndarray | list[list[float]]
    particle_material: int | np.ndarray | wp.array = 0
    shape_material: int | np.ndarray | wp.array = 0
    particle_mu: float | wp.array | None = None

    def __post_init__(self):
        values = self.coefficients
        if isinstance(values, wp.array) and values.dtype is not wp.float32:
            raise TypeError(f"coefficients must be an array of float32, not of {values.dtype.__name__}")
        what = "an array of numbers"
        values = as_numpy(values, "coefficients", what)
        if values.dtype.kind not in "iuf":
            raise TypeError(f"coefficients must be {what}, not {values.dtype}")
        if values.ndim != 2 or values.shape[0] != values.shape[1] or not values.size:
            raise ValueError(f"coefficients must have shape (n, n), not {values.shape}")
        with np.errstate(over="ignore"):
            single = values.astype(np.float32)
        bad = ~np.isfinite(single) | (single != single.T)
        if bad.any():
            i, j = np.argwhere(bad)[0]
            raise ValueError(
                f"coefficients[{i}][{j}] must be finite in single precision, and that of the pair in the other order, "
                f"not {values[i, j]} and {values[j, i]}"
            )
        for name in ("particle_material", "shape_material"):
            materials = as_numpy(getattr(self, name), name, "one integer or an array of integers")
            if materials.ndim > 1:
                raise ValueError(f"{name} must be one integer or an array of one dimension, not {materials.shape}")
            checked_integers(materials, name, materials.size, len(values))
        mu = self.particle_mu
        if isinstance(mu, wp.array):
            if mu.dtype is not wp.float32:
                raise TypeError(f"particle_mu must be a number, or an array of float32, not of {mu.dtype.__name__}")
        elif mu is not None:
            checked_number(mu, "particle_mu", 0.0)

    def on_device(self, model: newton.Model) -> wp.array:
        """Returns the coefficients on the device of a model, float32, shape [n, n]: those that a program may change."""
        if isinstance(self.coefficients, wp.array):
            return self.coefficients
        return wp.array(np.asarray(self.coefficients, dtype=np.float32), dtype=float, device=model.device)

    def materials(self, model: newton.Model) -> tuple[np.ndarray, np.ndarray]:
        """Returns the materials of the particles and shapes of a model, int32, with errors as of the class."""
        counts, most = {"particle": model.particle_count, "shape": model.shape_count}, len(self.coefficients)
        of_particles, of_shapes = (
            checked_integers(getattr(self, f"{what}_material"), f"friction.{what}_material", n, most)
            for what, n in counts.items()
        )
        return of_particles, of_shapes


def checked_table(friction: Any, model: newton.Model) -> tuple[FrictionTable | None, Any]:
    """Returns the table of the argument ``friction``, or None, and the coefficient of particles, not checked yet."""
    if not isinstance(friction, FrictionTable):
        return None, friction
    friction.materials(model)
    values = friction.coefficients
    if isinstance(values, wp.array) and values.device != model.device:
        raise ValueError(f"friction.coefficients must be on device {model.device}, not {values.device}")
    return friction, friction.particle_mu
