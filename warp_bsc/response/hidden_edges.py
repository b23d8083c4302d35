"""Hidden edges: pairs of edges that push nothing, because a face at one of them is met before it."""

import warp as wp

from .buffers import Motion
from .constraints import are_on_body, to_double
from .exclusion import Connectivity

__all__ = ["are_hidden"]

_MOST_BEND, _LEAST_BEND = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1e-3))
"""Sines of the angles by which a sheet may bend towards a body, and a body towards a sheet, which rounding allows."""


@wp.func
def _at(motion: Motion, vertex: int, time: wp.float64) -> wp.vec3d:
    start = to_double(motion.x0[vertex])
    return start + time * (to_double(motion.x1[vertex]) - start)


@wp.func
def are_hidden(
    motion: Motion, mesh: Connectivity, edges: wp.vec2i, corners: wp.vec4i, normal: wp.vec3d, time: wp.float64
) -> bool:
    """Returns whether one of two edges, of which a body moves one, is not what the other meets first along a normal.

    This is so if a face at the edge reaches farther along the normal than the edge: the edges of a triangulated flat
    face, or those of a sheet that the side of a box has run into from above. To push along such a normal would hold
    what slides. Sheets may bend around a body by 30 degrees to either side, bodies do not bend.

    Args:
        motion: The motion.
        mesh: Its connectivity.
        edges: The edges.
        corners: Their vertices.
        normal: Unit vector from the second to the first.
        time: When, in [0, 1].
    """
    if not are_on_body(motion, corners):
        return False
    for side in range(2):
        edge = edges[side]
        a = corners[2 * side]
        b = corners[2 * side + 1]
        out = wp.where(side == 0, -normal, normal)
        most = wp.where(a < motion.bodies.particle_count, _MOST_BEND, _LEAST_BEND)
        for i in range(mesh.edge_faces.first[edge], mesh.edge_faces.first[edge + 1]):
            face = mesh.edge_faces.items[i]
            third = mesh.faces[face, 0] + mesh.faces[face, 1] + mesh.faces[face, 2] - a - b
            origin = _at(motion, a, time)
            along = wp.normalize(_at(motion, b, time) - origin)
            across = _at(motion, third, time) - origin
            across -= wp.dot(across, along) * along
            if wp.dot(across, out) > most * wp.length(across):
                return True
    return False
