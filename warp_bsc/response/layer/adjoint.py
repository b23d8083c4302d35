"""The adjoint of the pushes of a contact layer: carries gradients from a pushed state to the predicted one."""

from typing import NamedTuple

import warp as wp

from ..adjoint import pose_kernels
from ..adjoint.arrays import copied, copied_materials, filled, launch_adjoint, materials_with_gradients, with_gradients
from ..adjoint.structs import StateGradients
from ..contacts.queue import PairQueue
from ..state.motion import ModelMotion
from . import kernels
from .pushes import Layer


class RecordedPushes(NamedTuple):
    """A copy of a layer and of the pairs that may be in it, before it pushed; in a CUDA graph, of all queues."""

    layer: Layer
    pairs: list[PairQueue]


def record_pushes(layer: Layer, pairs: list[PairQueue], motion: ModelMotion) -> RecordedPushes:
    """Copies what the adjoint needs."""
    copies = []
    for queue in pairs:
        if count := filled(queue.pairs, queue.counts, queue.count):
            copies.append(copied(queue, {"pairs": count, "counts": None}))
    pushes_bodies = motion.moves_bodies
    layer = copied(layer, ("shares", "changes") if pushes_bodies else ("shares",))
    layer.motion = copied(motion.vertices, ("x0", "x1", "is_not_finite", "friction"))
    layer.motion.materials = copied_materials(motion.vertices.materials)
    layer.planes = copied(motion.planes, ("start", "end", "friction"))
    if motion.keeps_poses:
        names = ("start", "end", "velocity", "inverse_mass") if pushes_bodies else ("start", "end")
        layer.motion.bodies = copied(motion.vertices.bodies, names)
    if pushes_bodies:
        layer.bodies = copied(layer.bodies, ("centre", "inverse_inertia"))
    return RecordedPushes(layer, copies)


def go_back(recorded: RecordedPushes, motion: ModelMotion, of_state: StateGradients) -> None:
    """Turns gradients with respect to a pushed state into those with respect to the predicted one, in place.

    Adds to the gradients of positions and poses at the start, of masses and inertias, of what coefficients of friction
    are read from, and of restitution, where these have such arrays.

    Args:
        recorded: The pushes.
        motion: The motion of the layer, for its mesh and friction.
        of_state: The gradients of the state; those of bodies may be None if the model has none.
    """
    layer, pairs = recorded
    mesh, pushes_bodies, keeps_poses = motion.mesh, motion.moves_bodies, motion.keeps_poses
    model, device = mesh.model, mesh.device
    n, particles, bodies = len(layer.motion.x0), model.particle_count, model.body_count
    inverse_mass = model.particle_inv_mass
    assert inverse_mass is not None
    names = "x0", "x1", "velocity", "inverse_mass", "friction"
    recorded_motion, recorded_bodies = layer.motion, layer.motion.bodies
    layer, of_layer = with_gradients(layer, ("shares", "changes") if pushes_bodies else ("shares",))
    layer.motion, of_motion = with_gradients(recorded_motion, names)
    materials = materials_with_gradients(recorded_motion.materials, motion.friction.materials.friction)
    layer.motion.materials, of_motion.materials = materials
    layer.planes, of_planes = with_gradients(recorded.layer.planes, ("start", "end", "friction"))
    if keeps_poses:
        names = ("start", "end", "velocity", "inverse_mass") if pushes_bodies else ("start", "end")
        layer.motion.bodies, of_motion.bodies = with_gradients(recorded_bodies, names)
    if pushes_bodies:
        layer.bodies, _of_bodies = with_gradients(layer.bodies, ("centre", "inverse_inertia"))

    def launch(kernel, dim, inputs, of_outputs=()):
        launch_adjoint(kernel, dim, inputs, of_outputs, device)

    of_changes = wp.zeros(n, dtype=wp.vec3, device=device)
    inputs = [layer, of_state.particle_q, of_state.particle_qd, of_changes]
    wp.launch(kernels.begin_backward, particles, inputs=inputs, device=device)
    of_body_changes = of_layer.changes
    if pushes_bodies:
        launch(kernels.push_poses, bodies, [layer], [of_state.body_q])
        of_body_changes = of_layer.changes
        inputs = [layer, of_state.body_qd, of_body_changes]
        wp.launch(kernels.begin_body_backward, bodies, inputs=inputs, device=device)
    over_planes = (particles, len(layer.planes.end))
    for queue in pairs:
        launch(kernels.sum_pushes, len(queue.pairs), [layer, queue, None], [of_changes, of_body_changes])
    launch(kernels.add_pushes_of_planes, over_planes, [layer], [of_changes])
    for queue in pairs:
        launch(kernels.sum_shares, len(queue.pairs), [layer, queue, None], [of_layer.shares])
    launch(kernels.add_shares_of_planes, over_planes, [layer], [of_layer.shares])
    if keeps_poses:
        if pushes_bodies:
            launch(pose_kernels.set_centres, bodies, [layer.motion, layer.motion.bodies.end, layer.bodies])
        shapes, planes = mesh.device_shape_vertices, mesh.device_planes
        inputs = [layer.motion, shapes.body, shapes.position, particles, layer.dt]
        launch(pose_kernels.place_shape_vertices, len(shapes.body), inputs)
        inputs = [layer.motion, planes.point, planes.normal, planes.body, layer.planes]
        launch(pose_kernels.place_planes, len(planes.body), inputs)
        of_masses = None if model.body_inv_mass is None else model.body_inv_mass.grad
        inputs = [layer, of_motion, of_state, of_masses]
        wp.launch(kernels.finish_body_backward, bodies, inputs=inputs, device=device)
    inputs = [of_motion, of_state.start_q, of_state.particle_q, inverse_mass.grad]
    wp.launch(kernels.finish_backward, particles, inputs=inputs, device=device)
    motion.friction.backward(of_motion.friction, of_planes.friction)
