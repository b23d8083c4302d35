"""Prints what warp-bsc repair did: a table of the repaired stretches, and what remains."""

from ..bench.tables import LONGEST, Column, count
from ..repairing.shot.stretch import distortion
from .option_names import with_option
from .repair_run import RepairRun
from .tables import Console, print_table, say

_STRETCHES = (  # of a stretch and its frames
    Column("frames", lambda row: len(row[1])),
    Column("points", lambda row: row[0].moved),
    Column("largest move", lambda row: row[0].largest_move / row[0].edge_length, ".3f"),
    Column("mean", lambda row: row[0].mean_move / row[0].edge_length, ".3f"),
    Column("edges", lambda row: row[0].edge_ratio, lambda ends: f"{ends[0]:.2f} to {ends[1]:.2f}"),
    Column(
        "acceleration",
        lambda row: [acceleration / row[0].edge_length for acceleration in row[0].acceleration],
        lambda both: f"{both[0]:.3f} ({both[1]:.3f})",
    ),
)


def print_repair(console: Console, run: RepairRun, kept: dict[str, str], remaining: dict[str, int]) -> None:
    """Prints what was done, and what remains."""
    scene = run.scene
    size = f"{count(len(scene.names), 'mesh', 'meshes')}, {scene.vertex_count:,} vertices"
    say(console, f"{scene.path}: {size}, {count(len(scene), 'interval')}")
    for warning in scene.warnings:
        say(console, f"note: {with_option(warning)}")
    for note in run.notes:
        say(console, f"note: {note}")
    for name, reason in list(kept.items())[:LONGEST]:
        say(console, f"note: {name} is not moved: {reason}")
    if len(kept) > LONGEST:
        say(console, f"note: {len(kept) - LONGEST} more are not moved")
    for first, second in run.unrepaired_pairs[:LONGEST]:
        say(console, f"Not repaired: {first} with {second}, which cross at {scene.times[0]:g} already.")
    if run.unrepaired_pairs:
        more = len(run.unrepaired_pairs) - LONGEST
        other = f"{count(more, 'more pair')} of meshes as well; " if more > 0 else ""
        say(console, f"  {other}--include-initial repairs them too, --ignore does not count them.")
    if run.earlier:
        say(console, f"note: stretches that an earlier run has repaired: {run.earlier:,}")
    if run.stretches:
        _print_stretches(console, run)
    if run.distorted:
        worst, (low, high) = max(run.distorted.items(), key=lambda frame: distortion(frame[1]))
        frames = (
            f"{count(len(run.distorted), 'frame')}, with edges shorter than a third of the shot's or longer than twice"
        )
        say(console, f"Not good: {frames}; at {worst:g} the worst, {low:.2f} to {high:.2f}.", style="bold red")
    for stretch in run.stretches[:LONGEST]:
        for reason in stretch.reasons:
            say(console, f"Not repaired from {stretch.start:g} to {stretch.end:g}: {reason}.")
        if stretch.uncertified:
            times = ", ".join(f"{time:g}" for time in stretch.uncertified[:4])
            say(console, f"Not certified: {count(len(stretch.uncertified), 'frame')}, the first at {times}.")
    for what, number in run.found.items():
        say(console, f"{what.capitalize()}: {number:,} before, {remaining[what]:,} remain.")
    finding, repairing = (f"{1e3 * run.seconds[name] / len(scene):,.1f} ms" for name in ("finding", "repairing"))
    say(console, f"Finding took {finding} an interval, repairing {repairing}.")
    if not run.has_moved:
        say(console, "Nothing was moved: what is written shows the scene as it is.")
    say(console, f"Wrote {run.output}.")
    if run.page:
        say(console, f"Wrote {run.page}.")


def _print_stretches(console: Console, run: RepairRun) -> None:
    """Prints a table of the stretches."""
    lengths = sorted({f"{stretch.edge_length:.3g}" for stretch in run.stretches})
    rows = zip(run.stretches[:LONGEST], run.frames, strict=False)
    print_table(
        console,
        "time",
        _STRETCHES,
        [(f"{stretch.start:g} → {stretch.end:g}", (stretch, frames)) for stretch, frames in rows],
        caption="Points: the most of a frame. Moves and the added acceleration a frame in median edge lengths "
        f"({' or '.join(lengths)} in the scene's unit, as of --max-move), in parentheses that of the scene; edges: the "
        "shortest and the longest against the scene at the same time.",
    )
    if len(run.stretches) > LONGEST:
        say(console, f"{len(run.stretches) - LONGEST} stretches are not listed; --json has all.")
