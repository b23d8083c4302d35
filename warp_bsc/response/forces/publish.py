"""Kernels that publish the contacts of a step, and the sums of their impulses."""

import warp as wp

from ...kernels.pipeline.queues import take_slot_int
from ..state.planes import MovingPlanes
from ..state.structs import ContactKind, Step
from ..state.vectors import ONE, ZERO, to_double, to_single
from .structs import ContactRows, ImpulseSums, KeptImpulses, PublishedImpulses, Sides, Unpaired
from .sums import add_impulse, body_of_vertex, clear_kept, shape_of, take_impulse

wp.set_module_options({"enable_backward": False})


@wp.func
def _add_to_side(sums: ImpulseSums, shape: int, body: int, impulse: wp.vec3d, torque: wp.vec3d, lost: wp.array[int]):
    """Adds the impulse on a side of a contact, if it is of a shape, to the sums of its shape and its body."""
    if shape >= 0:
        add_impulse(sums.of_shapes, shape, 0, impulse, lost)
    if body >= 0:
        add_impulse(sums.of_bodies, body, 0, impulse, lost)
        add_impulse(sums.of_bodies, body, 3, torque, lost)


@wp.func
def _local(sides: Sides, shape: int) -> int:
    """Returns the number of a shape in the matrix of a world; particles are one."""
    if shape < 0:
        return sides.max_local
    return sides.local_shape[shape]


@wp.func
def publish_contact(
    # in
    step: Step,
    sides: Sides,
    kind: int,
    corners: wp.vec4i,
    weights: wp.vec4d,
    plane: int,
    impulse: wp.vec3d,
    along: wp.float64,
    normal: wp.vec3d,
    torque_on_first: wp.vec3d,
    torque_on_second: wp.vec3d,
    velocity: wp.vec3,
    toi: wp.float64,
    # out
    sums: ImpulseSums,
    rows: ContactRows,
):
    """Adds the impulse of a contact to all sums, and writes a row for it if it fits."""
    shapes = wp.vec2i(shape_of(sides, corners[0]), shape_of(sides, corners[3]))
    bodies = wp.vec2i(body_of_vertex(sides, corners[0]), body_of_vertex(sides, corners[3]))
    if kind == ContactKind.PLANE:
        shapes[1] = sides.plane_shape[plane]
        bodies[1] = sides.plane_body[plane]
    point = wp.vec3d()
    for j in range(4):
        point += wp.max(weights[j], ZERO) * to_double(step.vertices.x1[corners[j]])
        if corners[j] < sides.particle_count and weights[j] != ZERO:
            add_impulse(sums.of_particles, corners[j], 0, weights[j] * impulse, rows.lost)
    _add_to_side(sums, shapes[0], bodies[0], impulse, torque_on_first, rows.lost)
    _add_to_side(sums, shapes[1], bodies[1], -impulse, torque_on_second, rows.lost)
    world = step.motion.world[corners[0]]
    if float(along) > sums.largest[world]:  # rarely: all contacts of a world have this address
        wp.atomic_max(sums.largest, world, float(along))
    if sums.of_pairs:
        size = sides.max_local + 1
        a = _local(sides, shapes[0])
        b = _local(sides, shapes[1])
        if a != b:  # of cloth with cloth, which all have one address, both add up to 0
            add_impulse(sums.of_pairs, (world * size + a) * size + b, 0, impulse, rows.lost)
            add_impulse(sums.of_pairs, (world * size + b) * size + a, 0, -impulse, rows.lost)
    row = take_slot_int(rows.count)
    if row < rows.kind.shape[0]:
        rows.kind[row] = kind
        rows.vertices[row] = corners
        if kind == ContactKind.PLANE:
            rows.vertices[row] = wp.vec4i(corners[0], -1, -1, -1)
        for j in range(4):
            rows.weights[row][j] = float(weights[j])
        rows.shapes[row] = shapes
        rows.bodies[row] = bodies
        rows.world[row] = world
        rows.toi[row] = float(toi)
        rows.point[row] = to_single(point)
        rows.normal[row] = to_single(normal)
        rows.velocity[row] = velocity
        rows.normal_impulse[row] = float(along)
        rows.tangential_impulse[row] = to_single(impulse - along * normal)


@wp.func
def _publish(
    # in
    step: Step,
    sides: Sides,
    kept: KeptImpulses,
    i: int,
    kind: int,
    corners: wp.vec4i,
    weights: wp.vec4d,
    plane: int,
    # out
    sums: ImpulseSums,
    rows: ContactRows,
):
    """Publishes a contact, and clears what was kept."""
    first, second = wp.vec3d(), wp.vec3d()
    if kept.torque:
        first = kept.torque[i, 0]
        second = kept.torque[i, 1]
    publish_contact(
        step,
        sides,
        kind,
        corners,
        weights,
        plane,
        kept.impulse[i],
        kept.along[i],
        kept.normal[i],
        first,
        second,
        kept.velocity[i],
        kept.toi[i],
        sums,
        rows,
    )
    clear_kept(kept, i)


@wp.func
def _kind_of(kind: int) -> int:
    """Returns the kind of a contact as it is published: a proximity is a contact once it pushes."""
    if kind == ContactKind.VERTEX_FACE_PROXIMITY:
        return int(ContactKind.VERTEX_FACE)
    if kind == ContactKind.EDGE_EDGE_PROXIMITY:
        return int(ContactKind.EDGE_EDGE)
    return kind


@wp.kernel
def publish_contacts(step: Step, sides: Sides, kept: KeptImpulses, sums: ImpulseSums, rows: ContactRows, threads: int):
    """Adds the impulses of constraints to all sums, and writes a row for each that has one."""
    constraints = step.constraints
    for i in range(wp.tid(), kept.count[0], threads):
        if wp.length_sq(kept.impulse[i]) > ZERO:
            if i < constraints.count[0]:
                kind, corners, weights = _kind_of(constraints.kind[i]), constraints.vertices[i], constraints.weights[i]
                _publish(step, sides, kept, i, kind, corners, weights, constraints.plane[i], sums, rows)
            else:  # constraints of a CUDA graph did not fit, and were dropped
                wp.atomic_add(rows.lost, 0, 1)
                clear_kept(kept, i)


@wp.kernel
def publish_contacts_of_planes(
    step: Step, planes: MovingPlanes, sides: Sides, kept: KeptImpulses, sums: ImpulseSums, rows: ContactRows
):
    """Does the same for the impulses that planes had in substeps; thread i has vertex i."""
    vertex = wp.tid()
    world = step.motion.world[vertex]
    weights = wp.vec4d(ONE, ZERO, ZERO, ZERO)
    for place in range(planes.of_worlds.shape[1]):
        plane = planes.of_worlds[world, place]
        if plane >= 0:
            i = vertex * sides.planes_per_world + sides.plane_slot[plane]
            if wp.length_sq(kept.impulse[i]) > ZERO:
                _publish(step, sides, kept, i, int(ContactKind.PLANE), wp.vec4i(vertex), weights, plane, sums, rows)


@wp.kernel
def publish_sums(unpaired: Unpaired, sums: ImpulseSums, published: PublishedImpulses):
    """Writes all sums, with the changes that no pair has, and clears them for the next step."""
    i = wp.tid()
    if i < published.particle.shape[0]:
        alone = unpaired.of_particles[i] + take_impulse(unpaired.idle_of_particles, i, 0)
        published.unpaired_particle[i] = to_single(alone)
        published.particle[i] = to_single(take_impulse(sums.of_particles, i, 0) + alone)
        unpaired.of_particles[i] = wp.vec3d()
    if i < published.body.shape[0]:
        linear = unpaired.of_bodies[i, 0] + take_impulse(unpaired.idle_of_bodies, i, 0)
        angular = unpaired.of_bodies[i, 1] + take_impulse(unpaired.idle_of_bodies, i, 3)
        published.unpaired_body[i] = wp.spatial_vector(to_single(linear), to_single(angular))
        linear += take_impulse(sums.of_bodies, i, 0)
        angular += take_impulse(sums.of_bodies, i, 3)
        published.body[i] = wp.spatial_vector(to_single(linear), to_single(angular))
        unpaired.of_bodies[i, 0] = wp.vec3d()
        unpaired.of_bodies[i, 1] = wp.vec3d()
    if i < published.shape.shape[0]:
        published.shape[i] = to_single(take_impulse(sums.of_shapes, i, 0))
    if i < published.pair.shape[0]:
        published.pair[i] = to_single(take_impulse(sums.of_pairs, i, 0))
