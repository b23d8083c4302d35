"""Copies of arrays and states, to which they can be set back."""

import copy
from collections.abc import Sequence
from typing import Any

import newton
import warp as wp


def _clone(x: Any) -> Any:
    """Returns a copy of an array, or of a state or a namespace of one; the model of a state may be any."""
    if isinstance(x, wp.array):
        return wp.clone(x, requires_grad=False)
    copied = copy.copy(x)
    for name, value in vars(x).items():
        if isinstance(value, (wp.array, newton.Model.AttributeNamespace)):
            setattr(copied, name, _clone(value))
    return copied


class Snapshot:
    """Keeps what arrays and states hold at one time."""

    def __init__(self, kept: Sequence[newton.State | wp.array]):
        """Copies arrays and states, as they are now; :meth:`save` copies them again, and allocates nothing."""
        self._kept = [(x, _clone(x)) for x in kept]

    def save(self) -> None:
        """Copies what they hold."""
        for x, saved in self._kept:
            saved.assign(x)

    def restore(self) -> None:
        """Makes them hold what they held when it was copied."""
        for x, saved in self._kept:
            x.assign(saved)
