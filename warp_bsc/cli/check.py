"""The command ``warp-bsc check``: finds what crosses, touches or is not sound in mesh files."""

import argparse
import functools
import json
from collections import Counter
from typing import Any

import numpy as np
import warp as wp

from .._atomic_file import naming
from ..bench.tables import Column
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..mesh_files.check import check
from ..mesh_files.file_scene import FrameMesh
from ..mesh_files.frames import Frames, find_frames
from ..mesh_files.mesh_file import MeshScene
from ..repairing.surface import weld_borders, welded
from ..scene_replay.depths import DepthRecorder
from ..scene_replay.html_report import ReportPage
from ..scene_replay.summary import Summary
from ..usd.read.triage import read_triage
from ..usd.selection import Selection
from .device import find_device, loading_kernels
from .exit_status import ExitStatus, explain_statuses
from .options import DEVICE, JSON, Commands, add_command, add_fail_on, add_options, file_option, several
from .progress import RunProgress
from .repair_files import check_page, in_words, read_frames
from .repair_run import tracked
from .tables import Console, print_table, say

_DESCRIPTION = """\
Find what crosses, touches or lies inside in mesh files (.glb, .obj, .off, .ply,
.stl), exactly, and the faces and edges that are not sound. Several files are one
scene. A name such as coat_####.ply, or 'coat_*.ply' in quotes, stands for the
frames of a motion: find the collisions between each two, and what crosses in
each. Two files of the same faces are a motion, too.
Vertices of borders in one place are one, as at seams of textures. Elements are
named by their numbers in their files, which count from 0; --json has all."""

_EPILOG = f"""\
examples:
  warp-bsc check garment.obj
  warp-bsc check body.obj garment.ply --json > findings.json
  warp-bsc check part.stl --fail-on intersections,borders,degenerate
  warp-bsc check frame_11.ply frame_12.ply --fail-on collisions
  warp-bsc check body.obj 'coat_####.ply' --report coat.html

{explain_statuses(ExitStatus.FOUND)}"""

_KINDS = {
    "collisions": "collisions in the motion",
    "intersections": "edges through faces",
    "touching": "edges that only touch faces",
    "inside": "components inside closed ones",
    "degenerate": "faces without area",
    "duplicates": "doubled faces",
    "doubled": "doubled vertices",
    "nonmanifold": "edges of more than two faces",
    "orientation": "edges of two faces with different orientations",
    "borders": "edges of one face",
}

_OF_PAIRS = ("collisions", "intersections", "touching")
"""The kinds of pairs of elements, which may be meant."""

_OF_POSITIONS = ("collisions", "intersections", "touching", "inside", "degenerate")
"""The kinds that are told of each frame; the others, such as seams, only of the frame from which on they are there."""

_COLUMNS = (
    Column("number", len),
    Column("the first", lambda found: in_words(found[0]) if found else None, kind="text"),
)

Findings = list[list[dict[str, Any]]]
"""What is found of one kind: the elements of each finding, as of :meth:`.MeshScene.element`."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "check", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    files = several("FILE", "a mesh file; # stands for a digit of the number of a frame", nargs="+")
    page = file_option("a page with a timeline, every frame in 3D, and a table of what crosses or collides, .html")
    triage = file_option("do not list what a file says is meant to meet, only count it, as replay does")
    add_options(command, {"files": files, "--report": page, "--triage": triage, **JSON, **DEVICE})
    add_fail_on(command, _KINDS)


def _run(arguments: argparse.Namespace) -> int:
    check_page(arguments.report)
    frames = _with_motion(find_frames(arguments.files))
    is_motion = len(frames.numbers) > 1
    device = find_device(arguments.device)
    selection = Selection(triage=read_triage(arguments.triage, of_files=True) if arguments.triage else ())
    if arguments.report:
        _report(arguments.report, frames, selection, str(device))
    findings: dict[str, Findings] = {kind: [] for kind in _KINDS if is_motion or kind != "collisions"}
    named = {name: FrameMesh(name, {}, False) for name in frames.names}
    notes = dict.fromkeys(selection.unmatched([*named.values()]))
    meant, is_meant = Counter(), functools.cache(lambda a, b: selection.meant(named[a], named[b]))
    names = {path: name for paths in frames.paths for path, name in zip(paths, frames.names, strict=True)}
    last, known = None, set()
    with RunProgress("Checking") as progress, loading_kernels(device, progress.console):
        for done, paths in enumerate(frames.paths):
            progress.show(done, len(frames.paths), f"frame {frames.numbers[done]}")
            scene = MeshScene(paths)
            notes |= dict.fromkeys(f"{file.path}: {note}" for file in scene.files for note in file.notes)
            has_motion = last is not None and np.array_equal(last.faces, scene.faces)
            found_here = _find(scene, device)
            if last is not None and has_motion:
                found_here["collisions"] = _find_in_motion(last, scene, device)
            elif last is not None:
                notes[f"{', '.join(paths)}: other faces than in the frame before, so no motion is checked"] = None
            before, known = known if has_motion else set(), set()
            for kind, found in found_here.items():
                for elements in found:
                    if kind in _OF_PAIRS and (entry := is_meant(*(names[element["of"]] for element in elements))):
                        meant[entry] += 1
                        continue
                    key = kind, *((names[element["of"]], str(next(iter(element.values())))) for element in elements)
                    known.add(key)
                    if kind in _OF_POSITIONS or key not in before:
                        findings[kind].append(elements)
            last = scene
    notes |= {f"meant: {entry}: {number:,}, not counted": None for entry, number in meant.items()}
    if arguments.json:
        facts = {"device": str(device), "is_motion": is_motion, "frames": frames.numbers}
        print(json.dumps(facts | {"findings": findings, "notes": list(notes)}, indent=1))
    else:
        console = Console()
        for note in notes:
            say(console, f"note: {note}")
        what = "one configuration"
        if is_motion:
            what = f"{len(frames.numbers):,} frames from {frames.numbers[0]} to {frames.numbers[-1]}, and their motion"
        say(console, f"{', '.join(arguments.files)}: {what}")
        print_table(console, "found", _COLUMNS, [(_KINDS[kind], found) for kind, found in findings.items()])
        if arguments.report:
            say(console, f"Wrote {arguments.report}.")
    return ExitStatus.FOUND if any(findings.get(kind) for kind in arguments.fail_on) else ExitStatus.DONE


def _with_motion(frames: Frames) -> Frames:
    """Returns two files of the same faces as two frames of one mesh; other files as they are."""
    if len(frames.numbers) > 1 or len(frames.names) != 2:
        return frames
    start, end = (MeshScene([path]) for path in frames.paths[0])
    if not np.array_equal(start.faces, end.faces):
        return frames
    return Frames([", ".join(frames.names)], [0, 1], [[path] for path in frames.paths[0]])


def _report(path: str, frames: Frames, selection: Selection, device: str) -> None:
    """Writes the page of a replay of the files."""
    scene = read_frames(frames, selection)
    page, intervals, depths = ReportPage(path, scene=scene), [], DepthRecorder()
    try:
        with naming(path):
            for result in tracked(scene, "Replaying", device):
                page.add(result)
                if result.intersections:
                    depths.add(result.intersections)
                intervals.append(result.summary)
            found = {"intervals": intervals, "depths": depths.largest()}
            page.finish(Summary(scene, method="exact", device=device, clearance=None, **found))
    finally:
        page.discard()


def _find(scene: MeshScene, device: wp.Device) -> dict[str, Findings]:
    """Returns what :func:`.check` finds, as elements, by kind."""
    found = check(scene.faces, scene.x, device=device)

    def pairs(pairs: np.ndarray) -> Findings:
        return [[scene.element("edge", found.edges[edge]), scene.element("face", face)] for edge, face in pairs]

    def one(kind: str, elements: np.ndarray) -> Findings:
        return [[scene.element(kind, element) for element in np.atleast_1d(row)] for row in elements]

    def edges(rows: np.ndarray) -> Findings:
        return [[scene.element("edge", ends)] for ends in found.edges[rows]]

    _, first_faces = np.unique(found.component, return_index=True)
    return {
        "intersections": pairs(found.crossings),
        "touching": pairs(found.touching),
        "inside": one("face", first_faces[found.inside]),
        "degenerate": one("face", found.degenerate_faces),
        "duplicates": one("face", found.doubled_faces),
        "doubled": one("vertex", found.doubled_vertices),
        "nonmanifold": edges(found.nonmanifold_edges),
        "orientation": edges(found.misoriented_edges),
        "borders": edges(found.borders),
    }


def _find_in_motion(start: MeshScene, end: MeshScene, device: wp.Device) -> Findings:
    """Returns the collisions of a motion."""
    x0, x1 = (x.astype(np.result_type(start.x, end.x)) for x in (start.x, end.x))
    mesh = CollisionMesh(start.faces, len(x0), device=device)
    mesh = welded(mesh, weld_borders(mesh, np.hstack([x0, x1])))
    found = CollisionDetector(mesh, method="exact").detect(x0, x1)
    collisions = [[start.element("vertex", v), start.element("face", f)] for v, f in found.vertex_face]
    return collisions + [[start.element("edge", ends) for ends in mesh.edges[pair]] for pair in found.edge_edge]
