"""Warnings name the line of the program, whatever libraries lie between it and the package."""

import functools
import warnings

import pytest

from warp_bsc._warnings import warn_caller

CALL = "def call(function, *arguments):\n    function(*arguments)"


def called_from(module, function):
    """A function that a function of a module calls."""
    names = {"__name__": module}
    exec(compile(CALL, f"/{module}.py", "exec"), names)
    return functools.partial(names["call"], function)


def origin(*modules):
    """The file that a warning names that the first of the modules gives, which the second calls, and so on."""
    function = warn_caller
    for module in modules:
        function = called_from(module, function)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        function("something")
    return said[0].filename


@pytest.mark.parametrize(
    "modules",
    [
        ["warp_bsc.response.report.report"],
        ["warp_bsc.response.report.report", "warp_bsc.response.stage", "warp_bsc._one_thread"],
        ["warp_bsc.response.report.report", "newton.solvers.coupled"],
        ["warp_bsc.response.report.report", "warp_bsc.torch", "torch.autograd.function", "warp_bsc.torch"],
    ],
)
def test_a_warning_names_the_program(modules):
    assert origin(*modules) == __file__


def test_a_program_that_the_package_calls_is_named_itself():
    """Such as the function of captured steps."""
    assert origin("warp_bsc.response.stage", "simulation", "warp_bsc.response.captured_steps") == "/simulation.py"
    assert origin("warp_bsc.response.stage", "newtonian", "warp_bsc") == "/newtonian.py"
