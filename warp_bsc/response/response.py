"""The response to collisions: moves vertices until their motion is certified to be free of collisions."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..detection.broad_phase_hierarchy import BroadPhaseHierarchy
from ..detection.intersections import CrossingCandidates
from ..detection.launch import retry_until_fits
from ..detection.pipeline import DetectionPipeline
from ..detection.settings import Count, PairKind, capacity_for
from .adjoint_kernels import count_grazing
from .angular_momentum import SUMS, sum_body_moments, sum_moments, sum_torques, turn_bodies, turn_vertices
from .bodies import (
    begin_bodies,
    change_body_velocities,
    cut_bodies,
    find_body_shares,
    freeze_undetected_bodies,
    move_bodies,
    move_to_end,
    place_vertices,
    set_vertex_velocities,
)
from .buffers import (
    Constraints,
    Progress,
    SolveStatus,
    SweepStatus,
    Vertices,
    allocate_bodies,
    allocate_constraints,
    allocate_vertices,
)
from .constraints import MAX_DIVISIONS, MAX_ITERATIONS, MAX_SLOW_ITERATIONS, MAX_TRUNCATIONS, Contacts
from .dividing_planes import DividingPlanes, allocate_dividing_planes
from .exclusion import Connectivity, count_crossings
from .kernels import (
    begin_step,
    collect_contacts,
    decide,
    divide_near_pairs,
    drop_if_full,
    freeze_undetected,
    record_body_truncations,
    record_offsets,
    truncate_vertices,
)
from .model_mesh import ModelMesh
from .model_motion import ModelMotion
from .planes import collect_penetrations
from .projection import (
    MAX_SWEEPS,
    SLOW_POSITION_SWEEPS,
    SLOW_VELOCITY_SWEEPS,
    SWEEPS_PER_BATCH,
    activate_position_constraints,
    activate_velocity_constraints,
    initialize_velocity_multipliers,
    project_positions,
    project_velocities,
    start_sweeps,
    update_positions,
    update_velocities,
)
from .proximities import Proximities, collect_proximities, drop_proximities, find_nearest
from .queueless import find_contacts_without_queues
from .step_record import StepRecord, StepRecorder, name_elements

__all__ = ["MAX_SWEEPS_PER_STEP", "Resolution", "Response"]

MAX_SWEEPS_PER_STEP = 1 + (MAX_ITERATIONS + 1) * int(MAX_SWEEPS)
"""Most sweeps of a step: one ahead of the detection, those of all iterations, and those on velocities."""

_MIN_ENTRIES = 4096
"""Least capacity of a record for active constraints, summed over sweeps."""
_PAIRS_PER_FACE = 32
"""Capacity of the detector's queues on a GPU, for each face: those of a CUDA graph cannot grow."""
_TOLERANCE = 0.1
"""Tolerance of constraints as a share of the separation."""
_BLOCKS = 8
"""Blocks of threads, for each multiprocessor of a GPU, of a launch over a queue."""
_DIVIDING_PLANES = 32
"""Capacity for dividing planes, for each particle: a pile of 30 sheets takes 9."""
_ITERATIONS_RESERVED = 3
"""Iterations for whose contacts constraints are reserved. In a CUDA graph, proximities take the room of all but one."""


@dataclass(frozen=True)
class Resolution:
    """The result of :meth:`Response.resolve`; the next call overwrites its arrays.

    Attributes:
        vertices: The vertices as they were moved, :class:`.buffers.Vertices`.
        constraints: The constraints that moved them, :class:`.buffers.Constraints`.
        status: What came of it, :class:`.buffers.SolveStatus`.
        status_values: The elements of ``status`` as one array of int.
    """

    vertices: Vertices
    constraints: Constraints
    status: SolveStatus
    status_values: wp.array


class Response:
    """Moves the vertices of a motion until it is certified to be free of collisions, on the device.

    Iterations of detection and projection come first: each contact is moved apart at the end of the step, and the new
    motion is detected again, as far as it changed. Vertices that still collide after ``max_iterations`` are divided,
    see :mod:`.dividing_planes`, and if that is not enough, frozen. Worlds divide after one iteration if their contacts
    are all of slow elements that nothing immovable pushes, and none of a body. This ends, because vertices that stood
    apart and stand still do not collide. A detection whose queues are too small in a CUDA graph is completed without
    queues, see :mod:`.queueless`.

    Bodies that can be moved are projected with the particles, each by its pose, see :mod:`.bodies`. One whose vertices
    are to be divided or frozen goes back along its path as one, and collides with what is left in the next iteration.

    Where the mesh has minimum distances, see :meth:`.model_mesh.ModelMesh.keep_distances`, a contact is a pair that
    comes nearer than it may. The first detection also adds constraints for pairs that come within the separation of
    that: the distance by which these are moved apart goes to zero where a pair only just comes near.

    If the response is differentiable, paths are truncated before their first contact instead of divided, and a
    detection whose queues are too small freezes all vertices, uncertified.

    Attributes:
        detector: The detector.
        status: What came of the last step, :class:`.buffers.SolveStatus`.
        vertices: The vertices as the last step left them, :class:`.buffers.Vertices`.
        constraints: The constraints of the last step, :class:`.buffers.Constraints`.
        progress: The state of the iterations, :class:`.buffers.Progress`.
        separation: Distance that projection moves contacts apart [m].
        restitution: Share of the approaching velocity that comes back, array of one float.
        worlds: Number of worlds.
        device: The device.
    """

    def __init__(
        self,
        mesh: ModelMesh,
        *,
        separation: float,
        restitution: wp.array[float],
        differentiable: bool,
        moves_bodies: bool = False,
    ):
        """Allocates buffers.

        Args:
            mesh: The mesh.
            separation: Distance that projection moves contacts apart [m].
            restitution: Share of the approaching velocity that comes back, in [0, 1], array of one float.
            differentiable: Whether all sweeps are made and paths are truncated, not divided, as the adjoint has it:
                whether a constraint is active would otherwise depend on tiny changes, and results would jump.
            moves_bodies: Whether motions have bodies that can be moved.
        """
        self.device = device = mesh.device
        self._keeps_distances = mesh.distances is not None
        pairs_per_face = None if device.is_cpu else _PAIRS_PER_FACE
        self.detector = DetectionPipeline(mesh, pairs_per_face=pairs_per_face, min_distances=mesh.distances)
        self.separation, self.restitution = separation, restitution
        self._tolerance = 0.0 if differentiable else _TOLERANCE * separation
        self._differentiable = differentiable
        self.worlds = max(1, mesh.model.world_count)
        self._most_blocks = _BLOCKS * device.sm_count
        self._summing_threads = 1 if device.is_cpu else 256 * device.sm_count
        self.vertices = allocate_vertices(mesh.vertex_count, device)
        self._movable = mesh.model.particle_count
        self._bodies = mesh.model.body_count if moves_bodies else 0
        if moves_bodies:
            self.vertices.bodies = allocate_bodies(self._bodies, device)
        self._shape_vertices = mesh.vertex_count - self._movable
        self._connectivity = connectivity = Connectivity()
        connectivity.faces, connectivity.edges = mesh.device_faces, mesh.device_edges
        connectivity.vertex_edges, connectivity.edge_faces = mesh.device_vertex_edges, mesh.device_edge_faces
        self._status_values = wp.zeros(len(SolveStatus.vars), dtype=int, device=device)
        self.status = name_elements(SolveStatus, self._status_values)
        sweep_values = wp.zeros(len(SweepStatus.vars), dtype=int, device=device)
        self._sweep = name_elements(SweepStatus, sweep_values)
        self.progress = progress = Progress()
        progress.status, progress.sweep = self.status, self._sweep
        progress.max_iterations = MAX_ITERATIONS
        for name in ("contact_iteration", "fast"):
            setattr(progress, name, wp.zeros(self.worlds, dtype=int, device=device))
        self._motion: ModelMotion  # of the step that is being resolved
        self._recorder: StepRecorder | None = None
        self._turn = wp.zeros((self.worlds, int(SUMS)), dtype=wp.int64, device=device)
        plane_worlds = mesh.planes.world
        planes_of_a_world = np.bincount(plane_worlds[plane_worlds >= 0], minlength=1).max() + (plane_worlds < 0).sum()
        self._stopped = mesh.vertex_count if moves_bodies else self._movable  # vertices that planes may stop
        self._most_penetrations = self._stopped * int(planes_of_a_world)
        self._kept = wp.zeros(1, dtype=int, device=device)
        self._nearest = None if differentiable else wp.empty((mesh.vertex_count, 6), dtype=float, device=device)
        self._crossing_candidates = CrossingCandidates(mesh)
        self._dividing_planes = allocate_dividing_planes(
            mesh.vertex_count, _DIVIDING_PLANES * self._movable, device, keep_distances=self._keeps_distances
        )
        self._dividing = DividingPlanes() if differentiable else self._dividing_planes
        progress.max_slow_iterations = MAX_ITERATIONS if differentiable else MAX_SLOW_ITERATIONS
        progress.slow_position_sweeps = int(MAX_SWEEPS) if differentiable else SLOW_POSITION_SWEEPS
        progress.slow_velocity_sweeps = int(MAX_SWEEPS) if differentiable else SLOW_VELOCITY_SWEEPS
        progress.max_truncations = int(MAX_TRUNCATIONS) if differentiable else MAX_DIVISIONS
        self.constraints = allocate_constraints(0, device)
        self._retired = []

    @property
    def max_iterations(self) -> int:
        """Most iterations of detect and project; vertices that still collide are divided."""
        return self.progress.max_iterations

    @max_iterations.setter
    def max_iterations(self, value: int) -> None:
        self.progress.max_iterations = value

    def prepare(self, motion: ModelMotion) -> None:
        """Resolves a motion to allocate buffers, which a CUDA graph cannot; clears the status."""
        self.resolve(motion, 1.0)
        self._status_values.zero_()
        self.vertices.outcome.zero_()

    def resolve(self, motion: ModelMotion, dt: float, record: StepRecorder | None = None) -> Resolution:
        """Returns the motion without its contacts, except for those that cannot be resolved.

        Args:
            motion: The motion that is wanted; it is only read.
            dt: Length of the step [s].
            record: Records the step for its adjoint; None to record nothing.

        Raises:
            RuntimeError: If a recorded step is captured in a CUDA graph, and there was none outside one.
        """
        self.find_contacts(motion, record)
        return self.finish(dt)

    def find_contacts(self, motion: ModelMotion, record: StepRecorder | None = None) -> None:
        """Detects the contacts of a motion, as the first half of :meth:`resolve`; ``status`` says whether any are left.

        Args:
            motion: The motion that is wanted; it is only read.
            record: As for :meth:`resolve`.

        Raises:
            RuntimeError: As for :meth:`resolve`.
        """
        self._begin(motion, record)
        if self._most_penetrations:  # cloth that only lies on a plane then needs one detection
            self._reserve(self._most_contacts)
            self._collect_penetrations(ahead=True)
            self._record_offsets()
            wp.capture_if(self.constraints.count, self._leave_planes)
        self._detect(refit=False)
        self._record_offsets(after=1)

    def finish(self, dt: float) -> Resolution:
        """Resolves the contacts that :meth:`find_contacts` found, as the second half of :meth:`resolve`."""
        wp.capture_if(self.status.unfinished, self._finish, dt=dt)
        return self.resolution

    @property
    def resolution(self) -> Resolution:
        """The motion as it was resolved last."""
        return Resolution(self.vertices, self.constraints, self.status, self._status_values)

    def collect_near_pairs(self) -> None:
        """Adds constraints for proximities after :meth:`find_contacts`, in worlds that have contacts."""
        wp.capture_if(self.status.active, self._collect_near_pairs)

    def collect_penetrations(self, motion: ModelMotion) -> None:
        """Adds constraints for vertices that a motion takes into solids of planes."""
        if self._most_penetrations:
            self._motion = motion
            self._reserve(self._most_penetrations)
            self._collect_penetrations(ahead=True)

    def project(self, motion: ModelMotion, dt: float, tolerance: float) -> None:
        """Projects positions and velocities of a motion onto the constraints as they are, without detection.

        Args:
            motion: The motion that is wanted, of ``vertices``; it is only read.
            dt: Its length [s].
            tolerance: Tolerance of positions as a share of that of a whole step.
        """
        self._motion = motion
        self._project(self._sweep_positions, tolerance=tolerance * self._tolerance)
        self._change_velocities(dt)

    def begin_bodies(self, motion: ModelMotion) -> None:
        """Initializes the bodies of ``vertices`` by what a motion wants of them."""
        self._motion = motion
        self._launch_over_bodies(begin_bodies)

    def inspect(self, motion: ModelMotion) -> Resolution:
        """Returns the motion as it is, with a status that says whether it has contacts; ``remaining`` counts them.

        Args:
            motion: The motion that is wanted; it is only read.
        """
        self._begin(motion, None)
        self._detect(refit=False)
        return self.resolution

    def _begin(self, motion, recorder):
        """Initializes everything for a step, and counts crossings at its start."""
        self._motion, self._recorder = motion, recorder
        self._record = StepRecord()  # which records nothing
        if recorder is not None:
            if not self.device.is_capturing:
                recorder.reserve_entries(_MIN_ENTRIES)
            elif not len(recorder.record.constraint):
                raise RuntimeError("the record of steps has no capacity: step once on a tape before capturing")
            self._record = recorder.begin()
        inputs = [motion.vertices, self.worlds]
        outputs = [self.vertices, self.constraints, self._dividing_planes, self.progress]
        size = max(len(self.vertices.x1), self.worlds + 1)
        wp.launch(begin_step, size, inputs=inputs, outputs=outputs, device=self.device)
        self.begin_bodies(motion)
        wp.capture_if(self.status.recount, self._count_crossings)

    def _count_crossings(self):
        """Counts the edges that cross faces at the start, of which one is movable."""
        motion, candidates = self._motion.vertices, self._crossing_candidates
        self.status.crossings.zero_()
        retry_until_fits(lambda: candidates.find(motion.x0), candidates, self.device)
        inputs = [motion, self._connectivity, candidates.pairs, candidates.counts, self.status.crossings]
        self._launch_over(count_crossings, [(candidates.pairs, candidates.counts, Count.QUEUED)], inputs)

    def _leave_planes(self):
        """Sweeps over the constraints once, ahead of the first detection."""
        self._start_sweeps()
        self._reserve_entries(1)
        self._sweep_positions()

    def _finish(self, dt):
        """Iterates as long as there are contacts, and changes velocities."""
        wp.capture_if(self.status.active, self._collect_near_pairs)
        wp.capture_while(self.status.active, self._iterate, dt=dt)
        self._record_offsets(after=1)
        wp.capture_if(self.constraints.count, self._change_velocities, dt=dt)
        self._launch_over_particles(freeze_undetected, [self._motion.vertices, self.vertices, self.progress])
        self._launch_over_bodies(freeze_undetected_bodies, self.progress)
        self._launch_over_shape_vertices(place_vertices)

    def _collect_penetrations(self, ahead):
        motion = self._motion
        inputs = [motion.vertices, self.vertices, motion.planes, self.constraints, self._dividing, self.progress]
        inputs += [self.separation, ahead]
        wp.launch(collect_penetrations, self._stopped, inputs=inputs, device=self.device)

    def _collect_near_pairs(self):
        """Adds constraints for proximities, in worlds that have contacts."""
        detector, motion, vertices = self.detector, self._motion.vertices, self.vertices
        retry_until_fits(detector.find_candidates, detector, self.device)
        wp.copy(self._kept, self.constraints.count)

        def collect() -> None:
            kinds = []
            for narrow_phase, elements in self._with_elements()[:2]:
                near = Proximities()
                kinds.append(near)
                near.mesh = self._connectivity
                near.edges = int(narrow_phase.kind == PairKind.EDGE_EDGE)
                near.elements, near.pairs, near.counts = elements, narrow_phase.queue, narrow_phase.counts
            queues = [(near.pairs, near.counts, Count.QUEUED) for near in kinds]
            nearest = self._nearest
            if nearest is not None:
                nearest.fill_(np.inf)
                self._launch_over(find_nearest, queues[:1], [motion, kinds[0], nearest])
            inputs = [motion, vertices, *kinds, nearest, self.constraints, self.progress, self.separation]
            self._launch_over(collect_proximities, queues, inputs)

        retry_until_fits(collect, self, self.device)
        inputs = [self.constraints, self._kept, self._most_contacts, detector.counters.array, detector.capacities]
        wp.launch(drop_proximities, 1, inputs=inputs, device=self.device)

    def _record_offsets(self, after=0):
        """Records, if the step is recorded, where an iteration begins or where the last ended."""
        if self._recorder is not None:
            wp.launch(
                record_offsets, 1, inputs=[self.constraints, self.progress, self._record, after], device=self.device
            )

    def _sweep_positions(self, first=True, last=True, tolerance=None):
        """Sweeps over the constraints on positions once; the first sweep fills the active set, the last empties it."""
        constraints = self.constraints
        inputs = [self._motion.vertices, self.vertices, constraints, self.progress]
        if first:
            options = [self._tolerance if tolerance is None else tolerance]
            self.launch_over_constraints(activate_position_constraints, [*inputs, *options])
        inputs.append(self._record)
        self._launch_over(project_positions, [(constraints.active_set, constraints.active_count, 0)], inputs)
        self._launch_over_particles(update_positions, [*inputs, last], finishes=True)
        self._launch_over_bodies(move_bodies, last)
        self._launch_over_shape_vertices(place_vertices)

    def _sweep_velocities(self, dt, first=True, last=True):
        """Sweeps over the constraints on velocities once, like :meth:`_sweep_positions`."""
        constraints = self.constraints
        inputs = [self._motion.vertices, self.vertices, constraints, self.progress]
        if first:
            options = [self.restitution, self._tolerance, dt]
            self.launch_over_constraints(activate_velocity_constraints, [*inputs, *options])
        inputs = [*inputs, self._record, self.restitution]
        self._launch_over(project_velocities, [(constraints.active_set, constraints.active_count, 0)], inputs)
        self._update_velocities(last)

    def _update_velocities(self, last=True):
        inputs = [self._motion.vertices, self.vertices, self.constraints, self.progress, self._record, last]
        self._launch_over_particles(update_velocities, inputs, finishes=True)
        self._launch_over_bodies(change_body_velocities, last)
        self._launch_over_shape_vertices(set_vertex_velocities)

    def _project(self, sweep, **options):
        """Sweeps until no constraint is active, or MAX_SWEEPS times; not at all if vertices are to be divided."""

        def batch():
            self._reserve_entries(SWEEPS_PER_BATCH)
            for i in range(SWEEPS_PER_BATCH):
                sweep(first=i == 0, last=i == SWEEPS_PER_BATCH - 1, **options)

        self._start_sweeps()
        wp.capture_while(self._sweep.another, batch)

    def _reserve_entries(self, sweeps):
        """Reserves entries for sweeps, if the step is recorded; does nothing in a CUDA graph."""
        if self._recorder is not None and not self.device.is_capturing:
            entries = sweeps * int(self.constraints.count.numpy()[0])
            self._record = self._recorder.reserve_entries(entries)

    def _start_sweeps(self):
        wp.launch(start_sweeps, 1, inputs=[self.progress], device=self.device)

    def _change_velocities(self, dt):
        """Solves the velocity constraints of all contacts that moved a vertex."""
        inputs = [self._motion.vertices, self.vertices]
        self._launch_over_bodies(move_to_end)
        self.launch_over_constraints(initialize_velocity_multipliers, [*inputs, self.constraints, dt])
        self._update_velocities()
        self._project(self._sweep_velocities, dt=dt)
        self._turn.zero_()
        threads = self._summing_threads
        for kernel, arguments in ((sum_torques, [self.constraints]), (sum_moments, [self._movable])):
            wp.launch(kernel, threads, inputs=[*inputs, *arguments, threads, self._turn], device=self.device)
        self._launch_over_bodies(sum_body_moments, self._turn)
        self._launch_over_particles(turn_vertices, [*inputs, self._turn])
        self._launch_over_bodies(turn_bodies, self._turn)

    def _iterate(self, dt):
        """Projects or truncates once, and detects the new motion."""
        self._record_offsets()
        self._project(self._sweep_positions)
        if self._recorder is not None and not self.device.is_capturing:
            self._record = self._recorder.reserve_truncations(self._movable + self._bodies)
        motion, vertices, dividing = self._motion.vertices, self.vertices, self._dividing
        if not self._differentiable:
            inputs = [motion, vertices, self.constraints, dividing, self.progress, self.separation]
            self.launch_over_constraints(divide_near_pairs, inputs)
        inputs = [motion, vertices, self.progress, self._record, dividing]
        inputs += [*self._contacts()[0], dt]
        self._launch_over_particles(truncate_vertices, inputs)
        self._launch_over_shape_vertices(find_body_shares, self.progress, self._dividing, self._record)
        if self._recorder is not None:
            self._launch_over_shape_vertices(record_body_truncations, self._record, *self._contacts()[0])
        self._launch_over_bodies(cut_bodies, self.progress, dt)
        self._launch_over_shape_vertices(place_vertices)
        self._detect(refit=True)

    def _detect(self, refit):
        """Detects the motion as it is now, adds constraints for its contacts, and decides whether to iterate again."""
        detector, motion, vertices = self.detector, self._motion.vertices, self.vertices
        progress = self.progress
        changed = vertices.changed if refit else None
        retry_until_fits(
            lambda: detector.find_contacts(motion.x0, vertices.x1, refit=refit, changed=changed),
            detector,
            self.device,
        )
        self._reserve(self._most_contacts)
        if refit:  # before, nothing has changed, and there is always enough
            vertices.changed.zero_()
            inputs = [self.constraints, self._record, self._most_contacts]
            wp.launch(drop_if_full, 1, inputs=inputs, device=self.device)
        of_elements, of_points = self._contacts()
        for contacts in (of_elements, of_points) if of_points else (of_elements,):
            queues = [(c.pairs, c.counts, Count.CONTACTS) for c in contacts]
            inputs = [motion, vertices, *contacts, self.constraints, self._dividing, progress, self.separation]
            self._launch_over(collect_contacts, queues, [*inputs, *self._fill_of_queues()])
        if self._recorder is not None:
            queues = [(c.pairs, c.counts, Count.CONTACTS) for c in of_elements]
            self._launch_over(count_grazing, queues, [motion, vertices, *of_elements, self._record])
        if self._most_penetrations:
            self._collect_penetrations(ahead=False)
        self._decide()
        if self._can_search:
            wp.capture_if(self.status.undetected, self._search)

    @property
    def _can_search(self):
        """Whether detections can do without queues; on the CPU these grow, and the adjoint needs what is in them."""
        return not self._differentiable and isinstance(self.detector.broad_phase, BroadPhaseHierarchy)

    def _decide(self):
        inputs = [self.constraints, self.progress, *self._fill_of_queues()]
        wp.launch(decide, 1, inputs=inputs, device=self.device)

    def _fill_of_queues(self):
        """Returns what says whether a queue of the detector overflowed, and whether contacts can be searched then."""
        return self.detector.counters.array, self.detector.capacities, self._can_search

    def _search(self):
        """Completes a detection whose queues were too small: all contacts that are left are divided from here on."""
        broad_phase, motion = self.detector.broad_phase, self._motion.vertices
        assert isinstance(broad_phase, BroadPhaseHierarchy)
        broad_phase.fit(motion.x0, self.vertices.x1)
        find_contacts_without_queues(
            broad_phase, self._connectivity, motion, self.vertices, self._dividing, self.progress, self.separation
        )
        if self._most_penetrations:
            self._collect_penetrations(ahead=False)
        self._decide()

    def _contacts(self):
        """Returns the contacts that the last detection found: vertex-face and edge-edge, and those of points."""
        contacts = [self._contacts_of(*phase) for phase in self._with_elements()]
        return contacts[:2], contacts[2:]

    def _contacts_of(self, narrow_phase, elements):
        found = narrow_phase.contacts
        contacts = Contacts()
        contacts.mesh = self._connectivity
        contacts.kind = int(narrow_phase.kind)
        contacts.edges = int(narrow_phase.kind == PairKind.EDGE_EDGE)
        contacts.elements, contacts.counts = elements, narrow_phase.counts
        contacts.pairs, contacts.status, contacts.within_tolerance = (
            found.pairs,
            found.status,
            found.within_tolerance,
        )
        contacts.toi, contacts.coordinates, contacts.normal = found.toi, found.coordinates, found.normal
        return contacts

    def _with_elements(self):
        """Returns each narrow phase with the vertices of its second elements, those of points last."""
        return [(n, self.detector.mesh.device_elements(n.kind)) for n in self.detector.narrow_phases]

    @property
    def _most_contacts(self):
        """Most contacts that a detection finds with its queues as they are."""
        return self._most_penetrations + sum(len(n.contacts.pairs) for n in self.detector.narrow_phases)

    def _reserve(self, needed):
        """Reserves ``needed`` more constraints, and as many for later iterations; does nothing in a CUDA graph."""
        old = self.constraints
        if self.device.is_capturing:
            return
        filled = int(old.count.numpy()[0])
        if len(old.vertices) < filled + needed:
            capacity = filled + _ITERATIONS_RESERVED * needed
            self.constraints = new = allocate_constraints(capacity, self.device, keep_distances=self._keeps_distances)
            for name in Constraints.vars if filled else ():
                array = getattr(old, name)
                wp.copy(getattr(new, name), array, count=min(filled, len(array)))
            self._retired.append(old)  # a CUDA graph may still write to it

    def grow(self) -> bool:
        """Enlarges the constraints, without the proximities, if those did not fit; returns whether. Synchronizes."""
        kept, found = (int(count.numpy()[0]) for count in (self._kept, self.constraints.count))
        if found + self._most_contacts <= len(self.constraints.vertices):
            return False
        wp.copy(self.constraints.count, self._kept)
        self._reserve(self._most_contacts + capacity_for(found - kept, "proximities"))
        return True

    def _launch_over(self, kernel, queues, inputs):
        """Launches a kernel over queues at once: over their entries on the CPU, over their capacity on a GPU.

        On the CPU it runs on one thread, unlike :func:`warp_bsc.detection.launch.launch_over_queue`, because Warp's
        additions are not atomic there. On a GPU each thread takes several entries, so that capacity costs little.

        Args:
            kernel: The kernel, which takes an entry of each queue.
            queues: Queues, each with its counts and the place of its own.
            inputs: Arguments of the kernel.
        """
        if self.device.is_cpu:
            entries = max(min(len(queue), int(counts.numpy()[count])) for queue, counts, count in queues)
            wp.launch(kernel, entries, inputs=inputs, device=self.device)
        else:
            entries = max(len(queue) for queue, _counts, _count in queues)
            wp.launch(kernel, entries, inputs=inputs, device=self.device, max_blocks=self._most_blocks)

    def launch_over_constraints(self, kernel: wp.Kernel, inputs: list) -> None:
        """Launches a kernel over the constraints, see :meth:`_launch_over`."""
        self._launch_over(kernel, [(self.constraints.vertices, self.constraints.count, 0)], inputs)

    def _launch_over_particles(self, kernel, inputs, finishes=False):
        """Launches a kernel over the particles; one that finishes a sweep runs even if there are none."""
        wp.launch(kernel, max(self._movable, int(finishes)), inputs=inputs, device=self.device)

    def _launch_over_bodies(self, kernel, *options):
        if self._bodies:
            inputs = [self._motion.vertices, self.vertices, *options]
            wp.launch(kernel, self._bodies, inputs=inputs, device=self.device)

    def _launch_over_shape_vertices(self, kernel, *options):
        """Launches a kernel over the vertices of shapes, if bodies can be moved."""
        if self._bodies:
            inputs = [self._motion.vertices, self.vertices, *options]
            wp.launch(kernel, self._shape_vertices, inputs=inputs, device=self.device)
