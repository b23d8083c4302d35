"""Buffers and launches that turn the multipliers of a step into contacts, impulses and their sums."""

from collections.abc import Callable

import numpy as np
import warp as wp

from ..state.mesh import host_array, members_of_worlds
from ..state.motion import StateArrays
from ..state.structs import allocate
from ..state.workspace import Workspace
from . import keep, publish
from .structs import Centres, ContactRows, ImpulseSums, KeptImpulses, PublishedImpulses, Sides, Unpaired

MAX_PAIRS = 2**20
"""Most entries of the matrices of pairs of shapes, over all worlds: they then take 38 MB."""


class ContactForces:
    """Sums up what contacts did to momentum in a step, and publishes it, without a change of the step.

    Attributes:
        rows: The contacts of the last step.
        published: The sums of the last step.
        shapes_of_worlds: The shapes of each world, see :class:`.contact_report.ContactReport`.
        more: Publishes the contacts that were in the solve, if there are some.
    """

    more: Callable[[Sides, Centres, ImpulseSums, ContactRows], None] | None = None

    def __init__(self, work: Workspace, capacity: int, *, in_substeps: bool):
        """Allocates buffers for ``capacity`` contacts; ``in_substeps`` says whether steps may have substeps."""
        self._work, device, mesh = work, work.device, work.mesh
        model, worlds, planes = mesh.model, work.worlds, mesh.planes.world
        shape_world = host_array(model.shape_world) if model.shape_count else np.zeros(0, dtype=np.int32)
        self.shapes_of_worlds = members_of_worlds(shape_world, worlds)
        self._sides, sides = Sides(), members_of_worlds(planes, worlds)
        self._set_sides(_numbers_in(self.shapes_of_worlds, model.shape_count), _numbers_in(sides, len(planes)))
        self._sides.planes_per_world = slots = max(1, sides.shape[1])
        self._sides.max_local = local = self.shapes_of_worlds.shape[1]
        particles, bodies, shapes = model.particle_count, model.body_count, model.shape_count
        pairs = worlds * (local + 1) ** 2
        pairs = pairs if pairs <= MAX_PAIRS else 0
        self._of_constraints = self._allocate_kept(0)
        self._slots = slots * work.vertices_at_planes if in_substeps and len(planes) else 0
        self._of_planes = self._allocate_kept(self._slots)
        sizes = {"of_bodies": (bodies, 2), "idle_of_particles": (particles, 3), "idle_of_bodies": (bodies, 6)}
        self._unpaired = allocate(Unpaired, particles, device, **sizes)
        self._centres = allocate(Centres, bodies, device)
        self._centres.end.fill_(wp.vec3d(np.nan))
        sizes = {"of_particles": particles, "of_bodies": bodies, "of_shapes": shapes, "of_pairs": pairs}
        columns = {name: (size, 6 if name == "of_bodies" else 3) for name, size in sizes.items()}
        self._sums = allocate(ImpulseSums, worlds, device, **columns)
        self.rows = allocate(ContactRows, capacity, device, count=1, lost=1)
        by = {
            "particle": particles,
            "unpaired_particle": particles,
            "shape": shapes,
            "pair": pairs,
            "max_impulse": worlds,
        }
        self.published = allocate(PublishedImpulses, bodies, device, **by)
        self.published.max_impulse = self._sums.largest
        self._size = max(particles, bodies, shapes, pairs)
        self._reserve()

    def _set_sides(self, local_shape, plane_slot):
        sides, mesh = self._sides, self._work.mesh
        model, of_vertices, of_planes = mesh.model, mesh.device_shape_vertices, mesh.device_planes
        sides.particle_count = model.particle_count
        sides.shape, sides.body = of_vertices.shape, of_vertices.body
        sides.com, sides.body_world = model.body_com, model.body_world
        sides.plane_shape, sides.plane_body = of_planes.shape, of_planes.body
        sides.plane_slot = wp.array(plane_slot, dtype=int, device=mesh.device)
        sides.local_shape = wp.array(local_shape, dtype=int, device=mesh.device)

    def _allocate_kept(self, size):
        torques = size if self._work.mesh.model.body_count else 0
        return allocate(KeptImpulses, size, self._work.device, count=1, torque=(torques, 2))

    def _reserve(self):
        """Keeps impulses of as many constraints as there can be; those of a CUDA graph cannot become more."""
        size, kept = len(self._work.constraints.vertices), self._of_constraints
        if len(kept.impulse) >= size:
            return
        if self._work.device.is_capturing:  # only after an error in the step before
            raise RuntimeError("impulses have no capacity: step once outside the graph before capturing")
        self._of_constraints = self._allocate_kept(size)
        for name in KeptImpulses.vars:
            old = getattr(kept, name)
            if old.size:
                wp.copy(getattr(self._of_constraints, name)[: len(old)], old)

    def begin(self, start: StateArrays, *, remembers: bool) -> None:
        """Takes the centres of mass at the start of a step; ``remembers`` says whether steps go on from the last."""
        self.rows.lost.zero_()
        inputs = [start, self._work.motion.vertices, self._sides, remembers, self._centres]
        self._work.launch(keep.start_centres, len(self._centres.end), inputs)

    def end(self, end: StateArrays, mask: wp.array[wp.bool] | None) -> None:
        """Takes the centres of mass at the predicted end of a step, of worlds that take part in it."""
        self._work.launch(keep.end_centres, len(self._centres.end), [end, self._sides, mask, self._centres])

    def restart_worlds(self, restarts: wp.array[int]) -> None:
        """Forgets the substeps of worlds that repeat them; ``restarts`` is 1 for these, shape [worlds]."""
        self._reserve()
        kept = [self._of_constraints, self._of_planes, self._unpaired]
        self._work.launch_over_constraints(keep.restart_worlds, restarts, self._sides, *kept)

    def keep(self, substeps: int = 1, remaining: wp.array[int] | None = None) -> None:
        """Keeps the impulses of a substep after its projections, or those at the end of the step.

        Args:
            substeps: Number of substeps of the step.
            remaining: How many there still are, with this one; None at the end of the step.
        """
        self._reserve()
        work = self._work
        inputs = [work.motion.planes, self._sides, self._centres, substeps, remaining]
        outputs = [self._of_constraints, self._of_planes, self._unpaired, self.rows.lost]
        work.launch_over_constraints(keep.keep_impulses, *inputs, *outputs)
        size = max(len(self._unpaired.of_particles), len(self._unpaired.of_bodies))
        work.launch(keep.keep_unpaired, size, [work.step, self._unpaired])

    def publish(self) -> None:
        """Publishes the contacts of the step and all sums, and clears what was kept."""
        work, step, rows = self._work, self._work.step, self.rows
        self.keep()
        rows.count.zero_()
        self.published.max_impulse.zero_()
        outputs = [self._sums, rows]
        work.launch_over_constraints(publish.publish_contacts, self._sides, self._of_constraints, *outputs)
        self._of_constraints.count.zero_()
        if self._slots:
            inputs = [step, work.motion.planes, self._sides, self._of_planes]
            work.launch(publish.publish_contacts_of_planes, work.vertices_at_planes, [*inputs, *outputs])
        if self.more is not None:
            self.more(self._sides, self._centres, self._sums, rows)
        work.launch(publish.publish_sums, self._size, [self._unpaired, self._sums], [self.published])


def _numbers_in(rows, count):
    """Returns the place of each of ``count`` numbers in the rows that have it, all of which have it there."""
    numbers = np.zeros(count, dtype=np.int32)
    for row in rows:
        numbers[row[row >= 0]] = np.flatnonzero(row >= 0)
    return numbers
