"""What benchmarks share: --json FILE, results that an interrupt keeps, and the progress of runs."""

import argparse
import contextlib
import json
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, TypeVar

import rich.console
import warp as wp
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from .._atomic_file import STDOUT, OutputFile
from ..bench.provenance import with_record
from .interrupts import INTERRUPTS
from .tables import Console, say

__all__ = ["RunsProgress", "add_json_file", "open_json", "report_runs"]

_Run = TypeVar("_Run")


def add_json_file(command: argparse.ArgumentParser) -> None:
    """Adds --json, whose file may be omitted."""
    command.add_argument(
        "--json",
        metavar="FILE",
        nargs="?",
        const=STDOUT,
        help="write all results as JSON to a file; without FILE, print them instead of tables",
    )


@contextlib.contextmanager
def open_json(path: str | None) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Opens the file of --json, so that a path that cannot be written fails before anything is measured.

    Args:
        path: The value of --json.

    Yields:
        A function that writes a measurement, given as plain data: to the file, to standard output, or nowhere.

    Raises:
        OSError: If the file cannot be written.
    """
    file = OutputFile(path) if path not in (None, STDOUT) else None

    def write(found: dict[str, Any]) -> None:
        text = json.dumps(found)
        if path == STDOUT:
            print(text)
        if file:
            file.write(text)
            file.commit()

    try:
        yield write
    finally:
        if file:
            file.discard()


def report_runs(
    measured: Generator[_Run, None, None],
    *,
    to_dict: Callable[..., dict[str, Any]],
    show: Callable[..., None],
    json_path: str | None,
    command: Sequence[str],
    device: wp.Device,
) -> None:
    """Measures all runs, prints them, and writes those that were complete if an interrupt ends it.

    Args:
        measured: Measures a run when its next element is taken.
        to_dict: Returns runs as plain data, given a list of them, the device, and whether some are missing (partial).
        show: Prints runs to a console, given the console and the same.
        json_path: The value of --json.
        command: The program and its arguments, for the record of the measurement.
        device: The Warp device.

    Raises:
        OSError: If the file cannot be written.
        KeyboardInterrupt: If an interrupt ended the measurement, after its results are written.
    """
    with open_json(json_path) as write:
        runs: list[_Run] = []
        interrupt = None
        try:
            with contextlib.closing(measured):  # takes its bar away
                for run in measured:
                    runs.append(run)
        except KeyboardInterrupt as signal:
            interrupt = signal
        with INTERRUPTS.held():
            settings = {"device": device, "partial": interrupt is not None}
            if json_path != STDOUT:
                show(Console(), runs, **settings)
            write(with_record(to_dict(runs, **settings), command, [device]))
        if interrupt:
            raise interrupt


class RunsProgress:
    """A bar on standard error with the run that is measured, if this is a terminal."""

    def __init__(self, total: int):
        """Makes the bar for a number of runs."""
        console = Console(stderr=True)
        columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("Measuring", total=total)

    @property
    def console(self) -> rich.console.Console:
        """Prints on standard error, on a terminal above the bar."""
        return self._bar.console

    def __enter__(self) -> "RunsProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, done: float, description: str) -> None:
        """Shows how many runs are done, with the share of the one that is measured, and what it does."""
        self._bar.update(self._task, completed=done, description=description)

    def note(self, line: str) -> None:
        """Prints a line above the bar, if there is one."""
        if not self._bar.disable:
            say(self._bar.console, line)
