"""Attachments of particles to bodies: springs as elements, and particles that hard attachments hold."""

import newton
import numpy as np
import warp as wp

from .._private_names.of_newton import attachment_arrays
from . import kernels
from .bodies import Poses
from .contact_forces import attachment_forces, hold_forces
from .elements import Elements, without_gradients


class Attachments:
    """Attachments of a model, for one step at a time.

    One of finite stiffness is a spring. One of infinite stiffness holds its particle: the particle ends the step at a
    point of the body, and no force moves it. Instead of the force on it, the equations have the offset from that point
    times m / dt^2, which is the force that moves it there.

    Attributes:
        springs: Elements of all attachments, without forces where the stiffness is infinite; none without attachments.
        holds: Elements of all attachments, with forces only where the stiffness is infinite; none without attachments.
    """

    def __init__(self, model: newton.Model, is_fixed: wp.array):
        """Takes a model, and which of its particles are fixed, see :attr:`.equations.Equations.is_fixed`."""
        self._model, self._is_fixed = model, is_fixed
        self.springs: list[Elements] = []
        self.holds: list[Elements] = []
        found = attachment_arrays(model)
        if found is None:
            return
        particles, body, point, stiffness, damping, enabled = found
        vertices = particles.reshape((-1, 1))
        self.springs = [Elements(attachment_forces, vertices, [body, point, stiffness, damping, enabled, None, None])]
        mass = without_gradients(model.particle_mass)  # a scale of the force that is left, on which no end depends
        self.holds = [
            Elements(hold_forces, vertices, [body, point, stiffness, enabled, vertices, mass, is_fixed, None])
        ]

    def load(self, poses: Poses) -> None:
        """Takes the poses of a step, and adds the particles that attachments hold to those that are fixed."""
        for elements in self.springs:
            elements.parameters[-2:] = poses.end, poses.start
        for elements in self.holds:
            elements.parameters[-1] = poses.end
            _, _, stiffness, enabled, vertices, *_ = elements.parameters
            inputs = [vertices, stiffness, enabled]
            outputs = [self._is_fixed]
            wp.launch(kernels.find_held, elements.count, inputs=inputs, outputs=outputs, device=elements.device)


def check_attachments(model: newton.Model) -> None:
    """Raises an error if several attachments hold one particle, reading them from the device.

    Raises:
        NotImplementedError: If they do.
    """
    found = attachment_arrays(model)
    if found is None:
        return
    held = found.particle.numpy()[np.isinf(found.stiffness.numpy()) & found.enabled.numpy().astype(bool)]
    if len(np.unique(held)) < len(held):
        raise NotImplementedError("solver: several attachments of infinite stiffness hold one particle of the model")
