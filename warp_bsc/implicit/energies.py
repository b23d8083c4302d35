"""Elastic forces of Newton's VBD as kernels over elements, which Warp differentiates.

Each kernel computes the forces on all particles of an element, from the energies that VBD minimizes in a step: stable
neo-Hookean membranes and tetrahedra, dihedral bending, springs, and their damping by the change since the start of the
step. VBD itself computes the force on one particle at a time. All is computed in float64 from the values in float32.

Every kernel has the same form. Thread (e, row) reads the positions of the particles of element e at the end and at the
start of the step, ``x1[e, row]`` and ``x0[e, row]``, and writes ``forces[e, row]``. There is one row to compute forces.
To compute a Jacobian there is one row for each component of force: the adjoint of row i, given unit vector i, is row i
of the Jacobian.

References:
    A. H. Chen, Z. Liu, Y. Yang and C. Yuksel, Vertex Block Descent, ACM Transactions on Graphics 43(4), 2024,
    doi:10.1145/3658179.
    B. Smith, F. De Goes and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Transactions on Graphics 37(2), 2018,
    doi:10.1145/3180491.
    R. Bridson, S. Marino and R. Fedkiw, Simulation of Clothing with Folds and Wrinkles, Symposium on Computer
    Animation, 2003 (the gradient of the dihedral angle).
"""

import warp as wp

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_SIX = wp.constant(wp.float64(6.0))
_PI = wp.constant(wp.float64(3.141592653589793))
_LEAST_AREA_SQUARED = wp.constant(wp.float64(1.0e-20))  # as VBD has these four
_LEAST_LAMBDA = wp.constant(wp.float64(1.0e-6))
_DEGENERATE = wp.constant(wp.float64(1.0e-6))
_LEAST_LENGTH = wp.constant(wp.float64(1.0e-8))


@wp.func
def _rest_stretch(mu: wp.float64, lame: wp.float64):
    """Returns the ratio of areas or volumes at which the volumetric term is at rest, alpha of Smith et al."""
    return _ONE + mu / (wp.sign(lame) * wp.max(wp.abs(lame), _LEAST_LAMBDA))


@wp.kernel
def membrane_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    poses: wp.array[wp.mat22],
    areas: wp.array[float],
    materials: wp.array2d[float],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of triangles."""
    e, row = wp.tid()
    mu, lame = wp.float64(materials[e, 0]), wp.float64(materials[e, 1])
    if mu <= _ZERO and lame <= _ZERO:
        for i in range(3):
            forces[e, row, i] = wp.vec3d()
        return
    lame = lame + mu
    pose = poses[e]
    a, b = wp.float64(pose[0, 0]), wp.float64(pose[0, 1])
    c, d = wp.float64(pose[1, 0]), wp.float64(pose[1, 1])
    u = x1[e, row, 1] - x1[e, row, 0]
    v = x1[e, row, 2] - x1[e, row, 0]
    f0 = a * u + c * v
    f1 = b * u + d * v
    area_vector = wp.cross(f0, f1)
    ratio = wp.sqrt(wp.max(wp.dot(area_vector, area_vector), _LEAST_AREA_SQUARED))
    normal = area_vector / ratio
    pressure = lame * (ratio - _rest_stretch(mu, lame))
    stress_0 = mu * f0 + pressure * wp.cross(f1, normal)
    stress_1 = mu * f1 + pressure * wp.cross(normal, f0)
    damping = wp.float64(materials[e, 2])
    if damping > _ZERO:
        u0 = x0[e, row, 1] - x0[e, row, 0]
        v0 = x0[e, row, 2] - x0[e, row, 0]
        g0 = a * u0 + c * v0
        g1 = b * u0 + d * v0
        scale = _TWO * damping / dt
        rate_00 = scale * (wp.dot(f0, f0) - wp.dot(g0, g0))
        rate_01 = scale * (wp.dot(f0, f1) - wp.dot(g0, g1))
        rate_11 = scale * (wp.dot(f1, f1) - wp.dot(g1, g1))
        stress_0 = stress_0 + rate_00 * f0 + rate_01 * f1
        stress_1 = stress_1 + rate_01 * f0 + rate_11 * f1
    area = wp.float64(areas[e])
    force_1 = -area * (a * stress_0 + b * stress_1)
    force_2 = -area * (c * stress_0 + d * stress_1)
    forces[e, row, 0] = -(force_1 + force_2)
    forces[e, row, 1] = force_1
    forces[e, row, 2] = force_2


@wp.func
def _dihedral_angle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns the angle between the normals of the triangles a, c, d and b, d, c at the edge from c to d."""
    n1 = wp.cross(c - a, d - a)
    n2 = wp.cross(d - b, c - b)
    e = d - c
    return wp.atan2(wp.dot(wp.cross(n1, n2), e) / wp.length(e), wp.dot(n1, n2))


@wp.func
def _is_degenerate(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    least_normal = wp.min(wp.length(wp.cross(c - a, d - a)), wp.length(wp.cross(d - b, c - b)))
    return wp.min(least_normal, wp.length(d - c)) < _DEGENERATE


@wp.kernel
def bending_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    vertices: wp.array2d[int],
    rest_angle: wp.array[float],
    rest_length: wp.array[float],
    properties: wp.array2d[float],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of pairs of triangles at an edge."""
    e, row = wp.tid()
    a, b, c, d = x1[e, row, 0], x1[e, row, 1], x1[e, row, 2], x1[e, row, 3]
    for i in range(4):
        forces[e, row, i] = wp.vec3d()
    if vertices[e, 0] < 0 or vertices[e, 1] < 0 or properties[e, 0] <= 0.0:
        return
    if _is_degenerate(a, b, c, d):
        return
    n1 = wp.cross(c - a, d - a)
    n2 = wp.cross(d - b, c - b)
    edge = d - c
    length = wp.length(edge)
    along = edge / length
    m1 = n1 / wp.dot(n1, n1)
    m2 = n2 / wp.dot(n2, n2)
    angle = _dihedral_angle(a, b, c, d)
    moment = wp.float64(properties[e, 0]) * (angle - wp.float64(rest_angle[e]))
    damping = wp.float64(properties[e, 1])
    p, q, r, s = x0[e, row, 0], x0[e, row, 1], x0[e, row, 2], x0[e, row, 3]
    if damping > _ZERO and not _is_degenerate(p, q, r, s):
        change = angle - _dihedral_angle(p, q, r, s)
        if change > _PI:
            change = change - _TWO * _PI
        elif change < -_PI:
            change = change + _TWO * _PI
        moment = moment + damping / dt * change
    moment = moment * wp.float64(rest_length[e])
    forces[e, row, 0] = moment * length * m1
    forces[e, row, 1] = moment * length * m2
    forces[e, row, 2] = moment * (wp.dot(a - d, along) * m1 + wp.dot(b - d, along) * m2)
    forces[e, row, 3] = -moment * (wp.dot(a - c, along) * m1 + wp.dot(b - c, along) * m2)


@wp.func
def _to_double(m: wp.mat33):
    return wp.mat33d(
        wp.float64(m[0, 0]),
        wp.float64(m[0, 1]),
        wp.float64(m[0, 2]),
        wp.float64(m[1, 0]),
        wp.float64(m[1, 1]),
        wp.float64(m[1, 2]),
        wp.float64(m[2, 0]),
        wp.float64(m[2, 1]),
        wp.float64(m[2, 2]),
    )


@wp.kernel
def tetrahedron_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    poses: wp.array[wp.mat33],
    materials: wp.array2d[float],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of tetrahedra."""
    e, row = wp.tid()
    mu, lame = wp.float64(materials[e, 0]), wp.float64(materials[e, 1])
    if mu <= _ZERO and lame <= _ZERO:
        for i in range(4):
            forces[e, row, i] = wp.vec3d()
        return
    lame = lame + mu
    pose = _to_double(poses[e])
    origin = x1[e, row, 0]
    f = wp.matrix_from_cols(x1[e, row, 1] - origin, x1[e, row, 2] - origin, x1[e, row, 3] - origin) * pose
    f0, f1, f2 = (
        wp.vec3d(f[0, 0], f[1, 0], f[2, 0]),
        wp.vec3d(f[0, 1], f[1, 1], f[2, 1]),
        wp.vec3d(f[0, 2], f[1, 2], f[2, 2]),
    )
    cofactor = wp.matrix_from_cols(wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1))
    stress = mu * f + lame * (wp.dot(f0, wp.cross(f1, f2)) - _rest_stretch(mu, lame)) * cofactor
    damping = wp.float64(materials[e, 2])
    if damping > _ZERO:
        origin_0 = x0[e, row, 0]
        g = wp.matrix_from_cols(x0[e, row, 1] - origin_0, x0[e, row, 2] - origin_0, x0[e, row, 3] - origin_0) * pose
        rate = wp.transpose(f) * f - wp.transpose(g) * g
        stress = stress + (_TWO * damping / dt) * (f * rate)
    h = -(stress * wp.transpose(pose)) / (_SIX * wp.determinant(pose))
    force_1 = wp.vec3d(h[0, 0], h[1, 0], h[2, 0])
    force_2 = wp.vec3d(h[0, 1], h[1, 1], h[2, 1])
    force_3 = wp.vec3d(h[0, 2], h[1, 2], h[2, 2])
    forces[e, row, 0] = -(force_1 + force_2 + force_3)
    forces[e, row, 1] = force_1
    forces[e, row, 2] = force_2
    forces[e, row, 3] = force_3


@wp.kernel
def spring_forces(
    # in
    dt: wp.float64,
    x1: wp.array3d[wp.vec3d],
    x0: wp.array3d[wp.vec3d],
    rest_length: wp.array[float],
    stiffness: wp.array[float],
    damping: wp.array[float],
    # out
    forces: wp.array3d[wp.vec3d],
):
    """Computes the forces of springs."""
    e, row = wp.tid()
    d = x1[e, row, 0] - x1[e, row, 1]
    length = wp.max(wp.length(d), _LEAST_LENGTH)
    length_0 = wp.max(wp.length(x0[e, row, 0] - x0[e, row, 1]), _LEAST_LENGTH)
    stretch = length - wp.float64(rest_length[e])
    tension = wp.float64(stiffness[e]) * stretch + wp.float64(damping[e]) / dt * (length - length_0)
    force = -(tension / length) * d
    forces[e, row, 0] = force
    forces[e, row, 1] = -force


@wp.kernel
def inertial_forces(
    # in
    dt: wp.float64,
    x1: wp.array[wp.vec3d],
    x0: wp.array[wp.vec3d],
    velocity: wp.array[wp.vec3],
    force: wp.array[wp.vec3],
    mass: wp.array[float],
    inverse_mass: wp.array[float],
    gravity: wp.array[wp.vec3],
    world: wp.array[int],
    is_fixed: wp.array[int],
    # out
    forces: wp.array[wp.vec3d],
):
    """The force that moves a particle to where it would be without others, from VBD's predicted position."""
    i = wp.tid()
    if is_fixed[i] != 0:
        forces[i] = wp.vec3d()
        return
    moved = x0[i] - x1[i]
    if inverse_mass[i] != 0.0:
        acceleration = wp.vec3d(gravity[world[i]])
        if force:
            acceleration = acceleration + wp.float64(inverse_mass[i]) * wp.vec3d(force[i])
        moved = moved + dt * (wp.vec3d(velocity[i]) + dt * acceleration)
    forces[i] = wp.float64(mass[i]) / (dt * dt) * moved
