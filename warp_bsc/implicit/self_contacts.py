"""Self-contact of VBD: the pairs of its last detection in a step, and their elements."""

from typing import NamedTuple

import numpy as np
import warp as wp
from newton.solvers import SolverVBD

from . import element_kernels
from .elements import Elements
from .self_contact_forces import SelfContactSettings, pair_forces
from .worlds import Worlds


class RecordedPairs(NamedTuple):
    """The pairs between which self-contact of VBD has forces in a step.

    Attributes:
        vertices: Particles of a vertex and a triangle, then of two edges, the first of which the pair pushes, int32,
            shape [n, 4], -1 where there is no pair.
        triangles: How many have a triangle.
        dropped: 1 for worlds with pairs that did not fit into the buffers of VBD, int32, shape [world_count].
    """

    vertices: wp.array
    triangles: int
    dropped: wp.array


def record_pairs(solver: SolverVBD, worlds: Worlds) -> RecordedPairs | None:
    """Returns the pairs of the last detection of VBD, as copies; None without self-contact.

    On the CPU, where this reads numbers on the host, there are as many rows as pairs; elsewhere, as the buffers of VBD
    can hold.
    """
    if not solver.particle_enable_self_contact:
        return None
    info, model, found, total = solver.trimesh_collision_info, solver.model, [], 0
    device, fields = model.device, ("", "_offsets", "_buffer_sizes", "_count")
    of_kinds = ("vertex_colliding_triangles", model.tri_indices), ("edge_colliding_edges", model.edge_indices)
    for name, primitives in of_kinds:
        buffer, offsets, sizes, counts = (getattr(info, name + field) for field in fields)
        starts, n = offsets, len(buffer) // 2
        if device.is_cpu:
            ends = np.cumsum(np.minimum(counts.numpy(), sizes.numpy()), dtype=np.int32)
            starts, n = wp.array(np.append(0, ends[:-1]), dtype=int, device=device), int(ends[-1])
        found.append([primitives, buffer, offsets, sizes, counts, starts, total, worlds.of_particles])
        total += n
    vertices = wp.full((total, 4), -1, dtype=int, device=device)
    dropped = wp.zeros(worlds.count, dtype=int, device=device)
    for inputs in found:
        kernel, outputs = element_kernels.collect_pairs, [vertices, dropped]
        wp.launch(kernel, len(inputs[4]), inputs=inputs, outputs=outputs, device=device)
    return RecordedPairs(vertices, found[1][6], dropped)


class SelfContactElements:
    """Elements of self-contact, for one step at a time."""

    def __init__(self, solver: SolverVBD):
        """Takes the coefficients of VBD and its model; the first step with pairs allocates buffers."""
        self._solver, self._elements = solver, None

    def load(self, pairs: RecordedPairs | None) -> list[Elements]:
        """Takes the pairs of a step; returns their elements, none without pairs."""
        if pairs is None or not len(pairs.vertices):
            return []
        elements, n, device = self._elements, len(pairs.vertices), pairs.vertices.device
        if elements is None or len(elements.jacobian) < n:
            spare = n // 2 if device.is_cpu else 0  # elsewhere the number does not change
            places = wp.empty((n + spare, 4), dtype=int, device=device)
            elements = self._elements = Elements(pair_forces, places, [])
        elements.vertices, elements.count = pairs.vertices, n
        elements.parameters = [pairs.vertices, pairs.triangles, self._settings()]
        return [elements]

    def _settings(self):
        solver, model, settings = self._solver, self._solver.model, SelfContactSettings()
        settings.distance, settings.friction_velocity = solver.particle_self_contact_margin, solver.friction_epsilon
        settings.ke, settings.kd, settings.mu = model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu
        settings.least_edge_squared = solver.trimesh_collision_detector.edge_edge_parallel_epsilon
        return settings
