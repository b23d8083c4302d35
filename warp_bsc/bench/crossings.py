"""Counts crossings of cloth and soft bodies of a Newton model in states, and what meets between two of them."""

import newton
import numpy as np
import warp as wp

from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..response.state.mesh import ModelMesh


class SoftPairs:
    """Counts edges that meet faces without a common vertex, and pairs that meet on the way, in exact arithmetic.

    At least one of the two belongs to cloth, a soft body or a spring, not to a rigid shape.

    Attributes:
        detector: The detector of the mesh.
    """

    def __init__(self, mesh: CollisionMesh, particles: int):
        """Makes the detector of a mesh whose first vertices are particles."""
        self.detector, self._particles = CollisionDetector(mesh, method="exact"), particles
        self._edge_is_soft, self._face_is_soft = (
            elements.min(axis=1, initial=particles) < particles for elements in (mesh.edges, mesh.faces)
        )

    def count_crossings(self, x: wp.array) -> tuple[int, int]:
        """Returns the number of crossings at finite positions, and of those with rigid shapes."""
        edges, faces = self.detector.find_intersections(x).T
        edge, face = self._edge_is_soft[edges], self._face_is_soft[faces]
        return int((edge | face).sum()), int((edge ^ face).sum())

    def count_collisions(self, x0: wp.array, x1: wp.array) -> int:
        """Returns the number of pairs that meet on straight ways."""
        found = self.detector.detect(x0, x1)
        vertices, faces = found.vertex_face.T
        first, second = found.edge_edge.T
        soft = ((vertices < self._particles) | self._face_is_soft[faces]).sum()
        return int(soft + (self._edge_is_soft[first] | self._edge_is_soft[second]).sum())


class CrossingCounter:
    """Counts as :class:`SoftPairs` does, in states of a model. Nothing crosses infinite planes, which have no faces."""

    def __init__(self, model: newton.Model, *, strands: bool = False):
        """Makes the mesh of a model; with ``strands``, springs without faces count as edges."""
        self._mesh = ModelMesh(model, strands=strands)
        self._pairs = SoftPairs(self._mesh, model.particle_count)
        self._x, self._x0 = (wp.zeros(self._mesh.vertex_count, dtype=wp.vec3, device=model.device) for _ in range(2))

    def count(self, state: newton.State) -> int:
        """Returns the number of crossings in a state, whose positions are finite."""
        self._read_positions(state)
        return self._pairs.count_crossings(self._x)[0]

    def begin(self, state: newton.State) -> None:
        """Takes the state from which :meth:`count_collisions` counts."""
        self._mesh.positions(state.particle_q, state.body_q, self._x0)

    def count_collisions(self, state: newton.State) -> int:
        """Returns the number of pairs that meet on straight ways from the last state to this one, and begins here."""
        self._read_positions(state)
        found = self._pairs.count_collisions(self._x0, self._x)
        self._x0, self._x = self._x, self._x0
        return found

    def is_finite(self, state: newton.State) -> bool:
        """Returns whether the positions of all vertices of faces are finite in a state."""
        self._read_positions(state)
        return bool(np.isfinite(self._x.numpy()[self._mesh.vertices]).all())

    def _read_positions(self, state):
        self._mesh.positions(state.particle_q, state.body_q, self._x)
