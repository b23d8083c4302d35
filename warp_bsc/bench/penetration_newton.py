"""Runs the scenes of ``warp-bsc bench penetration`` with solvers of Newton, plain and behind the stage."""

from collections.abc import Callable
from typing import Any

import newton
import numpy as np

from ..response.state.mesh import host_array
from .penetration_scenes import PenetrationScene
from .penetration_states import Trajectory
from .response_simulation import NotFinite, Simulation

__all__ = ["simulate_newton"]

_ITERATIONS = 10
"""Of VBD and XPBD in Newton's examples cloth_hanging, softbody_hanging and, for XPBD, cloth_hanging --solver xpbd."""
_STYLE3D_ITERATIONS = 4
"""In Newton's example cloth_style3d."""
_PAIRS = {"particle_vertex_contact_buffer_size": 64, "particle_edge_contact_buffer_size": 128}
"""VBD's buffers in Newton's example cloth_twist; pairs that do not fit are dropped."""
_FARTHEST = 100.0
"""Distance from the origin [m] from which on a scene, which is within a metre, has burst."""


class _States:
    """Keeps the positions of each state, in place of :class:`.response_simulation.Samples`."""

    def __init__(self):
        self.positions: list[np.ndarray] = []

    def add(self, state: newton.State) -> bool:
        """Keeps a state; returns whether its positions are finite.

        Raises:
            NotFinite: If they are finite, and so far away that the scene has burst.
        """
        self.positions.append(host_array(state.particle_q).copy())
        farthest = np.abs(self.positions[-1]).max()
        if _FARTHEST < farthest < np.inf:
            raise NotFinite(f"it bursts: particles are {farthest:.0f} m away after step {len(self.positions) - 1}")
        return bool(np.isfinite(farthest))


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
        solver: One of :data:`.response.SOLVERS`.
        rate: Steps a second.
        seconds: Simulated time [s].
        progress: Called with the number of steps done and the number of all.
        has_self_contact: Whether VBD has contacts between particles of its own.
        has_stage: Whether :class:`warp_bsc.SolverCCD` with default arguments is behind the solver, without contacts of
            Newton; without it the solver has these.

    Raises:
        NotFinite: If positions are not finite, or the scene bursts.
    """
    states = _States()
    simulation = Simulation(
        built.scene,
        solver,
        rate,
        has_contacts=not has_stage,
        stage_options={} if has_stage else None,
        inner=_make_solver(built, solver, has_self_contact=has_self_contact),
        samples=states,
    )
    simulation.run(seconds, progress)
    stage = simulation.stage
    return Trajectory(
        states.positions,
        simulation.milliseconds,
        uncertified_steps=stage.report.totals.uncertified_steps if stage else None,
        substepped_steps=sum(count > 1 for count in simulation.substeps) if stage else None,
    )


def _make_solver(built: PenetrationScene, solver: str, *, has_self_contact: bool) -> Any:
    """Returns a solver with the settings of Newton's examples."""
    model, solvers = built.scene.model, newton.solvers
    if solver == "xpbd":
        # Newton has no example of tetrahedra with XPBD; with its default relaxation they burst in Newton itself
        return solvers.SolverXPBD(model, iterations=_ITERATIONS, soft_body_relaxation=0.2)
    if solver == "style3d":
        return solvers.SolverStyle3D(model, config=solvers.SolverStyle3D.Config(iterations=_STYLE3D_ITERATIONS))
    if solver == "semi-implicit":
        return solvers.SolverSemiImplicit(model)
    own: dict[str, Any] = {}
    if has_self_contact:
        own = {"particle_self_contact_margin": built.margin, "particle_self_contact_gap": built.gap, **_PAIRS}
    return solvers.SolverVBD(model, iterations=_ITERATIONS, particle_enable_self_contact=has_self_contact, **own)
