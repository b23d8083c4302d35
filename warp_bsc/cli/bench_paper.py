"""The command ``warp-bsc bench paper``: measures the paper's benchmarks."""

import argparse
import importlib.util
import json
from pathlib import Path

import warp as wp
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from .._atomic_file import STDOUT, OutputFile
from ..bench import ipc_toolkit
from ..bench.figure import draw_paper_benchmarks
from ..bench.paper import Effort, Place, SceneBenchmark, benchmark_scene, find_adversarial_worst, find_places
from ..bench.provenance import with_record
from ..bench.scenes import PAPER_SCENES, BenchmarkScene, is_scene_name, load_intervals, paper_scenes
from ..bench.timing import limited_threads
from .bench_paper_tables import paper_benchmarks_to_dict, print_paper_benchmarks
from .device import find_device
from .exit_status import explain_statuses
from .options import Commands, add_command, add_threads
from .tables import Console

__all__ = ["add_to"]

_DESCRIPTION = """\
Measure the paper's five benchmarks, on the candidate pairs of each scene: the
mean and the worst time of a query by this project's methods, by a
floating-point cubic solver, by the paper's own inside tests and, if installed,
by the IPC Toolkit's methods; the wrong results of each, found by exact
arithmetic; the stages that decide the queries; and the time of a detection by
stage. A scene is one of the five by name, or a scene of warp-bsc bench
detector. All five together need several minutes, with --quick one or two."""

_EPILOG = f"""\
examples:
  warp-bsc bench
  warp-bsc bench --quick
  warp-bsc bench paper twisting crash:100000 --json times.json
  warp-bsc bench paper cloth.usd --device cpu --figure times.png

{explain_statuses()}"""

_FIGURES = (".png", ".svg", ".pdf")


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "paper", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    command.add_argument("scenes", metavar="SCENE", nargs="*", help="the scenes to measure (default: the paper's five)")
    command.add_argument("--quick", action="store_true", help="measure only a few intervals and queries")
    command.add_argument(
        "--device", help="Warp device, such as cpu or cuda:0 (default: the CPU, and the first GPU if there is one)"
    )
    command.add_argument(
        "--json",
        metavar="FILE",
        nargs="?",
        const=STDOUT,
        help="write all results as JSON to a file; without FILE, print them instead of tables",
    )
    command.add_argument(
        "--figure", metavar="FILE", help="draw the paper's Figure 7: .png, .svg or .pdf; needs matplotlib"
    )
    add_threads(command)


def _run(arguments: argparse.Namespace) -> int:
    _check(arguments)
    effort = Effort.quick() if arguments.quick else Effort.full()
    known = dict(zip(PAPER_SCENES, paper_scenes(), strict=True)) if _needs_assets(arguments.scenes) else {}
    names = [known.get(name, name) for name in arguments.scenes or known]
    if arguments.device is None:
        find_device(None)
        devices = [wp.get_device("cpu"), *wp.get_cuda_devices()[:1]]
    else:
        devices = [find_device(arguments.device)]
    files = {option: OutputFile(path) for option, path in _outputs(arguments).items()}
    try:
        scenes = [(name, load_intervals(name, most=effort.intervals)) for name in names]
        with limited_threads(arguments.threads):
            places = find_places(devices)
            benchmarks = _measure(scenes, places, effort)
            adversarial = find_adversarial_worst(places, effort)
        found = paper_benchmarks_to_dict(benchmarks, adversarial, quick=arguments.quick)
        found = with_record(found, arguments.command_line, devices)
        if arguments.json != STDOUT:
            print_paper_benchmarks(Console(), benchmarks, adversarial)
        else:
            print(json.dumps(found))
        if "json" in files:
            files["json"].write(json.dumps(found))
            files["json"].commit()
        if "figure" in files:
            draw_paper_benchmarks([found], arguments.figure)
    finally:
        for file in files.values():
            file.discard()
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Raises ValueError for options that would fail only after everything has been measured."""
    if arguments.figure:
        if Path(arguments.figure).suffix not in _FIGURES:
            raise ValueError(f"--figure {arguments.figure}: its name must end in one of {', '.join(_FIGURES)}")
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError("--figure needs matplotlib: pip install 'warp-bsc[bench]'")
    if arguments.json and is_scene_name(arguments.json):
        raise ValueError(f"--json {arguments.json}: this is a scene; name scenes before the options")


def _needs_assets(names: list[str]) -> bool:
    return not names or any(name in PAPER_SCENES for name in names)


def _outputs(arguments: argparse.Namespace) -> dict[str, str]:
    """Returns the files to write by option, opened before anything is measured, so that no result is lost."""
    outputs = {"json": None if arguments.json == STDOUT else arguments.json, "figure": arguments.figure}
    return {option: path for option, path in outputs.items() if path}


def _measure(
    scenes: list[tuple[str, list[tuple[int, BenchmarkScene]]]], places: list[Place], effort: Effort
) -> list[SceneBenchmark]:
    """Measures scene by scene, with a progress bar on standard error."""
    console = Console(stderr=True)
    compare = ipc_toolkit.is_installed()
    columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        steps = 4 + len({str(place.device) for place in places}) + len(places) + 2 * compare
        task = progress.add_task("Measuring", total=steps * len(scenes))
        benchmarks = []
        for number, (name, intervals) in enumerate(scenes):
            progress.update(task, completed=number * steps)

            def show(part: str, name: str = name) -> None:
                progress.update(task, advance=1, description=f"{Path(name).stem}: {part}")

            benchmarks.append(benchmark_scene(name, intervals, places, effort, compare=compare, progress=show))
        return benchmarks
