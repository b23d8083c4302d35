"""Reads and detects ahead, and writes behind, one item each, in threads."""

import contextvars
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

__all__ = ["WriteBehind", "read_ahead"]

_Item = TypeVar("_Item")


def read_ahead(items: Iterable[_Item]) -> Iterator[_Item]:
    """Yields items, the next of which is made in another thread meanwhile, in the context of this one.

    Closing waits for that one.

    Raises:
        Exception: What making an item raises, when it is that one's turn.
    """
    iterator = iter(items)
    context = contextvars.copy_context()
    nothing = []

    def take() -> list[_Item]:
        for item in iterator:
            return [item]
        return nothing

    with ThreadPoolExecutor(1, thread_name_prefix="read-ahead") as pool:
        following = pool.submit(context.run, take)
        while taken := following.result():
            following = pool.submit(context.run, take)
            yield taken.pop()


class WriteBehind(Generic[_Item]):
    """Calls a function with one item after another, in order, in another thread; at most one item waits."""

    def __init__(self, write: Callable[[_Item], None]):
        """Starts without an item; leaving the context waits for the last call."""
        self._write = write
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")
        self._pending: Future[None] | None = None

    def put(self, item: _Item) -> None:
        """Hands over an item when the one before is written.

        Raises:
            Exception: What the call with the item before has raised.
        """
        self.wait()
        self._pending = self._pool.submit(self._write, item)

    def wait(self) -> None:
        """Waits until every item is written. An interruption leaves the wait, not the call.

        Raises:
            Exception: What the last call has raised, once.
        """
        if self._pending:
            self._pending.exception()
            pending, self._pending = self._pending, None
            pending.result()

    def close(self) -> None:
        """Ends the thread after the last call."""
        self._pool.shutdown()
