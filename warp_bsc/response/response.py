"""The response to collisions: moves vertices until their motion is certified to be free of collisions."""

import numpy as np
import warp as wp

from ..detection.launch import retry_until_fits
from ..detection.pipeline import DetectionPipeline
from ..detection.settings import Count, PairKind, capacity_for
from .adjoint_kernels import count_grazing
from .angular_momentum import SUMS, sum_bodies, sum_torques, turn_vertices
from .constraints import (
    ACTIVE,
    CERTIFIED,
    EDGE_EDGE_CONTACT,
    FIRST_HITS,
    FROZEN_NOW,
    HITS,
    NEVER,
    ON_PLANE,
    PROJECTIONS,
    REMAINING,
    ROUND,
    SHARE,
    STEER,
    TIMES,
    TRUNCATIONS,
    UNDETECTED,
    Constraints,
    Contacts,
    Progress,
    Vertices,
    collect_contacts,
    contact_vertices,
    to_double,
    to_single,
)
from .planes import HalfSpaces, collect_penetrations, place_half_spaces
from .projection import (
    ANOTHER,
    BATCH,
    ITERATIONS,
    accelerate,
    change_velocities,
    displace,
    enlist_accelerating,
    enlist_displacing,
    move_vertices,
    start_impulses,
)
from .proximities import NearPairs, collect_near_pairs, forget_near_pairs
from .step_record import (
    FORGOTTEN,
    STANDS,
    TRUNCATED_PATHS,
    History,
    StepHistory,
    begin_round,
    is_recording,
)

__all__ = ["FROZEN", "TRUNCATED", "Response"]

_LEAST_ENTRIES = 4096
"""Constraints acting in iterations for which there is room to take them down at least."""
_ROUNDS_OF_ROOM = 2
"""For the contacts of how many rounds there is room."""

TRUNCATED, FROZEN = wp.constant(2), wp.constant(4)
"""Bits of what has been done to a vertex."""

_KERNEL = {"enable_backward": False}


@wp.kernel(**_KERNEL)
def _forget_if_full(constraints: Constraints, progress: Progress, needed: int):
    """Forgets all constraints where a detection might not find room for its own."""
    if constraints.count[0] > constraints.vertices.shape[0] - needed:
        constraints.count[0] = 0
        if is_recording(progress.history):
            progress.history.sizes[FORGOTTEN] = 1


@wp.kernel(**_KERNEL)
def _mark_round(constraints: Constraints, progress: Progress, after: int):
    """Marks in the history where a round begins, or where it ended; those that freeze share a mark."""
    last = progress.projections + TRUNCATIONS + 1
    rounds = progress.steer[ROUND]
    if after == 1 or rounds <= last:
        begin_round(progress.history, wp.min(rounds, last) + after, constraints.count[0])


@wp.kernel(**_KERNEL)
def _decide(progress: Progress, counts: wp.array[wp.int64], capacities: wp.array[wp.int64]):
    """Whether another round is needed, from the contacts counted."""
    overflowed = bool(False)
    for i in range(counts.shape[0]):
        overflowed = overflowed or counts[i] > capacities[i]
    steer = progress.steer
    hits = steer[HITS]
    steer[HITS] = 0
    steer[REMAINING] = hits
    if steer[ROUND] == 0:
        steer[FIRST_HITS] = steer[FIRST_HITS] + hits
    stuck = steer[ROUND] > progress.projections + TRUNCATIONS and steer[FROZEN_NOW] == 0
    steer[FROZEN_NOW] = 0
    steer[CERTIFIED] = wp.where(hits == 0 and not overflowed, 1, 0)
    steer[UNDETECTED] = wp.where(overflowed, 1, 0)
    steer[ACTIVE] = wp.where(hits == 0 or overflowed or stuck, 0, 1)
    steer[ROUND] = steer[ROUND] + steer[ACTIVE]


@wp.func
def _record_truncation(
    vertices: Vertices, history: History, vertex: int, cuts: bool, time: wp.float64, first: int, contacts: Contacts
):
    """Takes down where a path ended before it is cut before the first contact, or before the vertex stands still."""
    entry = wp.atomic_add(history.sizes, TRUNCATED_PATHS, 1)
    if entry >= history.vertex.shape[0]:
        return
    history.vertex[entry] = vertex
    history.end[entry] = vertices.x1[vertex]
    kind = wp.where(cuts, first & 3, STANDS)
    i = first >> 2
    history.kind[entry] = kind
    history.contact[entry] = wp.vec4i(vertex, i, 0, 0)
    history.toi[entry] = time
    if kind != ON_PLANE and kind != STANDS:
        history.contact[entry] = contact_vertices(contacts, i)
        history.localized[entry] = contacts.localized[i]
        history.toi[entry] = contacts.toi[i]
        history.coordinates[entry] = contacts.coordinates[i]
        history.normal[entry] = contacts.normal[i]


@wp.kernel(**_KERNEL)
def _truncate_vertices(
    vertices: Vertices, progress: Progress, vertex_face: Contacts, edge_edge: Contacts, dt: wp.float64
):
    """Cuts the path of each vertex before its first contact, and at last leaves it where it was."""
    vertex = wp.tid()
    key = vertices.time[vertex]
    if key == NEVER:
        return
    vertices.time[vertex] = NEVER
    if vertices.inverse_mass[vertex] == 0.0:
        return
    time = wp.float64(key >> wp.int64(32)) / TIMES
    cuts = progress.steer[ROUND] <= progress.projections + TRUNCATIONS
    if is_recording(progress.history) and (cuts or vertices.done[vertex] & FROZEN == 0):
        first = int(key & wp.int64(0xFFFFFFFF))
        if first & 3 == EDGE_EDGE_CONTACT:
            _record_truncation(vertices, progress.history, vertex, cuts, time, first, edge_edge)
        else:
            _record_truncation(vertices, progress.history, vertex, cuts, time, first, vertex_face)
    if cuts:
        x0 = to_double(vertices.x0[vertex])
        path = SHARE * time * (to_double(vertices.x1[vertex]) - x0)
        vertices.x1[vertex] = to_single(x0 + path)
        vertices.changed[vertex] = 1
        vertices.velocity[vertex] = to_single(path / dt)
        vertices.done[vertex] = vertices.done[vertex] | TRUNCATED
    elif vertices.done[vertex] & FROZEN == 0:
        vertices.x1[vertex] = vertices.x0[vertex]
        vertices.changed[vertex] = 1
        vertices.velocity[vertex] = wp.vec3()
        vertices.done[vertex] = vertices.done[vertex] | FROZEN
        wp.atomic_add(progress.steer, FROZEN_NOW, 1)


@wp.kernel(**_KERNEL)
def _stand_still(vertices: Vertices, progress: Progress):
    """Leaves everything where it was if a detection was incomplete: positions not finite, or a graph without room."""
    vertex = wp.tid()
    if progress.steer[UNDETECTED] == 1 and vertices.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = vertices.x0[vertex]
        vertices.velocity[vertex] = wp.vec3()
        vertices.done[vertex] = vertices.done[vertex] | FROZEN


class Response:
    """Moves the vertices of a motion until it is certified to be free of collisions, on the device.

    Rounds of projection come first: each contact is moved apart at the end of the step, and the new motion is detected
    again, as far as it has changed. What still collides after many has its path truncated before its first contact, a
    few times, and then stands still, which ends, because what stood apart and stands still does not collide. Where a
    detection is incomplete, everything stands still, and the motion is not certified.

    Attributes:
        detector: What it detects with.
        vertices: The vertices, whose ``x0``, ``x1`` and ``velocity`` are to be filled.
        steer: Array of int that says, by the places that :mod:`.constraints` names, what was done.
        constraints: What contacts ask for, :class:`Constraints`.
        half_spaces: The infinite planes, :class:`HalfSpaces`.
        history: What the last step did, if it was to be taken down, :class:`StepHistory`.
        separation: How far projection moves contacts apart [m].
        restitution: Which part of the approaching velocity comes back.
        worlds: How many worlds there are.
        device: The device.
    """

    def __init__(self, mesh, friction, plane_friction, *, separation, restitution, tolerance):
        """Makes room.

        Args:
            mesh: The :class:`ModelMesh`.
            friction: Coefficients of the vertices; that of a contact is the geometric mean, Warp array of float.
            plane_friction: Coefficients of the planes of the mesh, Warp array of float.
            separation: How far projection moves contacts apart [m].
            restitution: Which part of the approaching velocity comes back.
            tolerance: How precisely constraints are solved, as a share of the separation.
        """
        n, device = mesh.vertex_count, mesh.device
        self.detector = DetectionPipeline(mesh)
        self._mesh, self.device = mesh, device
        self.separation, self.restitution = separation, restitution
        self.vertices = vertices = Vertices()
        for name in ("x0", "x1", "velocity", "wanted_x1", "wanted_velocity"):
            setattr(vertices, name, wp.zeros(n, dtype=wp.vec3, device=device))
        vertices.inverse_mass, vertices.friction, vertices.world = mesh.inverse_masses, friction, mesh.device_world
        for name in ("active", "done", "changed"):
            setattr(vertices, name, wp.zeros(n, dtype=int, device=device))
        for name in ("displacement", "velocity_change"):
            setattr(vertices, name, wp.zeros((n, 3), dtype=wp.int64, device=device))
        vertices.time = wp.full(n, int(NEVER), dtype=wp.int64, device=device)
        vertices.movable = mesh.model.particle_count
        self._progress = progress = Progress()
        progress.steer = self.steer = wp.zeros(int(STEER), dtype=int, device=device)
        progress.projections = PROJECTIONS
        self._records = False
        # the one ahead, those of all rounds, and those on velocities
        self.history = StepHistory(device, iterations=1 + (PROJECTIONS + 1) * int(ITERATIONS))
        self._another_round = self.steer[int(ACTIVE) : int(ACTIVE) + 1]
        progress.iteration = wp.zeros(2, dtype=int, device=device)
        self._another_batch = progress.iteration[int(ANOTHER) : int(ANOTHER) + 1]
        self._tolerance = tolerance * separation
        self.worlds = max(1, mesh.model.world_count)
        progress.contact_round = wp.zeros(self.worlds, dtype=int, device=device)
        self._turn = wp.zeros((self.worlds, int(SUMS)), dtype=wp.int64, device=device)
        self.half_spaces = half_spaces = HalfSpaces()
        half_spaces.friction, half_spaces.world = plane_friction, mesh.device_planes.world
        for name in ("start", "end"):
            setattr(half_spaces, name, wp.zeros(len(plane_friction), dtype=wp.vec4d, device=device))
        plane_worlds = mesh.planes.world
        planes_of_a_world = np.bincount(plane_worlds[plane_worlds >= 0], minlength=1).max() + (plane_worlds < 0).sum()
        self._most_penetrations = vertices.movable * int(planes_of_a_world)
        self._kept = wp.zeros(1, dtype=int, device=device)
        self.constraints = self._with_room(0)
        self._retired = []

    @property
    def projections(self) -> int:
        """Rounds of projection at most; what still collides is truncated."""
        return self._progress.projections

    @projections.setter
    def projections(self, value):
        self._progress.projections = value

    def prepare(self):
        """Resolves the model as it stands, which makes what a CUDA graph cannot make: the hierarchy, and some room."""
        for place in (self.start, self.end):
            place(self._mesh.model.particle_q, self._mesh.model.body_q)
        self.resolve(1.0)
        self.steer.zero_()
        self.vertices.done.zero_()

    def start(self, particle_q, body_q):
        """Takes down where everything is at the start of a step, from arrays as of :meth:`ModelMesh.positions`."""
        self._place(particle_q, body_q, self.vertices.x0, self.half_spaces.start)

    def end(self, particle_q, body_q):
        """Takes down where everything wants to be at the end of the step."""
        self._place(particle_q, body_q, self.vertices.x1, self.half_spaces.end)

    def _place(self, particle_q, body_q, positions, planes):
        self._mesh.positions(particle_q, body_q, positions)
        place = self._mesh.device_planes
        inputs = [place.point, place.normal, place.body, body_q]
        wp.launch(place_half_spaces, len(planes), inputs=inputs, outputs=[planes], device=self.device)

    def resolve(self, dt, *, records=False):
        """Changes ``vertices.x1`` and ``vertices.velocity`` until no contact is left, or none that can be moved.

        Args:
            dt: Length of the step [s].
            records: Whether to take down what is done in ``history``.

        Raises:
            RuntimeError: If that is captured in a CUDA graph, and there has been no such step outside one.
        """
        vertices = self.vertices
        self._records = records
        self._progress.history = History()
        if records:
            if not self.device.is_capturing:
                self.history.reserve_entries(_LEAST_ENTRIES)
            elif not len(self.history.arrays.constraint):
                raise RuntimeError("step once on a tape before capturing, so that there is room to take down steps")
            self._progress.history = self.history.begin()
        wp.copy(vertices.wanted_x1, vertices.x1)
        wp.copy(vertices.wanted_velocity, vertices.velocity)
        self.steer.zero_()
        self._progress.contact_round.fill_(-1)
        self.constraints.count.zero_()
        for sums in (vertices.displacement, vertices.velocity_change, vertices.done, vertices.changed):
            sums.zero_()
        vertices.time.fill_(int(NEVER))
        if self._most_penetrations:  # what only lies on a plane needs no second detection
            self._reserve(self._most_contacts)
            self._collect_penetrations(ahead=True)
            self._mark_round()
            self._start_iterations()
            self._reserve_entries(1)
            self._displace()
        self._detect(refit=False)
        wp.capture_if(self._another_round, self._collect_near_pairs)
        wp.capture_while(self._another_round, self._round, dt=dt)
        self._mark_round(after=1)
        wp.capture_if(self.constraints.count, self._change_velocities, dt=dt)
        wp.launch(_stand_still, vertices.movable, inputs=[vertices, self._progress], device=self.device)

    def _collect_penetrations(self, ahead):
        inputs = [self.vertices, self.half_spaces, self.constraints, self._progress, self.separation, ahead]
        wp.launch(collect_penetrations, self.vertices.movable, inputs=inputs, device=self.device)

    def _collect_near_pairs(self):
        """Makes constraints of what is near, where something has been hit."""
        detector, vertices = self.detector, self.vertices
        retry_until_fits(detector.find_candidates, detector, self.device)
        wp.copy(self._kept, self.constraints.count)

        def collect() -> None:
            for narrow_phase, elements in self._with_elements():
                near = NearPairs()
                near.edges = int(narrow_phase.kind == PairKind.EDGE_EDGE)
                near.elements, near.pairs, near.counts = elements, narrow_phase.queue, narrow_phase.counts
                inputs = [vertices, near, self.constraints, self._progress, self.separation]
                self._launch_over(collect_near_pairs, near.pairs, near.counts, Count.QUEUED, inputs)

        retry_until_fits(collect, self, self.device)
        inputs = [self.constraints, self._kept, self._most_contacts, detector.counters.array, detector.capacities]
        wp.launch(forget_near_pairs, 1, inputs=inputs, device=self.device)

    def _mark_round(self, after=0):
        """Marks, where there is a history, the beginning of a round or the end of the last."""
        if self._records:
            wp.launch(_mark_round, 1, inputs=[self.constraints, self._progress, after], device=self.device)

    def _displace(self):
        """An iteration over constraints on positions."""
        vertices, constraints, progress = self.vertices, self.constraints, self._progress
        inputs = [vertices, constraints, progress]
        self._launch_over_constraints(enlist_displacing, [*inputs, self._tolerance])
        self._launch_over(displace, constraints.acting, constraints.acting_count, 0, inputs)
        wp.launch(move_vertices, vertices.movable, inputs=inputs, device=self.device)

    def _accelerate(self, dt):
        """An iteration over constraints on velocities."""
        constraints, progress = self.constraints, self._progress
        inputs = [self.vertices, constraints]
        tolerance = self._tolerance
        self._launch_over_constraints(enlist_accelerating, [*inputs, self.restitution, tolerance, dt])
        inputs = [*inputs, progress, self.restitution]
        self._launch_over(accelerate, constraints.acting, constraints.acting_count, 0, inputs)
        self._change()

    def _change(self):
        inputs = [self.vertices, self.constraints, self._progress]
        wp.launch(change_velocities, self.vertices.movable, inputs=inputs, device=self.device)

    def _iterate(self, iteration, **options):
        """Iterates until no constraint acts any more, or long enough."""

        def batch():
            self._reserve_entries(BATCH)
            for _ in range(BATCH):
                iteration(**options)

        self._start_iterations()
        wp.capture_while(self._another_batch, batch)

    def _reserve_entries(self, iterations):
        """Makes room to take down so many iterations, if they are to be; a CUDA graph has what room it has."""
        if self._records and not self.device.is_capturing:
            entries = iterations * int(self.constraints.count.numpy()[0])
            self._progress.history = self.history.reserve_entries(entries)

    def _start_iterations(self):
        self._progress.iteration.zero_()
        self._another_batch.fill_(1)

    def _change_velocities(self, dt):
        """Makes velocities of what the constraints that have displaced something let them be."""
        vertices = self.vertices
        inputs = [vertices, self.constraints]
        self._launch_over_constraints(start_impulses, [*inputs, dt])
        self._change()
        self._iterate(self._accelerate, dt=dt)
        self._turn.zero_()
        self._launch_over_constraints(sum_torques, [*inputs, self._turn])
        for kernel in (sum_bodies, turn_vertices):
            wp.launch(kernel, vertices.movable, inputs=[vertices, self._turn], device=self.device)

    def _round(self, dt):
        """One round: what the contacts ask for, and whether there still are some."""
        self._mark_round()
        self._iterate(self._displace)
        if self._records and not self.device.is_capturing:
            self._progress.history = self.history.reserve_truncations(self.vertices.movable)
        inputs = [self.vertices, self._progress, *self._contacts(), dt]
        wp.launch(_truncate_vertices, self.vertices.movable, inputs=inputs, device=self.device)
        self._detect(refit=True)

    def _detect(self, refit):
        """Detects the motion as it is now, and decides what that means."""
        detector, vertices, progress = self.detector, self.vertices, self._progress
        changed = vertices.changed if refit else None
        retry_until_fits(
            lambda: detector.find_contacts(vertices.x0, vertices.x1, refit=refit, changed=changed),
            detector,
            self.device,
        )
        vertices.changed.zero_()
        self._reserve(self._most_contacts)
        inputs = [self.constraints, progress, self._most_contacts]
        wp.launch(_forget_if_full, 1, inputs=inputs, device=self.device)
        for contacts in self._contacts():
            inputs = [vertices, contacts, self.constraints, progress, self.separation]
            self._launch_over(collect_contacts, contacts.pairs, contacts.counts, Count.CONTACTS, inputs)
            if self._records:
                inputs = [vertices, contacts, progress.history]
                self._launch_over(count_grazing, contacts.pairs, contacts.counts, Count.CONTACTS, inputs)
        if self._most_penetrations:
            self._collect_penetrations(ahead=False)
        wp.launch(_decide, 1, inputs=[progress, detector.counters.array, detector.capacities], device=self.device)

    def _contacts(self):
        """The contacts that the last detection found, vertex-face and edge-edge."""
        for narrow_phase, elements in self._with_elements():
            found = narrow_phase.contacts
            contacts = Contacts()
            contacts.edges = int(narrow_phase.kind == PairKind.EDGE_EDGE)
            contacts.elements, contacts.counts = elements, narrow_phase.counts
            contacts.pairs, contacts.status, contacts.localized = found.pairs, found.status, found.within_tolerance
            contacts.toi, contacts.coordinates, contacts.normal = found.toi, found.coordinates, found.normal
            yield contacts

    def _with_elements(self):
        """Each narrow phase with the vertices of its second elements."""
        return ((n, self.detector.mesh.device_elements(n.kind)) for n in self.detector.narrow_phases)

    @property
    def _most_contacts(self):
        """How many contacts a detection may find as its queues are."""
        return self._most_penetrations + sum(len(n.contacts.pairs) for n in self.detector.narrow_phases)

    def _with_room(self, room):
        """Constraints, none yet."""
        constraints = Constraints()
        constraints.count = wp.zeros(1, dtype=int, device=self.device)
        constraints.vertices = wp.empty(room, dtype=wp.vec4i, device=self.device)
        constraints.weights = wp.empty(room, dtype=wp.vec4d, device=self.device)
        constraints.normal = wp.empty(room, dtype=wp.vec3d, device=self.device)
        constraints.separation, constraints.urgency = (
            wp.empty(room, dtype=wp.float64, device=self.device) for _ in range(2)
        )
        constraints.friction = wp.empty(room, dtype=float, device=self.device)
        constraints.origin = wp.empty(room, dtype=int, device=self.device)
        constraints.localized = wp.empty(room, dtype=wp.bool, device=self.device)
        constraints.toi = wp.empty(room, dtype=wp.float64, device=self.device)
        constraints.acting_count = wp.zeros(1, dtype=wp.int64, device=self.device)
        constraints.slow, constraints.iteration, constraints.acting = (
            wp.empty(room, dtype=int, device=self.device) for _ in range(3)
        )
        constraints.displacing, constraints.impulse, constraints.reached = (
            wp.empty(room, dtype=wp.vec3d, device=self.device) for _ in range(3)
        )
        return constraints

    def _reserve(self, needed):
        """Makes room for so many more constraints, and as many in some rounds; a CUDA graph has what room it has."""
        old = self.constraints
        if self.device.is_capturing:
            return
        filled = int(old.count.numpy()[0])
        if len(old.vertices) < filled + needed:
            self.constraints = new = self._with_room(filled + _ROUNDS_OF_ROOM * needed)
            for name in Constraints.vars if filled else ():
                array = getattr(old, name)
                wp.copy(getattr(new, name), array, count=min(filled, len(array)))
            self._retired.append(old)  # a CUDA graph may still write to it

    def grow(self) -> bool:
        """Enlarges the constraints, without the near pairs, if those did not fit; returns whether. Synchronizes."""
        kept, found = (int(count.numpy()[0]) for count in (self._kept, self.constraints.count))
        if found + self._most_contacts <= len(self.constraints.vertices):
            return False
        wp.copy(self.constraints.count, self._kept)
        self._reserve(self._most_contacts + capacity_for(found - kept, "proximities"))
        return True

    def _launch_over(self, kernel, queue, counts, count, inputs):
        """Launches a kernel over a queue: as far as it is filled on the CPU, over all of it on a GPU.

        Unlike :func:`warp_bsc.detection.launch.launch_over_queue` on one thread of the CPU, where Warp's atomic
        additions are none.
        """
        entries = len(queue)
        if self.device.is_cpu:
            entries = min(entries, int(counts.numpy()[count]))
        wp.launch(kernel, entries, inputs=inputs, device=self.device)

    def _launch_over_constraints(self, kernel, inputs):
        self._launch_over(kernel, self.constraints.vertices, self.constraints.count, 0, inputs)
