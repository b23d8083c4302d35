"""Turns each error or signal that ends a command into an exit status and one line. Imports little."""

import contextlib
import errno
import io
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .._atomic_file import naming
from .exit_status import ExitStatus
from .interrupts import INTERRUPTS, Interrupted
from .option_names import with_option


def run_guarded(command: Callable[[], int]) -> int:
    """Runs a command and returns its exit status, also after an error or a signal.

    This is 2 after an error, 5 if a scene has nothing to check, 128 plus its number after a signal, each with a line on
    standard error; 141 without a line if the reader of standard output or standard error has closed it.
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
            _discard(1, 2)
            return ExitStatus.BROKEN_PIPE
        except Exception as error:
            from ..usd.scene_options import EmptySceneError  # noqa: PLC0415 (slow)

            status = ExitStatus.EMPTY if isinstance(error, EmptySceneError) else ExitStatus.ERROR
            return _explain(f"error: {describe(error)}", status)


def describe(error: BaseException) -> str:
    """Returns the message of an error in one line, with the option in place of the argument that it begins with.

    For an unforeseen error, its type and the line that raised it are added.
    """
    usd_errors = [part.commentary for part in error.args if hasattr(part, "commentary")]  # of a Tf.ErrorException
    text = " ".join(("; ".join(usd_errors) or str(error)).split())
    if usd_errors or (isinstance(error, OSError | ValueError | ImportError | MemoryError) and text):
        return with_option(text)
    text = ": ".join(filter(None, [type(error).__name__, text]))
    folder = Path(__file__).parents[1]
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if folder in Path(frame.filename).parents]
    return f"{text} ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else text


def finish_outputs(outputs: dict[str, Any], finish: Callable[[Any, str], None]) -> list[str]:
    """Finishes files, without their last parts if the disk is full; returns messages on missing parts.

    On a full disk all files shrink down to half of their intervals. After that only the file that does not fit
    shrinks, or is omitted; the page comes first, as it matters least: it is the last of ``outputs`` by their names,
    which can ``shrink``. ``finish`` finishes a file, given also why it has shrunk; empty if it has not.
    """
    problems, shortages = [], {}
    shared = 5  # number of eighths that all files lose, which leave about a half
    waiting = list(outputs)[::-1]  # the tables, which are the largest, come last
    while waiting:
        name = waiting[0]
        try:
            finish(outputs[name], shortages.get(name, ""))
        except Exception as error:
            if isinstance(error, BrokenPipeError) and name == "standard output":
                raise  # its reader has closed it, which is not an error
            number = error.errno if isinstance(error, OSError) else None
            sharing, smaller = [name], []
            if number in (errno.ENOSPC, errno.EDQUOT) and shared:
                sharing, shared = waiting, shared - 1
            if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                smaller = [other for other in sharing if outputs[other].shrink()]
            if smaller:
                shortages |= dict.fromkeys(smaller, describe(error))
                continue
            shortages.pop(name, None)
            problems.append(f"{name}: not written: {describe(error)}")
        waiting.pop(0)
    return problems + [f"{name}: not all of it is written: {shortage}" for name, shortage in shortages.items()]


@contextlib.contextmanager
def _encodable_output() -> Iterator[None]:
    """Writes characters that the encoding of standard output lacks as escapes."""
    stream = sys.stdout
    if not isinstance(stream, io.TextIOWrapper):
        yield
        return
    errors = stream.errors
    stream.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # reported when the text was written
            stream.reconfigure(errors=errors)


def _explain(line: str, status: int) -> int:
    """Prints why a command ended on standard error and returns the exit status."""
    try:
        print(f"warp-bsc: {line}", file=sys.stderr, flush=True)
    except OSError as error:  # standard error is full or closed as well
        _discard(2)
        if isinstance(error, BrokenPipeError):
            return ExitStatus.BROKEN_PIPE
    return status


def _discard(*outputs: int) -> None:
    """Discards the buffer of standard output (1) or error (2), on which Python would fail at exit."""
    with open(os.devnull, "w") as nowhere:
        for output in outputs:
            os.dup2(nowhere.fileno(), output)
