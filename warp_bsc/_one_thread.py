"""Keeps two threads from using the buffers of one object at the same time."""

import functools
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar


class _Locked(Protocol):
    """An object with a lock: an :class:`threading.RLock`, at which threads wait, or :class:`Occupied`."""

    @property
    def _lock(self) -> AbstractContextManager[Any, Any]: ...


_Self = TypeVar("_Self", bound=_Locked)
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def one_at_a_time(
    method: Callable[Concatenate[_Self, _Arguments], _Result],
) -> Callable[Concatenate[_Self, _Arguments], _Result]:
    """Returns a method that holds the ``_lock`` of its object while it runs."""

    @functools.wraps(method)
    def locked(self: _Self, *arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        with self._lock:
            return method(self, *arguments, **options)

    return locked


class Occupied:
    """A lock that raises an error in a second thread instead of letting it wait.

    It suits objects whose calls build on each other: one after another from two threads, they would mix two sequences.
    """

    def __init__(self, name: str):
        """Makes a lock that is free.

        Args:
            name: What the object is called in errors.
        """
        self._name = name
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(f"another thread is using this {self._name}: use one for each thread")

    def __exit__(self, *_: object) -> None:
        self._lock.release()
