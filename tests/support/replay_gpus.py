"""Measures ``warp-bsc replay`` of one large shot on one, two and four GPUs of a machine, and prints a table.

``python tests/support/replay_gpus.py`` takes the GPUs that are there; ``--devices cpu cpu,cpu --side 60`` tries it on a
CPU. The shot is made first: two waving sheets of together 4 side^2 triangles, whose crests pass through each other. A
run of two intervals on each device then compiles and loads the kernels. Each measured run is a process of its own, from
its start to its end. What runs write must be the same but for the names of devices; otherwise it is an error.

Reading and checking are sums over the processes, as ``replay`` prints them. ``--each 2`` starts two processes for each
GPU, which share it: where one process keeps its GPU waiting, for the host reads and names, they take less time.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp
from measured import options_of, report
from pxr import Vt
from replay_sizes import add_grid, new_stage

from warp_bsc.bench.tables import Column

COLUMNS = (
    Column("wall", "wall", "{:.1f} s".format),
    Column("speedup", "speedup", "{:.2f}".format),
    Column("reading", "reading", "{:.1f} s".format),
    Column("checking", "checking", "{:.1f} s".format),
    Column("writing", "writing", "{:.1f} s".format),
    Column("hits", "hits"),
)


def write_shot(path, side, samples):
    """Two sheets that wave; some of their crests pass through each other, at other places in each interval."""
    stage = new_stage(path, samples + 1)
    for name, gap, across in (("/World/A", 0.0, 7.0), ("/World/B", 0.0385, -5.0)):
        points, x, y = add_grid(stage, name, side)
        for frame in range(samples + 1):
            z = gap + 0.02 * np.sin(31.0 * x + across * y + 0.15 * frame)
            points.Set(Vt.Vec3fArray.FromNumpy(np.stack([x, y, z], axis=2).reshape(-1, 3).astype(np.float32)), frame)
    stage.Save()


def replay(scene, devices, hits, *options):
    """Replays a scene to a file of columns; returns wall time and the times of the parts of the work [s]."""
    command = [sys.executable, "-m", "warp_bsc", "replay", str(scene), "--device", devices, "--npz", str(hits)]
    started = time.perf_counter()
    done = subprocess.run([*command, *options], text=True, stdout=subprocess.PIPE, check=False)
    wall = time.perf_counter() - started
    if done.returncode:
        raise SystemExit(f"exit status {done.returncode} of {' '.join(command)}")
    parts = re.findall(r"(reading|checking|writing) ([\d,.]+) s", done.stdout)
    return {"wall": wall} | {name: float(seconds.replace(",", "")) for name, seconds in parts}


def columns_of(hits):
    """Returns the columns of a file by name, without its facts, which name the devices."""
    with np.load(hits) as columns:
        return {name: columns[name] for name in columns.files if name != "facts"}


def main():
    """Measures the shot."""
    parser = options_of(__doc__)
    parser.add_argument(
        "--devices", nargs="+", metavar="NAMES", help="of each run, the first is the one to compare with"
    )
    parser.add_argument("--each", type=int, default=1, help="processes for each device (default: 1)")
    parser.add_argument("--side", type=int, default=520, help="quads along a sheet (default: 520)")
    parser.add_argument("--samples", type=int, default=50, help="intervals (default: 50)")
    parser.add_argument("--folder", type=Path, help="keeps the shot there")
    arguments = parser.parse_args()
    names = [f"cuda:{number}" for number in range(wp.get_cuda_device_count())]
    runs = arguments.devices or [",".join(names[:count]) for count in (1, 2, 4) if count <= len(names)]
    if not runs:
        parser.error("no GPU is here: name --devices")
    rows, first = [], None
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        scene = folder / f"sheets_{arguments.side}_{arguments.samples}.usdc"
        if not scene.exists():
            write_shot(scene, arguments.side, arguments.samples)
        for device in dict.fromkeys(",".join(runs).split(",")):
            replay(scene, device, folder / "warm.npz", "--frames", "0:2")
        for run in runs:
            devices = ",".join([run] * arguments.each)
            row = replay(scene, devices, folder / "hits.npz")
            found = columns_of(folder / "hits.npz")
            first = first or (row["wall"], found)
            same = found.keys() == first[1].keys() and all(np.array_equal(found[n], first[1][n]) for n in found)
            if not same:
                raise SystemExit(f"{devices} finds something else than {runs[0]}")
            hits = int(found["interval"].size) if "interval" in found else None
            rows.append({"devices": devices, **row, "speedup": first[0] / row["wall"], "hits": hits})
            print(f"{devices}: {row['wall']:.1f} s", file=sys.stderr, flush=True)
    size = {"triangles": 4 * arguments.side**2, "intervals": arguments.samples, "each": arguments.each}
    report(arguments, "replay_gpus", "devices", COLUMNS, rows, wp.get_devices(), name="devices", **size)


if __name__ == "__main__":
    main()
