"""Ranges for profilers, so that a profile on a GPU reads as the phases of a step."""

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import warp as wp

VARIABLE = "WARP_BSC_PROFILE"
"""Environment variable that turns ranges on if it is 1, read when the package is imported."""
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def phase(name: str) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Returns a decorator that makes the launches of a function an NVTX range.

    Ranges show in Nsight Systems where the host launches: of a CUDA graph, only while it is captured. They need PyPI's
    ``nvtx``. The decorator returns the function itself unless the variable ``WARP_BSC_PROFILE`` is 1.
    """

    def decorate(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        if os.environ.get(VARIABLE) != "1":
            return function

        @functools.wraps(function)
        def in_range(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
            with wp.ScopedTimer(f"warp_bsc: {name}", use_nvtx=True, print=False):
                return function(*arguments, **options)

        return in_range

    return decorate
