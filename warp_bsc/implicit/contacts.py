"""Contacts of particles with rigid shapes, and self-contact: what a step saw of them, and their elements."""

from typing import NamedTuple

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverVBD

from .._private_names.of_newton import vbd_switch
from . import element_kernels
from .bodies import Poses
from .contact_forces import ContactPlanes, ContactSettings, contact_forces
from .elements import Elements, with_gradient
from .worlds import Worlds

_ARRAYS = "indices", "barycentric", "shape", "body_pos", "body_vel", "normal"
"""Fields of :class:`.contact_forces.ContactPlanes`, which are attributes ``soft_contact_*`` of contacts."""


class RecordedContacts(NamedTuple):
    """The contacts of a step.

    Attributes:
        capacity: Number of contacts that there can be.
        count: Number of contacts, on the device.
        planes: Copies of the contacts, with the gradients of the program's arrays.
    """

    capacity: int
    count: wp.array
    planes: ContactPlanes


def record_contacts(contacts: newton.Contacts | None, *, copies: bool) -> RecordedContacts | None:
    """Returns the contacts that a step saw, as copies or not; None if it saw none.

    On the CPU these are the contacts that there are; elsewhere and in graphs, all that there can be.
    """
    if contacts is None or not contacts.soft_contact_max:
        return None
    count, capacity = contacts.soft_contact_count, contacts.soft_contact_max
    if count.device.is_cpu and not count.device.is_capturing:
        capacity = min(capacity, int(count.numpy()[0]))
        if capacity == 0:
            return None
    planes = ContactPlanes()
    for name in _ARRAYS:
        array = getattr(contacts, f"soft_contact_{name}")[:capacity]
        copy = with_gradient(wp.clone(array, requires_grad=False), array.grad) if copies else array
        setattr(planes, name, copy)
    return RecordedContacts(capacity, wp.clone(count) if copies else count, planes)


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
    info, model, found, total = solver.trimesh_collision_detector.collision_info, solver.model, [], 0
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


class ContactElements:
    """Elements of contacts, between particles and shapes or of self-contact, for one step at a time."""

    def __init__(self, solver: SolverVBD):
        """Takes the coefficients of VBD and its model; the first step with contacts allocates buffers."""
        self._solver, self._elements = solver, None

    def load(self, recorded: RecordedContacts | None, pairs: RecordedPairs | None, poses: Poses) -> list[Elements]:
        """Takes the contacts of a step and the poses of bodies; returns their elements, none without contacts."""
        planes = 0 if recorded is None else recorded.capacity
        count = 0 if pairs is None else len(pairs.vertices)
        elements, n, device = self._elements, planes + count, self._solver.model.device
        if not n:
            return []
        if elements is None or len(elements.vertices) < n:
            spare = n // 2 if device.is_cpu else 0  # elsewhere the number does not change
            vertices = wp.full((n + spare, 4), -1, dtype=int, device=device)
            elements = self._elements = Elements(contact_forces, vertices, [])
        elements.count, settings = n, self._settings()
        settings.first_pair, settings.first_edges = planes, planes
        if recorded is not None:
            inputs, outputs = [recorded.count, recorded.planes.indices], [elements.vertices]
            wp.launch(element_kernels.set_contact_vertices, (planes, 4), inputs=inputs, outputs=outputs, device=device)
        if pairs is not None and count:
            settings.first_edges = planes + pairs.triangles
            wp.copy(elements.vertices[planes:n], pairs.vertices)
        of_planes = ContactPlanes() if recorded is None else recorded.planes
        elements.parameters = [elements.vertices, of_planes, settings, poses.end, poses.start]
        return [elements]

    def _settings(self):
        solver, model, settings = self._solver, self._solver.model, ContactSettings()
        settings.ke, settings.kd, settings.mu = model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu
        settings.friction_velocity = solver.friction_epsilon
        settings.has_barrier = int(vbd_switch(solver, "rigid_soft_contact_use_log_barrier"))
        settings.particle_radius = model.particle_radius
        settings.shape_ke, settings.shape_kd = model.shape_material_ke, model.shape_material_kd
        settings.shape_mu, settings.shape_margin = model.shape_material_mu, model.shape_margin
        settings.shape_body = model.shape_body
        if solver.particle_enable_self_contact:
            settings.distance = solver.particle_self_contact_margin
            settings.least_edge_squared = solver.trimesh_collision_detector.edge_edge_parallel_epsilon
        return settings
