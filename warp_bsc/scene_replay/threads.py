"""Iterators that work ahead, and calls that run behind, in threads."""

import contextvars
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice, repeat, takewhile
from typing import Generic, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def map_ahead(function: Callable[[_Item], _Result], items: Iterable[_Item], threads: int) -> Iterator[_Result]:
    """Yields ``function(item)`` for each item, in order, and meanwhile calls it for the next ones in other threads.

    Items are taken in this thread, as soon as a call can begin. Closing the iterator waits for the calls that run.

    Args:
        function: The function; its calls run in this thread's context.
        items: The items.
        threads: Number of calls at a time; as many results wait.

    Raises:
        Exception: The error of an item or of its call, when that item is next.
    """
    iterator = iter(items)
    calls: deque[Future[_Result]] = deque()
    end: Exception | None = None
    with ThreadPoolExecutor(threads, thread_name_prefix="map-ahead") as pool:
        while end is None or calls:
            while end is None and len(calls) <= threads:
                try:
                    calls.append(pool.submit(contextvars.copy_context().run, function, next(iterator)))
                except Exception as error:  # also that after the last item: StopIteration
                    end = error
            if calls:
                yield calls.popleft().result()
    if not isinstance(end, StopIteration):
        raise end


def read_ahead(items: Iterable[_Item]) -> Iterator[_Item]:
    """Yields items, and meanwhile makes the next one in another thread, in this thread's context.

    Closing the iterator waits for the next item.

    Raises:
        Exception: The error of making an item, when that item is next.
    """
    iterator = iter(items)
    taken = map_ahead(lambda _: list(islice(iterator, 1)), repeat(None), 1)
    for some in takewhile(bool, taken):
        yield some.pop()


class WriteBehind(Generic[_Item]):
    """Calls a function with items in order in another thread."""

    def __init__(self, write: Callable[[_Item], None], most: int = 16):
        """Makes a queue without items for calls of ``write``, in which at most so many wait."""
        self._write, self._most = write, most
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="write-behind")
        self._calls: deque[Future[None]] = deque()
        self._has_failed = False

    def put(self, item: _Item) -> None:
        """Hands over the next item, as soon as there is room for it.

        Raises:
            Exception: The error of a call, after which there are no others.
        """
        while self._calls and (len(self._calls) == self._most or self._calls[0].done()):
            self._wait_for_first()
        self._calls.append(self._pool.submit(self._call, item))

    def wait(self) -> None:
        """Waits until every item is written. An interruption ends the wait, not the calls.

        Raises:
            Exception: The error of a call, once.
        """
        while self._calls:
            self._wait_for_first()

    def close(self) -> None:
        """Ends the thread after the last call."""
        self._pool.shutdown()

    def _call(self, item: _Item) -> None:
        if self._has_failed:
            return
        try:
            self._write(item)
        except BaseException:
            self._has_failed = True
            raise

    def _wait_for_first(self) -> None:
        self._calls[0].exception()
        self._calls.popleft().result()
