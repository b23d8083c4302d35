"""The command ``warp-bsc check``: finds what crosses, touches or is not sound in mesh files."""

import argparse
import json
from typing import Any

import numpy as np
import warp as wp

from ..bench.tables import Column
from ..detection.detector import CollisionDetector
from ..detection.mesh import CollisionMesh
from ..mesh_files.check import check
from ..mesh_files.mesh_file import MeshScene
from ..repairing.surface import weld_borders, welded
from .device import find_device, loading_kernels
from .exit_status import ExitStatus, explain_statuses
from .options import DEVICE, JSON, Commands, add_command, add_fail_on, add_options, several
from .repair_files import in_words
from .tables import Console, print_table, say

_DESCRIPTION = """\
Find what crosses, touches or lies inside in mesh files (.obj, .off, .ply, .stl),
exactly, and the faces and edges that are not sound. Several files are one scene.
Two files of the same faces are the start and the end of a motion: find the
collisions in it, and what crosses at either end.
Vertices of borders in one place are one, as at seams of textures. Elements are
named by their numbers in their files, which count from 0; --json has all."""

_EPILOG = f"""\
examples:
  warp-bsc check garment.obj
  warp-bsc check body.obj garment.ply --json > findings.json
  warp-bsc check part.stl --fail-on intersections,borders,degenerate
  warp-bsc check frame_11.ply frame_12.ply --fail-on collisions

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

_COLUMNS = (
    Column("number", len),
    Column("the first", lambda found: in_words(found[0]) if found else None, kind="text"),
)

Findings = list[list[dict[str, Any]]]
"""What is found of one kind: the elements of each finding, as of :meth:`.MeshScene.element`."""


def add_to(commands: Commands, summary: str) -> None:
    """Adds the command with its options, and a line for the list of commands."""
    command = add_command(commands, "check", _run, summary=summary, description=_DESCRIPTION, epilog=_EPILOG)
    add_options(command, {"files": several("FILE", "a mesh file", nargs="+"), **JSON, **DEVICE})
    add_fail_on(command, _KINDS)


def _run(arguments: argparse.Namespace) -> int:
    files = [MeshScene([path]) for path in arguments.files]
    device = find_device(arguments.device)
    is_motion = len(files) == 2 and np.array_equal(files[0].faces, files[1].faces)
    with loading_kernels(device):
        scene = MeshScene(arguments.files)
        findings = _find_in_motion(files[0], files[1], device) if is_motion else _find(scene, device)
    notes = [f"{file.path}: {note}" for file in scene.files for note in file.notes]
    if arguments.json:
        facts = {"device": str(device), "is_motion": is_motion, "findings": findings, "notes": notes}
        print(json.dumps(facts, indent=1))
    else:
        console = Console()
        for note in notes:
            say(console, f"note: {note}")
        what = "the same faces, so the start and the end of a motion" if is_motion else "one configuration"
        say(console, f"{', '.join(arguments.files)}: {what}")
        print_table(console, "found", _COLUMNS, [(_KINDS[kind], found) for kind, found in findings.items()])
    return ExitStatus.FOUND if any(findings.get(kind) for kind in arguments.fail_on) else ExitStatus.DONE


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


def _find_in_motion(start: MeshScene, end: MeshScene, device: wp.Device) -> dict[str, Findings]:
    """Returns the collisions of a motion, and what crosses or touches at its ends."""
    x0, x1 = (x.astype(np.result_type(start.x, end.x)) for x in (start.x, end.x))
    mesh = CollisionMesh(start.faces, len(x0), device=device)
    mesh = welded(mesh, weld_borders(mesh, np.hstack([x0, x1])))
    found = CollisionDetector(mesh, method="exact").detect(x0, x1)
    collisions = [[start.element("vertex", v), start.element("face", f)] for v, f in found.vertex_face]
    collisions += [[start.element("edge", ends) for ends in mesh.edges[pair]] for pair in found.edge_edge]
    at_ends = [_find(scene, device) for scene in (start, end)]
    return {"collisions": collisions} | {
        kind: at_ends[0][kind] + at_ends[1][kind] for kind in ("intersections", "touching")
    }
