"""Contacts of particles with rigid shapes: what a step saw of them, and their elements."""

from typing import NamedTuple

import newton
import warp as wp
from newton.solvers import SolverVBD

from . import element_kernels
from .bodies import Poses
from .contact_forces import ContactPlanes, ContactSettings, contact_forces
from .elements import Elements, with_gradient

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


class ContactElements:
    """Elements of contacts between particles and shapes, for one step at a time."""

    def __init__(self, solver: SolverVBD):
        """Takes the coefficients of VBD and its model; the first step with contacts allocates buffers."""
        self._solver, self._elements = solver, None

    def load(self, recorded: RecordedContacts | None, poses: Poses) -> list[Elements]:
        """Takes the contacts of a step and the poses of bodies; returns their elements, none without contacts."""
        if recorded is None:
            return []
        elements, n = self._elements, recorded.capacity
        if elements is None or len(elements.vertices) < n:
            vertices = wp.full((n + n // 2, 3), -1, dtype=int, device=recorded.count.device)
            elements = self._elements = Elements(contact_forces, vertices, [])
        elements.count = n
        inputs = [recorded.count, recorded.planes.indices]
        wp.launch(
            element_kernels.set_contact_vertices,
            (n, 3),
            inputs=inputs,
            outputs=[elements.vertices],
            device=elements.device,
        )
        elements.parameters = [
            elements.vertices,
            recorded.planes,
            self._settings(),
            poses.end,
            poses.start,
        ]
        return [elements]

    def _settings(self):
        solver, model, settings = self._solver, self._solver.model, ContactSettings()
        settings.ke, settings.kd, settings.mu = model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu
        settings.friction_velocity = solver.friction_epsilon
        settings.has_barrier = int(solver.rigid_soft_contact_use_log_barrier)
        settings.particle_radius = model.particle_radius
        settings.shape_ke, settings.shape_kd = model.shape_material_ke, model.shape_material_kd
        settings.shape_mu, settings.shape_margin = model.shape_material_mu, model.shape_margin
        settings.shape_body = model.shape_body
        return settings
