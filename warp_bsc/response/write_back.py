"""Kernels that write a resolved step to a state."""

import warp as wp

from .state.certificate import revoke_if_not_finite
from .state.motion import StateArrays
from .state.status import Result, SolveStatus
from .state.structs import FROZEN, TRUNCATED, Vertices

wp.set_module_options({"enable_backward": False})


@wp.func
def _write_cuts(outcome: int, status: SolveStatus):
    """Writes to the status whether a path was truncated, or something was frozen."""
    if outcome & TRUNCATED != 0:
        status.results[Result.TRUNCATED] = 1
    if outcome & FROZEN != 0:
        status.results[Result.FROZEN] = 1


@wp.kernel
def write_back(vertices: Vertices, end: StateArrays, body_q_prev: wp.array[wp.transform], status: SolveStatus):
    """Writes the particles and bodies that the response changed; the others keep every bit of what they are.

    VBD takes the velocity of its next step from ``body_q_prev``, where it has that array.
    """
    i = wp.tid()
    bodies = vertices.bodies
    if i < bodies.outcome.shape[0] and bodies.outcome[i] != 0:
        end.body_q[i] = bodies.pose[i]
        end.body_qd[i] = bodies.velocity[i]
        if body_q_prev:
            body_q_prev[i] = bodies.pose[i]
        _write_cuts(bodies.outcome[i], status)
    if i >= vertices.outcome.shape[0]:
        return
    outcome = vertices.outcome[i]
    revoke_if_not_finite(outcome, i < end.particle_q.shape[0], status)
    if i >= end.particle_q.shape[0]:  # a vertex of a shape, which moves with its body, wherever that is
        return
    if outcome != 0:
        end.particle_q[i] = vertices.x1[i]
        end.particle_qd[i] = vertices.velocity[i]
    _write_cuts(outcome, status)
