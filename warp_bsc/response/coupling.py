"""Coupling: in steps with contacts, the inner solver takes substeps, between which contacts are projected.

A step that collides is taken again from its start in substeps: the inner solver steps, and a projection onto the
contacts of the whole step follows. So the elastic solve of each substep begins with positions and velocities that have
felt the contacts, and pulls against them for a fraction of the step only. The stretch between solver and contacts falls
with the length of the substep. Contacts are detected once, before the substeps; the motion of the whole step is
detected and certified after them.

With ``"auto"`` a step is resolved as without coupling first. Only where contacts strain an element by more than
``STRAIN`` against what the inner solver wanted, it is taken again, in the least number of ``SUBSTEPS`` that brings the
strain below, if that is in proportion to the length of a substep. The number follows from the step alone, not from
those before.

Contacts that a program passes on are shared out before the step, see :mod:`.inner_contacts`: whole steps and substeps
get the same ones. Those between bodies were found at the start of the step, and remain for all substeps.

References:
    M. Macklin, K. Storey, M. Lu, P. Terdiman, N. Chentanez, S. Jeschke and M. Mueller, Small Steps in Physics
    Simulation, Symposium on Computer Animation, 2019, doi:10.1145/3309486.3340247.
"""

from collections.abc import Callable, Sequence

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD

from .buffers import Constraints, Motion, Progress, Vertices
from .constraints import PLANE_CONTACT, approach_of
from .model_mesh import ModelMesh
from .model_motion import ModelMotion, moves_with_body, wanted_velocity
from .response import Resolution, Response

__all__ = ["STRAIN", "SUBSTEPS", "Coupling", "edges_at_rest"]

SUBSTEPS = (2, 4, 8, 16, 32)
"""Numbers of substeps that ``"auto"`` chooses from; a CUDA graph contains the substep of each."""
STRAIN = 0.01
"""Strain by contacts that ``"auto"`` leaves to a substep: elongation of an edge of cloth beyond its length at rest, or
change of the length of an edge in a soft body, as a share of that length."""

_ALLOCATION_FREE = (SolverVBD, SolverStyle3D)
"""Solvers whose steps allocate no memory, which the body of a condition in a CUDA graph cannot; others may."""
_STRAIN = wp.constant(STRAIN)
_COMPRESSION = wp.constant(0.25)
"""What compression of cloth counts, as a share of the same elongation."""
_UNCOUPLED = wp.constant(-2)
"""Iteration of the last contact of a world without constraints, so that no projection moves its vertices."""
_NEVER_VIOLATED = wp.constant(wp.float64(-1e30))

_KERNEL = {"enable_backward": False}


@wp.kernel(**_KERNEL)
def _use_substeps(unfinished: wp.array[int], number: int, substeps: wp.array[int]):
    """Writes the number of substeps of a step that collides; 0 of others."""
    substeps[0] = number * unfinished[0]


@wp.kernel(**_KERNEL)
def _measure_strain(
    # in
    motion: Motion,
    x1: wp.array[wp.vec3],
    edges: wp.array[wp.vec2i],
    lengths: wp.array[float],
    is_solid: wp.array[bool],
    # out
    strain: wp.array[float],
):
    """Finds the largest strain of an edge, in each world, between wanted positions and ``x1``.

    Cloth that is compressed buckles, and resists less than cloth that is stretched: a quarter of its compression
    counts.
    """
    i = wp.tid()
    a = edges[i][0]
    b = edges[i][1]
    wanted = wp.length(motion.x1[a] - motion.x1[b])
    length = wp.length(x1[a] - x1[b])
    change = wp.max(length - wp.max(wanted, lengths[i]), _COMPRESSION * (wp.min(wanted, lengths[i]) - length))
    if is_solid[i]:
        change = wp.abs(length - wanted)
    if change > 0.0:
        wp.atomic_max(strain, motion.world[a], change / lengths[i])


@wp.kernel(**_KERNEL)
def _choose_substeps(
    # in
    strain: wp.array[float],
    choices: wp.array[int],
    # in and out
    progress: Progress,
    # out
    number: wp.array[int],
    is_chosen: wp.array[int],
    substeps: wp.array[int],
):
    """Chooses the number of substeps of each world, 0 where contacts strain little; ``substeps`` is the largest."""
    world = wp.tid()
    progress.status.recount[0] = 0  # the start remains where crossings are counted
    wanted = strain[world] / _STRAIN
    number[world] = 0
    if wanted > 1.0:
        choice = int(0)
        while choice < choices.shape[0] - 1 and float(choices[choice]) < wanted:
            choice += 1
        number[world] = choices[choice]
        is_chosen[choice] = 1
        wp.atomic_max(substeps, 0, choices[choice])


@wp.kernel(**_KERNEL)
def _find_worlds(motion: Motion, constraints: Constraints, has_constraints: wp.array[int]):
    """Marks the worlds that have constraints."""
    i = wp.tid()
    if i < constraints.count[0]:
        has_constraints[motion.world[constraints.vertices[i][0]]] = 1


@wp.kernel(**_KERNEL)
def _keep_counts(constraints: Constraints, progress: Progress, detected: wp.array[int]):
    """Keeps the numbers of constraints and contacts."""
    detected[0] = constraints.count[0]
    detected[1] = progress.status.first_hits[0]
    progress.status.recount[0] = 0  # the start remains where crossings are counted


@wp.kernel(**_KERNEL)
def _begin_substeps(
    # in
    has_constraints: wp.array[int],
    number: wp.array[int],
    substeps: int,
    # in and out
    progress: Progress,
    # out
    is_coupled: wp.array[int],
    remaining: wp.array[int],
):
    """Marks the worlds that have constraints and take this number of substeps, and starts the count."""
    world = wp.tid()
    if world == 0:
        remaining[0] = substeps
    is_coupled[world] = wp.where(number[world] == substeps, has_constraints[world], 0)
    progress.contact_iteration[world] = wp.where(is_coupled[world] == 1, 0, _UNCOUPLED)


@wp.kernel(**_KERNEL)
def _start_substep(
    # in
    motion: Motion,
    start: wp.array[wp.vec4d],
    end: wp.array[wp.vec4d],
    substeps: int,
    dt: float,
    remaining: wp.array[int],
    detected: wp.array[int],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    # in and out
    substep: Motion,
    constraints: Constraints,
    progress: Progress,
    # out
    substep_start: wp.array[wp.vec4d],
    substep_end: wp.array[wp.vec4d],
    vertices: Vertices,
):
    """Writes the motion of a substep.

    Particles, and bodies that the response can move, go where the inner solver wants them, shapes a share of their way.
    """
    i = wp.tid()
    before = float(substeps - remaining[0]) / float(substeps)
    after = float(substeps - remaining[0] + 1) / float(substeps)
    if i == 0:
        constraints.count[0] = detected[0]
        progress.status.iteration[0] = 0
    if i < start.shape[0]:
        substep_start[i] = start[i] + wp.float64(before) * (end[i] - start[i])
        substep_end[i] = start[i] + wp.float64(after) * (end[i] - start[i])
    if i >= motion.x0.shape[0]:
        return
    lost = int(0)
    if i < particle_q.shape[0]:
        x0 = substep.x0[i]
        x1 = particle_q[i]
        velocity = particle_qd[i]
        if not (wp.isfinite(x1) and wp.isfinite(velocity)):
            x1 = x0
            velocity = wp.vec3()
            lost = 1
    elif moves_with_body(substep, i):
        x0 = substep.x0[i]
        place = i - motion.bodies.particle_count
        x1 = wp.transform_point(substep.bodies.end[motion.bodies.of_vertex[i]], motion.bodies.position[place])
        velocity = wanted_velocity(substep, i, x1)
    else:
        path = motion.x1[i] - motion.x0[i]
        x0 = motion.x0[i] + before * path
        x1 = motion.x0[i] + after * path
        velocity = path / dt
        substep.x0[i] = x0
    substep.x1[i] = x1
    substep.velocity[i] = velocity
    substep.is_lost[i] = lost
    vertices.x1[i] = x1
    vertices.velocity[i] = velocity
    vertices.outcome[i] = 0
    vertices.active[i] = 0
    for axis in range(3):
        vertices.particle_delta_x[i, axis] = wp.int64(0)
        vertices.particle_delta_v[i, axis] = wp.int64(0)


@wp.kernel(**_KERNEL)
def _reset_constraints(
    # in
    substep: Motion,
    vertices: Vertices,
    detected: wp.array[int],
    # in and out
    constraints: Constraints,
    progress: Progress,
):
    """Prepares constraints for the sweeps of a substep; those of planes are collected anew in each substep."""
    i = wp.tid()
    if i == 0:
        progress.status.iteration[0] = 1
        progress.status.active[0] = 0  # positions and velocities are swept without regard to a detection
    if i >= constraints.count[0]:
        return
    constraints.position_multiplier[i] = wp.vec3d()
    constraints.velocity_multiplier[i] = wp.vec3d()
    constraints.previous_multiplier[i] = wp.vec3d()
    constraints.last_sweep[i] = -2
    if i < detected[0] and constraints.kind[i] == PLANE_CONTACT:
        constraints.separation[i] = _NEVER_VIOLATED
        return
    corners = constraints.vertices[i]
    constraints.approach[i] = approach_of(
        substep, vertices, corners, constraints.weights[i], constraints.normal[i], constraints.separation[i]
    )


@wp.kernel(**_KERNEL)
def _end_substep(
    # in
    vertices: Vertices,
    # in and out
    remaining: wp.array[int],
    # out
    substep: Motion,
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Makes the end of a substep the start of the next."""
    vertex = wp.tid()
    if vertex == 0:
        remaining[0] = remaining[0] - 1
    if vertex < particle_q.shape[0]:
        substep.x0[vertex] = vertices.x1[vertex]
        particle_q[vertex] = vertices.x1[vertex]
        particle_qd[vertex] = vertices.velocity[vertex]
    elif moves_with_body(substep, vertex):
        substep.x0[vertex] = vertices.x1[vertex]


@wp.kernel(**_KERNEL)
def _end_body_substep(
    # in
    substep: Motion,
    vertices: Vertices,
    # out
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_q_prev: wp.array[wp.transform],
):
    """Makes the poses and velocities at the end of a substep those at the start of the next."""
    body = wp.tid()
    if substep.bodies.inverse_mass[body] > 0.0:
        body_q[body] = vertices.bodies.pose[body]
        body_qd[body] = vertices.bodies.velocity[body]
        if body_q_prev:
            body_q_prev[body] = vertices.bodies.pose[body]


@wp.kernel(**_KERNEL)
def _move_bodies(
    # in
    motion: Motion,
    body_q_start: wp.array[wp.transform],
    body_q_end: wp.array[wp.transform],
    substeps: int,
    remaining: wp.array[int],
    # out
    body_q_in: wp.array[wp.transform],
    body_q_out: wp.array[wp.transform],
):
    """Writes poses at both ends of a substep, between those of the whole step, of bodies that cannot be moved."""
    body = wp.tid()
    if motion.bodies.of_vertex:
        if motion.bodies.inverse_mass[body] > 0.0:
            return
    for end in range(2):
        share = float(substeps - remaining[0] + end) / float(substeps)
        start_pose = body_q_start[body]
        end_pose = body_q_end[body]
        p = wp.transform_get_translation(start_pose)
        p += share * (wp.transform_get_translation(end_pose) - p)
        r = wp.quat_slerp(wp.transform_get_rotation(start_pose), wp.transform_get_rotation(end_pose), share)
        if end == 0:
            body_q_in[body] = wp.transform(p, r)
        else:
            body_q_out[body] = wp.transform(p, r)


@wp.kernel(**_KERNEL)
def _end_substeps(
    # in
    is_coupled: wp.array[int],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    # in and out
    motion: Motion,
    # out
    particle_q_out: wp.array[wp.vec3],
    particle_qd_out: wp.array[wp.vec3],
    vertices: Vertices,
):
    """Makes the substeps the wanted motion, in worlds that have constraints, and puts vertices back to the start."""
    particle = wp.tid()
    vertices.x1[particle] = motion.x0[particle]
    if particle >= particle_q.shape[0]:
        return
    if is_coupled[motion.world[particle]] == 0 or motion.is_lost[particle] != 0 or motion.inverse_mass[particle] == 0.0:
        return
    motion.x1[particle] = particle_q[particle]
    motion.velocity[particle] = particle_qd[particle]
    particle_q_out[particle] = particle_q[particle]
    particle_qd_out[particle] = particle_qd[particle]


@wp.kernel(**_KERNEL)
def _end_body_substeps(
    # in
    is_coupled: wp.array[int],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    # in and out
    motion: Motion,
    # out
    body_q_out: wp.array[wp.transform],
    body_qd_out: wp.array[wp.spatial_vector],
):
    """Makes the poses after the substeps the wanted ones, in worlds that have constraints."""
    body = wp.tid()
    if motion.bodies.inverse_mass[body] == 0.0 or is_coupled[wp.max(motion.bodies.world[body], 0)] == 0:
        return
    motion.bodies.end[body] = body_q[body]
    motion.bodies.velocity[body] = body_qd[body]
    body_q_out[body] = body_q[body]
    body_qd_out[body] = body_qd[body]


@wp.kernel(**_KERNEL)
def _place_bodies(motion: Motion):
    """Writes the wanted positions and velocities of the vertices of bodies."""
    place = wp.tid()
    vertex = motion.bodies.particle_count + place
    if moves_with_body(motion, vertex):
        x1 = wp.transform_point(motion.bodies.end[motion.bodies.of_vertex[vertex]], motion.bodies.position[place])
        motion.x1[vertex] = x1
        motion.velocity[vertex] = wanted_velocity(motion, vertex, x1)


@wp.kernel(**_KERNEL)
def _restore_fast(has_fast: wp.array[int], progress: Progress):
    """Counts worlds with fast or pushing contacts in the motion that the inner solver wanted as such.

    Where something immovable pushes, substeps that obey it may end in contacts that do not look like it; but to divide
    them could leave vertices in its way.
    """
    world = wp.tid()
    progress.fast[world] = wp.max(progress.fast[world], has_fast[world])


@wp.kernel(**_KERNEL)
def _restore_hits(detected: wp.array[int], progress: Progress):
    """Makes the contacts of the step the inner solver wanted those that the status counts."""
    progress.status.first_hits[0] = detected[1]


def edges_at_rest(model: newton.Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns edges of triangles and tetrahedra, their lengths at rest [m], and which are of tetrahedra."""
    kinds = []
    for indices, poses, n in ((model.tri_indices, model.tri_poses, 3), (model.tet_indices, model.tet_poses, 4)):
        elements = np.zeros((0, n), dtype=int) if indices is None else indices.numpy().reshape(-1, n)
        inverse = np.zeros((0, n - 1, n - 1)) if poses is None else poses.numpy().astype(np.float64)
        valid = np.linalg.det(inverse) != 0.0
        sides = np.linalg.inv(inverse[valid])  # from the first vertex to the others, in columns
        x = np.concatenate([np.zeros_like(sides[:, :, :1]), sides], axis=2)
        a, b = np.triu_indices(n, k=1)
        edges = np.sort(elements[valid][:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1)
        kinds.append((edges, np.linalg.norm(x[:, :, a] - x[:, :, b], axis=1).ravel()))
    edges, of_edge = np.unique(np.concatenate([edges for edges, _ in kinds]), axis=0, return_inverse=True)
    lengths, is_solid = np.zeros(len(edges)), np.zeros(len(edges), dtype=bool)
    np.maximum.at(lengths, of_edge.ravel(), np.concatenate([lengths for _, lengths in kinds]))
    is_solid[of_edge.ravel()[len(kinds[0][0]) :]] = True
    return edges, lengths, is_solid


class Coupling:
    """Takes steps that collide again in substeps, in which the inner solver and a projection alternate.

    Worlds without contacts keep what the inner solver made of the whole step, bit by bit. So do, in all worlds, bodies
    that the response cannot move: in the substeps, they move evenly between their poses at both ends. Arrays of the
    inner solver are restored after the substeps, so that histories and clocks advance once a step. Options of a step,
    such as observables, are those of the whole step.

    What a substep is depends on the inner solver. VBD and Style3D make all their iterations in each, on the forces of a
    shorter step. So does XPBD, whose multipliers start anew in each substep, with the compliance of its length: it is
    XPBD in small steps, which stays stable where long ones diverge. An explicit solver (``SolverSemiImplicit``) needs
    no coupling: it is stable only at steps in which contacts strain elements little. A number of substeps is taken all
    the same, and ``"auto"`` leaves such steps as they are.

    Limitations:
        In a CUDA graph, steps that allocate memory, as those of ``SolverXPBD`` do, cannot be left out where nothing
        touches, so that the substeps cost their time in each step, and ``"auto"`` refuses them. ``SolverVBD`` and
        ``SolverStyle3D`` themselves are known not to allocate; every other solver and derived class counts as one that
        does. Python attributes that the inner solver changes in place, and not by assignment, are not restored.

        An inner solver that finds contacts of particles itself, by a ``collision_pipeline`` of its own or by VBD's
        self-contact, resolves them beside the stage: a whole step may leave stretch that substeps release. Contacts
        that Style3D finds between cloth and cloth are taken out.

    Attributes:
        substeps: Substeps of the last step, the most of all worlds, on the device; 0 if it was not taken again.
    """

    def __init__(
        self,
        step: Callable[..., None],
        solver: SolverBase,
        mesh: ModelMesh,
        motion: ModelMotion,
        response: Response,
        substeps: Sequence[int],
        *,
        moves_bodies: bool = False,
    ):
        """Allocates buffers.

        Args:
            step: Steps the inner solver, with the arguments of its ``step``.
            solver: The inner solver.
            mesh: The mesh.
            motion: The motion of the whole step.
            response: The response.
            substeps: Numbers of substeps to choose from, each at least 2, sorted; every step that collides takes the
                only one.
            moves_bodies: Whether the response can move bodies.
        """
        self._choices, self._chooses = substeps, len(substeps) > 1
        self._step, self._solver = step, solver
        self._mesh, self._motion, self._response = mesh, motion, response
        self._moves_bodies = moves_bodies
        self._substep = ModelMotion(mesh, motion.friction, moves_bodies=moves_bodies)
        model, device = mesh.model, mesh.device
        self._start, self._in, self._out = model.state(), model.state(), model.state()
        self._histories: dict[str, wp.array] = {}  # copies of arrays of the inner solver
        self.substeps = wp.zeros(1, dtype=int, device=device)
        self._number = wp.full(response.worlds, self._choices[0], dtype=int, device=device)  # of substeps, by world
        self._has_constraints = wp.zeros(response.worlds, dtype=int, device=device)
        self._is_coupled = wp.zeros(response.worlds, dtype=int, device=device)
        self._fast = wp.zeros(response.worlds, dtype=int, device=device)  # as in Progress, of the wanted motion
        self._detected = wp.zeros(2, dtype=int, device=device)  # constraints and contacts
        self._remaining = wp.zeros(1, dtype=int, device=device)
        if self._chooses:
            edges, lengths, is_solid = edges_at_rest(model)
            self._edges = wp.array(edges, dtype=wp.vec2i, device=device), wp.array(lengths, dtype=float, device=device)
            self._edges += (wp.array(is_solid, dtype=bool, device=device),)
            self._strain = wp.zeros(response.worlds, dtype=float, device=device)
            self._device_choices = wp.array(self._choices, dtype=int, device=device)
            self._is_chosen = wp.zeros(len(self._choices), dtype=int, device=device)
            self._unfinished = wp.zeros(1, dtype=int, device=device)
        self._allocates = type(solver) not in _ALLOCATION_FREE or solver.collision_pipeline is not None
        self._histories_of_solver()

    @property
    def _body_q_prev(self):
        """The poses from which VBD takes velocities; None for other solvers."""
        return getattr(self._solver, "body_q_prev", None)

    def save(self, state: newton.State) -> None:
        """Copies the state at the start of the step, before the inner solver changes it."""
        self._start.assign(state)

    def _histories_of_solver(self):
        """Returns the arrays of the inner solver, each with one of its size, allocated here where memory can be."""
        pairs = []
        for name, array in vars(self._solver).items():
            if isinstance(array, wp.array) and array.size and array.device == self._mesh.device:
                saved = self._histories.get(name)
                if saved is None or saved.shape != array.shape or saved.dtype != array.dtype:
                    saved = wp.empty_like(array, requires_grad=False)
                    if not self._mesh.device.is_capturing:  # memory of a graph is of no use outside it
                        self._histories[name] = saved
                pairs.append((array, saved))
        return pairs

    def resolve(
        self, state: newton.State, control: newton.Control | None, contacts: newton.Contacts | None, dt: float
    ) -> Resolution:
        """Returns the motion without its contacts, like :meth:`.response.Response.resolve`, and writes it to a state.

        Args:
            state: The state at the end of the step, as the inner solver made it.
            control: As for the inner solver.
            contacts: As for the inner solver.
            dt: Length of the step [s].

        Raises:
            NotImplementedError: If the number of substeps is to be chosen in a CUDA graph, and the inner solver may
                allocate memory.
        """
        response, device = self._response, self._mesh.device
        always = device.is_capturing and self._allocates
        response.find_contacts(self._motion)
        if self._chooses:
            if always:
                solver = type(self._solver).__name__
                raise NotImplementedError(f"in a graph, {solver} needs a number of substeps: coupling='auto' has none")
            self._choose(dt)
        else:
            inputs = [response.status.unfinished, self._choices[0]]
            self._launch(_use_substeps, 1, inputs, [self.substeps])
        arguments = {"state": state, "control": control, "contacts": contacts, "dt": dt}
        arguments["histories"] = self._histories_of_solver()
        if always:
            self._take_substeps(**arguments)
        else:
            wp.capture_if(self.substeps, self._take_substeps, **arguments)
        wp.capture_if(self.substeps, self._finish, dt=dt)
        return response.resolution

    def _choose(self, dt):
        """Resolves the motion, chooses the substeps of each world, and if there are any, detects its contacts again."""
        response = self._response
        wp.copy(self._unfinished, response.status.unfinished)
        self.substeps.zero_()
        response.finish(dt)
        wp.capture_if(self._unfinished, self._choose_substeps)
        wp.capture_if(self.substeps, self._find_contacts_again)

    def _choose_substeps(self):
        response = self._response
        self._strain.zero_()
        self._is_chosen.zero_()
        edges = self._edges
        inputs = [self._motion.vertices, response.vertices.x1, *edges]
        self._launch(_measure_strain, len(edges[0]), inputs, [self._strain])
        outputs = [response.progress, self._number, self._is_chosen, self.substeps]
        self._launch(_choose_substeps, response.worlds, [self._strain, self._device_choices], outputs)

    def _find_contacts_again(self):
        response = self._response
        wp.copy(response.vertices.x1, self._motion.vertices.x0)  # where crossings are counted
        response.find_contacts(self._motion)

    def _take_substeps(self, state, control, contacts, dt, histories):
        """Takes the step again in substeps, and writes the end to the wanted motion and to the state."""
        response = self._response
        response.collect_near_pairs()
        self._has_constraints.zero_()
        constraints, progress = response.constraints, response.progress
        inputs = [self._motion.vertices, constraints, self._has_constraints]
        response.launch_over_constraints(_find_worlds, inputs)
        self._launch(_keep_counts, 1, [constraints, progress], [self._detected])
        wp.copy(self._fast, progress.fast)
        for array, saved in histories:
            wp.copy(saved, array)
        arguments = {"state": state, "control": control, "contacts": contacts, "dt": dt, "histories": histories}
        for i, substeps in enumerate(self._choices):
            if self._chooses:
                is_chosen = self._is_chosen[i : i + 1]
                wp.capture_if(is_chosen, self._take_number_of_substeps, substeps=substeps, **arguments)
            else:
                self._take_number_of_substeps(substeps=substeps, **arguments)

    def _take_number_of_substeps(self, substeps, state, control, contacts, dt, histories):
        """Takes the step again in worlds with this number of substeps."""
        response, mesh = self._response, self._mesh
        inputs = [self._has_constraints, self._number, substeps]
        outputs = [response.progress, self._is_coupled, self._remaining]
        self._launch(_begin_substeps, response.worlds, inputs, outputs)
        attributes = dict(vars(self._solver))
        self._in.assign(self._start)
        wp.copy(self._substep.vertices.x0, self._motion.vertices.x0)
        if self._moves_bodies and self._body_q_prev is not None:
            wp.copy(self._body_q_prev, self._start.body_q)
        arguments = {"body_q": state.body_q, "control": control, "contacts": contacts, "dt": dt, "substeps": substeps}
        if mesh.device.is_capturing and self._allocates:
            for _ in range(substeps):
                self._take_substep(**arguments)
        else:
            wp.capture_while(self._remaining, self._take_substep, **arguments)
        vars(self._solver).update(attributes)
        for array, saved in histories:
            wp.copy(array, saved)
        inputs = [self._is_coupled, self._in.particle_q, self._in.particle_qd]
        outputs = [self._motion.vertices, state.particle_q, state.particle_qd, response.vertices]
        self._launch(_end_substeps, mesh.vertex_count, inputs, outputs)
        if self._moves_bodies:
            motion = self._motion.vertices
            inputs = [self._is_coupled, self._in.body_q, self._in.body_qd, motion]
            self._launch(_end_body_substeps, mesh.model.body_count, inputs, [state.body_q, state.body_qd])
            self._launch(_place_bodies, len(mesh.shape_vertices.body), [motion], [])

    def _take_substep(self, body_q, control, contacts, dt, substeps):
        """Steps the inner solver, and projects its motion onto the constraints."""
        response, mesh, motion, substep = self._response, self._mesh, self._motion, self._substep
        start, end = self._in, self._out
        particle_q, particle_qd = start.particle_q, start.particle_qd
        if mesh.model.body_count:
            inputs = [motion.vertices, self._start.body_q, body_q, substeps, self._remaining]
            self._launch(_move_bodies, mesh.model.body_count, inputs, [start.body_q, end.body_q])
        substep_dt = dt / substeps
        if self._moves_bodies:
            wp.copy(substep.vertices.bodies.start, start.body_q)  # now: some solvers overwrite it
        self._step(start, end, control, contacts, substep_dt)
        if self._moves_bodies:
            substep.set_body_ends(end.body_q, end.body_qd)
            response.begin_bodies(substep)
        inputs = [motion.vertices, motion.planes.start, motion.planes.end, substeps, dt, self._remaining]
        inputs += [self._detected, end.particle_q, end.particle_qd]
        outputs = [substep.vertices, response.constraints, response.progress]
        outputs += [substep.planes.start, substep.planes.end, response.vertices]
        self._launch(_start_substep, max(mesh.vertex_count, len(motion.planes.start)), inputs, outputs)
        response.collect_penetrations(substep)
        constraints, progress = response.constraints, response.progress
        inputs = [substep.vertices, response.vertices, self._detected, constraints, progress]
        response.launch_over_constraints(_reset_constraints, inputs)
        response.project(substep, substep_dt, 1.0 / substeps)  # creep adds up over substeps
        start.assign(self._start)
        outputs = [substep.vertices, particle_q, particle_qd]
        self._launch(_end_substep, mesh.vertex_count, [response.vertices, self._remaining], outputs)
        if self._moves_bodies:
            outputs = [start.body_q, start.body_qd, self._body_q_prev]
            self._launch(_end_body_substep, mesh.model.body_count, [substep.vertices, response.vertices], outputs)

    def _finish(self, dt):
        """Detects and resolves the contacts of the motion that the substeps made."""
        response = self._response
        response.find_contacts(self._motion)
        self._launch(_restore_fast, response.worlds, [self._fast], [response.progress])
        response.finish(dt)
        self._launch(_restore_hits, 1, [self._detected], [response.progress])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._mesh.device)
