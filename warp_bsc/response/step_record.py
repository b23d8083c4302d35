"""What a response did, taken down so that it can be undone, last things first: its gradient needs that."""

import warp as wp

__all__ = [
    "ENTRIES",
    "FORGOTTEN",
    "GRAZING",
    "ITERATIONS_DONE",
    "MARKED",
    "MARKS",
    "OF_ENTRIES",
    "OF_TRUNCATIONS",
    "SIZES",
    "STANDS",
    "TRUNCATED_PATHS",
    "History",
    "StepHistory",
    "begin_round",
    "end_iteration",
    "is_recording",
    "record_entry",
]

ITERATIONS_DONE, ENTRIES, TRUNCATED_PATHS, FORGOTTEN, GRAZING, SIZES = (wp.constant(i) for i in range(6))
"""Places in the array of sizes: iterations so far, constraints that acted in them, paths that were cut, whether
constraints were forgotten, and contacts whose gradients are clamped; and how many places there are."""

STANDS = wp.constant(-1)
"""The kind of contact of a vertex that is left where it was."""

MARKS = wp.constant(64)
"""Room for marks, one a round."""


MARKED = "iterations", "constraints", "truncations"
OF_ENTRIES = "constraint", "multiplier", "reached", "momentum"
OF_TRUNCATIONS = "vertex", "end", "contact", "kind", "localized", "toi", "coordinates", "normal"
"""Arrays of a history that have an element for each mark, each entry, each path that was cut."""


@wp.struct
class History:
    """What each iteration and each truncation of a step has changed. Of no length where nothing is taken down."""

    sizes: wp.array[int]
    ends: wp.array[int]  # how many entries there were at the end of an iteration
    constraint: wp.array[int]  # of an entry: that which acted
    multiplier: wp.array[wp.vec3d]  # before
    reached: wp.array[wp.vec3d]  # before
    momentum: wp.array[wp.float64]
    iterations: wp.array[int]  # how many of each there were at the beginning of a round
    constraints: wp.array[int]
    truncations: wp.array[int]
    vertex: wp.array[int]  # of a path that was cut
    end: wp.array[wp.vec3]  # of the path before
    kind: wp.array[int]  # of the contact that it was cut before; STANDS where all of the path was cut
    contact: wp.array[wp.vec4i]  # vertices of that contact; or the vertex and a half-space
    localized: wp.array[wp.bool]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@wp.func
def is_recording(history: History) -> bool:
    """Whether there is anything to take down in."""
    return history.sizes.shape[0] > 0


@wp.func
def record_entry(
    history: History, place: int, constraint: int, multiplier: wp.vec3d, reached: wp.vec3d, momentum: wp.float64
):
    """Takes down what a constraint was before it acted, ``place`` being its place among those of the iteration.

    What finds no room is missed by :data:`ENTRIES`, which counts it all the same.
    """
    entry = history.sizes[ENTRIES] + place
    if entry < history.constraint.shape[0]:
        history.constraint[entry] = constraint
        history.multiplier[entry] = multiplier
        history.reached[entry] = reached
        history.momentum[entry] = momentum


@wp.func
def end_iteration(history: History, acting: int):
    """Closes an iteration in which so many constraints acted; one in which none did leaves nothing to undo."""
    if acting == 0:
        return
    iteration = history.sizes[ITERATIONS_DONE]
    entries = history.sizes[ENTRIES] + acting
    history.sizes[ENTRIES] = entries
    history.sizes[ITERATIONS_DONE] = iteration + 1
    if iteration < history.ends.shape[0]:
        history.ends[iteration] = entries


@wp.func
def begin_round(history: History, mark: int, constraints: int):
    """Marks where a round begins."""
    history.iterations[mark] = history.sizes[ITERATIONS_DONE]
    history.constraints[mark] = constraints
    history.truncations[mark] = history.sizes[TRUNCATED_PATHS]


class StepHistory:
    """Room for the history of a step, used for one step after the other."""

    def __init__(self, device, *, iterations):
        """Makes room for so many iterations, and for nothing that they or truncations do."""
        self._device = device
        self.arrays = arrays = History()
        arrays.sizes = wp.zeros(int(SIZES), dtype=int, device=device)
        arrays.ends = wp.zeros(iterations, dtype=int, device=device)
        for name in MARKED:
            setattr(arrays, name, wp.zeros(int(MARKS), dtype=int, device=device))
        for names in (OF_ENTRIES, OF_TRUNCATIONS):
            self._make(names, 0)

    def begin(self):
        """Forgets what was taken down, and returns the arrays to take down the next step in."""
        self.arrays.sizes.zero_()
        return self.arrays

    def reserve_entries(self, more):
        """Makes room for so many more constraints that act, and returns the arrays. Asks the device."""
        return self._reserve(OF_ENTRIES, ENTRIES, more)

    def reserve_truncations(self, more):
        """Makes room for so many more paths that are cut, and returns the arrays. Asks the device."""
        return self._reserve(OF_TRUNCATIONS, TRUNCATED_PATHS, more)

    def _reserve(self, names, size, more):
        filled = int(self.arrays.sizes.numpy()[int(size)])
        old = {name: getattr(self.arrays, name) for name in names}
        if filled + more > len(old[names[0]]):
            self._make(names, 2 * (filled + more))
            for name in names if filled else ():
                wp.copy(getattr(self.arrays, name), old[name], count=filled)
        return self.arrays

    def _make(self, names, room):
        for name in names:
            setattr(self.arrays, name, wp.empty(room, dtype=History.vars[name].type.dtype, device=self._device))
