"""Measures what a solver and the collision stage make of scenes in contact: stretch, rest, energy and time.

The scenes are in :mod:`..scenes.contact`, which is imported with Newton when the first one is measured.
"""

import contextlib
import io
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

__all__ = [
    "CONFIGURATIONS",
    "CONVERGED",
    "EARLY_STEPS",
    "REFERENCE",
    "REFERENCE_RATE",
    "SCENES",
    "SEMI_IMPLICIT_STEPS",
    "SOLVERS",
    "WARM_UP",
    "ResponseMeasurement",
    "ResponseRun",
    "Spread",
    "measure_response",
]

SCENES = (
    "sphere",
    "box_edge",
    "tube_cone",
    "fold",
    "soft_bowl",
    "pile",
    "press",
    "press_tight",
    "ropes",
    "ball",
    "ball_two_way",
    "worlds",
)
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

_STAGES: dict[str, dict[str, Any]] = {"stage": {}, "stage+contacts": {}, REFERENCE: {}}
"""Arguments of the stage by configuration."""

_IMPLICIT: dict[str, dict[str, Any]] = {"implicit": {}, CONVERGED: {"max_iterations": 200}}
"""Arguments of the solver with contact inside, by configuration."""


@dataclass(frozen=True)
class Spread:
    """Differences between two runs of which one begins with all particles moved sideways.

    Attributes:
        distance: How far they are moved [m].
        stretch_at_end: Difference of the stretches at the end [%].
        stretch_at_most: Difference of the largest stretches [%].
    """

    distance: float
    stretch_at_end: float
    stretch_at_most: float


@dataclass(frozen=True)
class ResponseMeasurement:
    """What a run gave.

    Attributes:
        device: The Warp device.
        particles: Number of particles.
        triangles: Number of triangles of cloth and of the surfaces of soft bodies.
        rate: Steps a second.
        steps: Number of steps.
        stretch_at_end: Largest elongation of an edge of cloth, a tetrahedron or a spring beyond its length at rest,
            mean over the last tenth of the steps [%].
        stretch_at_most: The same, the largest of all steps [%].
        rest_speed: Mean speed of movable particles over the last tenth of the steps [mm/s].
        energy_gained: Largest rise of the kinetic, gravitational and elastic energy of a world above its least value
            so far [J]; None where a program moves something, and behind other solvers than VBD, whose elastic energies
            are others. Contacts have no energy here: what Newton's, which are springs, give back counts as a rise.
        crossings: Crossings of cloth, soft bodies and springs at the end, also with rigid shapes.
        collisions: Vertex-face and edge-edge pairs that meet on the straight way of a step, at least one of them not of
            a rigid shape, in all steps together; None for the reference, which has too many.
        uncertified_steps: Steps that were not certified; None without a stage.
        milliseconds: Time of each step but the first :data:`WARM_UP` [ms], with Newton's contacts; two steps are timed
            together.
        early: Positions after :data:`EARLY_STEPS` steps [m], shape [particle_count, 3]; None if there are fewer steps.
        spread: What a small offset of the start changes; None if it was not measured.
    """

    device: str
    particles: int
    triangles: int
    rate: int
    steps: int
    stretch_at_end: float
    stretch_at_most: float
    rest_speed: float
    energy_gained: float | None
    crossings: int
    collisions: int | None
    uncertified_steps: int | None
    milliseconds: list[float]
    early: np.ndarray | None = field(default=None, repr=False)
    spread: Spread | None = None

    def distance_from(self, other: "ResponseMeasurement") -> float | None:
        """Mean distance of the particles from those of a run with equal steps, after as many [mm]; None without it."""
        if self.early is None or other.early is None or self.rate != other.rate:
            return None
        return 1e3 * float(np.linalg.norm(self.early - other.early, axis=1).mean())

    @property
    def median(self) -> float:
        """Median time of a step [ms]."""
        return float(np.median(self.milliseconds))

    @property
    def mean(self) -> float:
        """Mean time of a step [ms]."""
        return float(np.mean(self.milliseconds))


@dataclass(frozen=True)
class ResponseRun:
    """A run of a scene in a configuration.

    Attributes:
        scene: One of :data:`SCENES`.
        solver: One of :data:`SOLVERS`.
        configuration: One of :data:`CONFIGURATIONS`.
        measured: The measurement; None if there is none.
        problem: Why there is no measurement; None if there is one.
    """

    scene: str
    solver: str
    configuration: str
    measured: ResponseMeasurement | None = None
    problem: str | None = None


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
        perturb: Distance [m]: the configuration ``stage`` runs a second time with all particles moved that far along x,
            see :class:`Spread`.
        progress: Called with the number of steps done and the number of all.

    Returns:
        The measurement, or the reason why there is none: the solver cannot run the scene, or positions are not finite.

    Raises:
        ValueError: If a name is unknown or a number out of range.
    """
    for name, value, known in (
        ("scene", scene, SCENES),
        ("configuration", configuration, CONFIGURATIONS),
        ("solver", solver, SOLVERS),
    ):
        if value not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}, not {value!r}")
    if seconds is not None and not 0.0 < seconds < math.inf:
        raise ValueError(f"seconds must be finite and more than 0, not {seconds}")
    for name, number in (("rate", rate), ("reference_rate", reference_rate)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be at least 1, not {number}")
    if perturb is not None and not 0.0 < perturb < math.inf:
        raise ValueError(f"perturb must be finite and more than 0, not {perturb}")
    from ..scenes.contact import NotRunnable  # noqa: PLC0415 (imports Newton)
    from ..scenes.simulation import NotFinite  # noqa: PLC0415 (imports Newton)

    if configuration == "self-contact" and solver != "vbd":
        return ResponseRun(scene, solver, configuration, problem="only VBD has contacts between particles of cloth")
    if configuration in _IMPLICIT and solver != "vbd":
        return ResponseRun(scene, solver, configuration, problem="SolverImplicit takes the place of VBD")
    passes = 2 if perturb is not None and configuration == "stage" else 1

    def run(number: int, offset: float) -> ResponseMeasurement:
        def show(done: int, steps: int) -> None:
            if progress:
                progress(number * steps + done, passes * steps)

        return _measure(scene, configuration, solver, seconds, rate, reference_rate, offset, show)

    try:
        with wp.ScopedDevice(device), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            # what Style3D prints would be part of a JSON output; large strain is measured, and needs no warning
            warnings.simplefilter("ignore", UserWarning)
            measured = run(0, 0.0)
            if perturb is not None and passes == 2:
                moved = run(1, perturb)
                at_end, at_most = (
                    abs(getattr(moved, name) - getattr(measured, name))
                    for name in ("stretch_at_end", "stretch_at_most")
                )
                measured = replace(measured, spread=Spread(perturb, at_end, at_most))
    except (NotRunnable, NotFinite) as reason:
        return ResponseRun(scene, solver, configuration, problem=str(reason))
    return ResponseRun(scene, solver, configuration, measured=measured)


def _measure(
    scene: str,
    configuration: str,
    solver: str,
    seconds: float | None,
    rate: int | None,
    reference_rate: int,
    offset: float,
    progress: Callable[[int, int], None],
) -> ResponseMeasurement:
    """Runs a scene once, with all particles moved by an offset along x."""
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
    return ResponseMeasurement(
        device=str(built.model.device),
        particles=built.model.particle_count,
        triangles=built.model.tri_count,
        rate=rate,
        steps=steps,
        stretch_at_end=100.0 * float(np.mean(samples.stretch[-last:])),
        stretch_at_most=100.0 * max(samples.stretch[1:]),
        rest_speed=1e3 * float(np.mean(samples.speed[-last:])),
        energy_gained=energy_gained(np.array(samples.energy), samples.restarts) if counts_energy else None,
        crossings=simulation.count_crossings(),
        collisions=sum(simulation.collisions) if configuration != REFERENCE else None,
        uncertified_steps=stage.report.totals.uncertified_steps if stage else None,
        milliseconds=simulation.milliseconds[WARM_UP:],
        early=samples.early,
    )
