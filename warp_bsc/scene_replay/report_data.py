"""What a replay says of a whole scene: whether it is broken, by which pairs of meshes, and the data of its page."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from ..usd.scene import Scene
from .baseline import Baseline, NewFinding
from .summary import CERTIFIED_FOR, CollisionSpan, IntersectionSpan, Summary

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
    """Two meshes that collide or intersect at some time of a replay, or one that does so with itself.

    Attributes:
        meshes: Names of the two, sorted.
        since: The first time at which they do, as a time code.
        until: The last time.
        is_initial: Whether they intersect at the first time already.
        hits: Number of their pairs that collide.
        edges: Largest number of edges of one that meet faces of the other at a time.
        depth: The largest depth, in the scene's unit of length, and the first time with it; None if it is not known.
    """

    meshes: tuple[str, str]
    since: float
    until: float
    is_initial: bool
    hits: int
    edges: int
    depth: tuple[float, float] | None


def pairs_of_meshes(summary: Summary) -> list[PairFindings]:
    """Returns the pairs of meshes that collide or intersect, those that begin after the first time before the others.

    Among these, the deepest come first, then those with the most collisions.
    """
    hits = {(min(meshes), max(meshes)): number for meshes, number in summary.mesh_pairs}
    spans: dict[tuple[str, str], list[CollisionSpan | IntersectionSpan]] = {}
    for span in (*summary.collision_spans, *summary.intersection_spans):
        spans.setdefault((min(span.meshes), max(span.meshes)), []).append(span)
    first = summary.intersections[0] if summary.intersections else None
    initial = {(min(meshes), max(meshes)) for meshes in (*first.mesh_pairs, *first.inside)} if first else set()
    pairs = [
        PairFindings(
            meshes,
            since=min(span.since for span in own),
            until=max(span.until for span in own),
            is_initial=meshes in initial,
            hits=hits.get(meshes, 0),
            edges=max((span.most for span in own if isinstance(span, IntersectionSpan) and not span.inside), default=0),
            depth=summary.depths.get(meshes),
        )
        for meshes, own in spans.items()
    ]
    return sorted(pairs, key=lambda pair: (pair.is_initial, -(pair.depth or (0,))[0], -pair.hits, pair.meshes))


def length(scene: Scene, distance: float) -> str:
    """Returns a distance in centimetres, by the scene's unit of length; of mesh files, which have none, as it is."""
    return f"{distance:.3g}" if scene.stage is None else f"{100.0 * distance * scene.meters_per_unit:.3g} cm"


def verdict(summary: Summary) -> str:
    """Returns a sentence that says whether a scene is broken, by how many pairs of meshes, and which is the worst."""
    if sentence := _nothing_found(summary):
        return sentence
    pairs, scene = pairs_of_meshes(summary), summary.scene
    later = sum(not pair.is_initial for pair in pairs)
    inverting = len({span.meshes for span in summary.inversion_spans})
    same = len({name for span in summary.duplicate_spans for name in span.meshes})
    verb = "collides or intersects" if len(pairs) == 1 else "collide or intersect"
    parts = [f"{len(pairs):,} {_plural('pair', len(pairs))} of meshes {verb}"] * bool(pairs)
    if later < len(pairs):
        parts[0] += f", {later:,} of them only after the first time" if later else ", at the first time already"
    parts += [f"tetrahedra of {inverting:,} {_plural('mesh', inverting, 'es')} invert"] * bool(inverting)
    is_broken = bool(parts)
    parts += [f"{same:,} meshes are duplicates"] * bool(same)
    if near := len(summary.nearest):
        parts.append(f"{near:,} {_plural('pair', near)} of meshes are within {summary.clearance:g} of each other")
    if not parts:
        return ""  # nothing was checked, or not all of it
    text = f"{'Broken' if is_broken else 'Not broken, but'}: {'; '.join(parts)}."
    if pairs:
        (first, second), worst = pairs[0].meshes, pairs[0]
        deep = (
            f"{length(scene, worst.depth[0])} deep"
            if worst.depth and worst.depth[0]
            else f"{worst.hits:,} {_plural('collision', worst.hits)}"
        )
        when = f"time {worst.since:g}" + f" to {worst.until:g}" * (worst.until > worst.since)
        of_these = " of these" * (0 < later < len(pairs))
        text += f" The worst{of_these}: {first} with {'itself' if first == second else second}, {deep}, {when}."
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
    looked = bool(summary.intersections)
    intersecting = sum(not at.is_empty for at in summary.intersections)
    tiles = [] if new is None else [(f"{len(new):,}", "new against the baseline")]
    tiles += [
        (f"{summary.hits:,}", "collisions"),
        (f"{len(summary.colliding):,} of {len(summary.intervals):,}", "intervals with collisions"),
    ]
    if first := summary.first_contact:
        tiles.append((f"{first.time:.6g}", "time code of the first"))
    if looked:
        tiles.append((f"{intersecting:,} of {len(summary.intersections):,}", "times with intersections at rest"))
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
            (
                interval.start,
                interval.end,
                interval.vertex_face_hits,
                interval.edge_edge_hits,
                *([interval.vertex_edge_hits + interval.vertex_vertex_hits] * scene.has_strands),
            )
            for interval in summary.intervals
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
        data["partial"] = (
            f"Partial: {len(summary.intervals)} of {summary.interval_count} intervals were checked; {summary.stopped}."
        )
    if not data["nothing"]:
        data["partial"] = " ".join(filter(None, (data["partial"], summary.not_checked)))
    if found := summary.validation:
        wrong = len(found.disagreements)
        text = (
            f"The exact checker decided {found.hits:,} collisions and {found.others:,} other pairs again: "
            f"{wrong:,} {'disagreement' if wrong == 1 else 'disagreements'}. Floating point had certified "
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
    found = (
        summary.hits
        or summary.duplicate_spans
        or summary.inversion_spans
        or any(at.pairs for at in summary.proximities)
    )
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
    checked = [f"{len(summary.intervals):,} {_plural('interval', len(summary.intervals))}"] * (not scene.is_still)
    checked += [f"{at_rest:,} {_plural('time', at_rest)}"] * bool(at_rest)
    text = (
        f"{sentence[:1].upper()}{sentence[1:]}: {' and '.join(checked)} of {len(scene.names):,} "
        f"{_plural('mesh', len(scene.names), 'es')} and {scene.face_count:,} "
        f"{_plural('triangle', scene.face_count)} were checked, {times}"
    )
    text += f", certified for {CERTIFIED_FOR}." if summary.certified else ", not certified: collisions may be missing."
    if not at_rest:
        text += " Intersections at rest were not checked."
    text += f" {summary.not_counted}" if summary.not_counted else ""
    text += f" {summary.not_checked}" if summary.not_checked else ""
    if scene.selection.chooses_pairs:
        text += " Only some pairs of meshes were checked, as options say."
    return text


def _plural(word: str, count: int, ending: str = "s") -> str:
    return word if count == 1 else word + ending


def _pairs_of_meshes(summary: Summary, new: Iterable[NewFinding]) -> list[dict]:
    """Returns the pairs of meshes with collisions, intersections or proximities, and the spans of time of each kind.

    ``new`` is what a baseline does not contain.

    They come in the order of :func:`pairs_of_meshes`, then those with proximities alone. A pair has at most
    :data:`_MAX_ROWS` spans of each kind; the numbers ``more`` count the others.
    """
    spans: dict[tuple[str, str], tuple[tuple[str, str], list, list, list]] = {}

    def spans_of(meshes: tuple[str, str]) -> tuple[tuple[str, str], list, list, list]:
        return spans.setdefault((min(meshes), max(meshes)), (meshes, [], [], []))

    for span in summary.collision_spans:
        spans_of(span.meshes)[1].append((span.since, span.until, span.hits))
    for span in summary.intersection_spans:
        inner = span.meshes[0] if span.inside else ""
        spans_of(span.meshes)[2].append((span.since, span.until, span.most, span.trend, inner))
    for span in summary.proximity_spans:
        spans_of(span.meshes)[3].append((span.since, span.until, span.distance))
    new_of: dict[tuple[str, str], list[tuple[str, float, float]]] = {}
    for what, meshes, start, end in new:
        new_of.setdefault((min(meshes), max(meshes)), []).append((what, start, end))
    found = {pair.meshes: pair for pair in pairs_of_meshes(summary)}
    order = [*found, *(meshes for meshes in spans if meshes not in found)]
    return [_pair(spans[key], found.get(key), new_of.get(key, [])) for key in order[:MAX_PAIRS]]


def _pair(spans: tuple[tuple[str, str], list, list, list], found: PairFindings | None, new: list) -> dict:
    meshes, collisions, at_rest, near = spans
    return {
        "meshes": meshes,
        "hits": found.hits if found else 0,
        "depth": found.depth if found else None,
        "is_initial": found is not None and found.is_initial,
        "spans": collisions[:_MAX_ROWS],
        "more": max(0, len(collisions) - _MAX_ROWS),
        "rest": at_rest[:_MAX_ROWS],
        "more_rest": max(0, len(at_rest) - _MAX_ROWS),
        "near": near[:_MAX_ROWS],
        "more_near": max(0, len(near) - _MAX_ROWS),
        "new": new[:_MAX_ROWS],
        "more_new": max(0, len(new) - _MAX_ROWS),
    }
