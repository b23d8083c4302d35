"""Finds the tetrahedra that the motion of a step inverts, or may invert, by certified signs of their volumes."""

import warp as wp

from ...detection.settings import TOLERANCE
from ...kernels.inversion import inversion_tetrahedron
from ...kernels.signs import FREE
from ..schedule import SolveStatus, count_inversion
from ..state.structs import ContactKind, Step, Tetrahedra
from ..state.workspace import Workspace
from .first_contact import packed_contact

wp.set_module_options({"enable_backward": False})

_TOLERANCE = wp.constant(wp.float64(TOLERANCE))


@wp.kernel
def _find(step: Step, tetrahedra: Tetrahedra, status: SolveStatus):
    """Counts a tetrahedron whose volume is not certainly positive in the whole step, and finds since when.

    One of which this already holds at the start is counted apart: no cut makes it positive. One without a vertex that
    can be moved is left out, like contacts.
    """
    i = wp.tid()
    motion, vertices, corners = step.motion, step.vertices, tetrahedra.corners
    a = corners[i, 0]
    b = corners[i, 1]
    c = corners[i, 2]
    d = corners[i, 3]
    masses = motion.inverse_mass[a] + motion.inverse_mass[b] + motion.inverse_mass[c] + motion.inverse_mass[d]
    if masses == 0.0:
        return
    a0, b0, c0, d0 = motion.x0[a], motion.x0[b], motion.x0[c], motion.x0[d]
    a1, b1, c1, d1 = vertices.x1[a], vertices.x1[b], vertices.x1[c], vertices.x1[d]
    found = inversion_tetrahedron(a0, b0, c0, d0, a1, b1, c1, d1, _TOLERANCE)
    if found.status == FREE:
        return
    at_start = inversion_tetrahedron(a0, b0, c0, d0, a0, b0, c0, d0, _TOLERANCE).status != FREE
    count_inversion(status, motion.world[a], at_start)
    if at_start or not tetrahedra.first_inversion:
        return
    packed = packed_contact(found.toi, int(ContactKind.NONE), 0)
    for j in range(4):
        vertex = corners[i, j]
        wp.atomic_min(tetrahedra.first_inversion, vertex, packed)
        vertices.changed[vertex] = 1


def find_inversions(work: Workspace) -> None:
    """Counts the tetrahedra that the motion inverts as it is now, all of them; finds when, if that is prevented."""
    of_worlds = work.status.of_worlds
    for counts in (of_worlds.inverting, of_worlds.inverted):
        if counts is not None:
            counts.zero_()
    assert work.tetrahedra is not None
    work.launch(_find, len(work.mesh.tets), [work.step, work.tetrahedra, work.status])
