"""Shows the results of a replay on the terminal."""

from rich.console import Console
from rich.text import Text

from ..replay.intervals import IntervalSummary
from ..replay.summary import CERTIFIED_FOR, Summary, ValidationSummary
from .tables import LONGEST, count, make_table, say

__all__ = ["print_replay"]


def print_replay(console: Console, summary: Summary) -> None:
    """Prints a table of the worst intervals and a summary.

    Args:
        console: The terminal or file to print to.
        summary: The results.
    """
    scene, intervals = summary.scene, summary.intervals
    say(
        console,
        f"{scene.path}: {count(len(scene.names), 'mesh', 'meshes')}, {scene.vertex_count:,} vertices, "
        f"{scene.face_count:,} faces, {count(summary.interval_count, 'interval')}; method {summary.method} on "
        f"{summary.device}",
    )
    for warning in scene.warnings:
        say(console, f"note: {warning}")
    say(console, f"note: {summary.motion}")
    if not summary.is_complete:
        say(
            console,
            f"Partial: {len(intervals)} of {count(summary.interval_count, 'interval')} were checked; "
            f"{summary.stopped}.",
        )

    listed = summary.worst[:LONGEST]
    if listed:
        _print_worst(console, listed)
    if listed and len(listed) < len(intervals):
        say(
            console,
            f"{count(len(intervals) - len(listed), 'interval')} not listed, "
            f"{len(summary.colliding) - len(listed)} with collisions; --json has all.",
        )

    if summary.colliding:
        _print_collisions(console, summary)
    else:
        say(console, f"No collision in {count(len(intervals), 'interval')}.")

    if uncertain := sum(not interval.certified for interval in intervals):
        say(
            console,
            f"Not certified even for {CERTIFIED_FOR}, collisions may be missing: {uncertain} of "
            f"{count(len(intervals), 'interval')}.",
        )
    elif summary.method == "conservative":
        unsure = sum(interval.stats.vertex_face.unsure + interval.stats.edge_edge.unsure for interval in intervals)
        say(
            console,
            f"Certified for {CERTIFIED_FOR}: no collision is missing. Pairs tested that floating point could not "
            f"certify: {unsure:,}.",
        )
    else:
        say(console, f"Certified for {CERTIFIED_FOR}: every answer.")
    if scene.left_out:
        say(
            console,
            f"Left out, as named above: {count(len(scene.left_out), 'part')} of the scene that could not be read.",
        )
    if summary.validation:
        _print_validation(console, summary.validation)
    total = sum(summary.milliseconds.values())
    say(console, f"Detection took {total:,.0f} ms, {total / max(1, len(intervals)):,.1f} ms an interval.")


def _print_worst(console: Console, listed: list[IntervalSummary]) -> None:
    """Prints the intervals, those with the most collisions first."""
    arrow = "->" if console.options.ascii_only else "→"
    stages = list(listed[0].stats.milliseconds)
    while True:
        headers = ["Pairs\ntested", "Hits", "Earliest", *("\n".join(stage.rsplit(" ", 1)) for stage in stages)]
        caption = "The worst first" + ("; times of the stages in milliseconds." if stages else ".")
        table = make_table("Interval", *headers, caption=caption)
        table.columns[0].no_wrap = True
        for interval in listed:
            assert interval.earliest  # it collides
            table.add_row(
                Text(f"{interval.start:g} {arrow} {interval.end:g}"),
                f"{interval.pairs_tested:,}",
                f"{interval.hits:,}",
                f"{round(interval.earliest.time, 6):.6g}",
                *(f"{interval.stats.milliseconds[stage]:,.1f}" for stage in stages),
            )
        wide = console.options.update(width=1000)
        if not stages or console.measure(table, options=wide).maximum <= console.width:
            break
        stages.pop()  # the stage of least interest, as the table is too wide
    console.print(table)


def _print_collisions(console: Console, summary: Summary) -> None:
    """Prints the number of pairs that collide, in all and by meshes, and the first contact."""
    colliding = summary.colliding
    vertex_face = sum(interval.vertex_face_hits for interval in colliding)
    edge_edge = sum(interval.edge_edge_hits for interval in colliding)
    say(
        console,
        f"Collisions in {len(colliding)} of {count(len(summary.intervals), 'interval')}: "
        f"{vertex_face:,} vertex-face and {edge_edge:,} edge-edge pairs.",
    )
    for (first, second), hits in summary.mesh_pairs[:LONGEST]:
        say(console, f"  {hits:,} of {first} with {'itself' if first == second else second}")
    if len(summary.mesh_pairs) > LONGEST:
        say(console, f"  and {len(summary.mesh_pairs) - LONGEST} more pairs of meshes; --json has all.")
    contact = colliding[0].earliest
    assert contact  # it collides
    (first, second), (first_element, second_element) = contact.meshes, contact.elements
    other = "its" if first == second else f"{second},"
    say(console, f"The first at time {contact.time:.6g}: {first}, {first_element}, with {other} {second_element}.")
    worst = summary.worst[0]
    say(console, f"The most from time {worst.start:g} to {worst.end:g}: {worst.hits:,} pairs.")


def _print_validation(console: Console, found: ValidationSummary) -> None:
    """Prints how the answers compare with the exact checker's."""
    wrong = found.disagreements
    say(
        console,
        f"Validated by the exact checker: {count(found.hits, 'collision')} and "
        f"{count(found.others, 'other pair')}, {count(len(wrong), 'disagreement')}.",
    )
    for line in wrong[:LONGEST]:
        say(console, f"  {line}")
    if len(wrong) > LONGEST:
        say(console, f"  and {len(wrong) - LONGEST} more; --json has all.")
    if found.false_hits:
        say(
            console,
            f"False collisions, which method conservative allows: {found.false_hits:,}.",
        )
    say(console, f"Certified by floating point: {found.certified:,} of {found.answers:,} answers.")
