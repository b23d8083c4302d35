"""The command ``warp-bsc replay``: finds the collisions in a USD scene and writes them to tables and files."""

import argparse
import contextlib

from .._atomic_file import STDOUT, unfinished_path
from ..scene_replay.baseline import Baseline
from ..scene_replay.workers import LocalWorkers, checked_workers, device_of_cluster
from ..usd.scene import Scene
from .device import find_devices, load_detector, loading_kernels
from .options import Commands, add_command, scene_path
from .replay_options import DESCRIPTION, EPILOG, add_replay_options, describe_selection, read_scene, read_selection
from .replay_run import ReplayRun


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "replay", _run, summary=summary, description=DESCRIPTION, epilog=EPILOG)
    add_replay_options(command)


def _run(arguments: argparse.Namespace) -> int:
    with contextlib.ExitStack() as stack:
        scene = _open_scene(arguments, stack)
        names = "subdivide", "intersections", "ignore_initial", "validate", "limit"  # what results depend on as well
        options = describe_selection(scene, arguments) | {name: getattr(arguments, name) for name in names}
        baseline = None
        if arguments.baseline:
            settings = {"method": arguments.method, "clearance": arguments.clearance, "options": options}
            baseline = Baseline(arguments.baseline, **settings)
        if isinstance(arguments.workers, str):
            name = device_of_cluster(arguments.workers, arguments.device)
        else:
            devices = find_devices(arguments.device)
            also = {"intersections": arguments.intersections, "proximities": arguments.clearance is not None}
            for device in {device.arch: device for device in devices}.values():  # for which kernels are compiled
                with loading_kernels(device):
                    load_detector(arguments.method, scene.dtype, device, **also, strands=scene.has_strands)
            name = ",".join(dict.fromkeys(map(str, devices)))
        return stack.enter_context(ReplayRun(scene, arguments, name, options, baseline)).run()


def _open_scene(arguments: argparse.Namespace, stack: contextlib.ExitStack) -> Scene:
    """Opens the scene that the options name; meanwhile the processes that check it start, which the stack ends."""
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
    workers = checked_workers(arguments.workers, arguments.device)
    if isinstance(workers, int) and workers > 1:
        arguments.workers = stack.enter_context(contextlib.closing(LocalWorkers(workers)))
        arguments.workers.start(arguments.device)
    written = [*outputs, str(unfinished_path(arguments.json))] if is_saved else outputs
    return read_scene(
        arguments.scene,
        arguments,
        selection=read_selection(arguments),
        frames=arguments.frames,
        subdivide=arguments.subdivide,
        as_json=arguments.progress == "json",
        written=[file for file in written if file != STDOUT],
    )
