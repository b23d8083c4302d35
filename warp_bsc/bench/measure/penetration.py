"""Runs the same scenes through several simulators, and judges each by exact detection on its states.

The scenes are in :mod:`..scenes.penetration`, which is imported with Newton when the first one is run.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from ..._arguments import checked_choice
from ..record import Run, silenced, version_of
from ..tables import Column, Table, count, grouped

SCENES = {
    "bullet": "a patch is shot at a held sheet, at 20 m/s",
    "drape": "a cloth drapes over a sphere",
    "stack": "five sheets fall on a sphere, each other and a floor",
    "twist": "two borders of a cloth are turned against each other",
    "soft": "a soft block is thrown on a held sheet, at 4 m/s",
}
"""The scenes, and what happens in each."""

FRAME_RATE = 60
"""Frames a second."""

WARM_UP = 2
"""Steps at the start whose times are left out: kernels are compiled and buffers grow in them."""


@dataclass(frozen=True)
class Simulator:
    """A simulator with its settings."""

    title: str  # its name for people
    rate: int  # steps a second
    settings: str  # its settings, and where they come from
    claims: str | None = None  # what it says of penetration; None if nothing
    package: str = "newton"  # the distribution that it comes with
    # one of :data:`.response.SOLVERS`, or ``"implicit"``; None for one that is not for Newton
    solver: str | None = None
    has_self_contact: bool = False  # whether VBD has contacts between particles of its own
    has_stage: bool = False  # whether :class:`warp_bsc.SolverCCD` is behind the solver, or the solver is one itself


def _with_stage(inner: Simulator) -> Simulator:
    settings = "default arguments, without Newton's contacts"
    return replace(inner, title=f"SolverCCD({inner.title})", settings=settings, claims=_CERTIFIES, has_stage=True)


_CERTIFIES = "certifies each step, or reports that it did not"
_VBD = Simulator("VBD", 600, "10 iterations, 10 steps a frame: Newton's softbody_hanging", solver="vbd")
_XPBD = Simulator("XPBD", 600, "10 iterations, 10 steps a frame: Newton's cloth_hanging --solver xpbd", solver="xpbd")
_STYLE3D = Simulator("Style3D", 600, "4 iterations, 10 steps a frame: Newton's cloth_style3d", solver="style3d")

SIMULATORS = {
    "vbd": _VBD,
    "vbd-self-contact": Simulator(
        "VBD, self-contact",
        600,
        "10 iterations, 10 steps a frame; margin and gap of Newton's softbody_dropping_to_cloth and cloth_twist",
        "paths are truncated (Divide and Truncate) so that nothing penetrates, but for pairs within two rings of edges",
        solver="vbd",
        has_self_contact=True,
    ),
    "style3d": _STYLE3D,
    "xpbd": _XPBD,
    "semi-implicit": Simulator(
        "SemiImplicit",
        3840,
        "64 steps a frame; Newton's cloth_hanging --solver semi_implicit has 32, with which light cloth bursts",
        solver="semi-implicit",
    ),
    "ccd-vbd": _with_stage(_VBD),
    "ccd-style3d": _with_stage(_STYLE3D),
    "ccd-xpbd": _with_stage(_XPBD),
    "implicit": Simulator(
        "SolverImplicit",
        FRAME_RATE,
        "default arguments, one step a frame, without Newton's contacts",
        _CERTIFIES,
        solver="implicit",
        has_stage=True,
    ),
    "mujoco-ipc": Simulator(
        "MuJoCo, ipc",
        600,
        "flag ipc, discrete integrator, solver Newton, tolerance 1e-6: MuJoCo's documentation, Deformables",
        "2D flexes cannot tunnel through each other, themselves or static shapes; no friction; experimental",
        package="mujoco",
    ),
    "libuipc": Simulator(
        "libuipc",
        120,
        "default configuration, two steps a frame, for its default of 0.01 s; contact from 1 mm on",
        "no penetration from valid starts, while its solves succeed",
        package="pyuipc",
    ),
}
"""The simulators by the names of the command."""

_LINES = "\n".join(f"  {name:18}{simulator.title}" for name, simulator in SIMULATORS.items())

DESCRIPTION = f"""\
Run the same scenes through several simulators, each with the settings that its
own examples or documentation recommend, and judge each by exact detection on
its states: edges that pass through faces at frame ends, of cloth and soft
bodies with themselves, each other and fixed shapes; pairs that meet on the way
from each state to the next, where the motion passes through; tetrahedra that
are inverted. A row also has the share of its speed that a freely flying body
keeps before it meets anything, the largest stretch of an edge, and the time of
a step. MuJoCo runs on the CPU, libuipc on a GPU, Newton's solvers on --device.
The simulators:
{_LINES}
SolverCCD and SolverImplicit have their default arguments. A simulator that is
not installed or cannot run a scene is a row, and a line below says why."""

EXAMPLES = f"""\
scenes:
{chr(10).join(f"  {name:8}{text}" for name, text in SCENES.items())}

examples:
  warp-bsc bench penetration
  warp-bsc bench penetration --scene bullet,twist --simulator vbd,ccd-vbd
  warp-bsc bench penetration --device cuda:0 --json penetration.json"""

_COLUMNS = (
    Column("Cross-\nings\nworst", lambda took: max(took["crossings"]), width=6),
    Column("\n\nsum", lambda took: sum(took["crossings"]), width=9),
    Column("Met\non the\nway", "collisions", width=10),
    Column("In-\nver-\nted", lambda took: max(took["inverted"]), width=5),
    Column("Speed\nkept\n[%]", "speed_kept", lambda share: f"{100.0 * share:.1f}", width=5),
    Column("Stretch\n\n[%]", "stretch", ",.1f", width=9),
    Column("Step\n\n[ms]", "milliseconds.median", ",.2f", width=8),
)


@dataclass(frozen=True)
class PenetrationRun(Run):
    """A run of a scene with a simulator.

    Attributes:
        scene: A key of :data:`SCENES`.
        simulator: A key of :data:`SIMULATORS`.
        measured: Plain data for JSON. ``device``, that of Newton's solvers, "cpu" for MuJoCo, "cuda" for libuipc;
            ``version``, that of the distribution that the simulator comes with; numbers of ``particles``, of
            ``triangles`` of cloth and of the surfaces of soft bodies, of ``frames`` and ``steps``; ``crossings``,
            ``shape_crossings`` and ``inverted`` of each frame end, and ``stretch``, as of :meth:`.judge.Judge.judge`;
            ``collisions``, the pairs that meet on the straight way from each state to the next, all, and
            ``colliding_steps``, the steps in which there are such pairs; ``speed_kept``, the share of its speed that a
            freely flying body keeps before it meets anything, None where nothing flies for a step;
            ``uncertified_steps``, None without a stage; ``milliseconds``, the median and mean time of a step but the
            first :data:`WARM_UP` [ms].
    """

    scene: str
    simulator: str


def measure_penetration(
    scene: str,
    simulator: str,
    *,
    device: str | wp.Device | None = None,
    frames: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PenetrationRun:
    """Runs a scene with a simulator, and judges its states.

    Args:
        scene: A key of :data:`SCENES`.
        simulator: A key of :data:`SIMULATORS`.
        device: The Warp device of Newton's solvers and of detection; default: the current one.
        frames: Number of frames; default: that of the scene. Newton's solvers take at least four steps.
        progress: Called with how much is done and how much there is to do, in steps: each is taken, then judged.

    Returns:
        The measurement, or the reason why there is none: the simulator is not installed or cannot run the scene, or
        positions are not finite.

    Raises:
        ValueError: If a name is unknown or ``frames`` less than 1.
    """
    checked_choice(scene, "scene", tuple(SCENES))
    checked_choice(simulator, "simulator", tuple(SIMULATORS))
    if frames is not None and frames < 1:
        raise ValueError(f"frames must be at least 1, not {frames}")
    from ..peers.states import NotInstalled  # noqa: PLC0415 (imports Newton)
    from ..scenes.contact import NotRunnable  # noqa: PLC0415 (imports Newton)
    from ..scenes.simulation import NotFinite  # noqa: PLC0415 (imports Newton)

    try:
        with wp.ScopedDevice(device), silenced():
            measured = _measure(scene, simulator, frames, progress or (lambda done, steps: None))
    except (NotInstalled, NotRunnable, NotFinite) as reason:
        return PenetrationRun(scene, simulator, problem=str(reason))
    return PenetrationRun(scene, simulator, measured=measured)


def _measure(scene: str, name: str, frames: int | None, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Runs and judges a scene on the current device."""
    from ..scenes.penetration import build_penetration_scene  # noqa: PLC0415 (imports Newton)
    from .judge import Judge  # noqa: PLC0415 (imports Newton)

    simulator = SIMULATORS[name]
    built = build_penetration_scene(scene, simulator.solver or "vbd", simulator.rate)
    model = built.scene.model
    seconds = built.scene.seconds if frames is None else frames / FRAME_RATE
    device, trajectory = _simulate(built, name, seconds, lambda done, steps: progress(done, 2 * steps))
    states, timed = trajectory.states, trajectory.milliseconds[WARM_UP:] or trajectory.milliseconds
    steps = len(states) - 1
    judged = Judge(model).judge(states, simulator.rate // FRAME_RATE, lambda done: progress(steps + done, 2 * steps))
    return judged | {
        "device": device,
        "version": version_of(simulator.package) or "of unknown version",  # built from source
        "particles": model.particle_count,
        "triangles": model.tri_count,
        "frames": len(judged["crossings"]),
        "steps": steps,
        "collisions": sum(judged["collisions"]),
        "colliding_steps": sum(found > 0 for found in judged["collisions"]),
        "speed_kept": find_speed_kept(built, states, simulator.rate),
        "uncertified_steps": trajectory.uncertified_steps,
        "milliseconds": {"median": float(np.median(timed)), "mean": float(np.mean(timed))},
    }


def _simulate(built, name: str, seconds: float, progress: Callable[[int, int], None]):
    """Runs a scene with a simulator, whose library is imported now; returns the device and the trajectory."""
    simulator = SIMULATORS[name]
    if simulator.solver:
        from ..peers.newton_solvers import simulate_newton  # noqa: PLC0415

        options = {"has_self_contact": simulator.has_self_contact, "has_stage": simulator.has_stage}
        device = str(built.scene.model.device)
        return device, simulate_newton(built, simulator.solver, simulator.rate, seconds, progress, **options)
    if name == "mujoco-ipc":
        from ..peers.mujoco_flex import simulate_mujoco  # noqa: PLC0415

        return "cpu", simulate_mujoco(built, simulator.rate, seconds, progress)
    from ..peers.libuipc import simulate_libuipc  # noqa: PLC0415

    return "cuda", simulate_libuipc(built, simulator.rate, seconds, progress)


def find_speed_kept(built, states: list[np.ndarray], rate: int) -> float | None:
    """Returns the way of the centre of what flies freely, as a share of that of a free fall at its first velocity.

    None without it, and where the first step goes as far as what it meets.
    """
    steps = min(max(1, math.floor(built.seconds * rate)), len(states) - 1)
    if not len(built.flying) or steps / rate >= 4.0 / 3.0 * built.seconds:
        return None
    first, last = (states[i][built.flying.start : built.flying.stop].mean(axis=0, dtype=float) for i in (0, steps))
    t, flight = steps / rate, np.array(built.flight)
    gravity = built.scene.model.gravity.numpy().reshape(-1, 3)[0].astype(float)
    free = flight * t + 0.5 * gravity * t * t
    return float((last - first) @ free / (free @ free))


def to_dict(runs: list[PenetrationRun]) -> dict[str, Any]:
    """Returns runs as plain data for JSON, with their scenes and simulators."""
    return {
        "steps_left_out": WARM_UP,
        "scenes": {name: SCENES[name] for name in grouped(runs, "scene")},
        "simulators": {name: asdict(SIMULATORS[name]) for name in grouped(runs, "simulator")},
        "runs": [vars(run) for run in runs],
    }


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement, one for each scene, a row a simulator; versions and claims."""
    runs, device = found["runs"], f"{found['device']}, {found['device_name']}"
    yield f"Penetration, Newton's solvers on {device}; medians of a step without the first {found['steps_left_out']}"
    for scene, group in grouped(runs, "scene").items():
        yield ""
        rows = [(SIMULATORS[run["simulator"]].title, run["measured"]) for run in group]
        yield Table(Column(scene, width=20, kind="text"), _COLUMNS, rows)
        if sizes := next((took for _, took in rows if took), None):
            parts = (count(sizes[f"{name}s"], name) for name in ("particle", "triangle", "frame"))
            yield f"{SCENES[scene].capitalize()}: {', '.join(parts)}"
        for run, (title, took) in zip(group, rows, strict=True):
            if took is None:
                yield f"{title}: not run: {run['problem']}"
            elif took["uncertified_steps"]:
                yield f"{title}: {count(took['uncertified_steps'], 'step')} of {took['steps']:,} not certified"
    yield ""
    yield "Crossings: edges through faces at frame ends, in the worst frame and in all together."
    yield "Met on the way: pairs that meet on the straight way from a state to the next, in all steps."
    yield "Inverted: tetrahedra in the worst frame. Speed kept: of a free flight before anything is met."
    for name, group in grouped((run for run in runs if run["measured"]), "simulator").items():
        simulator, version = SIMULATORS[name], group[0]["measured"]["version"]
        claims = f"claims: {simulator.claims}" if simulator.claims else "claims nothing of penetration"
        yield f"{simulator.title}: {simulator.package} {version}; {simulator.settings}; {claims}."
