"""Measures what a solver and the collision stage make of scenes in contact: stretch, rest, energy and time.

The scenes are in :mod:`..scenes.contact`, which is imported with Newton when the first one is measured.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from ..._arguments import checked_choice, checked_number
from ..record import Run, silenced
from ..tables import Column, Table, count, grouped, in_thousands

_NAMES = "sphere box_edge tube_cone fold soft_bowl pile press press_tight ropes ball ball_two_way worlds"
SCENES = tuple(_NAMES.split())
"""Names of the scenes."""

REFERENCE = "reference"
"""The configuration with a small step."""

CONVERGED = "converged"
"""The configuration whose Newton steps are not limited."""

CONFIGURATIONS = ("plain", "self-contact", "stage", "stage+contacts", "implicit", CONVERGED, REFERENCE)
"""The configurations.

``plain``: the solver with Newton's contacts. ``self-contact``: the same with VBD's own contacts between particles.
``stage``: :class:`warp_bsc.SolverCCD` with default arguments, without contacts of Newton. ``stage+contacts``: the same
with them. ``implicit``: :class:`warp_bsc.SolverImplicit` with default arguments, in place of VBD, whose energies it
has. ``converged``: the same with as many Newton steps as a step needs. ``reference``: ``stage`` at a small step.
"""

SOLVERS = ("vbd", "xpbd", "style3d", "semi-implicit")
"""The inner solvers."""

REFERENCE_RATE = 1920
"""Default number of steps a second of the reference."""

SEMI_IMPLICIT_STEPS = 32
"""Steps of the semi-implicit solver in place of one, where no rate is given: it is explicit, and bursts at larger ones.
"""

WARM_UP = 2
"""Steps at the start whose times are left out: kernels are compiled and buffers grow in them."""

EARLY_STEPS = 48
"""Steps after which positions are compared with those of :data:`CONVERGED`."""

DESCRIPTION = f"""\
Run scenes in which cloth, soft bodies, ropes and a ball touch, at 1/60 s, and
measure what each configuration of a solver and the collision stage makes of
them: the largest stretch of an edge, at the end and at most; the speed at rest;
the energy that is gained behind VBD, where nothing does work, with that of
elastic strain; the edges that cross faces at the end, and the pairs that meet
on the straight way of a step, found in exact arithmetic; the time of a step, on
a GPU in a CUDA graph; and the steps that were not certified. The balls take steps of 1/120 s.
The configurations:
  plain           the solver with Newton's contacts
  self-contact    the same with VBD's own contacts between particles
  stage           SolverCCD with default arguments, without Newton's contacts
  stage+contacts  the same with Newton's contacts
  implicit        SolverImplicit with default arguments, in place of VBD
  converged       the same with as many Newton steps as a step needs
  reference       SolverCCD at a small step: slow
Ropes have particle_radius, without which nothing collides with springs. The
semi-implicit solver takes {SEMI_IMPLICIT_STEPS} times as many steps in all configurations, unless
--rate is given. A scene that the solver cannot run is a row, and a line below
says why."""

EXAMPLES = f"""\
scenes:
  {" ".join(SCENES[:8])}
  {" ".join(SCENES[8:])}

examples:
  warp-bsc bench response --no-reference
  warp-bsc bench response box_edge --rate 240 --no-reference
  warp-bsc bench response sphere box_edge --device cuda:0
  warp-bsc bench response sphere --configurations stage --perturb 1e-6
  warp-bsc bench response --solver xpbd --json response.json"""

_COLUMNS = (
    Column("Stretch\nat end\n[%]", "stretch_at_end", in_thousands(2), width=7),
    Column("at\nmost\n[%]", "stretch_at_most", in_thousands(2), width=7),
    Column("Speed\nat end\n[mm/s]", "rest_speed", in_thousands(1), width=6),
    Column("Energy\ngained\n[J]", "energy_gained", ",.4f", width=7),
    Column("Cross-\nings", "crossings", width=6),
    Column("Pairs\nmeet", "collisions", width=6),
    Column("A step:\nmedian\n[ms]", "milliseconds.median", in_thousands(2), width=7),
    Column("\nmean\n[ms]", "milliseconds.mean", in_thousands(2), width=6),
)  # 80 columns with the first one and the gaps

_STAGES: dict[str, dict[str, Any]] = {"stage": {}, "stage+contacts": {}, REFERENCE: {}}
"""Arguments of the stage by configuration."""

_IMPLICIT: dict[str, dict[str, Any]] = {"implicit": {}, CONVERGED: {"max_iterations": 200}}
"""Arguments of the solver with contact inside, by configuration."""


@dataclass(frozen=True)
class ResponseRun(Run):
    """A run of a scene in a configuration.

    Attributes:
        scene: One of :data:`SCENES`.
        solver: One of :data:`SOLVERS`.
        configuration: One of :data:`CONFIGURATIONS`.
        early: Positions after :data:`EARLY_STEPS` steps [m], shape [particle_count, 3]; None if there are fewer steps.
        measured: Plain data for JSON. ``device``, that of Warp; numbers of ``particles``, and of ``triangles`` of cloth
            and of the surfaces of soft bodies; ``rate``, steps a second; ``steps``, the number of steps;
            ``stretch_at_end``, the largest elongation of an edge of cloth, a tetrahedron or a spring beyond its length
            at rest, mean over the last tenth of the steps, and ``stretch_at_most``, the largest of all steps [%];
            ``rest_speed``, the mean speed of movable particles over the last tenth of the steps [mm/s];
            ``energy_gained``, the largest rise of the kinetic, gravitational and elastic energy of a world above its
            least value so far [J], None where a program moves something, and behind other solvers than VBD, whose
            elastic energies are others (contacts have no energy here: what Newton's, which are springs, give back
            counts as a rise); ``crossings`` of cloth, soft bodies and springs at the end, also with rigid shapes;
            ``collisions``, the vertex-face and edge-edge pairs that meet on the straight way of a step, at least one of
            them not of a rigid shape, in all steps together, None for the reference, which has too many;
            ``uncertified_steps``, None without a stage; ``milliseconds``, the median, mean and worst time of a step but
            the first :data:`WARM_UP` [ms], with Newton's contacts, of which two are timed together; ``spread``, what a
            small offset of the start changes, None if it was not measured: ``distance``, how far all particles are
            moved sideways [m], and the differences of ``stretch_at_end`` and ``stretch_at_most`` [%].
    """

    scene: str
    solver: str
    configuration: str
    early: np.ndarray | None = field(default=None, repr=False)

    def distance_from(self, other: "ResponseRun | None") -> float | None:
        """Mean distance of the particles from those of a run with equal steps, after as many [mm]; None without it."""
        if (
            other is None
            or self.early is None
            or other.early is None
            or self.measured["rate"] != other.measured["rate"]
        ):
            return None
        return 1e3 * float(np.linalg.norm(self.early - other.early, axis=1).mean())


def measure_response(
    scene: str,
    configuration: str,
    *,
    solver: str = "vbd",
    device: str | wp.Device | None = None,
    seconds: float | None = None,
    rate: int | None = None,
    reference_rate: int = REFERENCE_RATE,
    perturb: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ResponseRun:
    """Runs a scene in a configuration, on a GPU from a CUDA graph of two steps, and measures it.

    Args:
        scene: One of :data:`SCENES`.
        configuration: One of :data:`CONFIGURATIONS`.
        solver: One of :data:`SOLVERS`.
        device: The Warp device; default: the current one.
        seconds: Simulated time [s]; default: that of the scene. There are at least four steps, and an even number.
        rate: Steps a second of the other configurations; default: that of the scene, and of the semi-implicit solver
            :data:`SEMI_IMPLICIT_STEPS` times as many.
        reference_rate: Steps a second of the reference.
        perturb: Distance [m]: the configuration ``stage`` runs a second time with all particles moved that far along x.
        progress: Called with the number of steps done and the number of all.

    Returns:
        The measurement, or the reason why there is none: the solver cannot run the scene, or positions are not finite.

    Raises:
        ValueError: If a name is unknown or a number out of range.
    """
    checked_choice(scene, "scene", SCENES)
    checked_choice(configuration, "configuration", CONFIGURATIONS)
    checked_choice(solver, "solver", SOLVERS)
    for name, number in (("seconds", seconds), ("perturb", perturb)):
        if number is not None:
            checked_number(number, name, 0.0, above=True)
    for name, number in (("rate", rate), ("reference_rate", reference_rate)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, not {number}")
    from ..scenes.contact import NotRunnable  # noqa: PLC0415 (imports Newton)
    from ..scenes.simulation import NotFinite  # noqa: PLC0415 (imports Newton)

    if configuration == "self-contact" and solver != "vbd":
        return ResponseRun(scene, solver, configuration, problem="only VBD has contacts between particles of cloth")
    if configuration in _IMPLICIT and solver != "vbd":
        return ResponseRun(scene, solver, configuration, problem="SolverImplicit takes the place of VBD")
    passes = 2 if perturb is not None and configuration == "stage" else 1

    def run(number: int, offset: float) -> tuple[dict[str, Any], np.ndarray | None]:
        def show(done: int, steps: int) -> None:
            if progress:
                progress(number * steps + done, passes * steps)

        return _measure(scene, configuration, solver, seconds, rate, reference_rate, offset, show)

    try:
        with wp.ScopedDevice(device), silenced():
            measured, early = run(0, 0.0)
            if perturb is not None and passes == 2:
                moved, _ = run(1, perturb)
                names = "stretch_at_end", "stretch_at_most"
                measured["spread"] = {"distance": perturb} | {n: abs(moved[n] - measured[n]) for n in names}
    except (NotRunnable, NotFinite) as reason:
        return ResponseRun(scene, solver, configuration, problem=str(reason))
    return ResponseRun(scene, solver, configuration, early, measured=measured)


def _measure(
    scene: str,
    configuration: str,
    solver: str,
    seconds: float | None,
    rate: int | None,
    reference_rate: int,
    offset: float,
    progress: Callable[[int, int], None],
) -> tuple[dict[str, Any], np.ndarray | None]:
    """Runs a scene once, with all particles moved by an offset along x; returns what it gave, and early positions."""
    from ..scenes.contact import build_scene  # noqa: PLC0415 (imports Newton)
    from ..scenes.simulation import Simulation, energy_gained  # noqa: PLC0415 (imports Newton)

    built = build_scene(scene, solver, rate or 60)
    is_explicit = solver == "semi-implicit"
    own_rate = SEMI_IMPLICIT_STEPS * built.rate if is_explicit else built.rate
    if configuration == REFERENCE:
        rate = max(reference_rate, own_rate) if is_explicit else reference_rate
    elif rate is None:
        rate = own_rate
    is_implicit = configuration in _IMPLICIT
    simulation = Simulation(
        built,
        "implicit" if is_implicit else solver,
        rate,
        has_self_contact=configuration == "self-contact",
        has_contacts=configuration in ("plain", "self-contact", "stage+contacts"),
        stage_options=(_STAGES | _IMPLICIT).get(configuration),
        offset=offset,
        counts_collisions=configuration != REFERENCE,
        early_steps=EARLY_STEPS,
    )
    steps = simulation.run(built.seconds if seconds is None else seconds, progress)
    stage, samples, last = simulation.stage, simulation.samples, max(1, steps // 10)
    counts_energy = solver == "vbd" and not built.motion
    took = simulation.milliseconds[WARM_UP:]
    measured = {
        "device": str(built.model.device),
        "particles": built.model.particle_count,
        "triangles": built.model.tri_count,
        "rate": rate,
        "steps": steps,
        "stretch_at_end": 100.0 * float(np.mean(samples.stretch[-last:])),
        "stretch_at_most": 100.0 * max(samples.stretch[1:]),
        "rest_speed": 1e3 * float(np.mean(samples.speed[-last:])),
        "energy_gained": energy_gained(np.array(samples.energy), samples.restarts) if counts_energy else None,
        "crossings": simulation.count_crossings(),
        "collisions": sum(simulation.collisions) if configuration != REFERENCE else None,
        "uncertified_steps": stage.report.totals.uncertified_steps if stage else None,
        "milliseconds": {"median": float(np.median(took)), "mean": float(np.mean(took)), "worst": max(took)},
        "spread": None,
    }
    return measured, samples.early


def to_dict(runs: list[ResponseRun]) -> dict[str, Any]:
    """Returns runs as plain data for JSON, with how far particles are from those of the converged run [mm]."""
    converged = {run.scene: run for run in runs if run.configuration == CONVERGED}
    rows = [vars(run) | {"from_converged": run.distance_from(converged.get(run.scene))} for run in runs]
    for row in rows:
        del row["early"]
    return {"steps_left_out": WARM_UP, "runs": rows}


def show(found: dict[str, Any]) -> Iterator[Table | str]:
    """Yields the tables of the JSON of a measurement, one for each scene, a row a run; why runs are missing."""
    device = f"{found['device']}, {found['device_name']}"
    yield f"Contact on {device}; times of a step without the first {found['steps_left_out']}"
    for scene, runs in grouped(found["runs"], "scene").items():
        yield ""
        first = Column(f"{scene}\n{runs[0]['solver']}", width=14, kind="text")
        yield Table(first, _COLUMNS, [(run["configuration"], run["measured"]) for run in runs])
        yield from _describe(runs)


def _describe(runs: list[dict[str, Any]]) -> Iterator[str]:
    """Yields the lines below the table of a scene."""
    if measured := [run["measured"] for run in runs if run["measured"]]:
        steps = dict.fromkeys(f"{count(took['steps'], 'step')} of 1/{took['rate']} s" for took in measured)
        sizes = (count(measured[0][f"{name}s"], name) for name in ("particle", "triangle"))
        yield ", ".join([*sizes, " or ".join(steps)])
    for run in runs:
        name, took = run["configuration"], run["measured"]
        if took is None:
            yield f"{name}: not run: {run['problem']}"
            continue
        if took["uncertified_steps"]:
            yield f"{name}: {count(took['uncertified_steps'], 'step')} not certified"
        if spread := took["spread"]:
            yield (
                f"{name}, moved by {spread['distance']:g} m: stretch differs by "
                f"{spread['stretch_at_end']:.2f} at the end, {spread['stretch_at_most']:.2f} at most"
            )
    distances = {run["configuration"]: run["from_converged"] for run in runs}
    shown = [f"{name} {mm:.2f}" for name, mm in distances.items() if mm is not None and name != CONVERGED]
    if shown:
        yield f"Mean distance from {CONVERGED} after {EARLY_STEPS} steps [mm]: {', '.join(shown)}"
