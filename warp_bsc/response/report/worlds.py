"""The part of a report that says what a step did in each world, as arrays on the device: ``report.worlds``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

_NO_IMPULSES = 'a stage keeps impulses only if it is asked to: SolverCCD(solver, report=["contacts"])'


@dataclass(eq=False)
class Worlds:
    """Results of the last step by world, Warp arrays of shape [world_count], written anew in each step.

    They are what the attributes of :class:`..report.SolverReport` with these names are for all worlds together. They
    stay where they are, so that a program may read them in a CUDA graph.

    Attributes:
        certified: Whether the motion is certified, bool.
        predicted_contacts: Contacts of the predicted motion, int.
        remaining: Contacts of the motion as it is stored, int.
        filtered: Pairs that filters left out, int. Shapes that are in all worlds have their elements in each of them.
        truncated: Vertices and bodies whose paths were truncated, int.
        frozen: Vertices and bodies that were frozen, int.
        not_finite: Particles whose predicted position or velocity was not finite, int.
        crossings: Edges that cross faces at the start, int.
        strain: Largest strain by contacts, float.
        inverting: Tetrahedra that the motion inverts, int; None if the stage was not asked to count them.
        inverted_at_start: Tetrahedra that were inverted at the start, int; None if the stage was not asked to count
            them.
        newton_steps, last_change, converged, arrived: As of
            :class:`warp_bsc.implicit.report.ImplicitStepReport`, int, float and bool; None if another
            solver steps.
    """

    certified: wp.array[wp.bool]
    predicted_contacts: wp.array[int]
    remaining: wp.array[int]
    filtered: wp.array[int]
    truncated: wp.array[int]
    frozen: wp.array[int]
    not_finite: wp.array[int]
    crossings: wp.array[int]
    strain: wp.array[float]
    _find_inside: Callable[[], np.ndarray]
    inverting: wp.array[int] | None = None
    inverted_at_start: wp.array[int] | None = None
    newton_steps: wp.array[int] | None = None
    last_change: wp.array[float] | None = None
    converged: wp.array[wp.bool] | None = None
    arrived: wp.array[wp.bool] | None = None
    _max_impulse: wp.array[float] | None = None

    @property
    def max_impulse(self) -> wp.array[float]:
        """The largest normal impulse of a contact [N s], float.

        Raises:
            RuntimeError: If the stage was not asked to keep contacts.
        """
        if self._max_impulse is None:
            raise RuntimeError(_NO_IMPULSES)
        return self._max_impulse

    @property
    def inside(self) -> np.ndarray:
        """Particles inside solids at the end of the step, int32, NumPy: found on the host on each access."""
        return self._find_inside()

    def numpy(self) -> dict[str, np.ndarray]:
        """Returns all results but :attr:`inside` on the host. Synchronizes with the device."""
        arrays = {name: array for name, array in vars(self).items() if isinstance(array, wp.array)}
        return {name.lstrip("_"): array.numpy() for name, array in arrays.items()}
