"""Measures repairs: what they free, how far they move and strain it, their time, and whether others agree."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import warp as wp

from ...detection.mesh import CollisionMesh
from ...repairing.repair import repair
from ...repairing.results import RepairResult
from ..peers import ipc_toolkit
from ..scenes.repair import KINDS, TangledMesh
from ..tables import LONGEST, Column, Table, count, grouped, list_titles

Hint = Literal["none", "order", "x_previous"]
"""What a repair is told: nothing; which sheet is inside which; positions that do not cross."""

HINTS: tuple[Hint, ...] = ("order", "x_previous")
"""The hints with which a mesh is repaired again that was not freed without one."""

KNOWN_MESH, FILE = "known", "file"
"""Kinds of meshes beside those of random damage."""

STRAIN = 0.1
"""Strain that :func:`warp_bsc.repair` seeks by default, above which meshes are counted."""

CROSSING_RANGES = ((0, 49), (50, 149), (150, 499), (500, None))
"""Least and largest numbers of crossings of the ranges in which random damage is counted."""

DESCRIPTION = f"""\
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

EXAMPLES = """\
examples:
  warp-bsc bench repair
  warp-bsc bench repair body.obj --random 0
  warp-bsc bench repair --random 60 --json repair.json
  warp-bsc bench repair --kinds folds --random 1 --seed 17"""

_MESHES = (  # of a run and an attempt; the mean move is that of vertices that moved
    Column("Ver-\ntices", "0.vertices"),
    Column("Crossings\nbefore", "0.crossings"),
    Column("\nafter", "1.crossings"),
    Column("Largest\nmove", "1.largest_move", ".2f"),
    Column("Mean\nmove", "1.mean_move", ".2f"),
    Column("Strain\n[%]", lambda row: 100 * row[1].strain, ".1f"),
    Column("Time\n[s]", "1.seconds", ".2f"),
)
_FREED = (  # of a summary, as the next ones
    Column("Meshes", "meshes"),
    Column("Freed", "freed"),
    *(Column(f"with\n{hint}=", f"freed_by_hint.{hint}") for hint in HINTS),
    Column("Crossings", "crossings", "{0[0]:,} to {0[1]:,}".format),
)
_COSTS = (
    Column("Largest move,\nmedian", "move.0", ".2f"),
    Column("at\nmost", "move.1", ".2f"),
    Column("Strain,\nmedian\n[%]", lambda found: 100 * found["strain"][0], ".1f"),
    Column("at\nmost\n[%]", lambda found: 100 * found["strain"][1], ".1f"),
    Column(f"more\nthan\n{100 * STRAIN:.0f}%", "strained"),
    Column("Time,\nmedian\n[s]", "seconds", ".2f"),
)


@dataclass(frozen=True)
class RepairAttempt:
    """A repair of a mesh."""

    hint: Hint  # what it was told
    crossings: int  # edges that meet faces afterwards, each counted once a face
    certified: bool  # whether the repair certifies that there are none
    largest_move: float  # largest distance of a vertex from the input, in median edge lengths of the input
    mean_move: float  # mean distance of the vertices that moved, in the same unit; 0 if none did
    strain: float  # largest change of the length of an edge, as a share of its length in the input
    # time of a second call with the same arguments, which makes its mesh from faces and has the positions on the host
    # [s]
    seconds: float
    reasons: tuple[str, ...]  # why crossings remain, each reason once
    toolkit_crosses: bool | None  # whether the IPC Toolkit finds intersections afterwards; None if it is not installed

    @property
    def toolkit_agrees(self) -> bool | None:
        """Whether the IPC Toolkit finds intersections where this repair counts crossings; None if not installed."""
        return None if self.toolkit_crosses is None else self.toolkit_crosses == (self.crossings > 0)


@dataclass(frozen=True)
class RepairRun:
    """The repairs of a mesh."""

    kind: str  # :data:`KNOWN_MESH`, :data:`FILE`, or the kind of random damage
    name: str  # the name of a known mesh, the path of a file, or the number of random damage
    vertices: int  # number of vertices
    faces: int  # number of faces
    crossings: int  # edges that meet faces in the input, each counted once a face
    # a repair without a hint; if it did not free the mesh, one with each hint that there is for it
    attempts: tuple[RepairAttempt, ...]
    # whether the repair of positions that do not cross returned every bit: of those before the damage, or of a file the
    # repaired ones. None if there are none.
    keeps_free: bool | None

    def is_freed(self, *hints: Hint) -> bool:
        """Returns whether the mesh is free without a hint, or with one of the given ones."""
        return any(attempt.certified for attempt in self.attempts if attempt.hint in ("none", *hints))

    @classmethod
    def of_json(cls, values: dict[str, Any]) -> "RepairRun":
        """Returns what :func:`dataclasses.asdict` made plain."""
        attempts: Any = tuple(RepairAttempt(**attempt) for attempt in values["attempts"])
        return cls(**values | {"attempts": attempts})


def measure_repair(kind: str, name: str, mesh: TangledMesh, *, device: wp.DeviceLike = None) -> RepairRun:
    """Repairs a mesh, first without a hint, and measures the result.

    Args:
        kind: Kind of the mesh, as of :class:`RepairRun`.
        name: Name of the mesh.
        mesh: The mesh.
        device: The Warp device; default: the current one.
    """
    edges = CollisionMesh(mesh.faces, len(mesh.x), device="cpu").edges
    edge = float(np.median(np.linalg.norm(mesh.x[edges[:, 0]] - mesh.x[edges[:, 1]], axis=1)))
    first, result = _attempt("none", {}, mesh, edge, device)
    attempts = [first]
    if not first.certified:
        attempts += [_attempt(hint, options, mesh, edge, device)[0] for hint, options in _hints(mesh).items()]
    free = mesh.free if mesh.free is not None else result.x if first.certified else None
    keeps_free = None
    if free is not None:
        again = repair(mesh.faces, free, fixed=mesh.fixed, device=device)
        keeps_free = again.certified and np.asarray(again.x).tobytes() == np.asarray(free).tobytes()
    sizes = {"vertices": len(mesh.x), "faces": len(mesh.faces), "crossings": result.crossings_before}
    return RepairRun(kind, name, **sizes, attempts=tuple(attempts), keeps_free=keeps_free)


def summarize(runs: Sequence[RepairRun]) -> dict[str, Any]:
    """Returns what repairs of several meshes, at least one, have in common.

    Returns:
        ``meshes``, their number; ``freed``, the number of those that were freed without a hint, and ``freed_by_hint``
        that without one or with this one; ``crossings``, the smallest and largest number in an input. Of repairs
        without a hint: ``move``, median and maximum of the largest moves, in median edge lengths; ``strain``, those of
        the strains; ``strained``, the number of meshes whose strain is more than :data:`STRAIN`; ``seconds``, the
        median time [s].
    """
    firsts = [run.attempts[0] for run in runs]
    crossings = [run.crossings for run in runs]
    moves, strains = ([getattr(first, name) for first in firsts] for name in ("largest_move", "strain"))
    return {
        "meshes": len(runs),
        "freed": sum(run.is_freed() for run in runs),
        "freed_by_hint": {hint: sum(run.is_freed(hint) for run in runs) for hint in HINTS},
        "crossings": (min(crossings), max(crossings)),
        "move": (float(np.median(moves)), max(moves)),
        "strain": (float(np.median(strains)), max(strains)),
        "strained": sum(strain > STRAIN for strain in strains),
        "seconds": float(np.median([first.seconds for first in firsts])),
    }


def _hints(mesh: TangledMesh) -> dict[Hint, dict[str, Any]]:
    """Returns the arguments of a repair for each hint that there is for a mesh."""
    hints: dict[Hint, dict[str, Any]] = {}
    if (mesh.sheet >= 0).any():
        hints["order"] = {"order": mesh.sheet}
    if mesh.free is not None:
        hints["x_previous"] = {"x_previous": mesh.free}
    return hints


def _attempt(
    hint: Hint, options: dict[str, Any], mesh: TangledMesh, edge: float, device: wp.DeviceLike
) -> tuple[RepairAttempt, RepairResult]:
    """Repairs a mesh twice; returns the measurement and the result of the second repair."""

    def run() -> RepairResult:
        return repair(mesh.faces, mesh.x, fixed=mesh.fixed, device=device, **options)

    run()  # loads kernels
    started = time.perf_counter()
    result = run()
    seconds = time.perf_counter() - started
    moves = result.moved[result.moved > 0.0] / edge
    attempt = RepairAttempt(
        hint=hint,
        crossings=result.crossings,
        certified=result.certified,
        largest_move=float(moves.max(initial=0.0)),
        mean_move=float(moves.mean()) if len(moves) else 0.0,
        strain=result.max_strain,
        seconds=seconds,
        reasons=tuple(dict.fromkeys(contour.reason for contour in result.unresolved)),
        toolkit_crosses=(
            ipc_toolkit.has_intersections(mesh.faces, np.asarray(result.x)) if ipc_toolkit.is_installed() else None
        ),
    )
    return attempt, result


def to_dict(runs: list[RepairRun]) -> dict[str, Any]:
    """Returns runs as plain data for JSON."""
    return {"ipc_toolkit": ipc_toolkit.version(), "runs": [asdict(run) for run in runs]}


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement: known meshes and files, random damage; what went wrong."""
    runs = [RepairRun.of_json(run) for run in found["runs"]]
    device = f"{found['device']}, {found['device_name']}"
    yield f"bsc.repair on {device}; moves in median edge lengths; times of a second call"
    attempts = [(_title(run, attempt.hint), run, attempt) for run in runs for attempt in run.attempts]
    if named := [(title, (run, attempt)) for title, run, attempt in attempts if run.kind in (KNOWN_MESH, FILE)]:
        yield ""
        yield Table("Mesh", _MESHES, named)
    if random := [run for run in runs if run.kind not in (KNOWN_MESH, FILE)]:
        kinds, ranges = grouped(random, "kind"), {}
        for least, largest in CROSSING_RANGES:
            title = f"{least} or more crossings" if largest is None else f"{least} to {largest} crossings"
            within = [run for run in random if least <= run.crossings <= (largest or run.crossings)]
            ranges |= {title: within} if within else {}
        for columns, groups in ((_FREED, kinds | ranges), (_COSTS, kinds)):
            yield ""
            yield Table("Damage", columns, [(title, summarize(group)) for title, group in groups.items()])
    yield ""
    failures = [
        f"{title}: {run.crossings:,} to {attempt.crossings:,} crossings: {'; '.join(attempt.reasons)}."
        for title, run, attempt in attempts
        if not attempt.certified
    ]
    yield from failures[:LONGEST]
    if len(failures) > LONGEST:
        yield f"{len(failures) - LONGEST} more are not listed."
    worse = [title for title, run, attempt in attempts if attempt.crossings > run.crossings]
    yield f"Returned with more crossings: {list_titles(worse)} of {count(len(attempts), 'repair')}."
    moved = [_title(run, "none") for run in runs if run.keeps_free is False]
    checked = sum(run.keeps_free is not None for run in runs)
    yield f"Changed where nothing crossed: {list_titles(moved)} of {count(checked, 'mesh', 'meshes')}."
    if found["ipc_toolkit"] is None:
        yield "The IPC Toolkit, which would check the outputs, is not installed: pip install 'warp-bsc[bench]'."
    else:
        others = [title for title, _, attempt in attempts if attempt.toolkit_agrees is False]
        title = f"Where IPC Toolkit {found['ipc_toolkit']} disagrees whether anything crosses"
        yield f"{title}: {list_titles(others)} of {count(len(attempts), 'output')}."


def _title(run: RepairRun, hint: Hint) -> str:
    """Returns the name of a mesh, with the hint that a repair of it had."""
    name = run.name if run.kind == KNOWN_MESH else Path(run.name).name if run.kind == FILE else f"{run.kind} {run.name}"
    return name if hint == "none" else f"{name}, {hint}="
