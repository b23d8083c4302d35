"""The command ``warp-bsc repair``: writes a layer over a USD scene in which its meshes do not collide."""

import argparse
import contextlib
import errno
import importlib
import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

from .._atomic_file import STDOUT, naming
from ..repair.shot import RepairedStretch, find_collisions, kept_meshes, repair_shot
from ..replay.intervals import replay
from ..replay.results import IntervalResult
from ..usd.frames import FrameRange
from ..usd.points_layer import PointsLayer
from ..usd.scene import Scene
from ..usd.selection import Selection
from .device import find_device, load_detector, loading_kernels
from .error_boundary import describe
from .exit_status import ExitStatus, explain_statuses
from .interrupts import INTERRUPTS, Interrupted
from .option_names import with_option
from .options import Commands, add_command, add_device, add_fail_on, add_json, distance
from .progress import RunProgress
from .replay_options import add_scene_selection
from .tables import LONGEST, Console, count, make_table, say

__all__ = ["add_to"]

_DESCRIPTION = """\
Write a USD layer over a scene in which the points of its deforming meshes are
moved so that they neither intersect nor collide, as warp-bsc replay checks it.
Where the scene is free, it keeps every bit; a few frames before a collision the
points leave their places, and return to them after it.
Meshes that only transforms move, shapes, curves, points and instances keep
their places, and so do meshes of --keep: the others are kept apart from them.
Curves and points are not seen. --ignore and --between choose what is looked
for; where something is found, all pairs are kept apart.
Skeletons and blend shapes no longer deform a mesh that is moved; it has points
of its own. The layer is then replayed, and what is left is named.
If Ctrl-C, SIGTERM, SIGHUP, an error or a full disk stops the run, the layer
ends at the last repaired frame, and is marked partial."""

_EPILOG = f"""\
examples:
  warp-bsc repair shot.usd --output fixed.usdc
  warp-bsc repair shot.usd --output fixed.usdc --keep '/World/Body*'
  warp-bsc repair shot.usd --output fixed.usdc --frames 101:150 --max-move 0.02
  warp-bsc repair shot.usd --output fixed.usdc --fail-on left --json > done.json

{explain_statuses(ExitStatus.FOUND, ExitStatus.LEFT_OUT)}"""


def add_to(commands: Commands) -> None:
    """Adds the command with its options."""
    command = add_command(
        commands,
        "repair",
        _run,
        summary="move the meshes of a USD scene so that they do not collide",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    command.add_argument("scene", metavar="SCENE", help="a .usd, .usda, .usdc or .usdz file")
    which = command.add_argument_group("selection")
    which.add_argument(
        "--keep",
        nargs="+",
        action="extend",
        default=[],
        metavar="PATTERN",
        help="obstacles: do not move meshes at or below these prims; * matches any text",
    )
    add_scene_selection(which)
    how = command.add_argument_group("repair")
    how.add_argument(
        "--max-move",
        type=distance,
        metavar="D",
        help="leave stretches of the scene as they are in which a point must move more than D, in the scene's unit",
    )
    how.add_argument(
        "--separation",
        type=distance,
        metavar="D",
        help="move what collides to this distance, in the scene's unit (default: 0.005 of the median edge length)",
    )
    out = command.add_argument_group("output")
    out.add_argument("--output", required=True, metavar="FILE", help="the layer, .usda, .usdc or .usd")
    add_json(command)
    add_fail_on(out, {"left": "collisions or intersections that are left"})
    add_device(command)


def _run(arguments: argparse.Namespace) -> int:
    if arguments.output == STDOUT:
        raise ValueError("--output must be a file, not standard output")
    if os.path.realpath(arguments.output) == os.path.realpath(arguments.scene):
        raise ValueError(f"{arguments.output}: the scene is read from this file; write to another one")
    device = find_device(arguments.device)
    with INTERRUPTS.held():  # an interrupt while USD's modules load is caught there, and breaks them
        importlib.import_module("warp_bsc.usd.find_meshes")
    INTERRUPTS.check()
    selection = Selection(
        prims=tuple(arguments.prims),
        exclude=tuple(arguments.exclude),
        self_collisions=arguments.self_collisions,
        between=tuple(arguments.between) if arguments.between else None,
        purposes=tuple(arguments.purpose or Selection.purposes),
        ignore=tuple(map(tuple, arguments.ignore)),
    )
    scene = _open(arguments.scene, arguments, selection, arguments.frames)
    if arguments.output in scene.files:
        raise ValueError(f"{arguments.output}: the scene is read from this file; write to another one")
    kept = kept_meshes(scene, arguments.keep)
    with loading_kernels(device):
        load_detector("exact", scene.dtype, device, intersections=True, strands=scene.has_strands)
    with contextlib.closing(_Repair(scene, arguments, str(device))) as run:
        run.run()
    if run.interrupt:
        raise run.interrupt
    if run.problems:
        raise ValueError("; ".join(run.problems))
    left = run.found
    if run.is_written:
        left = _check(_open(arguments.output, arguments, selection, arguments.frames), str(device))
    if arguments.json:
        print(json.dumps(run.facts(kept, left), indent=1))
    else:
        _print(Console(), run, kept, left)
    if "left" in arguments.fail_on and any(left.values()):
        return ExitStatus.FOUND
    return ExitStatus.LEFT_OUT if scene.left_out else ExitStatus.DONE


class _Repair:
    """A run: finds collisions, repairs, and writes the layer of the stretches that are done.

    Attributes:
        found: Numbers of collisions and intersections before.
        stretches: The stretches, without their frames.
        seconds: Times to find and to repair [s].
        interrupt: The signal that ended it.
        problems: Messages of errors.
        output: Path of the layer.
        is_written: Whether there is a layer: there is none if nothing is moved.
    """

    def __init__(self, scene: Scene, arguments: argparse.Namespace, device: str):
        self.scene, self._arguments, self._device = scene, arguments, device
        self._layer = PointsLayer(arguments.output, scene=scene)
        self.found = {"collisions": 0, "intersections": 0}
        self.stretches: list[RepairedStretch] = []
        self.seconds = {"finding": 0.0, "repairing": 0.0}
        self.interrupt: KeyboardInterrupt | None = None
        self.problems: list[str] = []
        self.output, self.is_written = arguments.output, False

    def run(self) -> None:
        """Repairs the scene as far as no signal or error stops it, and writes the layer."""
        done = 0
        with INTERRUPTS.held():
            try:
                with INTERRUPTS.raised():
                    for number in self._repair():
                        done = number
                        INTERRUPTS.check()
                    done = len(self.scene)
            except KeyboardInterrupt as stopped:
                self.interrupt = stopped if isinstance(stopped, Interrupted) else Interrupted()
            except Exception as error:
                self.interrupt = INTERRUPTS.came  # a library may have turned it into another error
                self.problems += [] if self.interrupt else [describe(error)]
            if not any(stretch.moved for stretch in self.stretches):
                return  # an earlier file is better than an empty one
            if done < len(self.scene):
                self._layer.end = self.scene.times[done]
            self._finish()

    def close(self) -> None:
        """Removes the temporary file."""
        self._layer.discard()

    def _repair(self) -> Iterator[int]:
        """Finds and repairs; yields the number of intervals that are done after each stretch."""
        scene, arguments = self.scene, self._arguments
        started = time.perf_counter()
        findings = []
        for finding in find_collisions(_tracked(scene, self._device, "Finding")):
            findings.append(finding)
            self.found["collisions"] += finding.hits
            self.found["intersections"] += finding.crossings[0]
        self.found["intersections"] += findings[-1].crossings[1]
        self.seconds["finding"] = time.perf_counter() - started
        started = time.perf_counter()
        with RunProgress("Repairing") as progress:
            progress.show(0, len(scene))
            for stretch in repair_shot(
                scene,
                findings,
                keep=arguments.keep,
                max_move=arguments.max_move,
                separation=arguments.separation,
                device=self._device,
                progress=lambda number: progress.show(number, len(scene)),
            ):
                scene.files.check()
                for frame in stretch.frames:
                    self._layer.add(frame)
                self.stretches.append(stretch)
                self.seconds["repairing"] = time.perf_counter() - started
                yield scene.times.index(stretch.end)

    def _finish(self) -> None:
        """Writes the layer, without its last frames if the disk is full."""
        shortage = ""
        while True:
            facts = self.found | {"stretches": len(self.stretches)}
            stopped = shortage or str(self.interrupt or "") or "; ".join(self.problems)
            try:
                with naming(self._arguments.output):
                    self._layer.finish(facts | ({"stopped": stopped} if stopped else {}))
            except Exception as error:
                number = error.errno if isinstance(error, OSError) else None
                is_full = number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
                if is_full and self._layer.shrink():
                    shortage = describe(error)
                    continue
                self.problems.append(f"{self._arguments.output}: not written: {describe(error)}")
                return
            self.is_written = True
            if shortage:
                self.problems.append(f"not all of it is written: {shortage}")
            return

    def facts(self, kept: dict[str, str], left: dict[str, int]) -> dict[str, Any]:
        """Returns what was done, for programs."""
        stretches = []
        for stretch in self.stretches:
            frames = [{"time": frame.time, "moved": len(frame.vertices)} for frame in stretch.frames]
            values = asdict(replace(stretch, frames=()))
            stretches.append(values | {"frames": frames})
        return {
            "scene": self.scene.path,
            "output": str(self._arguments.output) if self.is_written else None,
            "before": self.found,
            "left": left,
            "kept": kept,
            "stretches": stretches,
            "seconds": self.seconds,
        }


def _open(path: str, arguments: argparse.Namespace, selection: Selection, frames: FrameRange | None) -> Scene:
    """Opens a scene with the options that say how it is read."""
    try:
        with RunProgress("Comparing vertices") as progress:
            return Scene(
                path,
                selection=selection,
                frames=frames,
                strict=arguments.strict,
                allow_missing=arguments.allow_missing,
                progress=progress.show,
            )
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"{path}: {describe(error)}") from error


def _tracked(scene: Scene, device: str, activity: str) -> Iterator[IntervalResult]:
    """Yields what an exact replay finds, and shows its progress."""
    with RunProgress(activity) as progress:
        progress.show(0, len(scene))
        for result in replay(scene, method="exact", device=device):
            yield result
            progress.show(result.summary.index + 1, len(scene), f"time {result.summary.end:g}")


def _check(scene: Scene, device: str) -> dict[str, int]:
    """Returns the numbers of collisions and intersections of a layer."""
    findings = list(find_collisions(_tracked(scene, device, "Checking")))
    crossings = sum(finding.crossings[0] for finding in findings) + findings[-1].crossings[1]
    return {"collisions": sum(finding.hits for finding in findings), "intersections": crossings}


def _print(console: Console, run: _Repair, kept: dict[str, str], left: dict[str, int]) -> None:
    """Prints what was done, and what is left."""
    scene = run.scene
    say(
        console,
        f"{scene.path}: {count(len(scene.names), 'mesh', 'meshes')}, {scene.vertex_count:,} vertices, "
        f"{count(len(scene), 'interval')}",
    )
    for warning in scene.warnings:
        say(console, f"note: {with_option(warning)}")
    for name, reason in list(kept.items())[:LONGEST]:
        say(console, f"note: {name} is not moved: {reason}")
    if len(kept) > LONGEST:
        say(console, f"note: {len(kept) - LONGEST} more are not moved")
    if run.stretches:
        _print_stretches(console, run.stretches)
    for stretch in run.stretches[:LONGEST]:
        for reason in stretch.left:
            say(console, f"Left from {stretch.start:g} to {stretch.end:g}: {reason}.")
        if stretch.uncertified:
            times = ", ".join(f"{time:g}" for time in stretch.uncertified[:4])
            say(console, f"Not certified: {count(len(stretch.uncertified), 'frame')}, the first at {times}.")
    for what, number in run.found.items():
        say(console, f"{what.capitalize()}: {number:,} before, {left[what]:,} left.")
    seconds = run.seconds
    say(
        console,
        f"Finding took {1e3 * seconds['finding'] / len(scene):,.1f} ms an interval, repairing "
        f"{1e3 * seconds['repairing'] / len(scene):,.1f} ms.",
    )
    if run.is_written:
        say(console, f"Wrote {run.output}.")
    else:
        say(console, "Nothing was moved: no file was written.")


def _print_stretches(console: Console, stretches: list[RepairedStretch]) -> None:
    """Prints a table of the stretches."""
    table = make_table(
        "time",
        "frames",
        "points",
        "largest move",
        "mean",
        "edges",
        "acceleration",
        caption="Points: the most of a frame. Moves and the added acceleration a frame in median edge lengths, in "
        "parentheses that of the scene; edges: the shortest and the longest against the scene at the same time.",
    )
    for stretch in stretches[:LONGEST]:
        unit = stretch.edge_length
        low, high = stretch.edge_ratio
        added, own = stretch.acceleration
        table.add_row(
            f"{stretch.start:g} → {stretch.end:g}",
            f"{len(stretch.frames):,}",
            f"{stretch.moved:,}",
            f"{stretch.largest_move / unit:.3f}",
            f"{stretch.mean_move / unit:.3f}",
            f"{low:.2f} to {high:.2f}",
            f"{added / unit:.3f} ({own / unit:.3f})",
        )
    console.print(table)
    if len(stretches) > LONGEST:
        say(console, f"{len(stretches) - LONGEST} stretches are not listed; --json has all.")
