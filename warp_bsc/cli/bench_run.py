"""Runs the benchmarks of ``warp-bsc bench``: measures, prints tables, and writes JSON."""

import argparse
import contextlib
import difflib
import functools
import importlib.util
import itertools
import json
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import warp as wp

from .._atomic_file import STDOUT, OutputFile
from ..bench.figure import draw_paper_benchmarks
from ..bench.measure import (
    detector,
    given_queries,
    newton_examples,
    paper,
    paper_tables,
    penetration,
    queries,
    repair,
    response,
)
from ..bench.peers import ipc_toolkit
from ..bench.record import with_record
from ..bench.scenes import detector as scenes_of_detector
from ..bench.scenes import newton_examples as examples_of_newton
from ..bench.scenes.queries import SEED
from ..bench.scenes.repair import KNOWN, damaged, load_tangled
from ..bench.tables import Table
from ..bench.timing import limited_threads
from ..detection.run.launch import cores, count_cores
from ..detection.run.settings import SURFACE_KINDS, PairKind
from ..mesh_files.mesh_file import is_mesh_file
from .device import find_device, load_detector, loading_kernels
from .interrupts import INTERRUPTS
from .progress import RunProgress
from .query_file import find_query_files, read_query_file
from .tables import Console, print_table, say

_FIGURES = (".png", ".svg", ".pdf")

_Run = TypeVar("_Run")


def _check_json(path: str | None, is_named: Callable[[str], bool], what: str, named: str) -> None:
    """Raises ValueError if the value of --json is the name of what is measured, which argparse takes for its file."""
    if path and is_named(path):
        raise ValueError(f"--json {path}: this is {what}; name {named} before the options")


@contextlib.contextmanager
def _open_json(path: str | None) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Opens the file of --json, so that a path that cannot be written fails before anything is measured.

    Yields a function that writes a measurement, given as plain data: to the file, to standard output, or nowhere.
    """
    file = OutputFile(path) if path not in (None, STDOUT) else None

    def write(found: dict[str, Any]) -> None:
        text = json.dumps(found)
        if path == STDOUT:
            print(text)
        if file:
            file.write(text)
            file.commit()

    try:
        yield write
    finally:
        if file:
            file.discard()


def _draw(shown: Iterable[Table | str]) -> None:
    """Prints tables and lines."""
    console = Console()
    for part in shown:
        if isinstance(part, Table):
            print_table(console, part.first, part.columns, part.rows, caption=part.caption)
        else:
            say(console, part)


def _report(
    arguments: argparse.Namespace,
    device: wp.Device,
    measured: Generator[_Run, None, None],
    module: ModuleType,
    name: str,
    *,
    what: str = "runs",
    **settings: Any,
) -> None:
    """Measures all runs, prints them, and writes those that were complete if an interrupt ends it, then raises it.

    A run is measured when the next element of ``measured`` is taken. ``to_dict`` of the module makes plain data of runs
    and further settings, and ``show`` makes tables and lines of that.
    """
    with _open_json(arguments.json) as write:
        runs: list[_Run] = []
        interrupt = None
        try:
            with contextlib.closing(measured):  # takes its bar away
                for run in measured:
                    runs.append(run)
        except KeyboardInterrupt as signal:
            interrupt = signal
        with INTERRUPTS.held():
            found = {"benchmark": name, "device": str(device), "device_name": device.name, "partial": bool(interrupt)}
            found |= module.to_dict(runs, **settings)
            if arguments.json != STDOUT:
                ending = [f"Interrupted: the other {what} are missing."] if interrupt else []
                _draw(itertools.chain(module.show(found), ending))
            write(with_record(found, arguments.command_line, [device]))
        if interrupt:
            raise interrupt


def _measure_each(
    cases: Iterable[tuple[Any, ...]],
    measure: Callable[..., _Run],
    device: wp.Device,
    *,
    title: Callable[..., str] = "{}, {}".format,
    unit: str = "",
    holds: bool = True,
) -> Generator[_Run, None, None]:
    """Yields runs, and shows the progress.

    A run is measured given the arguments of its case, as is its title, and ``progress``, a function to call with how
    much of it is done, and how much there is, in ``unit``, or shares without. If ``holds``, interrupts wait for the
    next progress: a library that is interrupted while it loads raises other errors, or none.
    """
    cases = list(cases)
    with RunProgress("Measuring") as progress, loading_kernels(device, progress.console):
        for done, case in enumerate(cases):
            name = title(*case)
            progress.show(done, len(cases), f"{name}: starts")

            def show_part(part: int, parts: int, name: str = name, done: int = done) -> None:
                INTERRUPTS.check()
                how_much = f"{unit} {part:,} of {parts:,}" if unit else f"{part / parts:.0%}"
                progress.show(done + part / parts, len(cases), f"{name}: {how_much}")

            with INTERRUPTS.held() if holds else contextlib.nullcontext():
                run = measure(*case, progress=show_part)
            if (problem := getattr(run, "problem", None)) and progress.console.is_terminal:
                say(progress.console, f"{name}: {problem}")
            yield run
            INTERRUPTS.check()


def run_paper(arguments: argparse.Namespace) -> None:
    """Measures the paper's benchmarks."""
    if arguments.figure:  # would fail only after everything has been measured
        if Path(arguments.figure).suffix not in _FIGURES:
            raise ValueError(f"--figure {arguments.figure}: its name must end in one of {', '.join(_FIGURES)}")
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError("--figure needs matplotlib: pip install 'warp-bsc[bench]'")
    _check_json(arguments.json, scenes_of_detector.is_scene_name, "a scene", "scenes")
    effort = paper.QUICK if arguments.quick else paper.FULL
    needs_assets = not arguments.scenes or any(name in scenes_of_detector.PAPER_SCENES for name in arguments.scenes)
    known = {}
    if needs_assets:
        known = dict(zip(scenes_of_detector.PAPER_SCENES, scenes_of_detector.paper_scenes(), strict=True))
    names = [known.get(name, name) for name in arguments.scenes or known]
    devices = [find_device(arguments.device)]
    if arguments.device is None:
        devices = [wp.get_device("cpu"), *wp.get_cuda_devices()[:1]]
    figure = OutputFile(arguments.figure) if arguments.figure else None  # fails before anything is measured
    try:
        with _open_json(arguments.json) as write:
            scenes = [(name, scenes_of_detector.load_intervals(name, most=effort.intervals)) for name in names]
            with limited_threads(arguments.threads):
                places = paper.find_places(devices)
                benchmarks = _measure_scenes(scenes, places, effort)
                adversarial = paper.find_adversarial_worst(places, effort)
            found = paper.to_dict(benchmarks, adversarial, quick=arguments.quick)
            found = with_record(found, arguments.command_line, devices)
            if arguments.json != STDOUT:
                _draw(paper_tables.show(found))
            write(found)
            if figure:
                draw_paper_benchmarks([found], arguments.figure)
    finally:
        if figure:
            figure.discard()


def _measure_scenes(scenes: list, places: list[paper.Place], effort: paper.Effort) -> list[dict[str, Any]]:
    """Measures the paper's benchmarks scene by scene, and shows the progress."""
    compare = ipc_toolkit.is_installed()
    parts = 4 + len({str(place.device) for place in places}) + len(places) + 2 * compare
    benchmarks = []
    with RunProgress("Measuring") as progress:
        for index, (name, intervals) in enumerate(scenes):
            done = itertools.count(parts * index)

            def show_part(part: str, name: str = name, done: Iterator[int] = done) -> None:
                progress.show(next(done), parts * len(scenes), f"{Path(name).stem}: {part}")

            benchmarks.append(
                paper.benchmark_scene(name, intervals, places, effort, compare=compare, progress=show_part)
            )
    return benchmarks


def run_detector(arguments: argparse.Namespace) -> None:
    """Measures the detector."""
    if arguments.compare and arguments.worlds > 1:
        raise ValueError("--compare and --worlds exclude each other: the IPC Toolkit has no worlds")
    _check_json(arguments.json, scenes_of_detector.is_scene_name, "a scene", "scenes")
    if arguments.compare and importlib.util.find_spec("ipctk") is None:
        raise ValueError("--compare needs the IPC Toolkit: pip install 'warp-bsc[bench]'")
    scenes = [
        scenes_of_detector.load_scene(name, interval=arguments.interval)
        for name in arguments.scenes or scenes_of_detector.default_scenes()
    ]
    scenes = [scene.in_worlds(arguments.worlds) for scene in scenes]
    device = find_device(arguments.device)
    options = {name: getattr(arguments, name) for name in ("method", "repeat", "compare")}

    def measure() -> Generator[dict[str, Any], None, None]:
        with loading_kernels(device):
            for dtype in {scene.x0.dtype for scene in scenes}:
                load_detector(arguments.method, dtype, device)
        yield from _measure_each(
            [(scene,) for scene in scenes],
            lambda scene, progress: detector.benchmark_detector(scene, device=device, **options),
            device,
            title=lambda scene: scene.name,
            holds=False,
        )

    with limited_threads(arguments.threads):
        settings = {"method": arguments.method, "threads": count_cores(), "repeat": arguments.repeat}
        _report(arguments, device, measure(), detector, "detector", **settings)


def run_queries(arguments: argparse.Namespace) -> None:
    """Measures elementary queries, random ones or those of files."""
    if arguments.count is not None:
        queries.check_query_count(arguments.count)
    if arguments.paths and arguments.count is not None:
        raise ValueError("--count is for random queries: omit it, or the files")
    device = find_device(arguments.device)
    with limited_threads(arguments.threads):
        (_measure_files if arguments.paths else _measure_random)(arguments, device)


def _measure_random(arguments: argparse.Namespace, device: wp.Device) -> None:
    """Measures random queries in each mode."""

    def measure() -> Generator[dict[str, Any], None, None]:
        with loading_kernels(device):
            for kind in SURFACE_KINDS:
                queries.benchmark_queries(kind, count=1, device=device, repeat=1)
        for kind in SURFACE_KINDS:
            yield queries.benchmark_queries(kind, count=arguments.count, device=device, repeat=arguments.repeat)[0]

    copy_rate = queries.benchmark_copy(device=device, repeat=arguments.repeat)
    settings = {"threads": count_cores(), "repeat": arguments.repeat, "seed": SEED}
    _report(arguments, device, measure(), queries, "queries", **settings, copy_bytes_per_second=copy_rate)


def _measure_files(arguments: argparse.Namespace, device: wp.Device) -> None:
    """Measures the methods on the queries of files."""
    kinds = {kind.display_name: kind for kind in SURFACE_KINDS}
    points: dict[tuple[str, PairKind], list[np.ndarray]] = {}
    for path in arguments.paths:
        for file in find_query_files([path]):
            given = read_query_file(file)
            points.setdefault((path, kinds[given.kind]), []).append(given.points)
    threads, measure_kind = count_cores(), given_queries.benchmark_given_queries

    def measure() -> Generator[dict[str, Any], None, None]:
        with cores(threads):
            with loading_kernels(device):
                for kind in {kind for _, kind in points}:
                    measure_kind("", kind, np.zeros((1, 8, 3)), device=device, repeat=1)
            for (path, kind), parts in points.items():
                yield measure_kind(Path(path).name, kind, np.concatenate(parts), device=device, repeat=arguments.repeat)

    settings = {"threads": threads, "repeat": arguments.repeat}
    _report(arguments, device, measure(), given_queries, "given queries", **settings)


def run_newton(arguments: argparse.Namespace) -> None:
    """Measures Newton's own examples, or lists them."""
    device = find_device(arguments.device)
    with INTERRUPTS.held():  # a library that is interrupted while it loads raises other errors, or none
        examples = examples_of_newton.find_examples(arguments.examples)
        names = {example.name for example in examples_of_newton.find_examples()} if arguments.json else set()
    INTERRUPTS.check()
    _check_json(arguments.json, lambda path: path.split(" ")[0] in names, "an example", "examples")
    if arguments.list:
        _draw([examples_of_newton.list_examples(examples)])
        return
    options = {name: getattr(arguments, name) for name in ("frames", "check_every", "download")}
    measure = functools.partial(newton_examples.measure_example, device=str(device), **options)
    runs = _measure_each(itertools.product(examples, arguments.modes), measure, device, unit="frame", holds=False)
    _report(arguments, device, runs, newton_examples, "newton")


def run_response(arguments: argparse.Namespace) -> None:
    """Measures scenes in contact."""
    for name in arguments.scenes:
        if name not in response.SCENES:
            close = difflib.get_close_matches(name, response.SCENES, n=1)
            hint = f"; did you mean {close[0]}?" if close else "."
            known = ", ".join(response.SCENES)
            raise ValueError(f"{name!r}: there is no scene of this name{hint} The scenes are {known}")
    configurations = arguments.configurations
    if configurations is None:  # all that the solver and options allow
        omitted = set() if arguments.solver == "vbd" else {"self-contact", "implicit", response.CONVERGED}
        omitted |= set() if arguments.reference else {response.REFERENCE}
        configurations = tuple(name for name in response.CONFIGURATIONS if name not in omitted)
    _check_json(arguments.json, response.SCENES.__contains__, "a scene", "scenes")
    if arguments.perturb is not None and "stage" not in configurations:
        raise ValueError("--perturb runs the configuration stage a second time, and --configurations omits it")
    device = find_device(arguments.device)
    cases = itertools.product(dict.fromkeys(arguments.scenes or response.SCENES), configurations)
    options = {name: getattr(arguments, name) for name in ("solver", "seconds", "rate", "reference_rate", "perturb")}
    measure = functools.partial(response.measure_response, device=device, **options)
    runs = _measure_each(cases, measure, device, unit="step")
    _report(arguments, device, runs, response, "response")


def run_repair(arguments: argparse.Namespace) -> None:
    """Measures repairs."""
    _check_json(arguments.json, is_mesh_file, "a mesh file", "meshes")
    device = find_device(arguments.device)
    files = {path: load_tangled(path) for path in arguments.meshes}
    meshes = [(repair.KNOWN_MESH, name, make) for name, make in KNOWN.items()]
    meshes += [(repair.FILE, path, lambda mesh=mesh: mesh) for path, mesh in files.items()]
    seeds = range(arguments.seed, arguments.seed + arguments.random)
    meshes += [(kind, str(seed), functools.partial(damaged, kind, seed)) for kind in arguments.kinds for seed in seeds]
    runs = _measure_each(
        meshes,
        lambda kind, name, make, progress: repair.measure_repair(kind, name, make(), device=device),
        device,
        title=lambda kind, name, make: f"{kind} {name}",
    )
    _report(arguments, device, runs, repair, "repair", what="repairs")


def run_penetration(arguments: argparse.Namespace) -> None:
    """Judges simulators."""
    device, simulators = find_device(arguments.device), penetration.SIMULATORS
    measure = functools.partial(penetration.measure_penetration, device=device, frames=arguments.frames)
    cases = itertools.product(arguments.scene, arguments.simulator)
    runs = _measure_each(cases, measure, device, title=lambda scene, name: f"{scene}, {simulators[name].title}")
    _report(arguments, device, runs, penetration, "penetration")
