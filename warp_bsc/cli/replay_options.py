"""The options of ``warp-bsc replay``, their types and its help text."""

import argparse
import importlib
import os
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from .._atomic_file import STDOUT
from ..scene_replay.workers import checked_address
from ..usd.frames import FrameRange
from ..usd.read.openusd import check_openusd
from ..usd.read.triage import read_triage
from ..usd.scene import Scene
from ..usd.selection import PURPOSES, Selection
from .error_boundary import describe
from .exit_status import ExitStatus, explain_statuses
from .interrupts import INTERRUPTS
from .options import (
    Options,
    add_fail_on,
    add_options,
    detection_options,
    distance,
    file_option,
    flag,
    number,
    pair,
    patterns,
    positive,
    switch,
)
from .progress import RunProgress

DESCRIPTION = """\
Find the collisions of the meshes of a USD scene, with themselves and with each
other, between each two consecutive time samples; vertices move straight from
sample to sample. Meshes that never move are obstacles: contacts between
obstacles are excluded, and so are contacts of a mesh with itself if only its
transform moves it. Linear curves and points are included, with half their
widths as radii. Rotations are sampled at every whole time code as well.
At the time samples themselves, find the edges that pass through faces and the
meshes that are wholly inside closed ones, including obstacles and linear
curves, and meshes that are duplicates of each other; if nothing moves, at one
time. Find the tetrahedra that invert, or are inverted, at any time.
Parts that cannot be read are named and left out. Files are written atomically.
If Ctrl-C, SIGTERM, SIGHUP or an error stops the run, it leaves valid files of
the finished intervals, marked partial. If it is killed, --json leaves a file
from which --resume continues."""
"""The help text above the options."""

EPILOG = f"""\
examples:
  warp-bsc replay demo
  warp-bsc replay shot.usd --overlay hits.usda --report hits.html
  warp-bsc replay shot.usd --between '/World/Coat' '/World/Body*' --no-self
  warp-bsc replay shot.usd --frames 101:150 --subdivide 4 --validate 1000
  warp-bsc replay cloth.usd --device cpu --method conservative
  warp-bsc replay cloth.usd --json > collisions.json
  warp-bsc replay cloth.usd --clearance 0.002 --fail-on distance
  warp-bsc replay shot.usd --ignore-initial --ignore '/World/Hair*' /World/Head
  warp-bsc replay shot.usd --triage shot.triage.json --fail-on intersections
  warp-bsc replay shot.usd --baseline hits_v1.json --fail-on new || echo "worse"
  warp-bsc replay shot.usd --report hits.html --json hits.json --limit 1000
  warp-bsc replay shot.usd --workers 16 --json hits.json --resume
  warp-bsc replay shot.usd --workers tcp://head:8786 --report hits.html

  a recording of one of Newton's examples:
  python -m newton.examples cloth_twist --viewer usd --num-frames 60 \\
      --output-path twist.usd
  warp-bsc replay twist.usd

{explain_statuses(ExitStatus.FOUND, ExitStatus.DISAGREES, ExitStatus.LEFT_OUT, ExitStatus.EMPTY)}"""
"""The help text below the options."""


def add_replay_options(command: argparse.ArgumentParser) -> None:
    """Adds the options of the command."""
    text = "a .usd, .usda, .usdc or .usdz file; demo for a recorded cloth that comes with warp-bsc"
    command.add_argument("scene", metavar="SCENE", nargs="?", help=text)

    which = command.add_argument_group("selection")
    add_options(which, {**SCENE, **_SELECTION})
    out = command.add_argument_group("output")
    add_options(out, _OUTPUT)
    add_fail_on(
        out,
        {
            "intersections": "edges through faces, meshes inside others",
            "collisions": "",
            "distance": "proximities, with --clearance",
            "duplicates": "meshes that are there twice",
            "inversions": "tetrahedra whose volume is not positive",
            "new": "findings that --baseline does not contain",
        },
    )
    add_options(command.add_argument_group("running"), _RUNNING)
    add_options(command, detection_options("exact"))


def read_selection(arguments: argparse.Namespace, *, of_files: bool = False) -> Selection:
    """Returns the selection that the options of :data:`SCENE` make, of a scene or of mesh files.

    Raises:
        OSError: If the file of ``--triage`` cannot be read.
        ValueError: If it is not a triage file.
    """
    return Selection(
        prims=tuple(arguments.prims),
        exclude=tuple(arguments.exclude),
        self_collisions=arguments.self_collisions,
        between=tuple(arguments.between) if arguments.between else None,
        purposes=tuple(arguments.purpose or Selection.purposes),
        ignore=tuple(map(tuple, arguments.ignore)),
        triage=read_triage(arguments.triage, of_files=of_files) if arguments.triage else (),
    )


def read_scene(
    path: str, arguments: argparse.Namespace, *, written: Sequence[str] = (), as_json: bool = False, **options: Any
) -> Scene:
    """Opens a scene with the options of :data:`SCENE` that say how it is read, and shows the progress.

    The files of ``written`` are to be written; with ``as_json`` the progress is for programs.

    Raises:
        ImportError: If OpenUSD is missing or too old.
        OSError: If the file cannot be read.
        ValueError: If the options do not fit the scene, the file is broken, or one would be written twice, or over one
            that is read.
    """
    paths = [os.path.realpath(file) for file in [path, *written]]
    for file in paths:
        if paths.count(file) > 1:
            raise ValueError(f"{file}: named twice, as two files of a {arguments.command_line[1]}")
    with INTERRUPTS.held():  # an interrupt while USD's modules load is caught there, and breaks them
        check_openusd()
        importlib.import_module("warp_bsc.usd.read.find_meshes")
    INTERRUPTS.check()
    how = {"strict": arguments.strict, "allow_missing": arguments.allow_missing}
    try:
        with RunProgress("Comparing vertices", as_json=as_json) as progress:
            scene = Scene(path, **how, **options, progress=progress.show)
    except (OSError, ValueError):
        raise
    except Exception as error:
        raise ValueError(f"{path}: {describe(error)}") from error
    for file in written:
        if file in scene.files:
            raise ValueError(f"{file}: the scene is read from this file; write to another one")
    return scene


def describe_selection(scene: Scene, arguments: argparse.Namespace) -> dict[str, Any]:
    """Returns the options of :data:`SCENE` that results depend on, and the scene's selection, as JSON."""
    selection = asdict(scene.selection)
    del selection["ignored_names"], selection["ignored_inside"]  # found, not chosen
    frames = asdict(arguments.frames) if arguments.frames else None
    return selection | {"frames": frames, "strict": arguments.strict, "allow_missing": arguments.allow_missing}


def command_of(arguments: argparse.Namespace) -> str:
    """Returns the command that finds the same as given options: without those on output and processes, for a shell."""
    words = ["warp-bsc", "replay", arguments.scene]
    if not arguments.intersections:
        words.append("--no-intersections")
    words += [_option("ignore_initial")] * arguments.ignore_initial
    defaults = {"method": "exact", "subdivide": 1, "validate": 0, "clearance": None, "limit": None}
    for name, default in defaults.items():
        value = getattr(arguments, name)
        words += [_option(name), str(value)] if value != default else []
    return shlex.join(words + _selection_words(arguments))


def repair_command_of(scene: Scene, arguments: argparse.Namespace) -> str:
    """Returns the command that repairs what a replay with given options finds: with those that both commands have."""
    words = ["warp-bsc", "repair", arguments.scene, *_selection_words(arguments)]
    words += ["--device", arguments.device] if arguments.device else []
    return shlex.join([*words, "--output", f"{Path(scene.path).stem}_repaired.usdc"])


def _selection_words(arguments: argparse.Namespace) -> list[str]:
    """Returns the options of :data:`SCENE` as words of a command."""
    words = ["--no-self"] * (not arguments.self_collisions) + ["--strict"] * arguments.strict
    if frames := arguments.frames:
        numbers = [frames.start, frames.end] + [frames.step] * (frames.step is not None)
        words += ["--frames", ":".join("" if number is None else str(number) for number in numbers)]
    for name in ("between", "purpose", "prims", "exclude", "allow_missing"):
        values = getattr(arguments, name)
        words += [_option(name), *values] if values else []
    for meshes in arguments.ignore:
        words += ["--ignore", *meshes]
    return words + (["--triage", arguments.triage] if arguments.triage else [])


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _output(text: str) -> str:
    return STDOUT if text == "/dev/stdout" else text


def _frames(text: str) -> FrameRange:
    parts = text.split(":")
    if not 2 <= len(parts) <= 3:
        raise argparse.ArgumentTypeError(f"must be START:END:STEP, not {text!r}")
    try:
        return FrameRange(*(float(part) if part else None for part in parts))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be START:END:STEP, three numbers, not {text!r}: {error}") from None


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


SCENE: Options = {
    "--prims": patterns(
        "check only meshes at or below these prims or instances, named as in the report; * matches any text"
    ),
    "--exclude": patterns("do not check meshes at or below these prims"),
    "--self": {
        "dest": "self_collisions",
        **switch("check each mesh with itself (default: yes, unless only its transform moves it)"),
    },
    "--between": pair("check only pairs of a mesh of pattern A and one of pattern B"),
    "--ignore": {
        **pair("only count the collisions of a mesh of pattern A and one of pattern B; may be repeated"),
        "action": "append",
        "default": [],
    },
    "--triage": file_option(
        "ignore the meshes that a file says are meant to meet, each with a reason: only count them; the page of "
        "replay --report writes such files"
    ),
    "--purpose": {
        "nargs": "+",
        "action": "extend",
        "choices": PURPOSES,
        "metavar": "PURPOSE",
        "help": "purposes of the meshes to check: default, render, proxy, guide (default: default render)",
    },
    "--frames": number(
        _frames,
        "time codes to check, each of the three optional; without STEP, all samples from START to END; 5:5 "
        "checks time 5 alone, at rest",
        metavar="START:END:STEP",
    ),
    "--strict": flag("end with status 2 if a part of the scene cannot be read, instead of leaving it out"),
    "--allow-missing": patterns(
        "do not count these files, or the files and prims that these prims refer to, as left out if they are "
        "missing, only note them; * matches any text. Materials, textures and other files that cannot hold geometry "
        "may always be missing"
    ),
}
"""The options that select meshes, pairs of them and the time of a scene, and how it is read."""
_SELECTION: Options = {
    "--intersections": switch(
        "find the edges that pass through faces or touch them at the time samples themselves, and the meshes that "
        "are wholly inside others (default: yes)"
    ),
    "--clearance": number(
        distance,
        "find the proximities at the time samples themselves: vertices and faces, and edges, that are at most D "
        "apart, in the scene's unit, and neither share a vertex nor are joined by an edge. Distances between the "
        "samples are not checked, nor are those of curves and points; an edge that passes through a face is an "
        "intersection instead",
        metavar="D",
    ),
    "--ignore-initial": flag(
        "ignore all pairs of meshes that cross at the first time, and meshes that cross themselves then; for "
        "meshes that are inside others then, ignore only that they are inside"
    ),
    "--subdivide": number(
        positive,
        "divide the time from each sample to the next into N intervals, for motion that is neither linear nor a "
        "turn about one axis, such as that of skeletons (default: 1)",
        default=1,
    ),
    "--validate": number(
        _validate,
        "decide pairs of each interval again by the exact checker: all, or N hits and N other pairs",
        default=0,
        metavar="all|N",
    ),
}
_PRINTED = {"type": _output, "nargs": "?", "const": STDOUT}
_OUTPUT: Options = {
    "--overlay": file_option("a USD layer over the scene, .usda or .usdc, which shows the collisions as guides"),
    "--report": file_option(
        "a page with a timeline, every interval in 3D, and a table of all collisions, .html", type=_output
    ),
    "--json": file_option("every collision as JSON; without FILE, print only that", **_PRINTED),
    "--csv": file_option("every collision as CSV; without FILE, print only that", **_PRINTED),
    "--npz": file_option(
        "every collision as columns for NumPy, .npz, in a fifteenth of the space of JSON", type=_output
    ),
    "--limit": number(
        positive,
        "list in all these files at most N collisions of an interval, the earliest, and N edges through faces, "
        "parts inside others and proximities at a time, with one of each two meshes; all are counted, and files and "
        "tables say how many are not listed (default: all)",
    ),
    "--baseline": file_option(
        "compare with the JSON file of an earlier replay with the same options: print which meshes collide, "
        "cross, are inside others or, with --clearance, are near each other at times at which they were not then; "
        "the page of --report marks them"
    ),
}
_RUNNING: Options = {
    "--workers": number(
        _workers,
        "check intervals in N processes on this machine, which share its cores and the devices of --device or, "
        "unless it names one such as cuda:0, its GPUs (default: one for each device); or in the workers of the Dask "
        "cluster whose scheduler has this address, such as tcp://head:8786, which need the scene at the same path and "
        "pip install 'warp-bsc[cluster]', and use the one --device as they see it",
        metavar="N|ADDRESS",
    ),
    "--progress": {
        "choices": ("text", "json"),
        "default": "text",
        "help": "text: a bar on a terminal, else a line every ten seconds; json: an object of JSON in a line of "
        "standard error after each interval: activity, done, of, seconds, hits (default: text)",
    },
    "--resume": flag(
        "continue an earlier run with the same options and files that was stopped or killed: take its finished "
        "intervals from the file of --json, or that name with .part appended, and check the others; without these "
        "files, check all"
    ),
}
