"""The command ``warp-bsc replay``: finds the collisions in a USD scene and writes them to tables and files."""

import argparse
import contextlib
import errno
import importlib
import math
import os
import shlex
import time
from collections.abc import Generator
from dataclasses import asdict
from typing import Any, Literal

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .._atomic_file import STDOUT, naming, unfinished_path
from ..replay.baseline import Baseline
from ..replay.earlier import EarlierReplay, find_earlier
from ..replay.hit_files import HitsCsv, HitsJson, replay_facts
from ..replay.html_report import ReportPage
from ..replay.intervals import replay
from ..replay.outputs import ReplayOutput
from ..replay.results import IntervalResult
from ..replay.summary import Summary
from ..replay.threads import WriteBehind
from ..replay.usd_overlay import SHOWN_BY, Overlay
from ..replay.workers import checked_address, device_of_cluster
from ..usd.frames import FrameRange
from ..usd.scene import Scene
from ..usd.selection import PURPOSES, Selection
from .device import find_device, load_detector, loading_kernels
from .error_boundary import describe
from .exit_status import ExitStatus, explain_statuses
from .interrupts import INTERRUPTS, Interrupted
from .options import (
    Commands,
    add_command,
    add_detection_options,
    add_fail_on,
    distance,
    positive,
)
from .replay_tables import print_new, print_replay, print_work
from .tables import Console, say

__all__ = ["add_to", "open_scene", "run_replay"]

_DESCRIPTION = """\
Find the collisions of the meshes of a USD scene, with themselves and with each
other, between each two consecutive time samples; vertices move straight from
sample to sample. Meshes that never move are obstacles: contacts between
obstacles are excluded, and so are contacts of a mesh with itself if only its
transform moves it. Linear curves and points are included, with half their
widths as radii. Rotations are sampled at every whole time code as well.
At the time samples themselves, find the edges that pass through faces and the
meshes that are wholly inside closed ones, including obstacles and linear
curves; if nothing moves, at one time.
Parts that cannot be read are named and left out. Files are written atomically.
If Ctrl-C, SIGTERM, SIGHUP or an error stops the run, it leaves valid files of
the finished intervals, marked partial. If it is killed, --json leaves a file
from which --resume continues."""

_EPILOG = f"""\
examples:
  warp-bsc replay cloth.usd
  warp-bsc replay shot.usd --overlay hits.usda --report hits.html
  warp-bsc replay shot.usd --between '/World/Coat' '/World/Body*' --no-self
  warp-bsc replay shot.usd --frames 101:150 --subdivide 4 --validate 1000
  warp-bsc replay cloth.usd --device cpu --method conservative
  warp-bsc replay cloth.usd --json > collisions.json
  warp-bsc replay cloth.usd --clearance 0.002 --fail-on distance
  warp-bsc replay shot.usd --ignore-initial --ignore '/World/Hair*' /World/Head
  warp-bsc replay shot.usd --baseline hits_v1.json --fail-on new || echo "worse"
  warp-bsc replay shot.usd --workers 16 --json hits.json --resume
  warp-bsc replay shot.usd --workers tcp://head:8786 --report hits.html

  a recording of one of Newton's examples:
  python -m newton.examples cloth_twist --viewer usd --num-frames 60 \\
      --output-path twist.usd
  warp-bsc replay twist.usd

{explain_statuses(ExitStatus.FOUND, ExitStatus.DISAGREES, ExitStatus.LEFT_OUT)}"""

_LOG_SECONDS = 10.0
"""Time between two lines on the progress, where there is no terminal."""


def add_to(commands: Commands) -> None:
    """Adds the command with its options."""
    command = add_command(
        commands,
        "replay",
        _run,
        summary="find the collisions in a USD scene",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    command.add_argument("scene", metavar="SCENE", nargs="?", help="a .usd, .usda, .usdc or .usdz file")

    which = command.add_argument_group("selection")
    patterns = {"nargs": "+", "action": "extend", "default": [], "metavar": "PATTERN"}
    which.add_argument(
        "--prims",
        **patterns,
        help="check only meshes at or below these prims or instances, named as in the report; * matches any text",
    )
    which.add_argument("--exclude", **patterns, help="do not check meshes at or below these prims")
    which.add_argument(
        "--self",
        dest="self_collisions",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="check each mesh with itself (default: yes, unless only its transform moves it)",
    )
    which.add_argument(
        "--intersections",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="find the edges that pass through faces or touch them at the time samples themselves, and the meshes that "
        "are wholly inside others (default: yes)",
    )
    which.add_argument(
        "--clearance",
        type=distance,
        metavar="D",
        help="find the proximities at the time samples themselves: vertices and faces, and edges, that are at most D "
        "apart, in the scene's unit, and neither share a vertex nor are joined by an edge. Distances between the "
        "samples are not checked, nor are those of curves and points; an edge that passes through a face is an "
        "intersection instead",
    )
    which.add_argument(
        "--between", nargs=2, metavar=("A", "B"), help="check only pairs of a mesh of pattern A and one of pattern B"
    )
    which.add_argument(
        "--ignore",
        nargs=2,
        action="append",
        default=[],
        metavar=("A", "B"),
        help="only count the collisions of a mesh of pattern A and one of pattern B; may be repeated",
    )
    which.add_argument(
        "--ignore-from",
        metavar="FILE",
        help="read pairs for --ignore from a file: two patterns a line, in quotation marks if they contain blanks; # "
        "begins a comment",
    )
    which.add_argument(
        "--ignore-initial",
        action="store_true",
        help="ignore all pairs of meshes that cross at the first time, and meshes that cross themselves then; for "
        "meshes that are inside others then, ignore only that they are inside",
    )
    which.add_argument(
        "--purpose",
        nargs="+",
        action="extend",
        choices=PURPOSES,
        metavar="PURPOSE",
        help="purposes of the meshes to check: default, render, proxy, guide (default: default render)",
    )
    which.add_argument(
        "--frames",
        type=_frames,
        metavar="START:END:STEP",
        help="time codes to check, each of the three optional; without STEP, all samples from START to END",
    )
    which.add_argument(
        "--subdivide",
        type=positive,
        default=1,
        metavar="N",
        help="divide the time from each sample to the next into N intervals, for motion that is not linear, such as "
        "rotations (default: 1)",
    )
    which.add_argument(
        "--strict",
        action="store_true",
        help="end with status 2 if a part of the scene cannot be read, instead of leaving it out",
    )
    which.add_argument(
        "--allow-missing",
        **patterns,
        help="do not count these files, or the files and prims that these prims refer to, as left out if they are "
        "missing, only note them; * matches any text. Materials, textures and other files that cannot hold geometry "
        "may always be missing",
    )
    which.add_argument(
        "--validate",
        type=_validate,
        default=0,
        metavar="all|N",
        help="decide pairs of each interval again by the exact checker: all, or N hits and N other pairs",
    )

    out = command.add_argument_group("output")
    out.add_argument(
        "--overlay",
        metavar="FILE",
        help="a USD layer over the scene, .usda or .usdc, which shows the collisions as guides",
    )
    file = {"type": _output, "metavar": "FILE"}
    out.add_argument(
        "--report", **file, help="a page with a timeline, every interval in 3D, and a table of all collisions, .html"
    )
    printed = {"nargs": "?", "const": STDOUT, **file}
    out.add_argument("--json", **printed, help="every collision as JSON; without FILE, print only that")
    out.add_argument("--csv", **printed, help="every collision as CSV; without FILE, print only that")
    out.add_argument(
        "--baseline",
        metavar="FILE",
        help="compare with the JSON file of an earlier replay with the same options: print which meshes collide, "
        "cross, are inside others or, with --clearance, are near each other at times at which they were not then",
    )
    add_fail_on(
        out,
        {
            "intersections": "edges through faces, meshes inside others",
            "collisions": "",
            "distance": "proximities, with --clearance",
            "new": "findings that --baseline does not contain",
        },
    )
    run = command.add_argument_group("running")
    run.add_argument(
        "--workers",
        type=_workers,
        default=1,
        metavar="N|ADDRESS",
        help="check intervals in N processes on this machine, which share its cores or, unless --device names one "
        "such as cuda:0, its GPUs (default: 1); or in the workers of the Dask cluster whose scheduler has this "
        "address, such as tcp://head:8786, which need the scene at the same path and pip install 'warp-bsc[cluster]'",
    )
    run.add_argument(
        "--resume",
        action="store_true",
        help="continue an earlier run with the same options and files that was stopped or killed: take its finished "
        "intervals from the file of --json, or that name with .part appended, and check the others; without these "
        "files, check all",
    )
    add_detection_options(command, method="exact")


def _run(arguments: argparse.Namespace) -> int:
    scene = open_scene(arguments)
    baseline = None
    if arguments.baseline:
        baseline = Baseline(
            arguments.baseline,
            method=arguments.method,
            clearance=arguments.clearance,
            options=_describe_options(scene, arguments),
        )
    if isinstance(arguments.workers, str):
        try:
            device = device_of_cluster(arguments.workers, arguments.device)
        except ModuleNotFoundError as error:  # wrong usage, not an unforeseen error
            raise ValueError(str(error)) from error
        return run_replay(scene, arguments, device, baseline)
    device = find_device(arguments.device)
    with loading_kernels(device):
        load_detector(
            arguments.method,
            scene.dtype,
            device,
            intersections=arguments.intersections,
            proximities=arguments.clearance is not None,
            strands=scene.has_strands,
        )
    return run_replay(scene, arguments, str(device), baseline)


def open_scene(arguments: argparse.Namespace) -> Scene:
    """Opens the scene that the options name.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the options do not fit together, or the file is broken.
    """
    # The file of these options is optional: without it, argparse takes the scene that follows for it.
    for option in ("json", "csv"):
        if arguments.scene is None and getattr(arguments, option) not in (None, STDOUT):
            arguments.scene = getattr(arguments, option)
            setattr(arguments, option, STDOUT)
    if arguments.scene is None:
        raise ValueError("the following arguments are required: SCENE; see warp-bsc replay --help")
    is_saved = arguments.json not in (None, STDOUT)
    outputs = [file for file in (arguments.overlay, arguments.report, arguments.json, arguments.csv) if file]
    if "new" in arguments.fail_on and not arguments.baseline:
        raise ValueError("--fail-on new needs --baseline")
    if "distance" in arguments.fail_on and arguments.clearance is None:
        raise ValueError("--fail-on distance needs --clearance")
    if not arguments.intersections and (arguments.ignore_initial or "intersections" in arguments.fail_on):
        raise ValueError("--ignore-initial and --fail-on intersections need --intersections")
    if arguments.resume and not is_saved:
        raise ValueError("--resume needs --json FILE")
    if outputs.count(STDOUT) > 1:
        raise ValueError("--json, --csv and --report: only one of them can be printed on standard output")
    written = [*outputs, str(unfinished_path(arguments.json))] if is_saved else outputs
    paths = [os.path.realpath(file) for file in [arguments.scene, *written] if file != STDOUT]
    for path in paths:
        if paths.count(path) > 1:
            raise ValueError(f"{path}: named twice, as two files of a replay")
    selection = Selection(
        prims=tuple(arguments.prims),
        exclude=tuple(arguments.exclude),
        self_collisions=arguments.self_collisions,
        between=tuple(arguments.between) if arguments.between else None,
        purposes=tuple(arguments.purpose or Selection.purposes),
        ignore=(*map(tuple, arguments.ignore), *(_read_pairs(arguments.ignore_from) if arguments.ignore_from else ())),
    )
    with INTERRUPTS.held():  # an interrupt while USD's modules load is caught there, and breaks them
        importlib.import_module("warp_bsc.usd.find_meshes")
    INTERRUPTS.check()
    try:
        with _Progress("Comparing vertices") as progress:
            scene = Scene(
                arguments.scene,
                selection=selection,
                frames=arguments.frames,
                subdivide=arguments.subdivide,
                strict=arguments.strict,
                allow_missing=arguments.allow_missing,
                progress=progress.show,
            )
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"{arguments.scene}: {describe(error)}") from error
    for file in written:
        if file in scene.files:
            raise ValueError(f"{file}: the scene is read from this file; write to another one")
    return scene


def run_replay(scene: Scene, arguments: argparse.Namespace, device: str, baseline: Baseline | None) -> int:
    """Replays a scene, writes the files that the options name, and returns the exit status.

    Args:
        scene: The scene.
        arguments: The options.
        device: Name of the Warp device.
        baseline: The earlier replay to compare with, None without one.

    Raises:
        ValueError: If the scene is broken at some time, or a file cannot be written. The files contain the finished
            intervals, or as many as the disk has space for.
    """
    settings = {"method": arguments.method, "device": device, "clearance": arguments.clearance}
    facts = replay_facts(scene, **settings, options=_describe_options(scene, arguments))
    with contextlib.ExitStack() as stack:
        earlier = find_earlier(arguments.json, facts) if arguments.resume else None
        earlier_count = 0
        if earlier:
            stack.enter_context(contextlib.closing(earlier))
            earlier_count = earlier.count
        outputs = _open_outputs(stack, scene, arguments, facts, earlier_count)
        intervals, interrupt, problems = [], None, []
        works, writing = [], 0.0

        def write(result: IntervalResult) -> None:
            nonlocal writing
            started = time.perf_counter()
            scene.files.check()
            for output in outputs:
                with naming(output.file.name):
                    output.add(result)
            intervals.append(result.summary)
            works.append(result.work)
            writing += time.perf_counter() - started

        written = stack.enter_context(contextlib.closing(WriteBehind(write)))
        with INTERRUPTS.held():
            try:
                with INTERRUPTS.raised(), contextlib.closing(_track(scene, arguments, earlier)) as found:
                    for result in found:
                        written.put(result)
                        INTERRUPTS.check()
                    written.wait()
            except KeyboardInterrupt as stopped:
                interrupt = stopped if isinstance(stopped, Interrupted) else Interrupted()
            except Exception as error:
                interrupt = INTERRUPTS.came  # a library may have turned it into another error
                problems += [] if interrupt else [_explain(error, scene)]
            try:
                written.wait()
            except Exception as error:
                problem = _explain(error, scene)  # readers and writers all find a change of the scene's files
                problems += [] if interrupt or problem in problems else [problem]
            stopped = f"stopped by an error: {problems[0]}" if problems else str(interrupt or "")
            summary = Summary(scene, intervals=intervals, stopped=stopped, **settings)
            finished = outputs if intervals else []  # an earlier file is better than an empty one
            if len(intervals) < earlier_count:  # or than a shorter one, as a later run can resume it
                finished = [output for output in finished if not isinstance(output, HitsJson)]
            # Signals do not interrupt the files. They do interrupt streams, whose reader may not read to the end.
            problems += _finish([output for output in finished if not output.file.is_stream], summary)
            try:
                with INTERRUPTS.raised():
                    problems += _finish([output for output in finished if output.file.is_stream], summary)
            except BrokenPipeError:
                if not problems:
                    raise
            if problems:
                raise ValueError("; ".join([str(interrupt)] * bool(interrupt) + problems))
            if not interrupt:
                INTERRUPTS.check()
        if STDOUT not in (arguments.json, arguments.csv, arguments.report):
            with naming("standard output"):
                console = Console()
                print_replay(console, summary)
                print_work(console, works, writing)
                if baseline:
                    print_new(console, baseline.new_in(summary))
                for output in finished:
                    say(console, f"Wrote {output.file.path}.")
                    if isinstance(output, Overlay):
                        say(console, f"  {SHOWN_BY}")
    if interrupt:
        raise interrupt
    if summary.validation and summary.validation.disagreements:
        return ExitStatus.DISAGREES
    fails = {
        "intersections": any(sample.crossings or sample.inside for sample in summary.intersections),
        "collisions": summary.hits > 0,
        "distance": bool(summary.nearest),
        "new": baseline is not None and bool(baseline.new_in(summary)),
    }
    if any(fails[reason] for reason in arguments.fail_on):
        return ExitStatus.FOUND
    return ExitStatus.LEFT_OUT if scene.left_out else ExitStatus.DONE


def _explain(error: Exception, scene: Scene) -> str:
    """Returns why a replay stopped: a change of the scene's files, which may cause any error, or else the error."""
    try:
        scene.files.check()
    except ValueError as changed:
        return str(changed)
    if isinstance(error, OSError | ValueError):
        return describe(error)
    return f"{scene.path}: {describe(error)}"


def _finish(outputs: list[ReplayOutput], summary: Summary) -> list[str]:
    """Finishes files, without their last intervals if the disk is full; returns messages on missing parts.

    On a full disk all files shrink down to half of their intervals. After that only the file that does not fit
    shrinks, or is omitted; the page comes first, as it matters least.
    """
    problems, shortages = [], {}
    shared = 5  # number of eighths that all files lose, which leave about a half
    waiting = outputs[::-1]  # the tables, which are the largest, come last
    while waiting:
        output = waiting[0]
        try:
            output.finish(summary)
        except Exception as error:
            if isinstance(error, BrokenPipeError) and str(output.file.path) == STDOUT:
                raise  # its reader has closed it, which is not an error
            number = error.errno if isinstance(error, OSError) else None
            sharing, smaller = [output], []
            if number in (errno.ENOSPC, errno.EDQUOT) and shared:
                sharing, shared = waiting, shared - 1
            if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                smaller = [other for other in sharing if other.shrink()]
            if smaller:
                shortages |= {other.file.name: describe(error) for other in smaller}
                continue
            shortages.pop(output.file.name, None)
            problems.append(f"{output.file.name}: not written: {describe(error)}")
        waiting.pop(0)
    return problems + [f"{name}: not all of it is written: {shortage}" for name, shortage in shortages.items()]


def _open_outputs(
    stack: contextlib.ExitStack,
    scene: Scene,
    arguments: argparse.Namespace,
    facts: dict[str, Any],
    earlier_count: int,
) -> list[ReplayOutput]:
    """Opens the files that the options name; the stack discards those that are not finished."""
    makers = (
        (
            arguments.json,
            lambda path: HitsJson(path, facts=facts, has_strands=scene.has_strands, earlier_count=earlier_count),
        ),
        (arguments.csv, lambda path: HitsCsv(path, scene=scene)),
        (arguments.overlay, lambda path: Overlay(path, scene=scene)),
        (arguments.report, lambda path: ReportPage(path, scene=scene)),
    )
    outputs = []
    for path, make in makers:
        if path:
            outputs.append(make(path))
            stack.callback(outputs[-1].discard)
    return outputs


class _Progress:
    """Shows the progress of a run: a bar on a terminal, else a line on standard error every ten seconds."""

    def __init__(self, activity: str):
        self._activity = activity
        self._bar = Progress(
            TextColumn(activity),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._bar.disable = not self._bar.console.is_terminal
        self._task = self._bar.add_task("", total=None, note="")
        self._started = self._last_line = time.monotonic()

    def __enter__(self) -> "_Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, done: int, total: int, note: str = "") -> None:
        """Shows how much of the total is done, and a note."""
        now = time.monotonic()
        if done:
            note += f"{', ' * bool(note)}{done / max(now - self._started, 1e-9):.1f}/s"
        self._bar.update(self._task, completed=done, total=total, note=note)
        if self._bar.disable and done and now - self._last_line > _LOG_SECONDS:
            self._last_line = now
            left = (now - self._started) / done * (total - done)
            say(self._bar.console, f"{self._activity}: {done} of {total}, {note}, about {left:,.0f} s left")


def _track(
    scene: Scene, arguments: argparse.Namespace, earlier: EarlierReplay | None
) -> Generator[IntervalResult, None, None]:
    """Yields the intervals of an earlier replay, then the others as they are found; shows progress and time left."""
    with _Progress("Replaying") as progress:
        progress.show(0, len(scene))
        for result in replay(
            scene,
            method=arguments.method,
            device=arguments.device,
            intersections=arguments.intersections,
            ignore_initial=arguments.ignore_initial,
            clearance=arguments.clearance,
            validate=arguments.validate,
            earlier=earlier.results(scene) if earlier else (),
            workers=arguments.workers,
        ):
            yield result
            progress.show(result.summary.index + 1, len(scene), f"time {result.summary.end:g}")


def _describe_options(scene: Scene, arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the options that the results depend on, except method, device and clearance."""
    selection = asdict(scene.selection)
    del selection["ignored_names"], selection["ignored_inside"]  # found, not chosen
    names = "frames", "subdivide", "strict", "allow_missing", "intersections", "ignore_initial", "validate"
    options = {name: getattr(arguments, name) for name in names}
    return selection | options | {"frames": asdict(arguments.frames) if arguments.frames else None}


def _read_pairs(path: str) -> list[tuple[str, str]]:
    """Reads pairs of patterns from a file.

    Raises:
        OSError: If it cannot be read.
        ValueError: If a line has not two patterns.
    """
    pairs = []
    with naming(path), open(path, encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            try:
                patterns = shlex.split(line, comments=True)
            except ValueError as error:
                raise ValueError(f"{path}: line {number}: {error}") from None
            if len(patterns) not in (0, 2):
                raise ValueError(f"{path}: line {number}: must be two patterns, not {len(patterns)}")
            pairs += [(patterns[0], patterns[1])] if patterns else []
    return pairs


def _output(text: str) -> str:
    return STDOUT if text == "/dev/stdout" else text


def _frames(text: str) -> FrameRange:
    parts = text.split(":")
    if len(parts) > 3:
        raise argparse.ArgumentTypeError(f"must be START:END:STEP, not {text!r}")
    try:
        numbers = [float(part) if part else None for part in parts]
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be START:END:STEP, three numbers, not {text!r}") from None
    start, end, step = numbers + [None] * (3 - len(numbers))
    if any(number is not None and not math.isfinite(number) for number in numbers):
        raise argparse.ArgumentTypeError(f"must be finite numbers, not {text!r}")
    if step is not None and step <= 0:
        raise argparse.ArgumentTypeError(f"STEP must be more than 0, not {step:g}")
    if len(parts) < 2 or (start is not None and end is not None and end <= start):
        raise argparse.ArgumentTypeError(f"must be START:END:STEP with END after START, not {text!r}")
    return FrameRange(start, end, step)


def _validate(text: str) -> int | Literal["all"]:
    if text == "all":
        return "all"
    try:
        return positive(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"must be all or an integer of at least 1, not {text}") from error


def _workers(text: str) -> int | str:
    try:
        return checked_address(text) if "://" in text else positive(text)
    except (argparse.ArgumentTypeError, ValueError) as error:
        message = f"must be an integer of at least 1, or an address such as tcp://head:8786, not {text}"
        raise argparse.ArgumentTypeError(message) from error
