"""The command ``warp-bsc replay``: its options, and how a replay goes from the scene to all that was asked for."""

import argparse
import contextlib
import errno
import importlib
import math
import os

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .._atomic_file import STDOUT, naming
from ..replay.hit_files import HitsCsv, HitsJson
from ..replay.html_report import ReportPage
from ..replay.intervals import replay
from ..replay.outputs import ReplayOutput
from ..replay.summary import Summary
from ..replay.usd_overlay import Overlay
from ..usd.scene import FrameRange, Scene
from ..usd.selection import PURPOSES, Selection
from .error_boundary import describe
from .interrupts import INTERRUPTS, Interrupted
from .replay_tables import print_replay
from .tables import Console, say

__all__ = ["add_replay_options", "open_scene", "run_replay"]

_COLLIDES = 1
_DISAGREES = 3
_LEFT_OUT = 4


def add_replay_options(command: argparse.ArgumentParser) -> None:
    """Add the options that only this command has."""
    command.add_argument("scene", metavar="SCENE", nargs="?", help="a .usd, .usda, .usdc or .usdz file")

    which = command.add_argument_group("what is checked")
    patterns = {"nargs": "+", "action": "extend", "default": [], "metavar": "PATTERN"}
    which.add_argument(
        "--prims",
        **patterns,
        help="only meshes at or below these prims or instances, as the report names them; * stands for anything",
    )
    which.add_argument("--exclude", **patterns, help="no meshes at or below these prims")
    which.add_argument(
        "--self",
        dest="self_collisions",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="whether a mesh is checked with itself (default: it is, if more than its transform moves it)",
    )
    which.add_argument(
        "--between", nargs=2, metavar=("A", "B"), help="only pairs of a mesh of pattern A and one of pattern B"
    )
    which.add_argument(
        "--purpose",
        nargs="+",
        action="extend",
        choices=PURPOSES,
        metavar="PURPOSE",
        help="purposes of the meshes: default, render, proxy, guide (default: default render)",
    )
    which.add_argument(
        "--frames",
        type=_frames,
        metavar="START:END:STEP",
        help="part of the time, as time codes; each may be left out, and without STEP all samples between are taken",
    )
    which.add_argument(
        "--subdivide",
        type=_at_least_one,
        default=1,
        metavar="N",
        help="check N steps from each time to the next, for motion that is not linear, as of what turns, for "
        "which every whole time code is taken anyway (default: 1)",
    )
    which.add_argument(
        "--strict", action="store_true", help="leave nothing out: what cannot be read is an error, with status 2"
    )
    which.add_argument(
        "--validate",
        type=_validate,
        default=0,
        metavar="all|N",
        help="ask the exact checker again: about all answers, or N hits and N other pairs of each interval",
    )

    out = command.add_argument_group("what comes out")
    out.add_argument("--overlay", metavar="FILE", help="a USD layer over the scene, .usda, that shows the collisions")
    file = {"type": _output, "metavar": "FILE"}
    out.add_argument("--report", **file, help="a page with charts and the worst interval in 3D, .html")
    printed = {"nargs": "?", "const": STDOUT, **file}
    out.add_argument("--json", **printed, help="every collision as JSON; only that, without FILE")
    out.add_argument("--csv", **printed, help="every collision as CSV; only that, without FILE")


def open_scene(arguments) -> Scene:
    """The scene that the options ask for.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the options do not fit together, or the file is broken.
    """
    # The file of these options may be left out: what follows is the scene then.
    for option in ("json", "csv"):
        if arguments.scene is None and getattr(arguments, option) not in (None, STDOUT):
            arguments.scene = getattr(arguments, option)
            setattr(arguments, option, STDOUT)
    if arguments.scene is None:
        raise ValueError("the following arguments are required: SCENE; see warp-bsc replay --help")
    outputs = [file for file in (arguments.overlay, arguments.report, arguments.json, arguments.csv) if file]
    if outputs.count(STDOUT) > 1:
        raise ValueError("--json, --csv and --report to standard output: only one of them can be printed")
    places = [os.path.realpath(file) for file in [arguments.scene, *outputs] if file != STDOUT]
    for place in places:
        if places.count(place) > 1:
            raise ValueError(f"{place}: named twice, as two files of a replay")
    selection = Selection(
        prims=tuple(arguments.prims),
        exclude=tuple(arguments.exclude),
        self_collisions=arguments.self_collisions,
        between=tuple(arguments.between) if arguments.between else None,
        purposes=tuple(arguments.purpose or Selection.purposes),
    )
    with INTERRUPTS.held():  # USD's modules catch what is raised while they are loaded, and are broken then
        importlib.import_module("warp_bsc.usd.meshes")
    INTERRUPTS.check()
    try:
        scene = Scene(
            arguments.scene,
            selection=selection,
            frames=arguments.frames,
            subdivide=arguments.subdivide,
            strict=arguments.strict,
        )
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"{arguments.scene}: {describe(error)}") from error
    for file in outputs:
        if file in scene.files:
            raise ValueError(f"{file}: the scene is read from this file, what is written must be another")
    return scene


def run_replay(scene: Scene, arguments, device) -> int:
    """Replay a scene and write all that was asked for.

    Args:
        scene: The scene.
        arguments: The options.
        device: The Warp device.

    Returns:
        The exit status.

    Raises:
        ValueError: If the scene turns out to be broken, or a file could not be written. What was finished is on the
            disk, as far as there is room.
    """
    settings = {"method": arguments.method, "device": str(device)}
    with contextlib.ExitStack() as stack:
        outputs = _open_outputs(stack, scene, arguments, settings)
        intervals, interrupt, problems = [], None, []
        with INTERRUPTS.held():
            try:
                with INTERRUPTS.raised(), contextlib.closing(_track(scene, arguments, device)) as found:
                    for result in found:
                        scene.files.check()
                        for output in outputs:
                            with naming(output.file.name):
                                output.add(result)
                        intervals.append(result.summary)
                        INTERRUPTS.check()
            except KeyboardInterrupt as stopped:
                interrupt = stopped if isinstance(stopped, Interrupted) else Interrupted()
            except Exception as error:
                interrupt = INTERRUPTS.came  # of which a library may have made another error
                problems += [] if interrupt else [_explain(error, scene)]
            stopped = f"stopped by an error: {problems[0]}" if problems else str(interrupt or "")
            outcome = Summary(scene, intervals=intervals, stopped=stopped, **settings)
            finished = outputs if intervals else []  # what was there before is better than nothing
            # Nothing disturbs the files. Whoever reads the other ones may never come to the end.
            problems += _finish([output for output in finished if not output.file.is_stream], outcome)
            try:
                with INTERRUPTS.raised():
                    problems += _finish([output for output in finished if output.file.is_stream], outcome)
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
                print_replay(console, outcome)
                for output in finished:
                    say(console, f"Wrote {output.file.path}.")
    if interrupt:
        raise interrupt
    if outcome.validation and outcome.validation["disagreements"]:
        return _DISAGREES
    if arguments.fail_on_collision and outcome.hits:
        return _COLLIDES
    return _LEFT_OUT if scene.left_out else 0


def _explain(error, scene) -> str:
    """What stopped a replay: that the scene is another now, if it is, which may show in any way."""
    try:
        scene.files.check()
    except ValueError as changed:
        return str(changed)
    if isinstance(error, OSError | ValueError):
        return describe(error)
    return f"{scene.path}: {describe(error)}"


def _finish(outputs: list[ReplayOutput], outcome: Summary) -> list[str]:
    """Put files in their places, without the last intervals where there is no room for all, and say what is missing.

    On a full disk all of them shrink for one another's sake, but not below half: tables are worth more than a page.
    """
    problems, shortages = [], {}
    shared = 5  # times an eighth is a half
    waiting = outputs[::-1]  # the tables, which are the largest, come last
    while waiting:
        output = waiting[0]
        try:
            output.finish(outcome)
        except Exception as error:
            if isinstance(error, BrokenPipeError) and str(output.file.path) == STDOUT:
                raise  # nobody reads it any more, which is no error
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


def _open_outputs(stack, scene, arguments, settings) -> list[ReplayOutput]:
    """The files to write."""
    makers = (
        (arguments.json, lambda path: HitsJson(path, scene=scene, **settings)),
        (arguments.csv, HitsCsv),
        (arguments.overlay, lambda path: Overlay(path, scene=scene)),
        (arguments.report, ReportPage),
    )
    outputs = []
    for path, make in makers:
        if path:
            outputs.append(make(path))
            stack.callback(outputs[-1].discard)
    return outputs


def _track(scene, arguments, device):
    """The intervals as they are found, with progress, rate and time left on a terminal."""
    progress = Progress(
        TextColumn("Replaying"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("time {task.fields[time]:g}, {task.fields[rate]}"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    progress.disable = not progress.console.is_terminal
    with progress:
        task = progress.add_task("", total=len(scene.times) - 1, time=scene.times[0], rate="…/s")
        for result in replay(scene, method=arguments.method, device=device, validate_most=arguments.validate):
            yield result
            speed = progress.tasks[task].speed
            rate = f"{speed:.1f}/s" if speed else "…/s"
            progress.update(task, advance=1, time=result.summary.end, rate=rate)


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


def _at_least_one(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number


def _validate(text: str) -> int | None:
    return None if text == "all" else _at_least_one(text)
