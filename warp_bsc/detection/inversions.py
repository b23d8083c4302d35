"""Tetrahedra that invert in a motion, or are inverted in one configuration: certified signs of their volumes."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from .. import checker
from .._arguments import check_finite
from ..kernels.exact.inversion import tetrahedron_inverts_in
from ..kernels.exact.polygon import BITS
from ..kernels.inversion import first_inversion
from ..kernels.motion import query_at
from ..kernels.signs import FREE, HIT, ROUNDOFF, UNSURE
from .mesh import CollisionMesh
from .run.launch import launch_over, made_once
from .run.settings import NO_FUSED_OPERATIONS, NO_GRADIENTS, Method


@dataclass(frozen=True, eq=False)
class Inversions:
    """The tetrahedra whose volume is 0 or negative at some time of a motion, both ends included.

    Attributes:
        tets: Their rows in ``mesh.tets``, sorted, int32, shape [n].
        status: Certified status by floating point, for any method: 1 HIT, 2 UNSURE; 0 FREE only by method "float";
            int8, shape [n].
        toi: Time before which the volume is certainly positive, as a share of the step, float64, shape [n]; by method
            "float" it is computed, not certain.
        within_tolerance: Whether that is the time of inversion to within the tolerance, bool, shape [n]. By method
            "exact" it is; by the others it may be earlier where floating point cannot certify more.
    """

    tets: np.ndarray
    status: np.ndarray
    toi: np.ndarray
    within_tolerance: np.ndarray


@made_once
def _classify(dtype: type) -> wp.Kernel:
    """Returns the kernel that finds first inversions, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def classify(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        tets: wp.array2d[int],
        # accuracy
        roundoff: wp.float64,
        tolerance: wp.float64,
        # out
        status: wp.array[wp.int8],
        toi: wp.array[wp.float64],
        within_tolerance: wp.array[bool],
    ):
        i = first + wp.tid()
        vertices = wp.vec4i(tets[i, 3], tets[i, 0], tets[i, 1], tets[i, 2])
        found = first_inversion(query_at(x0, x1, vertices), roundoff, tolerance)
        status[i] = wp.int8(found.status)
        toi[i] = found.toi
        within_tolerance[i] = found.within_tolerance == 1

    return classify


@made_once
def _decide_exactly(dtype: type, limbs: int) -> wp.Kernel:
    """Returns the kernel that decides UNSURE tetrahedra in wide integers, for one type of position and one width."""
    tetrahedron_inverts = tetrahedron_inverts_in(limbs)

    @wp.kernel(**NO_GRADIENTS)
    def decide_exactly(
        first: int,
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        tets: wp.array2d[int],
        # in and out
        status: wp.array[wp.int8],
    ):
        i = first + wp.tid()
        if int(status[i]) != UNSURE:
            return
        vertices = wp.vec4i(tets[i, 3], tets[i, 0], tets[i, 1], tets[i, 2])
        status[i] = wp.int8(tetrahedron_inverts(query_at(x0, x1, vertices)))

    return decide_exactly


def inversions_of_motion(
    mesh: CollisionMesh, x0: wp.array, x1: wp.array, *, method: Method, tolerance: float
) -> Inversions:
    """Returns the tetrahedra of a mesh that invert in a motion.

    Args:
        mesh: The mesh.
        x0: Positions at the start on the mesh's device, array of vec3 or vec3d.
        x1: Positions at the end, of the same type; those at the start for one configuration.
        method: As of :class:`.detector.CollisionDetector`.
        tolerance: Of the times, as a share of the step.

    Raises:
        ValueError: If a position of a tetrahedron is not finite.
    """
    device, tets, n = mesh.device, mesh.device_tets, len(mesh.tets)
    types = wp.int8, wp.float64, bool
    status, toi, within_tolerance = (wp.zeros(n, dtype=dtype, device=device) for dtype in types)

    def classify(roundoff):
        inputs = [x0, x1, tets, roundoff, wp.float64(tolerance)]
        launch_over(_classify(x0.dtype), n, inputs=inputs, outputs=[status, toi, within_tolerance], device=device)
        return status.numpy().copy()  # on the CPU, the array itself

    certified = classify(ROUNDOFF)
    if (certified == UNSURE).any():
        for name, x in [("x", x0)] if x0 is x1 else [("x0", x0), ("x1", x1)]:
            check_finite(x.numpy(), name, np.unique(mesh.tets))
    inverts = certified != FREE
    if method == "float":
        inverts = classify(wp.float64(0.0)) != FREE
    elif method == "exact":
        inverts = _decided(mesh, x0, x1, status) == HIT
    (found,) = np.nonzero(inverts)
    times, are_within = toi.numpy()[found], within_tolerance.numpy()[found]
    if method == "exact" and not are_within.all():
        status.assign(np.where(inverts & ~within_tolerance.numpy(), UNSURE, FREE).astype(np.int8))
        at_start = _decided(mesh, x0, x0, status)[found] == HIT  # their time is 0, as no earlier one is
        left = ~are_within & ~at_start
        times[left] = checker.tetrahedron_toi(_points(mesh.tets[found[left]], x0, x1))[:, 0]
        are_within[:] = True
    return Inversions(found.astype(np.int32), certified[found], times, are_within)


def _decided(mesh: CollisionMesh, x0: wp.array, x1: wp.array, status: wp.array) -> np.ndarray:
    """Returns the status of all tetrahedra after the exact phase, and the checker where numbers are too wide for it."""
    tets = mesh.device_tets
    for limbs in BITS:
        if not (status.numpy() == UNSURE).any():
            break
        kernel, inputs = _decide_exactly(x0.dtype, limbs), [x0, x1, tets]
        launch_over(kernel, len(mesh.tets), inputs=inputs, outputs=[status], device=mesh.device, block_dim=64)
    decided = status.numpy()
    (left,) = np.nonzero(decided == UNSURE)
    if len(left):
        decided[left] = np.where(checker.tetrahedron(_points(mesh.tets[left], x0, x1)), HIT, FREE)
    return decided


def _points(corners: np.ndarray, x0: wp.array, x1: wp.array) -> np.ndarray:
    """Returns the positions of tetrahedra at both ends, shape [n, 8, 3]."""
    return np.concatenate([x0.numpy()[corners], x1.numpy()[corners]], axis=1)
