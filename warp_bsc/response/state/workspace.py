"""The buffers that a step works on, and launches of kernels over their elements."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Literal

import numpy as np
import warp as wp

from ...detection.pipeline import DetectionPipeline
from ...detection.run.settings import capacity_for
from ...kernels.arcs import Arcs
from ..tuning import (
    CANDIDATES_OF_CONTACT_IF_FEW,
    DIVIDING_PLANES,
    DIVIDING_PLANES_IF_FEW,
    ITERATIONS_RESERVED,
    ITERATIONS_RESERVED_IF_FEW,
    MAX_DIVISIONS,
    MAX_ITERATIONS,
    MAX_SLOW_ITERATIONS,
    PAIRS_PER_FACE,
    PAIRS_PER_STATIC_FACE,
    SLOW_POSITION_SWEEPS,
    STUCK_STEPS,
    SWEEPS_PER_BATCH,
    THREADS,
    TOLERANCE,
)
from .cluster import BLOCK, begin_worlds, count_constraints, list_constraints, threads_of_world
from .launches import Launches
from .mesh import ModelMesh, grouped_by_world
from .motion import ModelMotion, continues, takes_part
from .status import Detection, Loop, Result, SolveStatus, WorldCounts, clear_status, single_elements, start_sweeps
from .structs import (
    FROZEN,
    NEVER,
    NO_NODE,
    NOT_FINITE,
    NOT_PLACED,
    SUMS,
    Constraints,
    DividingPlanes,
    Incidence,
    MovedBodies,
    Step,
    Tetrahedra,
    Vertices,
    allocate,
)

wp.set_module_options({"enable_backward": False})

_VERY_MANY = wp.constant(2**30)
"""Crossings of an edge than which there are never more."""


@wp.kernel
def _begin(step: Step, worlds: int, dividing: DividingPlanes, status: SolveStatus):
    """Initializes the vertices by their prediction, and clears everything else."""
    i = wp.tid()
    motion, vertices = step.motion, step.vertices
    if i == 0:
        clear_status(status)
        step.constraints.count[0] = 0
        dividing.count[0] = 0
    if i < worlds:
        status.idle[i] = 0
        status.is_stuck[i] = 0
        status.contact_iteration[i] = -1
        status.is_fast[i] = 0
        if status.of_worlds.found:
            status.of_worlds.found[i] = 0
            status.of_worlds.hits[i] = 0
            status.of_worlds.remaining[i] = 0
            status.of_worlds.left_out[i] = 0
            status.of_worlds.filtered[i] = 0
    if i >= vertices.x1.shape[0]:
        return
    for axis in range(3):
        if motion.x0[i][axis] != vertices.x1[i][axis]:  # moved between steps
            status.loop[Loop.RECOUNT] = 1
    vertices.x1[i] = motion.x1[i]
    vertices.velocity[i] = motion.velocity[i]
    for axis in range(3):
        vertices.particle_delta_x[i, axis] = wp.int64(0)
        vertices.particle_delta_v[i, axis] = wp.int64(0)
    vertices.first_contact[i] = NEVER
    vertices.changed[i] = 0
    if motion.inverse_mass[i] > 0.0:  # not in worlds that take no part
        left = wp.where(vertices.outcome[i] & FROZEN != 0, STUCK_STEPS, vertices.frozen_lately[i] - 1)
        vertices.frozen_lately[i] = wp.where(continues(motion, motion.world[i]), wp.max(left, 0), 0)
    vertices.outcome[i] = wp.where(motion.is_not_finite[i] != 0, NOT_FINITE, 0)
    dividing.first[i] = NO_NODE
    dividing.lacks[i] = 0
    dividing.placed[i] = NOT_PLACED


@wp.kernel
def _forget_crossings(world_mask: wp.array[wp.bool], step: Step, last_crossings: wp.array[int]):
    edge = wp.tid()
    if takes_part(world_mask, step.motion.world[step.mesh.edges[edge, 0]]):
        last_crossings[edge] = _VERY_MANY


def pairs_of(mesh: ModelMesh, can_move: np.ndarray) -> int:
    """Returns how many pairs fit into the queues of a mesh on a GPU at first; ``can_move`` is 1 of each that can."""
    elements = mesh.faces, mesh.edges[mesh.free_edges], mesh.points.reshape(-1, 1)
    count, moving = sum(map(len, elements)), sum(int(can_move[e].any(axis=1).sum()) for e in elements)
    return PAIRS_PER_FACE * moving + PAIRS_PER_STATIC_FACE * (count - moving)


def _allocate_status(worlds: int, device: wp.Device, max_iterations: int) -> SolveStatus:
    """Returns a cleared status."""
    status = SolveStatus()
    for name, fields in (("loop", Loop), ("detection", Detection), ("results", Result)):
        setattr(status, name, wp.zeros(len(fields), dtype=int, device=device))
    for name in ("contact_iteration", "idle", "is_stuck", "is_fast", "crossings"):
        setattr(status, name, wp.zeros(worlds, dtype=int, device=device))
    status.max_iterations = max_iterations
    status.max_slow_iterations = MAX_SLOW_ITERATIONS
    status.max_divisions = MAX_DIVISIONS
    status.slow_position_sweeps = SLOW_POSITION_SWEEPS
    return status


class Workspace(Launches):
    """The buffers that a step works on, reused from step to step, on the device of the mesh.

    Attributes:
        step: The elements; the motion, which is only read; vertices and bodies as they are moved; the constraints.
        loop: Views of single elements of ``status.loop``, by :class:`.status.Loop`, for conditions on the device.
        results: The same of ``status.results``, by :class:`.status.Result`.
        tolerance: Tolerance of constraints on positions [m].
        crossings_of_edges: Faces that each edge crosses at the start of the step.
        last_crossings: The same of the step before; very many in a first step, whose start is as a program made it.
        nearest: How far each vertex is from the nearest face in six directions [m], see :mod:`.contacts.occluders`.
        clipped: Where paths end that are clipped there.
        can_move: 1 of each vertex that is not of a static shape: pairs without one are not looked for.
        active: The same, 0 of those that take no part in the step.
        turns: How bodies turn, None if no body has a shape.
        arcs: The arcs of vertices; without arrays if no body has a shape.
        tetrahedra: The tetrahedra whose inversions are looked for, None if nobody asks.
        ends: Where particles ended before inversions were prevented; None if they are not.
        unmasked: Inverse masses of vertices and bodies while those that take no part have none.
        sweeping_threads: Threads of each world that make all its sweeps in one launch; 0 to launch each, as of bodies.
    """

    def __init__(
        self,
        motion: ModelMotion,
        *,
        separation: float,
        restitution: wp.array[float],
        max_iterations: int = MAX_ITERATIONS,
        has_few_contacts: bool = False,
    ):
        """Allocates buffers, less where ``has_few_contacts`` says what is to be expected.

        Separation and restitution are those of :class:`.Step`, iterations those of :mod:`.schedule`.
        """
        self.mesh = mesh = motion.mesh
        self.device, vertices = mesh.device, mesh.vertex_count
        self.tolerance = TOLERANCE * separation
        self.worlds = max(1, mesh.model.world_count)
        self.particle_count, device = mesh.model.particle_count, mesh.device
        self.body_count = mesh.model.body_count if motion.moves_bodies else 0
        can_move = np.append(np.ones(self.particle_count), mesh.shape_vertices.body >= 0).astype(np.int32)
        self.active = self.can_move = wp.array(can_move, dtype=int, device=device)
        pairs = None if device.is_cpu else pairs_of(mesh, can_move)
        self.turns = motion.turns
        self.arcs = Arcs() if self.turns is None else self.turns.turns.arcs
        arcs = None if self.turns is None else self.arcs
        self.detector = DetectionPipeline(mesh, pairs=pairs, min_distances=mesh.distances, arcs=arcs)
        if has_few_contacts and device.is_cuda:
            self.detector.allocate_contacts(CANDIDATES_OF_CONTACT_IF_FEW)
        edges = len(mesh.edges)
        self.crossings_of_edges = wp.zeros(edges, dtype=int, device=device)
        self.last_crossings = wp.full(edges, _VERY_MANY, dtype=int, device=device)
        self.step = step = Step()
        step.mesh = mesh.connectivity
        self.motion = motion
        self.tetrahedra: Tetrahedra | None = None
        self.ends: wp.array[wp.vec3] | None = None
        self.unmasked: tuple[wp.array, wp.array] | None = None
        step.separation, step.restitution = separation, restitution
        size = vertices, 3
        step.vertices = allocate(Vertices, vertices, device, particle_delta_x=size, particle_delta_v=size)
        step.vertices.x1 = motion.last.positions
        if motion.moves_bodies:
            size = self.body_count, 6
            step.vertices.bodies = allocate(MovedBodies, self.body_count, device, delta_x=size, delta_v=size)
        self.particles = self._find_particles()
        largest = int(np.diff(self.particles.first.numpy()).max())
        self.sweeping_threads = 0 if self.body_count else threads_of_world(device, self.worlds, largest)
        self._iterations_reserved = ITERATIONS_RESERVED_IF_FEW if has_few_contacts else ITERATIONS_RESERVED
        step.constraints = self._allocate_constraints(0)
        self._retired: list[wp.array] = []
        capacity = (DIVIDING_PLANES_IF_FEW if has_few_contacts else DIVIDING_PLANES) * self.particle_count
        sizes = {"count": 1, "listed_count": 1, "next": 4 * capacity, "moved": self.worlds, "missed": self.worlds}
        sizes |= dict.fromkeys(("first", "listed", "lacks", "placed", "wanted", "reached"), vertices)
        self.dividing = allocate(DividingPlanes, capacity, device, **sizes, half=self._if_distances(capacity))
        self.status = _allocate_status(self.worlds, device, max_iterations)
        self.loop, self.results = single_elements(self.status.loop), single_elements(self.status.results)
        self.nearest = wp.empty((vertices, 6), dtype=float, device=device)
        self.clipped = wp.empty(vertices, dtype=wp.vec3, device=device)
        plane_worlds = mesh.planes.world
        planes_of_a_world = np.bincount(plane_worlds[plane_worlds >= 0], minlength=1).max() + (plane_worlds < 0).sum()
        self.vertices_at_planes = mesh.vertex_count if motion.moves_bodies else self.particle_count
        self.max_penetrations = self.vertices_at_planes * int(planes_of_a_world)
        self.kept = wp.zeros(1, dtype=int, device=device)
        self.moments = wp.zeros((self.worlds, int(SUMS)), dtype=wp.int64, device=device)
        self.summing_threads = 1 if device.is_cpu else 256 * device.sm_count  # few, as their warps add to the same sums
        self._threads = 1 if device.is_cpu else THREADS * device.sm_count

    def write_arcs(self) -> None:
        """Writes the arcs of the motion as it is now, if a body has a shape."""
        if self.turns is not None:
            self.turns.write_arcs(self.step.motion, self.vertices)

    def count_worlds(self) -> WorldCounts:
        """Counts contacts and filtered pairs of each world from now on, and returns the counts."""
        self.status.of_worlds = allocate(WorldCounts, self.worlds, self.device)
        self.detector.count_filtered_by_world(self.status.of_worlds.left_out_pairs)
        return self.status.of_worlds

    def watch_inversions(self, inversions: Literal["allowed", "reported", "prevented"]) -> None:
        """Allocates what it takes to count the tetrahedra that a step inverts, or also to prevent that."""
        if inversions == "allowed":
            return
        self.tetrahedra = tetrahedra = Tetrahedra()
        tetrahedra.corners = self.mesh.device_tets
        if inversions == "prevented":
            n = self.particle_count
            tetrahedra.first_inversion = wp.full(n, NEVER, dtype=wp.int64, device=self.device)
            self.ends = wp.zeros(n, dtype=wp.vec3, device=self.device)

    def forget_crossings(self, world_mask: wp.array[wp.bool] | None = None) -> None:
        """Makes the next step a first one, in the worlds of a mask as of :meth:`.LastStep.interrupt`, or in all."""
        if world_mask is None:
            self.last_crossings.fill_(_VERY_MANY)
        else:
            self.launch(_forget_crossings, len(self.last_crossings), [world_mask, self.step, self.last_crossings])

    @contextlib.contextmanager
    def all_worlds(self) -> Iterator[None]:
        """Gives the worlds that take no part in the step their masses."""
        motion = self.step.motion
        masses = motion.inverse_mass, motion.bodies.inverse_mass
        if self.unmasked is not None:
            motion.inverse_mass, motion.bodies.inverse_mass = self.unmasked
        try:
            yield
        finally:
            motion.inverse_mass, motion.bodies.inverse_mass = masses

    @property
    def motion(self) -> ModelMotion:
        """The motion of the step that is being resolved."""
        return self._motion

    @motion.setter
    def motion(self, motion: ModelMotion) -> None:
        self._motion, self.step.motion = motion, motion.vertices

    @property
    def vertices(self) -> Vertices:
        """The vertices and bodies as they are moved."""
        return self.step.vertices

    @property
    def constraints(self) -> Constraints:
        """The constraints."""
        return self.step.constraints

    def begin(self) -> None:
        """Initializes everything for a step."""
        size = max(len(self.vertices.x1), self.worlds)
        self.launch(_begin, size, [self.step, self.worlds, self.dividing, self.status])

    def _if_distances(self, capacity):
        """Returns a capacity, or 0 without minimum distances."""
        return 0 if self.mesh.distances is None else capacity

    def _allocate_constraints(self, capacity):
        sizes = {"count": 1, "active_count": self.worlds, "min_distance": self._if_distances(capacity)}
        sizes |= {"first": self.worlds, "number": self.worlds + 1}
        sizes["of_worlds"] = capacity if self.sweeping_threads and self.worlds > 1 else 0
        return allocate(Constraints, capacity, self.device, **sizes)

    def _find_particles(self):
        """Returns the particles of each world."""
        world = self.mesh.device_world.numpy()[: self.particle_count]
        particles = Incidence()
        particles.items, particles.first = (
            wp.array(numbers, dtype=int, device=self.device) for numbers in grouped_by_world(world, self.worlds)
        )
        return particles

    @property
    def max_contacts(self) -> int:
        """Contacts that a detection finds at most with its queues as they are."""
        return self.max_penetrations + sum(len(n.contacts.pairs) for n in self.detector.narrow_phases)

    def reserve(self, more: int) -> None:
        """Reserves ``more`` constraints, and some for later iterations; does nothing in a CUDA graph."""
        if self.device.is_capturing:
            return
        filled = int(self.constraints.count.numpy()[0])
        if len(self.constraints.vertices) < filled + more:
            new = self._allocate_constraints(filled + self._iterations_reserved * more)
            for name in Constraints.vars:
                old = getattr(self.constraints, name)
                if filled:
                    wp.copy(getattr(new, name), old, count=min(filled, len(old)))
                self._retired.append(old)  # a CUDA graph may still write to it
            self.step.constraints = new

    def grow(self) -> bool:
        """Enlarges the constraints, without the proximities, if those did not fit; returns whether. Synchronizes."""
        kept, found = (int(count.numpy()[0]) for count in (self.kept, self.constraints.count))
        if found + self.max_contacts <= len(self.constraints.vertices):
            return False
        wp.copy(self.constraints.count, self.kept)
        self.reserve(self.max_contacts + capacity_for(found - kept, "proximities"))
        return True

    def sweep_by_world(self, kernel: Callable[[int], wp.Kernel], inputs: Sequence) -> None:
        """Launches a kernel that makes all sweeps over each world, of a number of blocks, see :mod:`.cluster`.

        Its first inputs are the step and the particles of worlds, its last one is the threads of a world.
        """
        if self.worlds > 1:
            self.constraints.number.zero_()
            self.launch_over_constraints(count_constraints)
            self.launch(begin_worlds, self.worlds, [self.step])
            self.launch_over_constraints(list_constraints)
        threads = self.sweeping_threads
        inputs = [self.step, self.particles, *inputs, threads]
        options = {"device": self.device, "block_dim": min(threads, BLOCK)}
        wp.launch(kernel(max(1, threads // BLOCK)), self.worlds * threads, inputs=inputs, **options)

    def sweep(self, number: int, activate: Callable[[], None], project: wp.Kernel, update: Callable) -> None:
        """Sweeps a number of times over one active set, which ``activate`` fills, see :mod:`.solve.sweeps`.

        The kernel ``project`` updates multipliers; then ``update(work, last)`` changes vertices and bodies.
        """
        activate()
        for i in range(number):
            self.launch_over_entries(project, [self.step, self.status], is_large=True)
            update(self, i == number - 1)

    def repeat_sweeps(self, activate: Callable[[], None], project: wp.Kernel, update: Callable) -> None:
        """Repeats batches of sweeps until no constraint is active, at most MAX_SWEEPS times; none in divided worlds."""
        self.launch(start_sweeps, 1, [self.status])
        batch = {"number": int(SWEEPS_PER_BATCH), "activate": activate, "project": project, "update": update}
        wp.capture_while(self.loop[Loop.MORE_SWEEPS], self.sweep, **batch)
