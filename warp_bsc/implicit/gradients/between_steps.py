"""Gradients of kinematic particles and bodies that a program moves between two steps of a tape.

A step leaves kinematic particles and bodies where it found them, and a program may write other positions into the
state before the next step. A tape does not see that: it takes the positions for those of the step before. What a
program wrote is an input of its own, on which nothing before depends: the gradient belongs to the array it was written
to, and must not go on to the start of the step before. Each step on a tape therefore compares its start with the end of
the step before, and its gradients are kept apart while those of the step before are made.

What cannot be known is NaN:

- Where a kinematic particle is still where the step left it, its gradient goes on to the start of that step, as if
  nothing had been written. Whether a program wrote the same position is not known, so that its gradient in the array
  between the steps is NaN.
- Where the gradient of moved ones has a share of something that the tape recorded between the two steps, such as a
  loss, it may be of the position before or after. Both gradients are NaN, and counted.
- An array that the tape had used before the step that ended in it, such as one of two states that take turns, would
  get gradients of several times. That of what was moved is NaN, and counted.

What the tape itself writes between two steps, it differentiates. An array of which it writes a part is taken to be
written by it alone: gradients of what a program wrote into the same array go on to the start of the step before.
"""

import contextlib
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import newton
import numpy as np
import warp as wp
from newton import ParticleFlags

from ..._private_names.of_warp import paused_tape
from ..._private_names.tape_access import Access, access_to, arrays_of_launch
from ...response.state.mesh import dynamic_bodies
from .kernels import Count

wp.set_module_options({"enable_backward": False})

AMBIGUOUS_MOVES = (
    "kinematic particles or bodies were moved between steps on a tape, and it cannot be known what their gradients are "
    "of: they are NaN. Move them on the tape, give each step a state of its own, or record what reads them after the "
    "next step"
)
"""What to say of gradients that are NaN."""

GOES_ON, RESTS, STAYS, LOST, UNKNOWN = (wp.constant(i) for i in range(5))
"""Where the gradient of an array between two steps is written: to the start of the step (GOES_ON); there, with NaN in
the array (RESTS); to the array (STAYS); nowhere, with NaN in the array (LOST); or nowhere, NaN in both (UNKNOWN)."""


@wp.kernel
def _gather(index: wp.array[int], values: wp.array2d[float], rows: wp.array2d[float]):
    """Copies rows of values."""
    i, j = wp.tid()
    rows[i, j] = values[index[i], j]


@wp.kernel
def _find_moved(
    # in
    index: wp.array[int],
    last: wp.array2d[float],
    values: wp.array2d[float],
    # out
    moved: wp.array[int],
):
    """Finds rows that are not what they were."""
    i, j = wp.tid()
    if values[index[i], j] != last[i, j]:
        moved[i] = 1


@wp.kernel
def _finish(
    # in
    index: wp.array[int],
    start: wp.array2d[float],
    end: wp.array2d[float],
    # out
    last: wp.array2d[float],
    rests: wp.array[int],
    moved: wp.array[int],
):
    """Copies the rows at the end of a step, and finds those that are what they were at its start. None has moved."""
    i = wp.tid()
    row, same = index[i], int(1)
    for j in range(last.shape[1]):
        last[i, j] = end[row, j]
        if end[row, j] != start[row, j]:
            same = 0
    rests[i] = same
    moved[i] = 0


@wp.kernel
def _set_aside(
    # in
    index: wp.array[int],
    rests: wp.array[int],
    moved: wp.array[int],
    later: wp.array2d[float],
    is_written: bool,
    is_unknown: bool,
    is_reused: bool,
    # in and out
    of_end: wp.array2d[float],
    counts: wp.array[wp.int64],
    # out
    aside: wp.array2d[float],
    fate: wp.array[int],
):
    """Decides what becomes of gradients at the end of a step, and sets those aside that must not go back through it.

    ``later`` are those that the next step gave.
    """
    i = wp.tid()
    row = index[i]
    is_zero, is_later, is_nan = bool(True), bool(True), bool(False)
    for j in range(later.shape[1]):
        gradient = of_end[row, j]
        is_zero = is_zero and gradient == 0.0
        is_later = is_later and gradient == later[i, j]
        is_nan = is_nan or wp.isnan(gradient)
    outcome = GOES_ON
    if is_nan:
        outcome = UNKNOWN
    elif not is_zero and not is_written:
        if moved[i] == 0:
            if rests[i] != 0 and not is_reused:
                outcome = RESTS
        else:
            if not is_later or is_unknown:
                outcome = UNKNOWN
            elif is_reused:
                outcome = LOST
            else:
                outcome = STAYS
            if outcome != STAYS:
                wp.atomic_add(counts, int(Count.AMBIGUOUS_MOVES), wp.int64(1))
    fate[i] = outcome
    if outcome <= RESTS:
        return
    for j in range(later.shape[1]):
        aside[i, j] = of_end[row, j]
        of_end[row, j] = 0.0


@wp.kernel
def _put_back(
    # in
    index: wp.array[int],
    aside: wp.array2d[float],
    fate: wp.array[int],
    # out
    of_end: wp.array2d[float],
    of_start: wp.array2d[float],
):
    """Adds the gradients that were set aside to their arrays, after the step was gone back through."""
    i, j = wp.tid()
    row = index[i]
    if fate[i] == STAYS:
        of_end[row, j] = of_end[row, j] + aside[i, j]
    elif fate[i] != GOES_ON:
        of_end[row, j] = wp.nan
        if fate[i] == UNKNOWN and of_start:
            of_start[row, j] = wp.nan


def _components(array):
    """Returns an array of vectors or transforms as one of floats, with a row for each; it keeps no memory alive."""
    shape, strides = (len(array), array.dtype._length_), (array.strides[0], 4)
    return wp.array(ptr=array.ptr, dtype=float, shape=shape, strides=strides, device=array.device)


class _End:
    """An array in which a step on a tape ended, and what its adjoint keeps apart.

    Attributes:
        array: The array, positions or poses.
        start: The one in which the step started.
        launches: Entries of the tape up to there.
        is_followed: Whether a step of the tape starts in the array.
        is_written, is_unknown: Whether something on the tape writes the array before that, or may do so.
    """

    def __init__(self, array: wp.array, start: wp.array, index: wp.array, *, is_reused: bool):
        """Allocates copies of the rows of an array; ``is_reused`` says whether the tape has used it before."""
        self.array, self.start, self._index, self._is_reused = array, start, index, is_reused
        self.launches = 0
        self.is_followed = self.is_written = self.is_unknown = False
        rows = wp.zeros((3, len(index), array.dtype._length_), dtype=float, device=array.device)
        self._last, self._later, self._aside = rows[0], rows[1], rows[2]
        flags = wp.zeros((3, len(index)), dtype=int, device=array.device)
        self._rests, self._moved, self._fate = flags[0], flags[1], flags[2]

    def finish(self) -> None:
        """Copies the end of the step."""
        inputs = [self._index, _components(self.start), _components(self.array)]
        self._launch(_finish, len(self._index), inputs, [self._last, self._rests, self._moved])

    def follow(self, launches: list[Any]) -> None:
        """Finds what was moved before the step that starts here, between which and the end are entries of a tape."""
        access = access_to(self.array, launches)
        self.is_written |= access is Access.WRITTEN
        self.is_unknown |= access is Access.UNKNOWN or self.is_followed
        self.is_followed = True
        self._launch(_find_moved, self._last.shape, [self._index, self._last, _components(self.array)], [self._moved])

    def keep_later(self) -> None:
        """Copies the gradients after the next step was gone back through."""
        self._launch(_gather, self._last.shape, [self._index, _components(self.array.grad)], [self._later])

    def set_aside(self, counts: wp.array) -> None:
        """Sets gradients aside before the step is gone back through."""
        if self.is_followed:
            inputs = [self._index, self._rests, self._moved, self._later]
            inputs += [self.is_written, self.is_unknown, self._is_reused]
            outputs = [_components(self.array.grad), counts, self._aside, self._fate]
            self._launch(_set_aside, len(self._index), inputs, outputs)

    def put_back(self) -> None:
        """Puts gradients back after the step was gone back through."""
        if self.is_followed:
            of_start = None if self.start.grad is None else _components(self.start.grad)
            outputs = [_components(self.array.grad), of_start]
            self._launch(_put_back, self._last.shape, [self._index, self._aside, self._fate], outputs)

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.array.device)


class BetweenSteps:
    """Watches the kinematic particles and bodies of a model between the steps of a tape, see :mod:`.between_steps`."""

    def __init__(self, model: newton.Model, counts: wp.array[wp.int64]):
        """Reads which particles and bodies are kinematic.

        Args:
            model: The model.
            counts: Those of :class:`.report.GradientReport`, to which gradients that are NaN are added.
        """
        self._model, self._counts = model, counts
        self._tape: Callable[[], object] = lambda: None  # a weak reference
        self._hook: Callable[[], None] | None = None
        self._seen, self._used = 0, set[int]()  # entries of the tape, and pointers of their arrays
        self._ends: dict[int, _End] = {}
        self._begun: list[_End] = []
        self.refresh()

    def refresh(self) -> None:
        """Reads again which particles and bodies are kinematic."""
        model = self._model
        self._kinematic: dict[str, wp.array] = {}
        if model.particle_count:
            assert model.particle_inv_mass is not None and model.particle_flags is not None
            active = model.particle_flags.numpy() & int(ParticleFlags.ACTIVE) != 0
            self._add("particle_q", ~active | (model.particle_inv_mass.numpy() == 0.0))
        self._add("body_q", ~dynamic_bodies(model))

    def _add(self, name, kinematic):
        if kinematic.any():
            self._kinematic[name] = wp.array(np.flatnonzero(kinematic), dtype=int, device=self._model.device)

    @contextlib.contextmanager
    def watched(self, tape: wp.Tape, state_in: newton.State, state_out: newton.State) -> Iterator[None]:
        """Watches a step, all of which the tape records within the context."""
        if not self._kinematic:
            yield
            return
        with paused_tape():
            self._begin(tape, state_in, state_out)
        yield
        with paused_tape():
            self._end(tape)

    def _begin(self, tape, state_in, state_out):
        if self._tape() is not tape or self._has_lost(tape):
            self._tape, self._seen, self._used, self._ends = weakref.ref(tape), 0, set(), {}
        launches, followed = tape.launches, []
        for launch in launches[self._seen :]:
            self._used.update(array.ptr for _, array in arrays_of_launch(launch) if array.ptr)
        self._begun = begun = []
        for name, index in self._kinematic.items():
            start, end = getattr(state_in, name), getattr(state_out, name)
            before = self._ends.get(start.ptr)
            if before is not None and before.array.grad is not None:
                before.follow(launches[before.launches :])
                followed.append(before)
            self._used.add(start.ptr)
            if end.grad is not None:
                begun.append(_End(end, start, index, is_reused=end.ptr in self._used))
            self._used.add(end.ptr)

        def backward():
            for end in begun:
                end.put_back()
            for end in followed:
                end.keep_later()

        self._record(tape, backward)

    def _end(self, tape):
        begun, counts = self._begun, self._counts
        for end in begun:
            end.finish()

        def backward():
            for end in begun:
                end.set_aside(counts)

        self._record(tape, backward)
        for end in begun:
            end.launches = len(tape.launches)
            self._ends[end.array.ptr] = end

    def _record(self, tape, backward):
        tape.record_func(backward, [])
        self._hook, self._seen = backward, len(tape.launches)

    def _has_lost(self, tape):
        """Returns whether a tape was reset since the last step."""
        return len(tape.launches) < self._seen or tape.launches[self._seen - 1] is not self._hook
