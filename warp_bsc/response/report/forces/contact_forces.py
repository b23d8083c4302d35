"""Buffers and launches that turn the multipliers of a step into contacts, impulses and their sums."""

from collections.abc import Callable

import numpy as np
import warp as wp

from ...state.mesh import host_array, members_of_worlds
from ...state.motion import StateArrays
from ...state.structs import allocate
from ...state.workspace import Workspace
from . import accumulate, emit
from .structs import ContactRows, ImpulseSums, PublishedImpulses, Sides, Unpaired

MAX_PAIRS = 2**20
"""Most entries of the matrices of pairs of shapes, over all worlds: they then take 38 MB."""


class ContactForces:
    """Sums up what contacts did to momentum in a step, and publishes it, without a change of the step."""

    # publishes the contacts that were in the solve, if there are some
    more: Callable[[Sides, wp.array[wp.vec3d], ImpulseSums, ContactRows], None] | None = None

    def __init__(self, work: Workspace, capacity: int):
        """Allocates buffers for ``capacity`` contacts."""
        self._work, device, mesh = work, work.device, work.mesh
        model, worlds = mesh.model, work.worlds
        shape_world = host_array(model.shape_world) if model.shape_count else np.zeros(0, dtype=np.int32)
        # the shapes of each world, see :class:`.contact_report.ContactReport`
        self.shapes_of_worlds = members_of_worlds(shape_world, worlds)
        self._sides = Sides()
        self._set_sides(_numbers_in(self.shapes_of_worlds, model.shape_count))
        self._sides.max_local = local = self.shapes_of_worlds.shape[1]
        particles, bodies, shapes = model.particle_count, model.body_count, model.shape_count
        pairs = worlds * (local + 1) ** 2
        pairs = pairs if pairs <= MAX_PAIRS else 0
        sizes = {"of_bodies": (bodies, 2), "idle_of_particles": (particles, 3), "idle_of_bodies": (bodies, 6)}
        self._unpaired = allocate(Unpaired, particles, device, **sizes)
        self._centres = wp.zeros(bodies, dtype=wp.vec3d, device=device)
        sizes = {"of_particles": particles, "of_bodies": bodies, "of_shapes": shapes, "of_pairs": pairs}
        columns = {name: (size, 6 if name == "of_bodies" else 3) for name, size in sizes.items()}
        self._sums = allocate(ImpulseSums, worlds, device, **columns)
        self.rows = allocate(ContactRows, capacity, device, count=1, lost=1)  # the contacts of the last step
        by = dict.fromkeys(("particle", "unpaired_particle"), particles)
        by |= {"shape": shapes, "pair": pairs, "max_impulse": worlds}
        self.published = allocate(PublishedImpulses, bodies, device, **by)  # the sums of the last step
        self.published.max_impulse = self._sums.largest
        self._size = max(particles, bodies, shapes, pairs)

    def _set_sides(self, local_shape):
        sides, mesh = self._sides, self._work.mesh
        model, of_vertices, of_planes = mesh.model, mesh.device_shape_vertices, mesh.device_planes
        sides.particle_count = model.particle_count
        sides.shape, sides.body = of_vertices.shape, of_vertices.body
        sides.com, sides.body_world = model.body_com, model.body_world
        sides.plane_shape, sides.plane_body = of_planes.shape, of_planes.body
        sides.local_shape = wp.array(local_shape, dtype=int, device=mesh.device)

    def end(self, end: StateArrays, mask: wp.array[wp.bool] | None) -> None:
        """Takes the centres of mass at the predicted end of a step, of worlds that take part in it."""
        self._work.launch(accumulate.write_centres, len(self._centres), [end, self._sides, mask, self._centres])

    def publish(self, substep: int = 0, substeps: int = 1) -> None:
        """Publishes the contacts of the step and all sums; those of a substep beside those of the substeps before."""
        work, rows, first = self._work, self.rows, substep == 0
        if first:
            for array in (rows.count, rows.lost, self.published.max_impulse):
                array.zero_()
        size = max(len(self._unpaired.of_particles), len(self._unpaired.of_bodies))
        work.launch(accumulate.keep_unpaired, size, [work.step, self._unpaired])
        inputs = [work.motion.planes, self._sides, self._centres, substep, substeps]
        work.launch_over_constraints(emit.publish_contacts, *inputs, self._unpaired, self._sums, rows)
        if self.more is not None:
            self.more(self._sides, self._centres, self._sums, rows)
        work.launch(emit.publish_sums, self._size, [self._unpaired, first, self._sums], [self.published])


def _numbers_in(rows, count):
    """Returns the place of each of ``count`` numbers in the rows that have it, all of which have it there."""
    numbers = np.zeros(count, dtype=np.int32)
    for row in rows:
        numbers[row[row >= 0]] = np.flatnonzero(row >= 0)
    return numbers
