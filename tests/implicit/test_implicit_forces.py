"""Forces of the implicit adjoint against those of VBD, at random states: a Newton that changes an energy fails here."""

import newton
import numpy as np
import pytest
import warp as wp
from implicit_scenes import (
    DT,
    SELF_CONTACT,
    attached_cloth,
    cloth_on_slope,
    colliding_cloths,
    hanging_cloth,
    soft_block,
    springs,
)

from warp_bsc.implicit.bodies import Poses
from warp_bsc.implicit.contacts import record_contacts, record_pairs
from warp_bsc.implicit.equations import Equations, Step
from warp_bsc.implicit.worlds import Worlds

if newton.__version__.startswith(("1.6.", "1.7.")):
    pytest.skip("calls kernels of VBD with their parameters in Newton 1.8", allow_module_level=True)

from newton._src.geometry.soft_contacts_mesh import _make_soft_contact_filter_data
from newton._src.solvers.vbd.particle_vbd_kernels import (
    MeshAdjacencyData,
    accumulate_body_particle_attachment_force_and_hessian,
    accumulate_elasticity_force_and_hessian,
    accumulate_self_contact_force_and_hessian,
    accumulate_spring_force_and_hessian,
    scatter_particle_body_contact_force_and_hessian,
)
from newton._src.solvers.vbd.rigid_vbd_kernels import update_duals_particle_body_attachments


@wp.kernel(enable_backward=False)
def forces_of_vbd(
    dt: float,
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    inertia: wp.array[wp.vec3],
    mass: wp.array[float],
    tri: wp.array2d[int],
    tri_poses: wp.array[wp.mat22],
    tri_materials: wp.array2d[float],
    tri_areas: wp.array[float],
    edge: wp.array2d[int],
    edge_angle: wp.array[float],
    edge_length: wp.array[float],
    edge_bending: wp.array2d[float],
    tet: wp.array2d[int],
    tet_poses: wp.array[wp.mat33],
    tet_materials: wp.array2d[float],
    adjacency: MeshAdjacencyData,
    forces: wp.array[wp.vec3],
    hessians: wp.array[wp.mat33],
):
    i = wp.tid()
    if mass[i] == 0.0:
        forces[i] = wp.vec3()
        return
    f = forces[i] + mass[i] / (dt * dt) * (inertia[i] - x1[i])
    f, h = accumulate_elasticity_force_and_hessian(
        i,
        dt,
        x0,
        x1,
        tri,
        tri_poses,
        tri_materials,
        tri_areas,
        edge,
        edge_angle,
        edge_length,
        edge_bending,
        tet,
        tet_poses,
        tet_materials,
        adjacency,
        f,
        hessians[i],
    )
    forces[i] = f
    hessians[i] = h


def attachment_inputs(solver, x1, poses):
    """The multipliers of attachments to their limit at x1, and what the force of VBD reads after the colors."""
    m, (pose_1, pose_0, _) = solver.model, poses
    names = "body", "particle", "body_point", "stiffness", "damping", "enabled"
    body, particle, point, stiffness, damping, enabled = (getattr(m, f"attachment_particle_body_{n}") for n in names)
    rho, multipliers = solver._attachment_particle_body_rho, solver._attachment_particle_body_lambda
    inputs = [body, particle, point, stiffness, enabled, x1, pose_1, rho]
    for _ in range(300):
        wp.launch(update_duals_particle_body_attachments, len(body), inputs=inputs, outputs=[multipliers])
    return [pose_1, pose_0, body, particle, point, stiffness, damping, enabled, rho, multipliers]


def sum_of_vbd(solver, x0, x1, inertia, contacts, poses):
    """The forces that a sweep of VBD sees at x1."""
    m, n = solver.model, solver.model.particle_count
    attachments = attachment_inputs(solver, x1, poses) if m.attachment_particle_body_count else None
    forces, hessians = wp.zeros(n, dtype=wp.vec3), wp.zeros(n, dtype=wp.mat33)
    outputs = [forces, hessians]
    for color in range(len(m.particle_color_groups)):
        if m.spring_count:
            inputs = [DT, color, x0, x1, m.particle_colors, m.spring_count, m.spring_indices, m.spring_rest_length]
            inputs += [m.spring_stiffness, m.spring_damping]
            wp.launch(accumulate_spring_force_and_hessian, m.spring_count, inputs=inputs, outputs=outputs)
        if attachments:
            count, inputs = m.attachment_particle_body_count, [DT, color, x0, x1, m.particle_colors, *attachments]
            wp.launch(accumulate_body_particle_attachment_force_and_hessian, count, inputs=inputs, outputs=outputs)
        if solver.particle_enable_self_contact:
            inputs = [DT, color, x0, x1, m.particle_colors, m.tri_indices, m.edge_indices]
            inputs += [solver.trimesh_collision_info, solver.particle_self_contact_margin, m.soft_contact_ke]
            inputs += [m.soft_contact_kd, m.soft_contact_mu, solver.friction_epsilon]
            inputs += [solver._self_contact_edge_edge_parallel_epsilon]
            count = solver.particle_self_contact_evaluation_kernel_launch_size
            wp.launch(accumulate_self_contact_force_and_hessian, count, inputs=inputs, outputs=outputs)
        if contacts is not None:
            inputs = [DT, color, x0, x1, m.particle_colors, solver.friction_epsilon]
            inputs += [solver.rigid_soft_contact_use_log_barrier, m.particle_radius, contacts.soft_contact_indices]
            inputs += [contacts.soft_contact_count, _make_soft_contact_filter_data(m, contacts, x1, None)]
            inputs += [contacts.soft_contact_max, 1, solver.body_particle_contact_penalty_k]
            inputs += [solver.body_particle_contact_material_kd, solver.body_particle_contact_material_mu, m.shape_body]
            inputs += [None, None, None, m.body_com, contacts.soft_contact_shape, contacts.soft_contact_body_pos]
            inputs += [contacts.soft_contact_body_vel, contacts.soft_contact_normal, m.shape_margin]
            inputs += [contacts.soft_contact_barycentric]
            wp.launch(scatter_particle_body_contact_force_and_hessian, 1, inputs=inputs, outputs=outputs)
    inputs = [DT, x0, x1, inertia, m.particle_mass, m.tri_indices, m.tri_poses, m.tri_materials, m.tri_areas]
    inputs += [m.edge_indices, m.edge_rest_angle, m.edge_rest_length, m.edge_bending_properties, m.tet_indices]
    inputs += [m.tet_poses, m.tet_materials, solver.particle_adjacency]
    wp.launch(forces_of_vbd, n, inputs=inputs, outputs=outputs)
    return forces.numpy()


@pytest.mark.parametrize("barrier", [False, True])
@pytest.mark.parametrize("scene", [hanging_cloth, cloth_on_slope, soft_block, springs])
def test_forces_are_those_of_vbd(scene, barrier, device):
    model, rng = scene(device), np.random.default_rng(1)
    solver = newton.solvers.SolverVBD(model, iterations=1, rigid_soft_contact_use_log_barrier=barrier)
    start, end = model.state(), model.state()
    x = model.particle_q.numpy()
    x += rng.normal(scale=0.01, size=x.shape).astype(np.float32)
    if model.shape_count:
        normal = np.array(wp.quat_rotate(wp.quat(*model.shape_transform.numpy()[0, 3:]), wp.vec3(0.0, 0.0, 1.0)))
        x -= ((x @ normal).mean() * normal).astype(np.float32)  # half of the particles touch the plane
    start.particle_q.assign(x)
    start.particle_qd.assign(rng.normal(size=x.shape).astype(np.float32))
    start.particle_f.assign(rng.normal(scale=0.01, size=x.shape).astype(np.float32))
    contacts = None
    if model.shape_count:
        pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.1)
        contacts = pipeline.contacts()
        pipeline.collide(start, contacts)
    x0, v0 = wp.clone(start.particle_q), wp.clone(start.particle_qd)
    solver.step(start, end, None, contacts, DT)
    moved = x0.numpy() + rng.normal(scale=0.005, size=x.shape).astype(np.float32)
    x1 = wp.array(np.where(model.particle_mass.numpy()[:, None] > 0.0, moved, x0.numpy()), dtype=wp.vec3)
    poses = Poses(None, None)
    expected = sum_of_vbd(solver, x0, x1, solver.inertia, contacts, poses)
    equations = Equations(solver, Worlds(model))
    equations.load(Step(DT, x0, v0, x1, start.particle_f, record_contacts(contacts, copies=True), None, poses))
    forces = equations.evaluate().numpy()
    np.testing.assert_allclose(forces, expected, atol=2e-5 * np.abs(expected).max())
    if contacts is not None:
        equations.load(Step(DT, x0, v0, x1, start.particle_f, None, None, poses))
        without = equations.evaluate().numpy()
        assert np.abs(without - expected).max() > 0.003 * np.abs(expected).max()


def random_poses(rng, device):
    """Poses of one body at the start and at the end of a step."""
    poses = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]]) + rng.normal(scale=0.01, size=(2, 1, 7))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    return Poses(*(wp.array(pose, dtype=wp.transform, device=device) for pose in poses))


def test_forces_of_attachments_are_those_of_vbd(device):
    model, rng = attached_cloth(device), np.random.default_rng(1)
    solver = newton.solvers.SolverVBD(model, iterations=1)
    start, end = model.state(), model.state()
    x0, v0, f = wp.clone(start.particle_q), wp.clone(start.particle_qd), start.particle_f
    solver.step(start, end, None, None, DT)
    moved = x0.numpy() + rng.normal(scale=0.005, size=(len(x0), 3))
    x1, poses = wp.array(moved, dtype=wp.vec3, device=device), random_poses(rng, device)
    expected = sum_of_vbd(solver, x0, x1, solver.inertia, None, poses)
    equations = Equations(solver, Worlds(model))
    equations.load(Step(DT, x0, v0, x1, f, None, None, poses))
    forces = equations.evaluate().numpy()
    np.testing.assert_allclose(forces, expected, atol=1e-4 * np.abs(expected).max())
    model.attachment_particle_body_enabled.zero_()
    assert np.abs(equations.evaluate().numpy() - expected).max() > 0.1 * np.abs(expected).max()


def test_forces_of_self_contact_are_those_of_vbd(device):
    model, rng = colliding_cloths(device), np.random.default_rng(1)
    model.soft_contact_kd = 0.5
    solver = newton.solvers.SolverVBD(model, iterations=1, **SELF_CONTACT)
    start, end = model.state(), model.state()
    start.particle_qd.assign(np.tile((0.3, 0.1, -0.5), (model.particle_count, 1)))
    x0, v0, f = wp.clone(start.particle_q), wp.clone(start.particle_qd), start.particle_f
    solver.step(start, end, None, None, DT)
    moved = end.particle_q.numpy() + rng.normal(scale=0.001, size=(len(x0), 3))
    x1 = wp.array(np.where(model.particle_mass.numpy()[:, None] > 0.0, moved, x0.numpy()), dtype=wp.vec3, device=device)
    poses, pairs = Poses(None, None), record_pairs(solver, Worlds(model))
    expected = sum_of_vbd(solver, x0, x1, solver.inertia, None, poses)
    equations = Equations(solver, Worlds(model))
    equations.load(Step(DT, x0, v0, x1, f, None, pairs, poses))
    forces = equations.evaluate().numpy()
    np.testing.assert_allclose(forces, expected, atol=2e-5 * np.abs(expected).max())
    triangles, edges = pairs.vertices[: pairs.triangles], pairs.vertices[pairs.triangles :]
    for left in (pairs._replace(vertices=triangles), pairs._replace(vertices=edges, triangles=0)):
        equations.load(Step(DT, x0, v0, x1, f, None, left, poses))
        assert np.abs(equations.evaluate().numpy() - expected).max() > 0.01 * np.abs(expected).max()
