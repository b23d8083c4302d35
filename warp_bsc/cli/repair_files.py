"""Repairs mesh files: writes them again with positions at which nothing crosses, reads them, and checks them."""

import argparse
import contextlib
import fnmatch
import itertools
import json
import os
from typing import Any

import numpy as np
import warp as wp

from .._atomic_file import OutputFile
from ..bench.tables import LONGEST, Column, count
from ..detection.mesh import CollisionMesh
from ..mesh_files.check import find_meeting
from ..mesh_files.mesh_file import MeshFile, MeshScene
from ..repairing.repair import repair
from .device import find_device, loading_kernels
from .exit_status import ExitStatus
from .tables import Console, print_table, say, say_list

_FILES = (
    Column("moved vertices", "moved"),
    Column("largest move", "largest_move", ".3g"),
    Column("written to", "output", kind="text"),
)


def repair_files(arguments: argparse.Namespace) -> int:
    """Runs the command for mesh files, and returns the exit status."""
    scene = MeshScene(arguments.scene)
    outputs = _outputs(scene, arguments)
    device = find_device(arguments.device)
    previous = MeshScene(arguments.previous) if arguments.previous else None
    if previous and not np.array_equal(previous.faces, scene.faces):
        raise ValueError("--previous: the files must have the faces of the scene")
    kept = np.array([output is None for output in outputs])
    mesh = _mesh_of(scene, kept, device)
    with contextlib.ExitStack() as stack:
        files = []
        for output in filter(None, outputs):
            files.append(OutputFile(output))  # fails before anything is repaired
            stack.callback(files[-1].discard)
        with loading_kernels(device):
            result = repair(
                mesh,
                scene.x,
                fixed=kept[scene.file_of],
                order=scene.file_of if arguments.order else None,
                x_previous=previous.x if previous else None,
                min_distance=arguments.min_distance,
                max_strain=arguments.max_strain,
            )
        contents = map(MeshFile.with_positions, scene.files, scene.of_files(np.asarray(result.x)))
        for file, data in zip(files, itertools.compress(contents, ~kept), strict=True):
            file.write(data)
        for file in files:
            file.commit()
    written = MeshScene([output or file.path for file, output in zip(scene.files, outputs, strict=True)])
    with np.errstate(over="ignore"):
        rounded = written.x.astype(np.float32)
    positions = [written.x, rounded] if np.isfinite(rounded).all() else [written.x]
    again = _mesh_of(written, kept, device)
    meeting = [len(find_meeting(again, x)[1].pairs) for x in positions]
    among_kept = CollisionMesh(scene.faces[kept[scene.file_of[scene.faces[:, 0]]]], len(scene.x), device=device)
    found, remaining = {"intersections": result.crossings_before}, {"intersections": meeting[0]}
    if arguments.min_distance:
        name = f"pairs nearer than {arguments.min_distance:g}"
        found[name], remaining[name] = result.near_before, result.near
    notes = [f"{file.path}: {note}" for file in scene.files for note in file.notes]
    if unseen := len(find_meeting(among_kept, scene.x)[1].pairs):
        notes.append(f"in and among obstacles, {unseen:,} edges meet faces; they do not count")
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
    return ExitStatus.FOUND if arguments.fail_on and any(remaining.values()) else ExitStatus.DONE


def in_words(elements: list[dict[str, Any]]) -> str:
    """Returns elements, as of :meth:`.MeshScene.element`, as a text."""
    numbers = [(next(iter(element)), element["of"], next(iter(element.values()))) for element in elements]
    place = " ".join(f"{coordinate:.4g}" for coordinate in elements[0]["at"])
    return ", ".join(f"{kind} {number} of {path}" for kind, path, number in numbers) + f", at {place}"


def _mesh_of(scene: MeshScene, kept: np.ndarray, device: wp.Device) -> CollisionMesh:
    """Returns the mesh of a scene, in which files that are kept do not meet each other or themselves."""
    is_kept = kept[scene.file_of].astype(int)
    return CollisionMesh(scene.faces, len(scene.x), group=1 + is_kept, mask=3 - 2 * is_kept, device=device)


def _outputs(scene: MeshScene, arguments: argparse.Namespace) -> list[str | None]:
    """Returns where each file is written to, None for those that are kept."""
    paths = [file.path for file in scene.files]
    moving = paths
    for pattern in arguments.keep:
        matching = {path for path in paths if path == pattern or fnmatch.fnmatchcase(path, pattern)}
        if not matching:
            raise ValueError(f"--keep: no file matches {pattern}")
        moving = [path for path in moving if path not in matching]
    if len(moving) != 1 and not os.path.isdir(arguments.output):
        raise ValueError(f"{arguments.output}: must be a folder, as not one file may move; --keep names obstacles")
    into = os.path.isdir(arguments.output)
    outputs = {
        path: os.path.join(arguments.output, os.path.basename(path)) if into else arguments.output for path in moving
    }
    read = [os.path.realpath(path) for path in (*paths, *arguments.previous)]
    for path, output in outputs.items():
        if [*read, *map(os.path.realpath, outputs.values())].count(os.path.realpath(output)) > 1:
            raise ValueError(f"{output}: named twice, or read; write to another file")
        if os.path.splitext(output)[1].lower() != os.path.splitext(path)[1].lower():
            raise ValueError(f"{output}: must end as {path} does, of which only coordinates are replaced")
    return [outputs.get(path) for path in paths]
