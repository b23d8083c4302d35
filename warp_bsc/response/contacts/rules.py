"""Which contacts the response resolves: rules by masses, bodies, crossings at the start, and hidden edges."""

import warp as wp
from newton import ShapeFlags

from ...kernels.crossing import edge_crosses_face
from ...kernels.exact.rest import meet_at_rest
from ...kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from ...kernels.signs import HIT
from ..state.mesh import Connectivity
from ..state.structs import Bodies, Motion
from ..state.vectors import to_double
from ..tuning import BEND_OF_BODY, BEND_OF_SHEET


@wp.func
def inverse_mass_of(motion: Motion, vertex: int) -> float:
    """Returns the inverse mass of a vertex, or of the body that it moves with [1/kg]; 0 where nothing can move it."""
    if motion.bodies.of_vertex:
        body = motion.bodies.of_vertex[vertex]
        if body >= 0:
            return motion.bodies.inverse_mass[body]
    return motion.inverse_mass[vertex]


@wp.func
def is_on_body(motion: Motion, vertex: int) -> bool:
    """Returns whether a vertex is of a body; False if the response moves none."""
    if motion.bodies.of_vertex:
        return motion.bodies.of_vertex[vertex] >= 0
    return False


@wp.func
def are_on_body(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether one of two elements is of a body that can be moved."""
    if motion.bodies.of_vertex:
        for side in range(2):
            body = motion.bodies.of_vertex[corners[3 * side]]
            if body >= 0 and motion.bodies.inverse_mass[body] > 0.0:
                return True
    return False


_COLLIDE_SHAPES = wp.constant(int(ShapeFlags.COLLIDE_SHAPES))


@wp.func
def is_movable(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether the response can move one of four vertices: contacts of other pairs are not its own."""
    for j in range(4):
        if motion.inverse_mass[corners[j]] > 0.0:
            return True
    if not motion.bodies.of_vertex:
        return False
    for side in range(2):
        body = motion.bodies.of_vertex[corners[3 * side]]
        if body >= 0 and motion.bodies.inverse_mass[body] > 0.0:
            if corners[3 - 3 * side] < motion.bodies.particle_count:  # a particle that is held
                return True
            return motion.bodies.responds == 1 and bodies_meet(motion, corners)
    return False


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
def bodies_meet(motion: Motion, corners: wp.vec4i) -> bool:
    """Returns whether two elements of shapes are of two that are to collide, one on a body that can be moved."""
    if not motion.bodies.of_vertex:
        return False
    particles = motion.bodies.particle_count
    if corners[0] < particles or corners[3] < particles:
        return False
    body = motion.bodies.of_vertex[corners[0]]
    other = motion.bodies.of_vertex[corners[3]]
    if body == other:
        return False
    movable = bool(False)
    if body >= 0:
        movable = motion.bodies.inverse_mass[body] > 0.0
    if other >= 0:
        movable = movable or motion.bodies.inverse_mass[other] > 0.0
    return movable and collides(
        motion.bodies, motion.bodies.shape[corners[0] - particles], motion.bodies.shape[corners[3] - particles]
    )


@wp.func
def crosses_face(motion: Motion, mesh: Connectivity, edge: int, face: int) -> bool:
    """Returns whether an edge certainly crosses a face at the start."""
    for end in range(2):
        for corner in range(3):
            if mesh.edges[edge, end] == mesh.faces[face, corner]:
                return False
    x = motion.x0
    p = mesh.edges[edge, 0]
    q = mesh.edges[edge, 1]
    a = x[mesh.faces[face, 0]]
    b = x[mesh.faces[face, 1]]
    c = x[mesh.faces[face, 2]]
    return edge_crosses_face(x[p], x[q], a, b, c) == HIT


@wp.func
def touched_at_start(motion: Motion, kind: int, corners: wp.vec4i, bound: wp.float64) -> bool:
    """Returns whether the elements of a pair touched at the start of the step, exactly.

    A lower bound alone does not say so: it is 0 for a contact soon after the start as well, and for a small distance.

    Args:
        motion: The motion.
        kind: The kind of pair.
        corners: The vertices of the pair.
        bound: A lower bound of the time of impact, or of the distance at the start: if it is more than 0, they did
            not touch.
    """
    if bound > wp.float64(0.0):
        return False
    points = wp.where(kind == EDGE_EDGE, EDGE_EDGE, VERTEX_FACE)
    x = motion.x0
    return meet_at_rest(points, x[corners[0]], x[corners[1]], x[corners[2]], x[corners[3]])


@wp.func
def crossed_at_start(motion: Motion, mesh: Connectivity, edges: int, pair: wp.vec2i) -> bool:
    """Returns whether a contact is one of elements that certainly crossed at the start of the step.

    A vertex that passes through a face changes which of the vertex's edges cross that face; an edge that passes through
    another changes which of the faces at either edge the other crosses. So the contact of a vertex and a face belongs
    to a crossing if one of the vertex's edges crosses that face, and the contact of two edges if one of them crosses a
    face of the other. Such contacts are how crossing surfaces come apart.

    Args:
        motion: The motion.
        mesh: Its connectivity.
        edges: 1 where the contact is of edges.
        pair: The elements of the contact.
    """
    if edges == 1:
        for side in range(2):
            edge = pair[side]
            other = pair[1 - side]
            for i in range(mesh.edge_faces.first[other], mesh.edge_faces.first[other + 1]):
                if crosses_face(motion, mesh, edge, mesh.edge_faces.items[i]):
                    return True
        return False
    vertex = pair[0]
    for i in range(mesh.vertex_edges.first[vertex], mesh.vertex_edges.first[vertex + 1]):
        if crosses_face(motion, mesh, mesh.vertex_edges.items[i], pair[1]):
            return True
    return False


@wp.func
def met_at_start(
    motion: Motion, mesh: Connectivity, edges: int, pair: wp.vec2i, corners: wp.vec4i, toi: wp.float64
) -> bool:
    """Returns whether the elements of a contact touched or crossed at the start: it is left to the inner solver."""
    kind = wp.where(edges == 1, EDGE_EDGE, VERTEX_FACE)
    return touched_at_start(motion, kind, corners, toi) or crossed_at_start(motion, mesh, edges, pair)


@wp.func
def _at(motion: Motion, vertex: int, time: wp.float64) -> wp.vec3d:
    start = to_double(motion.x0[vertex])
    return start + time * (to_double(motion.x1[vertex]) - start)


@wp.func
def are_occluded(
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
