"""Repairs mesh files: writes them again with positions at which nothing crosses, reads them, and checks them."""

import argparse
import contextlib
import itertools
import json
from typing import Any

import numpy as np

from .._atomic_file import STDOUT, OutputFile, naming
from ..bench.tables import LONGEST, Column, count
from ..detection.at_rest.body_parts import connect_cells
from ..detection.mesh import CollisionMesh
from ..mesh_files.check import find_meeting
from ..mesh_files.file_scene import FileScene, FrameMesh
from ..mesh_files.frames import Frames, make_folder
from ..mesh_files.mesh_file import MeshFile, MeshScene, is_mesh_file
from ..repairing.repair import repair
from ..repairing.results import RepairResult
from ..repairing.shot.findings import kept_meshes
from ..repairing.shot.mesh_groups import bits_of
from ..repairing.shot.report import write_page
from ..repairing.shot.stretch import ShotFrame, StretchRecorder
from ..usd.selection import Selection
from ..usd.write.points_layer import MovedFrame
from .device import find_device, loading_kernels
from .exit_status import ExitStatus
from .progress import RunProgress
from .repair_run import find
from .tables import Console, print_table, say, say_list

_FILES = (
    Column("moved vertices", "moved"),
    Column("largest move", "largest_move", ".3g"),
    Column("written to", "output", kind="text"),
)


def check_page(path: str | None) -> None:
    """Raises a ValueError if a page would be written to standard output, or over a mesh."""
    if path == STDOUT or (path and is_mesh_file(path)):
        what = "standard output" if path == STDOUT else path
        raise ValueError(f"--report must be a file of its own, .html, not {what}")


def read_frames(frames: Frames, selection: Selection) -> FileScene:
    """Returns mesh files by frame as a scene, and shows how many have been read."""
    with RunProgress("Reading") as progress:
        return FileScene(frames, progress.show, selection=selection)


def repair_files(frames: Frames, arguments: argparse.Namespace, selection: Selection) -> int:
    """Runs the command for mesh files of one frame, and returns the exit status."""
    scene = MeshScene(frames.paths[0])
    (outputs,) = frames.outputs(arguments.keep, arguments.output, arguments.previous)
    device = find_device(arguments.device)
    previous = MeshScene(arguments.previous) if arguments.previous else None
    if previous and not np.array_equal(previous.faces, scene.faces):
        raise ValueError("--previous: the files must have the faces of the scene")
    kept = np.array([output is None for output in outputs])
    are_rigid = np.array(frames.matching(arguments.rigid, "--rigid"))
    named = [FrameMesh(name, {}, False) for name in frames.names]
    pairs = np.indices((len(named), len(named))).reshape(2, -1).T
    ignored = [(frames.names[a], frames.names[b]) for a, b in pairs[selection.ignored_pairs(named, pairs)].tolist()]
    bits = bits_of(frames.names, set(itertools.compress(frames.names, kept)), ignored)
    of_files = np.array([bits[name] for name in frames.names], dtype=np.uint32)

    def mesh_of(scene: MeshScene) -> CollisionMesh:
        group, mask = of_files[scene.file_of].T
        return CollisionMesh(scene.faces, len(scene.x), group=group, mask=mask, device=device)

    mesh = mesh_of(scene)
    pieces = connect_cells(mesh.edges, len(scene.x))
    make_folder(arguments.output)
    with contextlib.ExitStack() as stack:
        files, page = [], None
        if arguments.report:
            page = OutputFile(arguments.report)
            stack.callback(page.discard)
        for output in filter(None, outputs):
            files.append(OutputFile(output))  # fails before anything is repaired
            stack.callback(files[-1].discard)
        of_vertices = {"fixed": kept[scene.file_of], "rigid": np.where(are_rigid[scene.file_of], pieces, -1)}
        order, x_previous = scene.file_of if arguments.order else None, previous.x if previous else None
        limits = {name: getattr(arguments, name) for name in ("min_distance", "max_strain")}
        with loading_kernels(device):
            result = repair(mesh, scene.x, **of_vertices, order=order, x_previous=x_previous, **limits)
        xs = scene.of_files(np.asarray(result.x))
        contents = map(MeshFile.with_positions, scene.files, xs)
        for file, data in zip(files, itertools.compress(contents, ~kept), strict=True):
            file.write(data)
        for file in files:
            file.commit()
        paths = [output or file.path for file, output in zip(scene.files, outputs, strict=True)]
        if page:
            before, after = (read_frames(f, selection) for f in (frames, frames._replace(paths=[paths])))
            _write_page(page, before, after, xs, result, arguments)
    written = MeshScene(paths)
    with np.errstate(over="ignore"):
        rounded = written.x.astype(np.float32)
    positions = [written.x, rounded] if np.isfinite(rounded).all() else [written.x]
    meeting = [len(find_meeting(mesh_of(written), x)[1].pairs) for x in positions]
    among_kept = CollisionMesh(scene.faces[kept[scene.file_of[scene.faces[:, 0]]]], len(scene.x), device=device)
    found, remaining = {"intersections": result.crossings_before}, {"intersections": meeting[0]}
    if arguments.min_distance:
        name = f"pairs nearer than {arguments.min_distance:g}"
        found[name], remaining[name] = result.near_before, result.near
    notes = [f"{file.path}: {note}" for file in scene.files for note in file.notes]
    if unseen := len(find_meeting(among_kept, scene.x)[1].pairs):
        notes.append(f"in and among obstacles, {unseen:,} edges meet faces; they do not count")
    notes += selection.unmatched(named)
    if result.order is not None:
        sheets = [np.unique(scene.file_of[result.order == number]) for number in range(result.order.max() + 1)]
        names = ", ".join(scene.files[number].path for number in np.concatenate(sheets))
        notes.append(f"sheets that had changed places are in this order, from inside to outside: {names}")
    if meeting[-1] > meeting[0]:
        notes.append(f"rounded to single precision, as some programs read it, {meeting[-1]:,} edges meet faces")
    unresolved = []
    for contour in result.unresolved:
        elements = [[scene.element("edge", mesh.edges[e]), scene.element("face", f)] for e, f in contour.elements]
        reason = contour.reason.replace("order or x_previous", "--order or --previous")
        unresolved.append({"kind": contour.kind, "reason": reason, "elements": elements})
    rows = []
    for file, output, moved in zip(scene.files, outputs, scene.of_files(result.moved), strict=True):
        moves = {"moved": int((moved > 0.0).sum()), "largest_move": float(moved.max(initial=0.0))}
        rows.append({"file": file.path, "output": output} | moves)
    is_same = np.array_equal(written.x[written.faces], np.asarray(result.x)[scene.faces])  # none is rounded
    certified = result.certified and not meeting[0] and (is_same or not arguments.min_distance)
    if arguments.json:
        facts = {"device": str(device), "certified": certified, "before": found, "remaining": remaining}
        facts |= {"max_strain": result.max_strain, "unresolved": unresolved, "files": rows, "notes": notes}
        print(json.dumps(facts, indent=1))
    else:
        console = Console()
        for note in notes:
            say(console, f"note: {note}")
        print_table(console, "file", _FILES, [(row["file"], row) for row in rows])
        for what, number in found.items():
            say(console, f"{what.capitalize()}: {number:,} before, {remaining[what]:,} remain.")
        say(console, f"Lengths of edges change by at most {100.0 * result.max_strain:.3g}%.")
        for contour in unresolved[:LONGEST]:
            lines = [in_words(elements) for elements in contour["elements"]]
            say(console, f"Not repaired: {count(len(lines), 'edge')} through faces: {contour['reason']}.")
            say_list(console, lines, "")
        say(console, f"What was written has been read again: {'' if certified else 'not '}certified.")
        if page:
            say(console, f"Wrote {page.path}.")
    return ExitStatus.FOUND if arguments.fail_on and any(remaining.values()) else ExitStatus.DONE


def _write_page(
    page: OutputFile,
    before: FileScene,
    after: FileScene,
    xs: list[np.ndarray],
    result: RepairResult,
    arguments: argparse.Namespace,
) -> None:
    """Writes the page of a repair of one frame, given the files before and after, and the positions of each file."""
    device, kept = str(find_device(arguments.device)), kept_meshes(before, arguments.keep)
    segment, time = before.segment(0), before.times[0]
    given = segment.start_positions
    x, is_movable = given.copy(), np.zeros(len(given), bool)
    for number, mesh in enumerate(segment.meshes):
        x[segment.vertices_of(number)] = xs[number][mesh.points]
        is_movable[segment.vertices_of(number)] = mesh.name not in kept
    edges = CollisionMesh(segment.faces, len(given), device=device).edges
    length = float(np.median(np.linalg.norm(given[edges[:, 0]] - given[edges[:, 1]], axis=1)))
    recorder = StretchRecorder(is_movable, edges, length)
    (vertices,) = np.nonzero((x != given).any(axis=1))
    moved = MovedFrame(time, False, segment, vertices, x[vertices].astype(np.float64))
    recorder.add(ShotFrame(given, x, x - given, result.certified), moved)
    stretches = [recorder.finish([contour.reason for contour in result.unresolved])]
    with naming(page.name):
        found = [find(before, "Finding", arguments, device, ()), find(after, "Checking", arguments, device, ())]
        options = {"kept": kept, "min_distance": arguments.min_distance}
        write_page(page, before, stretches=lambda: stretches, before=found[0], after=found[1], **options)


def in_words(elements: list[dict[str, Any]]) -> str:
    """Returns elements, as of :meth:`.MeshScene.element`, as a text."""
    numbers = [(next(iter(element)), element["of"], next(iter(element.values()))) for element in elements]
    place = " ".join(f"{coordinate:.4g}" for coordinate in elements[0]["at"])
    return ", ".join(f"{kind} {number} of {path}" for kind, path, number in numbers) + f", at {place}"
