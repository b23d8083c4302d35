"""What a replay says of a whole scene: whether it is broken, by which pairs of meshes, and the data of its page."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from ..usd.scene import Scene
from .baseline import Baseline, NewFinding
from .summary import CERTIFIED_FOR, CollisionSpan, IntersectionSpan, ProximitySpan, Summary, counted

MAX_PAIRS = 10_000
"""Largest number of pairs of meshes in the page."""

_MAX_ROWS = 10  # of the small tables
_MAX_DISAGREEMENTS = 200
_MAX_NAMES = 100  # of duplicates


def report_title(scene: Scene) -> str:
    """Returns the title of the page."""
    return f"Collisions in {Path(scene.path).name}"


@dataclass(frozen=True)
class PairFindings:
    """Two meshes that collide, intersect or are near each other at some time of a replay, or one that does so itself.

    Attributes:
        meshes: Names of the two, sorted.
        collisions: The times over which they collide.
        intersections: The times over which they intersect.
        proximities: The times over which they are near each other.
        is_initial: Whether they intersect at the first time already.
        depth: The largest depth, in the scene's unit of length, and the first time with it; None if it is not known.
    """

    meshes: tuple[str, str]
    collisions: list[CollisionSpan]
    intersections: list[IntersectionSpan]
    proximities: list[ProximitySpan]
    is_initial: bool
    depth: tuple[float, float] | None

    @property
    def hits(self) -> int:
        """Number of their pairs that collide."""
        return sum(span.hits for span in self.collisions)

    @property
    def edges(self) -> int:
        """Largest number of edges of one that meet faces of the other at a time."""
        return max((span.most for span in self.intersections if not span.inside), default=0)


def pairs_of_meshes(summary: Summary) -> list[PairFindings]:
    """Returns the pairs of meshes that collide, intersect or are near each other.

    First come those that begin after the first time, then those that intersect at the first time already, then those
    that are only near each other; in each the deepest first, then those with the most collisions.
    """
    spans: dict[tuple[str, str], tuple[list, list, list]] = {}
    found = summary.collision_spans, summary.intersection_spans, summary.proximity_spans
    for which, own in enumerate(found):
        for span in own:
            spans.setdefault((min(span.meshes), max(span.meshes)), ([], [], []))[which].append(span)
    first = summary.intersections[0] if summary.intersections else None
    initial = {(min(meshes), max(meshes)) for meshes in (*first.mesh_pairs, *first.inside)} if first else set()
    pairs = [PairFindings(key, *own, key in initial, summary.depths.get(key)) for key, own in spans.items()]

    def rank(pair: PairFindings) -> tuple:
        depth, is_near = (pair.depth or (0.0,))[0], not (pair.collisions or pair.intersections)
        return is_near, pair.is_initial, -depth, -pair.hits, pair.meshes

    return sorted(pairs, key=rank)


def length(scene: Scene, distance: float) -> str:
    """Returns a distance in centimetres, by the scene's unit of length; of mesh files, which have none, as it is."""
    return f"{distance:.3g}" if scene.stage is None else f"{100.0 * distance * scene.meters_per_unit:.3g} cm"


def verdict(summary: Summary) -> str:
    """Returns a sentence that says whether a scene is broken, by how many pairs of meshes, and which is the worst."""
    if sentence := _nothing_found(summary):
        return sentence
    pairs = [pair for pair in pairs_of_meshes(summary) if pair.collisions or pair.intersections]
    later = sum(not pair.is_initial for pair in pairs)
    inverting = len({span.meshes for span in summary.inversion_spans})
    same = len({name for span in summary.duplicate_spans for name in span.meshes})
    verb = "collides or intersects" if len(pairs) == 1 else "collide or intersect"
    parts = [f"{counted(len(pairs), 'pair')} of meshes {verb}"] * bool(pairs)
    if later < len(pairs):
        parts[0] += f", {later:,} of them only after the first time" if later else ", at the first time already"
    parts += [f"tetrahedra of {counted(inverting, 'mesh', 'es')} invert"] * bool(inverting)
    parts += [f"{same:,} meshes are duplicates"] * bool(same)
    if near := len(summary.nearest):
        parts.append(f"within {summary.clearance:g} of each other: {counted(near, 'pair')} of meshes")
    if not parts:
        return ""  # nothing was checked, or not all of it
    text = f"{'Broken' if pairs or inverting else 'Not broken, but'}: {'; '.join(parts)}."
    if pairs:
        (first, second), worst = pairs[0].meshes, pairs[0]
        depth, spans = worst.depth[0] if worst.depth else 0.0, [*worst.collisions, *worst.intersections]
        since, until = min(span.since for span in spans), max(span.until for span in spans)
        deep = f"{length(summary.scene, depth)} deep" if depth else counted(worst.hits, "collision")
        when = f"time {since:g}" + f" to {until:g}" * (until > since)
        of_these = " of these" * (0 < later < len(pairs))
        text += f" The worst{of_these}: {first} with {'itself' if first == second else second}, {deep}, {when}."
    if pairs and summary.intersections and not any(pair.intersections for pair in pairs):
        text += " No mesh intersects at a sample: frames there show nothing, but motion blur and frames in between may."
    return text


def report_data(summary: Summary, baseline: Baseline | None) -> dict:
    """Returns the data of the whole replay that the page's script shows.

    Args:
        summary: The replay.
        baseline: The earlier replay with which the page compares; None without one.
    """
    new = None if baseline is None else baseline.new_in(summary)
    scene = summary.scene
    named = [(f"Mesh {name}", shown) for name in scene.names if (shown := scene.display_names[name])]
    tiles = [] if new is None else [(f"{len(new):,}", "new against the baseline")]
    tiles.append((f"{summary.hits:,}", "collisions"))
    tiles.append((f"{len(summary.colliding):,} of {len(summary.intervals):,}", "intervals with collisions"))
    if summary.colliding and (first := summary.colliding[0].earliest):
        tiles.append((f"{first.time:.6g}", "time code of the first"))
    if at_rest := summary.intersections:
        intersecting = sum(not at.is_empty for at in at_rest)
        tiles.append((f"{intersecting:,} of {len(at_rest):,}", "times with intersections at rest"))
    if spans := summary.duplicate_spans:
        tiles.append((f"{len({name for span in spans for name in span.meshes}):,}", "meshes that are duplicates"))
    if inversions := summary.inversion_spans:
        tiles.append((f"{len({span.meshes for span in inversions}):,}", "meshes with inverted tetrahedra"))
    if depths := summary.depths:
        tiles.append((length(scene, max(depth for depth, _ in depths.values())), "largest depth"))
    if summary.clearance is not None:
        nearest = summary.nearest
        tiles.append((f"{nearest[0].distance:.4g}" if nearest else f"> {summary.clearance:g}", "smallest distance"))
    tiles += [
        (f"{len(scene.names):,}", "meshes" if len(scene.names) != 1 else "mesh"),
        (f"{scene.face_count:,}", "triangles"),
        ("yes" if summary.certified else "no", f"certified for {CERTIFIED_FOR}"),
    ]
    data = {
        "title": report_title(scene),
        "subtitle": f"{scene.path}, time {scene.times[0]:g} to {scene.times[-1]:g}; method {summary.method} on "
        f"{summary.device}",
        "partial": "",
        "nothing": _nothing_found(summary),
        "verdict": verdict(summary),
        "is_whole": not summary.not_checked,
        "tiles": tiles,
        "intervals": [
            (at.start, at.end, at.vertex_face_hits, at.edge_edge_hits, *of_strands[: scene.has_strands])
            for at in summary.intervals
            for of_strands in [[at.vertex_edge_hits + at.vertex_vertex_hits]]
        ],
        "rest": [(at.time, at.crossings, at.touches, sum(at.inside.values())) for at in summary.intersections],
        "near": [(at.time, at.pairs) for at in summary.proximities],
        "toi": summary.toi_counts,
        "pairs": _pairs_of_meshes(summary, new or ()),
        **_triage(summary),
        "centimetres": None if scene.stage is None else 100.0 * scene.meters_per_unit,
        "has_baseline": new is not None,
        "up_axis": scene.up_axis,
        "facts": [
            ("File", scene.path),
            *scene.comments,
            *([("Baseline", baseline.path)] if baseline else ()),
            ("Up axis", scene.up_axis),
            ("Metres per unit", f"{scene.meters_per_unit:g}"),
            ("Time codes per second", f"{scene.time_codes_per_second:g}"),
            ("Vertices", f"{scene.vertex_count:,}"),
            *named[:_MAX_ROWS],
            *([("Other display names", f"{len(named) - _MAX_ROWS:,}")] if len(named) > _MAX_ROWS else ()),
        ],
        "notes": [
            *(f"{span.describe(_MAX_NAMES)}." for span in spans[:_MAX_ROWS]),
            *([f"{len(spans) - _MAX_ROWS:,} more sets of duplicates."] if len(spans) > _MAX_ROWS else ()),
            *(f"{span.describe()}." for span in inversions[:_MAX_ROWS]),
            *([f"{len(inversions) - _MAX_ROWS:,} more times of inversions."] if len(inversions) > _MAX_ROWS else ()),
            summary.motion,
            *scene.warnings,
        ],
        "validation": None,
    }
    if not summary.is_complete:
        checked = f"{len(summary.intervals)} of {len(scene)} intervals were checked"
        data["partial"] = f"Partial: {checked}; {summary.stopped}."
    if not data["nothing"]:
        data["partial"] = " ".join(filter(None, (data["partial"], summary.not_checked)))
    if found := summary.validation:
        text = (
            f"The exact checker decided {found.hits:,} collisions and {found.others:,} other pairs again: "
            f"{counted(len(found.disagreements), 'disagreement')}. Floating point had certified "
            f"{found.certified:,} of all {found.decided:,} pairs."
        )
        data["validation"] = {"text": text, "disagreements": found.disagreements[:_MAX_DISAGREEMENTS]}
    return data


def _triage(summary: Summary) -> dict:
    """Returns what is meant to meet, and what is ignored: entries with their numbers of collisions, and both sums."""
    scene, ignored = summary.scene, summary.ignored
    hits = [sum(pair.hits for pair in ignored if pair.meant == entry) for entry in scene.selection.triage]
    entries = [asdict(entry) | {"hits": number} for entry, number in zip(scene.selection.triage, hits, strict=True)]
    others = [pair for pair in ignored if pair.meant is None]
    return {
        "triage": None if scene.stage is None else entries,
        "triage_name": f"{Path(scene.path).stem}.triage.json",
        "ignored": [{"meshes": pair.meshes, "hits": pair.hits, "reason": "ignored by an option"} for pair in others],
        "ignored_counts": (len(ignored), sum(pair.hits for pair in ignored)),
    }


def _nothing_found(summary: Summary) -> str:
    """Returns a sentence on what was checked if nothing was found in a whole replay, else an empty text."""
    found = summary.hits or summary.duplicate_spans or summary.inversion_spans or summary.nearest
    if found or not summary.is_complete or not all(at.is_empty for at in summary.intersections):
        return ""
    if summary.scene.is_still and not summary.intersections:
        return ""  # nothing was checked
    scene, at_rest = summary.scene, len(summary.intersections)
    what = ["Nothing collides"] * (not scene.is_still) + ["nothing intersects"] * bool(at_rest)
    what += ["no tetrahedron inverts"] * any(scene.prim_of(name).has_tetrahedra for name in scene.names)
    if summary.clearance is not None:
        what.append(f"nothing is within {summary.clearance:g} of another")
    times = f"time {scene.times[0]:g}" if scene.is_still else f"time {scene.times[0]:g} to {scene.times[-1]:g}"
    sentence = ", ".join(what)
    checked = [counted(len(summary.intervals), "interval")] * (not scene.is_still)
    checked += [counted(at_rest, "time")] * bool(at_rest)
    of = f"{counted(len(scene.names), 'mesh', 'es')} and {counted(scene.face_count, 'triangle')}"
    text = f"{sentence[:1].upper()}{sentence[1:]}: {' and '.join(checked)} of {of} were checked, {times}"
    text += f", certified for {CERTIFIED_FOR}." if summary.certified else ", not certified: collisions may be missing."
    if not at_rest:
        text += " Intersections at rest were not checked."
    text += f" {summary.not_counted}" if summary.not_counted else ""
    text += f" {summary.not_checked}" if summary.not_checked else ""
    if scene.selection.chooses_pairs:
        text += " Only some pairs of meshes were checked, as options say."
    return text


def _pairs_of_meshes(summary: Summary, new: Iterable[NewFinding]) -> list[dict]:
    """Returns :func:`pairs_of_meshes` with the spans of time of each kind, for the page.

    A pair has at most :data:`_MAX_ROWS` spans of each kind; the numbers ``more`` count the others. ``new`` is what a
    baseline does not contain.
    """
    new_of: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
    for what, meshes, start, end in new:
        new_of.setdefault((min(meshes), max(meshes)), []).append((what, start, end))
    rows = []
    for pair in pairs_of_meshes(summary)[:MAX_PAIRS]:
        lists = {
            "spans": [(span.since, span.until, span.hits) for span in pair.collisions],
            "rest": [
                (span.since, span.until, span.most, span.trend, span.meshes[0] if span.inside else "")
                for span in pair.intersections
            ],
            "near": [(span.since, span.until, span.distance) for span in pair.proximities],
            "new": new_of.get(pair.meshes, []),
        }
        facts = {"meshes": pair.meshes, "hits": pair.hits, "depth": pair.depth, "is_initial": pair.is_initial}
        more = {f"more_{name}": max(0, len(found) - _MAX_ROWS) for name, found in lists.items()}
        rows.append(facts | {name: found[:_MAX_ROWS] for name, found in lists.items()} | more)
    return rows
