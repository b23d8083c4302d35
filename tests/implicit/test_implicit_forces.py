"""Forces of the implicit adjoint against those of VBD, at random states: a Newton that changes an energy fails here."""

import newton
import numpy as np
import pytest
import warp as wp
from implicit_scenes import DT, cloth_on_slope, hanging_cloth, soft_block, springs
from newton._src.geometry.soft_contacts_mesh import _make_soft_contact_filter_data
from newton._src.solvers.vbd.particle_vbd_kernels import (
    MeshAdjacencyData,
    accumulate_elasticity_force_and_hessian,
    accumulate_spring_force_and_hessian,
    scatter_particle_body_contact_force_and_hessian,
)

from warp_bsc.implicit.bodies import Poses
from warp_bsc.implicit.contacts import record_contacts
from warp_bsc.implicit.equations import Equations, Step


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


def sum_of_vbd(solver, x0, x1, inertia, contacts):
    """The forces that a sweep of VBD sees at x1."""
    m, n = solver.model, solver.model.particle_count
    forces, hessians = wp.zeros(n, dtype=wp.vec3), wp.zeros(n, dtype=wp.mat33)
    outputs = [forces, hessians]
    for color in range(len(m.particle_color_groups)):
        if m.spring_count:
            inputs = [DT, color, x0, x1, m.particle_colors, m.spring_count, m.spring_indices, m.spring_rest_length]
            inputs += [m.spring_stiffness, m.spring_damping]
            wp.launch(accumulate_spring_force_and_hessian, m.spring_count, inputs=inputs, outputs=outputs)
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
    expected = sum_of_vbd(solver, x0, x1, solver.inertia, contacts)
    equations = Equations(solver)
    equations.load(Step(DT, x0, v0, x1, start.particle_f, record_contacts(contacts, Poses(None, None), copies=True)))
    forces = equations.evaluate().numpy()
    np.testing.assert_allclose(forces, expected, atol=2e-5 * np.abs(expected).max())
    if contacts is not None:
        equations.load(Step(DT, x0, v0, x1, start.particle_f, None))
        without = equations.evaluate().numpy()
        assert np.abs(without - expected).max() > 0.003 * np.abs(expected).max()
