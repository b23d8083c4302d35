"""Where every error and every signal that ends a command becomes an exit status and one line. Imports little."""

import contextlib
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from .._atomic_file import naming
from .interrupts import INTERRUPTS, Interrupted

__all__ = ["describe", "run_guarded"]

_BROKEN_PIPE = 141
"""What a shell makes of the end by SIGPIPE."""


def run_guarded(command: Callable[[], int]) -> int:
    """Run a command.

    Args:
        command: Returns the exit status.

    Returns:
        The exit status: 2 after any error, 128 and the number of the signal after one, which a line on standard error
        then explains; without a line 141 where nobody reads the output any more.
    """
    with INTERRUPTS.handled(), _encodable_output():
        try:
            with INTERRUPTS.raised():
                status = command()
                with naming("standard output"):
                    print(end="", flush=True)
                INTERRUPTS.check()
                return status
        except KeyboardInterrupt as interrupt:
            return _explain(str(interrupt) or "interrupted", getattr(interrupt, "status", Interrupted().status))
        except BrokenPipeError:
            with open(os.devnull, "w") as nowhere:  # for what is left, which Python would try to write at exit
                for output in (1, 2):
                    os.dup2(nowhere.fileno(), output)
            return _BROKEN_PIPE
        except Exception as error:
            return _explain(f"error: {describe(error)}", 2)


def describe(error: BaseException) -> str:
    """What an error says, in one line; of one that nobody foresaw also what it is and where it comes from."""
    usd_errors = [part.commentary for part in error.args if hasattr(part, "commentary")]  # of a Tf.ErrorException
    text = " ".join(("; ".join(usd_errors) or str(error)).split())
    if usd_errors or (isinstance(error, OSError | ValueError) and text):
        return text
    text = ": ".join(filter(None, [type(error).__name__, text]))
    folder = Path(__file__).parents[1]
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if folder in Path(frame.filename).parents]
    return f"{text} ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else text


@contextlib.contextmanager
def _encodable_output():
    """Write to standard output with escapes what its encoding does not have."""
    stream = sys.stdout
    if not hasattr(stream, "reconfigure"):
        yield
        return
    errors = stream.errors
    stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # of what could not be written, which was said then
            stream.reconfigure(errors=errors)


def _explain(line, status) -> int:
    with contextlib.suppress(OSError):  # if standard error is full or closed as well
        print(f"warp-bsc: {line}", file=sys.stderr, flush=True)
    return status
