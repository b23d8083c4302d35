"""The command ``warp-bsc bench detector``: measures the detector on scenes."""

import argparse
import importlib.util
import os
from collections.abc import Generator
from dataclasses import asdict
from typing import Any

import warp as wp

from ..bench.measure.detector import DetectorBenchmark, benchmark_detector
from ..bench.record import shorten_path
from ..bench.scenes.detector import BenchmarkScene, default_scenes, is_scene_name, load_scene
from ..bench.timing import count_threads, limited_threads
from .bench import JSON_FILE, Benchmark, check_json, measure_each, name_place, report_runs, stage_columns
from .device import find_device, load_detector, loading_kernels
from .options import THREADS, detection_options, flag, natural, number, positive, repeat_options, several
from .tables import Column, Console, count, print_table, say

__all__ = ["BENCHMARK"]

_DESCRIPTION = """\
Measure the detector, from positions on the device to results on the device and
on the host. A scene is one interval of a USD file; two mesh files joined by a
comma; or generated: cloth:TRIANGLES, a wrinkled sheet that
folds onto itself, or crash:TRIANGLES, a thin tube that is crushed. Default:
cloth_twist.usd if this is a checkout, cloth:5000 and cloth:50000."""

_EXAMPLES = """\
  warp-bsc bench detector
  warp-bsc bench detector cloth.usd --interval 3
  warp-bsc bench detector first.ply,second.ply crash:1100000 --device cuda:0
  warp-bsc bench detector cloth:50000 --device cpu --threads 1 --compare
  warp-bsc bench detector cloth:1000 --worlds 1024 --device cuda:0
  warp-bsc bench detector --json times.json"""

_COUNTS = (
    Column("Triangles", lambda found: len(found.scene.faces)),
    Column("Candidates", "candidates"),
    Column("Survivors", "survivors"),
    Column("Hits", "hits"),
    Column("Unsure", "unsure"),
)
_TIMES = (
    Column("Detect", "detect_milliseconds", ",.2f"),
    Column("Detect\nand read", "read_milliseconds", ",.2f"),
    Column("CUDA\ngraph", "graph_milliseconds", ",.2f"),
    Column("Million\npairs/s", lambda found: found.candidates_per_second / 1e6, ",.1f"),
    Column("Memory\n[MiB]", lambda found: found.memory and found.memory / 2**20, ",.1f"),
)
_COMPARED = (
    Column("Candidates", lambda a: a.ipc_toolkit.vertex_face_candidates + a.ipc_toolkit.edge_edge_candidates),
    Column("Build", "ipc_toolkit.build_milliseconds", ",.1f"),
    Column("Step\nsize", "ipc_toolkit.step_milliseconds", ",.1f"),
    Column("Sum", "ipc_toolkit.milliseconds", ",.1f"),
    Column("Detect", "detect_milliseconds", ",.1f"),
    Column("Ratio", lambda found: found.ipc_toolkit.milliseconds / found.detect_milliseconds, ",.1f"),
)


def _run(arguments: argparse.Namespace) -> None:
    if arguments.compare and arguments.worlds > 1:
        raise ValueError("--compare and --worlds exclude each other: the IPC Toolkit has no worlds")
    check_json(arguments.json, is_scene_name, "a scene", "scenes")
    if arguments.compare and importlib.util.find_spec("ipctk") is None:
        raise ValueError("--compare needs the IPC Toolkit: pip install 'warp-bsc[bench]'")
    scenes = [load_scene(name, interval=arguments.interval) for name in arguments.scenes or default_scenes()]
    scenes = [scene.in_worlds(arguments.worlds) for scene in scenes]
    device = find_device(arguments.device)
    with limited_threads(arguments.threads):
        settings = {"method": arguments.method, "threads": count_threads(), "repeat": arguments.repeat}
        place = name_place(device, settings["threads"])
        report_runs(
            arguments,
            device,
            _measure(scenes, arguments, device),
            name="detector",
            heading=f"Method {arguments.method} on {place}; medians of {count(arguments.repeat, 'repetition')}",
            show=_show,
            to_dict=lambda benchmarks: settings | {"scenes": [_scene_to_dict(found) for found in benchmarks]},
        )


def _measure(
    scenes: list[BenchmarkScene], arguments: argparse.Namespace, device: wp.Device
) -> Generator[DetectorBenchmark, None, None]:
    with loading_kernels(device):
        for dtype in {scene.x0.dtype for scene in scenes}:
            load_detector(arguments.method, dtype, device)
    options = {"method": arguments.method, "device": device, "repeat": arguments.repeat, "compare": arguments.compare}

    def measure(scene: BenchmarkScene, progress: object) -> DetectorBenchmark:
        return benchmark_detector(scene, **options)

    cases = [(scene,) for scene in scenes]
    yield from measure_each(cases, measure, device, title=lambda scene: scene.name, holds=False)


def _show(console: Console, benchmarks: list[DetectorBenchmark]) -> None:
    """Prints the counts and times of the detector, a row a scene."""
    rows = [(_shorten(found.scene.name), found) for found in benchmarks]
    print_table(console, "Scene", _COUNTS, rows, caption="Hits: pairs that the method reports.")
    console.print()
    caption = "From positions on the device to results on the device, or read on the host."
    print_table(console, "Milliseconds", _TIMES, rows, caption=caption)
    console.print()
    print_table(console, "Milliseconds by stage", stage_columns(benchmarks), rows)
    if other := benchmarks[0].ipc_toolkit if benchmarks else None:
        console.print()
        caption = f"Milliseconds on {count(other.threads, 'core')}; it finds only the earliest time of impact."
        print_table(console, f"IPC Toolkit {other.version}", _COMPARED, rows, caption=caption)
    if not all(found.certified for found in benchmarks):
        say(console, "Not certified: collisions may be missing.")


def _scene_to_dict(found: DetectorBenchmark) -> dict[str, Any]:
    names = "precision", "candidates", "survivors", "hits", "unsure", "certified", "candidates_per_second"
    return {name: getattr(found, name) for name in names} | {
        "scene": shorten_path(found.scene.name),
        "triangles": len(found.scene.faces),
        "vertices": len(found.scene.x0),
        "vertex_face": asdict(found.vertex_face),
        "edge_edge": asdict(found.edge_edge),
        "earliest_toi": found.earliest_toi if found.hits else None,
        "milliseconds": {
            "detect": found.detect_milliseconds,
            "detect_and_read": found.read_milliseconds,
            "cuda_graph": found.graph_milliseconds,
            "stages": found.stage_milliseconds,
        },
        "memory_bytes": found.memory,
        "ipc_toolkit": asdict(found.ipc_toolkit) if found.ipc_toolkit else None,
    }


def _shorten(scene: str) -> str:
    """Returns the name of a scene without folders."""
    return ",".join(os.path.basename(path) for path in scene.split(","))


BENCHMARK = Benchmark(
    _run,
    _DESCRIPTION,
    _EXAMPLES,
    {
        "scenes": several("SCENE", "the scenes to measure"),
        "--interval": number(natural, "interval of a USD file, counted from 0 (default: 0)", default=0),
        "--worlds": number(
            positive, "worlds with the scene, which do not collide with each other (default: 1)", default=1
        ),
        **repeat_options(5),
        **THREADS,
        "--compare": flag(
            "measure the IPC Toolkit's candidates and collision-free step size as well, on the CPU; needs ipctk"
        ),
        **detection_options("conservative"),
        **JSON_FILE,
    },
)
