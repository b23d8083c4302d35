"""Steps of which a tape keeps a state now and then, and which it takes again on the way back, a segment at a time.

A segment begins with a copy of everything that its steps start from, and is recorded on a tape of its own when its
gradients are wanted. That tape begins as if a step had ended at the copy, so that what a program moves there keeps its
gradient apart, see :mod:`.between_steps`.
"""

import itertools
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import newton
import warp as wp

from ..._private_names.of_warp import paused_tape
from ..._private_names.tape_access import Access, access_to, arrays_of_launch, overlap
from ...response.drive.snapshot import Snapshot
from ...response.state.status import Loop
from .kernels import Count, add_to
from .step_gradients import StepGradients

wp.set_module_options({"enable_backward": False})

CheckpointedStep = Callable[[int, newton.State, newton.State], object]
"""Takes a step, given its number and the states at both ends."""
_ENDS = "particle_q", "particle_qd", "body_q", "body_qd"
"""Arrays of a state that steps lead to."""
_TYPES = wp.float32, wp.vec2, wp.vec3, wp.vec4, wp.quat, wp.transform, wp.spatial_vector, wp.mat33
"""Types of arrays of a state that have gradients."""


@wp.kernel
def _find_changed(saved: wp.array[int], values: wp.array[int], changed: wp.array[int]):
    """Finds out whether bits of values are not what they were."""
    i = wp.tid()
    if saved[i] != values[i]:
        changed[0] = 1


@wp.kernel
def _lose(changed: wp.array[int], gradients: wp.array[float], counts: wp.array[wp.int64]):
    """Makes gradients NaN, and counts that, if something has changed."""
    i = wp.tid()
    if changed[0] != 0:
        gradients[i] = wp.nan
        if i == 0:
            wp.atomic_add(counts, int(Count.UNREPEATED), wp.int64(1))


def _flat(array, dtype: type):
    """Returns an array as one of numbers of 32 bits; it keeps no memory alive."""
    return wp.array(ptr=array.ptr, dtype=dtype, shape=(array.capacity // 4,), device=array.device)


def _arrays_of(state, prefix=""):
    """Yields the arrays of a state by name."""
    for name, value in vars(state).items():
        if isinstance(value, wp.array):
            yield prefix + name, value
        elif isinstance(value, newton.Model.AttributeNamespace):
            yield from _arrays_of(value, f"{name}.")


def _gradients_of(state) -> dict[str, wp.array]:
    """Returns the gradients with respect to the arrays of a state by name."""
    return {name: x.grad for name, x in _arrays_of(state) if x.grad is not None and len(x) and x.dtype in _TYPES}


def _copy_gradients(source, into):
    gradients = _gradients_of(into)
    for name, gradient in _gradients_of(source).items():
        wp.copy(gradients[name], gradient)


def _clear_gradients(state):
    for gradient in _gradients_of(state).values():
        gradient.zero_()


class Checkpoints:
    """Steps that are taken in segments."""

    def __init__(
        self,
        gradients: StepGradients,
        totals: Sequence[wp.array],
        step: CheckpointedStep,
        steps: int,
        every: int,
        outputs: Sequence[wp.array],
    ):
        """Allocates states.

        Args:
            gradients: What records the steps of the solver.
            totals: Arrays in which it counts them.
            step: Takes a step.
            steps: Number of steps.
            every: Number of those of a segment.
            outputs: Arrays that steps write beside the states.
        """
        work = gradients.work
        self._gradients, self._step, self._outputs, self._every = gradients, step, outputs, every
        self._segments = [range(first, min(first + every, steps)) for first in range(0, steps, every)]
        # of the border at which a segment begins, and of its steps
        self._states = [work.mesh.model.state() for _ in range(len(self._segments[0]) + 2)]
        starts = [*work.motion.last.arrays, work.last_crossings, work.vertices.bodies.pose]
        self._starts = [array for array in starts if array is not None]
        self._totals = totals
        self._copies = list[Snapshot]()
        self._places = list[list]()
        self._norms = list[wp.array | None]()  # of the step that ended where each segment begins
        self._changed = wp.zeros(1, dtype=int, device=work.device)

    def take(self, tape: wp.Tape | None, state_in: newton.State, state_out: newton.State) -> None:
        """Takes the steps, of which a tape, if there is one, records none."""
        gradients, states = self._gradients, self._states
        self._norms.append(gradients.last[1] if gradients.last[0]() is tape else None)
        states[0].assign(state_in)
        for segment in self._segments:
            self._copies.append(self._copied())
            states[1].assign(states[0])
            taken = gradients.taken
            for k in segment:
                if k:
                    self._take(k)
                else:
                    self._take_first()
            if gradients.taken == taken:
                raise ValueError("step: it takes no step of the solver")
            states[0].assign(states[len(segment) + 1])
            if tape is not None:
                self._places.append([gradients.report.add_step(tape) for _ in range(gradients.taken - taken)])
                self._norms.append(self._places[-1][-1][1])
        self._copies.append(self._copied())
        state_out.assign(states[0])
        if tape is not None:
            gradients.last = weakref.ref(tape), self._norms[-1]

    def _copied(self):
        """Returns a copy of all that the next step starts from: its state, then ``_starts``."""
        return Snapshot([*dict(_arrays_of(self._states[0])).values(), *self._starts])

    def _take(self, k):
        start, end = self._states[1 + k % self._every :][:2]
        with paused_tape():
            end.clear_forces()
        self._step(k, start, end)

    def _take_first(self):
        """Takes the first step on a tape, which says what it writes."""
        nowhere = 0, wp.zeros((2, self._gradients.work.worlds), dtype=wp.float64, device=self._gradients.work.device)
        with self._gradients.aside(itertools.repeat(nowhere)), wp.Tape() as tape:
            self._take(0)
        known = [*self._outputs, *(array for state in self._states for _, array in _arrays_of(state))]
        written = [
            weakref.ref(array)
            for launch in tape.launches
            for _, array in arrays_of_launch(launch)
            if access_to(array, [launch]) is Access.WRITTEN and not any(overlap(array, x) for x in known)
        ]
        tape.launches.clear()  # and with them arrays that the step has made
        tape.gradients.clear()
        for array in filter(None, (reference() for reference in written)):
            raise ValueError(
                f"outputs must have all arrays that step writes, other than those of its states and those that it "
                f"makes; it writes one of shape {array.shape} and type {array.dtype.__name__}"
            )

    def go_back(self, found: dict[Any, Any], state_in: newton.State, state_out: newton.State) -> None:
        """Turns gradients with respect to the last state into those with respect to the first one and all else.

        Adds those of all else to ``found``, by their arrays: a tape then sets them to zero.
        """
        gradients, border = self._gradients, self._states[0]
        with paused_tape():
            after = Snapshot([*self._starts, *self._totals, *self._outputs])
            _clear_gradients(border)
            _copy_gradients(state_out, border)
            _clear_gradients(state_out)
            for segment in reversed(range(len(self._segments))):
                with gradients.aside(iter(self._places[segment])):
                    read = self._go_back_through(segment)
                found.update({array: gradient for of, gradient in read.items() if (array := of()) is not None})
            of_states = _gradients_of(border)
            for name, gradient in _gradients_of(state_in).items():
                values, sums = _flat(of_states[name], float), _flat(gradient, float)
                gradients.work.launch(add_to, len(sums), [values], [sums])
            self._restart(after)
            gradients.report.copy_counts()

    def _restart(self, copy):
        copy.restore()
        self._gradients.work.loop[Loop.RECOUNT].fill_(1)

    def _go_back_through(self, segment):
        """Takes the steps of a segment again, and goes back through them.

        Returns the gradients of arrays that they read, by weak references, as steps may have made them.
        """
        gradients, numbers, border = self._gradients, self._segments[segment], self._states[0]
        states = self._states[1 : len(numbers) + 2]
        self._restart(self._copies[segment])
        with wp.Tape() as tape:
            gradients.last = weakref.ref(tape), self._norms[segment]
            with gradients.between_steps.watched(tape, border, states[0]):
                with paused_tape():
                    states[0].assign(border)
                tape.record_func(lambda: _copy_gradients(states[0], border), [])
            for k in numbers:
                self._take(k)
        for state in states:
            _clear_gradients(state)
        _copy_gradients(border, states[-1])
        _clear_gradients(border)
        self._check(states[-1], self._copies[segment + 1].saved)
        tape.backward()
        of_states = {gradient.ptr for state in self._states for gradient in _gradients_of(state).values()}
        read = tape.gradients.items()
        return {weakref.ref(x): gradient for x, gradient in read if getattr(gradient, "ptr", 0) not in of_states}

    def _check(self, end, saved):
        """Makes the gradients at the end of a segment NaN if it is not the end that the steps had before."""
        work = self._gradients.work
        self._changed.zero_()
        of_end, last = dict(_arrays_of(end)), work.motion.last.arrays
        kept = [*of_end.items(), *(("last step", x) for x in last)]
        for before, (name, now) in zip(saved, kept, strict=False):
            if len(now) and name in (*_ENDS, "last step"):
                bits = _flat(now, int)
                work.launch(_find_changed, len(bits), [_flat(before, int), bits], [self._changed])
        of_end = _flat(end.particle_q.grad, float)
        work.launch(_lose, len(of_end), [self._changed], [of_end, self._gradients.report.counts])
