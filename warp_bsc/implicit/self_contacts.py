"""Self-contact of VBD: the pairs of its last detection in a step, and their elements."""

from typing import NamedTuple

import numpy as np
import warp as wp
from newton.solvers import SolverVBD

from . import element_kernels
from .elements import Elements
from .self_contact_forces import SelfContactSettings, edge_edge_forces, vertex_triangle_forces
from .worlds import Worlds


class RecordedPairs(NamedTuple):
    """The pairs between which self-contact of VBD has forces in a step.

    Attributes:
        vertex_triangle: Particles of a vertex and a triangle, int32, shape [n, 4], -1 where there is no pair.
        edge_edge: Particles of two edges, the first of which the pair pushes, likewise.
        dropped: 1 for worlds with pairs that did not fit into the buffers of VBD, int32, shape [world_count].
    """

    vertex_triangle: wp.array
    edge_edge: wp.array
    dropped: wp.array


def record_pairs(solver: SolverVBD, worlds: Worlds) -> RecordedPairs | None:
    """Returns the pairs of the last detection of VBD, as copies; None without self-contact.

    On the CPU, where this reads numbers on the host, there are as many rows as pairs; elsewhere, as the buffers of VBD
    can hold.
    """
    if not solver.particle_enable_self_contact:
        return None
    model, dropped = solver.model, wp.zeros(worlds.count, dtype=int, device=solver.model.device)
    triangles = _collect(solver, "vertex_colliding_triangles", model.tri_indices, worlds, dropped)
    edges = _collect(solver, "edge_colliding_edges", model.edge_indices, worlds, dropped)
    return RecordedPairs(triangles, edges, dropped)


def _collect(solver, name, primitives, worlds, dropped):
    """Returns the particles of the pairs in one of the buffers of VBD; marks worlds whose pairs did not fit."""
    buffer, offsets, sizes, counts = (
        getattr(solver.trimesh_collision_info, name + field) for field in ("", "_offsets", "_buffer_sizes", "_count")
    )
    device = counts.device
    if device.is_cpu:
        ends = np.cumsum(np.minimum(counts.numpy(), sizes.numpy()), dtype=np.int32)
        starts, n = wp.array(np.append(0, ends[:-1]), dtype=int, device=device), int(ends[-1])
    else:
        starts, n = offsets, len(buffer) // 2
    vertices = wp.full((n, 4), -1, dtype=int, device=device)
    kernel = element_kernels.collect_triangles if primitives.shape[1] == 3 else element_kernels.collect_edges
    inputs = [primitives, buffer, offsets, sizes, counts, starts, worlds.of_particles]
    wp.launch(kernel, len(counts), inputs=inputs, outputs=[vertices, dropped], device=device)
    return vertices


class SelfContactElements:
    """Elements of self-contact, for one step at a time."""

    def __init__(self, solver: SolverVBD):
        """Takes the coefficients of VBD and its model; the first step with pairs allocates buffers."""
        self._solver, self._elements = solver, {}

    def load(self, pairs: RecordedPairs | None) -> list[Elements]:
        """Takes the pairs of a step; returns their elements, none without pairs."""
        if pairs is None:
            return []
        kinds = (vertex_triangle_forces, pairs.vertex_triangle), (edge_edge_forces, pairs.edge_edge)
        return [self._loaded(kernel, vertices) for kernel, vertices in kinds if len(vertices)]

    def _loaded(self, kernel, vertices):
        elements, n = self._elements.get(kernel), len(vertices)
        if elements is None or len(elements.jacobian) < n:
            spare = n // 2 if vertices.device.is_cpu else 0  # elsewhere the number does not change
            places = wp.empty((n + spare, 4), dtype=int, device=vertices.device)
            elements = self._elements[kernel] = Elements(kernel, places, [])
        elements.vertices, elements.count = vertices, n
        elements.parameters = [vertices, self._settings()]
        return elements

    def _settings(self):
        solver, model, settings = self._solver, self._solver.model, SelfContactSettings()
        settings.distance, settings.friction_velocity = solver.particle_self_contact_margin, solver.friction_epsilon
        settings.ke, settings.kd, settings.mu = model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu
        settings.least_edge_squared = solver.trimesh_collision_detector.edge_edge_parallel_epsilon
        return settings
