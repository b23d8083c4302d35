"""What this package uses of Warp and Newton beyond their public interfaces: one function for each name or contract.

Each function says which contract it relies on, and what happens where a version breaks it: a clear error, or a fallback
that says so in a warning. The first use on a version that was not tested warns, once for each package.
"""

import functools
import importlib
import warnings
from types import ModuleType
from typing import Any

import warp as wp

__all__ = ["TESTED_VERSIONS", "cpu_graph", "may_run_in_threads", "replace_name", "warn_if_untested"]

TESTED_VERSIONS = {"warp": ("1.18", "1.19"), "newton": ("1.8",)}
"""Versions with which the tests of this package have passed, by the name of the module."""


@functools.cache
def warn_if_untested(package: str) -> None:
    """Warns, once, if the version of a package, "warp" or "newton", is none of :data:`TESTED_VERSIONS`."""
    version, tested = _version(package), TESTED_VERSIONS[package]
    if ".".join(version.split(".")[:2]) not in tested:
        warnings.warn(
            f"warp-bsc relies on undocumented parts of {package}, and was tested with its versions "
            f"{', '.join(tested)}, not with {version}, which is installed",
            stacklevel=3,
        )


def _version(package: str) -> str:
    """Returns the version of a package that has been imported."""
    return importlib.import_module(package).__version__


def cpu_graph() -> Any:
    """Returns the :class:`warp.Graph` that the CPU captures.

    Contract: ``warp._src.context.runtime._apic_graph`` is the graph from ``capture_begin`` to ``capture_end``. Python
    functions in a graph on the CPU, see :mod:`.detection.host_function`, live as long as it. Its attribute ``apic``
    says whether the graph is to be saved.

    Raises:
        RuntimeError: If this version of Warp has no graph of that name: operations that read results on the host then
            cannot be captured on the CPU. Graphs on CUDA do not need it.
    """
    warn_if_untested("warp")
    try:
        graph = wp._src.context.runtime._apic_graph
        is_known = isinstance(graph.apic, bool)
    except AttributeError:
        is_known = False
    if not is_known:
        raise RuntimeError(f"Warp {wp.__version__} does not say which graph the CPU captures: run this outside graphs")
    return graph


def may_run_in_threads(kernel: wp.Kernel) -> bool:
    """Returns whether several threads may run a kernel on the CPU at once.

    Contract: Warp releases Python's lock while a kernel runs on the CPU. Its kernels share a pointer to the stack of
    the thread that set it last, for their tiles, which a kernel without tiles does not follow once it is optimized.
    ``kernel.module.options`` holds ``mode`` and ``optimization_level``, which decide whether it is, as far as they are
    not None; :mod:`warp.config` holds the defaults.

    Where the options are gone, the answer is False, with a warning: detection on the CPU then takes one core.
    """
    warn_if_untested("warp")
    try:
        options = kernel.module.options
        mode, level = options["mode"] or wp.config.mode, options["optimization_level"]
        level = wp.config.optimization_level if level is None else level
    except (AttributeError, KeyError):
        _warn_of_one_thread()
        return False
    return mode == "release" and level != 0


@functools.cache
def _warn_of_one_thread() -> None:
    warnings.warn(
        f"Warp {wp.__version__} does not say how kernels were compiled: warp-bsc runs them on one core of the CPU",
        stacklevel=4,
    )


def replace_name(module: ModuleType, name: str, value: object) -> None:
    """Replaces a function or a class of a module of Newton, for all that look it up there afterwards.

    Contract: Newton's examples call ``newton.examples.run``, download through ``newton.utils.download_asset`` and
    ``newton.examples.download_external_git_folder``, and make the solvers that :mod:`newton.solvers` names.

    Raises:
        RuntimeError: If the module does not have the name, so that the replacement would have no effect.
    """
    warn_if_untested("newton")
    if not hasattr(module, name):
        raise RuntimeError(f"Newton {_version('newton')} has no {module.__name__}.{name}, which warp-bsc replaces")
    setattr(module, name, value)
