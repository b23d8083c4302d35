"""Small scenes behind VBD, and what their gradients are compared with: rollouts on a tape, and central differences."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from newton_versions import HAS_ATTACHMENTS, HAS_HARD_ATTACHMENTS

import warp_bsc as bsc
from warp_bsc.implicit.elasticity.elements import ElementKind, elements_of_model

__all__ = [
    "CLOTH",
    "DT",
    "SELF_CONTACT",
    "Rollout",
    "attached_cloth",
    "cloth_on_slope",
    "colliding_cloths",
    "exact_hessians",
    "hanging_cloth",
    "held_cloth",
    "soft_block",
    "springs",
]

DT = 1.0 / 60.0

CLOTH = {"tri_ke": 80.0, "tri_ka": 60.0, "tri_kd": 5e-3, "edge_ke": 2e-3, "edge_kd": 1e-4, "particle_radius": 0.02}


SELF_CONTACT = {
    "particle_enable_self_contact": True,
    "particle_self_contact_margin": 0.01,
    "particle_self_contact_gap": 0.02,
}
"""Options of VBD by which :func:`colliding_cloths` collide."""


def add_cloth(builder, n, at, rotation=None, **options):
    """Adds a cloth of ``n`` by ``n`` cells of 5 cm."""
    rotation = wp.quat_identity() if rotation is None else rotation
    builder.add_cloth_grid(
        pos=wp.vec3(*at),
        rot=rotation,
        vel=wp.vec3(),
        dim_x=n,
        dim_y=n,
        cell_x=0.05,
        cell_y=0.05,
        mass=0.002,
        **CLOTH,
        **options,
    )


def _finished(builder, device):
    builder.color()
    return builder.finalize(device=device, requires_grad=True)


def hanging_cloth(device, n=3, worlds=1):
    """A cloth that one side holds, in each world somewhat larger."""
    scene = newton.ModelBuilder()
    for world in range(worlds):
        builder = newton.ModelBuilder()
        add_cloth(builder, n + world, (0.0, 0.0, 1.0), fix_left=True)
        if worlds == 1:
            return _finished(builder, device)
        scene.add_world(builder)
    return _finished(scene, device)


def cloth_on_slope(device):
    """A cloth that falls on a slope and slides."""
    builder = newton.ModelBuilder()
    tilt = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.3)
    config = newton.ModelBuilder.ShapeConfig(ke=300.0, kd=0.0, mu=0.3)
    builder.add_shape_plane(xform=wp.transform(wp.vec3(), tilt), width=0.0, length=0.0, cfg=config)
    turned = wp.quat_from_axis_angle(wp.normalize(wp.vec3(0.2, 1.0, 0.1)), 0.45)
    add_cloth(builder, 3, (0.0, 0.0, 0.06), turned)
    model = _finished(builder, device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 300.0, 0.0, 0.4
    return model


def soft_block(device):
    """A soft block that falls on the ground."""
    builder = newton.ModelBuilder()
    builder.add_soft_grid(
        pos=wp.vec3(0.0, 0.0, 0.03),
        rot=wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.4, 0.2)), 0.2),
        vel=wp.vec3(),
        dim_x=2,
        dim_y=2,
        dim_z=1,
        cell_x=0.05,
        cell_y=0.05,
        cell_z=0.05,
        density=300.0,
        k_mu=3000.0,
        k_lambda=4000.0,
        k_damp=2.0,
        particle_radius=0.01,
    )
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(ke=2000.0, kd=0.0, mu=0.5))
    model = _finished(builder, device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 2000.0, 0.0, 0.5
    return model


def springs(device):
    """A chain of masses on damped springs, held at one end."""
    builder = newton.ModelBuilder()
    for i in range(5):
        builder.add_particle(wp.vec3(0.1 * i, 0.01 * i * i, 1.0), wp.vec3(), 0.0 if i == 0 else 0.02, radius=0.01)
    for i, j in [(0, 1), (1, 2), (2, 3), (3, 4), (0, 2), (2, 4)]:
        builder.add_spring(i, j, 60.0, 0.1, 0.0)
    return _finished(builder, device)


def attached_cloth(device, stiffness=30.0):
    """A cloth of which one side hangs on damped attachments to a kinematic body. Skips where Newton has none."""
    if not HAS_ATTACHMENTS:
        pytest.skip("Newton 1.6 has no attachments of particles to bodies")
    builder = newton.ModelBuilder()
    body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()), is_kinematic=True)
    add_cloth(builder, 3, (0.0, 0.0, 1.0))
    for row in range(4):
        point = wp.vec3(-0.002, 0.05 * row, 0.001)
        builder.add_attachment_particle_body(4 * row, body, body_point=point, stiffness=stiffness, damping=0.1)
    builder.add_attachment_particle_body(1, body, stiffness=1000.0, enabled=False)
    return _finished(builder, device)


def held_cloth(device):
    """A cloth of which a kinematic body holds one side. Skips where Newton cannot have that."""
    if not HAS_HARD_ATTACHMENTS:
        pytest.skip("Newton before 1.8 has no attachments of infinite stiffness")
    return attached_cloth(device, stiffness=np.inf)


def colliding_cloths(device, heights=(0.012,)):
    """A cloth that falls on another one, which is held at its sides; a world for each height from which it falls."""
    scene = newton.ModelBuilder()
    turned = wp.quat_from_axis_angle(wp.normalize(wp.vec3(0.1, 0.15, 1.0)), 0.4)
    held = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
    for height in heights:
        builder = newton.ModelBuilder()
        add_cloth(builder, 2, (0.04, 0.0, height), turned)
        add_cloth(builder, 3, (0.0, 0.0, 0.0), **held)
        scene.add_world(builder)
    model = _finished(scene, device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 300.0, 0.0, 0.4
    return model


def exact_hessians(elastic, model):
    """Yields the particles of elements of each kind, -1 for none, and the Hessians that ``elastic`` has computed."""
    _, vertices = elements_of_model(model)
    blocks, bends, place = elastic.blocks.numpy(), elastic.bends.numpy(), 0
    for kind, v in enumerate(vertices):
        n, size = v.shape
        if kind == ElementKind.BENDING:
            hessian = bends
        else:
            hessian, place = blocks[place : place + n * size * size], place + n * size * size
        yield v, hessian.reshape(n, size, size, 3, 3).transpose(0, 1, 3, 2, 4)


class Rollout:
    """Steps of a model from velocities that a number moves, and a weighted sum of where they end."""

    def __init__(self, model, *, steps=8, iterations=10, polish=4, start=(0.2, 0.1, -0.3), wrap=None, dt=DT, **options):
        self.model, self.steps, self.dt = model, steps, dt
        of_vbd = {name: options.pop(name) for name in list(options) if name.startswith("particle_")}
        inner = newton.solvers.SolverVBD(model, iterations=iterations, **of_vbd)
        self.adjoint = bsc.SolverImplicitAdjoint(inner, polish=polish, **options)
        self.solver = self.adjoint if wrap is None else wrap(self.adjoint)
        n, rng = model.particle_count, np.random.default_rng(3)
        self.weights = rng.normal(size=(2, n, 3)) / n * np.array([1.0, 0.05]).reshape(2, 1, 1)
        free = (model.particle_inv_mass.numpy() > 0.0)[:, None]
        self.velocity = (np.array(start) + 0.1 * rng.normal(size=(n, 3))) * free
        self.pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.02) if model.shape_count else None
        self.contacts = [self.pipeline.contacts() for _ in range(steps)] if self.pipeline else [None] * steps

    def begin(self, velocity=None):
        states = [self.model.state() for _ in range(self.steps + 1)]
        velocity = self.velocity if velocity is None else velocity
        states[0].particle_qd.assign(velocity.astype(np.float32))
        return states

    def run(self, states):
        for (start, end), contacts in zip(itertools.pairwise(states), self.contacts, strict=True):
            if contacts is not None:
                self.pipeline.collide(start, contacts)
            self.solver.step(start, end, None, contacts, self.dt)
        return states

    def loss(self, velocity=None):
        end = self.run(self.begin(velocity))[-1]
        return (self.weights[0] * end.particle_q.numpy()).sum() + (self.weights[1] * end.particle_qd.numpy()).sum()

    def backward(self):
        """The states of a rollout, with gradients; those of the model are in its arrays."""
        states = self.begin()
        with wp.Tape() as tape:
            self.run(states)
        seeds = (wp.array(w, dtype=wp.vec3, device=self.model.device) for w in self.weights)
        tape.backward(grads=dict(zip((states[-1].particle_q, states[-1].particle_qd), seeds, strict=True)))
        return states

    def central(self, array, direction, h):
        """Central difference of the loss along a direction of an array of the model."""
        values = array.numpy().copy()
        ends = []
        for sign in (1.0, -1.0):
            array.assign((values + sign * h * direction).astype(np.float32))
            ends.append(self.loss())
        array.assign(values)
        return (ends[0] - ends[1]) / (2.0 * h)
