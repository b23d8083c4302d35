"""Registers gradients of device functions without building the functions, so that the package is imported sooner."""

import contextlib
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import warp as wp


@contextlib.contextmanager
def _known_return_type(function: wp.Function, returned: type) -> Iterator[None]:
    """Has Warp find the type that a function returns instead of building the function to find out."""
    function.build = lambda *_arguments, **_options: None
    function.adj.return_var = (SimpleNamespace(label="", type=returned),)
    try:
        yield
    finally:
        del function.build, function.adj.return_var


def func_grad(function: wp.Function, returned: type) -> Callable[[Callable], Callable]:
    """Returns a decorator that registers the gradient of a function, as :func:`warp.func_grad` does.

    :func:`warp.func_grad` builds the function, with all that it calls, to find the type that it returns. Contract of
    Warp: this is ``Function.build``, and the type is in ``Function.adj.return_var``. Where the contract is broken, the
    function is built.

    Args:
        function: A function without overloads and without generic arguments.
        returned: The type that it returns.
    """

    def register(gradient):
        with contextlib.suppress(AttributeError, RuntimeError, TypeError), _known_return_type(function, returned):
            return wp.func_grad(function)(gradient)
        return wp.func_grad(function)(gradient)

    return register
