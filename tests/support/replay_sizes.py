"""Measures ``warp-bsc replay`` on large, long and crowded scenes, which it makes, and prints a table.

``python tests/support/replay_sizes.py`` measures all of them, ``... sheets cubes --workers 2`` some. Each replay is a
process of its own. Memory is that of all its processes at the moment when it is largest: pages that several of them
share count once. With ``--folder``, scenes and results are kept there, and scenes that are there are not made again.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp
from measured import options_of, report
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from warp_bsc.bench.tables import Column

SAMPLING_SECONDS = 0.05


class Cost(NamedTuple):
    """Wall time and processor time [s], and the largest memory [bytes] of a replay, its hits and its file [bytes]."""

    wall: float
    cpu: float
    memory: int
    hits: int
    size: int


# Scenes ------------------------------------------------------------------------------------------------------------


def new_stage(path, frames):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(frames - 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def add_grid(stage, path, side):
    """A mesh of side x side quads without points; returns its points' attribute, and their places in [-1, 1]."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, side + 1)] * 2, indexing="ij")
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1, 1)
    quads = (corner + np.array([0, side + 1, side + 2, 1])).astype(np.int32)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(quads), 4, dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(quads.reshape(-1)))
    mesh.CreateSubdivisionSchemeAttr("none")
    return mesh.CreatePointsAttr(), x, y


def add_ball(stage, path, side=8):
    """A closed mesh of 2 side (side - 1) triangles, radius 0.4."""
    lengthwise, across = np.meshgrid(np.arange(side), np.arange(1, side), indexing="ij")
    theta, phi = np.pi * across / side, 2.0 * np.pi * lengthwise / side
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=2)
    points = 0.4 * np.concatenate([points.reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    ring = np.arange(side)[:, None] * (side - 1)
    following = np.roll(ring, -1)
    inner = np.arange(side - 2)
    top, bottom = side * (side - 1), side * (side - 1) + 1
    quads = np.stack([ring + inner, ring + inner + 1, following + inner + 1, following + inner], axis=2).reshape(-1, 4)
    caps = np.concatenate(
        [
            np.column_stack([np.full(side, top), ring, following]),
            np.column_stack([np.full(side, bottom), following + side - 2, ring + side - 2]),
        ]
    )
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateFaceVertexCountsAttr([4] * len(quads) + [3] * len(caps))
    mesh.CreateFaceVertexIndicesAttr(np.concatenate([quads.reshape(-1), caps.reshape(-1)]).tolist())
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    return mesh


def write_sheets(path, side=500, frames=21):
    """Two sheets of together 4 side^2 triangles, the waves of which pass through each other in every interval."""
    stage = new_stage(path, frames)
    for name, sign in (("/World/A", 1.0), ("/World/B", -1.0)):
        points, x, y = add_grid(stage, name, side)
        for frame in range(frames):
            z = sign * 0.02 * np.sin(31.0 * x + 7.0 * y + 0.027 * frame) + 0.003 * sign * np.cos(23.0 * y)
            values = np.stack([x, y, z], axis=2).reshape(-1, 3).astype(np.float32)
            points.Set(Vt.Vec3fArray.FromNumpy(values), frame)
    stage.Save()


def place(number, side):
    """The place of an instance in a cubic grid of balls that nearly touch."""
    return 0.85 * np.array([number % side, number // side % side, number // side**2])


def swing(number, frame):
    return 0.06 * np.sin(0.3 * frame + np.array([1.7, 2.3, 3.1]) * number)


def write_instances(path, count=2000, frames=49):
    """Native instances of a ball, each moved by a transform of its own."""
    stage = new_stage(path, frames)
    stage.CreateClassPrim("/Ball")
    add_ball(stage, "/Ball/Mesh")
    for number in range(count):
        prim = UsdGeom.Xform.Define(stage, f"/World/Ball{number}")
        prim.GetPrim().GetReferences().AddInternalReference("/Ball")
        prim.GetPrim().SetInstanceable(True)
        translate = prim.AddTranslateOp()
        for frame in range(frames):
            translate.Set(Gf.Vec3d(*(place(number, 13) + swing(number, frame)).tolist()), frame)
    stage.Save()


def write_instancer(path, count=2000, frames=49):
    """The same balls, placed by one point instancer."""
    stage = new_stage(path, frames)
    stage.OverridePrim("/Balls")
    add_ball(stage, "/Balls/Mesh")
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Instancer")
    instancer.CreatePrototypesRel().SetTargets([Sdf.Path("/Balls/Mesh")])
    instancer.CreateProtoIndicesAttr([0] * count)
    for frame in range(frames):
        positions = np.array([place(number, 13) + swing(number, frame) for number in range(count)], dtype=np.float32)
        instancer.CreatePositionsAttr().Set(Vt.Vec3fArray.FromNumpy(positions), frame)
    stage.Save()


def write_meshes(path, count=500, frames=100, side=10):
    """Waving sheets beside and above each other, each a mesh with points of its own."""
    stage = new_stage(path, frames)
    for number in range(count):
        points, x, y = add_grid(stage, f"/World/Sheet{number}", side)
        dx, dy, dz = 1.9 * (number % 5), 1.9 * (number // 5 % 5), 0.12 * (number // 25)
        for frame in range(frames):
            z = dz + 0.06 * np.sin(3.0 * x + 2.0 * y + 0.2 * frame + number)
            values = np.stack([x + dx, y + dy, z], axis=2).reshape(-1, 3).astype(np.float32)
            points.Set(Vt.Vec3fArray.FromNumpy(values), frame)
    stage.Save()


def write_intervals(path, frames=2001, side=20):
    """A small scene of many intervals: two waving sheets of together 4 side^2 triangles."""
    stage = new_stage(path, frames)
    for number in range(2):
        points, x, y = add_grid(stage, f"/World/Sheet{number}", side)
        for frame in range(frames):
            z = 0.2 * np.sin(3.0 * x + 0.03 * frame + 2.0 * number)
            values = np.stack([x, y, z], axis=2).reshape(-1, 3).astype(np.float32)
            points.Set(Vt.Vec3fArray.FromNumpy(values), frame)
    stage.Save()


def write_cubes(path, side=10, frames=20):
    """Unit cubes that touch exactly; sines move each one within its layer, so that layers slide on each other.

    OpenUSD's ``usdDancingCubesExample`` is of this kind: a grid of cubes, moved and delayed by their place.
    """
    stage = new_stage(path, frames)
    for i, j, k in np.ndindex(side, side, side):
        cube = UsdGeom.Cube.Define(stage, f"/World/Cube_{i}_{j}_{k}")
        cube.CreateSizeAttr(1.0)
        translate = cube.AddTranslateOp()
        for frame in range(frames):
            angle = 2.0 * np.pi * (frame / 24.0 + (i + j + k) / (3.0 * side))
            translate.Set(Gf.Vec3d(i + 0.5 * np.sin(angle), j + 0.5 * np.sin(2.0 * angle), k), frame)
    stage.Save()


SCENES = {
    "sheets": (write_sheets, "1,000,000 triangles, 20 intervals"),
    "instances": (write_instances, "2,000 instances, 48 intervals"),
    "instancer": (write_instancer, "2,000 instances by an instancer, 48 intervals"),
    "meshes": (write_meshes, "500 meshes, 99 intervals"),
    "intervals": (write_intervals, "1,600 triangles, 2,000 intervals"),
    "cubes": (write_cubes, "1,000 touching cubes, 19 intervals"),
}


# Measurement -------------------------------------------------------------------------------------------------------


def memory_of(process):
    """Bytes of a process and its descendants, each page that some of them share as one."""
    total = 0
    try:
        with open(f"/proc/{process}/smaps_rollup") as file:
            total += sum(1024 * int(line.split()[1]) for line in file if line.startswith("Pss:"))
        for task in os.listdir(f"/proc/{process}/task"):
            with open(f"/proc/{process}/task/{task}/children") as file:
                total += sum(memory_of(int(child)) for child in file.read().split())
    except OSError:  # it has ended
        pass
    return total


def measure(command):
    """Runs a command and returns its wall time, processor time and memory, as of :class:`Cost`."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    largest, ended = 0, threading.Event()

    def sample():
        nonlocal largest
        while not ended.wait(SAMPLING_SECONDS):
            largest = max(largest, memory_of(process.pid))

    sampler = threading.Thread(target=sample)
    sampler.start()
    _, status, usage = os.wait4(process.pid, 0)
    ended.set()
    sampler.join()
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"exit status {process.returncode} of {' '.join(command)}")
    return time.perf_counter() - started, usage.ru_utime + usage.ru_stime, max(largest, 1024 * usage.ru_maxrss)


def replay(folder, name, options):
    """Replays a scene, which it writes if it is not there, to a file of columns."""
    write, _ = SCENES[name]
    scene, hits = folder / f"{name}.usdc", folder / f"{name}.npz"
    if not scene.exists():
        unfinished = folder / f"unfinished_{name}.usdc"
        write(unfinished)
        unfinished.rename(scene)
    command = [sys.executable, "-m", "warp_bsc", "replay", str(scene), "--npz", str(hits), "--device", "cpu"]
    cost = measure([*command, *options])
    with np.load(hits) as columns:
        found = json.loads(str(columns["facts"]))["hits"]
    return Cost(*cost, found, hits.stat().st_size)


COLUMNS = (
    Column("", "description", kind="word"),
    Column("hits", "hits"),
    Column("wall", "wall", "{:.1f} s".format),
    Column("processor", "cpu", "{:.1f} s".format),
    Column("memory", lambda row: f"{row['memory'] / 1e6:,.0f} MB"),
    Column("file", lambda row: f"{row['size'] / 1e6:,.2f} MB"),
)


def main():
    """Measures scenes."""
    parser = options_of(__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument("--folder", type=Path, help="keeps scenes and results there")
    parser.add_argument("--workers", default="1", help="processes that check intervals (default: 1)")
    arguments = parser.parse_args()
    if unknown := set(arguments.scenes) - SCENES.keys():
        parser.error(f"no scene is named {', '.join(sorted(unknown))}")
    found = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        for name in arguments.scenes or SCENES:
            cost = replay(folder, name, ["--workers", arguments.workers])
            found.append({"scene": name, "description": SCENES[name][1], **cost._asdict()})
    workers = {"workers": arguments.workers}
    report(arguments, "replay_sizes", "scene", COLUMNS, found, [wp.get_device("cpu")], **workers)


if __name__ == "__main__":
    main()
