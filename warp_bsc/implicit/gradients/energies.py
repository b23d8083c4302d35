"""Forces on unknowns as kernels that Warp differentiates: inertia, and those of elements and attachments."""

import warp as wp

from ...response.state.poses import point_of
from ...response.state.vectors import ZERO
from ..elasticity.derivatives import element_gradient
from ..elasticity.elements import Elements, element_size, first_corner, kind_of


@wp.kernel
def elastic_forces(
    # in
    elements: Elements,
    dt: wp.float64,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    # out
    forces: wp.array[wp.vec3d],
):
    """Computes the force of each element on each of its corners."""
    i = wp.tid()
    kind = kind_of(elements, i)
    e = i - elements.first[kind]
    gradient = element_gradient(elements, kind, e, x1, x0, dt)
    corner, size = first_corner(elements, kind, e), element_size(kind)
    for j in range(4):
        if j < size:
            forces[corner + j] = -gradient[j]


@wp.kernel
def inertial_forces(
    # in
    dt: wp.float64,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    velocity: wp.array[wp.vec3d],
    force: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    gravity: wp.array[wp.vec3],
    world: wp.array[int],
    particle: wp.array[int],
    is_fixed: wp.array[int],
    # out
    forces: wp.array[wp.vec3d],
):
    """The force that moves a particle to where it would be without others."""
    u = wp.tid()
    p = particle[u]
    if p < 0 or is_fixed[u] != 0:
        forces[u] = wp.vec3d()
        return
    inverse = wp.float64(inverse_mass[p])
    acceleration = wp.vec3d(gravity[wp.max(world[p], 0) % gravity.shape[0]])
    if force:
        acceleration = acceleration + inverse * wp.vec3d(force[p])
    moved = x0[p] - x1[p] + dt * (velocity[p] + dt * acceleration)
    forces[u] = moved / (inverse * dt * dt)


@wp.kernel
def find_falls(
    # in
    dt: float,
    gravity: wp.array[wp.vec3],
    # out
    fall: wp.array[float],
):
    """Computes how far gravity moves what is at rest in a step, by world."""
    world = wp.tid()
    fall[world] = dt * dt * wp.length(gravity[world % gravity.shape[0]])


@wp.kernel
def attachment_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    body: wp.array[int],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[float],
    damping: wp.array[float],
    enabled: wp.array[wp.bool],
    pose_1: wp.array[wp.transform],
    pose_0: wp.array[wp.transform],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of attachments of finite stiffness."""
    e, row = wp.tid()
    forces[e, row, 0] = wp.vec3d()
    if not enabled[e] or wp.isinf(stiffness[e]):
        return
    offset = x1[e, row, 0] - point_of(pose_1[body[e]], body_point[e])
    force = wp.max(wp.float64(stiffness[e]), ZERO) * offset
    if damping[e] > 0.0:
        offset_0 = x0[e, row, 0] - point_of(pose_0[body[e]], body_point[e])
        force = force + wp.float64(damping[e]) / dt * (offset - offset_0)
    forces[e, row, 0] = -force


@wp.kernel
def place_held(
    # in
    vertices: wp.array2d[int],
    body: wp.array[int],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[float],
    enabled: wp.array[wp.bool],
    pose_1: wp.array[wp.transform],
    # out
    x1: wp.array[wp.vec3d],
):
    """Computes where particles end that attachments of infinite stiffness hold."""
    e = wp.tid()
    if enabled[e] and wp.isinf(stiffness[e]):
        x1[vertices[e, 0]] = point_of(pose_1[body[e]], body_point[e])


@wp.kernel
def place_shapes(
    # in
    body: wp.array[int],
    position: wp.array[wp.vec3],
    poses: wp.array[wp.transform],
    # out
    x: wp.array[wp.vec3d],
):
    """Computes where vertices of bodies are."""
    i = wp.tid()
    if body[i] >= 0:
        x[i] = point_of(poses[body[i]], position[i])


@wp.kernel
def place_planes(
    # in
    body: wp.array[int],
    point: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    poses: wp.array[wp.transform],
    # out
    planes: wp.array[wp.vec4d],
):
    """Computes where infinite planes of bodies are."""
    i = wp.tid()
    if body[i] >= 0:
        pose = poses[body[i]]
        unit = wp.normalize(wp.vec3d(wp.transform_vector(pose, normal[i])))
        planes[i] = wp.vec4d(unit[0], unit[1], unit[2], wp.dot(unit, wp.vec3d(wp.transform_point(pose, point[i]))))
