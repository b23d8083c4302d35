"""Iterators that work one item ahead, and calls that run one item behind, in threads."""

import contextvars
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

_Item = TypeVar("_Item")


def read_ahead(items: Iterable[_Item]) -> Iterator[_Item]:
    """Yields items, and meanwhile makes the next one in another thread, in this thread's context.

    Closing the iterator waits for the next item.

    Raises:
        Exception: The error of making an item, when that item is next.
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
    """Calls a function with items in order in another thread, with at most one item waiting."""

    def __init__(self, write: Callable[[_Item], None]):
        """Makes a queue without items for calls of ``write``."""
        self._write = write
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")
        self._pending: Future[None] | None = None

    def put(self, item: _Item) -> None:
        """Waits until the previous item is written, and hands over the next one.

        Raises:
            Exception: The error of the call with the previous item.
        """
        self.wait()
        self._pending = self._pool.submit(self._write, item)

    def wait(self) -> None:
        """Waits until every item is written. An interruption ends the wait, not the call.

        Raises:
            Exception: The error of the last call, once.
        """
        if self._pending:
            self._pending.exception()
            pending, self._pending = self._pending, None
            pending.result()

    def close(self) -> None:
        """Ends the thread after the last call."""
        self._pool.shutdown()
