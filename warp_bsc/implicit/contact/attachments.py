"""Attachments of particles to bodies, in the inertia of their particles: springs, and particles that are held.

The energy of a spring to a point, and that of its damping, are isotropic in the end of its particle, as inertia is:
together they are one parabola around another goal. An attachment of infinite stiffness puts its particle at its point.
"""

import newton
import numpy as np
import warp as wp

from ..._private_names.of_newton import attachment_arrays
from ...response.state.motion import continues
from ...response.state.poses import point_of
from ...response.state.structs import Motion, Vertices
from ...response.state.vectors import ZERO, to_double, to_single
from .system import Unknowns

wp.set_module_options({"enable_backward": False})


@wp.struct
class ParticleAttachments:
    """The attachments of a model, by particle."""

    first: wp.array[int]  # first entry of each particle, and the end of the last
    items: wp.array[int]  # attachments
    body: wp.array[int]  # body of each attachment, and so on as in ``newton.Model``
    body_point: wp.array[wp.vec3]
    stiffness: wp.array[float]
    damping: wp.array[float]
    enabled: wp.array[wp.bool]


def attachments_of_model(model: newton.Model):
    """Returns the attachments of a model by particle, on its device; None if there are none.

    Raises:
        NotImplementedError: If several attachments of infinite stiffness hold one particle.
    """
    _check_attachments(model)
    arrays = attachment_arrays(model)
    if arrays is None:
        return None
    attachments = ParticleAttachments()
    for name in ("body", "body_point", "stiffness", "damping", "enabled"):
        setattr(attachments, name, getattr(arrays, name))
    of = arrays.particle.numpy()
    order = np.argsort(of, kind="stable").astype(np.int32)
    first = np.searchsorted(of[order], np.arange(model.particle_count + 1)).astype(np.int32)
    attachments.items = wp.array(order, dtype=int, device=model.device)
    attachments.first = wp.array(first, dtype=int, device=model.device)
    return attachments


def _check_attachments(model: newton.Model) -> None:
    """Raises an error if several attachments hold one particle, reading them from the device.

    Raises:
        NotImplementedError: If they do.
    """
    found = attachment_arrays(model)
    if found is None:
        return
    held = found.particle.numpy()[np.isinf(found.stiffness.numpy()) & found.enabled.numpy().astype(bool)]
    if len(np.unique(held)) < len(held):
        raise NotImplementedError("model: several attachments of infinite stiffness hold one particle")


@wp.func
def _is_finite(pose: wp.transform) -> bool:
    return wp.isfinite(wp.transform_get_translation(pose)) and wp.isfinite(wp.transform_get_rotation(pose))


@wp.kernel
def attach(
    # in
    attachments: ParticleAttachments,
    starts: wp.array[wp.transform],
    ends: wp.array[wp.transform],
    dt: wp.float64,
    # in and out
    motion: Motion,
    unknowns: Unknowns,
    goal: wp.array[wp.vec3],
    # out
    vertices: Vertices,
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Adds attachments to the inertia of particles; what is held by one goes to its point, and is no unknown."""
    p = wp.tid()
    u = unknowns.of_vertex[p]
    if unknowns.is_free[u] == 0:
        return
    weight, shifted = unknowns.inertia[u] + ZERO, wp.vec3d()
    origin = to_double(goal[p])
    for n in range(attachments.first[p], attachments.first[p + 1]):
        i = attachments.items[n]
        body, point = attachments.body[i], attachments.body_point[i]
        if not attachments.enabled[i] or not _is_finite(ends[body]):
            continue
        end = point_of(ends[body], point)
        stiffness = attachments.stiffness[i]
        if wp.isinf(stiffness):
            unknowns.is_free[u] = 0
            x, velocity = to_single(end), to_single((end - to_double(motion.x0[p])) / dt)
            motion.x1[p] = x
            motion.velocity[p] = velocity
            vertices.x1[p] = x
            vertices.velocity[p] = velocity
            particle_q[p] = x
            particle_qd[p] = velocity
            return
        spring = wp.max(wp.float64(stiffness), ZERO)
        shifted += spring * (end - origin)
        weight += spring
        if attachments.damping[i] > 0.0:
            damping = wp.float64(attachments.damping[i]) / dt
            moved = wp.vec3d()
            if continues(motion, motion.world[p]) and _is_finite(starts[body]):
                moved = end - point_of(starts[body], point)
            shifted += damping * (to_double(motion.x0[p]) + moved - origin)
            weight += damping
    unknowns.inertia[u] = weight
    goal[p] = to_single(origin + shifted / weight)
