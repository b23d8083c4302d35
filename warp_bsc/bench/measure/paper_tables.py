"""The tables of the paper's benchmarks, made from their JSON."""

from collections.abc import Callable, Iterator
from typing import Any

from ...detection.run.settings import SURFACE_KINDS
from ..tables import Column, Table, count
from .detector import phase_columns
from .methods import METHODS, PHASES

DESCRIPTION = """\
Measure the paper's five benchmarks, on the candidate pairs of each scene: the
mean and the worst time of a query by this project's methods, by a
floating-point cubic solver, by the paper's own inside tests and, if installed,
by the IPC Toolkit's methods; the wrong results of each, found by exact
arithmetic; the phases that decide the queries; and the time of a detection by
phase. A scene is one of the five by name, or a scene of warp-bsc bench
detector. All five together need several minutes, with --quick one or two."""

EXAMPLES = """\
examples:
  warp-bsc bench
  warp-bsc bench --quick
  warp-bsc bench paper twisting crash:100000 --json times.json
  warp-bsc bench paper cloth.usd --device cpu --figure times.png"""


def _few_digits(number: float) -> str:
    """Returns a number without fraction, or with two digits if it is small, as times on a GPU are."""
    return f"{number:,.0f}" if number >= 10.0 else f"{number:.2g}"


def _method_columns(
    value: Callable[[Any, str], Any], format: str | Callable[[Any], str], ratios: dict[str, str] | None = None
) -> list[Column]:
    """Returns a column for each method, and one for each ratio of two.

    Args:
        value: Returns what a column shows, given a row and a method.
        format: How it shows that.
        ratios: Headers of ratios to ``float``, by the method.
    """
    return [
        Column(method.replace("conservative", "conserv."), lambda row, method=method: value(row, method), format)
        for method in METHODS
    ] + [
        Column(header, lambda row, method=method: value(row, method) / value(row, "float"), ".2f")
        for method, header in (ratios or {}).items()
    ]


_QUERIES = (
    Column("Triangles", "triangles"),
    Column("Intervals", lambda scene: len(scene["intervals"])),
    Column("Overlapping", "overlapping"),
    Column("Queries", lambda scene: sum(scene["queries"].values())),
    Column("Collisions", "collisions"),
    Column("Unsure", "unsure"),
)
_PHASE_NAMES = ("Axis\nboxes", "Bern-\nstein", "Direc-\ntion", "Classi-\nfied", "Subdi-\nvided", "\nExact")
_SHARES = [
    Column(header, lambda scene, phase=phase: scene["decided_by"][phase] / sum(scene["decided_by"].values()), ".2%")
    for phase, header in zip(PHASES, _PHASE_NAMES, strict=True)
]
_TIMES = _method_columns(
    lambda timing, method: timing["nanoseconds"][method],
    ",.2f",
    {"cubic": "cubic /\nfloat", "reduced": "reduced\n/ float"},
)
_SLOWEST = _method_columns(  # of the slowest query of each method
    lambda worst, method: worst[method]["nanoseconds"][method], _few_digits, {"cubic": "cubic /\nfloat"}
)
_SLOWEST_OF_ALL = (
    Column("Kind", lambda query: next(kind.display_name for kind in SURFACE_KINDS if kind.label == query["kind"])),
    Column("Number", "number", ""),
    *_method_columns(lambda query, method: query["nanoseconds"][method], _few_digits),
)
_ERRORS = (
    Column("Checked", "checked"),
    *_method_columns(
        lambda scene, method: scene["errors"][method],
        lambda errors: f"{errors['false_positives']:,} + {errors['false_negatives']:,}",
    ),
)
_IPC_TOOLKIT = (
    Column("ns a\nquery", "nanoseconds", ",.0f"),
    Column("Call,\nns", "call_nanoseconds", ",.0f"),
    Column("Checked", "checked"),
    Column("False\npos.", "false_positives"),
    Column("False\nneg.", "false_negatives"),
)


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement, a row a scene, and the lines around them."""
    rows = [(scene["name"], scene) for scene in found["scenes"]]
    timings = [[(name, scene["timings"][i]) for name, scene in rows] for i in range(len(rows[0][1]["timings"]))]
    caption = "Overlapping: pairs whose swept boxes overlap. Queries: a random part of them, measured below."
    yield Table("Scene", _QUERIES, rows, caption=caption)
    yield ""
    yield Table("Decided by", _SHARES, rows, caption="Shares of the queries, with method exact.")
    yield ""
    for of_place in timings:
        yield Table(f"ns a query, {of_place[0][1]['place']}", _TIMES, of_place)
        yield ""
    for adversarial in found["adversarial"]:
        place = adversarial["place"]
        slowest = [(name, row["worst"]) for name, scene in rows for row in scene["timings"] if row["place"] == place]
        yield from _show_slowest(place, [*slowest, ("adversarial", adversarial["worst"])])
    caption = "False positives + false negatives, of all collisions by any method and a random sample."
    yield Table("Wrong results", _ERRORS, rows, caption=caption)
    for name, scene in rows:
        if scene["disagreeing"]:
            yield f"{name}: {count(scene['disagreeing'], 'result')} depended on the device."
    yield ""
    phases = dict.fromkeys(phase for _, scene in rows for phase in scene["stage_milliseconds"])
    frames = [*phase_columns(phases, "stage_milliseconds"), Column("All", "frame_milliseconds", ",.2f")]
    place = timings[-1][0][1]["place"]
    yield Table(f"ms a frame, {place}", frames, rows, caption="The detector, with method exact.")
    yield ""
    took = [(f"{name}, {method}", took) for name, scene in rows for method, took in scene["ipc_toolkit"].items()]
    if took:
        caption = "Called query by query from Python; the time of a call for features far apart is subtracted."
        yield Table(f"IPC Toolkit {found['ipc_toolkit']}, 1 core", _IPC_TOOLKIT, took, caption=caption)
        yield ""
    yield "float, conservative, exact: this project's methods; all that is not certified free is a collision."
    yield "cubic: a floating-point cubic solver, as in Provot 1997, Bridson et al. 2002 and El Topo."
    yield "reduced: float with the inside tests of the paper's Sec. 3.5; like the paper, it does not subdivide."


def _show_slowest(place: str, slowest: list[tuple[str, dict[str, Any]]]) -> Iterator[Table | str]:
    """Yields the tables of the slowest queries at a place, of each scene and of all."""
    caption = "The slowest query of each method. In the paper: float 105, exact 876, El Topo's solver 953."
    yield Table(f"Slowest query, ns, {place}", _SLOWEST, slowest, caption=caption)
    yield ""
    rows = []
    for method in METHODS:
        name, worst = max(slowest, key=lambda named, method=method: named[1][method]["nanoseconds"][method])
        rows.append((f"{method}: {name}", worst[method]))
    yield Table("Slowest of all", _SLOWEST_OF_ALL, rows)
    yield ""
