"""Pauses the collection of garbage while modules of kernels are imported."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def paused_collection() -> Iterator[None]:
    """Collects no garbage in the context.

    Warp parses each kernel as it is imported, into objects that stay. Every collection meanwhile looks at all of them
    again: the collision stage would take half as long again to import.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            if gc.get_freeze_count() == 0:
                gc.freeze()
                gc.unfreeze()  # all that there is counts as old now, and is not looked at three times soon
            gc.enable()
