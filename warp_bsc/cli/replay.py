"""The command ``warp-bsc replay``: its options, and how a replay goes from the scene to all that was asked for."""

import argparse
import contextlib
import math
import os
import shutil
import sys
import tempfile
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ..replay.hit_files import HitsCsv, HitsJson
from ..replay.html_report import ReportPage
from ..replay.intervals import replay
from ..replay.summary import Outcome
from ..replay.usd_overlay import Overlay
from ..usd.scene import FrameRange, Scene
from ..usd.selection import PURPOSES, Selection
from .replay_tables import print_replay
from .tables import Console, say

__all__ = ["add_replay_options", "open_scene", "run_replay"]

_STDOUT = "-"
_INTERRUPTED = 130
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
    out.add_argument("--report", metavar="FILE", help="a page with charts and the worst interval in 3D, .html")
    out.add_argument(
        "--json", nargs="?", const=_STDOUT, metavar="FILE", help="every collision as JSON; only that, without FILE"
    )
    out.add_argument(
        "--csv", nargs="?", const=_STDOUT, metavar="FILE", help="every collision as CSV; only that, without FILE"
    )


def open_scene(arguments) -> Scene:
    """The scene that the options ask for.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the options do not fit together, or the file is broken.
    """
    # The file of these options may be left out: what follows is the scene then.
    for option in ("json", "csv"):
        if arguments.scene is None and getattr(arguments, option) not in (None, _STDOUT):
            arguments.scene = getattr(arguments, option)
            setattr(arguments, option, _STDOUT)
    if arguments.scene is None:
        raise ValueError("the following arguments are required: SCENE; see warp-bsc replay --help")
    if arguments.json == arguments.csv == _STDOUT:
        raise ValueError("--json and --csv without FILE: only one of them can be printed")
    files = [arguments.scene, arguments.overlay, arguments.report, arguments.json, arguments.csv]
    places = [os.path.realpath(file) for file in files if file not in (None, _STDOUT)]
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
    return Scene(
        arguments.scene,
        selection=selection,
        frames=arguments.frames,
        subdivide=arguments.subdivide,
        strict=arguments.strict,
    )


def run_replay(scene: Scene, arguments, device) -> int:
    """Replay a scene and write all that was asked for.

    Args:
        scene: The scene.
        arguments: The options.
        device: The Warp device.

    Returns:
        The exit status.

    Raises:
        OSError: If a file cannot be written. What was finished is on the disk.
        ValueError: If the scene turns out to be broken. What was finished is on the disk.
    """
    settings = {"method": arguments.method, "device": str(device)}
    with contextlib.ExitStack() as stack:
        outputs, printed = _open_outputs(stack, scene, arguments, settings)
        intervals, stopped, error = [], "", None
        try:
            with contextlib.closing(_track(scene, arguments, device)) as found:
                for interval, contacts in found:
                    intervals.append(interval)
                    for output in outputs:
                        output.add(interval, contacts)
        except KeyboardInterrupt:
            stopped = "interrupted"
        except (OSError, ValueError, MemoryError) as failure:
            stopped, error = f"stopped by an error: {' '.join(str(failure).split())}", failure
        outcome = Outcome(scene, intervals=intervals, stopped=stopped, **settings)
        for output in outputs:
            try:
                output.finish(outcome)
            except OSError as failure:
                error = error or OSError(f"{output.path}: not all of it is written: {failure}")
        if error:
            raise error
        if printed:
            with open(printed, encoding="utf-8") as file:
                shutil.copyfileobj(file, sys.stdout)
        else:
            console = Console()
            print_replay(console, outcome)
            for output in outputs:
                say(console, f"Wrote {output.path}.")
    if stopped:
        print("warp-bsc: interrupted", file=sys.stderr)
        return _INTERRUPTED
    if outcome.validation and outcome.validation["disagreements"]:
        return _DISAGREES
    if arguments.fail_on_collision and outcome.hits:
        return _COLLIDES
    return _LEFT_OUT if scene.left_out else 0


def _open_outputs(stack, scene, arguments, settings):
    """The files to write, and the path of the one to print, None if there is none."""
    printed = None
    paths = {"json": arguments.json, "csv": arguments.csv}
    for option, path in paths.items():
        if path == _STDOUT:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            paths[option] = printed = Path(folder) / option
    makers = (
        (paths["json"], lambda path: HitsJson(path, scene=scene, **settings)),
        (paths["csv"], HitsCsv),
        (arguments.overlay, lambda path: Overlay(path, scene=scene)),
        (arguments.report, ReportPage),
    )
    outputs = []
    for path, make in makers:
        if path:
            outputs.append(make(path))
            stack.callback(outputs[-1].discard)
    return outputs, printed


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
        for interval, contacts in replay(
            scene, method=arguments.method, device=device, validate_most=arguments.validate
        ):
            yield interval, contacts
            speed = progress.tasks[task].speed
            rate = f"{speed:.1f}/s" if speed else "…/s"
            progress.update(task, advance=1, time=interval.end, rate=rate)


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
