"""The command ``warp-bsc bench detector``: measures the detector on scenes."""

import argparse
import importlib.util

from rich.progress import track

from .._atomic_file import STDOUT
from ..bench.detector import benchmark_detector
from ..bench.provenance import with_record
from ..bench.scenes import default_scenes, is_scene_name, load_scene
from ..bench.timing import count_threads, limited_threads
from .bench_detector_tables import detector_benchmarks_to_dict, print_detector_benchmarks
from .bench_runs import add_json_file, open_json
from .device import find_device, load_detector, loading_kernels
from .exit_status import explain_statuses
from .options import (
    Commands,
    add_command,
    add_detection_options,
    add_repeat,
    add_threads,
    natural,
    positive,
)
from .tables import Console

__all__ = ["add_to"]

_DESCRIPTION = """\
Measure the detector, from positions on the device to results on the device and
on the host. A scene is one interval of a USD file; two mesh files joined by a
comma; or generated: cloth:TRIANGLES, a wrinkled sheet that
folds onto itself, or crash:TRIANGLES, a thin tube that is crushed. Default:
cloth_twist.usd if this is a checkout, cloth:5000 and cloth:50000."""

_EPILOG = f"""\
examples:
  warp-bsc bench detector
  warp-bsc bench detector cloth.usd --interval 3
  warp-bsc bench detector first.ply,second.ply crash:1100000 --device cuda:0
  warp-bsc bench detector cloth:50000 --device cpu --threads 1 --compare
  warp-bsc bench detector cloth:1000 --worlds 1024 --device cuda:0
  warp-bsc bench detector --json times.json

{explain_statuses()}"""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "detector", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    command.add_argument("scenes", metavar="SCENE", nargs="*", help="the scenes to measure")
    command.add_argument(
        "--interval", type=natural, default=0, metavar="N", help="interval of a USD file, counted from 0 (default: 0)"
    )
    command.add_argument(
        "--worlds",
        type=positive,
        default=1,
        metavar="N",
        help="worlds with the scene, which do not collide with each other (default: 1)",
    )
    add_repeat(command, default=5)
    add_threads(command)
    command.add_argument(
        "--compare",
        action="store_true",
        help="measure the IPC Toolkit's candidates and collision-free step size as well, on the CPU; needs ipctk",
    )
    add_detection_options(command, method="conservative")
    add_json_file(command)


def _run(arguments: argparse.Namespace) -> int:
    if arguments.compare and arguments.worlds > 1:
        raise ValueError("--compare and --worlds exclude each other: the IPC Toolkit has no worlds")
    if arguments.json and is_scene_name(arguments.json):
        raise ValueError(f"--json {arguments.json}: this is a scene; name scenes before the options")
    if arguments.compare and importlib.util.find_spec("ipctk") is None:
        raise ValueError("--compare needs the IPC Toolkit: pip install 'warp-bsc[bench]'")
    scenes = [load_scene(name, interval=arguments.interval) for name in arguments.scenes or default_scenes()]
    scenes = [scene.in_worlds(arguments.worlds) for scene in scenes]
    device = find_device(arguments.device)
    progress = Console(stderr=True)
    options = {"method": arguments.method, "device": device, "repeat": arguments.repeat}
    with open_json(arguments.json) as write, limited_threads(arguments.threads):
        with loading_kernels(device):
            for dtype in {scene.x0.dtype for scene in scenes}:
                load_detector(arguments.method, dtype, device)
        benchmarks = [
            benchmark_detector(scene, compare=arguments.compare, **options)
            for scene in track(
                scenes, description="Measuring", console=progress, transient=True, disable=not progress.is_terminal
            )
        ]
        settings = {**options, "threads": count_threads()}
        if arguments.json != STDOUT:
            print_detector_benchmarks(Console(), benchmarks, **settings)
        write(with_record(detector_benchmarks_to_dict(benchmarks, **settings), arguments.command_line, [device]))
    return 0
