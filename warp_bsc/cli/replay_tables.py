"""Shows what a replay found, on the terminal."""

from rich.console import Console
from rich.text import Text

from ..replay.summary import CERTIFIED_FOR, Summary
from .tables import LONGEST, count, make_table, say

__all__ = ["print_replay"]


def print_replay(console: Console, outcome: Summary) -> None:
    """Print a table of the worst intervals and a summary.

    Args:
        console: Where to.
        outcome: What was found.
    """
    scene, intervals = outcome.scene, outcome.intervals
    say(
        console,
        f"{scene.path}: {count(len(scene.names), 'mesh', 'meshes')}, {scene.vertex_count:,} vertices, "
        f"{scene.face_count:,} faces, {count(outcome.interval_count, 'interval')}; method {outcome.method} on "
        f"{outcome.device}",
    )
    for warning in scene.warnings:
        say(console, f"note: {warning}")
    say(console, f"note: {outcome.motion}")
    if not outcome.is_complete:
        say(
            console,
            f"Partial: {len(intervals)} of {count(outcome.interval_count, 'interval')} were checked; "
            f"{outcome.stopped}.",
        )

    listed = outcome.worst[:LONGEST]
    if listed:
        _print_worst(console, listed)
    if listed and len(listed) < len(intervals):
        say(
            console,
            f"{count(len(intervals) - len(listed), 'interval')} not listed, "
            f"{len(outcome.colliding) - len(listed)} with collisions; --json has all.",
        )

    if outcome.colliding:
        _print_collisions(console, outcome)
    else:
        say(console, f"No collision in {count(len(intervals), 'interval')}.")

    if uncertain := sum(not interval.certified for interval in intervals):
        say(
            console,
            f"Not certified even for {CERTIFIED_FOR}, collisions may be missing: {uncertain} of "
            f"{count(len(intervals), 'interval')}.",
        )
    elif outcome.method == "conservative":
        unsure = sum(interval.stats.vertex_face.unsure + interval.stats.edge_edge.unsure for interval in intervals)
        say(
            console,
            f"Certified for {CERTIFIED_FOR}: no collision is missing. Pairs tested that could not be told apart from "
            f"collisions: {unsure:,}.",
        )
    else:
        say(console, f"Certified for {CERTIFIED_FOR}: every answer.")
    if scene.left_out:
        say(
            console,
            f"Left out, as named above: {count(len(scene.left_out), 'part')} of the scene that could not be read.",
        )
    if outcome.validation:
        _print_validation(console, outcome.validation)
    total = sum(outcome.milliseconds.values())
    say(console, f"Detection took {total:,.0f} ms, {total / max(1, len(intervals)):,.1f} ms an interval.")


def _print_worst(console, listed):
    """The intervals with the most collisions first."""
    arrow = "->" if console.options.ascii_only else "→"
    stages = list(listed[0].stats.milliseconds)
    while True:
        headers = ["Pairs\ntested", "Hits", "Earliest", *("\n".join(stage.rsplit(" ", 1)) for stage in stages)]
        caption = "The worst first" + ("; times of the stages in milliseconds." if stages else ".")
        table = make_table("Interval", *headers, caption=caption)
        table.columns[0].no_wrap = True
        for interval in listed:
            table.add_row(
                Text(f"{interval.start:g} {arrow} {interval.end:g}"),
                f"{interval.pairs_tested:,}",
                f"{interval.hits:,}",
                f"{round(interval.earliest.time, 6):.6g}",
                *(f"{interval.stats.milliseconds[stage]:,.1f}" for stage in stages),
            )
        roomy = console.options.update(width=1000)
        if not stages or console.measure(table, options=roomy).maximum <= console.width:
            break
        stages.pop()  # of the least interest where there is no room for all
    console.print(table)


def _print_collisions(console, outcome):
    """How many pairs collide, of which meshes, and where it begins."""
    colliding = outcome.colliding
    vertex_face = sum(interval.vertex_face_hits for interval in colliding)
    edge_edge = sum(interval.edge_edge_hits for interval in colliding)
    say(
        console,
        f"Collisions in {len(colliding)} of {count(len(outcome.intervals), 'interval')}: "
        f"{vertex_face:,} vertex-face and {edge_edge:,} edge-edge pairs.",
    )
    for (first, second), hits in outcome.mesh_pairs[:LONGEST]:
        say(console, f"  {hits:,} of {first} with {'itself' if first == second else second}")
    if len(outcome.mesh_pairs) > LONGEST:
        say(console, f"  and {len(outcome.mesh_pairs) - LONGEST} more pairs of meshes; --json has all.")
    contact = colliding[0].earliest
    (first, second), (first_element, second_element) = contact.meshes, contact.elements
    other = "its" if first == second else f"{second},"
    say(console, f"The first at time {contact.time:.6g}: {first}, {first_element}, with {other} {second_element}.")
    worst = outcome.worst[0]
    say(console, f"The most from time {worst.start:g} to {worst.end:g}: {worst.hits:,} pairs.")


def _print_validation(console, found):
    """What the exact checker says."""
    wrong = found["disagreements"]
    say(
        console,
        f"Validated by the exact checker: {count(found['hits'], 'collision')} and "
        f"{count(found['others'], 'other pair')}, {count(len(wrong), 'disagreement')}.",
    )
    for line in wrong[:LONGEST]:
        say(console, f"  {line}")
    if len(wrong) > LONGEST:
        say(console, f"  and {len(wrong) - LONGEST} more; --json has all.")
    if found["false_hits"]:
        say(console, f"Of the collisions {found['false_hits']:,} are none, as method conservative may have it.")
    say(console, f"Certified by floating point: {found['certified']:,} of {found['answers']:,} answers.")
