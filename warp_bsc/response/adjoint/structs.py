"""The structs of an adjoint: a step that is restored from its record, the cursor in the record, and gradients."""

import enum

import warp as wp

from ..state.planes import MovingPlanes
from ..state.record import StepRecord
from ..state.status import SolveStatus
from ..state.structs import Step

wp.set_module_options({"enable_backward": False})


@wp.struct
class Cursor:
    """Where the adjoint is in the record of a step; each field is an array of one element."""

    iteration: wp.array[int]  # of detect and project
    first_sweep: wp.array[int]  # of that iteration
    current_sweep: wp.array[int]  # or -1
    next_sweep: wp.array[int]  # to go back through
    more_sweeps: wp.array[int]  # 1 if there is one
    more_iterations: wp.array[int]  # 1 while there are iterations to go back through


@wp.struct
class RestoredStep:
    """A recorded step, restored as it was at the cursor."""

    step: Step
    planes: MovingPlanes
    status: SolveStatus
    record: StepRecord
    cursor: Cursor


@wp.struct
class Projection:
    """The sweeps on positions, or those on velocities. Adjoints only read the gradients of changes."""

    of_velocities: wp.bool
    x: wp.array[wp.vec3]  # where impulses act [m]
    multiplier: wp.array[wp.vec3d]
    sums: wp.array2d[wp.int64]  # of what all sweeps changed vertices by
    body_sums: wp.array2d[wp.int64]
    multiplier_change: wp.array[wp.vec3d]  # by one sweep
    previous_change: wp.array[wp.vec3d]  # of the multiplier without momentum
    vertex_change: wp.array[wp.vec3]
    body_change: wp.array[wp.spatial_vectord]


@wp.struct
class Paths:
    """Truncated paths, by their places in the record."""

    end: wp.array[wp.vec3]  # of a vertex [m]
    velocity: wp.array[wp.vec3]
    pose: wp.array[wp.transform]  # of a body, at the end
    twist: wp.array[wp.spatial_vector]


@wp.struct
class BodyGradients:
    """Gradients with respect to bodies, and to changes of them by constraints, at the cursor."""

    pose: wp.array[wp.transform]
    velocity: wp.array[wp.spatial_vector]
    shift: wp.array[wp.spatial_vectord]  # with respect to changes of centres, and turns
    velocity_change: wp.array[wp.spatial_vectord]  # with respect to what constraints add to velocities


@wp.struct
class Gradients:
    """Gradients with respect to positions and velocities at the cursor."""

    x1: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    more_x1: wp.array[wp.vec3]  # added to x1 once everything has read it
    more_velocity: wp.array[wp.vec3]
    velocity_change: wp.array[wp.vec3]  # with respect to what constraints add to velocities
    on_bodies: wp.array[wp.vec3]  # with respect to positions or velocities of vertices of bodies
    bodies: BodyGradients


@wp.struct
class StateGradients:
    """Gradients with respect to results of a step, then to what was predicted; those of the start are added to."""

    start_q: wp.array[wp.vec3]
    particle_q: wp.array[wp.vec3]
    particle_qd: wp.array[wp.vec3]
    start_body_q: wp.array[wp.transform]
    body_q: wp.array[wp.transform]
    body_qd: wp.array[wp.spatial_vector]


@wp.struct
class ModelGradients:
    """Gradients of the model that a step adds to, as far as the model has them."""

    particle_inv_mass: wp.array[float]
    body_inv_mass: wp.array[float]
    body_inv_inertia: wp.array[wp.mat33]
    body_mass: wp.array[float]
    body_inertia: wp.array[wp.mat33]
    restitution: wp.array[float]


class Move(enum.IntEnum):
    """Where a cursor moves."""

    END = 0  # behind the sweeps on velocities
    SWEEPS = 1  # behind the sweeps on positions of its iteration
    DETECTION = 2  # to the detection ahead of its iteration, after which the iteration before ends


@wp.func
def entry_of(record: StepRecord, sweep: int, place: int) -> int:
    """Returns the entry of the constraint at a place of a sweep's active set; -1 if the set is smaller."""
    if sweep < 0:
        return -1
    entry = place
    if sweep > 0:
        entry += record.sweep_ends[sweep - 1]
    return wp.where(entry < record.sweep_ends[sweep], entry, -1)
