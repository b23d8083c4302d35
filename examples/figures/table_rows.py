"""The rows of the tables of measurements, each made from what commands wrote with ``--json``."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from warp_bsc.bench.measure.penetration import SIMULATORS
from warp_bsc.bench.measure.repair import FILE, KNOWN_MESH

Found = dict[str, Any]
"""A measurement: what a command wrote with --json."""
Rows = list[tuple[str, ...]]
"""The rows of a table, the header first."""


def milliseconds(value: float) -> str:
    """Returns a time with three digits, in seconds from 0.1 s on."""
    return f"{value / 1e3:.3g} s" if value >= 100.0 else f"{value:.3g} ms"


def digits(value: float) -> str:
    """Returns a number with two digits, more if it is large."""
    return f"{value:#.2g}".rstrip(".") if abs(value) < 99.5 else f"{value:,.0f}"


def _counts(values: Any) -> str:
    """Returns the smallest and the largest of some numbers."""
    return f"{min(values):,} to {max(values):,}"


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
    rows = [("scene", "candidates", "hits", "GPU", "two cores", "one core", "IPC Toolkit, two cores", "one core")]
    for scenes in zip(gpu["scenes"], two_cores["scenes"], one_core["scenes"], strict=False):
        first = scenes[0]
        times = [scene["milliseconds"]["detect"] for scene in scenes]
        times += [
            scene["ipc_toolkit"]["build_milliseconds"] + scene["ipc_toolkit"]["step_milliseconds"]
            for scene in scenes[1:]
        ]
        counts = [f"{first[name]:,}" for name in ("candidates", "hits")]
        rows.append((_scene_name(first), *counts, *map(milliseconds, times)))
    return rows


def detector_stages(gpu: Found, worlds: Found) -> Rows:
    """Where the time of a detection goes on a GPU."""
    stages = [stage for stage in gpu["scenes"][0]["milliseconds"]["stages"] if stage not in ("sort", "exact")]
    rows = [("scene", "whole graph", *stages)]
    for scene in (*gpu["scenes"], *worlds["scenes"]):
        took = scene["milliseconds"]
        numbers = [took["cuda_graph"], *(took["stages"][stage] for stage in stages)]
        rows.append((f"{_scene_name(scene)}, {scene['hits']:,} hits", *(f"{number:.2f}" for number in numbers)))
    return rows


def queries(gpu: Found, one_core: Found) -> Rows:
    """Elementary queries a second."""
    titles = {
        "status": "one kernel that calls `ccd_edge_edge` or `ccd_vertex_face`",
        "queued": "a second kernel decides the survivors",
        "exact": "queries that are UNSURE in floating point, in exact arithmetic",
    }
    rows = [("queries", "edge-edge, a second", "vertex-face, a second")]
    for mode, title in titles.items():
        for found, place in ((gpu, ""), (one_core, ", on one core of the CPU")):
            rates = {kind["kind"]: kind["modes"][mode]["queries_per_second"] for kind in found["kinds"]}
            rows.append((title + place, *(_rate(rates[kind]) for kind in ("edge-edge", "vertex-face"))))
    return rows


def certify(*runs: Found) -> Rows:
    """Answers of adversarial queries by method, of all runs together."""
    titles = {"float": "`float`", "conservative": "`conservative`", "user's kernel": "a kernel with `ccd_*`"}
    rows = [("answers by", "FREE", "HIT", "UNSURE", "FREE, but colliding", "HIT, but free")]
    for method in runs[0]["methods"]:
        answers = [run["methods"][method] for run in runs]
        sums = (sum(answer[key] for answer in answers) for key in ("free", "hit", "unsure", "missed", "false"))
        rows.append((titles.get(method, "exact arithmetic on the device"), *(f"{number:,}" for number in sums)))
    return rows


def _rate(number: float) -> str:
    return f"{number / 1e9:.1f} billion" if number >= 1e9 else f"{number / 1e6:.3g} million"


def given_queries(found: Found) -> Rows:
    """Times of a query of public files by method, on one core."""
    methods = ("float", "conservative", "exact")
    rows = [
        ("queries", "collide", *(f"`{name}`" for name in methods), "cubic solver", "`float` / cubic", "`exact` / cubic")
    ]
    titles = {"queries": "hand-made", "cloth-funnel": "simulated (cloth-funnel)"}
    for row in found["queries"]:
        took = row["nanoseconds"]
        rows.append(
            (
                f"{titles.get(row['name'], row['name'])}, {row['queries']:,} {row['kind']}",
                f"{100.0 * row['hits'] / row['queries']:.0f}%",
                *(digits(took[name]) for name in (*methods, "cubic")),
                *(digits(took[name] / took["cubic"]) for name in ("float", "exact")),
            )
        )
    return rows


def paper(found: Found) -> Rows:
    """Times of a query on one core in the scenes of the paper."""
    methods = {"float": "`float`", "conservative": "`conservative`", "exact": "`exact`", "cubic": "cubic solver"}
    rows = [("scene", *methods.values(), "cubic / `float`", "slowest query, `float` / cubic")]
    for scene in found["scenes"]:
        timing = scene["timings"][0]
        took, worst = timing["nanoseconds"], timing["worst"]
        slowest = (worst[method]["nanoseconds"][method] for method in ("float", "cubic"))
        rows.append(
            (
                f"{scene['name']}, {scene['triangles']:,} triangles",
                *(f"{took[method]:.1f}" for method in methods),
                f"{took['cubic'] / took['float']:.1f}",
                " / ".join(f"{time:.0f}" for time in slowest),
            )
        )
    return rows


def touching(found: Found) -> Rows:
    """Sheets that touch exactly."""
    titles = {
        "intersections": "`find_intersections`",
        "at a distance, at rest": "`exact` at their minimum distance, at rest",
        "at a distance, moving": "the same, moving together",
    }
    rows = [("flat sheets in the same plane", "pairs", "wrong of those checked", "time")]
    for row in found["rows"]:
        title = f"{titles[row['question']]}: {row['sheets']} sheets of {row['faces']:,} faces"
        rows.append((title, f"{row['pairs']:,}", str(row["wrong"]), f"{digits(row['seconds'])} s"))
    return rows


# Newton ------------------------------------------------------------------------------------------------------------


def newton(*measurements: Found) -> Rows:
    """Newton's examples, plain, with the stage, and with :class:`warp_bsc.SolverImplicit` in place of VBD."""
    titles = {"plain": "plain: ms a frame (95th percentile); crossings", "stage": "with `SolverCCD`"}
    if any(run["mode"] == "implicit" for found in measurements for run in found["runs"]):
        titles["implicit"] = "with `SolverImplicit` in place of VBD"
    rows = [("example", *titles.values(), "steps")]
    for found in measurements:
        modes: dict[str, dict[str, Found]] = {}
        for run in found["runs"]:
            modes.setdefault(run["example"], {})[run["mode"]] = run
        for name, run in modes.items():
            cells = [_newton_cell(run[mode]) for mode in titles]
            frames = next((r["measured"]["frames"] for r in run.values() if r["measured"]), None)
            title = f"`{name}`" + (f", {frames} frames" if frames else "")
            rows.append((title, *cells, _newton_steps(*(run[mode]["measured"] for mode in titles))))
    return rows


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
    ends = [took["test_post_step"], took["test_final"]]
    if all(end is None for end in ends):
        return "none"
    return "ok" if all(end in (None, "ok") for end in ends) else "fail"


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
    runs = {(run["scene"], run["configuration"]): run for run in found["runs"]}
    measured = {run["scene"]: run["measured"] for run in reference["runs"] if run["configuration"] == "reference"}
    columns = [name for name in titles if any(name == configuration for _, configuration in runs)]
    rows = [("scene", *(titles[name] for name in columns), f"reference, 1/{next(iter(measured.values()))['rate']} s")]
    for scene in dict.fromkeys(scene for scene, _ in runs):
        cells = [_response_cell(runs[scene, name]) for name in columns]
        rows.append((f"{scene}: {_SCENES_IN_CONTACT[scene]}", *cells, _stretch_and_speed(measured[scene])))
    return rows


def _response_cell(run: Found) -> str:
    took, distance = run["measured"], run.get("from_converged")
    mean = "" if took["uncertified_steps"] is None else f" ({_three(took['milliseconds']['mean'])})"
    parts = [_stretch_and_speed(took), f"{_three(took['milliseconds']['median'])}{mean} ms", *_what_passed(took)]
    if run["configuration"] == "implicit" and distance is not None:
        parts.append(f"{digits(distance)} mm from the converged run")
    return "; ".join(parts)


def _stretch_and_speed(took: Found) -> str:
    return f"{_stretches(took)}; {took['rest_speed']:,.0f} mm/s"


def _stretches(took: Found) -> str:
    return f"{digits(took['stretch_at_end'])}, {digits(took['stretch_at_most'])}%"


def _what_passed(took: Found) -> list[str]:
    counts = ("crossings", "crossings"), ("collisions", "pairs meet"), ("uncertified_steps", "steps not certified")
    return [f"{took[key]:,} {title}" for key, title in counts if took[key]]


def _three(value: float) -> str:
    return f"{value:,.0f}" if value >= 99.5 else f"{value:#.3g}"


def implicit_accuracy(found: Found) -> Rows:
    """Residuals of VBD's steps, and errors of gradients through them."""
    scenes = {
        "hanging": "a hanging cloth",
        "slope": "a cloth on a slope, with friction",
        "block": "a soft block on the ground",
        "drape": "a cloth on a sphere, behind `SolverCCD(..., substeps=2)`",
        "patches": "two patches that collide, behind `SolverCCD`",
    }
    inputs = {
        "tri_materials": "stretch",
        "tet_materials": "stretch",
        "edge_bending_properties": "bending",
        "particle_mass": "mass",
        "shape_material_mu": "friction",
    }
    rows = [("scene", "10 iterations", "20 iterations", "20 and `polish=3`", "materials, with `polish=3`")]
    for name, title in scenes.items():
        runs = [run for run in found["rows"] if run["scene"] == name]
        errors = [f"{run['residual']:.2g}; {digits(100.0 * run['velocity'])}%" for run in runs]
        materials = [f"{inputs[key]} {digits(100.0 * runs[-1][key])}%" for key in inputs if key in runs[-1]]
        rows.append((title, *errors, ", ".join(materials)))
    return rows


def implicit_time(found: Found) -> Rows:
    """Times of a step of VBD on a tape and back."""
    rows = [("scene", "VBD", "on a tape", "back", "VBD with `polish=3`")]
    for row in found["rows"]:
        title = row["scene"].replace("hanging", "a hanging cloth").replace("on a sphere", "a cloth on a sphere")
        rows.append((title, *(_three(time) for time in row["milliseconds"].values())))
    return rows


def arc_cost(small: Found, large: Found) -> Rows:
    """Times of steps and detections by arcs, beside those by chords."""
    degrees = f"{small['degrees']:g} degrees"
    titles = {
        f"ball, {degrees} a step": f"a cloth on a ball that the program turns by {degrees} a step",
        "ball, nothing turns": "the same, the ball does not turn",
        "boxes that tumble": "nine boxes that tumble on a sheet",
        "detect": "one `detect(arcs=)` of the first: nearly all contacts are on arcs",
    }
    rows = [("scene", "triangles of the cloth", "arcs", "chords", "ratio")]
    for found in (small, large):
        times = {row["name"]: row["milliseconds"] for row in found["rows"]}
        for name, title in titles.items():
            arcs, chords = times[name]["arcs"], times[name]["chords"]
            ratio = f"{arcs / chords:.2f}"
            rows.append((title, f"{2 * found['cells'] ** 2:,}", milliseconds(arcs), milliseconds(chords), ratio))
    return rows


def worlds_throughput(found: Found) -> Rows:
    """Steps a second by the number of worlds, and crossings."""
    titles = {
        "VBD": "VBD, Newton's contacts",
        "VBD, self-contact": "with VBD's self-contact",
        "SolverCCD(VBD)": "`SolverCCD`",
        "SolverImplicit": "`SolverImplicit`",
    }
    clock = "processor" if not found["record"]["gpus"] else "clock"
    cells = {
        (row["solver"], row["worlds"]): f"{_three(row['steps_per_second'][clock])} ({row['crossings']:,})"
        for row in found["rows"]
    }
    worlds = list(dict.fromkeys(number for _, number in cells))
    rows = [("worlds", *(f"{number:,}" for number in worlds))]
    return rows + [(title, *(cells[name, number] for number in worlds)) for name, title in titles.items()]


def inverting_steps(*measurements: Found) -> Rows:
    """Tetrahedra that steps invert, by what the stage does about them, and times of steps."""
    titles = {"plain": "VBD, Newton's contacts", "left": '`"left"`', "reported": '`"reported"`'}
    titles |= {"prevented": '`"prevented"`'}
    scenes = {"throw": "throw: a block of 2,560 tetrahedra flies at a ball at 20 m/s"}
    rows = [("scene, steps", *titles.values())]
    runs: dict[tuple[str, int], dict[str, Found]] = {}
    for run in (run for found in measurements for run in found["rows"]):
        runs.setdefault((run["scene"], run["steps"]), {})[run["mode"]] = run
    for (scene, steps), modes in runs.items():
        cells = []
        for run in (modes[mode] for mode in titles):
            many = f" in {run['inverting_steps']} steps" if run["inverted"] else ""
            cut = f", {run['truncated_steps']} steps with cut paths" if run["truncated_steps"] else ""
            cells.append(f"{run['inverted']:,}{many} ({_three(run['milliseconds'])} ms){cut}")
        rows.append((f"{scenes.get(scene, scene)}, {steps:,}", *cells))
    return rows


def penetration(*measurements: Found) -> Rows:
    """Who penetrates, where: crossings in the worst frame and in all, and pairs that meet on the way."""
    return _by_scene(
        measurements,
        lambda took: f"{max(took['crossings']):,}; {sum(took['crossings']):,}; {took['collisions']:,}",
    )


def penetration_costs(*measurements: Found) -> Rows:
    """What simulators keep of speed, tetrahedra and lengths, and their time."""

    def cell(took: Found) -> str:
        kept = "" if took["speed_kept"] is None else f"{digits(100.0 * took['speed_kept'])}% kept, "
        inverted = f"{max(took['inverted'])} inverted, " if max(took["inverted"]) else ""
        return f"{kept}{inverted}{digits(took['stretch'])}%, {digits(took['milliseconds']['median'])} ms"

    return _by_scene(measurements, cell)


def penetration_simulators(*measurements: Found) -> Rows:
    """Settings and claims of simulators, and what they did not run."""
    rows = [("simulator", "version", "settings", "says of penetration", "not run")]
    for name, simulator in _joined(measurements, "simulators").items():
        runs = [run for found in measurements for run in found["runs"] if run["simulator"] == name]
        versions = {run["measured"]["version"] for run in runs if run["measured"]}
        missing: dict[str, list[str]] = {}
        for run in runs:
            if run["problem"]:
                missing.setdefault(run["problem"].partition(": ")[0], []).append(run["scene"])
        scenes = [
            f"{reason} ({', '.join(names) if len(names) < len(runs) else 'all'})" for reason, names in missing.items()
        ]
        claims = SIMULATORS[name].claims or "nothing"  # not measured
        rows.append((simulator["title"], ", ".join(versions), simulator["settings"], claims, "; ".join(scenes)))
    return rows


def _joined(measurements: Sequence[Found], key: str) -> Found:
    """Returns what measurements have at a key, together."""
    return {name: value for found in measurements for name, value in found[key].items()}


def _by_scene(measurements: Sequence[Found], cell: Callable[[Found], str]) -> Rows:
    """Returns a row for each simulator, and a column for each scene."""
    runs = {(run["scene"], run["simulator"]): run["measured"] for found in measurements for run in found["runs"]}
    scenes = _joined(measurements, "scenes")
    rows = [("simulator", *scenes)]
    for name, simulator in _joined(measurements, "simulators").items():
        measured = [runs.get((scene, name)) for scene in scenes]
        rows.append((simulator["title"], *("not run" if took is None else cell(took) for took in measured)))
    return rows


# Repair and replay -------------------------------------------------------------------------------------------------


def repair_named(found: Found, *kinds: str) -> Rows:
    """Repairs of known meshes or files, each with every hint that was tried."""
    rows = [("`bsc.repair`", "vertices", "crossings", "largest, mean move", "strain", "time")]
    for run in found["runs"]:
        if run["kind"] in kinds:
            for attempt in run["attempts"]:
                hint = "" if attempt["hint"] == "none" else f", `{attempt['hint']}=`"
                rows.append((f"{Path(run['name']).stem}{hint}", f"{run['vertices']:,}", *_repair_cells(run, attempt)))
    return rows


def _repair_cells(run: Found, attempt: Found) -> tuple[str, ...]:
    return (
        f"{run['crossings']:,} to {attempt['crossings']:,}",
        f"{digits(attempt['largest_move'])}, {digits(attempt['mean_move'])}",
        f"{digits(100.0 * attempt['strain'])}%",
        f"{attempt['seconds']:.2f} s",
    )


def repair_random(found: Found) -> Rows:
    """Random damage by kind."""
    costs = "largest move, median and most", "strain, median and most", "more than 10%", "median time"
    rows = [("kind", "freed", "crossings", *costs)]
    kinds: dict[str, list[Found]] = {}
    for run in found["runs"]:
        if run["kind"] not in (KNOWN_MESH, FILE):
            kinds.setdefault(run["kind"], []).append(run)
    for kind, runs in kinds.items():
        first = [run["attempts"][0] for run in runs]
        moves, strains = ([attempt[name] for attempt in first] for name in ("largest_move", "strain"))
        rows.append(
            (
                kind,
                f"{sum(attempt['crossings'] == 0 for attempt in first)} of {len(runs)}",
                _counts([run["crossings"] for run in runs]),
                f"{digits(median(moves))}, {digits(max(moves))}",
                f"{digits(100.0 * median(strains))}, {digits(100.0 * max(strains))}%",
                str(sum(strain > 0.1 for strain in strains)),
                f"{median(attempt['seconds'] for attempt in first):.2f} s",
            )
        )
    return rows


def repair_shots(found: Found) -> Rows:
    """Repairs of shots: what collides before and after, moves, edges, and times beside those of the replay."""
    rows = [
        ("shot", "collisions", "edges in faces", "largest, mean move", "edges", "an interval; its replay", "multiple")
    ]
    for row in found["rows"]:
        before, left, seconds = row["before"], row["left"], row["seconds"]
        counts = [f"{before[what]:,} to {left[what]:,}" for what in ("collisions", "intersections")]
        repairing, finding = (milliseconds(1e3 * seconds[what] / row["intervals"]) for what in ("repairing", "finding"))
        command = " ".join((row["shot"], *row["options"]))
        rows.append(
            (
                f"`{command}`, {row['intervals']} intervals, {row['vertices']:,} vertices",
                *counts,
                f"{row['largest_move']:.2f}, {row['mean_move']:.2f}",
                f"{row['shortest_edge']:.2f} to {row['longest_edge']:.2f}",
                f"{repairing}; {finding}",
                f"{seconds['repairing'] / seconds['finding']:.1f}",
            )
        )
    return rows


def replay_sizes(found: Found) -> Rows:
    """Large, long and crowded scenes."""
    rows = [("scene", "collisions", "wall", "processor", "memory", "file")]
    for row in found["rows"]:
        sizes = f"{row['memory'] / 1e9:.2f} GB", f"{row['size'] / 1e6:.1f} MB"
        times = f"{row['wall']:.1f} s", f"{row['cpu']:.1f} s"
        rows.append((f"`{row['scene']}`: {row['description']}", f"{row['hits']:,}", *times, *sizes))
    return rows


# The front page -----------------------------------------------------------------------------------------------------


def front(gpu: Found, two_cores: Found, bullet: Found, drape: Found) -> Rows:
    """What the front page shows."""
    balls = {}
    for name, found in (("gpu", gpu), ("cpu", two_cores)):
        balls[name] = next(scene for scene in found["scenes"] if _scene_name(scene).startswith("cloth-ball"))
    ball, peer = balls["cpu"], balls["cpu"]["ipc_toolkit"]
    took = balls["gpu"]["milliseconds"]["cuda_graph"]
    size = (
        f"{ball['triangles']:,} triangles, {ball['candidates'] / 1e6:.1f} million candidates, {ball['hits']:,} contacts"
    )
    rows = [
        ("measured", ""),
        (
            f"{size}: all, with time and normal",
            f"{took:.1f} ms on an {gpu['record']['gpus'][0].removeprefix('NVIDIA ')}",
        ),
        (
            "the same on two cores",
            f"{milliseconds(ball['milliseconds']['detect'])} (IPC Toolkit, the earliest time alone: "
            f"{milliseconds(peer['build_milliseconds'] + peer['step_milliseconds'])})",
        ),
    ]
    names = {"vbd": "VBD", "vbd-self-contact": "with its self-contact", "ccd-vbd": "with `SolverCCD`"}
    for found, title, what in (
        (bullet, "a patch of cloth is shot at a sheet: pairs that pass through", "collisions"),
        (drape, "a cloth drapes over a ball: edges through faces, worst frame", "crossings"),
    ):
        runs = {run["simulator"]: run["measured"][what] for run in found["runs"] if run["measured"]}
        counts = {name: value if isinstance(value, int) else max(value) for name, value in runs.items()}
        rows.append((title, ", ".join(f"{names[name]} {counts[name]:,}" for name in names)))
    return rows
