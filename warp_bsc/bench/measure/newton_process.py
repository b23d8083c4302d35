"""A process that runs one of Newton's examples and measures it.

``python -m warp_bsc.bench.measure.newton_process REQUEST`` runs the example as ``python -m newton.examples`` does, with
a frame loop that measures in place of ``newton.examples.run``. The collision stage takes the place of solver classes of
:mod:`newton.solvers`, or :class:`warp_bsc.SolverImplicit` that of VBD.
"""

import json
import os
import runpy
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from ..._garbage import paused_collection
from ..scenes.newton_examples import describe_download
from .newton_examples import CPU_FRAMES, FRAMES, STAGE_TOTALS, WARM_UP, describe_times

SOLVERS = ("SolverVBD", "SolverXPBD", "SolverStyle3D", "SolverSemiImplicit")
"""The solvers of Newton that move cloth and soft bodies."""


class _NotMeasured(Exception):
    """The example cannot be measured, such as in this mode or without a download; the message says why."""


def _describe_error(error: BaseException) -> str:
    """Returns the type of an error and the first line of its message."""
    line = _first_line(error)
    return line if line == type(error).__name__ else f"{type(error).__name__}: {line}"


def _first_line(error: BaseException) -> str:
    """Returns the first line of an error's message, its type if there is none."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def serve(request: dict[str, Any], reply: Callable[[dict[str, Any]], None]) -> None:
    """Serves a request of :func:`measure_example` in this process, which must not serve another one."""
    try:
        measured = _measure_here(request, lambda frame, frames: reply({"frame": frame, "frames": frames}))
    except _NotMeasured as reason:
        reply({"problem": str(reason)})
    except Exception as error:
        missing = error if isinstance(error, ModuleNotFoundError) else error.__cause__
        if isinstance(missing, ModuleNotFoundError):  # Newton raises an error of its own from that for a backend
            reply({"problem": f"needs the package {missing.name}"})
        else:
            reply({"problem": f"failed: {_describe_error(error)}"})
    else:
        reply({"measured": measured})


def _measure_here(request: dict[str, Any], progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Runs an example as the main module, with the frame loop that measures."""
    with paused_collection():
        import newton.examples  # noqa: PLC0415 (slow)
        import newton.utils  # noqa: PLC0415 (slow)

        from ..._private_names.of_newton import replace_name  # noqa: PLC0415 (imports Newton)

    measurements: list[dict[str, Any]] = []
    stages: list[Any] = []
    replaced = {"plain": (), "stage": SOLVERS, "implicit": SOLVERS[:1]}[request["mode"]]

    def run(example, arguments):
        own = arguments.num_frames != newton.examples.create_parser().get_default("num_frames")
        frames = request["frames"]
        if frames is None:
            frames = arguments.num_frames if own else FRAMES
            frames = min(frames, CPU_FRAMES) if wp.get_device().is_cpu else frames
        if replaced and not stages:
            raise _NotMeasured(f"not applicable: no solver with particles is one of {', '.join(replaced)}")
        measurements.append(_measure_frames(example, frames, request["check_every"], stages, progress))

    replace_name(newton.examples, "run", run)
    if not request["download"]:
        replace_name(newton.utils, "download_asset", _refuse_download)
        replace_name(newton.examples, "download_external_git_folder", _refuse_download)
    _replace_solvers(replaced, _StagedType if request["mode"] == "stage" else _ImplicitType, stages)
    options = ["--viewer", "null", "--quiet", "--device", request["device"], *request["options"]]
    if request["frames"] is not None:
        options += ["--num-frames", str(request["frames"])]
    sys.argv = [request["module"], *options]
    runpy.run_module(request["module"], run_name="__main__")
    if not measurements:
        raise _NotMeasured("not applicable: it does not call newton.examples.run")
    return measurements[0]


def _refuse_download(*arguments, **options):
    """Stands in for the functions of Newton that download."""
    asset = next((str(argument) for argument in (*arguments, *options.values())), "")
    raise _NotMeasured(describe_download(asset))


class _StagedType(type):
    """The type of solver classes whose instances come with the collision stage behind them.

    They are subclasses of Newton's, so that examples may read their attributes and derive from them. What they make is
    of Newton's class itself, as a user's solver is.
    """

    stages: list[Any]
    original: type

    def __call__(cls, *arguments, **options):
        """Makes a solver and returns the stage behind it, or the solver if it has no particles."""
        from ...response.solver_ccd import SolverCCD  # noqa: PLC0415 (imports Newton)

        is_derived = "original" not in cls.__dict__
        solver = super().__call__(*arguments, **options) if is_derived else cls.original(*arguments, **options)
        if not solver.model.particle_count:
            return solver
        stage = SolverCCD(solver)
        cls.stages.append(stage)
        return stage

    def __instancecheck__(cls, instance):
        """Returns whether an instance, or the solver before a stage, is of the class, or of Newton's in its place."""
        from ...response.solver_ccd import SolverCCD  # noqa: PLC0415 (imports Newton)

        solver = instance.solver if isinstance(instance, SolverCCD) else instance
        return super().__instancecheck__(solver) or isinstance(solver, cls.__dict__.get("original", ()))


class _ImplicitType(_StagedType):
    """The type of a class in place of VBD's whose instances are solvers with contact inside."""

    def __call__(cls, *arguments, **options):
        """Makes a solver of the model, whatever the other arguments, or VBD if it has no particles."""
        from ...implicit.solver_implicit import SolverImplicit  # noqa: PLC0415 (imports Newton)

        model = options["model"] if "model" in options else arguments[0]
        if not model.particle_count:
            return super().__call__(*arguments, **options)
        solver: Any = SolverImplicit(model)
        solver.rebuild_bvh = lambda state: None  # VBD's, which examples call
        cls.stages.append(solver)
        return solver


def _replace_solvers(replaced: Sequence[str], kind: type[_StagedType], stages: list[Any]) -> None:
    """Replaces solvers in :mod:`newton.solvers` by classes of a type, which list the stages that they make.

    This must come before the example is imported: it may import the classes by name.
    """
    import newton.solvers  # noqa: PLC0415 (slow)

    from ..._private_names.of_newton import replace_name  # noqa: PLC0415 (imports Newton)

    for name in replaced:
        solver = getattr(newton.solvers, name)
        names = {"__doc__": solver.__doc__, "__module__": solver.__module__, "stages": stages, "original": solver}
        replace_name(newton.solvers, name, kind(name, (solver,), names))


def _measure_frames(
    example: Any, frames: int, check_every: int, stages: list[Any], progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Runs the frames of an example as ``newton.examples.run`` does, and its tests.

    Args:
        example: The example, constructed.
        frames: Number of frames.
        check_every: Number of frames after which crossings are counted again; those of the last frame are as well.
        stages: The stages behind or in place of its solvers.
        progress: Called with the number of frames done and the number of all.
    """
    from ..crossings import CrossingCounter  # noqa: PLC0415 (imports Newton)

    state, model = _name_of_state(example), example.model
    crossings = CrossingCounter(model)
    post_step = _Test(example, "test_post_step")
    seconds = []
    at_start = crossings.count(getattr(example, state))
    most, first_crossed, first_not_finite = 0, None, None
    for frame in range(frames):
        progress(frame, frames)
        wp.synchronize_device(model.device)
        start = time.perf_counter()
        example.step()
        wp.synchronize_device(model.device)
        seconds.append(time.perf_counter() - start)
        post_step.run()
        example.render()
        if first_not_finite is None and (frame % check_every == check_every - 1 or frame == frames - 1):
            if crossings.is_finite(getattr(example, state)):
                count = crossings.count(getattr(example, state))
                most = max(most, count)
                if count > at_start and first_crossed is None:
                    first_crossed = frame
            else:
                first_not_finite = frame
    progress(frames, frames)
    final = _Test(example, "test_final")
    final.run()
    totals = [
        [getattr(stage.report.totals, name) for name in STAGE_TOTALS]  # each reads the device
        for stage in stages
    ]
    return {
        "device": str(model.device),
        "particles": model.particle_count,
        "triangles": model.tri_count,
        "tetrahedra": model.tet_count,
        "shapes": model.shape_count,
        "frames": frames,
        "crossings_at_start": at_start,
        "most_crossings": most,
        "first_frame_with_crossings": first_crossed,
        "first_frame_not_finite": first_not_finite,
        "stage": dict(zip(STAGE_TOTALS, map(sum, zip(*totals, strict=True)), strict=True)) if totals else None,
        "test_final": final.result,
        "test_post_step": post_step.result,
        "milliseconds": describe_times([1e3 * took for took in seconds[WARM_UP:]]),
    }


class _Test:
    """A test of an example, by name.

    Attributes:
        result: "ok", the first line of the message if it failed, None if the example has no test of this name, or
            it did not run.
    """

    def __init__(self, example: Any, name: str):
        self._test = getattr(example, name, None)
        self.result: str | None = None

    def run(self) -> None:
        """Runs the test, unless it failed before."""
        if self._test is None or self.result not in (None, "ok"):
            return
        try:
            self._test()
            self.result = "ok"
        except (AssertionError, ValueError) as error:
            self.result = _first_line(error)
        except Exception as error:
            self.result = _describe_error(error)


def _name_of_state(example: Any) -> str:
    """Returns the name of the attribute that has an example's present state, which the example may replace by another.

    Raises:
        _NotMeasured: If the example has no cloth and no soft bodies, or its state is not where Newton's examples have
            theirs.
    """
    model, name = getattr(example, "model", None), next((n for n in ("state_0", "state") if hasattr(example, n)), "")
    if model is None or not name:
        raise _NotMeasured("not applicable: it has no attributes model and state_0")
    if not model.tri_count + model.tet_count:
        raise _NotMeasured("not applicable: it has neither cloth nor soft bodies")
    return name


def _main() -> None:
    """Serves the request in the argument, and writes replies as lines of JSON to standard output.

    All other output, also that of native code, goes to standard error.
    """
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def reply(values: dict[str, Any]) -> None:
        replies.write(json.dumps(values) + "\n")
        replies.flush()

    serve(json.loads(sys.argv[1]), reply)


if __name__ == "__main__":
    _main()
