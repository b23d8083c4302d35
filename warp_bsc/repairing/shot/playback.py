"""Steps SolverCCD behind a solver that moves particles to given positions."""

import warnings
from typing import Any

import newton
import numpy as np
from newton.solvers import SolverBase

from ...detection.mesh import CollisionMesh
from ...response.solver_ccd import SolverCCD
from ...response.state.collision_filter import CollisionFilter


class Playback:
    """The stage behind a solver that moves the vertices of a mesh to given positions."""

    def __init__(self, mesh: CollisionMesh, x: np.ndarray, is_movable: np.ndarray, min_distance: float):
        """Makes the model of a mesh at ``x``, float32, shape [vertex_count, 3], with its groups, masks and distance."""
        builder = newton.ModelBuilder()
        builder.add_particles(x.tolist(), np.zeros_like(x).tolist(), is_movable.astype(float).tolist())
        builder.add_triangles(*mesh.faces.astype(np.int64).T.tolist())
        model = builder.finalize(device=mesh.device)
        self._given = _Given(model)
        options: dict[str, Any] = {"friction": 0.0, "restitution": 0.0, "min_distance": min_distance}
        if mesh.group is not None and mesh.mask is not None:
            options["collision_filter"] = CollisionFilter(mesh.group, mesh.mask)
        self._stage = SolverCCD(self._given, **options)
        self._start, self._end = model.state(), model.state()

    def step(self, start: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, bool]:
        """Returns the positions that the stage makes of a motion, and whether it certifies the motion to them.

        All positions are float32, shape [vertex_count, 3].
        """
        assert self._start.particle_q is not None and self._end.particle_q is not None
        self._start.particle_q.assign(start)
        self._given.target = target
        self._stage.reset(self._start)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "a step strained an edge")  # which springs relax
            warnings.filterwarnings("ignore", "edges pass through")  # of a first frame that could not be freed
            self._stage.step(self._start, self._end, None, None, 1.0)
            certified = self._stage.report.certified  # which warns as a step does
        return self._end.particle_q.numpy().copy(), certified


class _Given(SolverBase):
    """A solver that moves particles to given positions, float32, shape [particle_count, 3]."""

    target: np.ndarray

    def step(self, state_in, state_out, control, contacts, dt):
        """Writes the target, and the velocity that reaches it."""
        state_out.particle_q.assign(self.target)
        state_out.particle_qd.assign((self.target - state_in.particle_q.numpy()) / np.float32(dt))
