"""Shows what the queries of a file or a benchmark found: tables for people, plain data for programs."""

import os
from dataclasses import asdict, dataclass

from rich.console import Console
from rich.table import Table

from ..bench.detector import DetectorBenchmark
from ..bench.queries import MODES, SEED, QueryBenchmark
from ..detection.query import QueryResult
from .query_file import QueryFile
from .tables import count, make_table, say

__all__ = [
    "QueryAnswers",
    "detector_benchmarks_to_dict",
    "print_detector_benchmarks",
    "print_queries",
    "print_query_benchmarks",
    "queries_to_dict",
    "query_benchmarks_to_dict",
]

_STATUS = ("free", "hit", "unsure")  # by the value of query_vertex_face(...).status


@dataclass(frozen=True)
class QueryAnswers:
    """The answers to the queries of a file.

    Attributes:
        file: The queries.
        result: Their answers.
        milliseconds: Time that these took [ms].
    """

    file: QueryFile
    result: QueryResult
    milliseconds: float

    @property
    def hits(self) -> int:
        """Number of queries answered with a collision."""
        return int(self.result.hit.sum())

    @property
    def certified(self) -> dict[str, int]:
        """How many queries floating point could certify to be free, to be hits, and neither."""
        return {name: int((self.result.status == code).sum()) for code, name in enumerate(_STATUS)}

    @property
    def confusion(self) -> dict[str, int]:
        """How many answers are true and false, positives and negatives, where the truth is known."""
        hit, truth = self.result.hit, self.file.truth
        return {
            "true_positives": int((hit & truth).sum()),
            "false_positives": int((hit & ~truth).sum()),
            "true_negatives": int((~hit & ~truth).sum()),
            "false_negatives": int((~hit & truth).sum()),
        }


def print_queries(console: Console, answers: list[QueryAnswers], *, method: str, device: str) -> None:
    """Print the answers to query files, and how they compare with the truth where it is known.

    Args:
        console: Where to.
        answers: Those to each file.
        method: The method that was used.
        device: The device that was used.
    """
    folder = os.path.commonpath([answer.file.path.absolute().parent for answer in answers])
    say(console, f"{count(len(answers), 'file')} in {folder}; method {method} on {device}")
    say(console, "Free, hit and unsure: what floating point could certify, whatever the method.")
    table = make_table("File", "Queries", "Hits", "Free", "Hit", "Unsure", "ms")
    _add_files(
        table,
        folder,
        [(a.file, [len(a.file.points), a.hits, *a.certified.values(), a.milliseconds]) for a in answers],
    )
    console.print(table)

    known = [answer for answer in answers if answer.file.truth is not None]
    if known:
        table = make_table("Against the truth", "True\npos.", "False\npos.", "True\nneg.", "False\nneg.")
        _add_files(table, folder, [(answer.file, list(answer.confusion.values())) for answer in known])
        console.print()
        console.print(table)
    for answer in known:
        if answer.file.truth_path != answer.file.path:
            say(console, f"Truth of {answer.file.path.name} from {answer.file.truth_path.name}.")


def queries_to_dict(answers: list[QueryAnswers], *, method: str, device: str) -> dict:
    """Every answer, to be written as JSON. Arguments as of :func:`print_queries`."""
    return {
        "method": method,
        "device": device,
        "files": [
            {
                "path": str(answer.file.path),
                "kind": answer.file.kind,
                "queries": len(answer.file.points),
                "hits": answer.hits,
                "certified": answer.certified,
                "truth_path": str(answer.file.truth_path) if answer.file.truth_path else None,
                "confusion": answer.confusion if answer.file.truth is not None else None,
                "milliseconds": answer.milliseconds,
                "hit": answer.result.hit.tolist(),
                "status": [_STATUS[status] for status in answer.result.status],
                "toi": [toi if toi <= 1.0 else None for toi in answer.result.toi.tolist()],
            }
            for answer in answers
        ],
    }


def print_detector_benchmarks(
    console: Console, benchmarks: list[DetectorBenchmark], *, method: str, device, threads: int, repeat: int
) -> None:
    """Print what the detector found and what it took, scene by scene.

    Args:
        console: Where to.
        benchmarks: The measurements of each scene.
        method: The method that was used.
        device: The Warp device that was used.
        threads: How many CPU cores were used.
        repeat: How many repetitions the medians are of.
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
        caption="From positions on the device to results there, or read on the host.",
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
            caption=f"Milliseconds on {count(other.threads, 'core')}, for the earliest time of impact only.",
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
        say(console, "Not certified, collisions may be missing.")


def detector_benchmarks_to_dict(
    benchmarks: list[DetectorBenchmark], *, method: str, device, threads: int, repeat: int
) -> dict:
    """Every measurement, to be written as JSON. Arguments as of :func:`print_detector_benchmarks`."""
    return {
        "benchmark": "detector",
        "method": method,
        "device": str(device),
        "device_name": device.name,
        "threads": threads,
        "repeat": repeat,
        "scenes": [
            {
                "scene": found.scene.name,
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


def print_query_benchmarks(
    console: Console, benchmarks: list[QueryBenchmark], *, copy_rate: float, device, threads: int, repeat: int
) -> None:
    """Print how many elementary queries a second were answered, and what the answers were.

    Args:
        console: Where to.
        benchmarks: The measurements of each kind of query.
        copy_rate: Bytes that the device reads and writes when it copies [1/s].
        device: The Warp device that was used.
        threads: How many CPU cores were used.
        repeat: How many repetitions the medians are of.
    """
    cores = count(threads, "core") if device.is_cpu else device.name
    say(console, f"Random queries on {device}, {cores}; medians of {count(repeat, 'repetition')}")
    caption = "Survivors: queries that the culls leave."
    table = make_table("Kind", "Queries", "Survivors", "Share", "Free", "Hit", "Unsure", caption=caption)
    for found in benchmarks:
        numbers = [len(found.status), found.survivors, found.free, found.hits, found.unsure]
        number, survivors, *answers = (f"{number:,}" for number in numbers)
        table.add_row(found.kind, number, survivors, f"{found.survivor_share:.1%}", *answers)
    console.print(table)
    console.print()

    table = make_table(
        "Mode",
        "ms",
        "Million\nqueries/s",
        "Bytes\na query",
        "GB/s",
        "Share of\ncopying",
    )
    for took in benchmarks:
        for mode, milliseconds in took.milliseconds.items():
            rate = took.bytes_per_second[mode]
            table.add_row(
                f"{took.kind}, {mode}",
                f"{milliseconds:,.2f}",
                f"{took.queries_per_second[mode] / 1e6:,.1f}",
                str(MODES[mode]),
                f"{rate / 1e9:,.1f}",
                f"{rate / copy_rate:.1%}",
            )
    console.print(table)
    console.print()
    say(console, "status: the status of a query, one thread each.")
    say(console, "impact: its time of impact, coordinates and normal too.")
    say(console, "queued: its status, by one kernel that culls and one for the survivors.")
    say(console, "exact: its status in integers, where floating point leaves it open.")
    say(console, f"Copying reads and writes {copy_rate / 1e9:,.1f} GB/s here.")


def query_benchmarks_to_dict(
    benchmarks: list[QueryBenchmark], *, copy_rate: float, device, threads: int, repeat: int
) -> dict:
    """Every measurement, to be written as JSON. Arguments as of :func:`print_query_benchmarks`."""
    return {
        "benchmark": "queries",
        "device": str(device),
        "device_name": device.name,
        "threads": threads,
        "repeat": repeat,
        "seed": SEED,
        "copy_bytes_per_second": copy_rate,
        "kinds": [
            {
                "kind": found.kind,
                "queries": len(found.status),
                "survivors": found.survivors,
                "survivor_share": found.survivor_share,
                "certified": {"free": found.free, "hit": found.hits, "unsure": found.unsure},
                "modes": {
                    mode: {
                        "milliseconds": milliseconds,
                        "queries_per_second": found.queries_per_second[mode],
                        "bytes_per_query": MODES[mode],
                        "bytes_per_second": found.bytes_per_second[mode],
                        "share_of_copy": found.bytes_per_second[mode] / copy_rate,
                    }
                    for mode, milliseconds in found.milliseconds.items()
                },
            }
            for found in benchmarks
        ],
    }


def _add_files(table: Table, folder: str, rows: list[tuple[QueryFile, list[int | float]]]):
    """Add a row for each file, and the total of many."""

    def format_all(numbers):
        return [f"{number:,.1f}" if isinstance(number, float) else f"{number:,}" for number in numbers]

    for file, numbers in rows:
        table.add_row(os.path.relpath(file.path.with_suffix(""), folder), *format_all(numbers))
    if len(rows) > 1:
        table.add_section()
        table.add_row("all", *format_all(map(sum, zip(*(numbers for _, numbers in rows), strict=True))))


def _shorten(scenes: list[str]) -> list[str]:
    """Names of scenes without their folders."""
    return [",".join(os.path.basename(path) for path in scene.split(",")) for scene in scenes]
