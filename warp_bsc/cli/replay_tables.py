"""Shows the results of a replay on the terminal."""

import shlex
from collections import defaultdict

from rich.console import Console

from ..bench.tables import LONGEST, Column, count
from ..repairing.shot.findings import closed_meshes, kept_meshes
from ..scene_replay.baseline import NewFinding
from ..scene_replay.report_data import PairFindings, length, pairs_of_meshes, verdict
from ..scene_replay.results import Contact, IntersectionSummary, Nearest, Work
from ..scene_replay.scene_pairs import PHASES
from ..scene_replay.summary import CERTIFIED_FOR, IntersectionSpan, Summary
from ..scene_replay.validation import Validation
from ..usd.scene import Scene
from .option_names import with_option
from .tables import print_table, say, say_list

_POSITION = [Column(axis, lambda found, i=i: found.position[i], ".4g") for i, axis in enumerate("xyz")]
_INTERVALS = (
    Column("Collisions", "hits"),
    Column("Mesh pairs", lambda interval: len(interval.mesh_pairs)),
    Column("First at", lambda interval: round(interval.earliest.time, 6), ".6g"),
)
_NEAREST = (Column("Distance", "distance", ".6g"), Column("Time", "time", "g"), *_POSITION)

_RANGES = 4
"""Most ranges of time in a line."""


def print_replay(console: Console, summary: Summary) -> None:
    """Prints whether the scene is broken, by which pairs of meshes, the sums, and a table of the worst intervals."""
    scene, intervals = summary.scene, summary.intervals
    size = f"{count(len(scene.names), 'mesh', 'meshes')}, {scene.vertex_count:,} vertices, {scene.face_count:,} faces"
    all_intervals = count(len(summary.scene), "interval")
    say(console, f"{scene.path}: {size}, {all_intervals}; method {summary.method} on {summary.device}")
    for warning in scene.warnings:
        say(console, f"note: {with_option(warning)}")
    say(console, f"note: {summary.motion}")
    if not summary.is_complete:
        say(console, f"Partial: {len(intervals)} of {all_intervals} were checked; {summary.stopped}.")

    if sentence := verdict(summary):
        say(console, sentence, style="bold red" if sentence.startswith("Broken") else "bold")
    pairs = pairs_of_meshes(summary)
    _print_pairs(console, scene, pairs)

    if summary.colliding:
        _print_collisions(console, summary)
    elif not scene.is_still:
        say(console, f"No collision in {count(len(intervals), 'interval')}.")
    if summary.intersections:
        _print_intersections(console, summary, {pair.meshes for pair in pairs if pair.is_initial})
    for span in summary.duplicate_spans[:LONGEST]:
        say(console, f"{span.describe(LONGEST)}.")
    if (more := len(summary.duplicate_spans) - LONGEST) > 0:
        say(console, f"  and {count(more, 'more set')} of duplicates; --json has all.")
    if spans := summary.inversion_spans:
        say(console, f"Inverted tetrahedra in {count(len({span.meshes for span in spans}), 'mesh', 'meshes')}:")
        say_list(console, [span.describe() for span in spans], "; --json has all.")
    if summary.clearance is not None:
        _print_proximities(console, summary, summary.clearance)
    if summary.ignored:
        say(console, summary.not_counted)
        say_list(console, [str(pair) for pair in summary.ignored], " pairs of meshes; --json has all.")

    if summary.colliding:
        _print_intervals(console, summary)
    if not scene.is_still:
        _print_certificate(console, summary)
    if summary.not_checked:
        say(console, summary.not_checked)
    if summary.validation:
        _print_validation(console, summary.validation, scene.has_strands)


def print_repair(console: Console, summary: Summary, command: str) -> None:
    """Prints the command that repairs what a replay found; nothing if it found nothing that a repair can move."""
    names = {name for meshes, _ in summary.mesh_pairs for name in meshes}
    kept = kept_meshes(summary.scene).keys()
    if names <= kept:
        return
    say(console, f"To repair: {command}")
    start = summary.intersections[0].mesh_pairs if summary.intersections else {}
    crossing = [pair for pair, (crosses, _) in start.items() if crosses and pair[0] != pair[1]]
    if left := [pair for pair in crossing if not kept >= {*pair}]:
        pairs = count(len(left), "pair")
        say(console, f"  It leaves {pairs} of meshes that cross at the first time; --include-initial repairs them too.")
        closed = closed_meshes(summary.scene)
        bodies = sorted((names & closed) - kept)
        if bodies and any((first in closed) != (second in closed) for first, second in left):
            say(console, f"  With --keep {shlex.join(bodies)} bodies stay where they are, and cloth alone moves.")


def print_work(console: Console, works: list[Work | None], writing: float) -> None:
    """Prints the times of the parts of the work, None for intervals of an earlier run, and of writing [s]."""
    done = [work for work in works if work]
    if len(done) < len(works):
        say(console, f"Taken from an earlier run: {count(len(works) - len(done), 'interval')}.")
    if not done:
        return
    times = {"reading": sum(work.reading for work in done), "checking": sum(work.checking for work in done)}
    times["writing"] = writing
    total = max(sum(times.values()), 1e-9)
    shares = ", ".join(f"{name} {seconds:,.2f} s ({seconds / total:.0%})" for name, seconds in times.items())
    each, longest = (total - writing) / len(done), max(work.reading + work.checking for work in done)
    took = f"{1e3 * each:,.1f} ms an interval, at most {1e3 * longest:,.1f} ms"
    say(console, f"Work: {shares}. Reading and checking took {took}.")
    by_worker = defaultdict(list)
    for work in done:
        by_worker[work.worker and f"{work.worker} on {work.device}"].append(work.reading + work.checking)
    if "" in by_worker:  # this process alone
        return
    workers = sorted(by_worker.items())
    lines = [f"{name}: {count(len(seconds), 'interval')}, {sum(seconds):,.2f} s" for name, seconds in workers]
    say_list(console, lines, " workers.")


def print_new(console: Console, new: list[NewFinding]) -> None:
    """Prints the findings that a baseline does not contain."""
    if not new:
        say(console, "Nothing is new against the baseline.")
        return
    say(console, f"New against the baseline: {count(len(new), 'interval or time', 'intervals and times')}.")
    say_list(console, [_new_finding(*finding) for finding in new], ".")


def _new_finding(what: str, meshes: tuple[str, ...], start: float, end: float) -> str:
    """Returns what a baseline does not contain, in words."""
    finding = f"{_pair((meshes[0], meshes[-1]))} {what}"
    if what == "is inside":
        finding = " is inside ".join(meshes)
    elif what == "inverts":
        finding = f"tetrahedra of {meshes[0]} are inverted"
    elif what == "are duplicates":
        finding = f"{meshes[0]} and {count(len(meshes) - 1, 'other')} are duplicates"
    return f"{finding} at {start:g}" if start == end else f"{finding} from {start:g} to {end:g}"


def _print_certificate(console: Console, summary: Summary) -> None:
    """Prints whether a collision may be missing."""
    intervals, of_all = summary.intervals, count(len(summary.intervals), "interval")
    if uncertain := sum(not interval.certified for interval in intervals):
        say(console, f"Not certified even for {CERTIFIED_FOR}, collisions may be missing: {uncertain} of {of_all}.")
        return
    certified = "every pair tested."
    if summary.method == "conservative":
        certified = "no collision is missing. Pairs tested that floating point could not certify: "
        certified += f"{sum(interval.unsure for interval in intervals):,}."
    say(console, f"Certified for {CERTIFIED_FOR}: {certified}")


def _print_pairs(console: Console, scene: Scene, pairs: list[PairFindings]) -> None:
    """Prints a line for each pair of meshes: its depth, and the times and numbers of what meets."""
    lines = []
    for pair in pairs:
        parts = [f"{length(scene, pair.depth[0])} deep at {pair.depth[1]:g}"] if pair.depth else []
        if ranges := [f"{span.since:g} to {span.until:g}" for span in pair.collisions]:
            more = f", and {len(ranges) - _RANGES} more times" * (len(ranges) > _RANGES)
            parts.append(f"{count(pair.hits, 'collision')} from {', '.join(ranges[:_RANGES])}{more}")
        parts += [f"at most {count(pair.edges, 'edge')} in faces"] * bool(pair.edges)
        if parts:
            parts += ["from the first time on"] * pair.is_initial
            lines.append(f"{_pair(pair.meshes)}: {'; '.join(parts)}")
    say_list(console, lines, " pairs of meshes; --json has all.")


def _print_intervals(console: Console, summary: Summary) -> None:
    """Prints the intervals with the most collisions, in order of time."""
    arrow = "->" if console.options.ascii_only else "→"
    listed = sorted(summary.worst[:LONGEST], key=lambda interval: interval.index)
    rows = [(f"{interval.start:g} {arrow} {interval.end:g}", interval) for interval in listed]
    print_table(console, Column("Frames", kind="word"), _INTERVALS, rows)
    if len(listed) < len(summary.intervals):
        more = len(summary.colliding) - len(listed)
        others = count(len(summary.intervals) - len(listed), "interval")
        say(console, f"{others} not listed, {more} with collisions; --json has all.")


def _print_collisions(console: Console, summary: Summary) -> None:
    """Prints the total number of pairs that collide, their numbers by meshes, and the first contact."""
    colliding = summary.colliding
    kinds = ["vertex_face", "edge_edge"] + ["vertex_edge", "vertex_vertex"] * summary.scene.has_strands
    numbers = [sum(getattr(interval, f"{kind}_hits") for interval in colliding) for kind in kinds]
    texts = [f"{number:,} {kind.replace('_', '-')}" for number, kind in zip(numbers, kinds, strict=True)]
    where = f"{len(colliding)} of {count(len(summary.intervals), 'interval')}"
    say(console, f"Collisions in {where}: {', '.join(texts[:-1])} and {texts[-1]} pairs.")
    contact = colliding[0].earliest
    assert contact  # it collides
    say(console, f"The first at time {contact.time:.6g}: {_contact(contact)}.")
    worst = summary.worst[0]
    pairs = "pair" if worst.hits == 1 else "pairs"
    say(console, f"The most from time {worst.start:g} to {worst.end:g}: {worst.hits:,} {pairs}.")


def _print_intersections(console: Console, summary: Summary, initial: set[tuple[str, str]]) -> None:
    """Prints the intersections at the times themselves, their spans of time, and the phases of the collisions.

    The spans of pairs of meshes that intersect at the first time already come last.
    """
    samples = summary.intersections
    spans = sorted(summary.intersection_spans, key=lambda span: (min(span.meshes), max(span.meshes)) in initial)
    times = count(len(samples), "time")
    if not spans:
        say(console, f"No edge meets a face at rest, and no mesh is inside another, at {times}.")
        return
    first = samples[0]
    if not first.is_empty:
        state = "Already crosses" if first.crossings else "Already touches" if first.touches else "Already inside"
        say(console, f"{state} at {first.time:g}: {_intersecting(first)}.")
    worst = max(samples, key=lambda sample: (sample.crossings, sum(sample.inside.values()), sample.touches))
    where = f"{sum(not sample.is_empty for sample in samples):,} of {times}"
    say(console, f"Intersections at rest at {where}; the most at {worst.time:g}: {_intersecting(worst)}.")
    pairs = [" inside ".join(span.meshes) if span.inside else _pair(span.meshes) for span in spans]
    lines = [f"{pair}: {_history(span)}" for pair, span in zip(pairs, spans, strict=True)]
    say_list(console, lines, "; --json has all.")
    if summary.colliding:
        numbers = map(sum, zip(*(interval.phases or () for interval in summary.colliding), strict=True))
        phases = ", ".join(f"{phase} {number:,}" for phase, number in zip(PHASES, numbers, strict=True))
        separate = f"{sum(interval.separate_hits or 0 for interval in summary.colliding):,} are of meshes"
        say(console, f"Of the collisions, {separate} that were separate before. The surfaces around them: {phases}.")


def _print_proximities(console: Console, summary: Summary, clearance: float) -> None:
    """Prints the number of proximities at the times themselves, and the nearest elements of each two meshes."""
    samples, nearest = summary.proximities, summary.nearest
    times = f"{count(len(samples), 'time')}; between times, distances are not checked"
    if summary.scene.has_strands:
        times += ", nor are those of curves and points at all"
    if not nearest:
        say(console, f"No elements are at most {clearance:g} apart, at {times}.")
        return
    near = sum(bool(sample.pairs) for sample in samples)
    worst = max(samples, key=lambda sample: sample.pairs)
    least = f"{nearest[0].distance:.6g}, at {nearest[0].time:g}; the most pairs at {worst.time:g}: {worst.pairs:,}"
    apart = f"Elements are at most {clearance:g} apart at {near:,} of {times}"
    say(console, f"{apart}. The smallest distance is {least}.")
    rows = [(_contact(found), found) for found in nearest[:LONGEST]]
    print_table(console, "Nearest elements", _NEAREST, rows, caption="The nearest of all times.")
    if len(nearest) > LONGEST:
        say(console, f"  and {len(nearest) - LONGEST} more pairs of meshes; --json has all.")


def _intersecting(found: IntersectionSummary) -> str:
    """Returns the numbers of edges through faces, of edges touching faces and of parts inside others, in words."""
    numbers = [
        (found.crossings, "edge", "through faces"),
        (found.touches, "edge", "touching faces"),
        (sum(found.inside.values()), "part", "inside"),
    ]
    return ", ".join(f"{count(number, one)} {how}" for number, one, how in numbers if number)


def _contact(found: Contact | Nearest) -> str:
    """Returns the prims and the elements of two that meet, or are nearest, in words."""
    (first, second), (element, other) = found.meshes, found.elements
    return f"{first}, {element}, with {'its' if first == second else f'{second},'} {other}"


def _pair(meshes: tuple[str, str]) -> str:
    first, second = meshes
    return f"{first} with {'itself' if first == second else second}"


def _history(span: IntersectionSpan) -> str:
    """Returns the span of time in which two meshes intersect, and its numbers, in words."""
    trend = "touches only" if not span.inside and not span.crossings else span.trend
    one = "part" if span.inside else "edge"
    if span.since == span.until:
        return f"at {span.since:g}, {count(span.first, one)}, {trend}"
    numbers = f"{count(span.first, one)} at first, {span.last:,} at last"
    if span.most > max(span.first, span.last):
        numbers += f", {span.most:,} at {span.most_at:g}"
    return f"from {span.since:g} to {span.until:g}, {numbers}: {trend}"


def _print_validation(console: Console, found: Validation, has_strands: bool) -> None:
    """Prints the comparison with the exact checker."""
    wrong = found.disagreements
    pairs = f"{count(found.hits, 'collision')} and {count(found.others, 'other pair')}"
    say(console, f"Validated by the exact checker: {pairs}, {count(len(wrong), 'disagreement')}.")
    if has_strands:
        say(console, "Collisions of curves and points are not validated.")
    say_list(console, wrong, "; --json has all.")
    if found.false_hits:
        say(console, f"False collisions, which method conservative allows: {found.false_hits:,}.")
    say(console, f"Certified by floating point: {found.certified:,} of {found.decided:,} pairs.")
