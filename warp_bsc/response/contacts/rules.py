"""Which contacts the response resolves: rules by masses, bodies, crossings at the start, and occluded edges."""

from enum import IntEnum

import warp as wp
from newton import ShapeFlags

from ...kernels.crossing import edge_crosses_face
from ...kernels.exact.rest import meet_at_rest
from ...kernels.pairs import form_of, is_filtered
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...kernels.signs import HIT
from ..state.structs import Bodies, Motion, Step, body_of, can_move
from ..state.vectors import ZERO, corners_of, to_double
from ..tuning import BEND_OF_BODY, BEND_OF_SHEET, PARALLEL

_COLLIDE_SHAPES = wp.constant(int(ShapeFlags.COLLIDE_SHAPES))


class ContactClass(IntEnum):
    """What the response does with a contact."""

    OURS = 0  # resolves it
    CROSSED = 1  # excludes it, because its elements crossed or touched at the start: the inner solver parts them
    OF_BODIES = 2  # counts it, and leaves it to the inner solver, because it is between bodies
    NONE = 3  # ignores it: nothing can be moved, or bodies that touched at the start
    FILTERED = 4  # counts it: of two shapes that Newton's flags, groups or filters keep from colliding


@wp.func
def inverse_mass_of(motion: Motion, vertex: int) -> float:
    """Returns the inverse mass of a vertex, or of the body that it moves with [1/kg]; 0 where nothing can move it."""
    body = body_of(motion, vertex)
    if body >= 0:
        return motion.bodies.inverse_mass[body]
    return motion.inverse_mass[vertex]


@wp.func
def are_on_body(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether one of two elements is of a body that can be moved."""
    return can_move(motion, body_of(motion, corners[0])) or can_move(motion, body_of(motion, corners[3]))


@wp.func
def collides(bodies: Bodies, shape: int, other: int) -> bool:
    """Returns whether two shapes are to collide: by their flags, their groups, and the pairs that are filtered out.

    Shapes of one positive group collide with each other, and with all negative groups but no other positive one; those
    of a negative group with all but their own; those of group 0 with none.
    """
    if bodies.shape_flags[shape] & bodies.shape_flags[other] & _COLLIDE_SHAPES == 0:
        return False
    group = bodies.shape_collision_group[shape]
    other_group = bodies.shape_collision_group[other]
    if group == 0 or other_group == 0 or wp.where(group == other_group, group < 0, group > 0 and other_group > 0):
        return False
    shapes = wp.int64(bodies.shape_flags.shape[0])
    key = wp.int64(wp.min(shape, other)) * shapes + wp.int64(wp.max(shape, other))
    place = wp.lower_bound(bodies.filtered, key)
    return place == bodies.filtered.shape[0] or bodies.filtered[place] != key


@wp.func
def crosses_face(step: Step, edge: int, face: int) -> bool:
    """Returns whether an edge certainly crosses a face at the start; not if a filter leaves the pair out."""
    mesh = step.mesh
    for end in range(2):
        for corner in range(3):
            if mesh.edges[edge, end] == mesh.faces[face, corner]:
                return False
    x = step.motion.x0
    p = mesh.edges[edge, 0]
    q = mesh.edges[edge, 1]
    corners = wp.vec3i(mesh.faces[face, 0], mesh.faces[face, 1], mesh.faces[face, 2])
    if is_filtered(step.motion.pair_filter, wp.vec3i(p, q, q), corners):
        return False
    a = x[mesh.faces[face, 0]]
    b = x[mesh.faces[face, 1]]
    c = x[mesh.faces[face, 2]]
    return edge_crosses_face(x[p], x[q], a, b, c) == HIT


@wp.func
def crossed_at_start(step: Step, kind: int, pair: wp.vec2i) -> bool:
    """Returns whether a contact belongs to elements that certainly crossed at the start of the step.

    A vertex that passes through a face changes which of the vertex's edges cross that face; an edge that passes through
    another changes which of the faces at either edge the other crosses. So the contact of a vertex and a face belongs
    to a crossing if one of the vertex's edges crosses that face, and the contact of two edges if one of them crosses a
    face of the other. Crossing surfaces come apart by these contacts. Points cross nothing.
    """
    mesh = step.mesh
    if kind == EDGE_EDGE:
        for side in range(2):
            other = pair[1 - side]
            for i in range(mesh.edge_faces.first[other], mesh.edge_faces.first[other + 1]):
                if crosses_face(step, pair[side], mesh.edge_faces.items[i]):
                    return True
    if kind == VERTEX_FACE:
        for i in range(mesh.vertex_edges.first[pair[0]], mesh.vertex_edges.first[pair[0] + 1]):
            if crosses_face(step, mesh.vertex_edges.items[i], pair[1]):
                return True
    return False


@wp.func
def owner_of(motion: Motion, corners: wp.vec4i) -> int:
    """Returns the ContactClass of two elements as far as it follows from their vertices, not CROSSED.

    Those of two bodies, or of a body and a static shape, are of bodies unless the response keeps these apart.
    """
    for j in range(4):
        if motion.inverse_mass[corners[j]] > 0.0:
            return ContactClass.OURS
    if not are_on_body(motion, corners):
        return ContactClass.NONE
    a = corners[0] - motion.bodies.particle_count
    b = corners[3] - motion.bodies.particle_count
    if wp.min(a, b) < 0:  # a particle that is held
        return ContactClass.OURS
    if body_of(motion, corners[0]) == body_of(motion, corners[3]):
        return ContactClass.NONE
    if not collides(motion.bodies, motion.bodies.shape[a], motion.bodies.shape[b]):
        return ContactClass.FILTERED
    return wp.where(motion.bodies.responds == 1, int(ContactClass.OURS), int(ContactClass.OF_BODIES))


@wp.func
def classify_contact(
    step: Step, kind: int, pair: wp.vec2i, corners: wp.vec4i, owner: int, bound: wp.float64, may_cross: bool
) -> int:
    """Returns the ContactClass of a contact of an owner, as of :func:`owner_of`.

    Above a ``bound`` of 0, which is a lower one of the time of impact, or of the distance at the start, the elements
    did not touch at the start; at 0, which it also is for contacts soon after the start, an exact test decides. Nothing
    that can be moved crosses at the start unless it ``may_cross``.
    """
    met = bool(False)
    if not bound > ZERO:
        x = step.motion.x0
        met = meet_at_rest(form_of(kind), x[corners[0]], x[corners[1]], x[corners[2]], x[corners[3]])
    if not met and (may_cross or owner != ContactClass.OURS):
        met = crossed_at_start(step, kind, pair)
    if not met:
        return owner
    return wp.where(owner == ContactClass.OURS, int(ContactClass.CROSSED), int(ContactClass.NONE))


@wp.func
def _at(motion: Motion, vertex: int, time: wp.float64) -> wp.vec3d:
    start = to_double(motion.x0[vertex])
    return start + time * (to_double(motion.x1[vertex]) - start)


@wp.func
def are_parallel(motion: Motion, edges: wp.vec4i) -> bool:
    """Returns whether two edges are nearly parallel: bending a little turns what is across both by any angle.

    A push in that direction would move cloth sideways, and strain it, where sheets lie edge on edge.
    """
    a, b, c, d = corners_of(motion.x0, edges)
    u = b - a
    v = d - c
    return wp.length_sq(wp.cross(u, v)) < PARALLEL * wp.length_sq(u) * wp.length_sq(v)


@wp.func
def are_occluded(step: Step, edges: wp.vec2i, corners: wp.vec4i, normal: wp.vec3d, time: wp.float64) -> bool:
    """Returns whether a face next to one of two edges shields it from the other along the normal, at a time in [0, 1].

    Only pairs with an edge of a body that can be moved are occluded. The face reaches farther along the normal than
    the edge: at the edges of a triangulated flat face, or at those of a sheet that the side of a box has run into from
    above. A push along this normal would hold what slides. Sheets may bend around a body by 30 degrees to either side,
    bodies do not bend.
    """
    motion, mesh = step.motion, step.mesh
    if not are_on_body(motion, corners):
        return False
    for side in range(2):
        edge = edges[side]
        a = corners[2 * side]
        b = corners[2 * side + 1]
        out = wp.where(side == 0, -normal, normal)
        most = wp.where(a < motion.bodies.particle_count, BEND_OF_SHEET, BEND_OF_BODY)
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
