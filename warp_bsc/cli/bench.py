"""The command ``warp-bsc bench NAME``: each name runs a measurement, prints tables, and writes JSON for programs."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

from .._atomic_file import STDOUT
from ..bench.measure import detector, newton_examples, paper_tables, penetration, queries, repair, response
from ..bench.scenes.repair import KINDS
from . import bench_run
from .exit_status import explain_statuses
from .options import (
    DEVICE,
    THREADS,
    Commands,
    Options,
    add_command,
    add_options,
    detection_options,
    distance,
    file_option,
    flag,
    names_of,
    natural,
    number,
    positive,
    positive_real,
    repeat_options,
    several,
    switch,
)

_DESCRIPTION = """\
Measure detection, SolverCCD and repair. Without the name of a benchmark,
warp-bsc bench runs the paper's five benchmarks, as warp-bsc bench paper does."""

_JSON: Options = {
    "--json": file_option(
        "write all results as JSON to a file; without FILE, print them instead of tables", nargs="?", const=STDOUT
    )
}


@dataclass(frozen=True)
class _Benchmark:
    """A command."""

    summary: str  # in the list of benchmarks
    texts: ModuleType  # which has its help texts
    run: Callable[[argparse.Namespace], None]
    options: Options
    kept: str = ""  # by a signal, in the plural; empty if it keeps nothing


def add_to(commands: Commands, summary: str, named: list[str] | None = None) -> None:
    """Adds ``bench``, and its benchmarks: with options those that are named, or all; the others without."""
    others = [name for name in BENCHMARKS if name != "paper"]
    lines = ["", " --quick", " paper --help", *(f" {name}" for name in others), " detector --help"]
    examples = "\n".join(f"  warp-bsc bench{line}" for line in lines)
    epilog = f"examples:\n{examples}\n\n{explain_statuses()}"
    bench = add_command(commands, "bench", None, summary=summary, description=_DESCRIPTION, epilog=epilog)
    benchmarks = bench.add_subparsers(required=True, metavar="BENCHMARK")
    for name, benchmark in BENCHMARKS.items():
        if named is not None and name not in named:
            benchmarks.add_parser(name, help=benchmark.summary)
            continue
        texts, epilog = benchmark.texts, f"{benchmark.texts.EXAMPLES}\n\n{explain_statuses()}"
        if benchmark.kept:
            epilog += f"\nAfter a signal, the {benchmark.kept} that were complete are printed or written first."
        command = add_command(
            benchmarks, name, benchmark.run, summary=benchmark.summary, description=texts.DESCRIPTION, epilog=epilog
        )
        add_options(command, benchmark.options)


BENCHMARKS = {
    "paper": _Benchmark(
        "measure the paper's benchmarks",
        paper_tables,
        bench_run.run_paper,
        {
            "scenes": several("SCENE", "the scenes to measure (default: the paper's five)"),
            "--quick": flag("measure only a few intervals and queries"),
            "--device": {
                "help": "Warp device, such as cpu or cuda:0 (default: the CPU, and the first GPU if there is one)"
            },
            **_JSON,
            "--figure": file_option("draw the paper's Figure 7: .png, .svg or .pdf; needs matplotlib"),
            **THREADS,
        },
    ),
    "detector": _Benchmark(
        "measure the detector",
        detector,
        bench_run.run_detector,
        {
            "scenes": several("SCENE", "the scenes to measure"),
            "--interval": number(natural, "interval of a USD file, counted from 0 (default: 0)", default=0),
            "--worlds": number(
                positive, "worlds with the scene, which do not collide with each other (default: 1)", default=1
            ),
            **repeat_options(5),
            **THREADS,
            "--compare": flag(
                "measure the IPC Toolkit's candidates and collision-free step size as well, on the CPU; needs ipctk"
            ),
            **detection_options("conservative"),
            **_JSON,
        },
    ),
    "queries": _Benchmark(
        "measure elementary queries",
        queries,
        bench_run.run_queries,
        {
            "paths": several(
                "FILE",
                "a CSV file as of warp-bsc query, or a folder: all CSV files in it and below, in one row for each kind",
            ),
            "--count": number(positive, "queries of each kind (default: 2^24 on a GPU, 2^18 on the CPU)"),
            **repeat_options(20),
            **THREADS,
            **DEVICE,
            **_JSON,
        },
    ),
    "newton": _Benchmark(
        "measure Newton's own examples",
        newton_examples,
        bench_run.run_newton,
        {
            "examples": several("EXAMPLE", "the examples to run, by name, with their options in quotes"),
            "--frames": number(
                positive,
                "frames of each run (default: the number that the example sets, else 300; on the CPU at most 10)",
            ),
            "--modes": names_of(
                newton_examples.MODES,
                "plain: the example as it is; stage: with SolverCCD behind its solver; implicit: with SolverImplicit "
                "in place of VBD (default: all)",
                metavar="MODE,...",
            ),
            "--check-every": number(
                positive,
                "count crossings at the end of every Nth frame, and of the last (default: %(default)s)",
                default=5,
            ),
            "--download": flag("let examples download assets; without it, their rows name the assets"),
            "--list": flag("list the examples and what they need, and run none"),
            **_JSON,
            **DEVICE,
        },
        kept="runs",
    ),
    "response": _Benchmark(
        "measure stretch, rest, energy and time of contact",
        response,
        bench_run.run_response,
        {
            "scenes": several("SCENE", "the scenes to run (default: all)"),
            "--solver": {
                "choices": response.SOLVERS,
                "default": "vbd",
                "help": "the inner solver (default: %(default)s)",
            },
            "--configurations": names_of(
                response.CONFIGURATIONS,
                "the configurations to run (default: all, self-contact, implicit and converged only for vbd)",
                all_by_default=False,
            ),
            "--reference": switch("whether the reference is among the default configurations"),
            "--rate": number(positive, "steps a second of the other configurations (default: that of the scene)"),
            "--reference-rate": number(
                positive, "steps a second of the reference (default: %(default)s)", default=response.REFERENCE_RATE
            ),
            "--seconds": number(
                positive_real, "simulated time of each run [s] (default: that of the scene)", metavar="T"
            ),
            "--perturb": number(
                distance,
                "run stage a second time with all particles moved sideways by D [m], and report how much its stretch "
                "differs",
                metavar="D",
            ),
            **_JSON,
            **DEVICE,
        },
        kept="runs",
    ),
    "repair": _Benchmark(
        "measure what repair frees, and how",
        repair,
        bench_run.run_repair,
        {
            "meshes": several("MESH", "mesh files to measure beside the known meshes and random damage"),
            "--random": number(
                natural, "meshes of each kind that are pushed into themselves (default: %(default)s)", default=10
            ),
            "--kinds": names_of(
                KINDS, f"kinds of meshes to push into themselves, of {', '.join(KINDS)} (default: all)"
            ),
            "--seed": number(
                natural,
                "number of the first mesh of each kind, on which its damage depends (default: %(default)s)",
                default=0,
            ),
            **_JSON,
            **DEVICE,
        },
        kept="repairs",
    ),
    "penetration": _Benchmark(
        "judge simulators by exact detection: who penetrates, where",
        penetration,
        bench_run.run_penetration,
        {
            "--scene": names_of(penetration.SCENES, "the scenes to run (default: all)"),
            "--simulator": names_of(penetration.SIMULATORS, "the simulators to run (default: all)"),
            "--frames": number(positive, "frames of each run, of 1/60 s (default: those of the scene)"),
            **_JSON,
            **DEVICE,
        },
        kept="runs",
    ),
}
"""The benchmarks by name."""
