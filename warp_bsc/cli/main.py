"""The command line, ``warp-bsc``."""

import argparse
import importlib.util
import json
import os
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import warp as wp
from rich.progress import track

from .. import __version__
from ..bench.detector import benchmark_detector, count_threads, limited_threads
from ..bench.queries import benchmark_copy, benchmark_queries, check_query_count
from ..bench.scenes import default_scenes, load_scene
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..detection.query import query_edge_edge, query_vertex_face
from ..detection.settings import METHODS
from .bench_paper import add_paper_options, run_paper_benchmarks
from .error_boundary import run_guarded
from .query_file import KINDS, find_query_files, read_query_file
from .replay import add_replay_options, open_scene, run_replay
from .tables import Console
from .tables_report import (
    QueryAnswers,
    detector_benchmarks_to_dict,
    print_detector_benchmarks,
    print_queries,
    print_query_benchmarks,
    queries_to_dict,
    query_benchmarks_to_dict,
)

__all__ = ["main", "run"]

_CUT_SHORT = """\
  129, 130, 143  interrupted by SIGHUP, by Ctrl-C, by SIGTERM
  141  nobody reads the output, as after | head -1"""

_STATUS = """\
exit status:
  0  done, whether or not anything collides
  1  collisions found, with --fail-on-collision
  2  wrong use, bad input or another error; a line on standard error says what
     and where"""

_EXIT_STATUS = f"""\
{_STATUS}
{_CUT_SHORT}"""

_REPLAY_EXIT_STATUS = f"""\
{_STATUS}
  3  --validate found an answer that is wrong
  4  done, but parts of the scene could not be read and were left out; --strict
     ends with 2 instead
{_CUT_SHORT}
Where several hold, the signals come before 2, then 3, 1 and 4."""

_EXAMPLES = f"""\
examples:
  warp-bsc replay cloth.usd
  warp-bsc query 227vf.csv 227ee.csv
  warp-bsc bench detector
  warp-bsc replay --help

{_EXIT_STATUS}"""

_REPLAY = """\
Find the collisions between each two consecutive time samples of a USD scene:
of its meshes with themselves and with each other, every vertex moving straight
from sample to sample. Meshes that never move are obstacles; where these touch
one another is not counted, nor where a mesh touches itself that only its
transform moves. What turns is sampled at every whole time code too. What
cannot be read is named and left out. Files appear complete or not at all;
after Ctrl-C, SIGTERM, SIGHUP or an error they hold the intervals that are
finished and say that they are partial."""

_REPLAY_EXAMPLES = f"""\
examples:
  warp-bsc replay cloth.usd
  warp-bsc replay shot.usd --overlay hits.usda --report hits.html
  warp-bsc replay shot.usd --between '/World/Coat' '/World/Body*' --no-self
  warp-bsc replay shot.usd --frames 101:150 --subdivide 4 --validate 1000
  warp-bsc replay cloth.usd --device cpu --method conservative
  warp-bsc replay cloth.usd --json > collisions.json
  warp-bsc replay cloth.usd --fail-on-collision || echo "it collides"

  a recording of one of Newton's examples:
  python -m newton.examples cloth_twist --viewer usd --num-frames 60 \\
      --output-path twist.usd
  warp-bsc replay twist.usd

{_REPLAY_EXIT_STATUS}"""

_QUERY = """\
Answer elementary queries and compare the answers with the truth, if it is
known. Eight rows of a CSV file are a query, each the numerators and
denominators of x, y and z, and the true answer (0 or 1) if known; it may also
stand in NAME_mma_bool.json."""

_QUERY_EXAMPLES = f"""\
examples:
  warp-bsc query 227vf.csv 227ee.csv
  warp-bsc query unit-tests --method float
  warp-bsc query pairs.csv --kind edge-edge --json > answers.json

{_EXIT_STATUS}"""

_BENCH_EXIT_STATUS = f"""\
exit status:
  0  done
  2  wrong use, bad input or another error; a line on standard error says what
     and where
{_CUT_SHORT}"""

_BENCH = """\
Measure how long things take. Without a benchmark's name: the paper's five
benchmarks, warp-bsc bench paper."""

_BENCH_EXAMPLES = f"""\
examples:
  warp-bsc bench
  warp-bsc bench --quick
  warp-bsc bench paper --help
  warp-bsc bench detector
  warp-bsc bench queries
  warp-bsc bench detector --help

{_BENCH_EXIT_STATUS}"""

_BENCH_PAPER = """\
Measure the paper's five benchmarks: for the candidate pairs of each scene the
time of a query, mean and worst, by this project's methods, a floating-point
cubic solver, the paper's own inside tests and, if installed, the IPC Toolkit's
methods; their wrong answers, held against exact arithmetic; what decides the
queries; and the time of a detection by stage. A scene is one of the five by
name, or what warp-bsc bench detector takes. The whole takes some minutes, a
quick look one or two."""

_BENCH_PAPER_EXAMPLES = f"""\
examples:
  warp-bsc bench
  warp-bsc bench --quick
  warp-bsc bench paper twisting crash:100000 --json times.json
  warp-bsc bench paper cloth.usd --device cpu --figure times.png

{_BENCH_EXIT_STATUS}"""

_BENCH_DETECTOR = """\
Measure the detector, from positions on the device to the results there and on
the host. A scene is a USD file, of which one interval is measured; two meshes
joined by a comma; or generated: cloth:TRIANGLES, a wrinkled sheet that folds
onto itself, or crash:TRIANGLES, a thin tube that is crushed. Default: the scene
of the checkout, if this is one, cloth:5000 and cloth:50000."""

_BENCH_DETECTOR_EXAMPLES = f"""\
examples:
  warp-bsc bench detector
  warp-bsc bench detector cloth.usd --interval 3
  warp-bsc bench detector first.ply,second.ply crash:1100000 --device cuda:0
  warp-bsc bench detector cloth:50000 --device cpu --threads 1 --compare
  warp-bsc bench detector --json > times.json

{_BENCH_EXIT_STATUS}"""

_BENCH_QUERIES = """\
Measure how many elementary queries a second are answered: random ones, the same
on every device, of which the culls leave a third. Queries and answers stay on
the device. On a GPU replays of a CUDA graph are timed, by events."""

_BENCH_QUERIES_EXAMPLES = f"""\
examples:
  warp-bsc bench queries
  warp-bsc bench queries --device cpu --threads 1 --count 1000000
  warp-bsc bench queries --json > rates.json

{_BENCH_EXIT_STATUS}"""


_BENCHMARKS = ("paper", "detector", "queries")


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        # So that wrong use ends as bad input does, in one line.
        raise ValueError(f"{message}; see {self.prog} --help")


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: The arguments, those of the process by default.

    Returns:
        The exit status, see ``warp-bsc --help``.
    """
    return run_guarded(lambda: run(sys.argv[1:] if argv is None else argv))


def run(argv: list[str]) -> int:
    """Run the command line as :func:`main` does, but raise every error."""
    arguments = _build_parser().parse_args(_with_joined_frames(_with_benchmark(argv)))
    return arguments.run(arguments)


def _with_benchmark(argv: list[str]) -> list[str]:
    """The arguments with the benchmark that is meant where none is named."""
    if argv[:1] == ["bench"] and argv[1:2] not in [[name] for name in (*_BENCHMARKS, "-h", "--help")]:
        return ["bench", "paper", *argv[1:]]
    return argv


def _with_joined_frames(argv: list[str]) -> list[str]:
    """The arguments with the value of --frames joined to it, lest one that begins with a minus look like an option."""
    if "--frames" not in argv[:-1]:
        return argv
    place = argv.index("--frames")
    return [*argv[:place], "=".join(argv[place : place + 2]), *_with_joined_frames(argv[place + 2 :])]


def _build_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="warp-bsc",
        description="Continuous collision detection for deforming triangle meshes.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"warp-bsc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = _add_command(
        commands, "replay", _run_replay, "find the collisions in a USD scene", _REPLAY, _REPLAY_EXAMPLES
    )
    add_replay_options(command)
    _add_detection_options(command, method="exact")
    _add_fail_on_collision(command)

    command = _add_command(commands, "query", _run_query, "answer queries of CSV files", _QUERY, _QUERY_EXAMPLES)
    command.add_argument("paths", metavar="FILE", nargs="+", help="a CSV file, or a folder for all that are in it")
    command.add_argument(
        "--kind",
        choices=KINDS,
        help="what the queries are (default: told by a folder vertex-face or edge-edge, or a name ending in vf or ee)",
    )
    _add_detection_options(command, method="exact")
    _add_json(command)
    _add_fail_on_collision(command)

    command = _add_command(commands, "bench", None, "measure how long things take", _BENCH, _BENCH_EXAMPLES)
    benchmarks = command.add_subparsers(required=True, metavar="BENCHMARK")
    command = _add_command(
        benchmarks, "paper", _run_bench_paper, "measure the paper's benchmarks", _BENCH_PAPER, _BENCH_PAPER_EXAMPLES
    )
    add_paper_options(command)
    _add_threads(command)

    command = _add_command(
        benchmarks,
        "detector",
        _run_bench_detector,
        "measure the detector",
        _BENCH_DETECTOR,
        _BENCH_DETECTOR_EXAMPLES,
    )
    command.add_argument("scenes", metavar="SCENE", nargs="*", help="what to measure")
    command.add_argument("--interval", type=int, default=0, metavar="N", help="of a USD file, from 0 (default: 0)")
    _add_benchmark_options(command, repeat=5)
    command.add_argument(
        "--compare",
        action="store_true",
        help="measure the IPC Toolkit's candidates and collision-free step size too, on the CPU; needs ipctk",
    )
    _add_detection_options(command, method="conservative")
    _add_json(command)

    command = _add_command(
        benchmarks, "queries", _run_bench_queries, "measure elementary queries", _BENCH_QUERIES, _BENCH_QUERIES_EXAMPLES
    )
    command.add_argument(
        "--count", type=int, metavar="N", help="queries of each kind (default: 2^24 on a GPU, 2^18 on the CPU)"
    )
    _add_benchmark_options(command, repeat=20)
    _add_device(command)
    _add_json(command)
    return parser


def _add_command(commands, name, run, summary, description, examples):
    command = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=run)
    return command


def _add_detection_options(command, *, method):
    command.add_argument(
        "--method",
        choices=METHODS,
        default=method,
        help="float: the signs as floating point computes them; conservative: what it cannot certify counts as a "
        "collision; exact: the true answer (default: %(default)s)",
    )
    _add_device(command)


def _add_device(command):
    command.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")


def _add_json(command):
    command.add_argument("--json", action="store_true", help="print JSON only, with everything found")


def _add_benchmark_options(command, *, repeat):
    command.add_argument(
        "--repeat",
        type=_positive,
        default=repeat,
        metavar="N",
        help="repetitions to take the median of (default: %(default)s)",
    )
    _add_threads(command)


def _add_threads(command):
    command.add_argument(
        "--threads", type=_positive, metavar="N", help="CPU cores to use, on Linux (default: all; those of a GPU aside)"
    )


def _add_fail_on_collision(command):
    command.add_argument("--fail-on-collision", action="store_true", help="exit with status 1 if anything collides")


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number


def _run_replay(arguments) -> int:
    scene = open_scene(arguments)
    device = _find_device(arguments.device)
    with _loading_kernels(Console(stderr=True), device):
        _load_detector(arguments.method, scene.dtype, device)
    return run_replay(scene, arguments, device)


def _run_query(arguments) -> int:
    files = [read_query_file(path, kind=arguments.kind) for path in find_query_files(arguments.paths)]
    device = _find_device(arguments.device)
    console, progress = Console(), Console(stderr=True)
    functions = dict(zip(KINDS, (query_vertex_face, query_edge_edge), strict=True))
    options = {"method": arguments.method, "toi": arguments.json, "device": device}
    with _loading_kernels(progress, device):
        for kind in {file.kind for file in files}:
            functions[kind](np.zeros((1, 8, 3)), **options)
    answers = []
    for file in files:
        start = time.perf_counter()
        result = functions[file.kind](file.points, **options)
        answers.append(QueryAnswers(file, result, 1e3 * (time.perf_counter() - start)))
    if arguments.json:
        print(json.dumps(queries_to_dict(answers, method=arguments.method, device=str(device))))
    else:
        print_queries(console, answers, method=arguments.method, device=str(device))
    return 1 if arguments.fail_on_collision and any(answer.hits for answer in answers) else 0


def _run_bench_paper(arguments) -> int:
    return run_paper_benchmarks(arguments, _find_device, limited_threads)


def _run_bench_detector(arguments) -> int:
    if arguments.compare and importlib.util.find_spec("ipctk") is None:
        raise ValueError("--compare needs the IPC Toolkit: pip install 'warp-bsc[bench]'")
    scenes = [load_scene(name, interval=arguments.interval) for name in arguments.scenes or default_scenes()]
    device = _find_device(arguments.device)
    console, progress = Console(), Console(stderr=True)
    options = {"method": arguments.method, "device": device, "repeat": arguments.repeat, "compare": arguments.compare}
    with limited_threads(arguments.threads):
        with _loading_kernels(progress, device):
            for dtype in {scene.x0.dtype for scene in scenes}:
                _load_detector(arguments.method, dtype, device)
        benchmarks = [
            benchmark_detector(scene, **options)
            for scene in track(
                scenes, description="Measuring", console=progress, transient=True, disable=not progress.is_terminal
            )
        ]
        settings = {
            "method": arguments.method,
            "device": device,
            "threads": count_threads(),
            "repeat": arguments.repeat,
        }
    if arguments.json:
        print(json.dumps(detector_benchmarks_to_dict(benchmarks, **settings)))
    else:
        print_detector_benchmarks(console, benchmarks, **settings)
    return 0


def _run_bench_queries(arguments) -> int:
    if arguments.count is not None:
        check_query_count(arguments.count)
    device = _find_device(arguments.device)
    console, progress = Console(), Console(stderr=True)
    options = {"device": device, "repeat": arguments.repeat}
    with limited_threads(arguments.threads):
        with _loading_kernels(progress, device):
            for kind in KINDS:
                benchmark_queries(kind, count=1, device=device, repeat=1)
        benchmarks = [benchmark_queries(kind, count=arguments.count, **options) for kind in KINDS]
        settings = {"copy_rate": benchmark_copy(**options), "threads": count_threads(), **options}
    if arguments.json:
        print(json.dumps(query_benchmarks_to_dict(benchmarks, **settings)))
    else:
        print_query_benchmarks(console, benchmarks, **settings)
    return 0


def _load_detector(method, dtype, device):
    """Load the detector's kernels, and compile them if need be."""
    triangles = CollisionMesh([[0, 1, 2], [3, 4, 5]], 6, device=device)
    points = np.zeros((6, 3), dtype)
    CollisionDetector(triangles, method=method).detect(points, points)


def _find_device(name: str | None):
    """The Warp device of that name, the preferred one for None."""
    _start_warp()
    if name is None:
        return wp.get_preferred_device()
    known = [device.alias for device in wp.get_devices()] + ["cuda"] * wp.is_cuda_available()
    if name not in known:
        raise ValueError(f"--device {name}: there is no such device here, only {', '.join(known)}")
    return wp.get_device(name)


def _start_warp():
    """Initialise Warp, without its native library's line on standard error where there is no CUDA driver."""
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    stderr = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


@contextmanager
def _loading_kernels(console: Console, device):
    """Tell the user what takes so long, should the kernels have to be compiled."""
    message = f"Compiling kernels for {device}, once for each version: up to a few minutes."
    timer = threading.Timer(2.0, console.print, [message])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
