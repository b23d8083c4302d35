"""The commands ``warp-bsc bench NAME``: each runs a measurement, prints tables, and writes JSON for programs."""

import argparse
import contextlib
import importlib
import json
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import warp as wp
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from .._atomic_file import STDOUT, OutputFile
from ..bench.record import with_record
from .device import loading_kernels
from .exit_status import explain_statuses
from .interrupts import INTERRUPTS
from .options import Commands, Options, add_command, add_options
from .tables import Column, Console, count, say

__all__ = [
    "BENCHMARKS",
    "JSON_FILE",
    "Benchmark",
    "add_to",
    "check_json",
    "measure_each",
    "name_place",
    "open_json",
    "report_runs",
    "run_to_dict",
    "show_progress",
    "stage_columns",
]

BENCHMARKS = {
    "paper": "measure the paper's benchmarks",
    "detector": "measure the detector",
    "queries": "measure elementary queries",
    "newton": "measure Newton's own examples",
    "response": "measure stretch, rest, energy and time of contact",
    "repair": "measure what repair frees, and how",
    "penetration": "judge simulators by exact detection: who penetrates, where",
}
"""The benchmarks. Each is a module of this package, with its :class:`Benchmark` as ``BENCHMARK``."""

_DESCRIPTION = """\
Measure detection, SolverCCD and repair. Without the name of a benchmark,
warp-bsc bench runs the paper's five benchmarks, as warp-bsc bench paper does."""

_EXAMPLES = """\
  warp-bsc bench
  warp-bsc bench --quick
  warp-bsc bench paper --help
  warp-bsc bench detector
  warp-bsc bench queries
  warp-bsc bench newton
  warp-bsc bench response
  warp-bsc bench repair
  warp-bsc bench penetration
  warp-bsc bench detector --help"""

JSON_FILE: Options = {
    "--json": {
        "metavar": "FILE",
        "nargs": "?",
        "const": STDOUT,
        "help": "write all results as JSON to a file; without FILE, print them instead of tables",
    }
}
"""``--json``, whose file may be omitted."""

_Run = TypeVar("_Run")


@dataclass(frozen=True)
class Benchmark:
    """A command.

    Attributes:
        run: Runs it with the parsed arguments.
        description: The help text above the options.
        examples: Examples in the help text, a line each.
        options: The options.
        sections: Help text above the examples.
        kept: What a signal leaves, in the plural; empty if it leaves nothing.
    """

    run: Callable[[argparse.Namespace], None]
    description: str
    examples: str
    options: Options
    sections: str = ""
    kept: str = ""


def add_to(commands: Commands, summary: str, named: list[str] | None = None) -> None:
    """Adds ``bench``, and its benchmarks: with options those that are named, or all; the others without."""
    bench = add_command(commands, "bench", None, summary=summary, description=_DESCRIPTION, epilog=_explain(_EXAMPLES))
    benchmarks = bench.add_subparsers(required=True, metavar="BENCHMARK")
    for name, text in BENCHMARKS.items():
        if named is None or name in named:
            _add_benchmark(benchmarks, name, text)
        else:
            benchmarks.add_parser(name, help=text)


def _add_benchmark(commands: Commands, name: str, summary: str) -> None:
    benchmark: Benchmark = importlib.import_module(f".bench_{name}", __package__).BENCHMARK
    epilog = benchmark.sections + _explain(benchmark.examples)
    if benchmark.kept:
        epilog += f"\nAfter a signal, the {benchmark.kept} that were complete are printed or written first."
    command = add_command(
        commands, name, benchmark.run, summary=summary, description=benchmark.description, epilog=epilog
    )
    add_options(command, benchmark.options)


def _explain(examples: str) -> str:
    return f"examples:\n{examples}\n\n{explain_statuses()}"


def check_json(path: str | None, is_named: Callable[[str], bool], what: str, named: str) -> None:
    """Raises ValueError if the value of --json is the name of what is measured, which argparse takes for its file."""
    if path and is_named(path):
        raise ValueError(f"--json {path}: this is {what}; name {named} before the options")


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
    arguments: argparse.Namespace,
    device: wp.Device,
    measured: Generator[_Run, None, None],
    *,
    name: str,
    heading: str,
    show: Callable[[Console, list[_Run]], None],
    to_dict: Callable[[list[_Run]], dict[str, Any]],
    what: str = "runs",
) -> None:
    """Measures all runs, prints them, and writes those that were complete if an interrupt ends it.

    Args:
        arguments: The options.
        device: The Warp device.
        measured: Measures a run when its next element is taken.
        name: Name of the benchmark in JSON.
        heading: The first line that is printed.
        show: Prints runs.
        to_dict: Returns runs as plain data for JSON, without what all benchmarks have.
        what: What runs are called.

    Raises:
        OSError: If the file of --json cannot be written.
        KeyboardInterrupt: If an interrupt ended the measurement, after its results are written.
    """
    with open_json(arguments.json) as write:
        runs: list[_Run] = []
        interrupt = None
        try:
            with contextlib.closing(measured):  # takes its bar away
                for run in measured:
                    runs.append(run)
        except KeyboardInterrupt as signal:
            interrupt = signal
        with INTERRUPTS.held():
            if arguments.json != STDOUT:
                console = Console()
                say(console, heading)
                show(console, runs)
                if interrupt:
                    say(console, f"Interrupted: the other {what} are missing.")
            found = {"benchmark": name, "device": str(device), "device_name": device.name, "partial": bool(interrupt)}
            write(with_record(found | to_dict(runs), arguments.command_line, [device]))
        if interrupt:
            raise interrupt


def name_place(device: wp.Device, threads: int) -> str:
    """Returns a device with its name, of the CPU the number of cores."""
    return f"{device}, {count(threads, 'core') if device.is_cpu else device.name}"


def stage_columns(benchmarks: Iterable[Any]) -> list[Column]:
    """Returns columns of the times of the stages of detections."""
    stages = dict.fromkeys(stage for found in benchmarks for stage in found.stage_milliseconds)
    return [
        Column("\n".join(stage.rsplit(" ", 1)), lambda found, stage=stage: found.stage_milliseconds[stage], ",.2f")
        for stage in stages
    ]


def run_to_dict(run: Any, to_dict: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
    """Returns a run, a dataclass, as plain data, given a function that returns its measurement, if any, as such."""
    return vars(run) | {"measured": to_dict(run.measured) if run.measured else None}


def measure_each(
    cases: Iterable[tuple[Any, ...]],
    measure: Callable[..., _Run],
    device: wp.Device,
    *,
    title: Callable[..., str] = "{}, {}".format,
    unit: str = "",
    holds: bool = True,
) -> Generator[_Run, None, None]:
    """Yields runs, and shows the progress.

    Args:
        cases: The arguments of each run.
        measure: Measures a run, given these and ``progress``, a function to call with how much of it is done, and how
            much there is.
        device: The Warp device.
        title: Returns the title of a run, given its arguments.
        unit: What a run is done in; shares without.
        holds: Whether interrupts wait for the next progress: a library that is interrupted while it loads raises other
            errors, or none.
    """
    cases = list(cases)
    with show_progress(len(cases)) as (console, show), loading_kernels(device, console):
        for done, case in enumerate(cases):
            name = title(*case)
            show(done, f"{name}: starts")

            def show_part(part: int, parts: int, name: str = name, done: int = done) -> None:
                INTERRUPTS.check()
                how_much = f"{unit} {part:,} of {parts:,}" if unit else f"{part / parts:.0%}"
                show(done + part / parts, f"{name}: {how_much}")

            with INTERRUPTS.held() if holds else contextlib.nullcontext():
                run = measure(*case, progress=show_part)
            if (problem := getattr(run, "problem", None)) and console.is_terminal:
                say(console, f"{name}: {problem}")
            yield run
            INTERRUPTS.check()


@contextlib.contextmanager
def show_progress(total: int) -> Iterator[tuple[Console, Callable[[float, str], None]]]:
    """Shows a bar on standard error if that is a terminal.

    Args:
        total: Number of runs.

    Yields:
        A console that prints above the bar, and a function to call with how many runs are done, and what is done now.
    """
    console = Console(stderr=True)
    columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("Measuring", total=total)
        yield console, lambda done, description: progress.update(task, completed=done, description=description)
