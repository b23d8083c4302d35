"""The contact layer: results are continuous, gradients hold across changes of contacts, bounces give restitution."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp

import warp_bsc as bsc
from newton_scenes import Rollout

DT = 1.0 / 600.0
STEPS = 40
LAYER = 0.012
SOFT = {"tri_ke": 50.0, "tri_ka": 50.0, "tri_kd": 1e-2, "edge_ke": 1e-2, "edge_kd": 1e-3, "particle_radius": 0.005}
FREE = {"tri_ke": 0.0, "tri_ka": 0.0, "tri_kd": 0.0, "edge_ke": 0.0, "edge_kd": 0.0, "particle_radius": 0.005}
STEPS_OF_DIFFERENCES = np.array([1e-2, 3e-3, 1e-3, 3e-4])


@wp.kernel
def throw(velocity: wp.array[wp.vec3], thrown: int, per_world: int, particle_qd: wp.array[wp.vec3]):
    particle = wp.tid()
    if particle % per_world < thrown:
        particle_qd[particle] = velocity[particle / per_world]
    else:
        particle_qd[particle] = wp.vec3()


@wp.kernel
def add_to_centre(particle_q: wp.array[wp.vec3], thrown: int, per_world: int, centre: wp.array[wp.vec3]):
    particle = wp.tid()
    if particle % per_world < thrown:
        wp.atomic_add(centre, particle / per_world, particle_q[particle] / float(thrown))


def add_square(builder, cells, cell, at, axis=(1.0, 0.0, 0.0), angle=0.0, velocity=(0.0, 0.0, 0.0), **options):
    """A square patch of cloth, centred, turned about an axis."""
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(*axis)), angle)
    corner = wp.vec3(*at) + wp.quat_rotate(rotation, wp.vec3(-0.5 * cells * cell, -0.5 * cells * cell, 0.0))
    builder.add_cloth_grid(
        pos=corner,
        rot=rotation,
        vel=wp.vec3(*velocity),
        dim_x=cells,
        dim_y=cells,
        cell_x=cell,
        cell_y=cell,
        mass=0.001,
        **options,
    )


def semi_implicit(model):
    model.particle_ke = model.particle_kd = model.particle_kf = 0.0
    model.particle_grid = None
    return newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)


class Throws:
    """Patches thrown on a sphere, a box or a pinned sheet that are fixed, one in each world."""

    def __init__(self, device, target, worlds, *, requires_grad):
        world = newton.ModelBuilder()
        at = {"sphere": (0.02, 0.015, 0.16), "box": (0.02, 0.015, 0.115), "sheet": (0.01, -0.008, 0.055)}[target]
        add_square(world, 5, 0.03, at, (0.6190, -0.7751, 0.1268), 0.35, **SOFT)
        self.thrown = world.particle_count
        config = newton.ModelBuilder.ShapeConfig(mu=0.3, density=0.0)
        if target == "sphere":
            world.add_shape_sphere(-1, radius=0.1, cfg=config)
        elif target == "box":
            tilted = wp.transform(wp.vec3(), wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.3))
            world.add_shape_box(-1, xform=tilted, hx=0.05, hy=0.06, hz=0.05, cfg=config)
        else:
            pinned = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
            add_square(world, 5, 0.06, (0.0, 0.0, 0.0), (1.0, 0.4, 0.0), 0.1, **pinned, **SOFT)
        self.per_world = world.particle_count
        builder = newton.ModelBuilder()
        builder.replicate(world, worlds)
        self.model = builder.finalize(device=device, requires_grad=requires_grad)
        inner = semi_implicit(self.model)
        self.solver = bsc.SolverCCD(inner, friction=0.3, restitution=0.2, contact_layer=LAYER)
        self.states = [self.model.state() for _ in range(STEPS + 1)]
        vectors = {"shape": worlds, "dtype": wp.vec3, "device": device, "requires_grad": requires_grad}
        self.velocity, self.centre = wp.zeros(**vectors), wp.zeros(**vectors)

    def centres(self, velocities):
        """The centres of the patches after all steps, by their velocities."""
        self.velocity.assign(np.asarray(velocities, dtype=np.float32))
        self.states[0].particle_q.assign(self.model.particle_q)
        of_patches = [self.thrown, self.per_world]
        inputs, outputs = [self.velocity, *of_patches], [self.states[0].particle_qd]
        wp.launch(throw, self.model.particle_count, inputs=inputs, outputs=outputs, device=self.model.device)
        for before, after in itertools.pairwise(self.states):
            before.clear_forces()
            self.solver.step(before, after, None, None, DT)
        self.centre.zero_()
        inputs, outputs = [self.states[-1].particle_q, *of_patches], [self.centre]
        wp.launch(add_to_centre, self.model.particle_count, inputs=inputs, outputs=outputs, device=self.model.device)
        particles = self.states[-1].particle_q.numpy().astype(float)
        return particles.reshape(-1, self.per_world, 3)[:, : self.thrown].mean(axis=1)

    def gradients(self, velocity):
        """The derivatives of the components of a centre by those of a velocity, shape [3 of the centre, 3]."""
        tape = wp.Tape()
        with tape:
            self.centres(velocity[None])
        rows = []
        for axis in np.eye(3, dtype=np.float32):
            seed = wp.array(axis[None], dtype=wp.vec3, device=self.model.device)
            tape.backward(grads={self.centre: seed})
            rows.append(self.velocity.grad.numpy()[0].copy())
            tape.zero()
        return np.array(rows)


def central_differences(device, target, velocity):
    """Derivatives as :meth:`Throws.gradients` returns them, for each of :data:`STEPS_OF_DIFFERENCES`."""
    offsets = STEPS_OF_DIFFERENCES[:, None, None, None] * np.eye(3)[:, None] * np.array([1.0, -1.0])[:, None]
    velocities = (velocity + offsets).astype(np.float32).astype(float)
    scene = Throws(device, target, velocities.size // 3, requires_grad=False)
    centres = scene.centres(velocities.reshape(-1, 3)).reshape(velocities.shape)
    assert scene.solver.report.uncertified_steps == 0
    steps = np.stack([velocities[:, k, 0, k] - velocities[:, k, 1, k] for k in range(3)], axis=1)
    return ((centres[:, :, 0] - centres[:, :, 1]) / steps[..., None]).swapaxes(1, 2)


@pytest.mark.parametrize(
    "target, velocity",
    [("sphere", (0.5, -0.2, -1.7)), ("box", (0.7, 0.3, -2.0)), ("sheet", (-0.3, 0.4, -2.4))],
)
def test_central_differences_agree_with_each_other_and_with_the_tape(target, velocity, device):
    velocity = np.array(velocity, dtype=np.float32)
    differences = central_differences(device, target, velocity)
    scene = Throws(device, target, 1, requires_grad=True)
    all_of_them = np.concatenate([differences, scene.gradients(velocity)[None]])
    assert scene.solver.report.lost_gradients == 0
    np.set_printoptions(precision=5, suppress=True, linewidth=150)
    print(target, all_of_them.reshape(5, 9).T)
    largest = np.abs(all_of_them).max()
    counts = np.abs(all_of_them).min(axis=0) >= 0.01 * largest
    spread = all_of_them.max(axis=0) - all_of_them.min(axis=0)
    print((spread / np.abs(all_of_them).min(axis=0) * counts).max(), (spread / largest).max())
