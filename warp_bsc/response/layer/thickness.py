"""Chooses the thickness of a contact layer in the first step, by edge lengths and by the speeds that can be foreseen.

A layer must hold the path of some steps, or contacts pass it before it has pushed them back. Measured on three throws:
central differences are within 0.13% of the tape if the layer is at least 1.7 times as thick as the path of a step, off
by up to 0.6% at 1.4 to 1.6 times, by 9% at 1.0 to 1.2 times, and by more than half below. So the layer is thin, a
quarter of an edge, if ``PATHS_IN_LAYER`` paths of a step fit in it, else as thick as edges allow. The path is that of
the fastest pair in the first step, with what gravity adds on the way down to the lowest vertex or plane. There are two
thicknesses, not one for each speed, so that results do not depend on speeds by the thickness. It stays as it was
chosen, also after a reset.
"""

import warp as wp

from ..state.planes import MovingPlanes, signed_distance
from ..state.structs import Motion
from ..tuning import PATHS_IN_LAYER

wp.set_module_options({"enable_backward": False})


@wp.struct
class ThicknessRule:
    """The rule for the thickness of a layer, and what it has found."""

    thin: float  # thickness for slow motion [m]
    thick: float  # that for fast motion [m]
    least: wp.array[float]  # path of a step by axis, and height against gravity [m]
    largest: wp.array[float]  # the same
    is_chosen: wp.array[int]  # one number, 1 once the thickness is


@wp.func
def _widen(rule: ThicknessRule, i: int, least: float, largest: float):
    wp.atomic_min(rule.least, i, least)
    wp.atomic_max(rule.largest, i, largest)


@wp.kernel
def find_extremes(motion: Motion, planes: MovingPlanes, gravity: wp.array[wp.vec3], rule: ThicknessRule):
    """Finds the extremes of paths and heights over all vertices; those of planes are heights."""
    vertex = wp.tid()
    if rule.is_chosen[0] != 0 or motion.is_not_finite[vertex] != 0:
        return
    x = motion.x0[vertex]
    path = motion.x1[vertex] - x
    for axis in range(3):
        _widen(rule, axis, path[axis], path[axis])
    up = -wp.normalize(gravity[wp.clamp(motion.world[vertex], 0, gravity.shape[0] - 1)])
    height = wp.dot(up, x)
    _widen(rule, 3, height, height)
    for place in range(planes.of_worlds.shape[1]):
        plane = planes.of_worlds[motion.world[vertex], place]
        if plane >= 0:
            surface = planes.start[plane]
            steepness = wp.dot(up, wp.vec3(float(surface[0]), float(surface[1]), float(surface[2])))
            distance, _error = signed_distance(surface, x)
            if steepness > 0.5 and distance > wp.float64(0.0):
                _widen(rule, 3, height - float(distance) / steepness, height)


@wp.kernel
def choose_thickness(gravity: wp.array[wp.vec3], dt: float, rule: ThicknessRule, thickness: wp.array[wp.float64]):
    """Writes the thickness if it is not chosen yet."""
    if rule.is_chosen[0] != 0:
        return
    rule.is_chosen[0] = 1
    square = float(0.0)
    for axis in range(3):
        path = rule.largest[axis] - rule.least[axis]
        square += path * path
    strongest = float(0.0)
    for world in range(gravity.shape[0]):
        strongest = wp.max(strongest, wp.length(gravity[world]))
    drop = wp.max(rule.largest[3] - rule.least[3], 0.0)
    square += 2.0 * strongest * drop * dt * dt
    chosen = rule.thin
    if PATHS_IN_LAYER * wp.sqrt(square) > rule.thin:
        chosen = rule.thick
    thickness[0] = wp.float64(chosen)
