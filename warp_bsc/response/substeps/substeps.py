"""Coupling: in steps with contacts, the inner solver takes substeps, between which contacts are projected.

A step that collides is taken again from its start in substeps: the inner solver steps, and a projection onto the
contacts of the whole step follows. So the elastic solve of each substep begins with positions and velocities that have
felt the contacts, and pulls against them for a fraction of the step only. The stretch between solver and contacts falls
with the length of the substep. Contacts are detected once, before the substeps; the motion of the whole step is
detected and certified after them.

With ``"auto"`` a step is resolved as without coupling first. Only where contacts strain an element by more than
``STRAIN`` against what the inner solver predicted, it is taken again, in the least number of ``SUBSTEPS`` that brings
the strain below, if that is in proportion to the length of a substep. The number follows from the step alone, not from
those before.

Contacts that a program passes on are shared out before the step, see :mod:`.inner_contacts`: whole steps and substeps
get the same ones. Those between bodies were found at the start of the step, and remain for all substeps.

References:
    M. Macklin, K. Storey, M. Lu, P. Terdiman, N. Chentanez, S. Jeschke and M. Mueller, Small Steps in Physics
    Simulation, Symposium on Computer Animation, 2019, doi:10.1145/3309486.3340247.
"""

from collections.abc import Callable, Sequence

import newton
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD

from ..contacts.detect import detect_penetrations
from ..solve import positions, velocities
from ..solve.bodies import begin_bodies
from ..state.mesh import ModelMesh
from ..state.motion import ModelMotion
from ..state.workspace import Resolution, Workspace
from ..step import add_proximities, find_contacts, resolve_contacts
from .kernels import (
    begin_substeps,
    end_body_substep,
    end_body_substeps,
    end_substep,
    end_substeps,
    find_worlds,
    keep_counts,
    move_bodies,
    place_bodies,
    reset_constraints,
    restore_fast,
    restore_hits,
    start_substep,
    use_substeps,
)
from .strain import choose_substeps, edges_at_rest, measure_strain

_ALLOCATION_FREE = (SolverVBD, SolverStyle3D)
"""Solvers whose steps allocate no memory, which the body of a condition in a CUDA graph cannot; others may."""


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
        work: Workspace,
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
            work: The workspace of the step.
            substeps: Numbers of substeps to choose from, each at least 2, sorted; every step that collides takes the
                only one.
            moves_bodies: Whether the response can move bodies.
        """
        self._choices, self._chooses = substeps, len(substeps) > 1
        self._step, self._solver = step, solver
        self._mesh, self._motion, self._work = mesh, motion, work
        self._moves_bodies = moves_bodies
        self._substep = ModelMotion(mesh, motion.friction, moves_bodies=moves_bodies)
        model, device = mesh.model, mesh.device
        self._start, self._in, self._out = model.state(), model.state(), model.state()
        self._histories: dict[str, wp.array] = {}  # copies of arrays of the inner solver
        self.substeps = wp.zeros(1, dtype=int, device=device)
        self._number = wp.full(work.worlds, self._choices[0], dtype=int, device=device)  # of substeps, by world
        self._has_constraints = wp.zeros(work.worlds, dtype=int, device=device)
        self._is_coupled = wp.zeros(work.worlds, dtype=int, device=device)
        self._fast = wp.zeros(work.worlds, dtype=int, device=device)  # as in SolveStatus, of the predicted motion
        self._detected = wp.zeros(2, dtype=int, device=device)  # constraints and contacts
        self._remaining = wp.zeros(1, dtype=int, device=device)
        if self._chooses:
            edges, lengths, is_solid = edges_at_rest(model)
            self._edges = wp.array(edges, dtype=wp.vec2i, device=device), wp.array(lengths, dtype=float, device=device)
            self._edges += (wp.array(is_solid, dtype=bool, device=device),)
            self._strain = wp.zeros(work.worlds, dtype=float, device=device)
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
        """Returns the motion without its contacts, like :func:`.step.resolve`, and writes it to a state.

        Args:
            state: The state at the end of the step, as the inner solver made it.
            control: As for the inner solver.
            contacts: As for the inner solver.
            dt: Length of the step [s].

        Raises:
            NotImplementedError: If the number of substeps is to be chosen in a CUDA graph, and the inner solver may
                allocate memory.
        """
        work, device = self._work, self._mesh.device
        always = device.is_capturing and self._allocates
        find_contacts(work, self._motion)
        if self._chooses:
            if always:
                solver = type(self._solver).__name__
                raise NotImplementedError(f"in a graph, {solver} needs a number of substeps: coupling='auto' has none")
            self._resolve_and_choose(dt)
        else:
            inputs = [work.status.loop.unfinished, self._choices[0]]
            self._launch(use_substeps, 1, inputs, [self.substeps])
        arguments = {"state": state, "control": control, "contacts": contacts, "dt": dt}
        arguments["histories"] = self._histories_of_solver()
        if always:
            self._take_substeps(**arguments)
        else:
            wp.capture_if(self.substeps, self._take_substeps, **arguments)
        wp.capture_if(self.substeps, self._finish, dt=dt)
        return work.resolution

    def _resolve_and_choose(self, dt):
        """Resolves the motion, chooses the substeps of each world, and if there are any, detects its contacts again."""
        work = self._work
        wp.copy(self._unfinished, work.status.loop.unfinished)
        self.substeps.zero_()
        resolve_contacts(work, dt)
        wp.capture_if(self._unfinished, self._choose)
        wp.capture_if(self.substeps, self._find_contacts_again)

    def _choose(self):
        work = self._work
        self._strain.zero_()
        self._is_chosen.zero_()
        edges = self._edges
        inputs = [self._motion.vertices, work.vertices.x1, *edges]
        self._launch(measure_strain, len(edges[0]), inputs, [self._strain])
        outputs = [work.status, self._number, self._is_chosen, self.substeps]
        self._launch(choose_substeps, work.worlds, [self._strain, self._device_choices], outputs)

    def _find_contacts_again(self):
        work = self._work
        wp.copy(work.vertices.x1, self._motion.vertices.x0)  # where crossings are counted
        find_contacts(work, self._motion)

    def _take_substeps(self, state, control, contacts, dt, histories):
        """Takes the step again in substeps, and writes the end to the predicted motion and to the state."""
        work = self._work
        add_proximities(work)
        self._has_constraints.zero_()
        constraints, status = work.constraints, work.status
        inputs = [self._motion.vertices, constraints, self._has_constraints]
        work.launch_over_constraints(find_worlds, inputs)
        self._launch(keep_counts, 1, [constraints, status], [self._detected])
        wp.copy(self._fast, status.is_fast)
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
        work, mesh = self._work, self._mesh
        inputs = [self._has_constraints, self._number, substeps]
        outputs = [work.status, self._is_coupled, self._remaining]
        self._launch(begin_substeps, work.worlds, inputs, outputs)
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
        outputs = [self._motion.vertices, state.particle_q, state.particle_qd, work.vertices]
        self._launch(end_substeps, mesh.vertex_count, inputs, outputs)
        if self._moves_bodies:
            motion = self._motion.vertices
            inputs = [self._is_coupled, self._in.body_q, self._in.body_qd, motion]
            self._launch(end_body_substeps, mesh.model.body_count, inputs, [state.body_q, state.body_qd])
            self._launch(place_bodies, len(mesh.shape_vertices.body), [motion], [])

    def _take_substep(self, body_q, control, contacts, dt, substeps):
        """Steps the inner solver, and projects its motion onto the constraints."""
        work, mesh, motion, substep = self._work, self._mesh, self._motion, self._substep
        start, end = self._in, self._out
        particle_q, particle_qd = start.particle_q, start.particle_qd
        if mesh.model.body_count:
            inputs = [motion.vertices, self._start.body_q, body_q, substeps, self._remaining]
            self._launch(move_bodies, mesh.model.body_count, inputs, [start.body_q, end.body_q])
        substep_dt = dt / substeps
        if self._moves_bodies:
            wp.copy(substep.vertices.bodies.start, start.body_q)  # now: some solvers overwrite it
        self._step(start, end, control, contacts, substep_dt)
        if self._moves_bodies:
            substep.set_body_ends(end.body_q, end.body_qd)
            work.motion = substep
            work.launch_over_bodies(begin_bodies)
        inputs = [motion.vertices, motion.planes.start, motion.planes.end, substeps, dt, self._remaining]
        inputs += [self._detected, end.particle_q, end.particle_qd]
        outputs = [substep.vertices, work.constraints, work.status]
        outputs += [substep.planes.start, substep.planes.end, work.vertices]
        self._launch(start_substep, max(mesh.vertex_count, len(motion.planes.start)), inputs, outputs)
        work.motion = substep
        if work.max_penetrations:
            work.reserve(work.max_penetrations)
            detect_penetrations(work, ahead=True)
        constraints, status = work.constraints, work.status
        inputs = [substep.vertices, work.vertices, self._detected, constraints, status]
        work.launch_over_constraints(reset_constraints, inputs)
        positions.project(work, tolerance=1.0 / substeps)  # creep adds up over substeps
        velocities.project(work, substep_dt)
        start.assign(self._start)
        outputs = [substep.vertices, particle_q, particle_qd]
        self._launch(end_substep, mesh.vertex_count, [work.vertices, self._remaining], outputs)
        if self._moves_bodies:
            outputs = [start.body_q, start.body_qd, self._body_q_prev]
            self._launch(end_body_substep, mesh.model.body_count, [substep.vertices, work.vertices], outputs)

    def _finish(self, dt):
        """Detects and resolves the contacts of the motion that the substeps made."""
        work = self._work
        find_contacts(work, self._motion)
        self._launch(restore_fast, work.worlds, [self._fast], [work.status])
        resolve_contacts(work, dt)
        self._launch(restore_hits, 1, [self._detected], [work.status])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._mesh.device)
