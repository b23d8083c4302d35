"""The command ``warp-bsc bench repair``: measures bsc.repair on known meshes, files and random damage."""

import argparse
from collections.abc import Generator

import warp as wp

from ..bench.mesh_files import is_mesh_name
from ..bench.repair import FILE, KNOWN_MESH, RepairRun, measure_repair
from ..bench.repair_scenes import KINDS, KNOWN, TangledMesh, damaged, load_tangled
from .bench_repair_tables import print_repair_runs, repair_runs_to_dict
from .bench_runs import RunsProgress, add_json_file, report_runs
from .device import find_device, loading_kernels
from .exit_status import explain_statuses
from .interrupts import INTERRUPTS
from .options import Commands, add_command, add_device, natural

__all__ = ["add_to"]

_DESCRIPTION = f"""\
Measure bsc.repair on known meshes that cross themselves, on mesh files, and on
meshes of {len(KINDS)} kinds that are pushed into themselves at random. The known ones:
  sheets  two sheets through each other in islands
  folded  a fold whose upper layer has sunk through the lower
  corner  one sheet through another from border to border
A row has the crossings before and after, found in exact arithmetic, moves in
median edge lengths, the largest strain of an edge, and the time of a second
call. What is not freed is repaired again with each hint that there is for it:
order= and x_previous=. Lines below say what came back with more crossings, what
moved where nothing crossed, and where the IPC Toolkit, if installed, disagrees.
Vertices of a file at the same position are one."""

_EPILOG = f"""\
examples:
  warp-bsc bench repair
  warp-bsc bench repair body.obj --random 0
  warp-bsc bench repair --random 60 --json repair.json
  warp-bsc bench repair --kinds folds --random 1 --seed 17

{explain_statuses()}
After a signal, the repairs that were complete are printed or written first."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(
        commands,
        "repair",
        _run,
        summary=summary,
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    command.add_argument(
        "meshes", metavar="MESH", nargs="*", help="mesh files to measure beside the known meshes and random damage"
    )
    command.add_argument(
        "--random",
        type=natural,
        default=10,
        metavar="N",
        help="meshes of each kind that are pushed into themselves (default: %(default)s)",
    )
    command.add_argument(
        "--kinds",
        type=_kinds,
        default=tuple(KINDS),
        metavar="NAME,...",
        help=f"kinds of meshes to push into themselves, of {', '.join(KINDS)} (default: all)",
    )
    command.add_argument(
        "--seed",
        type=natural,
        default=0,
        metavar="N",
        help="number of the first mesh of each kind, on which its damage depends (default: %(default)s)",
    )
    add_json_file(command)
    add_device(command)


def _kinds(text: str) -> tuple[str, ...]:
    """Returns the kinds that an argument lists, each once."""
    kinds = tuple(dict.fromkeys(text.split(",")))
    for kind in kinds:
        if kind not in KINDS:
            raise argparse.ArgumentTypeError(f"must be of {', '.join(KINDS)}, not {kind!r}")
    return kinds


def _run(arguments: argparse.Namespace) -> int:
    if arguments.json and is_mesh_name(arguments.json):
        raise ValueError(f"--json {arguments.json}: this is a mesh file; name meshes before the options")
    device = find_device(arguments.device)
    files = {path: load_tangled(path) for path in arguments.meshes}
    report_runs(
        _measure(files, arguments, device),
        to_dict=repair_runs_to_dict,
        show=print_repair_runs,
        json_path=arguments.json,
        command=arguments.command_line,
        device=device,
    )
    return 0


def _measure(
    files: dict[str, TangledMesh], arguments: argparse.Namespace, device: wp.Device
) -> Generator[RepairRun, None, None]:
    """Yields the repairs of each mesh, and shows the progress."""
    numbers = range(arguments.seed, arguments.seed + arguments.random)
    meshes = [(KNOWN_MESH, name, KNOWN[name]) for name in KNOWN]
    meshes += [(FILE, path, lambda path=path: files[path]) for path in files]
    meshes += [
        (kind, str(number), lambda kind=kind, number=number: damaged(kind, number))
        for kind in arguments.kinds
        for number in numbers
    ]
    with RunsProgress(len(meshes)) as progress, loading_kernels(device, progress.console):
        for done, (kind, name, make) in enumerate(meshes):
            progress.show(done, f"{kind} {name}")
            with INTERRUPTS.held():  # a library that is interrupted while it loads raises other errors, or none
                run = measure_repair(kind, name, make(), device=device)
            yield run
            INTERRUPTS.check()
