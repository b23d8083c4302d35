"""Signals that end the program, raised once as KeyboardInterrupt so that finished results can be kept."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

_NUMBERS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(KeyboardInterrupt):
    """A signal that ends the program.

    Attributes:
        status: The usual exit status after it: 128 plus its number.
    """

    def __init__(self, number: int = signal.SIGINT):
        super().__init__("interrupted" + (f" by {signal.Signals(number).name}" if number != signal.SIGINT else ""))
        self.status = 128 + number


class _Interrupts:
    """Handles SIGINT, SIGTERM and SIGHUP within :meth:`handled`.

    Ignored signals, as under ``nohup``, stay ignored. Only in the main thread, where Python runs signal handlers, are
    signals handled.
    """

    def __init__(self):
        self.came: Interrupted | None = None  # the first signal that has arrived
        self._handlers: dict[int, Any] = {}
        self._raises = False

    @contextlib.contextmanager
    def handled(self) -> Iterator[None]:
        """Delays signals in the block, except where they are raised; restores the handlers at its end."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._raises = False
        try:
            for number in _NUMBERS:
                # None is a handler that was not set from Python, which could not be restored.
                if signal.getsignal(number) not in (signal.SIG_IGN, None):
                    self._handlers[number] = signal.signal(number, self._handle)
            yield
        finally:
            while self._handlers:
                signal.signal(*self._handlers.popitem())
            self.came = None  # a later run in another thread would raise it

    @contextlib.contextmanager
    def raised(self, raises: bool = True) -> Iterator[None]:
        """Raises the first signal that arrives in the block; delays later ones, so that they do not disturb cleanup."""
        before, self._raises = self._raises, raises
        try:
            yield
        finally:
            self._raises = before and (self._raises or not raises)

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Delays signals in the block."""
        return self.raised(False)

    def check(self) -> None:
        """Raises the signal that has arrived, if any: one that was delayed, or whose exception was swallowed."""
        if self.came:
            raise self.came

    def _handle(self, number: int, _frame: object) -> None:
        self.came = self.came or Interrupted(number)
        if self._raises:
            self._raises = False
            raise self.came


INTERRUPTS = _Interrupts()
"""The signals of this process."""
