"""The stage that only watches: it reports the collisions of another solver's steps, and changes nothing."""

from collections.abc import Collection
from typing import Literal

import numpy as np
import warp as wp
from newton.solvers import SolverBase

from .._one_thread import one_at_a_time
from ..detection.run.host_function import run_on_host
from .contacts.detect import inspect
from .drive.inner_steps import InnerSteps
from .options import checked_report, default_separation, friction_of
from .stage import CollisionStage
from .state.collision_filter import CollisionFilter, checked_filter
from .state.kept_distances import KeptDistances
from .state.mesh import ModelMesh
from .state.motion import ModelMotion, arrays_of


class CollisionMonitor(CollisionStage):
    """Lets another solver step, and reports the collisions of its motion; changes no bit of its results.

    Each step costs one detection. The certificate is that of :class:`.solver_ccd.SolverCCD`: a certified step is free
    of collisions, except for those of elements that crossed or touched at its start. The :attr:`report` counts a
    contact among its ``hits`` in the step that passes it. Elements that cross from then on are counted in
    ``crossings``, and their contacts as ``excluded``. With a minimum distance, it counts the pairs that come nearer
    than they may. On a :class:`warp.Tape` a step records what the inner solver records.

    Attributes:
        solver: The inner solver.
        mesh: The triangles that collide, :class:`.state.mesh.ModelMesh`.
        report: What the monitor found, :class:`.report.SolverReport`.
        work: The buffers of a step, ``state.workspace.Workspace``.
    """

    def __init__(
        self,
        solver: SolverBase,
        *,
        min_distance: float | Literal["model"] | wp.array[float] | None = None,
        particle_radius: float | np.ndarray | wp.array | None = None,
        collision_filter: CollisionFilter | None = None,
        report: Collection[Literal["worlds"]] = (),
    ):
        """Puts the monitor behind a solver.

        Args:
            solver: Any Newton solver that moves particles.
            min_distance: Distance that pairs should keep [m], or ``"model"``, as for :class:`.solver_ccd.SolverCCD`.
            particle_radius: Radius of each particle [m], as for :class:`.solver_ccd.SolverCCD`.
            collision_filter: Groups and masks of particles and shapes: pairs that they leave out are not watched,
                :class:`.state.collision_filter.CollisionFilter`.
            report: ``["worlds"]`` makes ``report.worlds`` have results by world, as for :class:`.solver_ccd.SolverCCD`.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a distance is out of range, or the filter does not fit the model.
            NotImplementedError: If the model has shapes that are not supported, see :class:`.state.mesh.ModelMesh`.
        """
        super().__init__(solver)
        _, counts_worlds = checked_report(report, self.model, choices=["worlds"])
        distances = KeptDistances.of(self.model, min_distance, particle_radius)
        collision_filter = checked_filter(collision_filter, self.model)
        of_mesh = {"collision_filter": collision_filter, "uses_margins": distances.has_fixed_margins}
        mesh = ModelMesh(self.model, strands=distances.any, **of_mesh)
        self._warn_of_unseen(mesh, distances)
        if distances.any:
            mesh.keep_distances(distances, reach=0.0)
        nothing = wp.zeros(max(1, self.model.shape_count), dtype=float, device=mesh.device)
        friction = friction_of(mesh, nothing[:1], nothing)
        motion = ModelMotion(mesh, friction, watches_turns=True)
        self._allocate(motion, default_separation(mesh), nothing, responds=False)
        if counts_worlds:
            self._count_worlds()
        self._inner = InnerSteps(self)
        self._prepare_entry()

    def _resolve(self, step):
        end = arrays_of(step.state_out)
        run_on_host(lambda: self._inspect(step, end), self.mesh.device)

    @one_at_a_time
    def _inspect(self, step, end):
        """Detects the collisions of the motion from the start of the step to its end, and counts the step."""
        with self._prepared(step, end):
            inspect(self.work)
