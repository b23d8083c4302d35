"""The command ``warp-bsc replay``: finds the collisions in a USD scene and writes them to tables and files."""

import argparse
import contextlib
import errno
import importlib
import os
import shlex
import time
from collections.abc import Generator
from typing import Any

from .._atomic_file import STDOUT, naming, unfinished_path
from ..replay.baseline import Baseline
from ..replay.earlier import EarlierReplay, find_earlier
from ..replay.hit_columns import HitsNpz
from ..replay.hit_files import HitsCsv, HitsJson, replay_facts
from ..replay.html_report import ReportPage
from ..replay.intervals import replay
from ..replay.limit import limit_rows, not_listed
from ..replay.outputs import ReplayOutput
from ..replay.results import IntervalResult
from ..replay.summary import Summary
from ..replay.threads import WriteBehind
from ..replay.usd_overlay import SHOWN_BY, Overlay
from ..replay.workers import device_of_cluster
from ..usd.scene import Scene
from ..usd.selection import Selection
from .device import find_device, load_detector, loading_kernels
from .error_boundary import describe
from .exit_status import ExitStatus
from .interrupts import INTERRUPTS, Interrupted
from .options import Commands, add_command, scene_path
from .progress import RunProgress
from .replay_options import (
    DESCRIPTION,
    EPILOG,
    add_replay_options,
    command_of,
    describe_selection,
    repair_command_of,
)
from .replay_tables import print_new, print_repair, print_replay, print_work
from .tables import Console, say

__all__ = ["add_to", "open_scene", "run_replay"]


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(
        commands,
        "replay",
        _run,
        summary=summary,
        description=DESCRIPTION,
        epilog=EPILOG,
    )
    add_replay_options(command)


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
    arguments.scene = scene_path(arguments.scene)
    is_saved = arguments.json not in (None, STDOUT)
    named = (arguments.overlay, arguments.report, arguments.json, arguments.csv, arguments.npz)
    outputs = [file for file in named if file]
    if "new" in arguments.fail_on and not arguments.baseline:
        raise ValueError("--fail-on new needs --baseline")
    if "distance" in arguments.fail_on and arguments.clearance is None:
        raise ValueError("--fail-on distance needs --clearance")
    at_rest = arguments.ignore_initial or arguments.fail_on & {"intersections", "duplicates"}
    if at_rest and not arguments.intersections:
        raise ValueError("--ignore-initial and --fail-on intersections and duplicates need --intersections")
    if arguments.resume and not is_saved:
        raise ValueError("--resume needs --json FILE")
    if arguments.limit and not outputs:
        raise ValueError("--limit needs a file: --json, --csv, --npz, --overlay or --report")
    if arguments.npz == STDOUT:
        raise ValueError("--npz: it is no text, name a file")
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
        with RunProgress("Comparing vertices", as_json=arguments.progress == "json") as progress:
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
        outputs = _open_outputs(stack, scene, arguments, facts, earlier_count, baseline)
        intervals, interrupt, problems = [], None, []
        works, writing = [], 0.0

        def write(result: IntervalResult) -> None:
            nonlocal writing
            started = time.perf_counter()
            scene.files.check()
            if arguments.limit:
                result = limit_rows(result, arguments.limit)
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
            summary = Summary(scene, intervals=intervals, stopped=stopped, limit=arguments.limit, **settings)
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
                print_repair(console, summary, repair_command_of(scene, arguments))
                if baseline:
                    print_new(console, baseline.new_in(summary))
                if finished and (missing := str(not_listed(summary, with_end=True) or "")):
                    say(console, f"--limit: {missing}")
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
        "duplicates": bool(summary.duplicate_spans),
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
    baseline: Baseline | None,
) -> list[ReplayOutput]:
    """Opens the files that the options name; the stack discards those that are not finished."""
    makers = (
        (
            arguments.json,
            lambda path: HitsJson(path, facts=facts, has_strands=scene.has_strands, earlier_count=earlier_count),
        ),
        (arguments.csv, lambda path: HitsCsv(path, scene=scene)),
        (arguments.npz, lambda path: HitsNpz(path, facts=facts, interval_count=len(scene))),
        (arguments.overlay, lambda path: Overlay(path, scene=scene, command=command_of(arguments))),
        (arguments.report, lambda path: ReportPage(path, scene=scene, baseline=baseline)),
    )
    outputs = []
    for path, make in makers:
        if path:
            outputs.append(make(path))
            stack.callback(outputs[-1].discard)
    return outputs


def _track(
    scene: Scene, arguments: argparse.Namespace, earlier: EarlierReplay | None
) -> Generator[IntervalResult, None, None]:
    """Yields the intervals of an earlier replay, then the others as they are found; shows progress and time left."""
    hits = 0
    with RunProgress("Replaying", as_json=arguments.progress == "json") as progress:
        progress.show(0, len(scene), hits=hits)
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
            hits += result.summary.hits
            progress.show(result.summary.index + 1, len(scene), f"time {result.summary.end:g}", hits=hits)


def _describe_options(scene: Scene, arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the options that the results depend on, except method, device and clearance."""
    names = "subdivide", "intersections", "ignore_initial", "validate", "limit"
    return describe_selection(scene, arguments) | {name: getattr(arguments, name) for name in names}


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
