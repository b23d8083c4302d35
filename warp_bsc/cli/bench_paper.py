"""``warp-bsc bench``: the paper's benchmarks from the command line."""

import importlib.util
import json
from pathlib import Path

import warp as wp
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from .._atomic_file import OutputFile
from ..bench.figure import draw_paper_benchmarks
from ..bench.ipc_toolkit import has_peers
from ..bench.paper import Effort, benchmark_scene, find_adversarial_worst, find_places
from ..bench.scenes import PAPER_SCENES, load_intervals, paper_scenes
from .bench_paper_tables import paper_benchmarks_to_dict, print_paper_benchmarks
from .tables import Console

__all__ = ["add_paper_options", "run_paper_benchmarks"]

_FIGURES = (".png", ".svg", ".pdf")
_STDOUT = "-"


def add_paper_options(command) -> None:
    """Add the options of the paper's benchmarks to their command."""
    command.add_argument("scenes", metavar="SCENE", nargs="*", help="what to measure (default: the paper's five)")
    command.add_argument("--quick", action="store_true", help="take a first look: few intervals and queries")
    command.add_argument(
        "--device", help="Warp device, such as cpu or cuda:0 (default: the CPU, and the first GPU if there is one)"
    )
    command.add_argument(
        "--json",
        metavar="FILE",
        nargs="?",
        const=_STDOUT,
        help="write JSON with everything found to a file; without one print it, and nothing else",
    )
    command.add_argument(
        "--figure", metavar="FILE", help="draw the paper's Figure 7: .png, .svg or .pdf; needs matplotlib"
    )


def run_paper_benchmarks(arguments, find_device, limited_threads) -> int:
    """Run the paper's benchmarks.

    Args:
        arguments: Of the command line.
        find_device: The function that finds a Warp device by its name.
        limited_threads: What keeps all that is measured to so many cores.

    Returns:
        The exit status.

    Raises:
        ValueError: If something cannot be measured or drawn.
        OSError: If a file cannot be read or written.
    """
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
        if arguments.json != _STDOUT:
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


def _check(arguments):
    """Raises ValueError for what would fail after all has been measured."""
    if arguments.figure:
        if Path(arguments.figure).suffix not in _FIGURES:
            raise ValueError(f"--figure {arguments.figure}: its name must end in one of {', '.join(_FIGURES)}")
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError("--figure needs matplotlib: pip install 'warp-bsc[bench]'")
    if arguments.json and (":" in arguments.json or Path(arguments.json).suffix.startswith(".usd")):
        raise ValueError(f"--json {arguments.json}: this is a scene; name scenes before the options")


def _needs_assets(names):
    return not names or any(name in PAPER_SCENES for name in names)


def _outputs(arguments):
    """The files to write, by option; their places are tried before anything is measured."""
    outputs = {"json": None if arguments.json == _STDOUT else arguments.json, "figure": arguments.figure}
    return {option: path for option, path in outputs.items() if path}


def _measure(scenes, places, effort):
    """Measures scene by scene, with a bar on standard error."""
    console = Console(stderr=True)
    columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        steps = 4 + len({str(place.device) for place in places}) + len(places) + 2 * has_peers()
        task = progress.add_task("Measuring", total=steps * len(scenes))
        benchmarks = []
        for number, (name, intervals) in enumerate(scenes):
            progress.update(task, completed=number * steps)

            def show(doing, name=name):
                progress.update(task, advance=1, description=f"{Path(name).stem}: {doing}")

            benchmarks.append(benchmark_scene(name, intervals, places, effort, peers=has_peers(), progress=show))
        return benchmarks
