"""Measures Newton's own examples, unchanged: plain, with the collision stage behind their solver, or another for VBD.

Each run is a process of its own, see :mod:`.newton_process`, so that neither a crash nor the solver classes that it
replaces reach another run.
"""

import ast
import contextlib
import difflib
import importlib
import importlib.util
import json
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..record import Run
from ..tables import Column, Table

__all__ = [
    "CPU_FRAMES",
    "DESCRIPTION",
    "EXAMPLES",
    "FOLDERS",
    "FRAMES",
    "MODES",
    "WARM_UP",
    "ExampleMeasurement",
    "ExampleRun",
    "NewtonExample",
    "StageTotals",
    "describe_download",
    "describe_needs",
    "find_examples",
    "list_examples",
    "measure_example",
    "show",
    "to_dict",
]

DESCRIPTION = """\
Run Newton's own examples, unchanged, and measure them: plain, with SolverCCD
put behind their solver, or behind each entry of a coupled solver that has
particles, and with SolverImplicit in place of VBD. Each run is a process of its
own, in which the example captures its own CUDA graph and runs its own tests. A
row has the times of frames, without drawing and without the first two; the
edges of cloth or soft bodies that cross faces at the start, and the most at
frame ends, found in exact arithmetic; the steps that were not certified; and
whether the example's own tests pass. Default: the examples of
newton.examples.cloth, softbody and multiphysics that have cloth or soft bodies.
Any other example of Newton can be named. Options of the example itself follow
its name, in quotes. A run that fails is a row, and a line below the table says
why. Tests that expect a state at rest fail in short runs, in all modes."""

EXAMPLES = """\
examples:
  warp-bsc bench newton --list
  warp-bsc bench newton cloth_twist softbody_hanging --device cuda:0
  warp-bsc bench newton "cloth_hanging --solver xpbd" --frames 20 --modes stage
  warp-bsc bench newton --json examples.json"""

_NEEDS = (
    Column("Folder", lambda example: example.module.split(".")[2], kind="text"),
    Column("Needs", lambda example: "; ".join(describe_needs(example)), kind="text"),
)
_TIMES = (
    Column("Mode", "mode", kind="word"),
    Column("Median\n[ms]", "measured.milliseconds.median", ",.1f"),
    Column("95%\n[ms]", "measured.milliseconds.percentile_95", ",.1f"),
    Column("Worst\n[ms]", "measured.milliseconds.worst", ",.1f"),
    Column("Cross-\nings at\nstart", "measured.crossings_at_start"),
    Column("At\nmost", "measured.most_crossings"),
    Column("Its tests", lambda run: _name_result(run["measured"]), kind="word"),
)
_SIZES = (
    Column("Partic-\nles", "particles"),
    Column("Trian-\ngles", "triangles"),
    Column("Frames", "frames"),
    Column("Steps", "stage.steps"),
    Column("Uncer-\ntified", "stage.uncertified_steps"),
    Column("Trun-\ncated", "stage.truncated_steps"),
    Column("Frozen", "stage.frozen_steps"),
)

FOLDERS = ("cloth", "softbody", "multiphysics")
"""The folders of Newton's examples that are measured by default."""

MODES = ("plain", "stage", "implicit")
"""The modes: the example as it is, with :class:`warp_bsc.SolverCCD` behind its solver, and with
:class:`warp_bsc.SolverImplicit` in place of VBD, with default arguments.

Of a coupled solver, these are the entries that have particles, each with a stage or solver of its own.
"""

WARM_UP = 2
"""Frames at the start whose times are left out: kernels are compiled and buffers grow in them."""

FRAMES = 300
"""Frames of an example that sets no number of its own."""

CPU_FRAMES = 10
"""Largest default number of frames on the CPU."""

_BUILDERS = ("add_cloth", "add_soft", "add_triangle", "add_tetrahedr")
"""How the names of the functions begin that add cloth and soft bodies to a model."""

_DOWNLOADS = ("download_asset", "download_external_git_folder")
"""Functions of Newton that download files of examples."""


@dataclass(frozen=True)
class NewtonExample:
    """An example of Newton.

    Attributes:
        name: Its name, as ``python -m newton.examples`` takes it.
        module: The module, which runs the example if it is the main one.
        options: Options of the example itself.
        deformable: Whether its source adds cloth or soft bodies to a model.
        downloads: Names of the assets that it downloads, "" for one that the source does not name.
        missing: Packages that it imports and that are not installed.
    """

    name: str
    module: str
    options: tuple[str, ...] = ()
    deformable: bool = True
    downloads: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The name and the options."""
        return shlex.join([self.name, *self.options])


@dataclass(frozen=True)
class StageTotals:
    """Totals of the reports of all stages of a run, see :class:`warp_bsc.SolverReport`.

    A stage behind an entry of a coupled solver takes a step for each substep of the entry and each pass of the coupler.
    It certifies the motion of what the entry sees in the state of the program; crossings are counted in the whole
    model.

    Attributes:
        steps: Steps.
        uncertified_steps: Steps that were not certified.
        truncated_steps: Steps in which a path was truncated.
        frozen_steps: Steps in which a vertex was frozen.
    """

    steps: int
    uncertified_steps: int
    truncated_steps: int
    frozen_steps: int


@dataclass(frozen=True)
class ExampleMeasurement:
    """Times of an example's frames, and its crossings.

    A crossing is an edge that meets a face without a common vertex, found in exact arithmetic; at least one of the two
    belongs to cloth or a soft body. Crossings within a step, and at frame ends that are not checked, are not counted.

    Attributes:
        device: The Warp device.
        particles: Number of particles.
        triangles: Number of triangles of cloth and of the surfaces of soft bodies that the model lists.
        tetrahedra: Number of tetrahedra.
        shapes: Number of rigid shapes.
        frames: Number of frames.
        frame_milliseconds: Time of each frame but the first :data:`WARM_UP` [ms]; drawing is not in it.
        crossings_at_start: Number of crossings before the first frame.
        most_crossings: Largest number of crossings at a checked frame end.
        first_frame_with_crossings: The first checked frame, counted from 0, with more crossings than the start; None if
            there is none.
        first_frame_not_finite: The first checked frame, counted from 0, with positions that are not finite; None if
            there is none. No later frame is checked for crossings.
        stage: What the stage or :class:`warp_bsc.SolverImplicit` reports; None without both.
        test_final: What the example's ``test_final`` finds: "ok" or the first line of its message; None without one.
        test_post_step: The same of ``test_post_step``, which is called after each frame until it fails.
    """

    device: str
    particles: int
    triangles: int
    tetrahedra: int
    shapes: int
    frames: int
    frame_milliseconds: list[float]
    crossings_at_start: int
    most_crossings: int
    first_frame_with_crossings: int | None
    first_frame_not_finite: int | None
    stage: StageTotals | None
    test_final: str | None
    test_post_step: str | None

    def to_dict(self) -> dict[str, Any]:
        """Returns the measurement as plain data for JSON."""
        values = asdict(self)
        frames = values.pop("frame_milliseconds")
        median, percentile_95 = (float(np.percentile(frames, share)) for share in (50, 95))
        times = {"median": median, "percentile_95": percentile_95, "worst": max(frames), "frames": frames}
        return values | {"milliseconds": times}


@dataclass(frozen=True)
class ExampleRun(Run):
    """A run of an example in a mode.

    Attributes:
        example: Name and options of the example.
        mode: One of :data:`MODES`.
    """

    example: str
    mode: str


def find_examples(requests: Sequence[str] = ()) -> list[NewtonExample]:
    """Returns examples of Newton by name; without one, those with cloth or soft bodies in :data:`FOLDERS`.

    The sources are read, and no example is imported.

    Args:
        requests: Names of examples, each followed by options of the example itself, as in a shell:
            ``"cloth_hanging --solver xpbd"``.

    Raises:
        ValueError: If Newton has no example of a name, or quotes in a request have no end.
    """
    from newton.examples import get_examples  # noqa: PLC0415 (slow)

    modules = get_examples()
    if not requests:
        found = [_read_example(name, module) for name, module in modules.items() if module.split(".")[2] in FOLDERS]
        return [example for example in found if example.deformable]
    examples = []
    for request in requests:
        try:
            name, *options = shlex.split(request) or [""]
        except ValueError as error:
            raise ValueError(f"{request!r}: {error}") from None
        if name not in modules:
            close = difflib.get_close_matches(name, modules, n=3)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise ValueError(f"{name!r}: Newton has no example of this name{hint}")
        examples.append(_read_example(name, modules[name], tuple(options)))
    return examples


def _read_example(name: str, module: str, options: tuple[str, ...] = ()) -> NewtonExample:
    """Reads an example's source for its packages and downloads."""
    specification = importlib.util.find_spec(module)
    assert specification is not None and specification.origin is not None
    tree = ast.parse(Path(specification.origin).read_text(encoding="utf-8"))
    calls = [(_called_name(node), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    deformable = any(called.startswith(_BUILDERS) for called, _ in calls)
    downloads = dict.fromkeys(_first_string(node) for called, node in calls if called in _DOWNLOADS)
    imported = []
    for node in tree.body:  # an import within a function or a "try" may have a substitute
        if isinstance(node, ast.Import):
            imported += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imported.append(node.module)
    packages = dict.fromkeys(name.split(".")[0] for name in imported)
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    return NewtonExample(name, module, options, deformable, tuple(downloads), tuple(missing))


def _called_name(call: ast.Call) -> str:
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def _first_string(call: ast.Call) -> str:
    strings = [argument.value for argument in call.args if isinstance(argument, ast.Constant)]
    return next((string for string in strings if isinstance(string, str)), "")


def measure_example(
    example: NewtonExample,
    mode: str,
    *,
    device: str,
    frames: int | None = None,
    check_every: int = 5,
    download: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ExampleRun:
    """Runs an example in a process of its own and measures its frames.

    Args:
        example: The example.
        mode: One of :data:`MODES`.
        device: Name of the Warp device.
        frames: Number of frames, more than :data:`WARM_UP`; default: the number that the example sets, otherwise
            :data:`FRAMES`; on the CPU at most :data:`CPU_FRAMES`.
        check_every: Number of frames after which crossings are counted again; those of the last frame are as well.
        download: Whether the example may download assets.
        progress: Called with the number of frames done and the number of all.

    Returns:
        The measurement, or the reason why there is none, such as an error of the example or a crash.

    Raises:
        ValueError: If the mode or a number is out of range.
    """
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}, not {mode!r}")
    if frames is not None and frames <= WARM_UP:
        raise ValueError(f"frames must be more than {WARM_UP}, as the times of these are left out, not {frames}")
    if check_every < 1:
        raise ValueError(f"check_every must be at least 1, not {check_every}")
    needs = describe_needs(example, download=download)
    if needs:
        return ExampleRun(example.title, mode, problem=needs[0])
    request = {
        "module": example.module,
        "options": example.options,
        "mode": mode,
        "device": device,
        "frames": frames,
        "check_every": check_every,
        "download": download,
    }
    with tempfile.TemporaryFile() as errors:
        last: dict[str, Any] = {}
        for reply in _replies(request, errors):
            last = reply
            if "frame" in reply and progress:
                progress(reply["frame"], reply["frames"])
        if "measured" in last:
            values = last["measured"]
            totals = values["stage"]
            values["stage"] = None if totals is None else StageTotals(**totals)
            return ExampleRun(example.title, mode, measured=ExampleMeasurement(**values))
        problem = last.get("problem")
        if problem is None:
            problem = _describe_end(last["status"], _last_line(errors))
    return ExampleRun(example.title, mode, problem=problem)


def describe_needs(example: NewtonExample, *, download: bool = False) -> list[str]:
    """Returns the packages and downloads that an example lacks by its source, a line each.

    Args:
        example: The example.
        download: Whether it may download assets.
    """
    needs = [f"needs the package {package}" for package in example.missing]
    if example.downloads and not download:
        needs.append(describe_download(", ".join(filter(None, example.downloads))))
    return needs


def describe_download(asset: str) -> str:
    """Returns the line about an asset that may not be downloaded."""
    return f"needs a download: {asset or 'an asset'}"


def _replies(request: dict[str, Any], errors) -> Iterator[dict[str, Any]]:
    """Starts a process that serves a request, and yields its replies; the last is its exit status, or its result.

    The process ends with the iteration, also where an error ends that.
    """
    command = [sys.executable, "-m", f"{__package__}.newton_process", json.dumps(request)]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, text=True)
    assert process.stdout is not None
    complete = False
    try:
        for line in process.stdout:
            reply = json.loads(line)
            complete = "frame" not in reply
            yield reply
        status = process.wait()
        if not complete:
            yield {"status": status}
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        process.stdout.close()


def _last_line(errors) -> str:
    """Returns the last line of a file that is not blank, "" if there is none."""
    errors.seek(0)
    lines = errors.read().decode(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def _describe_end(status: int, line: str) -> str:
    """Returns how a process ended that gave no result."""
    if status < 0:
        with contextlib.suppress(ValueError):  # a signal without a name
            return f"failed: the process was ended by {signal.Signals(-status).name}"
        return f"failed: the process was ended by signal {-status}"
    return f"failed: the process ended with status {status}" + (f": {line}" if line else "")


def list_examples(examples: Sequence[NewtonExample]) -> Table:
    """Returns the table of examples and what they need."""
    return Table("Example", _NEEDS, [(example.title, example) for example in examples])


def to_dict(runs: list[ExampleRun]) -> dict[str, Any]:
    """Returns runs as plain data for JSON."""
    return {"frames_left_out": WARM_UP, "runs": [run.to_dict() for run in runs]}


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement: times, crossings and tests, a row a run; reports of stages."""
    device = f"{found['device']}, {found['device_name']}"
    yield f"Newton's examples on {device}; times of a frame without the first {found['frames_left_out']}"
    caption = "Crossings of cloth and soft bodies: at the start, and the most at a checked frame end."
    yield Table("Example", _TIMES, [(run["example"], run) for run in found["runs"]], caption=caption)
    sizes: dict[str, dict[str, Any]] = {}
    for run in found["runs"]:
        took = run["measured"]
        for remark in _find_failures(took) if took else [run["problem"]]:
            yield f"{run['example']}, {run['mode']}: {remark}"
        name = f"{run['example']}, implicit" if run["mode"] == "implicit" else run["example"]
        if took and (took["stage"] or name not in sizes):
            sizes[name] = took
    if sizes:
        yield ""
        caption = "Steps: all, not certified, with paths truncated, with vertices frozen."
        yield Table("Example", _SIZES, sizes.items(), caption=caption)


def _name_result(took: dict[str, Any] | None) -> str:
    """Returns how the tests of an example ended."""
    if took is None:
        return "not run"
    return "fail" if _find_failures(took) else took["test_final"] or "none"


def _find_failures(took: dict[str, Any]) -> list[str]:
    """Returns the messages of an example's tests that failed, and the frame at which positions were not finite."""
    tests = "test_post_step", "test_final"
    failures = [f"{test}: {took[test]}" for test in tests if took[test] not in (None, "ok")]
    if (frame := took["first_frame_not_finite"]) is not None:
        failures.append(f"positions are not finite at the end of frame {frame}")
    return failures
