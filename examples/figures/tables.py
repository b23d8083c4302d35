"""Writes the tables of measurements in the pages, from the files that the commands of the page of measurements wrote.

    python examples/figures/tables.py              # --check: writes nothing, and fails if the page would change

A table of a page stands between ``<!-- table: NAME -->`` and ``<!-- end -->``, with lines below it that say where its
figures come from. Its files are in ``warp_bsc/bench/measurements``; where one is missing, the table stays as it is.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import table_rows
from table_rows import Found, Rows

from warp_bsc._atomic_file import OutputFile
from warp_bsc.bench.measure.penetration import SCENES
from warp_bsc.bench.measure.repair import FILE, KNOWN_MESH

ROOT = Path(__file__).resolve().parents[2]
_GUIDES = "contacts", "gradients", "reports", "turning_bodies"
PAGES = [
    ROOT / "README.md",
    ROOT / "docs" / "index.md",
    ROOT / "docs" / "detectors.md",
    ROOT / "docs" / "intersections.md",
    ROOT / "docs" / "measurements.md",
    *(ROOT / "docs" / "newton" / f"{name}.md" for name in _GUIDES),
]
MEASUREMENTS = ROOT / "warp_bsc" / "bench" / "measurements"
_COMPARED = {
    "ccd_peers": {"ipctk": "IPC Toolkit"},
    "detector": {"ipctk": "IPC Toolkit"},
    "intersections": {title: title for title in table_rows.ASKED},
    "penetration": {"mujoco": "MuJoCo", "pyuipc": "libuipc"},
    "repair": {"ipctk": "IPC Toolkit"},
}
"""Libraries that a benchmark compares with, with their titles."""
_BUSY = 2.0
"""Load of a machine before a measurement from which on the line below its table says so."""
_BLOCK = re.compile(r"(<!-- table: (\S+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Table:
    """A table of a page.

    Attributes:
        files: Names of its measurements, without ending.
        make: Returns its rows, given the measurements in the same order.
        needs_all: Whether the table needs all of its files, not only one.
        has_sources: Whether the line below it says where its figures come from; else that of a later table does.
    """

    files: tuple[str, ...]
    make: Callable[..., Rows]
    needs_all: bool = True
    has_sources: bool = True


_PENETRATION = tuple(f"penetration_{scene}" for scene in SCENES)
_INVERTING = tuple(f"inverting_steps_{name}" for name in ("scenes", "hanging", "dropping"))


TABLES = {
    "front": Table(("penetration_twist", "penetration_drape"), table_rows.front, has_sources=False),
    "front_detector": Table(("detector_gpu", "detector_two_cores"), table_rows.front_detector, has_sources=False),
    "arc_cost_cpu": Table(("arc_cost_cpu", "arc_cost_large_cpu"), table_rows.arc_cost),
    "detectors": Table(("ccd_peers_cpu",), table_rows.detectors, has_sources=False),
    "detectors_missed": Table(("ccd_peers_cpu",), table_rows.detectors_missed),
    "certify": Table(tuple(f"certify_{seed}_gpu" for seed in range(11, 15)), table_rows.certify),
    "given_queries": Table(("given_queries_one_core",), table_rows.given_queries),
    "detector": Table(("detector_gpu", "detector_two_cores", "detector_one_core"), table_rows.detector),
    "detector_stages": Table(("detector_gpu", "detector_worlds_gpu"), table_rows.detector_stages),
    "gradients": Table(("gradients_cpu",), table_rows.gradients),
    "newton_coupled": Table(("newton_coupled_gpu",), table_rows.newton),
    "newton_gpu": Table(("newton_twist_gpu", "newton_gpu"), table_rows.newton),
    "intersections": Table(("intersections_cpu",), table_rows.intersections, has_sources=False),
    "intersections_by_definition": Table(
        ("intersections_cpu",), lambda found: table_rows.intersections(found, by_definition=True), has_sources=False
    ),
    "intersection_times": Table(("intersections_cpu",), table_rows.intersection_times),
    "inverting_steps": Table(_INVERTING, table_rows.inverting_steps),
    "paper": Table(("paper_cpu",), table_rows.paper),
    "penetration": Table(_PENETRATION, table_rows.penetration, needs_all=False, has_sources=False),
    "penetration_costs": Table(_PENETRATION, table_rows.penetration_costs, needs_all=False, has_sources=False),
    "penetration_simulators": Table(_PENETRATION, table_rows.penetration_simulators, needs_all=False),
    "queries": Table(("queries_gpu", "queries_one_core"), table_rows.queries),
    "repair_drape": Table(("repair_drape_cpu",), lambda found: table_rows.repair_named(found, FILE)),
    "repair_known": Table(("repair_bodies_cpu",), lambda found: table_rows.repair_named(found, KNOWN_MESH, FILE)),
    "repair_random": Table(("repair_random_cpu",), table_rows.repair_random),
    "repair_shots": Table(("repair_shots_cpu",), table_rows.repair_shots),
    "replay_sizes": Table(("replay_sizes",), table_rows.replay_sizes),
    "response_cpu": Table(("response_cpu", "response_gpu"), table_rows.response),
    "response_gpu": Table(("response_gpu",), lambda found: table_rows.response(found, found)),
    "response_style3d_cpu": Table(("response_style3d_cpu", "response_style3d_gpu"), table_rows.response),
    "response_style3d_gpu": Table(("response_style3d_gpu",), lambda found: table_rows.response(found, found)),
    "touching": Table(("touching",), table_rows.touching),
    "worlds_throughput_cpu": Table(("worlds_throughput_cpu",), table_rows.worlds_throughput),
}
"""The tables of all pages by name."""


def load(name: str) -> Found | None:
    """Returns a measurement, None if there is none.

    Raises:
        ValueError: If it was interrupted, or its record is missing.
    """
    path = MEASUREMENTS / f"{name}.json"
    if not path.exists():
        return None
    found = json.loads(path.read_text())
    if found.get("partial"):
        raise ValueError(f"{path.name}: the measurement was interrupted")
    if "record" not in found:
        raise ValueError(f"{path.name}: has no record of where it comes from")
    return found


def describe(found: Found) -> str:
    """Returns where a measurement comes from, in a line."""
    record = found["record"]
    commit = f"commit {record['commit'][:7]}" if record["commit"] else "not from a checkout"
    machine = ", ".join(record["gpus"]) or f"{record['cpu']}, {record['cores']} cores"
    if (record.get("load") or 0.0) >= _BUSY:
        machine += f" shared with other programs (load {record['load']})"
    names = {"warp-lang": "Warp", "newton": "Newton"} | _COMPARED.get(found["benchmark"], {})
    used = ", ".join(f"{title} {record['versions'].get(name, 'none')}" for name, title in names.items())
    changed = " with changes" if record["changed"] else ""
    return f"*`{record['command']}`: {record['date'][:10]}, {commit}{changed}, {machine}, {used}*"


def make(name: str) -> str | None:
    """Returns a table with the lines below it, None if a measurement of it is missing.

    Raises:
        ValueError: If there is no such table, or a measurement cannot be used.
    """
    if name not in TABLES:
        raise ValueError(f"no table is named {name}, only {', '.join(TABLES)}")
    table = TABLES[name]
    loaded = [load(file) for file in table.files]
    measurements = [found for found in loaded if found is not None]
    if len(measurements) < (len(loaded) if table.needs_all else 1):
        return None
    head, *rows = table.make(*measurements)
    lines = [head, ("---",) * len(head), *rows]
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    if not table.has_sources:
        return text
    return text + "\n" + "  \n".join(_joined(list(dict.fromkeys(map(describe, measurements))))) + "\n"


def _joined(lines: list[str]) -> list[str]:
    """Returns lines that differ in one word as one line, with all of these words."""
    words = [line.split(" ") for line in lines]
    differing = {i for line in words for i, word in enumerate(line) if i >= len(words[0]) or word != words[0][i]}
    if len(differing) != 1 or len({len(line) for line in words}) != 1:
        return lines
    (place,) = differing
    end = "`:" if words[0][place].endswith("`:") else ""  # of the command
    words[0][place] = "|".join(line[place].removesuffix(end) for line in words) + end
    return [" ".join(words[0])]


def update(page: str) -> tuple[str, list[str]]:
    """Returns a page with its tables made anew, and the names of those that stay as they are."""
    kept = []

    def replace(block: re.Match) -> str:
        made = make(block[2])
        if made is None:
            kept.append(block[2])
            return block[0]
        return f"{block[1]}\n{made}\n{block[4]}"  # with blank lines, without which some programs see no table

    return _BLOCK.sub(replace, page), kept


def main() -> int:
    """Writes the pages, or checks them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a page would change")
    arguments = parser.parse_args()
    differ = False
    for page in PAGES:
        before = page.read_text()
        after, kept = update(before)
        for name in kept:
            missing = [file for file in TABLES[name].files if not (MEASUREMENTS / f"{file}.json").exists()]
            print(f"{name} stays as it is: there is no {', '.join(f'{file}.json' for file in missing)}")
        if after == before:
            continue
        differ = True
        if arguments.check:
            print(f"{page.relative_to(ROOT)} is not what its measurements make: run python examples/figures/tables.py")
        else:
            _write(page, after)
    return int(arguments.check and differ)


def _write(page: Path, text: str) -> None:
    file = OutputFile(page)
    try:
        file.write(text)
        file.commit()
    finally:
        file.discard()


if __name__ == "__main__":
    sys.exit(main())
