"""The equations that a converged step solves, and their derivatives.

At the end x1 of a step the forces on each unknown balance: inertia, elasticity, attachments, barriers and friction. Let
A = -d forces / d x1. By the implicit function theorem, a gradient g with respect to x1 becomes the gradient of
l . forces with respect to everything that forces depend on, where A^T l = g. A is that of the forces as they are:
elements are not made positive definite, closest points move, and friction follows its load, so that it is not
symmetric.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..._private_names.of_newton import attachment_arrays
from ...response.state.planes import MovingPlanes
from ...response.state.structs import Motion
from ..contact.newton_method import NewtonMethod
from ..contact.pairs import BarrierSettings
from . import energies, kernels
from .arrays import launch_adjoint, with_gradient
from .bodies import ContactsOnBodies, find_arms, inertial_forces_on_bodies
from .contact_forces import RecordedContacts, contact_forces, contact_jacobians
from .elastic import Elastic
from .elements import Elements
from .matrix import StepMatrix
from .matrix_kernels import Matrix


class SolvedBodies(NamedTuple):
    """Bodies that a step has solved for.

    Attributes:
        is_solved: 1 for those, int32, shape [body_count], like all that follow.
        velocities: Velocities at the start of the step.
        force: External forces, or None.
        goals, goal_velocities: Where inertia leads them, and their velocities there.
    """

    is_solved: wp.array
    velocities: wp.array
    force: wp.array | None
    goals: wp.array
    goal_velocities: wp.array


class SolvedStep(NamedTuple):
    """What a step began and ended with. Arrays of vertices are vec3d.

    Attributes:
        dt: Length of the step [s].
        x0, x1: Positions of vertices at both ends [m].
        v0: Velocities of particles at the start [m/s].
        force: External forces [N], vec3, or None.
        is_fixed: 1 for unknowns that are not solved for.
        vertices, rows: Corners of contacts and their unknowns, -1 for none, int32, shape [n, 4].
        contacts: The same contacts.
        motion, planes, settings: What barriers and friction depend on; with the gradients that are wanted.
        poses: Poses of bodies at the end and at the start, None without bodies.
        bodies: Those that are solved for, None if none can be.
    """

    dt: float
    x0: wp.array
    x1: wp.array
    v0: wp.array
    force: wp.array | None
    is_fixed: wp.array
    vertices: wp.array
    rows: wp.array
    contacts: RecordedContacts
    motion: Motion
    planes: MovingPlanes
    settings: BarrierSettings
    poses: tuple[wp.array | None, wp.array | None]
    bodies: SolvedBodies | None


class StepEquations:
    """The derivatives of the forces on the unknowns of a solver, for one step at a time.

    Attributes:
        count: Number of unknowns.
        elastic: Elastic forces.
        attachments: Attachments of the model, None without any.
        unknown: Unknown of each particle.
        of_bodies: First unknown of each body, -1 for none; None if no body is solved for.
        world: World of each unknown.
    """

    def __init__(self, newton: NewtonMethod):
        """Allocates buffers for steps of a solver, whose unknowns they have."""
        self._newton, model = newton, newton.mesh.model
        self.model, self.device, self.count = model, model.device, len(newton.problem.unknowns.particle)
        self._unknowns = unknowns = newton.problem.unknowns
        self._inertia = wp.zeros(self.count, dtype=wp.float64, device=self.device)
        unknown = unknowns.of_vertex.numpy()[: model.particle_count]
        self.unknown = unknowns.of_vertex[: model.particle_count]
        self.elastic = Elastic(model, unknown, self.count)
        self.attachments: Any = attachment_arrays(model)
        self._springs: list[Elements] = []
        if self.attachments is not None:
            particles = self.attachments.particle
            rows = wp.array(unknown[particles.numpy()].reshape(-1, 1), dtype=int, device=self.device)
            self._springs = [Elements(energies.attachment_forces, particles.reshape((-1, 1)), rows)]
        of_bodies = newton.problem.bodies.unknown
        self.of_bodies = of_bodies if len(of_bodies) else None
        self._inertia_of_bodies: Elements | None = None
        if self.of_bodies is not None:
            self._inertia_of_bodies = self._elements_of_bodies(of_bodies.numpy())
        of_worlds = unknowns.of_worlds.numpy()
        world = np.repeat(np.arange(len(of_worlds) - 1), np.diff(of_worlds))
        self.world = wp.array(world.astype(np.int32), dtype=int, device=self.device)
        self._is_fixed = wp.zeros(self.count, dtype=int, device=self.device)
        self._matrix = StepMatrix(self.elastic, self._of_one_unknown(), self._is_fixed)
        self._contacts: Elements | None = None
        self._in_contact: Elements | None = None  # those of the step, if it has any
        self._step: SolvedStep | None = None

    def _elements_of_bodies(self, unknown):
        """Returns elements of the inertia of shifts and turns of bodies, at changes of 0."""
        bodies = np.flatnonzero(unknown >= 0)
        arrays = np.repeat(bodies, 2), np.tile([0, 1], len(bodies)), np.ravel(unknown[bodies, None] + np.arange(2))
        self._body, self._is_turn, rows = (wp.array(a.astype(np.int32), dtype=int, device=self.device) for a in arrays)
        vertices = wp.full((len(rows), 1), -1, dtype=int, device=self.device)
        return Elements(inertial_forces_on_bodies, vertices, rows.reshape((-1, 1)))

    def _of_one_unknown(self):
        return self._springs if self._inertia_of_bodies is None else [*self._springs, self._inertia_of_bodies]

    @property
    def step(self) -> SolvedStep:
        """The step that was loaded."""
        assert self._step is not None
        return self._step

    def load(self, step: SolvedStep) -> None:
        """Takes a step."""
        self._step = step
        wp.copy(self._is_fixed, step.is_fixed)
        inputs = [wp.float64(step.dt), self.model.particle_inv_mass, self._unknowns.particle, step.is_fixed]
        wp.launch(kernels.inertia_of, self.count, inputs=inputs, outputs=[self._inertia], device=self.device)
        for springs in self._springs:
            attached = self.attachments
            parameters = [attached.body, attached.body_point, attached.stiffness, attached.damping, attached.enabled]
            springs.parameters = [*parameters, *step.poses]
        if self._inertia_of_bodies is not None and step.bodies is not None:
            parameters = [self._body, self._is_turn, step.poses[0], step.bodies.goals, step.motion.bodies]
            self._inertia_of_bodies.parameters = parameters
        self._in_contact = self._load_contacts(step)
        for elements in self.elements():
            elements.load(step.x1, step.x0)

    def _load_contacts(self, step):
        count, elements = len(step.vertices), self._contacts
        if not count:
            return None
        if elements is None or len(elements.vertices) < count:
            capacity = count + (count // 2 if self.device.is_cpu else 0)  # elsewhere the number does not change
            of_type, size = (Elements, 4) if self.of_bodies is None else (ContactsOnBodies, 8)
            sizes = (capacity, 4), (capacity, size)
            vertices, rows = (wp.full(shape, -1, dtype=int, device=self.device) for shape in sizes)
            elements = self._contacts = of_type(contact_forces, vertices, rows, jacobians=contact_jacobians)
        elements.count = count
        wp.copy(elements.vertices[:count], step.vertices)
        wp.copy(elements.rows[:count], step.rows)
        elements.parameters = [elements.vertices, step.contacts, step.motion, step.planes, step.settings]
        if isinstance(elements, ContactsOnBodies):
            mesh = self._newton.mesh
            inputs = [elements.vertices, elements.rows, step.x1, step.motion.bodies, step.poses[0]]
            inputs += [mesh.device_shape_vertices.body, mesh.model.particle_count]
            wp.launch(find_arms, (count, 4), inputs=inputs, outputs=[elements.arms], device=self.device)
        return elements

    def differentiate(self, *, transposed: bool) -> Matrix:
        """Returns the matrix A, the derivative of minus the forces, or A^T."""
        step = self.step
        self.elastic.differentiate(step.dt, step.x1, step.x0)
        for elements in self.elements():
            elements.differentiate(step.dt)
        return self._matrix.assemble(self._inertia, self._in_contact, transposed=transposed)

    def add_gradients(self, multipliers: wp.array, of_x1: wp.array, of_x0: wp.array, of_v0: wp.array, of_force) -> None:
        """Adds the gradients with respect to all that forces depend on.

        Args:
            multipliers: Gradients with respect to the forces, l above, vec3d; 0 where these are fixed.
            of_x1: The array to add to for positions of vertices at the end, vec3d.
            of_x0: The same for those at the start.
            of_v0: The same for velocities of particles at the start.
            of_force: The same for external forces, vec3; None for none.
        """
        step = self.step
        x1, x0, v0 = with_gradient(step.x1, of_x1), with_gradient(step.x0, of_x0), with_gradient(step.v0, of_v0)
        inputs = self.inertial(x1, x0, v0, of_force)
        launch_adjoint(energies.inertial_forces, self.count, inputs, [multipliers], self.device)
        self.elastic.add_gradients(step.dt, x1, x0, multipliers)
        for elements in self.elements():
            elements.add_gradients(step.dt, multipliers, of_x1, of_x0)

    def elements(self) -> list[Elements]:
        """Returns the elements of the step, but for elastic ones."""
        return [*self._of_one_unknown(), *([] if self._in_contact is None else [self._in_contact])]

    def inertial(self, x1: wp.array, x0: wp.array, v0: wp.array, of_force: wp.array | None = None) -> list:
        """Returns the inputs of :func:`.energies.inertial_forces`, at positions and velocities."""
        step, model = self.step, self.model
        force = None if step.force is None else with_gradient(step.force, of_force)
        inputs = [wp.float64(step.dt), x1, x0, v0, force, model.particle_inv_mass, model.gravity]
        return [*inputs, model.particle_world, self._unknowns.particle, step.is_fixed]
