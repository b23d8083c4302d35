"""Runs the scenes of ``warp-bsc bench penetration`` with solvers of Newton, plain and behind the stage."""

from collections.abc import Callable

import newton
import numpy as np

from ...response.report.strain import edges_at_rest
from ...response.state.mesh import host_array
from ..scenes.penetration import PenetrationScene
from ..scenes.simulation import NotFinite, Simulation, largest_stretch, make_solver, self_contact
from .states import Trajectory

_ITERATIONS = 10
"""Of VBD and XPBD in Newton's examples cloth_hanging, softbody_hanging and, for XPBD, cloth_hanging --solver xpbd."""
_STYLE3D_ITERATIONS = 4
"""In Newton's example cloth_style3d."""
_BURST = 10.0
"""Elongation of an edge, as a share of its length at rest, from which on a scene has burst, and is not judged."""


class _States:
    """Keeps the positions of each state, in place of :class:`..scenes.simulation.Samples`."""

    def __init__(self, model: newton.Model):
        self.positions: list[np.ndarray] = []
        self._edges, self._lengths, _ = edges_at_rest(model)

    def add(self, state: newton.State) -> bool:
        """Keeps a state; returns whether its positions are finite.

        Raises:
            NotFinite: If they are finite, and the scene has burst.
        """
        x = host_array(state.particle_q).copy()
        self.positions.append(x)
        if not np.isfinite(x).all():
            return False
        stretch = largest_stretch(x, self._edges, self._lengths)
        if stretch > _BURST:
            raise NotFinite(
                f"it bursts: after step {len(self.positions) - 1} an edge is {1.0 + stretch:.0f} times as long"
            )
        return True


def simulate_newton(
    built: PenetrationScene,
    solver: str,
    rate: int,
    seconds: float,
    progress: Callable[[int, int], None],
    *,
    has_self_contact: bool,
    has_stage: bool,
) -> Trajectory:
    """Runs a scene, on a GPU from a CUDA graph of two steps.

    Args:
        built: The scene.
        solver: One of :data:`..measure.response.SOLVERS`, or ``"implicit"``.
        rate: Steps a second.
        seconds: Simulated time [s].
        progress: Called with the number of steps done and the number of all.
        has_self_contact: Whether VBD has contacts between particles of its own.
        has_stage: Whether :class:`warp_bsc.SolverCCD` with default arguments is behind the solver, or the solver is
            one itself, without contacts of Newton; without it the solver has these.

    Raises:
        NotFinite: If positions are not finite, or the scene bursts.
    """
    model = built.scene.model
    states, inner = _States(model), None
    if solver != "implicit":
        own = self_contact(built.margin, built.gap) if has_self_contact else {"particle_enable_self_contact": False}
        inner = make_solver(model, solver, _STYLE3D_ITERATIONS if solver == "style3d" else _ITERATIONS, **own)
    options = {"has_contacts": not has_stage, "stage_options": {} if has_stage else None}
    simulation = Simulation(built.scene, solver, rate, **options, inner=inner, samples=states)
    simulation.run(seconds, progress)
    uncertified = simulation.stage.report.totals.uncertified_steps if simulation.stage else None
    return Trajectory(states.positions, simulation.milliseconds, uncertified)
