"""Copies of arrays, to which they can be set back, all of them or in some worlds."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from ..state.motion import takes_part


def _restoring(dtype: type) -> wp.Kernel:
    """Returns the kernel below for arrays of a type: a graph on the CPU runs wrong overloads of generic ones."""

    @wp.kernel(enable_backward=False, module="unique")
    def restore(saved: wp.array[dtype], world: wp.array[int], mask: wp.array[wp.bool], values: wp.array[dtype]):
        """Restores what belongs to worlds that take no part in a step."""
        i = wp.tid()
        if not takes_part(mask, world[i]):
            values[i] = saved[i]

    return restore


_TYPES = wp.vec3, wp.vec4d, wp.transform, wp.spatial_vector, wp.float32, wp.int32
_RESTORE = {dtype: _restoring(dtype) for dtype in _TYPES}


def restore_worlds(saved: Any, worlds: wp.array[int], mask: wp.array[wp.bool], array: Any) -> None:
    """Restores the elements of an array in worlds that take no part in a step, given the world of each element."""
    wp.launch(_RESTORE[array.dtype], len(worlds), inputs=[saved, worlds, mask], outputs=[array], device=array.device)


class Snapshot:
    """Keeps what arrays hold at one time.

    Attributes:
        saved: The copies, in the order of what is kept.
    """

    def __init__(self, kept: Sequence[wp.array], *, worlds: Sequence[wp.array] = (), before: "Snapshot | None" = None):
        """Copies arrays, as they are now; :meth:`save` copies them again, and allocates nothing.

        ``worlds`` has the worlds of the elements of each array, if it is ever to be restored by a mask. The memory of a
        snapshot ``before``, which then is of no use, is used again if its arrays are of the same shapes.
        """
        self._kept, self._worlds = kept, worlds
        if before is not None and [(x.shape, x.dtype) for x in kept] == [(x.shape, x.dtype) for x in before.saved]:
            self.saved = before.saved
            self.save()
        else:
            self.saved = [wp.clone(x, requires_grad=False) for x in kept]

    def save(self) -> None:
        """Copies what they hold."""
        for x, saved in zip(self._kept, self.saved, strict=True):
            saved.assign(x)

    def restore(self, mask: wp.array[wp.bool] | None = None) -> None:
        """Makes them hold what they held when it was copied; with a mask, in worlds that take no part in a step."""
        for i, (x, saved) in enumerate(zip(self._kept, self.saved, strict=True)):
            if mask is None:
                x.assign(saved)
            else:
                restore_worlds(saved, self._worlds[i], mask, x)
