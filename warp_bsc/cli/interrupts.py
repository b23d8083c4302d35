"""Signals that end a program: raised as Ctrl-C is, once, so that what is finished can be kept."""

import contextlib
import signal
import threading

__all__ = ["INTERRUPTS", "Interrupted"]

_NUMBERS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupted(KeyboardInterrupt):
    """A signal that ends the program.

    Attributes:
        status: The exit status that is usual after it, 128 and its number.
    """

    def __init__(self, number: int = signal.SIGINT):
        super().__init__("interrupted" + (f" by {signal.Signals(number).name}" if number != signal.SIGINT else ""))
        self.status = 128 + number


class _Interrupts:
    """What becomes of SIGINT, SIGTERM and SIGHUP while :meth:`handled` says so.

    Those that the program was told to ignore, as ``nohup`` does, stay ignored. In a thread other than the main one, to
    which Python hands no signals, nothing changes.

    Attributes:
        came: The first that came, None if there was none.
    """

    def __init__(self):
        self.came = None
        self._handlers = {}
        self._raises = False

    @contextlib.contextmanager
    def handled(self):
        """Let signals wait in the block, except where they are raised; then all is as it was."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self.came, self._raises = None, False
        try:
            for number in _NUMBERS:
                # None is a handler that was not set from Python and could not be brought back.
                if signal.getsignal(number) not in (signal.SIG_IGN, None):
                    self._handlers[number] = signal.signal(number, self._handle)
            yield
        finally:
            while self._handlers:
                signal.signal(*self._handlers.popitem())

    @contextlib.contextmanager
    def raised(self, raises: bool = True):
        """Raise the first signal that comes in the block; those after it wait, so that nothing disturbs the end."""
        before, self._raises = self._raises, raises
        try:
            yield
        finally:
            self._raises = before and (self._raises or not raises)

    def held(self):
        """Let signals wait in the block."""
        return self.raised(False)

    def check(self):
        """Raise the signal that came, if one did: while it waited, or where an exception is not handed on."""
        if self.came:
            raise self.came

    def _handle(self, number, _frame):
        self.came = self.came or Interrupted(number)
        if self._raises:
            self._raises = False
            raise self.came


INTERRUPTS = _Interrupts()
"""The signals of this process."""
