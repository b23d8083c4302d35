"""Shows the measurements of the detector: tables for people, plain data for programs."""

import os
from dataclasses import asdict
from typing import Any

import warp as wp
from rich.console import Console

from ..bench.detector import DetectorBenchmark
from ..bench.provenance import shorten_path
from .tables import count, make_table, say

__all__ = ["detector_benchmarks_to_dict", "print_detector_benchmarks"]


def print_detector_benchmarks(
    console: Console, benchmarks: list[DetectorBenchmark], *, method: str, device: wp.Device, threads: int, repeat: int
) -> None:
    """Prints the counts and times of the detector, a row a scene.

    Args:
        console: The terminal or file to print to.
        benchmarks: The measurements of each scene.
        method: The method.
        device: The Warp device.
        threads: Number of CPU cores.
        repeat: Number of repetitions.
    """
    cores = count(threads, "core") if device.is_cpu else device.name
    say(console, f"Method {method} on {device}, {cores}; medians of {count(repeat, 'repetition')}")
    names = _shorten([benchmark.scene.name for benchmark in benchmarks])
    rows = list(zip(names, benchmarks, strict=True))

    table = make_table(
        "Scene",
        "Triangles",
        "Candidates",
        "Survivors",
        "Hits",
        "Unsure",
        caption="Hits: pairs that the method reports.",
    )
    for name, found in rows:
        numbers = [len(found.scene.faces), found.candidates, found.survivors, found.hits, found.unsure]
        table.add_row(name, *(f"{number:,}" for number in numbers))
    console.print(table)
    console.print()

    table = make_table(
        "Milliseconds",
        "Detect",
        "Detect\nand read",
        "CUDA\ngraph",
        "Million\npairs/s",
        "Memory\n[MiB]",
        caption="From positions on the device to results on the device, or read on the host.",
    )
    for name, took in rows:
        table.add_row(
            name,
            f"{took.detect_milliseconds:,.2f}",
            f"{took.read_milliseconds:,.2f}",
            "" if took.graph_milliseconds is None else f"{took.graph_milliseconds:,.2f}",
            f"{took.candidates_per_second / 1e6:,.1f}",
            "" if took.memory is None else f"{took.memory / 2**20:,.1f}",
        )
    console.print(table)
    console.print()

    stages = benchmarks[0].stage_milliseconds
    table = make_table("Milliseconds by stage", *("\n".join(stage.rsplit(" ", 1)) for stage in stages))
    for name, took in rows:
        table.add_row(name, *(f"{milliseconds:,.2f}" for milliseconds in took.stage_milliseconds.values()))
    console.print(table)

    compared = [(name, took, took.ipc_toolkit) for name, took in rows if took.ipc_toolkit]
    if compared:
        console.print()
        *_, other = compared[0]
        table = make_table(
            f"IPC Toolkit {other.version}",
            "Candidates",
            "Build",
            "Step\nsize",
            "Sum",
            "Detect",
            "Ratio",
            caption=f"Milliseconds on {count(other.threads, 'core')}; it finds only the earliest time of impact.",
        )
        for name, took, other in compared:
            table.add_row(
                name,
                f"{other.vertex_face_candidates + other.edge_edge_candidates:,}",
                *(
                    f"{milliseconds:,.1f}"
                    for milliseconds in (
                        other.build_milliseconds,
                        other.step_milliseconds,
                        other.milliseconds,
                        took.detect_milliseconds,
                    )
                ),
                f"{other.milliseconds / took.detect_milliseconds:,.1f}",
            )
        console.print(table)
    if not all(benchmark.certified for benchmark in benchmarks):
        say(console, "Not certified: collisions may be missing.")


def detector_benchmarks_to_dict(
    benchmarks: list[DetectorBenchmark], *, method: str, device: wp.Device, threads: int, repeat: int
) -> dict[str, Any]:
    """Returns the measurements as plain data for JSON. Arguments: as of :func:`print_detector_benchmarks`."""
    return {
        "benchmark": "detector",
        "method": method,
        "device": str(device),
        "device_name": device.name,
        "threads": threads,
        "repeat": repeat,
        "scenes": [
            {
                "scene": shorten_path(found.scene.name),
                "precision": found.precision,
                "triangles": len(found.scene.faces),
                "vertices": len(found.scene.x0),
                "candidates": found.candidates,
                "survivors": found.survivors,
                "hits": found.hits,
                "unsure": found.unsure,
                "vertex_face": asdict(found.vertex_face),
                "edge_edge": asdict(found.edge_edge),
                "earliest_toi": found.earliest_toi if found.hits else None,
                "certified": found.certified,
                "milliseconds": {
                    "detect": found.detect_milliseconds,
                    "detect_and_read": found.read_milliseconds,
                    "cuda_graph": found.graph_milliseconds,
                    "stages": found.stage_milliseconds,
                },
                "candidates_per_second": found.candidates_per_second,
                "memory_bytes": found.memory,
                "ipc_toolkit": asdict(found.ipc_toolkit) if found.ipc_toolkit else None,
            }
            for found in benchmarks
        ],
    }


def _shorten(scenes: list[str]) -> list[str]:
    """Returns the names of scenes without their folders."""
    return [",".join(os.path.basename(path) for path in scene.split(",")) for scene in scenes]
