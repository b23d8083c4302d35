"""Finds the tetrahedra that the motion of a step inverts, or may invert, by certified signs of their volumes."""

import warp as wp

from ...detection.run.settings import TOLERANCE
from ...kernels.inversion import inversion_tetrahedron
from ...kernels.signs import FREE
from ..schedule import count_inversion
from ..state.status import Result, SolveStatus
from ..state.structs import NEVER, ContactKind, Step, Tetrahedra
from ..state.vectors import ZERO, to_double
from ..state.workspace import Workspace
from .first_contact import packed_contact

wp.set_module_options({"enable_backward": False})

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))


@wp.func
def _vertices_to_cut(step: Step, corners: wp.vec4i, time: wp.float64) -> wp.vec4i:
    """Returns those of the vertices of a tetrahedron whose motion makes it flat at a time, -1 in place of the others.

    They are those along whose paths its volume falls. If none of these can be moved, they are all that can.
    """
    paths = wp.matrix(shape=(4, 3), dtype=wp.float64)
    at = wp.matrix(shape=(4, 3), dtype=wp.float64)
    for j in range(4):
        x0 = to_double(step.motion.x0[corners[j]])
        paths[j] = to_double(step.vertices.x1[corners[j]]) - x0
        at[j] = x0 + time * paths[j]
    u = at[1] - at[0]
    v = at[2] - at[0]
    w = at[3] - at[0]
    gradients = wp.matrix(shape=(4, 3), dtype=wp.float64)  # of six times the volume
    gradients[1] = wp.cross(v, w)
    gradients[2] = wp.cross(w, u)
    gradients[3] = wp.cross(u, v)
    gradients[0] = -(gradients[1] + gradients[2] + gradients[3])
    movable = wp.vec4i(-1)
    falls = wp.vec4i(-1)
    any_falls = bool(False)
    for j in range(4):
        if step.motion.inverse_mass[corners[j]] > 0.0:
            movable[j] = corners[j]
            if wp.dot(gradients[j], paths[j]) < ZERO:
                falls[j] = corners[j]
                any_falls = True
    if any_falls:
        return falls
    return movable


@wp.kernel
def _find(step: Step, tetrahedra: Tetrahedra, status: SolveStatus):
    """Counts a tetrahedron whose volume is not certainly positive in the whole step, and finds since when.

    One of which this already holds at the start is counted apart: no cut makes it positive. One without a vertex that
    can be moved is left out, like contacts.
    """
    i = wp.tid()
    motion, vertices = step.motion, step.vertices
    corners = wp.vec4i()
    mass = float(0.0)
    for j in range(4):
        corners[j] = tetrahedra.corners[i, j]
        mass += motion.inverse_mass[corners[j]]
    if mass == 0.0:
        return
    x0, x1 = motion.x0, vertices.x1
    a0, b0, c0, d0 = x0[corners[0]], x0[corners[1]], x0[corners[2]], x0[corners[3]]
    a1, b1, c1, d1 = x1[corners[0]], x1[corners[1]], x1[corners[2]], x1[corners[3]]
    found = inversion_tetrahedron(a0, b0, c0, d0, a1, b1, c1, d1, _TOLERANCE)
    if found.status == FREE:
        return
    at_start = inversion_tetrahedron(a0, b0, c0, d0, a0, b0, c0, d0, _TOLERANCE).status != FREE
    count_inversion(status, motion.world[corners[0]], at_start)
    if at_start or not tetrahedra.first_inversion:
        return
    packed = packed_contact(found.toi, int(ContactKind.NONE), 0)
    cut = _vertices_to_cut(step, corners, found.toi)
    for j in range(4):
        vertices.changed[corners[j]] = 1
        if cut[j] >= 0:
            wp.atomic_min(tetrahedra.first_inversion, cut[j], packed)


def find_inversions(work: Workspace) -> None:
    """Counts the tetrahedra that the motion inverts as it is now, all of them; finds when, if that is prevented."""
    assert work.tetrahedra is not None
    of_worlds, results = work.status.of_worlds, work.results
    for count in (results[Result.INVERTING], results[Result.INVERTED], of_worlds.inverting, of_worlds.inverted):
        if count is not None:
            count.zero_()
    if work.ends is not None:
        work.tetrahedra.first_inversion.fill_(NEVER)
    work.launch(_find, len(work.mesh.tets), [work.step, work.tetrahedra, work.status])
