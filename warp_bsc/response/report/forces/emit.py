"""Kernels that publish the contacts of a step, and the sums of their impulses."""

import warp as wp

from ....kernels.pipeline.queues import take_slot_int
from ...state.planes import MovingPlanes
from ...state.structs import ContactKind, Step, can_move, constraint_count
from ...state.vectors import ZERO, relative, to_double, to_single
from .accumulate import body_of_side, responds, time_at_plane, torque_on
from .structs import ContactRows, ImpulseSums, PublishedImpulses, Sides, Unpaired
from .sums import add_impulse, body_of_vertex, shape_of, take_impulse

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
    centres: wp.array[wp.vec3d],
    kind: int,
    corners: wp.vec4i,
    weights: wp.vec4d,
    plane: int,
    impulse: wp.vec3d,
    along: wp.float64,
    normal: wp.vec3d,
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
    for side in range(2):
        torque = torque_on(step, sides, centres, corners, weights, plane, side, impulse)
        of_side = wp.where(side == 0, impulse, -impulse)
        _add_to_side(sums, shapes[side], bodies[side], of_side, torque, rows.lost)
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
def _kind_of(kind: int) -> int:
    """Returns the kind of a contact as it is published: a proximity is a contact once it pushes."""
    if kind == ContactKind.VERTEX_FACE_PROXIMITY:
        return int(ContactKind.VERTEX_FACE)
    if kind == ContactKind.EDGE_EDGE_PROXIMITY:
        return int(ContactKind.EDGE_EDGE)
    return kind


@wp.func
def _add_idle(
    step: Step,
    sides: Sides,
    centres: wp.array[wp.vec3d],
    corners: wp.vec4i,
    weights: wp.vec4d,
    plane: int,
    impulse: wp.vec3d,
    unpaired: Unpaired,
    lost: wp.array[int],
):
    """Adds the multiplier of a contact that changed no velocity to those that no pair has."""
    for j in range(4):
        if corners[j] < sides.particle_count and weights[j] != ZERO:
            add_impulse(unpaired.idle_of_particles, corners[j], 0, weights[j] * impulse, lost)
    for side in range(2):
        body = body_of_side(sides, corners, plane, side)
        if can_move(step.motion, body):
            add_impulse(unpaired.idle_of_bodies, body, 0, wp.where(side == 0, impulse, -impulse), lost)
            torque = torque_on(step, sides, centres, corners, weights, plane, side, impulse)
            add_impulse(unpaired.idle_of_bodies, body, 3, torque, lost)


@wp.kernel
def publish_contacts(
    # in
    step: Step,
    planes: MovingPlanes,
    sides: Sides,
    centres: wp.array[wp.vec3d],
    substep: int,
    substeps: int,
    # in and out
    unpaired: Unpaired,
    sums: ImpulseSums,
    rows: ContactRows,
    threads: int,
):
    """Adds the impulses of constraints to all sums, and writes a row for each that has one."""
    constraints, motion = step.constraints, step.motion
    for i in range(wp.tid(), constraint_count(step), threads):
        impulse = constraints.velocity_multiplier[i] + wp.vec3d()
        if wp.length_sq(impulse) > ZERO:
            corners, weights, normal = constraints.vertices[i], constraints.weights[i], constraints.normal[i]
            plane = wp.where(constraints.kind[i] == ContactKind.PLANE, constraints.plane[i], -1)
            if responds(step, i):
                toi = wp.float64(constraints.toi[i])
                if plane >= 0:
                    toi = time_at_plane(motion, planes, plane, corners[0])
                toi = (wp.float64(substep) + toi) / wp.float64(substeps)
                velocity = to_single(relative(weights, corners, motion.velocity))
                publish_contact(
                    step,
                    sides,
                    centres,
                    _kind_of(constraints.kind[i]),
                    corners,
                    weights,
                    plane,
                    impulse,
                    wp.dot(impulse, normal),
                    normal,
                    velocity,
                    toi,
                    sums,
                    rows,
                )
            else:
                _add_idle(step, sides, centres, corners, weights, plane, impulse, unpaired, rows.lost)


@wp.func
def _clear(published: PublishedImpulses, i: int):
    if i < published.particle.shape[0]:
        published.unpaired_particle[i] = wp.vec3()
        published.particle[i] = wp.vec3()
    if i < published.body.shape[0]:
        published.unpaired_body[i] = wp.spatial_vector()
        published.body[i] = wp.spatial_vector()
    if i < published.shape.shape[0]:
        published.shape[i] = wp.vec3()
    if i < published.pair.shape[0]:
        published.pair[i] = wp.vec3()


@wp.kernel
def publish_sums(unpaired: Unpaired, first: bool, sums: ImpulseSums, published: PublishedImpulses):
    """Adds all sums to those of the step, of which this is the ``first`` substep or not, and clears them.

    They have the changes that no pair has too.
    """
    i = wp.tid()
    if first:
        _clear(published, i)
    if i < published.particle.shape[0]:
        alone = unpaired.of_particles[i] + take_impulse(unpaired.idle_of_particles, i, 0)
        published.unpaired_particle[i] += to_single(alone)
        published.particle[i] += to_single(take_impulse(sums.of_particles, i, 0) + alone)
        unpaired.of_particles[i] = wp.vec3d()
    if i < published.body.shape[0]:
        linear = unpaired.of_bodies[i, 0] + take_impulse(unpaired.idle_of_bodies, i, 0)
        angular = unpaired.of_bodies[i, 1] + take_impulse(unpaired.idle_of_bodies, i, 3)
        published.unpaired_body[i] += wp.spatial_vector(to_single(linear), to_single(angular))
        linear += take_impulse(sums.of_bodies, i, 0)
        angular += take_impulse(sums.of_bodies, i, 3)
        published.body[i] += wp.spatial_vector(to_single(linear), to_single(angular))
        unpaired.of_bodies[i, 0] = wp.vec3d()
        unpaired.of_bodies[i, 1] = wp.vec3d()
    if i < published.shape.shape[0]:
        published.shape[i] += to_single(take_impulse(sums.of_shapes, i, 0))
    if i < published.pair.shape[0]:
        published.pair[i] += to_single(take_impulse(sums.of_pairs, i, 0))
