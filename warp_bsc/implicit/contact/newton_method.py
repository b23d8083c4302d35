"""Newton's method on the energy of a step: inertia, elasticity, barriers and friction. Read :meth:`NewtonMethod.solve`.

Each Newton step solves for displacements by conjugate gradients, takes the share of them that brings no two elements
together, and less of it where the energy does not fall. What lies between two solves is :mod:`.advance`, on the device.
"""

from collections.abc import Callable

import numpy as np
import warp as wp

from ..._profiling import phase
from ...detection.pipeline import MIN_CAPACITY
from ...detection.run.launch import cores_for, launch_on_cores, retry_until_fits
from ...detection.run.settings import capacity_for
from ...response.contacts.queue import PairQueue, queues_of
from ...response.report.forces.structs import ContactRows, ImpulseSums, Sides
from ...response.solve.bodies import begin_bodies as begin_response_to_bodies
from ...response.state.mesh import grouped_by_world, host_array
from ...response.state.motion import StateArrays
from ...response.state.structs import allocate
from ...response.state.workspace import Workspace
from ..elasticity.derivatives import make_derivatives
from ..elasticity.elements import ElementKind, elements_of_model
from . import bodies, decisions, pairs, steps
from .advance import ADVANCE, BLOCKS
from .attachments import attach, attachments_of_model
from .conjugate_gradients import Vectors, make_team
from .flow import Flow, Phase, Problem
from .impulses import publish_contacts
from .matrix import make_matrix
from .pairs import BarrierSettings, Candidates, Trial
from .results import StepResults, note_overflow, write_results
from .rows import make_rows
from .scales import edges_of_particles, in_each_world, metre_of
from .system import Contacts, Progress, Unknowns, Worlds
from .touching import part_touching

_OF_ENTRIES = "entries", "unsorted", "row", "order", "pulled", "entry_weight"
"""Arrays of contacts with several elements for each."""
_PARTS = 4
"""Threads that share a row or a block of the Hessian on a GPU, while it is assembled."""
_MANY_VERTICES = 64
"""Vertices for each multiprocessor of a GPU from which on threads have several pairs each, and share less."""
_CONTACTS = 24
"""Contacts that fit at first, for each particle: where two layers of cloth touch all over, they have 9, in a fold up to
15."""
_MORE_OF_BODIES = 4
"""How many times as many those of a body are, for each of its two unknowns."""
_REACH_OF_EDGE = 0.1
"""Reach of a barrier as a share of the median length of edges."""
_USUAL_REACH = 1e-3
"""Reach of particles without edges or radii [m]."""
_SHORT_EDGE = 0.25
"""Largest reach as a share of the shortest edge at a vertex."""
_RECOVERY_SPEED = 0.3
"""Speed at which a barrier moves apart what is within its reach [m/s]: what is thrown rises by 5 mm."""
_SMOOTHING_SPEED = 0.5e-3
"""Speed below which friction is smoothed [m/s]."""
_LEAST_SPEED = 1e-3
"""Speed by which no unknown changes any more where a step of 1/60 s ends [m/s], proportionally less in shorter ones."""
_PRECISE = 0.01
"""Share of that at which steps end whose gradients are wanted: those are of a converged step."""
_FAR_SPEED = 0.1
"""Speed by which one that changes still is far from its end [m/s], see ``is_far``."""
_UNIT_SPEED = 1e-5
"""Speed of a particle whose kinetic energy is about a unit of energy [m/s]."""
_MOST_UNITS, _FAST = 2.0**56, 100.0
"""Units of energy of the heaviest body at a speed [m/s]: they shall not overflow."""
_MOST_UNITS_OF_ALL = 2.0**61
"""The same of all particles together: many and fast ones have coarser units."""
_TOLERANCE = 1e-2
"""Residual at which a solve ends, as a share of the first: by energies, most of which are of what is heavy."""
_LIGHT = 0.01, 1e-4
"""Median of masses as a share of the mean, below which what is light asks for a smaller residual, and down to which."""
_MAX_ITERATIONS = 200
_PUBLISHING = 2**15
"""Threads that publish contacts on a GPU, of all worlds."""
LATE_STEPS = 16
"""Newton steps after which a step ends, even if something that a program moves has not arrived."""


class NewtonMethod:
    """Solves one step after the other, with the same buffers, on the device of the model.

    Attributes:
        mesh: The triangles that collide.
        keeps_contacts: Whether a solve ends with the contacts at its end, to publish or to record them.
        may_grow: Whether buffers of contacts grow between Newton steps, outside graphs.
        problem: What Newton steps read and write.
    """

    keeps_contacts = False
    may_grow = True

    def __init__(
        self,
        work: Workspace,
        *,
        max_steps: int,
        precise: bool,
        results: StepResults,
        unconverged_steps: wp.array[wp.int64],
    ):
        """Allocates buffers for the steps of a workspace, in at most ``max_steps`` Newton steps each.

        If ``precise``, they go on until less is left than what counts as converged. Solves write what they did into
        ``results``, and count steps in which a world did not converge.
        """
        self._work, self.max_steps, self._precision = work, max_steps, _PRECISE if precise else 1.0
        mesh = self.mesh = work.mesh
        model, device = mesh.model, mesh.device
        particles, vertices = model.particle_count, mesh.vertex_count
        elements, of_elements = elements_of_model(model)
        bends = of_elements[ElementKind.BENDING]
        bends[(bends < 0).any(axis=1)] = -1  # an edge at a border does not bend
        world = mesh.device_world.numpy()[:particles]
        if (np.diff(world) < 0).any():
            raise ValueError("particles of a world do not follow each other in the model")

        def array(values):
            return wp.array(np.asarray(values, dtype=np.int32), dtype=int, device=device)

        p = self.problem = Problem()
        unknowns = Unknowns()
        solved, body_of_vertex = self._bodies_in_solve(), mesh.shape_vertices.body
        body_world = np.zeros(0, dtype=int)
        if len(solved):
            body_world = np.maximum(host_array(model.body_world)[solved], 0)
        # in each world its particles, then a shift and a turn of each of its bodies
        owner_world = np.concatenate([world, np.repeat(body_world, 2)])
        order, of_worlds = grouped_by_world(owner_world, work.worlds)
        number = np.argsort(order, kind="stable")
        unknown, of_bodies = number[:particles], np.full(model.body_count + 1, -1)
        of_bodies[solved] = number[particles::2]
        self._count = len(order)
        first = of_bodies[body_of_vertex]  # that of -1 is the last
        unknowns.of_vertex = array(np.append(unknown, np.where(first < 0, -1, -2 - first)))
        self._all_sought = array(np.append(np.ones(particles), np.where(first < 0, 0, 2 + body_of_vertex)))
        self._sought = wp.clone(self._all_sought)
        unknowns.particle = array(np.where(order < particles, order, -1))
        unknowns.body = array(np.append(np.full(particles, -1), np.repeat(solved, 2))[order])
        unknowns.of_worlds = array(of_worlds)
        unknowns.first_of_bodies = array(of_worlds[:-1] + np.bincount(world, minlength=work.worlds))
        unknowns.is_free = wp.zeros(self._count, dtype=int, device=device)
        unknowns.inertia = wp.zeros(self._count, dtype=wp.float64, device=device)
        unknowns.arm = wp.zeros(vertices, dtype=wp.vec3, device=device)
        largest = int(np.bincount(owner_world, minlength=1).max(initial=0))
        self._team, self._threads, self._solve_worlds = make_team(largest, work.worlds, device)
        p.bodies = allocate(bodies.SolvedBodies, model.body_count if len(solved) else 0, device)
        holder = np.arange(vertices)
        if len(solved):
            first_vertex = np.full(model.body_count, -1)
            of_body, first_of_body = np.unique(body_of_vertex, return_index=True)
            first_vertex[of_body[of_body >= 0]] = particles + first_of_body[of_body >= 0]
            p.bodies.unknown, p.bodies.first_vertex = array(of_bodies[:-1]), array(first_vertex)
            held = np.flatnonzero(first >= 0)
            holder[particles + held] = first_vertex[body_of_vertex[held]]
        p.unknowns, p.rows = unknowns, make_rows(of_elements, unknown, self._count, device)
        p.matrix = make_matrix(p.rows, of_worlds, self._team.parts, device)
        p.vectors = allocate(Vectors, self._count, device)
        p.progress = allocate(Progress, work.worlds, device)
        p.trial = allocate(Trial, vertices, device, path=(int(decisions.PATH), particles), any_touches=1)
        p.trial.holder = array(holder)
        p.trial.limit.fill_(1.0)
        self._goes_back = wp.zeros(1, dtype=int, device=device)
        self.iterations = wp.zeros(work.worlds, dtype=int, device=device)
        settings = p.settings
        self._metre = metre_of(mesh)
        reach = self._reach(mesh)
        settings.reach = wp.array(reach, dtype=float, device=device)
        settings.elasticity = wp.array(self._elasticity(mesh), dtype=float, device=device)
        settings.is_of_face = array(np.isin(np.arange(vertices), mesh.faces))
        settings.load = wp.zeros(vertices, dtype=float, device=device)
        worlds = mesh.device_world.numpy()
        of_bodies = np.full(vertices, np.inf)
        if len(solved):
            least = in_each_world(np.min, reach[:particles], world, work.worlds, np.inf)[worlds]
            of_bodies = np.minimum(bodies.reach_between_bodies(mesh), least)
            of_bodies[:particles] = np.inf
        settings.reach_of_bodies = wp.array(of_bodies, dtype=float, device=device)
        reach = np.minimum(reach, of_bodies)
        margin = np.where(np.isfinite(reach), reach, 0.0)
        margin += 0.5 * in_each_world(np.max, margin, worlds, work.worlds, 0.0)[worlds]
        p.trial.margin = wp.array(margin, dtype=float, device=device)
        masses = host_array(model.particle_mass)
        moves = (host_array(model.particle_inv_mass) > 0) & np.isfinite(masses)
        mass = in_each_world(np.mean, masses[moves], world[moves], work.worlds, 1.0)
        total = in_each_world(np.sum, masses[moves], world[moves], work.worlds, 0.0)
        units = 1.0 / np.maximum(mass * _UNIT_SPEED**2, total * _FAST**2 / _MOST_UNITS_OF_ALL) / self._metre**2
        light = in_each_world(np.median, masses[moves], world[moves], work.worlds, 1.0) / mass
        tolerance = _TOLERANCE * np.where(light < _LIGHT[0], np.sqrt(np.maximum(light, _LIGHT[1])), 1.0)
        self._tolerance = wp.array(tolerance, dtype=float, device=device)
        if len(solved):
            heaviest = in_each_world(np.max, host_array(model.body_mass)[solved], body_world, work.worlds, 0.0)
            units = np.minimum(units, _MOST_UNITS / np.maximum(heaviest * (_FAST * self._metre) ** 2, 1e-9))
        settings.units = wp.array(units, dtype=wp.float64, device=device)
        self._attachments = attachments_of_model(model)
        self._results = [results, unconverged_steps]
        sizes = {**dict.fromkeys(("solves_next", "goes_on", "turn", "taken", "ended", "any_leaves"), 1), "count": 2}
        p.flow = allocate(Flow, work.worlds, device, **sizes, lacks=2, listed=2 * work.worlds)
        processors = device.sm_count if device.is_cuda else 1
        self._is_many = device.is_cuda and vertices > _MANY_VERTICES * processors
        self._block, blocks = BLOCKS[self._is_many]
        self._blocks = blocks * processors
        p.elements, p.derivatives = elements, make_derivatives(of_elements, device)
        p.worlds = self._in_worlds(of_elements, unknowns)
        p.vertices_at_planes = work.vertices_at_planes if work.max_penetrations else 0
        p.parts = _PARTS if device.is_cuda else 1
        p.turns = _PARTS if self._is_many else 1
        self._queues: list[PairQueue] = []
        self._captured, self._retired = False, []
        rooms = np.append(0, np.cumsum(np.where(order < particles, 1, _MORE_OF_BODIES)))
        self._rooms = rooms[of_worlds]  # of contacts, summed up by world
        self._allocate_candidates(queues_of(work.detector, candidates=True))
        self.allocate_contacts(max(_CONTACTS, -(-MIN_CAPACITY // max(int(rooms[-1]), 1))))

    @property
    def settings(self) -> BarrierSettings:
        """What barriers and friction depend on."""
        return self.problem.settings

    def _in_worlds(self, of_elements, unknowns) -> Worlds:
        """Returns what is in each world."""
        found, count, device = Worlds(), self._work.worlds, self._work.device
        world = self.mesh.device_world.numpy()
        is_given = (unknowns.of_vertex.numpy() == -1).astype(int)
        vertices, first = grouped_by_world(2 * world + is_given, 2 * count)
        arrays = {"vertices": vertices, "first_vertex": first[::2], "first_given": first[1::2]}
        # by world and kind, and on a GPU each kind begins with a warp of its own: the threads of one do the same
        kinds = len(of_elements)
        vertex = np.concatenate([v.max(axis=1, initial=-1) for v in of_elements])
        kind = np.repeat(np.arange(kinds), [len(v) for v in of_elements])
        numbers = np.flatnonzero(vertex >= 0)
        of_kinds, first_of_kind = grouped_by_world(kinds * world[vertex[numbers]] + kind[numbers], kinds * count)
        counts, warp = np.diff(first_of_kind), 32 if device.is_cuda else 1
        start = np.append(0, np.cumsum(-(-counts // warp) * warp))
        elements, first_element = np.full(start[-1], -1), start[::kinds]
        elements[np.arange(len(numbers)) + np.repeat(start[:-1] - first_of_kind[:-1], counts)] = numbers[of_kinds]
        arrays |= {"elements": elements, "first_element": first_element}
        for name, values in arrays.items():
            setattr(found, name, wp.array(values.astype(np.int32), dtype=int, device=device))
        return found

    def _reach(self, mesh) -> np.ndarray:
        """Returns the gap from which each vertex pushes [m], infinite for shapes."""
        model, particles = mesh.model, mesh.model.particle_count
        reach = np.full(mesh.vertex_count, np.inf)
        edges, lengths = edges_of_particles(mesh)
        world, least = mesh.device_world.numpy(), self._metre * _USUAL_REACH
        usual = in_each_world(np.median, lengths, world[edges[:, 0]], self._work.worlds, least / _REACH_OF_EDGE)
        reach[:particles] = _REACH_OF_EDGE * usual[world[:particles]]
        for k in range(2):
            np.minimum.at(reach, edges[:, k], _SHORT_EDGE * lengths)
        if particles:
            radius = model.particle_radius.numpy()
            reach[:particles] = np.where(radius > 0, np.minimum(reach[:particles], radius), reach[:particles])
        return reach

    def _elasticity(self, mesh) -> np.ndarray:
        """Returns the stiffness of tetrahedra around each vertex, mu V |b|^2 of each, of shape functions b [N/m]."""
        model, found = mesh.model, np.zeros(mesh.vertex_count)
        if model.tet_count:
            poses, materials = model.tet_poses.numpy().astype(float), model.tet_materials.numpy()
            gradients = np.concatenate([-poses.sum(axis=1, keepdims=True), poses], axis=1)
            volume = 1.0 / (6.0 * np.linalg.det(poses))
            stiffness = (materials[:, 0] * volume)[:, None] * (gradients**2).sum(axis=2)
            np.add.at(found, model.tet_indices.numpy().reshape(-1, 4), stiffness)
        return found

    def _bodies_in_solve(self) -> np.ndarray:
        """Returns the bodies whose vertices may be solved for."""
        mesh, worlds = self.mesh, self._work.worlds
        if not self._work.motion.moves_bodies:
            return np.zeros(0, dtype=int)
        with_shapes = np.unique(mesh.shape_vertices.body[mesh.shape_vertices.body >= 0])
        return with_shapes[(host_array(mesh.model.body_world)[with_shapes] >= 0) | (worlds == 1)]

    def solve(self, end: StateArrays, dt: float) -> None:
        """Finds where particles and bodies end that the motion of the workspace predicts, and writes it there and here.

        Args:
            end: The state at the end, with the poses of bodies as predicted; what is solved for is written.
            dt: Length of the step [s].
        """
        self._captured = self._captured or bool(self._work.device.is_capturing)
        self._begin(end, dt)
        self._find_end(end)

    @phase("retreat")
    def retreat(self, end: StateArrays, detect: Callable[[], None]) -> None:
        """Ends the step earlier in worlds in which the workspace found contacts, where ``detect`` finds none then."""
        self._go_back(end, detect, begins=True)
        wp.capture_while(self._goes_back, self._go_back, end=end, detect=detect, begins=False)

    def _go_back(self, end, detect, begins):
        work = self._work
        self._goes_back.zero_()
        inputs = [self.problem.unknowns, work.status.contact_iteration, begins, self.problem.progress]
        self._launch(decisions.go_back, work.worlds, inputs, [self._results[0].converged, self._goes_back])
        wp.capture_if(self._goes_back, self._move_back, end=end, detect=detect)

    def _move_back(self, end, detect):
        p = self.problem
        inputs = [p.trial, p.unknowns, self._dt, p.progress]
        self._launch(steps.retreat, self.mesh.vertex_count, inputs, [self._work.step.motion, end])
        detect()

    def prepare(self, state: StateArrays) -> None:
        """Does all that a step does, in no world, to allocate buffers and load kernels, which a CUDA graph cannot."""
        end = StateArrays()
        for name in StateArrays.vars:
            given = getattr(state, name)
            setattr(end, name, None if given is None else wp.clone(given))
        self._begin(end, 1.0)
        self.problem.progress.active.zero_()
        self._find_end(end)
        self._solve()

    def read_materials(self) -> None:
        """Reads the stiffness of tetrahedra again; not in a CUDA graph. All else is read in each step."""
        if self.mesh.model.tet_count and not self._work.device.is_capturing:
            self.settings.elasticity.assign(self._elasticity(self.mesh))

    @property
    def _least_speed(self):
        return self._metre * _LEAST_SPEED * min(1.0, 60.0 * self._dt)

    @phase("begin solve")
    def _begin(self, end, dt):
        work, motion, p = self._work, self._work.step.motion, self.problem
        self._dt = float(dt)
        p.motion, p.planes = motion, work.motion.planes
        p.settings.dt = dt
        p.settings.recovery = self._metre * _RECOVERY_SPEED * dt
        p.settings.smoothing = self._metre * _SMOOTHING_SPEED * dt
        p.least_change = self._precision * self._least_speed * self._dt
        p.far_change = self._metre * _FAR_SPEED * self._dt
        p.max_steps, p.max_late_steps = self.max_steps, max(LATE_STEPS, self.max_steps)
        flow, progress = p.flow, p.progress
        lists = flow.count, flow.taken, flow.ended  # where an interrupt, of the last step, left them
        of_worlds = progress.active, progress.given_moves, progress.fastest, flow.arrived, self.iterations
        for zeros in (*of_worlds, *lists, flow.lacks):
            zeros.zero_()
        given = [motion, self.mesh.model.gravity, wp.float64(dt)]
        self._launch(steps.begin_unknowns, self._count, given, [p.unknowns, p.trial, p.progress])
        if self._attachments is not None:
            inputs = [self._attachments, work.motion.last.poses, end.body_q, wp.float64(dt)]
            outputs = [motion, p.unknowns, p.trial.goal, work.vertices, end.particle_q, end.particle_qd]
            self._launch(attach, self.mesh.model.particle_count, inputs, outputs)
        wp.copy(self._sought, self._all_sought)
        self._launch(bodies.begin_bodies, len(p.bodies.unknown), [motion], [p.unknowns, p.progress.active, p.bodies])
        inputs = [*given, p.unknowns, p.bodies]
        self._launch(steps.begin_step, max(self.mesh.vertex_count, work.worlds), inputs, [p.trial, p.progress])
        wp.copy(p.trial.origin, motion.x0)
        p.trial.touched.fill_(pairs.NO_FACE)
        p.trial.any_touches.zero_()

    def _find_end(self, end):
        work, motion, p = self._work, self._work.step.motion, self.problem
        self.find_candidates()
        wp.capture_if(p.trial.any_touches, self._part_touching)
        p.flow.phase.fill_(int(Phase.BEGIN))
        p.flow.goes_on.fill_(1)
        wp.capture_while(p.flow.goes_on, self._take_newton_steps)
        if self.keeps_contacts:
            retry_until_fits(self._find_contacts_at_end, self, work.device)
        if len(p.bodies.unknown):
            self._launch(bodies.finish_bodies, work.body_count, [p.bodies, p.unknowns, self._dt], [motion, end])
            work.launch_over_bodies(begin_response_to_bodies)
        inputs, outputs = [p.trial, p.unknowns, self._dt], [motion, work.vertices, end, p.progress]
        self._launch(steps.finish, self.mesh.vertex_count, inputs, outputs)
        inputs = [p.progress, self._dt, self._least_speed, p.flow.lacks]
        self._launch(write_results, work.worlds, inputs, self._results)

    def renew_candidates(self):
        """Makes boxes anew in worlds in which a vertex leaves its own, and finds the candidates within them."""
        p = self.problem
        inputs = [self._work.step.motion, p.unknowns, p.progress, int(self.keeps_contacts), p.trial]
        self._launch(steps.renew_boxes, self.mesh.vertex_count, inputs, [self._sought])
        p.progress.leaves.zero_()
        p.flow.any_leaves.zero_()
        self.find_candidates()

    @phase("find candidates")
    def find_candidates(self):
        """Finds the pairs that may come near each other within the boxes."""
        work, detector, trial = self._work, self._work.detector, self.problem.trial

        def find():
            # no pairs of shapes alone, or within a body
            detector.find_candidates(trial.lower, trial.upper, changed=self._sought, keep_separated=True)

        retry_until_fits(find, detector, work.device)
        self._launch(note_overflow, 1, [detector.counters.array, detector.capacities], [self.problem.flow.lacks])
        queues = queues_of(detector, candidates=True)
        if [len(q.pairs) for q in self._queues] != [len(q.pairs) for q in queues]:
            self._allocate_candidates(queues)
        self._place_candidates()
        self._prepare_candidates()

    def _place_candidates(self):
        """Gives each world its part of the candidates."""
        work, candidates = self._work, self.problem.candidates
        if work.worlds == 1:
            return
        candidates.room.zero_()
        candidates.used.zero_()
        for k in range(0, len(self._queues), 2):
            queues = self._queues[k : k + 2]
            work.launch_over_entries(pairs.count_candidates, [self.mesh.device_world, *queues, candidates])
        self._launch(pairs.place_candidates, work.worlds, [candidates], [])

    def _prepare_candidates(self):
        p = self.problem
        for zeros in (p.candidates.near, p.candidates.far, p.candidates.listed_others):
            zeros.zero_()
        p.candidates.listed_edges.fill_(-1)
        inputs = [self._work.step, p.settings, self._work.status.crossings, p.progress]
        for k in range(0, len(self._queues), 2):  # pairs of faces and edges, and then those of points, if there are any
            queues = self._queues[k : k + 2]
            p.candidates.used.zero_()
            inputs_of_all = [*inputs, *queues, p.candidates, p.trial]
            self._work.launch_over_entries(pairs.prepare_candidates, inputs_of_all, on_cores=True)

    def _part_touching(self):
        inputs = [self._work.step, self.settings]
        self._launch(part_touching, self.mesh.model.particle_count, inputs, [self.problem.trial])
        self._prepare_candidates()

    def _allocate_candidates(self, queues):
        self._retire(self.problem.candidates)
        of_worlds = "start", "room", "near", "far", "listed_edges", "listed_others"
        sizes: dict = dict.fromkeys(of_worlds, self._work.worlds)
        capacity = sum(len(q.pairs) for q in queues)
        sizes |= {"used": 1, "kept": capacity if self.mesh.distances is not None else 0}
        self.problem.candidates = allocate(Candidates, capacity, self._work.device, **sizes)
        self.problem.candidates.room.fill_(capacity)
        self._queues = queues  # last: without memory, they are allocated again

    def allocate_contacts(self, of_room):
        """Allocates contacts, so many for each particle of a world, and more for each body."""
        self._retire(self.problem.contacts)
        start, device = of_room * self._rooms, self._work.device
        capacity, of_each = int(start[-1]), 8 if len(self.problem.bodies.unknown) else 4  # a body has two unknowns
        sizes: dict = dict.fromkeys(("first", "several", "middle", "end"), self._count)
        parts = 1 if self._is_many else self.problem.parts
        sizes["bucket"] = parts * self.mesh.vertex_count
        sizes |= dict.fromkeys(_OF_ENTRIES, of_each * capacity)
        sizes |= dict.fromkeys(("count", "listed", "coupled_first", "coupled_end"), self._work.worlds)
        contacts = allocate(Contacts, capacity, device, **sizes)
        contacts.parts, contacts.entries_of_each = parts, of_each
        contacts.start = wp.array(start.astype(np.int32), dtype=int, device=device)
        contacts.first_bucket = self.problem.worlds.first_vertex
        self.problem.contacts = contacts

    def _retire(self, buffers):
        if self._captured:
            self._retired.append(dict(vars(buffers)))  # a CUDA graph may still write to the arrays

    def grow(self) -> bool:
        """Enlarges the buffers of contacts if those that were found last did not fit; returns whether. Synchronizes."""
        contacts = self.problem.contacts
        if not self.problem.grows:
            return False
        found, rooms = contacts.count.numpy(), np.diff(self._rooms)
        if (found <= np.diff(contacts.start.numpy())).all():
            return False
        needed = int(np.max(-(-found[rooms > 0] // rooms[rooms > 0])))
        capacity = capacity_for(needed * int(self._rooms[-1]), "contacts")
        self.allocate_contacts(capacity // int(self._rooms[-1]))
        return True

    def _take_newton_steps(self):
        flow = self.problem.flow
        wp.capture_if(flow.any_leaves, self.renew_candidates)
        flow.goes_on.zero_()
        self._advance(resumes=True, of_all=True)
        wp.capture_while(flow.solves_next, self._solve)
        if not self._work.device.is_capturing:
            self.grow()

    def _find_contacts_at_end(self):
        self.problem.flow.phase.fill_(int(Phase.PUBLISH))
        self._advance(of_all=True)

    @phase("linear solve")
    def _solve(self):
        work, team, p = self._work, self._team, self.problem
        if team.blocks > 1 or work.device.is_cpu:
            team.arrived.zero_()
        inputs = [p.matrix, p.contacts, p.unknowns, p.progress.solving]
        inputs += [self._tolerance, _MAX_ITERATIONS, p.flow.solves, team]
        outputs = [p.vectors, self.iterations, p.flow.solves_next]
        options = {"device": work.device, "block_dim": self._threads}
        threads = work.worlds * team.blocks * self._threads
        launch_on_cores(self._solve_worlds, threads, inputs=inputs, outputs=outputs, **options)
        self._advance()

    @phase("Newton step")
    def _advance(self, resumes=False, of_all=False):
        device, worlds, kernel = self._work.device, self._work.worlds, ADVANCE[self._is_many]
        self.problem.grows = int(self.may_grow and not device.is_capturing)
        threads = self._block if device.is_cuda else 1
        blocks = self._blocks if device.is_cuda else min(worlds, cores_for(kernel, device))
        inputs = [int(resumes), int(of_all or worlds == 1), threads, blocks, self.problem]
        launch_on_cores(kernel, blocks * threads, inputs=inputs, device=device, block_dim=self._block)

    def publish(self, sides: Sides, centres: wp.array[wp.vec3d], sums: ImpulseSums, rows: ContactRows) -> None:
        """Publishes the impulses of the contacts at the end of the last step, if ``keeps_contacts`` is set."""
        work = self._work
        threads = max(1, _PUBLISHING // work.worlds) if work.device.is_cuda else 1
        inputs = [self.problem.contacts, self.settings, self.problem.trial, work.step, sides, centres, threads]
        self._launch(publish_contacts, (threads, work.worlds), inputs, [sums, rows])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._work.device)
