"""Counts crossings of cloth and soft bodies of a Newton model in states, and what meets between two of them."""

import newton
import numpy as np
import warp as wp

from ..detection.detector import CollisionDetector
from ..response.state.mesh import ModelMesh

__all__ = ["CrossingCounter"]


class CrossingCounter:
    """Counts edges that meet faces without a common vertex, and pairs that meet on the way, in exact arithmetic.

    At least one of the two belongs to cloth, a soft body or a spring, not to a rigid shape. Infinite planes have no
    faces, and nothing crosses them.
    """

    def __init__(self, model: newton.Model, *, strands: bool = False):
        """Makes the mesh of a model.

        Args:
            model: The model.
            strands: Whether springs without faces count as edges.
        """
        self._mesh = ModelMesh(model, strands=strands)
        self._detector = CollisionDetector(self._mesh, method="exact")
        self._x, self._x0 = (wp.zeros(self._mesh.vertex_count, dtype=wp.vec3, device=model.device) for _ in range(2))
        particles = model.particle_count
        self._vertex_is_soft = np.arange(self._mesh.vertex_count) < particles
        self._edge_is_soft, self._face_is_soft = (
            elements.min(axis=1, initial=particles) < particles for elements in (self._mesh.edges, self._mesh.faces)
        )

    def count(self, state: newton.State) -> int:
        """Returns the number of crossings in a state, whose positions are finite."""
        self._read_positions(state)
        edges, faces = self._detector.find_intersections(self._x).T
        return int((self._edge_is_soft[edges] | self._face_is_soft[faces]).sum())

    def begin(self, state: newton.State) -> None:
        """Takes the state from which :meth:`count_collisions` counts."""
        self._mesh.positions(state.particle_q, state.body_q, self._x0)

    def count_collisions(self, state: newton.State) -> int:
        """Returns the number of pairs that meet on straight ways from the last state to this one, and begins here."""
        self._read_positions(state)
        found = self._detector.detect(self._x0, self._x)
        self._x0, self._x = self._x, self._x0
        vertices, faces = found.vertex_face.T
        first, second = found.edge_edge.T
        soft = (self._vertex_is_soft[vertices] | self._face_is_soft[faces]).sum()
        return int(soft + (self._edge_is_soft[first] | self._edge_is_soft[second]).sum())

    def is_finite(self, state: newton.State) -> bool:
        """Returns whether the positions of all vertices of faces are finite in a state."""
        self._read_positions(state)
        return bool(np.isfinite(self._x.numpy()[self._mesh.vertices]).all())

    def _read_positions(self, state):
        self._mesh.positions(state.particle_q, state.body_q, self._x)
