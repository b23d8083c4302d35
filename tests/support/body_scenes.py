"""Models of rigid bodies and cloth."""

import newton
import numpy as np
import warp as wp
from newton_scenes import add_patch


def add_body(builder, shape, at, *, mass=1.0, inertia=(4e-3, 4e-3, 4e-3), mu=0.5, offset=(0.0, 0.0, 0.0), **size):
    """A body with one shape, whose mass and inertia are those given."""
    pose = at if isinstance(at, wp.transform) else wp.transform(wp.vec3(*at), wp.quat_identity())
    inertia = wp.mat33(*np.diag(inertia).ravel().tolist())
    body = builder.add_body(xform=pose, mass=mass, inertia=inertia, lock_inertia=True)
    config = newton.ModelBuilder.ShapeConfig(mu=mu, density=0.0)
    at_shape = wp.transform(wp.vec3(*offset), wp.quat_identity())
    getattr(builder, f"add_shape_{shape}")(body, xform=at_shape, cfg=config, **size)
    return body


def finalize(builder, velocities, device):
    """A model whose bodies have these velocities, linear and angular."""
    builder.color()
    model = builder.finalize(device=device)
    model.body_qd.assign(np.array(velocities, dtype=np.float32))
    return model


def free(model):
    """Bodies and particles fly on without forces."""
    return newton.solvers.SolverXPBD(model, iterations=0, angular_damping=0.0)


def boxes(device, *, velocities, positions, static=False, filtered=()):
    """Boxes in a row without gravity, each smaller than the last, a static one before them if asked; cloth far away."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(builder, 2, 0.05, (0.0, 0.0, 5.0))
    half = 0.1
    if static:
        at = wp.transform(wp.vec3(-0.3, 0.01, 0.02), wp.quat_identity())
        builder.add_shape_box(-1, xform=at, hx=half, hy=half, hz=half)
    for position in positions:
        add_body(builder, "box", position, inertia=(7e-3, 7e-3, 7e-3), hx=half, hy=half, hz=half)
        half -= 0.03  # edges of two boxes are not in one line
    for pair in filtered:
        builder.add_shape_collision_filter_pair(*pair)
    return finalize(builder, [[*velocity, 0.0, 0.0, 0.0] for velocity in velocities], device)
