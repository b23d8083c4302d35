"""Gradients through VBD against central differences of the same program, and against a reference in float64."""

import numpy as np
import pytest
from implicit_scenes import (
    DT,
    SELF_CONTACT,
    Rollout,
    attached_cloth,
    cloth_on_slope,
    colliding_cloths,
    hanging_cloth,
    held_cloth,
    soft_block,
    springs,
)
from scipy.optimize import root

MATERIALS = {
    hanging_cloth: {
        "particle_mass": 1e-4,
        "tri_materials": 2.0,
        "tri_areas": 5e-5,
        "tri_poses": 0.05,
        "edge_bending_properties": 1e-4,
        "edge_rest_angle": 0.02,
        "edge_rest_length": 1e-3,
        "gravity": 0.1,
    },
    cloth_on_slope: {"tri_materials": 2.0, "shape_material_ke": 6.0, "shape_material_mu": 0.01},
    soft_block: {"tet_materials": 50.0, "tet_poses": 0.05, "shape_material_mu": 0.02},
    springs: {"spring_stiffness": 1.0, "spring_damping": 0.01, "spring_rest_length": 1e-3, "gravity": 0.1},
    attached_cloth: {
        "attachment_particle_body_stiffness": 3.0,
        "attachment_particle_body_damping": 0.03,
        "attachment_particle_body_body_point": 1e-3,
    },
    held_cloth: {"attachment_particle_body_body_point": 1e-3},
    colliding_cloths: {"tri_materials": 2.0, "particle_mass": 1e-4},
}
"""Arrays of the model of a scene, each with the step of its central difference."""

OPTIONS = {
    attached_cloth: {"steps": 3},
    held_cloth: {"steps": 3},
    colliding_cloths: {"steps": 6, "dt": 1.0 / 240.0, "start": (0.3, 0.1, -0.3), **SELF_CONTACT},
}
"""Options of the rollout of a scene; shorter steps, as VBD cuts what moves too far towards other cloth."""


@pytest.mark.parametrize("scene", MATERIALS)
def test_gradients_are_those_of_central_differences(scene, device):
    model = scene(device)
    for name in MATERIALS[scene]:
        getattr(model, name).requires_grad = True
    options = {"steps": 5, "polish": 3} | OPTIONS.get(scene, {})
    rollout, rng = Rollout(model, **options), np.random.default_rng(5)
    states = rollout.backward()
    assert rollout.adjoint.report.unconverged_steps == 0
    assert rollout.adjoint.report.failed_solves == 0
    if rollout.pipeline:
        assert sum(int(contacts.soft_contact_count.numpy()[0]) for contacts in rollout.contacts) > 10
    velocity = rollout.velocity
    for axis in np.eye(3):
        direction, h = axis * (model.particle_inv_mass.numpy() > 0.0)[:, None], 3e-3
        central = (rollout.loss(velocity + h * direction) - rollout.loss(velocity - h * direction)) / (2.0 * h)
        gradient = (states[0].particle_qd.grad.numpy() * direction).sum()
        assert gradient == pytest.approx(central, rel=0.01, abs=1e-4)
    for name, h in MATERIALS[scene].items():
        array = getattr(model, name)
        direction = rng.uniform(0.5, 1.0, size=array.numpy().shape) * (array.numpy() != 0.0)
        if name in ("tri_materials", "edge_bending_properties", "tet_materials"):
            direction[:, 2:] = 0.0  # the damping of cloth has other magnitudes
        if name == "edge_rest_angle":
            direction = rng.uniform(0.5, 1.0, size=array.numpy().shape)
        central = rollout.central(array, direction, h)
        gradient = (array.grad.numpy() * direction).sum()
        assert gradient == pytest.approx(central, rel=0.02, abs=3e-6 / h), name


class Reference:
    """The steps of a hanging cloth in float64, as SciPy solves them, with forces of its own."""

    def __init__(self, rollout):
        model = self.model = rollout.model
        self.rollout, self.dt, self.g = rollout, DT, model.gravity.numpy()[0].astype(float)
        names = ("particle_mass", "tri_poses", "tri_areas", "tri_materials", "edge_rest_length")
        self.mass, self.poses, self.areas, self.materials, self.lengths = (
            getattr(model, name).numpy().astype(float) for name in names
        )
        self.bending = model.edge_bending_properties.numpy().astype(float)
        self.tri, edges = model.tri_indices.numpy(), model.edge_indices.numpy()
        self.inner = (edges >= 0).all(axis=1)
        self.edges, self.free = edges[self.inner], self.mass > 0.0

    def strain(self, x):
        a, b, c = (x[self.tri[:, i]] for i in range(3))
        return np.stack([b - a, c - a], axis=2) @ self.poses

    def angles(self, corners):
        a, b, c, d = (corners[:, i] for i in range(4))
        m, n, e = np.cross(c - a, d - a), np.cross(d - b, c - b), d - c
        sine = np.einsum("ij,ij->i", np.cross(m, n), e) / np.linalg.norm(e, axis=1)
        return np.arctan2(sine, np.einsum("ij,ij->i", m, n))

    def forces(self, x, x0):
        """Elastic forces, membranes by F C^-1, bending by central differences of the angle."""
        forces, transposed = np.zeros_like(x), (0, 2, 1)
        mu, lame, damping = (column[:, None, None] for column in self.materials[:, :3].T)
        lame = lame + mu
        f, f0 = self.strain(x), self.strain(x0)
        c, c0 = f.transpose(transposed) @ f, f0.transpose(transposed) @ f0
        ratio = np.sqrt(np.linalg.det(c))[:, None, None]
        stress = mu * f + lame * (ratio - 1.0 - mu / lame) * ratio * f @ np.linalg.inv(c)
        stress += 2.0 * damping / self.dt * f @ (c - c0)
        of_sides = -self.areas[:, None, None] * stress @ self.poses.transpose(transposed)
        np.add.at(forces, self.tri[:, 1:], of_sides.transpose(transposed))
        np.add.at(forces, self.tri[:, 0], -of_sides.sum(axis=2))
        corners, h = x[self.edges], 1e-4
        angle = self.angles(corners)
        moment = self.bending[self.inner, 0] * angle + self.bending[self.inner, 1] / self.dt * (
            angle - self.angles(x0[self.edges])
        )
        moment *= self.lengths[self.inner]
        for i, j in np.ndindex(4, 3):
            rate = np.zeros(len(angle))
            for n, weight in ((1, 0.75), (2, -0.15), (3, 1.0 / 60.0)):
                for sign in (1.0, -1.0):
                    moved = corners.copy()
                    moved[:, i, j] += sign * n * h
                    rate += sign * weight / h * self.angles(moved)
            np.add.at(forces[:, j], self.edges[:, i], -moment * rate)
        return forces

    def loss(self, velocity):
        x = self.model.particle_q.numpy().astype(float)
        v, shape = velocity.astype(float), (-1, 3)
        for _ in range(self.rollout.steps):
            y = x + self.dt * v + self.dt**2 * self.g

            def balance(free, x0=x, y=y):
                x1 = x0.copy()
                x1[self.free] = free.reshape(shape)
                inertia = self.mass[:, None] / self.dt**2 * (y - x1)
                return (inertia + self.forces(x1, x0))[self.free].ravel()

            solved = root(balance, y[self.free].ravel(), tol=1e-13)
            assert np.abs(solved.fun).max() < 1e-10
            x1 = x.copy()
            x1[self.free] = solved.x.reshape(shape)
            v, x = (x1 - x) / self.dt, x1
        return (self.rollout.weights * np.stack([x, v])).sum()


@pytest.mark.slow
def test_gradients_are_those_of_a_reference_in_float64(device):
    model = hanging_cloth(device, n=2)
    arrays = {"tri_materials": model.tri_materials, "edge_bending_properties": model.edge_bending_properties}
    for array in arrays.values():
        array.requires_grad = True
    rollout = Rollout(model, steps=2)
    states, reference = rollout.backward(), Reference(rollout)
    assert rollout.loss() == pytest.approx(reference.loss(rollout.velocity), abs=1e-5)
    free, gradients, references = (model.particle_inv_mass.numpy() > 0.0)[:, None], [], []
    for axis in np.eye(3):
        moved = 1e-4 * axis * free
        gradients.append((states[0].particle_qd.grad.numpy() * axis).sum())
        ends = [reference.loss(rollout.velocity + sign * moved) for sign in (1.0, -1.0)]
        references.append((ends[0] - ends[1]) / 2e-4)
    np.testing.assert_allclose(gradients, references, atol=1e-3 * np.abs(references).max())
    for values, array in ((reference.materials, model.tri_materials), (reference.bending, arrays.popitem()[1])):
        gradients = array.grad.numpy().sum(axis=0)
        kept, ends = values[:, 0].copy(), []
        for sign in (1.0, -1.0):
            values[:, 0] = kept * (1.0 + sign * 1e-3)
            ends.append(reference.loss(rollout.velocity))
        values[:, 0] = kept
        assert gradients[0] == pytest.approx((ends[0] - ends[1]) / (2e-3 * kept.max()), rel=1e-3)
