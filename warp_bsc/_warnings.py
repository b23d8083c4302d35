"""Warns at the line of the program that calls this package."""

import sys
import warnings

_NOT_OF_CALLER = {"warp_bsc", "newton", "warp", "torch", "jax"}
"""This package, and the libraries that call it for a program: a coupled solver, a function of autograd."""


def warn_caller(message: str) -> None:
    """Warns at the line of the program that led here: the innermost frame that is of no library.

    If there is none, as in a callback on a thread of JAX, it is the innermost frame outside this package.
    """
    roots = []
    frame = sys._getframe(1)
    while frame is not None:
        roots.append(frame.f_globals.get("__name__", "").partition(".")[0])
        frame = frame.f_back
    outside = [i for i, root in enumerate(roots) if root != "warp_bsc"]
    callers = [i for i in outside if roots[i] not in _NOT_OF_CALLER]
    warnings.warn(message, stacklevel=2 + (callers or outside or [0])[0])
