"""The gradient of a response: undoes what a step did, last things first, and carries gradients along.

What a response did is a long chain of small steps: contacts become constraints, each iteration changes multipliers and
by them positions, paths are cut, and in the end velocities change. Which contacts there were, which constraints acted
and when it was enough is taken as given; all the rest is differentiated as it was computed. The adjoint of each small
step is Warp's; this module only sees to it that each finds what was there when the step was made. For that iterations
are undone: multipliers are in the history, and positions follow by taking back what multipliers had changed, exactly,
as the sums are integers.
"""

from types import SimpleNamespace

import warp as wp

from .adjoint_kernels import (
    CURRENT,
    CURSOR,
    FIRST,
    MARK,
    NEXT,
    accelerating,
    constraining,
    displacing,
    entry_of,
    massing,
    starting,
    truncating,
    turning,
    twisting,
)
from .angular_momentum import SUMS, turns
from .constraints import PROJECTED, ROUND, STEER, TRUNCATIONS, UNDETECTED, Constraints, Progress, Vertices
from .planes import HalfSpaces
from .projection import BATCH, moved, spread
from .step_record import (
    ENTRIES,
    FORGOTTEN,
    ITERATIONS_DONE,
    MARKED,
    OF_ENTRIES,
    OF_TRUNCATIONS,
    TRUNCATED_PATHS,
    History,
)

__all__ = ["Recording", "Undoing"]

_OF_CONSTRAINTS = (
    "vertices",
    "weights",
    "normal",
    "separation",
    "friction",
    "urgency",
    "origin",
    "localized",
    "toi",
    "slow",
    "displacing",
    "impulse",
    "reached",
)
_UNDONE_OF_CONSTRAINTS = "displacing", "impulse", "reached"
_DIFFERENTIABLE = "weights", "normal", "separation", "urgency", "displacing", "impulse", "reached"
_OF_VERTICES = "x0", "x1", "velocity", "wanted_x1", "wanted_velocity", "displacement", "velocity_change", "done"
_UNDONE_OF_VERTICES = "x1", "velocity", "displacement", "velocity_change"
_KERNEL = {"enable_backward": False}


@wp.struct
class _Gradients:
    """Gradients with respect to positions and velocities as they are where undoing is."""

    x1: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    more_x1: wp.array[wp.vec3]  # to be added, once everything has read the former
    more_velocity: wp.array[wp.vec3]
    push: wp.array[wp.vec3]  # with respect to what constraints add to velocities


@wp.kernel(**_KERNEL)
def _begin(
    vertices: Vertices,
    gradients: _Gradients,
    steer: wp.array[int],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    x0: wp.array[wp.vec3],
):
    """Takes over the gradients of a step's results; where all stood still, that of the start is all there is."""
    vertex = wp.tid()
    x1 = wp.vec3()
    velocity = wp.vec3()
    if vertex < particle_q.shape[0]:
        x1 = particle_q[vertex]
        velocity = particle_qd[vertex]
    x0[vertex] = wp.vec3()
    if steer[UNDETECTED] == 1 and vertices.inverse_mass[vertex] > 0.0:
        x0[vertex] = x1
        x1 = wp.vec3()
        velocity = wp.vec3()
    gradients.x1[vertex] = x1
    gradients.velocity[vertex] = velocity


@wp.kernel(**_KERNEL)
def _begin_undoing(
    history: History,
    steer: wp.array[int],
    projections: int,
    complete: wp.array[int],
    cursor: wp.array[int],
    more: wp.array[int],
    back: wp.array[int],
):
    """Puts the cursor behind the last iteration on velocities; ``more`` says of iterations and rounds if there are."""
    cursor[CURRENT] = -1
    if complete[0] == 0:  # what is missing cannot be undone, and where it would be there is nothing to read
        cursor[FIRST] = 0
        cursor[NEXT] = -1
        return
    mark = wp.min(steer[ROUND], projections + TRUNCATIONS + 1)
    cursor[MARK] = mark
    cursor[FIRST] = history.iterations[mark + 1]
    cursor[NEXT] = history.sizes[ITERATIONS_DONE] - 1
    more[0] = wp.where(cursor[NEXT] >= cursor[FIRST], 1, 0)
    more[1] = 1
    back[ROUND] = mark


@wp.kernel(**_KERNEL)
def _begin_round(history: History, cursor: wp.array[int], more: wp.array[int]):
    """Puts the cursor behind the last iteration on positions of a round."""
    mark = cursor[MARK]
    cursor[FIRST] = history.iterations[mark]
    cursor[NEXT] = history.iterations[mark + 1] - 1
    more[0] = wp.where(cursor[NEXT] >= cursor[FIRST], 1, 0)


@wp.kernel(**_KERNEL)
def _to_detection(cursor: wp.array[int], back: wp.array[int]):
    """Goes back to the detection before a round."""
    back[ROUND] = wp.max(cursor[MARK] - 1, 0)


@wp.kernel(**_KERNEL)
def _end_round(cursor: wp.array[int], more: wp.array[int]):
    """Goes back to the round before."""
    cursor[MARK] = cursor[MARK] - 1
    more[1] = wp.where(cursor[MARK] >= 0, 1, 0)


@wp.kernel(**_KERNEL)
def _undo(
    vertices: Vertices,
    constraints: Constraints,
    progress: Progress,
    cursor: wp.array[int],
    multiplier: wp.array[wp.vec3d],
    sums: wp.array2d[wp.int64],
):
    """Takes back what an iteration did to multipliers, and to the sums of what they change."""
    entry = entry_of(progress.history, cursor[NEXT], wp.tid())
    if cursor[NEXT] < cursor[FIRST] or entry < 0:
        return
    i = progress.history.constraint[entry]
    old = progress.history.multiplier[entry]
    spread(vertices, constraints, i, old - multiplier[i], sums)
    multiplier[i] = old
    constraints.reached[i] = progress.history.reached[entry]
    for j in range(4):
        wp.atomic_add(vertices.active, constraints.vertices[i][j], 1)


@wp.func
def _step_back(vertex: int, cursor: wp.array[int], more: wp.array[int]):
    """Lets the cursor be at the iteration that is being undone, and the next be the one before."""
    if vertex == 0:
        iteration = cursor[NEXT]
        undone = iteration >= cursor[FIRST]
        cursor[CURRENT] = wp.where(undone, iteration, -1)
        cursor[NEXT] = wp.where(undone, iteration - 1, iteration)
        more[0] = wp.where(cursor[NEXT] >= cursor[FIRST], 1, 0)


@wp.kernel(**_KERNEL)
def _undo_displacements(vertices: Vertices, gradients: _Gradients, cursor: wp.array[int], more: wp.array[int]):
    """Moves vertices back to where they were before an iteration, and adds up their gradients."""
    vertex = wp.tid()
    _step_back(vertex, cursor, more)
    gradients.x1[vertex] = gradients.x1[vertex] + gradients.more_x1[vertex]
    gradients.more_x1[vertex] = wp.vec3()
    if vertices.active[vertex] != 0 and vertices.inverse_mass[vertex] > 0.0:
        vertices.x1[vertex] = moved(vertices.wanted_x1[vertex], vertices.displacement, vertex)


@wp.kernel(**_KERNEL)
def _undo_turn(vertices: Vertices):
    """Gives vertices the velocities that they had before they were turned."""
    vertex = wp.tid()
    if turns(vertices, vertex):
        vertices.velocity[vertex] = moved(vertices.wanted_velocity[vertex], vertices.velocity_change, vertex)


@wp.kernel(**_KERNEL)
def _undo_velocities(vertices: Vertices, gradients: _Gradients, cursor: wp.array[int], more: wp.array[int]):
    """Gives vertices the velocities that they had before an iteration, and adds up their gradients."""
    vertex = wp.tid()
    _step_back(vertex, cursor, more)
    gradients.velocity[vertex] = gradients.velocity[vertex] + gradients.more_velocity[vertex]
    gradients.more_velocity[vertex] = wp.vec3()
    gradients.push[vertex] = wp.vec3()
    if vertices.inverse_mass[vertex] > 0.0 and vertices.done[vertex] <= PROJECTED:
        gradients.push[vertex] = gradients.velocity[vertex]
        vertices.velocity[vertex] = moved(vertices.wanted_velocity[vertex], vertices.velocity_change, vertex)


@wp.kernel(**_KERNEL)
def _undo_truncations(
    vertices: Vertices,
    gradients: _Gradients,
    history: History,
    cursor: wp.array[int],
    end: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Lets paths that were cut end where they did before; the gradients of what was cut go to ``end`` and velocity."""
    mark = cursor[MARK]
    entry = history.truncations[mark] + wp.tid()
    if entry >= history.truncations[mark + 1]:
        return
    vertex = history.vertex[entry]
    end[entry] = gradients.x1[vertex]
    velocity[entry] = gradients.velocity[vertex]
    gradients.x1[vertex] = wp.vec3()
    gradients.velocity[vertex] = wp.vec3()
    vertices.x1[vertex] = history.end[entry]


@wp.kernel(**_KERNEL)
def _finish(
    gradients: _Gradients,
    x0: wp.array[wp.vec3],
    wanted_x1: wp.array[wp.vec3],
    wanted_velocity: wp.array[wp.vec3],
    complete: wp.array[int],
    start_q: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Hands over the gradients of what the step started from; NaN if it was not all taken down."""
    particle = wp.tid()
    missing = float(0.0)
    if complete[0] == 0:
        missing = wp.nan
    x1 = gradients.x1[particle] + gradients.more_x1[particle] + wanted_x1[particle]
    velocity = gradients.velocity[particle] + gradients.more_velocity[particle] + wanted_velocity[particle]
    particle_q[particle] = x1 + wp.vec3(missing)
    particle_qd[particle] = velocity + wp.vec3(missing)
    start_q[particle] = start_q[particle] + x0[particle] + wp.vec3(missing)


@wp.kernel(**_KERNEL)
def _judge(constraints: wp.array[int], history: History, room: int, complete: wp.array[int]):
    """Whether all that a step did has found room in its recording."""
    sizes = history.sizes
    fits = constraints[0] <= room and sizes[FORGOTTEN] == 0
    fits = fits and sizes[ITERATIONS_DONE] <= history.ends.shape[0]
    fits = fits and sizes[ENTRIES] <= history.constraint.shape[0]
    fits = fits and sizes[TRUNCATED_PATHS] <= history.vertex.shape[0]
    complete[0] = wp.where(fits, 1, 0)


class Recording:
    """A step as it was taken down: as much of it as there is or, in a CUDA graph, as there is room for.

    Attributes:
        dt: Length of the step [s].
        vertices: The vertices at its end.
        constraints: The constraints at its end.
        history: What was done.
        half_spaces: The half-spaces.
        steer: What the response was steered by.
        complete: Array of one int, 1 where nothing is missing.
    """

    def __init__(self, response, dt):
        """Copies what a response has just done."""
        self.dt = dt
        constraints, history = response.constraints, response.history.arrays
        if response.device.is_capturing:
            count, iterations = len(constraints.vertices), len(history.ends)
            entries, truncations = len(history.constraint), len(history.vertex)
        else:
            count = int(constraints.count.numpy()[0])
            iterations, entries, truncations = (
                int(history.sizes.numpy()[int(place)]) for place in (ITERATIONS_DONE, ENTRIES, TRUNCATED_PATHS)
            )
        self.steer = wp.clone(response.steer)
        self.half_spaces = HalfSpaces()
        for name in ("start", "end"):
            setattr(self.half_spaces, name, wp.clone(getattr(response.half_spaces, name)))
        self.vertices = _copied(response.vertices, Vertices(), dict.fromkeys(_OF_VERTICES))
        for name in ("inverse_mass", "friction", "world"):
            setattr(self.vertices, name, getattr(response.vertices, name))
        self.constraints = _copied(constraints, Constraints(), {**dict.fromkeys(_OF_CONSTRAINTS, count), "count": 1})
        lengths = {"sizes": None, "ends": iterations, **dict.fromkeys(MARKED)}
        lengths |= {**dict.fromkeys(OF_ENTRIES, entries), **dict.fromkeys(OF_TRUNCATIONS, truncations)}
        self.history = _copied(history, History(), lengths)
        self.complete = wp.empty(1, dtype=int, device=response.device)
        inputs = [constraints.count, history, count]
        wp.launch(_judge, 1, inputs=inputs, outputs=[self.complete], device=response.device)


def _copied(struct, into, lengths):
    """Copies the first elements of a struct's arrays, by name, into one of the same type; None: all."""
    for name, length in lengths.items():
        array = getattr(struct, name)
        if length == 0:  # of which Warp makes no slices
            setattr(into, name, wp.empty(0, dtype=array.dtype, device=array.device))
        else:
            setattr(into, name, wp.clone(array if length is None else array[:length]))
    return into


def _give_gradients(struct, names, gradients=None):
    """Replaces arrays of a struct by ones of the same data with gradients, given or new ones, which it returns."""
    into = SimpleNamespace(**(gradients or {}))
    for name in names:
        array = getattr(struct, name)
        if not hasattr(into, name):
            setattr(into, name, wp.zeros_like(array))
        if len(array):
            alias = array[:]
            alias.grad = getattr(into, name)
            setattr(struct, name, alias)
    return into


class Undoing:
    """Undoes a recorded step, and carries gradients along."""

    def __init__(self, recording, response):
        """Prepares to undo a recording of a response."""
        self._recording, self._response, self._device = recording, response, response.device
        self._launch_count = len(recording.constraints.vertices)
        device, n = self._device, len(recording.vertices.x0)
        self._gradients = gradients = _Gradients()
        for name in _Gradients.vars:
            setattr(gradients, name, wp.zeros(n, dtype=wp.vec3, device=device))
        self._vertices = vertices = _copied(recording.vertices, Vertices(), dict.fromkeys(_UNDONE_OF_VERTICES))
        for name in set(_OF_VERTICES) - set(_UNDONE_OF_VERTICES) | {"inverse_mass", "friction", "world"}:
            setattr(vertices, name, getattr(recording.vertices, name))
        vertices.active = wp.zeros(n, dtype=int, device=device)
        of_vertices = {"x1": gradients.more_x1, "velocity": gradients.more_velocity}
        self._of_vertices = _give_gradients(
            vertices, ("x0", "x1", "velocity", "wanted_x1", "wanted_velocity"), of_vertices
        )
        self._constraints = constraints = _copied(
            recording.constraints, Constraints(), dict.fromkeys(_UNDONE_OF_CONSTRAINTS)
        )
        for name in set(_OF_CONSTRAINTS) - set(_UNDONE_OF_CONSTRAINTS) | {"count"}:
            setattr(constraints, name, getattr(recording.constraints, name))
        self._of_constraints = _give_gradients(constraints, _DIFFERENTIABLE)
        truncations = len(recording.history.vertex)
        self._of_truncations = [wp.zeros(truncations, dtype=wp.vec3, device=device) for _ in range(2)]
        self._pushed = wp.empty(n, dtype=wp.vec3, device=device)
        self._progress = Progress()
        self._progress.steer = wp.zeros(int(STEER), dtype=int, device=device)
        self._progress.history = recording.history
        self._cursor = wp.zeros(int(CURSOR), dtype=int, device=device)
        self._more = wp.zeros(2, dtype=int, device=device)
        self._more_iterations, self._more_rounds = self._more[:1], self._more[1:]

    def backward(self, start_q, particle_q, particle_qd):
        """Turns gradients with respect to what the step led to into those with respect to what it came from.

        Args:
            start_q: Gradient with respect to positions at the start, to which it is added, array of vec3.
            particle_q: Gradient with respect to the positions at the end, array of vec3; in its place is put that with
                respect to the positions that the inner solver wanted.
            particle_qd: The same for the velocities.
        """
        recording, vertices, gradients = self._recording, self._vertices, self._gradients
        history, of_vertices = recording.history, self._of_vertices
        inputs = [vertices, gradients, recording.steer, particle_q, particle_qd]
        self._launch(_begin, len(vertices.x0), inputs, [of_vertices.x0])
        inputs = [history, recording.steer, self._response.projections, recording.complete]
        self._launch(_begin_undoing, 1, inputs, [self._cursor, self._more, self._progress.steer])
        self._undo_turn()
        wp.capture_while(self._more_iterations, self._batch, undo=self._undo_acceleration)
        self._undo_start()
        wp.capture_while(self._more_rounds, self._undo_round)
        inputs = [gradients, of_vertices.x0, of_vertices.wanted_x1, of_vertices.wanted_velocity, recording.complete]
        self._launch(_finish, len(particle_q), inputs, [start_q, particle_q, particle_qd])

    def _undo_turn(self):
        """Undoes the turn that keeps angular momentum."""
        vertices, constraints = self._vertices, self._constraints
        n = len(vertices.x0)
        self._launch(_undo_turn, n, [vertices])
        totals = wp.zeros((self._response.worlds, int(SUMS)), dtype=wp.float64, device=self._device, requires_grad=True)
        self._launch(twisting, self._launch_count, [vertices, constraints], [totals])
        self._launch(massing, n, [vertices], [totals])
        self._adjoin(turning, n, [vertices, totals], [self._gradients.velocity])
        self._adjoin(massing, n, [vertices], [totals.grad])
        self._adjoin(twisting, self._launch_count, [vertices, constraints], [totals.grad])

    def _batch(self, undo):
        for _ in range(BATCH):
            undo()

    def _undo_acceleration(self):
        """Undoes an iteration on velocities."""
        constraints, of_constraints = self._constraints, self._of_constraints
        self._undo(constraints.impulse, self._vertices.velocity_change)
        self._undo_velocities()
        self._adjoin(
            accelerating,
            self._launch_count,
            [self._vertices, constraints, self._progress, self._cursor, self._response.restitution],
            [of_constraints.impulse, of_constraints.reached, self._gradients.push],
        )
        self._vertices.active.zero_()

    def _undo_velocities(self):
        inputs = [self._vertices, self._gradients, self._cursor, self._more]
        self._launch(_undo_velocities, len(self._vertices.x0), inputs)

    def _undo_start(self):
        """Undoes the impulses to begin with."""
        constraints, of_constraints = self._constraints, self._of_constraints
        self._undo_velocities()
        self._adjoin(
            starting,
            self._launch_count,
            [self._vertices, constraints, self._recording.dt],
            [of_constraints.impulse, of_constraints.reached, self._gradients.push],
        )
        of_constraints.reached.zero_()

    def _undo_round(self):
        """Undoes a round: truncation or projection, and what its contacts were made of."""
        self._undo_displacements()
        self._undo_truncations()
        inputs = [self._recording.history, self._cursor]
        self._launch(_begin_round, 1, inputs, [self._more])
        wp.capture_while(self._more_iterations, self._batch, undo=self._undo_displacement)
        self._launch(_to_detection, 1, [self._cursor], [self._progress.steer])
        of_constraints = self._of_constraints
        self._adjoin(
            constraining,
            self._launch_count,
            [self._vertices, self._recording.constraints, self._progress, self._cursor, self._response.separation],
            [of_constraints.weights, of_constraints.normal, of_constraints.separation, of_constraints.urgency],
        )
        self._launch(_end_round, 1, [self._cursor], [self._more])

    def _undo_displacement(self):
        """Undoes an iteration on positions."""
        constraints, of_constraints = self._constraints, self._of_constraints
        self._undo(constraints.displacing, self._vertices.displacement)
        self._undo_displacements()
        self._adjoin(
            displacing,
            self._launch_count,
            [self._vertices, constraints, self._progress, self._cursor],
            [of_constraints.displacing, of_constraints.reached, self._gradients.x1],
        )
        self._vertices.active.zero_()

    def _undo_displacements(self):
        inputs = [self._vertices, self._gradients, self._cursor, self._more]
        self._launch(_undo_displacements, len(self._vertices.x0), inputs)

    def _undo_truncations(self):
        vertices, history = self._vertices, self._recording.history
        truncations = len(history.vertex)
        ends, velocities = self._of_truncations
        inputs = [vertices, self._gradients, history, self._cursor]
        self._launch(_undo_truncations, truncations, inputs, [ends, velocities])
        self._adjoin(
            truncating,
            truncations,
            [vertices, self._recording.half_spaces, self._progress, self._cursor, self._recording.dt],
            [ends, velocities],
        )

    def _undo(self, multiplier, sums):
        inputs = [self._vertices, self._constraints, self._progress, self._cursor, multiplier]
        self._launch(_undo, self._launch_count, inputs, [sums])

    def _launch(self, kernel, dim, inputs, outputs=()):
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._device)

    def _adjoin(self, kernel, dim, inputs, of_outputs):
        """Launches the adjoint of a kernel.

        It does not touch outputs, which their gradients stand for, but for those that functions add to.
        """
        outputs = [self._pushed if of is self._gradients.x1 or of is self._gradients.push else of for of in of_outputs]
        of_inputs = [value._cls() if hasattr(value, "_cls") else None for value in inputs]
        wp.launch(
            kernel,
            dim,
            inputs=inputs,
            outputs=outputs,
            adj_inputs=of_inputs,
            adj_outputs=of_outputs,
            adjoint=True,
            device=self._device,
        )
