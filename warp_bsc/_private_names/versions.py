"""Versions of Warp and Newton with which this package was tested."""

import functools
import importlib

from .._warnings import warn_caller

TESTED_VERSIONS = {"warp": ("1.17", "1.18", "1.19"), "newton": ("1.6", "1.7", "1.8")}
"""Versions with which the tests of this package have passed, by the name of the module."""


@functools.cache
def warn_if_untested(package: str) -> None:
    """Warns, once, if the version of a package, "warp" or "newton", is none of :data:`TESTED_VERSIONS`."""
    version, tested = version_of(package), TESTED_VERSIONS[package]
    if ".".join(version.split(".")[:2]) not in tested:
        warn_caller(
            f"warp-bsc relies on undocumented parts of {package}, and was tested with its versions "
            f"{', '.join(tested)}, not with {version}, which is installed"
        )


def version_of(package: str) -> str:
    """Returns the version of a package that has been imported."""
    return importlib.import_module(package).__version__


def missing(package: str, name: str, consequence: str) -> RuntimeError:
    """Returns the error that a version of a package lacks a name, and what follows."""
    return RuntimeError(f"{package} {version_of(package)} has no {name}, which warp-bsc uses: {consequence}")
