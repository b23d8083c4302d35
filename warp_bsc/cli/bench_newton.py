"""The command ``warp-bsc bench newton``: measures Newton's own examples, plain, with the stage and another solver."""

import argparse
import functools
import itertools
from dataclasses import asdict
from typing import Any

from ..bench.measure.newton_examples import (
    MODES,
    WARM_UP,
    ExampleMeasurement,
    ExampleRun,
    describe_needs,
    find_examples,
    measure_example,
)
from .bench import JSON_FILE, Benchmark, check_json, measure_each, report_runs, run_to_dict
from .device import find_device
from .interrupts import INTERRUPTS
from .options import DEVICE, flag, names_of, number, positive, several
from .tables import Column, Console, print_table, say

__all__ = ["BENCHMARK"]

_DESCRIPTION = """\
Run Newton's own examples, unchanged, and measure them: plain, with SolverCCD
put behind their solver, or behind each entry of a coupled solver that has
particles, and with SolverImplicit in place of VBD. Each run is a process of its
own, in which the example captures its own CUDA graph and runs its own tests. A
row has the times of frames, without drawing and without the first two; the
edges of cloth or soft bodies that cross faces at the start, and the most at
frame ends, found in exact arithmetic; the steps that were not certified; and
whether the example's own tests pass. Default: the examples of
newton.examples.cloth, softbody and multiphysics that have cloth or soft bodies.
Any other example of Newton can be named. Options of the example itself follow
its name, in quotes. A run that fails is a row, and a line below the table says
why. Tests that expect a state at rest fail in short runs, in all modes."""

_EXAMPLES = """\
  warp-bsc bench newton --list
  warp-bsc bench newton cloth_twist softbody_hanging --device cuda:0
  warp-bsc bench newton "cloth_hanging --solver xpbd" --frames 20 --modes stage
  warp-bsc bench newton --json examples.json"""

_NEEDS = (
    Column("Folder", lambda example: example.module.split(".")[2], "", kind="text"),
    Column("Needs", lambda example: "; ".join(describe_needs(example)), "", kind="text"),
)
_TIMES = (
    Column("Mode", "mode", "", kind="word"),
    Column("Median\n[ms]", "measured.median", ",.1f"),
    Column("95%\n[ms]", "measured.percentile_95", ",.1f"),
    Column("Worst\n[ms]", "measured.worst", ",.1f"),
    Column("Cross-\nings at\nstart", "measured.crossings_at_start"),
    Column("At\nmost", "measured.most_crossings"),
    Column("Its tests", lambda run: _name_result(run.measured), "", kind="word"),
)
_SIZES = (
    Column("Partic-\nles", "particles"),
    Column("Trian-\ngles", "triangles"),
    Column("Frames", "frames"),
    Column("Steps", "stage.steps"),
    Column("Uncer-\ntified", "stage.uncertified_steps"),
    Column("Trun-\ncated", "stage.truncated_steps"),
    Column("Frozen", "stage.frozen_steps"),
)


def _run(arguments: argparse.Namespace) -> None:
    device = find_device(arguments.device)
    with INTERRUPTS.held():  # a library that is interrupted while it loads raises other errors, or none
        examples = find_examples(arguments.examples)
        names = {example.name for example in find_examples()} if arguments.json else set()
    INTERRUPTS.check()
    check_json(arguments.json, lambda path: path.split(" ")[0] in names, "an example", "examples")
    if arguments.list:
        print_table(Console(), "Example", _NEEDS, [(example.title, example) for example in examples])
        return

    options = {"frames": arguments.frames, "check_every": arguments.check_every, "download": arguments.download}
    measure = functools.partial(measure_example, device=str(device), **options)
    report_runs(
        arguments,
        device,
        measure_each(itertools.product(examples, arguments.modes), measure, device, unit="frame", holds=False),
        name="newton",
        heading=f"Newton's examples on {device}, {device.name}; times of a frame without the first {WARM_UP}",
        show=_show,
        to_dict=lambda runs: {
            "frames_left_out": WARM_UP,
            "runs": [run_to_dict(run, _measurement_to_dict) for run in runs],
        },
    )


def _show(console: Console, runs: list[ExampleRun]) -> None:
    """Prints the times, the crossings and the tests of examples, a row a run, and the reports of stages."""
    caption = "Crossings of cloth and soft bodies: at the start, and the most at a checked frame end."
    print_table(console, "Example", _TIMES, [(run.example, run) for run in runs], caption=caption)
    sizes: dict[str, ExampleMeasurement] = {}
    for run in runs:
        for remark in _find_failures(run.measured) if run.measured else [run.problem]:
            say(console, f"{run.example}, {run.mode}: {remark}")
        name = f"{run.example}, implicit" if run.mode == "implicit" else run.example
        if run.measured and (run.measured.stage or name not in sizes):
            sizes[name] = run.measured
    if sizes:
        console.print()
        caption = "Steps: all, not certified, with paths truncated, with vertices frozen."
        print_table(console, "Example", _SIZES, sizes.items(), caption=caption)


def _measurement_to_dict(took: ExampleMeasurement) -> dict[str, Any]:
    values = asdict(took)
    frames = values.pop("frame_milliseconds")
    times = {"median": took.median, "percentile_95": took.percentile_95, "worst": took.worst, "frames": frames}
    return values | {"milliseconds": times}


def _name_result(took: ExampleMeasurement | None) -> str:
    """Returns how the tests of an example ended."""
    if took is None:
        return "not run"
    return "fail" if _find_failures(took) else took.test_final or "none"


def _find_failures(took: ExampleMeasurement) -> list[str]:
    """Returns the messages of an example's tests that failed, and the frame at which positions were not finite."""
    failures = [f"test_post_step: {took.test_post_step}"] if took.test_post_step not in (None, "ok") else []
    failures += [f"test_final: {took.test_final}"] if took.test_final not in (None, "ok") else []
    if took.first_frame_not_finite is not None:
        failures.append(f"positions are not finite at the end of frame {took.first_frame_not_finite}")
    return failures


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "examples": several("EXAMPLE", "the examples to run, by name, with their options in quotes"),
        "--frames": number(
            positive,
            "frames of each run (default: the number that the example sets, else 300; on the CPU at most 10)",
        ),
        "--modes": names_of(
            MODES,
            "plain: the example as it is; stage: with SolverCCD behind its solver; implicit: with SolverImplicit in "
            "place of VBD (default: all)",
            metavar="MODE,...",
        ),
        "--check-every": number(
            positive,
            "count crossings at the end of every Nth frame, and of the last (default: %(default)s)",
            default=5,
        ),
        "--download": flag("let examples download assets; without it, their rows name the assets"),
        "--list": flag("list the examples and what they need, and run none"),
        **JSON_FILE,
        **DEVICE,
    },
    kept="runs",
)
