"""The rows of the tables of measurements, each made from what commands wrote with ``--json``."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from warp_bsc.bench.measure import given_queries as given
from warp_bsc.bench.measure.detector import phase_columns
from warp_bsc.bench.measure.penetration import SIMULATORS
from warp_bsc.bench.measure.repair import FILE, KNOWN_MESH, STRAIN, RepairRun, summarize
from warp_bsc.bench.peers.ipc_toolkit import ipc_milliseconds
from warp_bsc.bench.tables import Column, grouped, two

Found = dict[str, Any]
"""A measurement: what a command wrote with --json."""
Rows = list[tuple[str, ...]]
"""The rows of a table, the header first."""


def three(value: float) -> str:
    """Returns a number with three digits, more if it is large."""
    return f"{value:,.0f}" if value >= 99.5 else f"{value:#.3g}"


def milliseconds(value: float) -> str:
    """Returns a time with three digits, in seconds from 0.1 s on."""
    return f"{value / 1e3:.3g} s" if value >= 100.0 else f"{value:.3g} ms"


def percent(value: float) -> str:
    """Returns a percentage with two digits, more if it is large."""
    return f"{two(value)}%"


def markdown(first: str, columns: Iterable[Column], rows: Iterable[tuple[str, Any]]) -> Rows:
    """Returns the rows of a table.

    Args:
        first: Header of the names of the rows.
        columns: The other columns.
        rows: The name of each row, and a value of which the columns show parts.
    """
    columns = list(columns)
    head = first, *(column.header if column.title is None else column.title for column in columns)
    return [head, *((name, *(column.cell(row, page=True) for column in columns)) for name, row in rows)]


def pivot(runs: Iterable[Found], row: str, column: str) -> dict[str, Found]:
    """Returns runs by the values of two keys."""
    return {name: {run[column]: run for run in group} for name, group in grouped(runs, row).items()}


# Intersections -----------------------------------------------------------------------------------------------------


ASKED = "CGAL", "IPC Toolkit", "libigl", "MeshFix", "MeshLib", "Open3D", "PyMeshLab", "trimesh", "trueform", "VTK"
"""Tools that are asked beside this package."""


def _answer(answers: list[bool] | None) -> str:
    if answers is None:
        return ""
    yes = sum(answers)
    return ("no", "yes")[answers[0]] if yes in (0, len(answers)) else f"yes {yes} of {len(answers)}"


def intersections(found: Found, by_definition: bool = False) -> Rows:
    """Answers to the question whether a mesh intersects itself; those that are wrong by every definition are bold."""
    rows = [("mesh", "right", *found["cases"][0]["answers"])]
    for case in found["cases"]:
        if case["by_definition"] == by_definition:
            answers = {title: _answer(given) for title, given in case["answers"].items()}
            if not by_definition:
                answers |= {title: f"**{answers[title]}**" for title in case["wrong"]}
            rows.append((case["name"], ("no", "yes")[case["intersects"]], *answers.values()))
    return rows


def intersection_times(found: Found) -> Rows:
    """Times of tools by the number of triangles, and that of the query alone in the largest mesh."""
    rows = found["times"]
    times = {title: [row["seconds"].get(title) for row in rows] for title in rows[0]["seconds"]}

    def cell(time: Found | None, key: str = "total") -> str:
        return milliseconds(1e3 * time[key]) if time else ""

    sizes = [f"{row['triangles']:,}" for row in rows]
    head = "tool", f"{sizes[0]} triangles", *sizes[1:], f"{sizes[-1]}, the query alone"
    return [head, *((title, *map(cell, given), cell(given[-1], "query")) for title, given in times.items())]


# Detection ---------------------------------------------------------------------------------------------------------


_MESHES = {"227.ply": "cloth-funnel", "cloth_ball92.ply": "cloth-ball"}
"""Names of the scenes of two frames by their first file; the ends of paths, as these differ from machine to machine."""


def _scene_name(scene: Found) -> str:
    name, _, worlds = scene["scene"].partition(" in ")
    first = Path(name.split(",")[0]).name
    title = _MESHES.get(first, first.partition(":")[0]) + (f" in {worlds}" if worlds else "")
    return f"{title}, {scene['triangles']:,} triangles"


def detector(gpu: Found, two_cores: Found, one_core: Found) -> Rows:
    """Detections on a GPU and on the CPU, beside the IPC Toolkit."""
    places, peers = ("GPU", "two cores", "one core"), {1: "IPC Toolkit, two cores", 2: "one core"}
    columns = [Column(name, f"0.{name}") for name in ("candidates", "hits")]
    columns += [Column(place, f"{i}.milliseconds.detect", milliseconds) for i, place in enumerate(places)]
    columns += [
        Column(place, lambda row, i=i: ipc_milliseconds(row[i]["ipc_toolkit"]), milliseconds)
        for i, place in peers.items()
    ]
    rows = zip(gpu["scenes"], two_cores["scenes"], one_core["scenes"], strict=False)
    return markdown("scene", columns, [(_scene_name(row[0]), row) for row in rows])


def detector_stages(gpu: Found, worlds: Found) -> Rows:
    """Where the time of a detection goes on a GPU."""
    phases = [phase for phase in gpu["scenes"][0]["milliseconds"]["stages"] if phase not in ("sort", "exact")]
    columns = [Column("whole graph", "cuda_graph", ",.2f"), *phase_columns(phases, "stages")]
    scenes = (*gpu["scenes"], *worlds["scenes"])
    rows = [(f"{_scene_name(scene)}, {scene['hits']:,} hits", scene["milliseconds"]) for scene in scenes]
    return markdown("scene", columns, rows)


def queries(gpu: Found, one_core: Found) -> Rows:
    """Elementary queries a second."""
    titles = {
        "status": "one kernel that calls `ccd_edge_edge` or `ccd_vertex_face`",
        "queued": "a second kernel decides the survivors",
        "exact": "queries that are UNSURE in floating point, in exact arithmetic",
    }
    rows = [
        (title + place, {kind["kind"]: kind["modes"][mode]["queries_per_second"] for kind in found["kinds"]})
        for mode, title in titles.items()
        for found, place in ((gpu, ""), (one_core, ", on one core of the CPU"))
    ]

    def rate(number: float) -> str:
        return f"{number / 1e9:.1f} billion" if number >= 1e9 else f"{number / 1e6:.3g} million"

    return markdown("queries", [Column(f"{kind}, a second", kind, rate) for kind in ("edge-edge", "vertex-face")], rows)


def certify(*runs: Found) -> Rows:
    """Answers of adversarial queries by method, of all runs together."""
    titles = {"float": "`float`", "conservative": "`conservative`", "user's kernel": "a kernel with `ccd_*`"}
    answers = {
        "FREE": "free",
        "HIT": "hit",
        "UNSURE": "unsure",
        "FREE, but colliding": "missed",
        "HIT, but free": "false",
    }
    columns = [Column(title, lambda row, key=key: sum(run[key] for run in row)) for title, key in answers.items()]
    methods = {method: [run["methods"][method] for run in runs] for method in runs[0]["methods"]}
    rows = [(titles.get(method, "exact arithmetic on the device"), row) for method, row in methods.items()]
    return markdown("answers by", columns, rows)


DETECTORS = {
    "exact": "`exact`",
    "conservative": "`conservative`, the default",
    "float": "`float`",
    "cubic": "cubic solver",
    "Tight Inclusion": "IPC Toolkit, Tight Inclusion",
    "Tight Inclusion, rescaling 1": "the same, `conservative_rescaling=1`",
    "additive": "IPC Toolkit, additive",
}


def detectors(found: Found) -> Rows:
    """Queries that detectors miss, report falsely and do not decide, hand-made and adversarial ones."""
    parts = {"hand-made": [], "adversarial": []}
    for row in found["rows"]:
        parts["hand-made" if row["queries"] == "hand-made" else "adversarial"].append(row)

    def total(rows: Iterable[Found], key: str, detector: str = "exact") -> str:
        return f"{sum(row[key] for row in rows if row['detector'] == detector):,}"

    head = ["detector"]
    for name, rows in parts.items():
        head += [f"{name}: missed of {total(rows, 'colliding')}", f"false of {total(rows, 'free')}", "late"]
    return [
        tuple(head),
        *(
            (title, *(total(rows, key, name) for rows in parts.values() for key in ("missed", "false", "late")))
            for name, title in DETECTORS.items()
        ),
    ]


def detectors_missed(found: Found) -> Rows:
    """Misses by the generator of adversarial queries, of the detectors that miss any."""
    runs = pivot((row for row in found["rows"] if row["queries"] != "hand-made"), "queries", "detector")
    names = [name for name in DETECTORS if any(row[name]["missed"] for row in runs.values())]
    columns = [Column(DETECTORS[name], lambda row, name=name: row[name]["missed"]) for name in names]
    rows = [
        (f"`{queries}`, {row['exact']['colliding']:,} collide", row)
        for queries, row in runs.items()
        if any(row[name]["missed"] for name in names)
    ]
    return markdown("queries", columns, rows)


def given_queries(found: Found) -> Rows:
    """Times of a query of public files by method, on one core."""
    titles = {"queries": "hand-made", "cloth-funnel": "simulated (cloth-funnel)"}
    rows = [
        (f"{titles.get(row['name'], row['name'])}, {row['queries']:,} {row['kind']}", row) for row in found["queries"]
    ]
    return markdown("queries", given.COLUMNS, rows)


def paper(found: Found) -> Rows:
    """Times of a query on one core in the scenes of the paper."""
    titles = {"float": "`float`", "conservative": "`conservative`", "exact": "`exact`", "cubic": "cubic solver"}
    columns = [Column(title, f"nanoseconds.{method}", ".1f") for method, title in titles.items()]
    columns += [
        Column("cubic / `float`", lambda row: row["nanoseconds"]["cubic"] / row["nanoseconds"]["float"], ".1f"),
        Column(
            "slowest query, `float` / cubic",
            "worst",
            lambda worst: " / ".join(f"{worst[name]['nanoseconds'][name]:.0f}" for name in ("float", "cubic")),
        ),
    ]
    rows = [(f"{scene['name']}, {scene['triangles']:,} triangles", scene["timings"][0]) for scene in found["scenes"]]
    return markdown("scene", columns, rows)


def touching(found: Found) -> Rows:
    """Sheets that touch exactly."""
    titles = {
        "intersections": "`find_intersections`",
        "at a distance, at rest": "`exact` at their minimum distance, at rest",
        "at a distance, moving": "the same, moving together",
    }
    columns = (
        Column("pairs", "pairs"),
        Column("wrong of those checked", "wrong"),
        Column("time", "seconds", lambda seconds: f"{two(seconds)} s"),
    )
    rows = [
        (f"{titles[row['question']]}: {row['sheets']} sheets of {row['faces']:,} faces", row) for row in found["rows"]
    ]
    return markdown("flat sheets in the same plane", columns, rows)


# Newton ------------------------------------------------------------------------------------------------------------


def newton(*measurements: Found) -> Rows:
    """Newton's examples, plain, with the stage, and with :class:`warp_bsc.SolverImplicit` in place of VBD."""
    titles = {"plain": "plain: ms a frame (95th percentile); crossings", "stage": "with `SolverCCD`"}
    if any(run["mode"] == "implicit" for found in measurements for run in found["runs"]):
        titles["implicit"] = "with `SolverImplicit` in place of VBD"
    columns = [Column(title, mode, _newton_cell) for mode, title in titles.items()]
    columns.append(Column("steps", lambda row: _newton_steps(*(row[mode]["measured"] for mode in titles))))
    rows = []
    for name, row in (item for found in measurements for item in pivot(found["runs"], "example", "mode").items()):
        frames = next((run["measured"]["frames"] for run in row.values() if run["measured"]), None)
        rows.append((f"`{name}`" + (f", {frames} frames" if frames else ""), row))
    return markdown("example", columns, rows)


def _newton_cell(run: Found) -> str:
    took = run["measured"]
    if took is None:
        return f"not run: {run['problem']}"
    times = took["milliseconds"]
    return f"{times['median']:,.1f} ({times['percentile_95']:,.1f}); {took['most_crossings']:,}"


def _newton_steps(plain: Found | None, stage: Found | None, implicit: Found | None = None) -> str:
    """Returns what the stage reports, and how the example's own tests end."""
    if stage is None or stage["stage"] is None:
        return ""
    steps = stage["stage"]
    words = [f"{steps['steps'] - steps['uncertified_steps']:,} of {steps['steps']:,} certified"]
    if steps.get("substepped_steps"):  # of versions whose stage chose substeps
        words.append(f"{steps['substepped_steps']:,} in substeps")
    words.append(f"{steps['truncated_steps'] or 'none'} truncated")
    if steps["frozen_steps"]:
        words.append(f"{steps['frozen_steps']} with frozen vertices")
    if implicit:
        steps = implicit["stage"]
        words.append(f"`SolverImplicit` {steps['steps'] - steps['uncertified_steps']:,} of {steps['steps']:,}")
    tests = [_newton_tests(took) for took in (plain, stage, implicit) if took]
    return f"{', '.join(words)}; tests {' / '.join(dict.fromkeys(tests))}"


def _newton_tests(took: Found) -> str:
    ends = {took["test_post_step"], took["test_final"]} - {None}
    return "none" if not ends else "ok" if ends == {"ok"} else "fail"


_SCENES_IN_CONTACT = {
    "sphere": "a cloth drapes over it",
    "box_edge": "a cloth hangs across it",
    "tube_cone": "a tube is pulled over a cone",
    "fold": "a plate folds a cloth",
    "soft_bowl": "a soft block falls into a bowl",
    "pile": "five soft cubes",
    "press": "a soft block, with room",
    "press_tight": "without room",
    "ropes": "across a cloth",
    "ball": "moved by the program at 40 m/s",
    "ball_two_way": "34 g at 40 m/s",
    "worlds": "eight, two of them reset",
}


def response(found: Found, reference: Found) -> Rows:
    """Scenes in contact by configuration, beside a reference at small steps."""
    titles = {
        "plain": "Newton's contacts",
        "self-contact": "with VBD's self-contact",
        "stage": "`SolverCCD`, default",
        "implicit": "`SolverImplicit`",
    }
    runs = pivot(found["runs"], "scene", "configuration")
    measured = {run["scene"]: run["measured"] for run in reference["runs"] if run["configuration"] == "reference"}
    columns = [
        Column(title, name, _response_cell)
        for name, title in titles.items()
        if any(name in row for row in runs.values())
    ]
    rate = next(iter(measured.values()))["rate"]
    columns.append(Column(f"reference, 1/{rate} s", "of reference", _stretch_and_speed))
    rows = [
        (f"{scene}: {_SCENES_IN_CONTACT[scene]}", row | {"of reference": measured[scene]})
        for scene, row in runs.items()
    ]
    return markdown("scene", columns, rows)


def _response_cell(run: Found) -> str:
    took, distance = run["measured"], run.get("from_converged")
    mean = "" if took["uncertified_steps"] is None else f" ({three(took['milliseconds']['mean'])})"
    parts = [_stretch_and_speed(took), f"{three(took['milliseconds']['median'])}{mean} ms"]
    counts = {"crossings": "crossings", "collisions": "pairs meet", "uncertified_steps": "steps not certified"}
    parts += [f"{took[key]:,} {title}" for key, title in counts.items() if took[key]]
    if run["configuration"] == "implicit" and distance is not None:
        parts.append(f"{two(distance)} mm from the converged run")
    return "; ".join(parts)


def _stretch_and_speed(took: Found) -> str:
    return f"{two(took['stretch_at_end'])}, {percent(took['stretch_at_most'])}; {took['rest_speed']:,.0f} mm/s"


def arc_cost(small: Found, large: Found) -> Rows:
    """Times of steps and detections by arcs, beside those by chords."""
    degrees = f"{small['degrees']:g} degrees"
    titles = {
        f"ball, {degrees} a step": f"a cloth on a ball that the program turns by {degrees} a step",
        "ball, nothing turns": "the same, the ball does not turn",
        "boxes that tumble": "nine boxes that tumble on a sheet",
        "detect": "one `detect(rigid_motion=)` of the first: nearly all contacts are on arcs",
    }
    columns = [Column("triangles of the cloth", "triangles")]
    columns += [Column(key, key, milliseconds) for key in ("arcs", "chords")]
    columns.append(Column("ratio", lambda row: row["arcs"] / row["chords"], ".2f"))
    rows = []
    for found in (small, large):
        times = {row["name"]: row["milliseconds"] | {"triangles": 2 * found["cells"] ** 2} for row in found["rows"]}
        rows += [(title, times[name]) for name, title in titles.items()]
    return markdown("scene", columns, rows)


def worlds_throughput(found: Found) -> Rows:
    """Steps a second by the number of worlds, and crossings."""
    titles = {
        "VBD": "VBD, Newton's contacts",
        "VBD, self-contact": "with VBD's self-contact",
        "SolverCCD(VBD)": "`SolverCCD`",
        "SolverImplicit": "`SolverImplicit`",
    }

    def cell(row: Found) -> str:
        return f"{three(row['steps_per_second']['clock'])} ({row['crossings']:,})"

    columns = [
        Column(f"{number:,}", lambda runs, number=number: runs[number], cell)
        for number in dict.fromkeys(row["worlds"] for row in found["rows"])
    ]
    runs = pivot(found["rows"], "solver", "worlds")
    return markdown("worlds", columns, [(title, runs[name]) for name, title in titles.items()])


def gradients(found: Found) -> Rows:
    """Digits to which gradients and central differences agree, by input and scene."""
    columns = [Column(scene.replace("_", " "), f"{scene}.shown") for scene in found["scenes"]]
    return markdown("input", columns, [(re.sub(r"^\w+_\w+", r"`\g<0>`", row["input"]), row) for row in found["rows"]])


def inverting_steps(*measurements: Found) -> Rows:
    """Tetrahedra that steps invert, by what the stage does about them, and times of steps."""
    titles = {"plain": "VBD, Newton's contacts"} | {
        name: f'`"{name}"`' for name in ("allowed", "reported", "prevented")
    }
    scenes = {"throw": "throw: a block of 2,560 tetrahedra flies at a ball at 20 m/s"}

    def cell(run: Found) -> str:
        many = f" in {run['inverting_steps']} steps" if run["inverted"] else ""
        cut = f", {run['truncated_steps']} steps with cut paths" if run["truncated_steps"] else ""
        return f"{run['inverted']:,}{many} ({three(run['milliseconds'])} ms){cut}"

    runs = [
        run
        | {"title": f"{scenes.get(run['scene'], run['scene'])}, {run['steps']:,}"}
        | ({"mode": "allowed"} if run["mode"] == "left" else {})  # its name in older files
        for found in measurements
        for run in found["rows"]
    ]
    columns = [Column(title, mode, cell) for mode, title in titles.items()]
    return markdown("scene, steps", columns, pivot(runs, "title", "mode").items())


def penetration(*measurements: Found) -> Rows:
    """Who penetrates, where: crossings in the worst frame and in all, and pairs that meet on the way."""
    return _by_scene(
        measurements,
        lambda took: f"{max(took['crossings']):,}; {sum(took['crossings']):,}; {took['collisions']:,}",
    )


def penetration_costs(*measurements: Found) -> Rows:
    """What simulators keep of speed, tetrahedra and lengths, and their time."""

    def cell(took: Found) -> str:
        kept = "" if took["speed_kept"] is None else f"{percent(100.0 * took['speed_kept'])} kept, "
        inverted = f"{max(took['inverted'])} inverted, " if max(took["inverted"]) else ""
        return f"{kept}{inverted}{percent(took['stretch'])}, {two(took['milliseconds']['median'])} ms"

    return _by_scene(measurements, cell)


def penetration_simulators(*measurements: Found) -> Rows:
    """Settings and claims of simulators, and what they did not run."""

    def not_run(runs: list[Found]) -> str:
        missing = grouped(
            ({"scene": run["scene"], "reason": run["problem"].partition(": ")[0]} for run in runs if run["problem"]),
            "reason",
        )
        scenes = {reason: ", ".join(run["scene"] for run in group) for reason, group in missing.items()}
        return "; ".join(
            f"{reason} ({scenes[reason] if len(group) < len(runs) else 'all'})" for reason, group in missing.items()
        )

    runs = grouped((run for found in measurements for run in found["runs"]), "simulator")
    simulators = _joined(measurements, "simulators")
    columns = (
        Column("version", lambda name: ", ".join({r["measured"]["version"] for r in runs[name] if r["measured"]})),
        Column("settings", lambda name: simulators[name]["settings"]),
        Column("says of penetration", lambda name: SIMULATORS[name].claims or "nothing"),  # not measured
        Column("not run", lambda name: not_run(runs[name])),
    )
    return markdown("simulator", columns, [(simulators[name]["title"], name) for name in simulators])


def _joined(measurements: Iterable[Found], key: str) -> Found:
    """Returns what measurements have at a key, together."""
    return {name: value for found in measurements for name, value in found[key].items()}


def _by_scene(measurements: Iterable[Found], cell: Callable[[Found], str]) -> Rows:
    """Returns a row for each simulator, and a column for each scene."""

    def write(run: Found) -> str:
        return cell(run["measured"]) if run["measured"] else "not run"

    runs = pivot((run for found in measurements for run in found["runs"]), "simulator", "scene")
    columns = [
        Column(scene, lambda row, scene=scene: row.get(scene, {"measured": None}), write)
        for scene in _joined(measurements, "scenes")
    ]
    titles = _joined(measurements, "simulators").items()
    return markdown("simulator", columns, [(simulator["title"], runs.get(name, {})) for name, simulator in titles])


# Repair and replay -------------------------------------------------------------------------------------------------


_MESH_COLUMNS = (
    Column("vertices", "0.vertices"),
    Column("crossings", lambda row: f"{row[0].crossings:,} to {row[1].crossings:,}"),
    Column("largest, mean move", lambda row: f"{two(row[1].largest_move)}, {two(row[1].mean_move)}"),
    Column("strain", "1.strain", lambda strain: f"{two(100.0 * strain)}%"),
    Column("time", "1.seconds", "{:.2f} s".format),
)
"""Columns of a run and an attempt."""
_COST_COLUMNS = (
    Column("freed", "{0[freed]} of {0[meshes]}".format),
    Column("crossings", "crossings", "{0[0]:,} to {0[1]:,}".format),
    Column("largest move, median and most", "move", lambda ends: ", ".join(map(two, ends))),
    Column("strain, median and most", "strain", lambda ends: f"{two(100.0 * ends[0])}, {two(100.0 * ends[1])}%"),
    Column(f"more than {100 * STRAIN:.0f}%", "strained"),
    Column("median time", "seconds", "{:.2f} s".format),
)
"""Columns of what ``summarize`` returns."""


def repair_named(found: Found, *kinds: str) -> Rows:
    """Repairs of known meshes or files, each with every hint that was tried."""
    rows = []
    for run in (RepairRun.of_json(run) for run in found["runs"] if run["kind"] in kinds):
        for attempt in run.attempts:
            hint = "" if attempt.hint == "none" else f", `{attempt.hint}=`"
            rows.append((f"{Path(run.name).stem}{hint}", (run, attempt)))
    return markdown("`bsc.repair`", _MESH_COLUMNS, rows)


def repair_random(found: Found) -> Rows:
    """Random damage by kind."""
    runs = [RepairRun.of_json(run) for run in found["runs"] if run["kind"] not in (KNOWN_MESH, FILE)]
    return markdown("kind", _COST_COLUMNS, [(kind, summarize(group)) for kind, group in grouped(runs, "kind").items()])


def repair_shots(found: Found) -> Rows:
    """Repairs of shots: what collides before and after, moves, edges, and times beside those of the replay."""

    def each(row: Found, what: str) -> str:
        return milliseconds(1e3 * row["seconds"][what] / row["intervals"])

    columns = [
        Column(title, lambda row, key=key: f"{row['before'][key]:,} to {row['left'][key]:,}")
        for title, key in {"collisions": "collisions", "edges in faces": "intersections"}.items()
    ]
    columns += [
        Column("largest, mean move", lambda row: f"{row['largest_move']:.2f}, {row['mean_move']:.2f}"),
        Column("edges", lambda row: f"{row['shortest_edge']:.2f} to {row['longest_edge']:.2f}"),
        Column("an interval; its replay", lambda row: f"{each(row, 'repairing')}; {each(row, 'finding')}"),
        Column("multiple", lambda row: row["seconds"]["repairing"] / row["seconds"]["finding"], ".1f"),
    ]
    rows = [
        (
            f"`{' '.join((row['shot'], *row['options']))}`, {row['intervals']} intervals, {row['vertices']:,} vertices",
            row,
        )
        for row in found["rows"]
    ]
    return markdown("shot", columns, rows)


def replay_sizes(found: Found) -> Rows:
    """Large, long and crowded scenes."""
    seconds = "{:.1f} s".format
    columns = (
        Column("collisions", "hits"),
        Column("wall", "wall", seconds),
        Column("processor", "cpu", seconds),
        Column("memory", "memory", lambda size: f"{size / 1e9:.2f} GB"),
        Column("file", "size", lambda size: f"{size / 1e6:.1f} MB"),
    )
    return markdown("scene", columns, [(f"`{row['scene']}`: {row['description']}", row) for row in found["rows"]])


# The front page -----------------------------------------------------------------------------------------------------


def front(twist: Found, drape: Found) -> Rows:
    """What the front page shows of simulations: what passes through, and beside it the price."""
    names = {
        "vbd": "VBD",
        "vbd-self-contact": "VBD, self-contact",
        "ccd-vbd": "`SolverCCD(VBD)`",
        "implicit": "`SolverImplicit`",
    }
    rows = [(f"a second, on an {twist['device_name'].removeprefix('NVIDIA ')}", *names.values())]
    for found, title in ((twist, "a cloth is wrung"), (drape, "a cloth drapes over a ball")):
        took = {run["simulator"]: run["measured"] for run in found["runs"] if run["measured"]}
        rows.append(
            (f"{title}: edges through faces in the worst frame", *(f"{max(took[k]['crossings'])}" for k in names))
        )
        seconds = {key: 1e-3 * took[key]["milliseconds"]["mean"] * took[key]["steps"] for key in names}
        rows.append(("its steps, and their time", *(f"{took[k]['steps']}, {two(seconds[k])} s" for k in names)))
    return rows


def front_detector(gpu: Found, two_cores: Found) -> Rows:
    """What the front page shows of the detector."""
    ball, on_gpu = (
        next(scene for scene in found["scenes"] if _scene_name(scene).startswith("cloth-ball"))
        for found in (two_cores, gpu)
    )
    counts = f"{ball['candidates'] / 1e6:.1f} million candidates, {ball['hits']:,} contacts"
    name = gpu["record"]["gpus"][0].removeprefix("NVIDIA ")
    return [
        (f"{ball['triangles']:,} triangles, {counts}", "time"),
        (f"all contacts, with time and normal, on an {name}", f"{on_gpu['milliseconds']['cuda_graph']:.1f} ms"),
        ("the same on two cores", milliseconds(ball["milliseconds"]["detect"])),
        (
            "the earliest time alone, by the IPC Toolkit on two cores",
            milliseconds(ipc_milliseconds(ball["ipc_toolkit"])),
        ),
    ]
