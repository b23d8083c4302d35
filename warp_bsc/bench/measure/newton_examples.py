"""Measures Newton's own examples, unchanged: plain, with the collision stage behind their solver, or another for VBD.

Each run is a process of its own, see :mod:`.newton_process`, so that neither a crash nor the solver classes that it
replaces reach another run.
"""

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._arguments import checked_choice
from ..record import Run
from ..scenes.newton_examples import NewtonExample, describe_needs
from ..tables import Column, Table

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


STAGE_TOTALS = ("steps", "uncertified_steps", "truncated_steps", "frozen_steps")
"""Totals of the reports of all stages of a run, see :class:`warp_bsc.SolverReport`: steps, those that were not
certified, in which a path was truncated, and in which a vertex was frozen.

A stage behind an entry of a coupled solver takes a step for each substep of the entry and each pass of the coupler. It
certifies the motion of what the entry sees in the state of the program; crossings are counted in the whole model.
"""


@dataclass(frozen=True)
class ExampleRun(Run):
    """A run of an example in a mode.

    A crossing is an edge that meets a face without a common vertex, found in exact arithmetic; at least one of the two
    belongs to cloth or a soft body. Crossings within a step, and at frame ends that are not checked, are not counted.

    Attributes:
        example: Name and options of the example.
        mode: One of :data:`MODES`.
        measured: Plain data for JSON. ``device``, that of Warp; numbers of ``particles``, of ``triangles`` of cloth and
            of the surfaces of soft bodies that the model lists, of ``tetrahedra``, rigid ``shapes`` and ``frames``;
            ``crossings_at_start``, before the first frame; ``most_crossings``, the largest number at a checked frame
            end; ``first_frame_with_crossings``, the first checked frame, counted from 0, with more crossings than the
            start, and ``first_frame_not_finite``, that with positions that are not finite, after which no frame is
            checked, each None if there is none; ``stage``, the :data:`STAGE_TOTALS` of the stages, or of
            :class:`warp_bsc.SolverImplicit`, None without both; ``test_final``, what the example's test of this name
            finds: "ok" or the first line of its message, None without one; ``test_post_step``, the same of the one that
            is called after each frame until it fails; ``milliseconds``, as of :func:`describe_times`.
    """

    example: str
    mode: str


def describe_times(frames: list[float]) -> dict[str, Any]:
    """Returns times of frames [ms], but the first :data:`WARM_UP`, with their median, 95th percentile and maximum."""
    median, percentile_95 = (float(np.percentile(frames, share)) for share in (50, 95))
    return {"median": median, "percentile_95": percentile_95, "worst": max(frames), "frames": frames}


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
    checked_choice(mode, "mode", MODES)
    if frames is not None and frames <= WARM_UP:
        raise ValueError(f"frames must be more than {WARM_UP}, as the times of these are left out, not {frames}")
    if check_every < 1:
        raise ValueError(f"check_every must be at least 1, not {check_every}")
    needs = describe_needs(example, download=download)
    if needs:
        return ExampleRun(example.title, mode, problem=needs[0])
    request = {"module": example.module, "options": example.options, "mode": mode, "device": device}
    request |= {"frames": frames, "check_every": check_every, "download": download}
    with tempfile.TemporaryFile() as errors:
        last: dict[str, Any] = {}
        for reply in _replies(request, errors):
            last = reply
            if "frame" in reply and progress:
                progress(reply["frame"], reply["frames"])
        if "measured" in last:
            return ExampleRun(example.title, mode, measured=last["measured"])
        problem = last.get("problem")
        if problem is None:
            problem = _describe_end(last["status"], _last_line(errors))
    return ExampleRun(example.title, mode, problem=problem)


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


def to_dict(runs: list[ExampleRun]) -> dict[str, Any]:
    """Returns runs as plain data for JSON."""
    return {"frames_left_out": WARM_UP, "runs": [vars(run) for run in runs]}


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
