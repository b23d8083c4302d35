"""A sensor of contact forces by environment and by what is touched, in the names and shapes of Isaac Lab's sensor."""

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .._arguments import check_instance, checked_integer, checked_number, checked_strings
from .drive.world_mask import checked_mask
from .report.forces.sums import add_impulse, take_impulse
from .stage import CollisionStage
from .state.mesh import host_array
from .state.motion import takes_part
from .state.structs import allocate
from .state.vectors import to_double, to_single

wp.set_module_options({"enable_backward": False})

PARTICLES = "particles"
"""The name of all particles of a world, among sensors and filters."""


@wp.struct
class _Readings:
    """What sensors read; in arrays of forces the first column is of all contacts, the others of filters."""

    total: wp.array3d[wp.vec3]  # [N]
    normal: wp.array3d[wp.vec3]
    friction: wp.array3d[wp.vec3]
    history: wp.array3d[wp.vec3]  # of totals, the newest first
    current_air_time: wp.array2d[float]  # [s]
    last_air_time: wp.array2d[float]
    current_contact_time: wp.array2d[float]
    last_contact_time: wp.array2d[float]


@dataclass(frozen=True, eq=False)
class ContactSensorData:
    """Contact forces on E environments, B sensors and M filters, as Warp arrays on the device that stay where they are.

    Names and shapes are those of Isaac Lab's ``ContactSensorData``; ``wp.to_torch`` makes tensors of them without a
    copy. Forces are means over the last step, in the world frame [N].

    Attributes:
        net_forces_w: Forces of all contacts on each sensor, vec3, shape [E, B].
        net_normal_forces_w: Their normal parts.
        net_friction_forces_w: Their tangential parts.
        net_forces_w_history: Those of the last T updates, the newest first, vec3, shape [E, T, B].
        force_matrix_w: Forces of what each filter names, vec3, shape [E, B, M]; None without filters, as are both
            others.
        normal_force_matrix_w: Their normal parts.
        friction_force_matrix_w: Their tangential parts.
        current_air_time: Time without contact so far, 0 in contact [s], float, shape [E, B], as are the others.
        last_air_time: Length of the last time without contact [s].
        current_contact_time: Time in contact so far, 0 without [s].
        last_contact_time: Length of the last time in contact [s].
        complete: Whether the forces of the last update have all contacts of the step, bool, shape [1]: false if there
            were more than ``report=`` of the solver allows.
    """

    net_forces_w: wp.array
    net_normal_forces_w: wp.array
    net_friction_forces_w: wp.array
    net_forces_w_history: wp.array
    force_matrix_w: wp.array | None
    normal_force_matrix_w: wp.array | None
    friction_force_matrix_w: wp.array | None
    current_air_time: wp.array
    last_air_time: wp.array
    current_contact_time: wp.array
    last_contact_time: wp.array
    complete: wp.array


@wp.kernel
def _add_contacts(
    # in
    count: wp.array[int],
    shapes: wp.array[wp.vec2i],
    world: wp.array[int],
    normal: wp.array[wp.vec3],
    normal_impulse: wp.array[float],
    tangential_impulse: wp.array[wp.vec3],
    columns: wp.array[wp.vec2i],
    # out
    sums: wp.array4d[wp.int64],
    lost: wp.array[int],
):
    """Adds the impulses of a contact to the sums of sensors on both of its sides."""
    i = wp.tid()
    if i >= count[0] or world[i] < 0:
        return
    along = wp.float64(normal_impulse[i]) * to_double(normal[i])
    across = to_double(tangential_impulse[i])
    for side in range(2):
        # particles, whose shape is -1, stand in the last row
        own = columns[(shapes[i][side] + columns.shape[0]) % columns.shape[0]][0]
        other = columns[(shapes[i][1 - side] + columns.shape[0]) % columns.shape[0]][1]
        sign = wp.float64(1 - 2 * side)
        if own >= 0:
            of_sensor = sums[world[i], own]
            add_impulse(of_sensor, 0, 0, sign * along, lost)
            add_impulse(of_sensor, 0, 3, sign * across, lost)
            if other >= 0:
                add_impulse(of_sensor, other, 0, sign * along, lost)
                add_impulse(of_sensor, other, 3, sign * across, lost)


@wp.kernel
def _read(
    # in
    mask: wp.array[wp.bool],
    count: wp.array[int],
    capacity: int,
    lost_by_solver: wp.array[int],
    dt: float,
    threshold: float,
    # in and out
    sums: wp.array4d[wp.int64],
    lost: wp.array[int],
    # out
    readings: _Readings,
    complete: wp.array[wp.bool],
):
    """Makes forces of the sums of a sensor, and clears them."""
    world, sensor = wp.tid()
    if world == 0 and sensor == 0:
        complete[0] = count[0] <= capacity and lost_by_solver[0] == 0 and lost[0] == 0
        lost[0] = 0
    for column in range(readings.total.shape[2]):
        normal = to_single(take_impulse(sums[world, sensor], column, 0)) / dt
        friction = to_single(take_impulse(sums[world, sensor], column, 3)) / dt
        if takes_part(mask, world):
            readings.normal[world, sensor, column] = normal
            readings.friction[world, sensor, column] = friction
            readings.total[world, sensor, column] = normal + friction
    if not takes_part(mask, world):
        return
    for k in range(readings.history.shape[1] - 1, 0, -1):
        readings.history[world, k, sensor] = readings.history[world, k - 1, sensor]
    readings.history[world, 0, sensor] = readings.total[world, sensor, 0]
    in_air, touching = readings.current_air_time[world, sensor], readings.current_contact_time[world, sensor]
    if wp.length(readings.normal[world, sensor, 0]) > threshold:
        if in_air > 0.0:
            readings.last_air_time[world, sensor] = in_air + dt
        readings.current_air_time[world, sensor] = 0.0
        readings.current_contact_time[world, sensor] = touching + dt
    else:
        if touching > 0.0:
            readings.last_contact_time[world, sensor] = touching + dt
        readings.current_contact_time[world, sensor] = 0.0
        readings.current_air_time[world, sensor] = in_air + dt


@wp.kernel
def _clear(mask: wp.array[wp.bool], readings: _Readings):
    """Sets what a sensor reads to 0."""
    world, sensor = wp.tid()
    if not takes_part(mask, world):
        return
    for column in range(readings.total.shape[2]):
        readings.total[world, sensor, column] = wp.vec3()
        readings.normal[world, sensor, column] = wp.vec3()
        readings.friction[world, sensor, column] = wp.vec3()
    for k in range(readings.history.shape[1]):
        readings.history[world, k, sensor] = wp.vec3()
    readings.current_air_time[world, sensor] = 0.0
    readings.last_air_time[world, sensor] = 0.0
    readings.current_contact_time[world, sensor] = 0.0
    readings.last_contact_time[world, sensor] = 0.0


class ContactSensor:
    """Reads the contact forces on bodies and cloth from the report of a solver, by environment and by what is touched.

    A pattern names bodies by their labels, as Python's ``fnmatch`` has it, shapes where no body has such a label, and
    the particles of a world by ``"particles"``. What is in all worlds, such as a ground, counts in each of them. Forces
    are those of :attr:`.forces.contact_report.ContactReport.contacts`, so those of the solver alone; their sums are the
    same in any order of threads. Contacts of two things that are in all worlds are of no environment.

    Attributes:
        data: What the sensors read, :class:`ContactSensorData`.
        labels: The labels of the sensors in the first world.
    """

    def __init__(
        self,
        solver: CollisionStage,
        sensors: Sequence[str],
        filters: Sequence[str] = (),
        *,
        history_length: int = 1,
        force_threshold: float = 1.0,
    ):
        """Finds what the patterns name.

        Args:
            solver: A :class:`warp_bsc.SolverCCD` or :class:`warp_bsc.SolverImplicit` with
                ``report=["contacts"]``.
            sensors: Patterns of what has a sensor each, in this order, and in that of the model.
            filters: Patterns; each is of all that it names in a world, and has a column of the force matrix.
            history_length: Updates that the history has, at least 1.
            force_threshold: Normal force above which a sensor is in contact [N], for the times in contact and air.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number is out of range, if there are no sensors, if a pattern names nothing, or not equally
                many sensors in each world, or if something has two sensors, or two filters.
            RuntimeError: If the solver does not report contacts.
        """
        check_instance(solver, "solver", CollisionStage, "a SolverCCD or a SolverImplicit")
        sensors, filters = checked_strings(sensors, "sensors"), checked_strings(filters, "filters")
        checked_integer(history_length, "history_length", 1)
        self._threshold = checked_number(force_threshold, "force_threshold", 0.0)
        self._model, self._device, self._contacts = solver.model, solver.model.device, solver.report.forces.contacts
        worlds = max(1, self._model.world_count)
        columns = np.full((self._model.shape_count + 1, 2), -1, dtype=np.int32)
        self.labels: list[str] = []
        for pattern in sensors:
            found = self._find(pattern, "sensors")
            everywhere, local = found.pop(-1, []), [found.get(world, []) for world in range(worlds)]
            if len({len(things) for things in local}) != 1:
                counts = [len(things) for things in local]
                raise ValueError(f"sensors: {pattern!r} must name equally many in each world, not {counts}")
            for things in [*([thing] for thing in everywhere), *zip(*local, strict=True)]:
                for _, shapes in things:
                    self._assign(columns[:, 0], shapes, len(self.labels), f"sensors: {pattern!r}")
                self.labels.append(things[0][0])
        if not self.labels:
            raise ValueError("sensors: there are none")
        for column, pattern in enumerate(filters):
            for things in self._find(pattern, "filters").values():
                for _, shapes in things:
                    self._assign(columns[:, 1], shapes, column + 1, f"filters: {pattern!r}")
        self._columns = wp.array(columns, dtype=wp.vec2i, device=self._device)
        of_sensors: Any = worlds, len(self.labels)
        forces = (*of_sensors, len(filters) + 1)
        sizes: Any = dict.fromkeys(("total", "normal", "friction"), forces)
        sizes["history"] = worlds, history_length, len(self.labels)
        self._readings = r = allocate(_Readings, of_sensors, self._device, **sizes)
        self._sums = wp.zeros((*forces, 6), dtype=wp.int64, device=self._device)
        self._lost = wp.zeros(1, dtype=int, device=self._device)
        self._complete = wp.full(1, True, dtype=wp.bool, device=self._device)
        self._all_worlds = wp.full(worlds + 1, True, dtype=wp.bool, device=self._device)
        by_kind = r.total, r.normal, r.friction
        net = [array[:, :, 0] for array in by_kind]
        matrices = [array[:, :, 1:] if filters else None for array in by_kind]
        times = [r.current_air_time, r.last_air_time, r.current_contact_time, r.last_contact_time]
        self.data = ContactSensorData(*[*net, r.history, *matrices, *times, self._complete])

    def update(self, dt: float, world_mask: wp.array[wp.bool] | None = None) -> None:
        """Reads the contacts of the last step; call it once after each, in a CUDA graph or not.

        Args:
            dt: Length of the step [s], more than 0.
            world_mask: As of that step: what the sensors of other worlds have read stays.

        Raises:
            TypeError: If ``dt`` is no number, or the mask no array of bool.
            ValueError: If ``dt`` is not more than 0, or the mask has another shape or device.
        """
        dt, c = checked_number(dt, "dt", 0.0, above=True), self._contacts
        inputs = [c.count, c.shapes, c.world, c.normal, c.normal_impulse, c.tangential_impulse, self._columns]
        self._launch(_add_contacts, c.capacity, inputs, [self._sums, self._lost])
        inputs = [self._mask(world_mask), c.count, c.capacity, c._lost, dt, self._threshold, self._sums, self._lost]
        self._launch(_read, self._sums.shape[:2], inputs, [self._readings, self._complete])

    def reset(self, world_mask: wp.array[wp.bool] | None = None) -> None:
        """Sets all that the sensors of some worlds have read to 0, of all without a mask, which is that of a step."""
        self._launch(_clear, self._sums.shape[:2], [self._mask(world_mask)], [self._readings])

    def _mask(self, world_mask):
        mask = checked_mask(world_mask, self._model)
        return self._all_worlds if mask is None else mask

    def _find(self, pattern, argument):
        """Returns by world, -1 for all, what a pattern names: labels, and rows of the table of columns."""
        model, found = self._model, {}
        if pattern == PARTICLES:
            return {-1: [(PARTICLES, np.array([model.shape_count]))]}
        body = host_array(model.shape_body) if model.shape_count else np.zeros(0, dtype=int)
        for labels, world_of, shapes_of in (
            (model.body_label, model.body_world, lambda i: np.flatnonzero(body == i)),
            (model.shape_label, model.shape_world, lambda i: np.array([i])),
        ):
            named = [i for i, label in enumerate(labels) if not found and fnmatch.fnmatchcase(label, pattern)]
            worlds = host_array(world_of) if named and model.world_count else np.full(len(labels), -1)
            for i in named:
                found.setdefault(int(worlds[i]), []).append((labels[i], shapes_of(i)))
        if not found:
            raise ValueError(f"{argument}: no body and no shape has a label like {pattern!r}")
        return found

    def _assign(self, columns, rows, column, what):
        if (columns[rows] >= 0).any():
            raise ValueError(f"{what} names what another pattern names")
        columns[rows] = column

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self._device)
