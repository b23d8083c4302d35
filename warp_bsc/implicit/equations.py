"""The equations that a step of VBD solves, and their derivatives.

At the end x1 of a step the forces on each particle balance: inertia m / dt^2 (x0 + dt v0 + dt^2 (g + f / m) - x1), and
the forces of elements. Let A = -d forces / d x1. By the implicit function theorem, a gradient g with respect to x1
becomes the gradient of l . forces with respect to everything that the forces depend on, where A^T l = g.
"""

from typing import NamedTuple

import warp as wp
from newton import ParticleFlags
from newton.solvers import SolverVBD

from ..response.adjoint.arrays import launch_adjoint
from . import energies, kernels
from .attachments import Attachments
from .bodies import Poses
from .contacts import ContactElements, RecordedContacts, RecordedPairs
from .elastic import Elastic
from .elements import Elements, with_gradient
from .matrix import StepMatrix
from .matrix_kernels import Matrix
from .worlds import Worlds


class Step(NamedTuple):
    """What a step began and ended with.

    Attributes:
        dt: Length of the step [s].
        x0: Positions at the start [m], vec3, shape [particle_count], like all that follow.
        v0: Velocities at the start [m/s].
        x1: Positions at the end [m].
        force: External forces [N], or None.
        contacts: Contacts with shapes, or None.
        pairs: Pairs of self-contact, or None.
        poses: Poses of bodies.
    """

    dt: float
    x0: wp.array
    v0: wp.array
    x1: wp.array
    force: wp.array | None
    contacts: RecordedContacts | None
    pairs: RecordedPairs | None
    poses: Poses


class Equations:
    """The forces on the particles of a model, and their derivatives, for one step at a time.

    Attributes:
        forces: Sum of the forces on each particle, 0 for fixed ones [N], vec3d, shape [particle_count].
        matrix: What :meth:`differentiate` computed.
        elastic: The elastic forces.
        is_fixed: 1 for particles that VBD does not move, 2 for those that an attachment holds, int32; 0 for others.
    """

    def __init__(self, solver: SolverVBD, worlds: Worlds):
        """Allocates buffers for VBD of a model with particles, and the worlds of these."""
        model = self.model = solver.model
        self.device, n = model.device, model.particle_count
        self._x1, self._x0, self._of_x1, self._of_x0, self.forces = (self.zeros() for _ in range(5))
        self.is_fixed = wp.zeros(n, dtype=int, device=self.device)
        self._attachments = Attachments(model, self.is_fixed)
        self.elastic = Elastic(model)
        self._contacts = ContactElements(solver)
        self._in_contact: list[Elements] = []
        self._matrix = StepMatrix(self.elastic, self._attachments.springs, self.is_fixed, worlds)
        self._step: Step | None = None
        self.matrix: Matrix | None = None

    def zeros(self) -> wp.array:
        """Returns a zero vector of float64 for each particle."""
        return wp.zeros(self.model.particle_count, dtype=wp.vec3d, device=self.device)

    def load(self, step: Step) -> None:
        """Takes a step."""
        self._step = step
        inputs = [self.model.particle_flags, int(ParticleFlags.ACTIVE), self.model.particle_mass]
        self._launch(kernels.find_fixed, inputs, [self.is_fixed])
        self._launch(kernels.to_double, [step.x0], [self._x0])
        self._attachments.load(step.poses)
        self._in_contact = self._contacts.load(step.contacts, step.pairs, step.poses)
        self.load_end(step.x1)

    def load_end(self, x1: wp.array) -> None:
        """Takes another end of the step."""
        self._launch(kernels.to_double, [x1], [self._x1])
        for elements in [*self.elements(), *self._attachments.holds]:
            elements.load(self._x1, self._x0)

    def evaluate(self) -> wp.array:
        """Returns the forces, which vanish where the step is solved."""
        assert self._step is not None
        self._launch(energies.inertial_forces, self._inertial(self._x1, self._x0), [self.forces])
        self.elastic.add_forces(self._step.dt, self._x1, self._x0, self.forces)
        for elements in self.elements():
            elements.add_forces(self._step.dt, self.forces)
        self._launch(kernels.clear_fixed, [self.is_fixed], [self.forces])
        for elements in self._attachments.holds:
            elements.add_forces(self._step.dt, self.forces)
        return self.forces

    def differentiate(self, *, transposed: bool) -> None:
        """Computes the matrix A, the derivative of minus the forces, or A^T."""
        assert self._step is not None
        dt, mass = self._step.dt, self.model.particle_mass
        self.elastic.differentiate(dt, self._x1, self._x0)
        for elements in self.elements():
            elements.differentiate(dt)
        assert mass is not None
        self.matrix = self._matrix.assemble(dt, mass, self._in_contact, transposed=transposed)

    def add_gradients(
        self, multipliers: wp.array, of_end: wp.array, of_velocity: wp.array | None, of_force: wp.array | None
    ) -> tuple[wp.array, wp.array]:
        """Adds the gradients with respect to all that forces depend on, and returns those with respect to positions.

        Args:
            multipliers: Gradients with respect to the forces, l above, vec3d. Those of particles that attachments hold
                follow from the others, and are written here.
            of_end: Gradients with respect to positions at the end, g above, vec3d.
            of_velocity: The array to add to for velocities at the start, vec3; None for none.
            of_force: The array to add to for external forces, vec3; None for none.

        Returns:
            The gradients with respect to positions at the end and at the start, vec3d, which the next call overwrites.
        """
        assert self._step is not None
        for array in (self._of_x1, self._of_x0):
            array.zero_()
        x1, x0 = with_gradient(self._x1, self._of_x1), with_gradient(self._x0, self._of_x0)
        inputs = self._inertial(x1, x0, of_velocity, of_force)
        launch_adjoint(energies.inertial_forces, len(x1), inputs, [multipliers], self.device)
        self.elastic.add_gradients(self._step.dt, x1, x0, multipliers)
        for elements in self.elements():
            elements.add_gradients(self._step.dt, multipliers, self._of_x1, self._of_x0)
        for elements in self._attachments.holds:
            inputs = [wp.float64(self._step.dt), self.model.particle_mass, self.is_fixed, of_end, self._of_x1]
            self._launch(kernels.hold_multipliers, inputs, [multipliers])
            elements.add_gradients(self._step.dt, multipliers, self._of_x1, self._of_x0)
        return self._of_x1, self._of_x0

    def elements(self) -> list[Elements]:
        """Returns the springs of attachments, and all that is in contact in the step."""
        return [*self._attachments.springs, *self._in_contact]

    def _inertial(self, x1, x0, of_velocity=None, of_force=None):
        step, model = self._step, self.model
        assert step is not None
        velocity = with_gradient(step.v0, of_velocity)
        force = None if step.force is None else with_gradient(step.force, of_force)
        masses = model.particle_mass, model.particle_inv_mass
        inputs = [wp.float64(step.dt), x1, x0, velocity, force, *masses]
        return [*inputs, model.gravity, model.particle_world, self.is_fixed]

    def _launch(self, kernel, inputs, outputs):
        wp.launch(kernel, self.model.particle_count, inputs=inputs, outputs=outputs, device=self.device)
