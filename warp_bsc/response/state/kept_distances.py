"""The distances that pairs of a model keep: radii of particles and margins of shapes, and a minimum for all pairs."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from ..._arguments import checked_distance, checked_distances

_OF_MODEL = "model"
"""The argument that takes radii and margins from the model."""


@dataclass(frozen=True, eq=False)
class KeptDistances:
    """Distances that pairs keep: the sum of the radii or margins of both sides, and a minimum.

    Attributes:
        minimum: Of all pairs [m].
        radii: Radius of each particle [m], float64, shape [particle_count].
        margins: Margin of each shape [m], float64, shape [shape_count].
        is_chosen: Whether the program gave a number for the minimum, be it 0.
    """

    minimum: float
    radii: np.ndarray
    margins: np.ndarray
    is_chosen: bool

    @classmethod
    def of(cls, model: newton.Model, min_distance: Any = None, particle_radius: Any = None) -> "KeptDistances":
        """Returns the distances by the arguments of :class:`.solver_ccd.SolverCCD`, with its errors."""
        margins = np.zeros(model.shape_count)
        if isinstance(min_distance, str):
            if min_distance != _OF_MODEL:
                raise ValueError(f"min_distance must be a number or {_OF_MODEL!r}, not {min_distance!r}")
            margins = _of_model(model.shape_margin, "shape_margin", model.shape_count)
            if particle_radius is None:
                particle_radius = _of_model(model.particle_radius, "particle_radius", model.particle_count)
            min_distance = None
        is_chosen = min_distance is not None
        minimum = 0.0 if min_distance is None else checked_distance(min_distance, "min_distance")
        radii = 0.0 if particle_radius is None else particle_radius
        radii = checked_distances(radii, "particle_radius", model.particle_count)
        return cls(minimum, np.broadcast_to(radii, model.particle_count), margins, is_chosen)

    @property
    def any(self) -> bool:
        """Whether pairs keep a distance."""
        return self.minimum > 0.0 or bool(self.radii.any() or self.margins.any())

    @property
    def largest(self) -> float:
        """The largest distance that a pair with a particle may have to keep [m]."""
        radius = self.radii.max(initial=0.0)
        return self.minimum + float(radius + max(radius, self.margins.max(initial=0.0)))


def _of_model(values: wp.array | None, name: str, count: int) -> np.ndarray:
    """Returns radii or margins of a model, float64, zeros if it has none."""
    if values is None:
        return np.zeros(count)
    return checked_distances(values.numpy(), f"min_distance={_OF_MODEL!r}: model.{name}", count)
