"""The command ``warp-bsc repair``: writes a USD layer or mesh files in which meshes do not collide."""

import argparse
import contextlib
import json
from typing import Any

from .._atomic_file import STDOUT, OutputFile, unfinished_path
from ..mesh_files.file_scene import FileScene, FrameFiles
from ..mesh_files.frames import find_frames, make_folder
from ..mesh_files.mesh_file import is_mesh_file
from ..repairing.shot.findings import INVERTED, count_found, kept_meshes, matching_meshes
from ..scene_replay.hit_files import replay_facts
from ..usd.scene import Scene
from ..usd.write.points_layer import PointsLayer
from .device import find_device, find_devices, load_detector, loading_kernels
from .exit_status import ExitStatus, explain_statuses
from .options import (
    DEVICE,
    JSON,
    Commands,
    add_command,
    add_fail_on,
    add_options,
    distance,
    file_option,
    flag,
    number,
    patterns,
    positive_real,
    scene_path,
)
from .repair_files import check_page, read_frames, repair_files
from .repair_run import RepairRun, find
from .repair_tables import print_repair
from .replay_options import SCENE, describe_selection, read_scene, read_selection
from .tables import Console

_DESCRIPTION = """\
Write a USD layer over a scene in which the points of its deforming meshes are
moved so that they neither intersect nor collide, as warp-bsc replay checks it.
Where the scene is free, it keeps every bit; a few frames before a collision the
points leave their places, and return to them after it.
Meshes that only transforms move, shapes, curves, points and instances keep
their places, and so do meshes of --keep: the others are kept apart from them.
The inside of a TetMesh follows its surface; where tetrahedra would invert, it
stays, and is named. A scene without motion is repaired as one frame.
Two meshes that cross at the first frame, such as the parts of a body, are
mostly meant to: they are named, and stay as they are, at all frames.
Curves and points are not seen. --ignore and --between choose what is looked
for; where something is found, all pairs except ignored ones are kept apart.
Skeletons and blend shapes no longer deform a mesh that is moved; it has points
of its own. The layer is then replayed, and what remains is named.
If Ctrl-C, SIGTERM, SIGHUP, an error or a full disk stops the run, the layer
ends at the last repaired frame, and is marked partial. If it is killed too, a
file beside the layer remains from which --resume continues.
Mesh files (.glb, .obj, .off, .ply, .stl) are written again with coordinates at
which no edge meets a face, all else as it was, and what was written is read and
checked exactly. Several files are one scene. A name such as coat_####.ply, or
'coat_*.ply' in quotes, stands for the frames of a shot, repaired as one of USD."""

_EPILOG = f"""\
examples:
  warp-bsc repair shot.usd --output fixed.usdc
  warp-bsc repair shot.usd --output fixed.usdc --keep '/World/Body*'
  warp-bsc repair shot.usd --output fixed.usdc --report moves.html --resume
  warp-bsc repair shot.usd --output fixed.usdc --min-distance 0.002
  warp-bsc repair shot.usd --output fixed.usdc --frames 101:150 --max-move 0.02
  warp-bsc repair shot.usd --output fixed.usdc --fail-on remaining --json > done.json
  warp-bsc repair garment.obj --output free.obj
  warp-bsc repair body.obj garment.obj --keep body.obj --output free.obj
  warp-bsc repair body.obj 'coat_####.ply' --output 'free/coat_####.ply'

{explain_statuses(ExitStatus.FOUND, ExitStatus.LEFT_OUT, ExitStatus.EMPTY)}"""

_OF_ALL = {"command_line", "scene", "output", "report", "keep", "rigid", "triage", "min_distance", "json"}
_OF_ALL |= {"fail_on", "device"}
_OF_ONE_FRAME = {"max_strain", "order", "previous"}
_OF_FRAMES = {"max_move", "resume"}
"""The options for everything, for mesh files of one frame alone, and for several frames. Others are for USD alone."""
_CHANGING = "keep", "rigid", "include_initial", "max_move", "min_distance"
"""The options on which the result depends, beside the scene."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "repair", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    command.add_argument("scene", metavar="SCENE", nargs="+", help="a USD file, demo, or mesh files, # for digits")
    which = command.add_argument_group("selection")
    add_options(which, {"--keep": patterns("obstacles: prims, and all below, or files that stay; * matches any text")})
    add_options(which, SCENE)
    how = command.add_argument_group("repair")
    add_options(
        how,
        {
            "--include-initial": flag(
                "repair also pairs of two meshes that cross at the first frame; by default these stay as they are"
            ),
            "--rigid": patterns("hard parts: prims, and all below, or files whose connected pieces move as a whole"),
            "--max-move": number(
                distance,
                "leave stretches of the scene as they are in which a point must move more than D, in the scene's unit",
                metavar="D",
            ),
            "--min-distance": number(
                distance,
                "repair also what comes nearer than D, in the scene's unit, at the samples or between them, and keep "
                "that distance where the scene is repaired, certified between samples too. Elements that an edge joins "
                "only do not touch; pairs that are nearer at the first sample are named, and come no nearer where the "
                "scene is repaired",
                default=0.0,
                metavar="D",
            ),
        },
    )
    previous = "the files of a time before at which nothing crosses, such as the last frame, in the same order"
    files = command.add_argument_group("repair of mesh files of one frame")
    add_options(files, {"--max-strain": number(positive_real, "strain to keep to (default: %(default)s)", default=0.1)})
    add_options(files, {"--order": flag("the files are sheets, from inside to outside, whose faces point outside")})
    add_options(files, {"--previous": patterns(previous) | {"metavar": "FILE"}})
    command.set_defaults(default_of=command.get_default)
    out = command.add_argument_group("output")
    add_options(
        out,
        {
            "--output": file_option(
                "the USD layer, .usda, .usdc or .usd; or a mesh file, # for digits, or a folder", required=True
            ),
            "--report": file_option(
                "a page with a timeline and the moved frames in 3D, before and after, with the moves as colour, .html"
            ),
            "--resume": flag(
                "continue an earlier run with the same options and files that was stopped or killed: take what it "
                "found and repaired from FILE.part, beside the layer; without that file, repair all"
            ),
        },
    )
    add_options(command, JSON)
    reasons = {"remaining": "collisions or intersections that remain"}
    reasons["distorted"] = "frames in which edges are shorter than a third of the shot's or longer than twice"
    add_fail_on(out, reasons)
    add_options(command, DEVICE)


def _run(arguments: argparse.Namespace) -> int:
    frames = find_frames(arguments.scene) if any(map(is_mesh_file, arguments.scene)) else None
    kind, options = "USD scenes", vars(arguments).keys() - _OF_ONE_FRAME
    if frames:
        of_one = len(frames.numbers) == 1
        kind = "mesh files" if of_one else "frames of mesh files"
        options = _OF_ALL | (_OF_ONE_FRAME if of_one else _OF_FRAMES)
    for name, value in vars(arguments).items():
        if name not in options and value != arguments.default_of(name):
            raise ValueError(f"--{name.replace('_', '-')} is not for {kind}")
    check_page(arguments.report)
    if arguments.output == STDOUT:
        raise ValueError("--output must be a file, not standard output")
    selection = read_selection(arguments, of_files=bool(frames))
    if frames and kind == "mesh files":
        if "distorted" in arguments.fail_on:
            raise ValueError("--fail-on distorted is for shots; --max-strain bounds the strain of one frame")
        return repair_files(frames, arguments, selection)
    device = find_device(arguments.device) if frames else find_devices(arguments.device)[0]
    chosen = {"selection": selection, "frames": arguments.frames}
    if frames:
        outputs = frames.outputs(arguments.keep, arguments.output)
        scene = read_frames(frames, selection)
        arguments.include_initial = True  # all that crosses is repaired, as in files of one frame
    else:
        scene, outputs = _open_usd(arguments, chosen), []
    kept = kept_meshes(scene, arguments.keep)
    matching_meshes(scene, arguments.rigid, "rigid")  # fails before anything is written
    with loading_kernels(device):
        load_detector("exact", scene.dtype, device, intersections=True, strands=scene.has_strands)
    options = describe_selection(scene, arguments)
    options |= {name: getattr(arguments, name) for name in _CHANGING}
    facts = replay_facts(scene, method="exact", device=str(device), clearance=None, options=options)
    with contextlib.ExitStack() as stack:
        page = None
        if arguments.report:
            page = OutputFile(arguments.report)
            stack.callback(page.discard)
        if isinstance(scene, FileScene):
            make_folder(arguments.output)
            layer = FrameFiles(scene, outputs)
        else:
            layer = PointsLayer(arguments.output, scene=scene)
        run = stack.enter_context(contextlib.closing(RepairRun(scene, layer, arguments, str(device), facts)))
        run.run()
        after = run.journal.findings if run.is_whole else None
        if run.is_whole and (frames or run.has_moved):
            if isinstance(layer, FrameFiles):
                fixed = read_frames(layer.frames, selection)
            else:
                fixed = read_scene(arguments.output, arguments, **chosen)
            assert run.journal.findings
            after = find(fixed, "Checking", arguments, str(device), run.journal.findings[0].unrepaired_pairs)
        if page and run.journal.findings is not None:
            run.report(page, kept, after)
        if run.interrupt:
            raise run.interrupt
        if run.problems:
            raise ValueError("; ".join(run.problems))
    assert after is not None
    remaining = count_found(after, arguments.min_distance)
    if arguments.json:
        print(json.dumps(run.facts(kept, remaining), indent=1))
    else:
        print_repair(Console(), run, kept, remaining)
    repairable = [number for what, number in remaining.items() if what != INVERTED]
    found = {"remaining": any(repairable), "distorted": bool(run.distorted)}
    if any(found[reason] for reason in arguments.fail_on):
        return ExitStatus.FOUND
    return ExitStatus.LEFT_OUT if scene.left_out or any(stretch.held for stretch in run.stretches) else ExitStatus.DONE


def _open_usd(arguments: argparse.Namespace, chosen: dict[str, Any]) -> Scene:
    """Opens a USD scene, given the selection and the frames."""
    if len(arguments.scene) > 1:
        raise ValueError("only mesh files can be several")
    written = [file for file in (arguments.output, arguments.report) if file]
    written.append(str(unfinished_path(arguments.output)))
    arguments.scene = scene_path(arguments.scene[0])
    return read_scene(arguments.scene, arguments, written=written, **chosen)
