"""Elastic energy of cloth, soft bodies and springs: of what VBD has the forces."""

from typing import Any

import newton
import numpy as np

from ..response.state.mesh import host_array

__all__ = ["ElasticEnergy"]


class ElasticEnergy:
    """The elastic energy of triangles, pairs of them at edges, tetrahedra and springs of a model; 0 of those at rest.

    It is that of VBD: a stable neo-Hookean one of triangles and tetrahedra, that of dihedral angles, and that of
    springs, see :mod:`..implicit.contact.elasticity`. Contacts have none here, nor do attachments.
    """

    def __init__(self, model: newton.Model):
        """Reads elements, rest shapes and materials of a model with particles."""
        self._worlds, self._world = max(1, model.world_count), np.maximum(host_array(model.particle_world), 0)

        def read(*names):
            return [_read(model, name) for name in names]

        self._triangles, self._tri_poses, self._areas, self._membrane = read(
            "tri_indices", "tri_poses", "tri_areas", "tri_materials"
        )
        self._edges, self._angles, self._lengths, self._bending = read(
            "edge_indices", "edge_rest_angle", "edge_rest_length", "edge_bending_properties"
        )
        self._tetrahedra, self._tet_poses, self._solid = read("tet_indices", "tet_poses", "tet_materials")
        self._springs, self._spring_lengths, self._stiffness = read(
            "spring_indices", "spring_rest_length", "spring_stiffness"
        )

    def of(self, x: np.ndarray) -> np.ndarray:
        """Returns the energy in each world [J], float64, shape [world_count], at positions [m], shape [n, 3]."""
        x, total = x.astype(np.float64), np.zeros(self._worlds)

        def add(energies, particles):
            np.add.at(total, self._world[particles], energies)

        if self._triangles is not None:
            gradient = _sides(x, self._triangles) @ self._tri_poses
            area = np.linalg.norm(np.cross(gradient[:, :, 0], gradient[:, :, 1]), axis=1)
            add(self._areas * _neo_hookean(gradient, area, self._membrane), self._triangles[:, 0])
        if self._tetrahedra is not None:
            gradient = _sides(x, self._tetrahedra) @ self._tet_poses
            volume = 1.0 / (6.0 * np.linalg.det(self._tet_poses))
            add(volume * _neo_hookean(gradient, np.linalg.det(gradient), self._solid), self._tetrahedra[:, 0])
        if self._edges is not None:
            inner = (self._edges >= 0).all(axis=1) & (self._bending[:, 0] > 0.0)
            bent = _dihedral_angles(*x[self._edges[inner]].transpose(1, 0, 2)) - self._angles[inner]
            add(0.5 * self._bending[inner, 0] * self._lengths[inner] * bent**2, self._edges[inner, 2])
        if self._springs is not None:
            ends = x[self._springs.reshape(-1, 2)]
            stretch = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) - self._spring_lengths
            add(0.5 * self._stiffness * stretch**2, self._springs.reshape(-1, 2)[:, 0])
        return total


def _read(model: newton.Model, name: str) -> Any:
    """Returns an array on the host, numbers in float64; None if there are no such elements."""
    array = getattr(model, name)
    if array is None or not len(array):
        return None
    values = host_array(array)
    return values if values.dtype == np.int32 else values.astype(np.float64)


def _sides(x, elements):
    """Returns the vectors from the first vertex of elements to the others, as columns, shape [n, 3, size - 1]."""
    corners = x[elements]
    return (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)


def _neo_hookean(gradient, measure, materials):
    """Returns energies by area or volume at rest, of which ``measure`` is the share that is there, from 0 at rest."""
    mu, lame = materials[:, 0], materials[:, 0] + materials[:, 1]
    excess = (gradient**2).sum(axis=(1, 2)) - gradient.shape[2]
    return 0.5 * mu * excess + 0.5 * lame * (measure - 1.0) ** 2 - mu * (measure - 1.0)


def _dihedral_angles(a, b, c, d):
    """Returns the angles between the normals of the triangles a, c, d and b, d, c."""
    n1, n2, edge = np.cross(c - a, d - a), np.cross(d - b, c - b), d - c
    sines = (np.cross(n1, n2) * edge).sum(axis=1)
    return np.arctan2(sines, (n1 * n2).sum(axis=1) * np.linalg.norm(edge, axis=1))
