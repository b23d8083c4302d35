"""Elastic energy of cloth, soft bodies and springs: of what VBD has the forces."""

import newton
import numpy as np
import warp as wp

from ..implicit.elasticity.derivatives import element_energy
from ..implicit.elasticity.elements import Elements, elements_of_model, first_vertex, kind_of
from ..response.state.mesh import host_array


class ElasticEnergy:
    """The elastic energy of triangles, pairs of them at edges, tetrahedra and springs of a model; 0 of those at rest.

    It is that of VBD: a stable neo-Hookean one of triangles and tetrahedra, that of dihedral angles, and that of
    springs, see :mod:`..implicit.elasticity`. Contacts have none here, nor do attachments.
    """

    def __init__(self, model: newton.Model):
        """Reads elements of a model with particles."""
        self._worlds, self._world = max(1, model.world_count), np.maximum(host_array(model.particle_world), 0)
        self._elements, vertices = elements_of_model(model)
        n, device = sum(map(len, vertices)), model.device
        self._energy, self._vertex = wp.zeros(n, dtype=wp.float64, device=device), wp.zeros(n, dtype=int, device=device)

    def of(self, x: np.ndarray) -> np.ndarray:
        """Returns the energy in each world [J], float64, shape [world_count], at positions [m], shape [n, 3]."""
        device, outputs = self._energy.device, [self._energy, self._vertex]
        inputs = [self._elements, wp.array(x, dtype=wp.vec3d, device=device)]
        wp.launch(_find_energies, len(self._energy), inputs=inputs, outputs=outputs, device=device)
        return np.bincount(self._world[self._vertex.numpy()], self._energy.numpy(), minlength=self._worlds)


@wp.kernel(enable_backward=False)
def _find_energies(
    # in
    elements: Elements,
    x: wp.array[wp.vec3d],
    # out
    energy: wp.array[wp.float64],
    vertex: wp.array[int],
):
    """Computes the energy of each element, without that of damping, and one of its particles."""
    i = wp.tid()
    kind = kind_of(elements, i)
    energy[i] = element_energy(elements, i, kind, x, x, wp.float64(1.0))
    vertex[i] = first_vertex(elements, kind, i - elements.first[kind])
