"""Finds the points of a part of a surface that are closest to given ones, and where straight ways out meet it."""

import numpy as np
import warp as wp

from ..detection.run.launch import launch
from .kernels import find_closest, find_exits
from .surface import Surface


def closest_points(
    surface: Surface, x: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points of some faces, at least one, that are closest to given ones, and the normals there.

    Positions ``x`` of the surface and all points are in units, shapes [m, 3] and [n, 3].
    """
    target = _part(surface, x, faces)
    closest, normals = (wp.empty(len(points), dtype=wp.vec3, device=surface.device) for _ in range(2))
    inputs, outputs = [target.id, surface.array(points, wp.vec3)], [closest, normals]
    launch(find_closest, len(points), inputs=inputs, outputs=outputs, device=surface.device)
    return closest.numpy().astype(np.float64), normals.numpy().astype(np.float64)


def exit_distances(
    surface: Surface, x: np.ndarray, faces: np.ndarray, points: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Returns how far points are from some faces along directions, infinite where they meet none, shape [n, k].

    Arguments are those of :func:`closest_points`, and directions of length 1, shape [k, 3].
    """
    target = _part(surface, x, faces)
    distances = wp.empty((len(points), len(directions)), dtype=float, device=surface.device)
    inputs = [target.id, surface.array(points, wp.vec3), surface.array(directions, wp.vec3)]
    launch(find_exits, distances.shape, inputs=inputs, outputs=[distances], device=surface.device)
    return distances.numpy().astype(np.float64)


def _part(surface: Surface, x: np.ndarray, faces: np.ndarray) -> wp.Mesh:
    """Returns some faces as a mesh that Warp can search."""
    if not len(faces):  # a mesh of no faces corrupts the memory of a GPU in Warp 1.19
        raise ValueError("faces must not be empty")
    return wp.Mesh(surface.array(x, wp.vec3), surface.array(surface.mesh.faces[faces].ravel(), int))
