"""What became of vertices and bodies in the last step, read from the device."""

import numpy as np

from ..state.mesh import ModelMesh
from ..state.structs import INVALID, UNCERTIFIED
from .count_steps import StepResults


class Outcomes:
    """Reads the outcomes of vertices and bodies, whose bits are those of :mod:`.state.structs`."""

    def __init__(self, mesh: ModelMesh, results: StepResults):
        """Reads the outcomes in the results of steps of a mesh."""
        self._mesh, self._results = mesh, results

    def find(self, bit: int) -> np.ndarray:
        """Returns which vertices have a bit of the outcome, themselves or their body, bool, shape [vertex_count]."""
        results, mesh = self._results, self._mesh
        found = (results.of_vertices.numpy() & int(bit)) != 0
        if len(results.of_bodies):
            of_bodies = np.append((results.of_bodies.numpy() & int(bit)) != 0, False)  # last: of no body
            found[mesh.model.particle_count :] |= of_bodies[mesh.shape_vertices.body]
        return found

    def find_uncertified(self) -> np.ndarray:
        """Returns which vertices of the mesh the certificate of the last step lacks, bool, shape [vertex_count]."""
        outcome = self._results.of_vertices.numpy()
        listed, invalid = ((outcome & int(bit)) != 0 for bit in (UNCERTIFIED, INVALID))
        for elements in (self._mesh.faces, self._mesh.edges):
            listed[elements[invalid[elements].any(axis=1)]] = True
        return listed

    def count(self, bit: int) -> int:
        """Returns the number of vertices and bodies that have a bit of the outcome."""
        outcomes = self._results.of_vertices, self._results.of_bodies
        return sum(int(np.count_nonzero(outcome.numpy() & int(bit))) for outcome in outcomes)
