"""Checks the arguments of a repair and converts them: the mesh, vertices that stay, and the set of each vertex."""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from .._arguments import as_numpy, check_finite, checked_shape, given
from ..detection.mesh import CollisionMesh
from ..detection.run.start import checked_device


def checked_mesh(mesh: Any, x: Any, device: wp.DeviceLike) -> tuple[CollisionMesh, np.ndarray]:
    """Returns a mesh and its positions as NumPy, given a mesh or faces and positions, or a ``trimesh.Trimesh``."""
    trimesh = sys.modules.get("trimesh")  # imported if the mesh is one of its own
    if x is None and trimesh and isinstance(mesh, trimesh.Trimesh):
        mesh, x = np.array(mesh.faces), np.array(mesh.vertices)
    positions = checked_shape(x, (3,), "x")
    if not isinstance(mesh, CollisionMesh):
        chosen = checked_device(device)
        try:
            mesh = CollisionMesh(mesh, len(positions), device=chosen)
        except (TypeError, ValueError) as error:
            raise type(error)(f"mesh: {error}") from None
    elif device is not None:
        raise ValueError("device must be omitted with a mesh, which has its own")
    if len(positions) != mesh.vertex_count:
        raise ValueError(f"x must have {mesh.vertex_count} rows, one a vertex, got {len(positions)}")
    check_finite(positions, "x", mesh.vertices)
    return mesh, positions


def checked_mask(vertices: Any, name: str, count: int) -> np.ndarray:
    """Returns which vertices are given, by a mask, bool, or indices, integers, shape [n]: a mask, bool, shape [count].

    Raises:
        TypeError: If they are no array of numbers.
        ValueError: If they have another shape or type, or an index is out of range.
    """
    values = as_numpy(vertices, name, "an array of indices or a mask")
    if values.dtype == bool:
        if values.shape != (count,):
            raise ValueError(f"{name} as a mask must have shape ({count},), not {values.shape}")
        return values.copy()
    mask = np.zeros(count, dtype=bool)
    if values.shape == (0,):
        return mask
    if values.ndim != 1 or not np.issubdtype(values.dtype, np.integer):
        raise ValueError(f"{name} must be a mask or integers of shape (n,), not {values.dtype} {values.shape}")
    bad = (values < 0) | (values >= count)
    if bad.any():
        raise ValueError(f"{name}[{np.argmax(bad)}] is {values[np.argmax(bad)]}, but the mesh has {count} vertices")
    mask[values] = True
    return mask


def checked_sets(sets: Any, name: str, count: int) -> np.ndarray:
    """Returns the set that each vertex is in, such as its sheet, -1 for none, int, shape [count].

    They are given as an array of a number for each vertex, of at least -1, or as a sequence of sets of vertices.

    Raises:
        TypeError: If it is neither.
        ValueError: If numbers or sets have another shape or are out of range, or sets share a vertex.
    """
    if isinstance(sets, np.ndarray | wp.array):
        values = as_numpy(sets, name)
        if values.shape != (count,) or not np.issubdtype(values.dtype, np.integer):
            what = f"{values.dtype} {values.shape}"
            raise ValueError(f"{name} as an array must be {count} integers, one a vertex, not {what}")
        if values.min(initial=0) < -1 or values.max(initial=0) >= 2**31:
            raise ValueError(f"{name} must be in [-1, 2^31), not {values.min(initial=0)} to {values.max(initial=0)}")
        return values.astype(np.int64)
    if isinstance(sets, str) or not isinstance(sets, Sequence):
        raise TypeError(f"{name} must be an array of numbers or a sequence of sets of vertices, not {given(sets)}")
    number_of = np.full(count, -1)
    for number, vertices in enumerate(sets):
        mask = checked_mask(vertices, f"{name}[{number}]", count)
        shared = mask & (number_of >= 0)
        if shared.any():
            vertex = np.argmax(shared)
            raise ValueError(f"{name}[{number}] has vertex {vertex}, which {name}[{number_of[vertex]}] has as well")
        number_of[mask] = number
    return number_of


def checked_seams(mesh: CollisionMesh, x: np.ndarray, weld: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """Returns for each vertex the one whose position it gets where seams are closed: a fixed one if there is one.

    ``weld`` is the vertex that each one at ``x``, shape [n, 3], is welded to; ``fixed`` ones stay, bool, shape [n].

    Raises:
        ValueError: If two fixed vertices that are apart are welded, or two corners of a face.
    """
    first, rows = np.arange(len(x)), np.flatnonzero(fixed)[::-1]
    first[weld[rows]] = rows
    weld = first[weld]
    moved = fixed & np.isin(weld, rows) & (x != x[weld]).any(axis=1)
    if moved.any():
        vertex = np.argmax(moved)
        raise ValueError(f"seam_tolerance must not close vertices {weld[vertex]} and {vertex}, which are fixed apart")
    corners = np.sort(mesh.faces, axis=1), np.sort(weld[mesh.faces], axis=1)
    before, after = ((of[:, 1:] == of[:, :-1]).sum(axis=1) for of in corners)
    if (after > before).any():
        raise ValueError(f"seam_tolerance must be less than the edges of face {np.argmax(after > before)}")
    return weld
