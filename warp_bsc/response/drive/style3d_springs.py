"""Contacts inside the solve of Style3D: each of its iterations sees the constraints, as stiff springs.

Before a step, the contacts of particles that fly on are detected. They and the proximities become constraints, planes
at the times of impact, which Style3D gets in place of contacts of its own: forces that push, with friction, and their
derivatives. The motion that Style3D predicts therefore nearly meets the contacts, and its whole step is in equilibrium
with them. What remains, the stage detects and resolves as ever.

On the CPU, where threads of the detection find contacts in any order, constraints are sorted once a step by a hash of
all that their forces depend on: forces are added up in the same order in equal steps, bit for bit. On a GPU they are
added up in any order, and so are the forces of Style3D itself.

The springs are implicit, and add no energy. Multipliers in their place (an augmented Lagrangian) would meet the
contacts closer, but those of the first iterations threw sheets apart.
"""

import functools
from typing import Any

import newton
import warp as wp

from ..._private_names.of_newton import with_contacts
from ..._private_names.of_warp import paused_tape
from ...detection.run.host_function import run_on_host
from ..state.motion import ModelMotion, StateArrays, arrays_of
from ..state.structs import Constraints, Motion
from ..state.vectors import ZERO, to_double, to_single
from ..state.workspace import Workspace
from ..step import add_proximities, find_contacts
from ..tuning import INNER_STIFFNESS, SLOWEST_SLIP
from .inner_steps import InnerSteps, StepCall

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _fly_on(
    # in
    start: StateArrays,
    particle_f: wp.array[wp.vec3],
    particle_world: wp.array[int],
    gravity: wp.array[wp.vec3],
    dt: float,
    # out
    motion: Motion,
):
    """Predicts the motion of particles by their velocities, gravity and forces."""
    i = wp.tid()
    x1 = start.particle_q[i] + wp.vec3()
    velocity = start.particle_qd[i] + wp.vec3()
    if motion.inverse_mass[i] > 0.0:
        world = particle_world[i]
        acceleration = gravity[wp.where(world < 0, gravity.shape[0] - 1, world)]
        if particle_f:
            acceleration += motion.inverse_mass[i] * particle_f[i]
        velocity += dt * acceleration
        x1 += dt * velocity
    finite = wp.isfinite(x1) and wp.isfinite(velocity)
    motion.x1[i] = wp.where(finite, x1, motion.x0[i])
    motion.velocity[i] = wp.where(finite, velocity, wp.vec3())
    motion.is_not_finite[i] = wp.where(finite, 0, 1)


@wp.func
def _point(
    motion: Motion, constraints: Constraints, i: int, x: wp.array[wp.vec3], fixed: wp.array[wp.vec3]
) -> wp.vec3d:
    """Returns the vector between contact points: particles that can be moved are at ``x``, others ``fixed``."""
    point = wp.vec3d()
    for j in range(4):
        vertex = constraints.vertices[i][j]
        if motion.inverse_mass[vertex] > 0.0:
            point += constraints.weights[i][j] * to_double(x[vertex])
        else:
            point += constraints.weights[i][j] * to_double(fixed[vertex])
    return point


@wp.func
def _stiffness(motion: Motion, constraints: Constraints, i: int, dt: float) -> float:
    """Returns the stiffness of a constraint by the mass that it moves [N/m], 0 where nothing can be moved."""
    inverse_mass = float(0.0)
    for j in range(4):
        weight = float(constraints.weights[i][j])
        inverse_mass += weight * weight * motion.inverse_mass[constraints.vertices[i][j]]
    if inverse_mass > 0.0:
        return INNER_STIFFNESS / (inverse_mass * dt * dt)
    return 0.0


@wp.func
def _mixed(key: wp.uint64, bits: wp.uint64) -> wp.uint64:
    """Returns a key that also depends on some bits.

    The mixing function is that of SplitMix64: G. L. Steele, D. Lea and C. H. Flood, Fast Splittable Pseudorandom Number
    Generators, OOPSLA 2014, doi:10.1145/2660193.2660195.
    """
    mixed = key ^ bits
    mixed = (mixed ^ (mixed >> wp.uint64(30))) * wp.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> wp.uint64(27))) * wp.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> wp.uint64(31))


@wp.kernel
def _make_keys(
    # in
    constraints: Constraints,
    # out
    keys: wp.array[wp.uint64],
    order: wp.array[int],
):
    """Makes a key of each constraint, a hash of all that its forces depend on.

    Of 10,000 constraints, two that differ have the same key in one of 3e11 steps.
    """
    i = wp.tid()
    key = _mixed(wp.cast(constraints.separation[i], wp.uint64), wp.uint64(wp.cast(constraints.friction[i], wp.uint32)))
    for j in range(4):
        key = _mixed(key, wp.uint64(constraints.vertices[i][j]))
        key = _mixed(key, wp.cast(constraints.weights[i][j], wp.uint64))
    for axis in range(3):
        key = _mixed(key, wp.cast(constraints.normal[i][axis], wp.uint64))
    keys[i] = key
    order[i] = i


@wp.func
def _at(order: wp.array[int], place: int) -> int:
    """Returns the constraint at a place in the order; by its index, where there is none."""
    if order:
        return order[place]
    return place


@wp.kernel
def _add_forces(
    # in
    motion: Motion,
    constraints: Constraints,
    order: wp.array[int],
    x: wp.array[wp.vec3],
    x_before: wp.array[wp.vec3],
    dt: float,
    # out
    forces: wp.array[wp.vec3],
    diagonal: wp.array[wp.mat33],
    threads: int,
):
    """Adds the forces of constraints and the diagonal of their derivative.

    Friction acts against the slip since the start of the step, in proportion below ``SLOWEST_SLIP``. The derivatives of
    the force along the normal and across it [N/m] stand in place of the velocity multiplier, which the stage begins to
    use after the inner solver.
    """
    for place in range(wp.tid(), wp.min(constraints.count[0], constraints.vertices.shape[0]), threads):
        i = _at(order, place)
        constraints.velocity_multiplier[i] = wp.vec3d()
        stiffness = _stiffness(motion, constraints, i, dt)
        normal = to_single(constraints.normal[i])
        point = _point(motion, constraints, i, x, motion.x1)
        push = stiffness * float(constraints.separation[i] - wp.dot(constraints.normal[i], point))
        if push > 0.0:
            slip = to_single(point - _point(motion, constraints, i, x_before, motion.x0))
            slip -= wp.dot(slip, normal) * normal
            across = constraints.friction[i] * push / wp.max(wp.length(slip), SLOWEST_SLIP * dt)
            constraints.velocity_multiplier[i] = wp.vec3d(wp.float64(stiffness), wp.float64(across), ZERO)
            force = push * normal - across * slip
            normals = wp.outer(normal, normal)
            derivative = stiffness * normals + across * (wp.identity(3, float) - normals)
            for j in range(4):
                vertex = constraints.vertices[i][j]
                if motion.inverse_mass[vertex] > 0.0:
                    weight = float(constraints.weights[i][j])
                    wp.atomic_add(forces, vertex, weight * force)
                    wp.atomic_add(diagonal, vertex, weight * weight * derivative)


@wp.kernel
def _multiply(
    motion: Motion,
    constraints: Constraints,
    order: wp.array[int],
    x: wp.array[wp.vec3],
    # out
    product: wp.array[wp.vec3],
    threads: int,
):
    """Multiplies changes of positions by the derivative of the forces."""
    for place in range(wp.tid(), wp.min(constraints.count[0], constraints.vertices.shape[0]), threads):
        i = _at(order, place)
        derivatives = constraints.velocity_multiplier[i]
        if derivatives[0] > ZERO:
            normal = to_single(constraints.normal[i])
            change = wp.vec3()
            for j in range(4):
                vertex = constraints.vertices[i][j]
                if motion.inverse_mass[vertex] > 0.0:
                    change += float(constraints.weights[i][j]) * x[vertex]
            along = wp.dot(change, normal) * normal
            resisting = float(derivatives[0]) * along + float(derivatives[1]) * (change - along)
            for j in range(4):
                vertex = constraints.vertices[i][j]
                if motion.inverse_mass[vertex] > 0.0:
                    wp.atomic_add(product, vertex, float(constraints.weights[i][j]) * resisting)


class Style3DContacts:
    """The constraints of a step, with the interface of the collision handler of ``SolverStyle3D``.

    It takes the place of that attribute while Style3D steps, see
    :func:`warp_bsc._private_names.of_newton.with_contacts`.
    """

    def __init__(self, work: Workspace):
        """Allocates buffers; ``work`` is free between steps of the stage."""
        mesh, device = work.mesh, work.device
        model = mesh.model
        self._work, self._model = work, model
        self._flight = ModelMotion(mesh, work.motion.friction, last=work.motion.last)
        self._ends = wp.zeros_like(work.vertices.x1)
        self._diagonal = wp.zeros(model.particle_count, dtype=wp.mat33, device=device)
        self._product = wp.zeros(model.particle_count, dtype=wp.vec3, device=device)
        self._keys: wp.array[wp.uint64] | None = None
        self._order: wp.array[int] | None = None

    def find(self, state: newton.State, dt: float) -> None:
        """Finds the contacts of particles that fly on from a state for a step of length ``dt`` [s]."""
        work, flight, model, start = self._work, self._flight, self._model, arrays_of(state)
        motion, work.motion, last = work.motion, flight, flight.last.positions
        try:
            wp.copy(self._ends, last)
            flight.set_start(start)
            flight.set_end(start, dt)
            inputs = [start, state.particle_f, model.particle_world, model.gravity, dt]
            work.launch(_fly_on, model.particle_count, inputs, [flight.vertices])
            find_contacts(work)
            add_proximities(work)
            self._sort()
            wp.copy(last, self._ends)  # which the response overwrites
        finally:
            work.motion = motion

    def _sort(self):
        """Sorts the constraints on the CPU, whose kernels then go through them in an order that is always the same."""
        work = self._work
        if not work.device.is_cpu:
            return
        constraints = work.constraints
        count = min(int(constraints.count.numpy()[0]), len(constraints.vertices))
        if self._keys is None or len(self._keys) < 2 * count:  # the constraints have grown
            size = 2 * len(constraints.vertices)  # half of it is space for the sort
            self._keys, self._order = (wp.empty(size, dtype=kind, device=work.device) for kind in (wp.uint64, int))
        work.launch(_make_keys, count, [constraints], [self._keys, self._order])
        wp.utils.radix_sort_pairs(self._keys, self._order, count)

    def _launch(self, kernel, inputs):
        """Launches a kernel over the constraints, of which a replay of a CPU graph may have more than its capture."""
        work, flight, threads = self._work, self._flight.vertices, self._work.summing_threads

        def launch():
            work.launch(kernel, threads, [flight, work.constraints, self._order, *inputs, threads])

        run_on_host(launch, work.device)

    def frame_begin(self, *_arguments) -> None:
        """Does nothing: :meth:`find` has found the contacts."""

    linear_iteration_end = frame_end = frame_begin

    def accumulate_contact_force(
        self,
        dt: float,
        iteration: int,
        state_in: newton.State,
        state_out: newton.State,
        contacts: newton.Contacts | None,
        particle_forces: wp.array,
        particle_q_prev: wp.array,
        particle_stiff: wp.array | None = None,
    ) -> None:
        """Adds the forces of an iteration [N], whose positions are those of ``state_in``."""
        self._diagonal.zero_()
        self._launch(_add_forces, [state_in.particle_q, particle_q_prev, dt, particle_forces, self._diagonal])

    def contact_hessian_diagonal(self) -> wp.array:
        """Returns the blocks on the diagonal of the derivative of the forces [N/m], shape [particle_count]."""
        return self._diagonal

    def hessian_multiply(self, x: wp.array) -> wp.array:
        """Returns the product of the derivative of the forces with changes of positions [N], shape [particle_count]."""
        self._product.zero_()
        self._launch(_multiply, [x, self._product])
        return self._product


class SpringSteps(InnerSteps):
    """Lets Style3D step with the constraints of the stage in place of its own contacts."""

    pushes_before: str | None = "SolverStyle3D pushes in its iterations"

    def __init__(self, stage: Any, work: Workspace):
        """Allocates buffers; ``work`` is free between steps of the stage."""
        super().__init__(stage)
        self._contacts, self._device = Style3DContacts(work), work.device

    def take(self, call: StepCall) -> None:
        """Finds the contacts of particles that fly on, and steps Style3D with them."""
        with paused_tape():
            run_on_host(functools.partial(self._contacts.find, call.state_in, call.dt), self._device)
        with with_contacts(self._stage.solver, self._contacts):
            super().take(call)
