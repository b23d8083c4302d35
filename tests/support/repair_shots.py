"""Measures ``warp-bsc repair`` on shots: what collides before and after, how far points move, and the time.

``python tests/support/repair_shots.py`` repairs recorded scenes of ``assets/`` and a cloth that VBD drapes without
self-contact, each twice, on the CPU or ``--device``; times are those of the faster run. It prints a row for each shot,
and ``--json`` writes them to a file as well.
"""

import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np
import warp as wp
from draped_shot import write_shot
from measured import options_of, report

import warp_bsc as bsc
from warp_bsc.bench.tables import Column
from warp_bsc.cli.main import main as run_command
from warp_bsc.usd.scene import Scene

ASSETS = Path(__file__).parents[2] / "assets"
DRAPE = "drape.usdc"
SHOTS = (
    ("dancer.usd", ()),
    ("twisting.usd", ()),
    ("flamenco.usd", ()),
    (DRAPE, ()),
    ("dancer.usd", ("--min-distance", "0.001")),
)
"""Files, and options of the command."""
RUNS = 2


def repair(path, output, options, device):
    """Runs the command, and returns the results that it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        status = run_command(["repair", str(path), "--output", str(output), "--device", device, "--json", *options])
    if status:
        raise SystemExit(f"exit status {status} of the repair of {path}")
    return json.loads(printed.getvalue())


def compare(path, output):
    """Returns sizes of a shot, and how far its repair moves points and stretches edges.

    Moves are in median lengths of the edges that move, at the first time; those of edges are ratios of their lengths in
    the repair to those in the shot at the same time.
    """
    shot, repaired = (Scene(str(name)) for name in (path, output))
    segment = shot.interval(0).segment
    edges = bsc.CollisionMesh(segment.faces, segment.vertex_count, device="cpu").edges

    def positions(scene):
        return np.stack([*(scene.interval(i).x0 for i in range(len(scene))), scene.interval(len(scene) - 1).x1])

    def lengths(x):
        ends = x[:, edges]
        return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)

    before, after = positions(shot).astype(float), positions(repaired).astype(float)
    moves = np.linalg.norm(after - before, axis=2)
    moved = (moves > 0.0).any(axis=0)[edges].any(axis=1)
    old, new = lengths(before)[:, moved], lengths(after)[:, moved]
    edge = np.median(old[0])
    return {
        "intervals": len(shot),
        "vertices": segment.vertex_count,
        "largest_move": float(moves.max() / edge),
        "mean_move": float(moves[moves > 0.0].mean() / edge),
        "shortest_edge": float((new / old).min()),
        "longest_edge": float((new / old).max()),
    }


COLUMNS = (
    *(
        Column(key.capitalize(), lambda row, key=key: ", ".join(f"{count:,}" for count in row[key].values()))
        for key in ("before", "left")
    ),
    Column("Largest move", "largest_move", ".2f"),
    Column("Mean", "mean_move", ".2f"),
    Column("Edges", lambda row: f"{row['shortest_edge']:.2f} to {row['longest_edge']:.2f}"),
    *(Column(f"{what.capitalize()} [s]", f"seconds.{what}", ".2f") for what in ("finding", "repairing")),
)


def main():
    """Measures all shots."""
    arguments = options_of(__doc__, device="cpu").parse_args()
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_shot(folder / DRAPE)
        for name, options in SHOTS:
            path, output = (folder if name == DRAPE else ASSETS) / name, folder / "fixed.usdc"
            runs = [repair(path, output, options, arguments.device) for _ in range(RUNS)]
            seconds = {key: min(run["seconds"][key] for run in runs) for key in runs[0]["seconds"]}
            row = {"shot": name, "options": list(options), "before": runs[0]["before"], "left": runs[0]["remaining"]}
            row |= compare(path, output) | {"seconds": seconds}
            rows.append(row)
    report(
        arguments,
        "repair_shots",
        "Shot",
        COLUMNS,
        rows,
        [wp.get_device(arguments.device)],
        name=lambda row: " ".join((row["shot"], *row["options"])),
    )


if __name__ == "__main__":
    main()
