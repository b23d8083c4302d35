"""Small scenes of the solver with contact inside, whose gradients tests compare with differences of their inputs."""

import itertools

import newton
import numpy as np
import warp as wp
from gradient_reference import ReferenceSteps

import warp_bsc as bsc

DT = 1.0 / 60.0
CLOTH = {"tri_ke": 80.0, "tri_ka": 60.0, "tri_kd": 0.05, "edge_ke": 5e-3, "edge_kd": 5e-4, "particle_radius": 0.0}
TILT = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.2)
OF_CLOTH = "tri_materials", "tri_poses", "tri_areas", "edge_rest_angle", "edge_rest_length", "edge_bending_properties"
OF_SPRINGS = "spring_rest_length", "spring_stiffness", "spring_damping"
OF_ATTACHMENTS = tuple(f"attachment_particle_body_{name}" for name in ("body_point", "stiffness", "damping"))
OF_ALL = "x", "v", "particle_f", "particle_inv_mass", "gravity"
SIZES = {"x": 0.1, "v": 1.0, "particle_f": 0.1, "poses": 0.1, "places": 0.1, "edge_rest_angle": 1.0}
SIZES |= {"attachment_particle_body_body_point": 0.1}
"""Sizes of inputs whose differences are not to be shares of their values."""


def add_cloth(builder, cells, at, velocity=(0.0, 0.0, 0.0), *, rot=TILT, cell=0.05, **options):
    """Adds a cloth of so many cells in both directions."""
    dims = {"dim_x": cells[0], "dim_y": cells[1], "cell_x": cell, "cell_y": cell, "mass": 0.002}
    builder.add_cloth_grid(pos=wp.vec3(*at), rot=rot, vel=wp.vec3(*velocity), **dims, **(CLOTH | options))


class Program:
    """Some steps on a tape, and a weighted sum of where they end; :meth:`run` computes both for changed inputs.

    Attributes:
        model, solver: What is stepped.
        inputs: Values of all inputs by name: of arrays of the model, or of ``arrays``; of positions and velocities of
            particles at the start, ``x`` and ``v``; of ``particle_f``, the external forces of all steps; of ``poses``
            of bodies and of ``places`` of particles without mass, in each step, which the program writes between steps.
        states: States of the last run.
    """

    def __init__(self, builder, names=(), *, steps=3, poses=None, places=None, arrays=None, dt=DT, **options):
        """Finalizes a builder; ``poses`` and ``places`` are those of each step."""
        builder.color()
        model = self.model = builder.finalize(device="cpu", requires_grad=True)
        self.dt, self.steps = dt, steps
        self.arrays = {name: getattr(model, name) for name in ("particle_inv_mass", "gravity", *names)} | (arrays or {})
        for array in self.arrays.values():
            array.requires_grad = True
        self.solver = bsc.SolverImplicit(model, max_iterations=60, **options)
        self.reference: ReferenceSteps | None = None
        rng, n = np.random.default_rng(3), model.particle_count
        self.weights = rng.normal(size=(2, n, 3)) / n * np.array([1.0, 0.02]).reshape(2, 1, 1)
        self.inputs = {name: array.numpy().copy() for name, array in self.arrays.items()}
        self.free = model.particle_inv_mass.numpy() > 0.0
        self.inputs |= {"x": model.particle_q.numpy().astype(float), "v": model.particle_qd.numpy().astype(float)}
        self.inputs["particle_f"] = (1e-3 * rng.normal(size=(n, 3))).astype(np.float32)
        if poses is not None:
            poses = np.array(poses)
            poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
            self.inputs["poses"] = poses.astype(np.float32)
        if places is not None:
            self.inputs["places"] = np.asarray(places, dtype=np.float32)

    def run(self, held=None, **changed):
        """Takes all steps on a tape, and returns the weighted sum of where they end."""
        inputs = self.inputs | changed
        for name, array in self.arrays.items():
            array.assign(inputs[name])
        self.solver.notify_model_changed(0)
        states = self.states = [self.model.state() for _ in range(self.steps + 1)]
        states[0].particle_q.assign(inputs["x"].astype(np.float32))
        states[0].particle_qd.assign(inputs["v"].astype(np.float32))
        for state in states:
            state.particle_f.assign(inputs["particle_f"])
        self.solver.reset(states[0])
        if self.reference is not None:
            self.reference.begin(inputs["x"], inputs["v"], held)
        self.tape = wp.Tape()
        self.converged = []
        for k, (start, end) in enumerate(itertools.pairwise(states)):
            if "poses" in inputs:
                start.body_q.assign(inputs["poses"][k])
            if "places" in inputs:
                x = start.particle_q.numpy()
                x[~self.free] = inputs["places"][k]
                start.particle_q.assign(x)
            with self.tape:
                self.solver.step(start, end, None, None, self.dt)
            self.converged.append(self.solver.report.converged)
        if self.reference is not None:
            return self.loss(self.reference.x, self.reference.v)
        return self.loss(states[-1].particle_q.numpy(), states[-1].particle_qd.numpy())

    def loss(self, x, v):
        """Returns the weighted sum of positions and velocities."""
        return (self.weights[0] * x).sum() + (self.weights[1] * v).sum()

    def gradients(self):
        """Runs, and returns the gradient with respect to each input, of the same shapes."""
        self.run()
        for array in self.arrays.values():
            array.grad.zero_()
        seeds = (wp.array(w, dtype=wp.vec3, device=self.model.device) for w in self.weights)
        states = self.states
        self.tape.backward(grads=dict(zip((states[-1].particle_q, states[-1].particle_qd), seeds, strict=True)))
        found = {name: array.grad.numpy().copy() for name, array in self.arrays.items()}
        found |= {"x": states[0].particle_q.grad.numpy().copy(), "v": states[0].particle_qd.grad.numpy().copy()}
        found["particle_f"] = sum(state.particle_f.grad.numpy() for state in states[:-1])
        if "poses" in self.inputs:
            found["poses"] = np.stack([state.body_q.grad.numpy() for state in states[:-1]])
        if "places" in self.inputs:
            found["places"] = np.stack([state.particle_q.grad.numpy()[~self.free] for state in states[:-1]])
        return found

    def refine(self):
        """Lets steps be solved in float64 from now on."""
        self.reference = ReferenceSteps(self.solver)
        return self

    def difference(self, name, eps, held, rng):
        """Returns a central difference of the loss for an input in a random direction, and that direction.

        Both are in units of what has changed: what float32 made of it.
        """
        values = self.inputs[name]
        direction = rng.normal(size=values.shape)
        direction *= SIZES.get(name, np.where(np.isfinite(values), values, 0.0))
        if name in ("x", "v"):
            direction[~self.free] = 0.0
        ends = []
        for sign in (1.0, -1.0):
            changed = values + sign * eps * direction
            if name == "poses":
                changed[..., 3:] /= np.linalg.norm(changed[..., 3:], axis=-1, keepdims=True)
            ends.append(changed.astype(values.dtype))
        losses = [self.run(held, **{name: end}) for end in ends]
        with np.errstate(invalid="ignore"):
            way = np.where(np.isfinite(values), ends[0].astype(float) - ends[1].astype(float), 0.0)
        return losses[0] - losses[1], way


def cloth_on_sphere():
    """A cloth thrown on a sphere."""
    builder = newton.ModelBuilder()
    at = wp.transform(wp.vec3(0.01, 0.005, -0.1), wp.quat_identity())
    builder.add_shape_sphere(-1, radius=0.1, xform=at, cfg=newton.ModelBuilder.ShapeConfig(mu=0.4))
    add_cloth(builder, (2, 2), (-0.05, -0.05, 0.006), (0.4, 0.1, -0.6))
    friction = wp.array(np.linspace(0.2, 0.5, builder.particle_count), dtype=float, device="cpu")
    return Program(builder, ("shape_material_mu", *OF_CLOTH), friction=friction, arrays={"friction": friction})


def cloth_on_edge():
    """A cloth that falls on the edge of a box, with a table of friction."""
    builder = newton.ModelBuilder()
    turned = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.05, 0.03)), 0.8)
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1414), turned), hx=0.2, hy=0.1, hz=0.1)
    add_cloth(builder, (2, 2), (-0.05, -0.03, 0.008), (0.3, 0.2, -0.5))
    table = wp.array([[-1.0, 0.3], [0.3, -1.0]], dtype=float, device="cpu")
    friction = bsc.FrictionTable(table, 0, 1)
    return Program(builder, OF_CLOTH, friction=friction, arrays={"friction_table": table})


def block_on_plane():
    """A soft block that falls on an infinite plane, which a kinematic body moves."""
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_plane(body=body, width=0.0, length=0.0, cfg=newton.ModelBuilder.ShapeConfig(mu=0.5))
    builder.add_soft_grid(
        pos=wp.vec3(0.0, 0.0, 0.012), rot=TILT, vel=wp.vec3(0.3, 0.1, -0.4), dim_x=1, dim_y=1, dim_z=1,
        cell_x=0.05, cell_y=0.05, cell_z=0.05, density=300.0, k_mu=3000.0, k_lambda=4000.0, k_damp=2.0,
        particle_radius=0.0,
    )  # fmt: skip
    poses = [[[0.002 * k, 0.001 * k, 0.0, 0.003 * k, -0.003 * k, 0.002 * k, 1.0]] for k in range(4)]
    names = "tet_poses", "tet_materials", "shape_material_mu"
    return Program(builder, names, steps=4, friction=0.4, poses=poses, min_distance=0.001)


def cloth_on_sheet():
    """A cloth that falls on a sheet, whose border a program moves."""
    builder = newton.ModelBuilder()
    add_cloth(builder, (2, 2), (-0.03, -0.02, 0.012), (0.3, 0.1, -0.6))
    held = dict.fromkeys(["fix_left", "fix_right"], True)
    add_cloth(builder, (2, 2), (-0.08, -0.08, 0.0), rot=wp.quat_identity(), cell=0.08, **held)
    x, mass = np.array(builder.particle_q, dtype=float), np.array(builder.particle_mass)
    places = [x[mass == 0.0] + k * np.array([0.001, 0.0005, 0.002]) for k in range(4)]
    return Program(builder, OF_CLOTH, steps=4, friction=0.3, places=places)


def rope_over_bar():
    """A rope that falls over a bar."""
    builder = newton.ModelBuilder()
    turned = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), np.pi / 2.0)
    bar = wp.transform(wp.vec3(0.0, 0.0, -0.05), turned)
    builder.add_shape_capsule(-1, xform=bar, radius=0.05, half_height=0.2)
    for i in range(5):
        builder.add_particle(wp.vec3(0.04 * (i - 2), 0.01 * i, 0.012), wp.vec3(0.1, 0.2, -0.6), 0.01, radius=0.005)
        if i:
            builder.add_spring(i - 1, i, 60.0, 0.5, 0.0)
    return Program(builder, (*OF_SPRINGS, "shape_material_mu"), friction=0.3, particle_radius=0.005)


def cloth_on_body():
    """A cloth that hangs on a body, which a program moves, by springs and where it is held, and lies on it."""
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_sphere(body, radius=0.1, xform=wp.transform(wp.vec3(0.02, 0.0, -0.1), wp.quat_identity()))
    add_cloth(builder, (2, 2), (-0.05, -0.05, 0.005), (0.3, 0.1, -0.5))
    x = np.array(builder.particle_q, dtype=float)
    for p, stiffness in ((0, np.inf), (2, 40.0), (6, 20.0), (7, np.inf)):
        builder.add_attachment_particle_body(
            p, body, body_point=wp.vec3(*(x[p] + 0.001)), stiffness=stiffness, damping=0.3
        )
    poses = [[[0.003 * k, 0.002 * k, -0.001 * k, 0.01 * k, 0.0, 0.02 * k, 1.0]] for k in range(4)]
    return Program(builder, (*OF_CLOTH[:1], *OF_ATTACHMENTS), steps=4, friction=0.3, poses=poses)


def pushed_cloth():
    """A cloth that a box pushes, which a program moves and turns, and that keeps a distance from it."""
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_box(body, hx=0.15, hy=0.15, hz=0.02)
    add_cloth(builder, (2, 2), (-0.05, -0.04, 0.03), (0.1, 0.0, -0.2))
    poses = [[[0.002 * k, 0.001 * k, 0.006 * k, 0.02 * k, 0.01 * k, 0.02 * k, 1.0]] for k in range(4)]
    return Program(builder, OF_CLOTH[:1], steps=4, friction=0.4, poses=poses, min_distance=0.002)


SCENES = {
    scene.__name__: scene
    for scene in (
        cloth_on_sphere, cloth_on_edge, block_on_plane, cloth_on_sheet, rope_over_bar, cloth_on_body, pushed_cloth,
    )
}  # fmt: skip
