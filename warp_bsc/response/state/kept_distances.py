"""The distances that pairs of a model keep: radii of particles and margins of shapes, and a minimum for all pairs."""

from dataclasses import dataclass
from typing import Any

import newton
import numpy as np
import warp as wp

from ..._arguments import checked_distance, checked_distances
from ...detection.narrow.rules.approach import MinDistances

_OF_MODEL = "model"
"""The argument that takes radii and margins from the model."""


@dataclass(frozen=True, eq=False)
class KeptDistances:
    """Distances that pairs keep: the sum of the radii or margins of both sides, and a minimum."""

    minimum: float  # of all pairs [m]
    radii: np.ndarray  # radius of each particle [m], float64, shape [particle_count]
    margins: np.ndarray  # margin of each shape [m], float64, shape [shape_count]
    is_chosen: bool  # whether the program gave the minimum, be it 0
    has_fixed_margins: bool  # whether margins are those that the model had
    # arrays from which each step reads the minimum, radii and margins again; None for what stays as it is
    arrays: tuple[wp.array | None, ...]
    has_radius: np.ndarray  # which particles have a radius

    @classmethod
    def of(
        cls, model: newton.Model, min_distance: Any = None, particle_radius: Any = None, *, of_strands: bool = False
    ) -> "KeptDistances":
        """Returns the distances by the arguments of :class:`.solver_ccd.SolverCCD`, with its errors.

        With ``of_strands``, particles without triangles and tetrahedra have their radii if there are no arguments.
        """
        minimum, radii, margins, count = min_distance, particle_radius, None, model.particle_count
        has_radius, name, prefix = np.ones(count, dtype=bool), "particle_radius", "model."
        of_strands = of_strands and minimum is None and radii is None
        if isinstance(min_distance, str):
            if min_distance != _OF_MODEL:
                raise ValueError(f"min_distance must be a number or {_OF_MODEL!r}, not {min_distance!r}")
            minimum, margins, prefix = None, _of_model(model, "shape_margin"), f"min_distance={_OF_MODEL!r}: model."
        for elements in (model.tri_indices, model.tet_indices):
            if of_strands and elements is not None:
                has_radius[elements.numpy().ravel()] = False
        if of_strands or (isinstance(min_distance, str) and radii is None):
            radii, name = _of_model(model, "particle_radius"), f"{prefix}particle_radius"
        values = has_radius * checked_distances(0.0 if radii is None else radii, name, count)
        if of_strands and not values.any():
            radii = None
        of_shapes = checked_distances(0.0 if margins is None else margins, f"{prefix}shape_margin", model.shape_count)
        of_shapes = np.broadcast_to(of_shapes, model.shape_count)
        of_all = 0.0
        if isinstance(minimum, wp.array):
            of_all = float(checked_distances(minimum, "min_distance", 1)[0])
        elif minimum is not None:
            of_all = checked_distance(minimum, "min_distance")
        arrays = (*(x if isinstance(x, wp.array) else None for x in (minimum, radii, margins)),)
        for array, name in zip(arrays, ("min_distance", "particle_radius"), strict=False):
            if array is not None and (array.dtype is not wp.float32 or array.device != model.device):
                kind = f"{array.dtype.__name__} on {array.device}"
                raise TypeError(f"{name} must be numbers, or an array of float32 on {model.device}, not of {kind}")
        is_fixed = margins is not None and arrays[2] is None
        return cls(of_all, values, of_shapes, minimum is not None, is_fixed, arrays, has_radius)

    @property
    def any(self) -> bool:
        """Whether pairs keep a distance, or may keep one that gradients are with respect to."""
        differs = any(array is not None and array.requires_grad for array in self.arrays)
        return differs or self.minimum > 0.0 or bool(self.radii.any() or self.margins.any())


def _of_model(model, name):
    """Returns an array of a model: as it is if the model requires gradients, as numbers if not, None if it is empty."""
    array = getattr(model, name)
    if array is None or not len(array):
        return None
    return array if model.requires_grad else array.numpy()


@wp.kernel
def _read_distances(
    # in
    numbers: wp.array[wp.float64],
    index: wp.array[int],
    particle_count: int,
    minimum: wp.array[float],
    of_particles: wp.array[float],
    of_shapes: wp.array[float],
    # out
    radius: wp.array[wp.float64],
    of_planes: wp.array[wp.float64],
):
    """Adds distances of arrays to those that are numbers, of vertices and then of planes; negative ones count as 0."""
    i = wp.tid()
    k, half, own = index[i], float(0.0), float(0.0)
    if minimum:
        half = 0.5 * minimum[0]
    if i >= particle_count:
        if of_shapes:
            own = of_shapes[k]
    elif of_particles and k >= 0:
        own = of_particles[k]
    found = numbers[i] + wp.float64(wp.where(half >= 0.0, half, 0.0)) + wp.float64(wp.where(own >= 0.0, own, 0.0))
    if i < radius.shape[0]:
        radius[i] = found
    else:
        of_planes[i - radius.shape[0]] = found


class DistanceArrays:
    """Arrays of a program from which steps read distances that pairs keep.

    Attributes:
        inputs: The arrays.
    """

    def __init__(self, kept: KeptDistances, shapes: np.ndarray, distances: MinDistances):
        """Takes arrays, which ``distances`` are then read from, given the shape of each other vertex and each plane."""
        minimum, of_particles, of_shapes = self._arrays = kept.arrays
        self.inputs = [array for array in kept.arrays if array is not None]
        self._distances, device = distances, distances.radius.device
        numbers = np.concatenate([(of_particles is None) * kept.radii, (of_shapes is None) * kept.margins[shapes]])
        numbers += (minimum is None) * 0.5 * kept.minimum
        index = np.concatenate([np.where(kept.has_radius, np.arange(len(kept.radii)), -1), shapes])
        numbers, index = wp.array(numbers, dtype=wp.float64, device=device), wp.array(index, dtype=int, device=device)
        self._places = numbers, index, len(kept.radii)

    @property
    def requires_grad(self) -> bool:
        """Whether one of the arrays requires gradients."""
        return any(array.requires_grad for array in self.inputs)

    def read(self) -> None:
        """Reads the distances again. Can be captured in a CUDA graph."""
        self._launch([self._distances.radius, self._distances.of_planes])

    def backward(self, of_radius: wp.array[wp.float64], of_planes: wp.array[wp.float64]) -> None:
        """Adds to the gradients of :attr:`inputs`, given those of vertices and planes."""
        outputs = [of_radius, of_planes]  # stand in for the outputs, which the adjoint does not read or write
        self._launch(outputs, adjoint=True, adj_inputs=6 * [None], adj_outputs=outputs)

    def _launch(self, outputs, **options):
        inputs = [*self._places, *self._arrays]
        size, device = len(self._places[0]), outputs[0].device
        wp.launch(_read_distances, size, inputs=inputs, outputs=outputs, device=device, **options)
