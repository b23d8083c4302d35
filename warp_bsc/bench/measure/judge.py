"""Judges what a simulator made of a scene, by exact detection: crossings, collisions between states, inversions."""

import itertools
from collections.abc import Callable
from typing import Any

import newton
import numpy as np
import warp as wp

from ...detection.mesh import CollisionMesh
from ...response.report.strain import edges_at_rest
from ...response.state.mesh import ModelMesh, host_array
from ..crossings import SoftPairs
from ..scenes.simulation import largest_stretch


class Judge:
    """Judges trajectories of the particles of a model whose shapes do not move.

    All simulators are judged alike, on the same mesh: the particles in double precision, and the model's shapes cut
    into triangles as the stage has them. Round shapes lie within the true ones.
    """

    def __init__(self, model: newton.Model):
        """Makes the mesh of a model.

        Raises:
            ValueError: If the model has bodies or infinite planes, which are not judged.
        """
        mesh = ModelMesh(model)
        if model.body_count or len(mesh.planes.shape):
            raise ValueError("model must have neither bodies nor infinite planes")
        self._particles = model.particle_count
        self._shape_vertices = mesh.shape_vertices.position.astype(np.float64)
        self._mesh = CollisionMesh(mesh.faces, mesh.vertex_count, tets=mesh.tets, device=model.device)
        self._pairs = SoftPairs(self._mesh, model.particle_count)
        moves = host_array(model.particle_inv_mass) > 0.0
        edges, lengths, _ = edges_at_rest(model)
        moves = moves[edges].any(axis=1)
        self._edges, self._lengths = edges[moves], lengths[moves]

    def judge(
        self, states: list[np.ndarray], steps_per_frame: int, progress: Callable[[int], None] = lambda done: None
    ) -> dict[str, Any]:
        """Returns what detection finds in a trajectory. Pairs of two fixed shapes do not count.

        Args:
            states: Positions of the particles at the start and after each step [m], each of shape [particle_count, 3].
            steps_per_frame: Steps of a frame; the last frame may have fewer.
            progress: Called with the number of steps that are judged.

        Returns:
            ``crossings``, the edges that pass through faces at the end of each frame, and ``shape_crossings``, those of
            them in which one of the two belongs to a fixed shape; ``collisions``, the vertex-face and edge-edge pairs
            that meet on the straight way from each state to the next, for each step; ``inverted``, the tetrahedra that
            are inverted at the end of each frame; ``stretch``, the largest elongation of an edge beyond its length at
            rest, of all frame ends [%].

        Raises:
            ValueError: If positions are not finite or have another shape.
        """
        positions = [self._with_shapes(state) for state in states]
        ends = [*range(steps_per_frame, len(states) - 1, steps_per_frame), len(states) - 1]
        crossings = [self._pairs.count_crossings(positions[end]) for end in ends]
        inverted = [0] * len(ends)
        if len(self._mesh.tets):
            inverted = [len(self._pairs.detector.find_inversions(positions[end])) for end in ends]
        collisions = []
        for step, pair in enumerate(itertools.pairwise(positions)):
            collisions.append(self._pairs.count_collisions(*pair))
            progress(step + 1)
        return {
            "crossings": [every for every, _ in crossings],
            "shape_crossings": [with_shapes for _, with_shapes in crossings],
            "collisions": collisions,
            "inverted": inverted,
            "stretch": 100.0 * max(largest_stretch(states[end], self._edges, self._lengths) for end in ends),
        }

    def _with_shapes(self, state: np.ndarray) -> wp.array:
        """Returns positions of all vertices on the device, of the shapes as well."""
        if state.shape != (self._particles, 3):
            raise ValueError(f"states must have shape ({self._particles}, 3), not {state.shape}")
        every = np.concatenate([state.astype(np.float64), self._shape_vertices])
        return wp.array(every, dtype=wp.vec3d, device=self._mesh.device)
