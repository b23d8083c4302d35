"""Small scenes of the solver with contact inside, whose gradients tests compare with differences of their inputs."""

import itertools

import newton
import numpy as np
import warp as wp
from gradient_reference import BETWEEN_BODIES, ReferenceSteps
from newton_versions import needs_attachments, needs_hard_attachments

import warp_bsc as bsc

DT = 1.0 / 60.0
CLOTH = {"tri_ke": 80.0, "tri_ka": 60.0, "tri_kd": 0.05, "edge_ke": 5e-3, "edge_kd": 5e-4, "particle_radius": 0.0}
OF_MODEL = (
    *("particle_inv_mass", "gravity", "shape_material_mu", "body_inv_mass", "body_inertia", "body_inv_inertia"),
    *("tri_materials", "tri_poses", "tri_areas", "edge_bending_properties", "edge_rest_angle", "edge_rest_length"),
    *("tet_materials", "tet_poses", "spring_stiffness", "spring_damping", "spring_rest_length"),
    *(f"attachment_particle_body_{name}" for name in ("body_point", "stiffness", "damping")),
)
"""Arrays of a model that steps have gradients of."""
OF_STATE = "particle_q", "particle_qd", "particle_f", "body_q", "body_qd", "body_f"
DISTANCES = "min_distance", "particle_radius", "shape_margin"
"""Arrays of distances that pairs keep, where a program has any."""
INPUTS = *OF_STATE[:3], "places", "friction", "friction_table", *DISTANCES, *OF_MODEL, *OF_STATE[3:], "poses"
"""All inputs of programs."""
SIZES = {"particle_qd": 1.0, "edge_rest_angle": 1.0, "body_qd": 1.0, "body_f": np.repeat([0.1, 1e-3], 3)}
SIZES |= dict.fromkeys(("particle_q", "particle_f", "body_q", "poses", "places"), 0.1)
SIZES["attachment_particle_body_body_point"] = 0.1
"""Sizes of inputs whose differences are not shares of their values."""
STEPS = 1e-4, 1e-5, 1e-6
"""Shares of their sizes by which inputs are moved."""
COARSER = dict.fromkeys(("shape_material_mu", "friction", "gravity"), 100.0)
"""Factors of these for inputs from which something is computed in float32."""
FORCES = {"particle_f": 1e-3, "body_f": np.repeat([0.01, 1e-4], 3)}
"""Sizes of external forces [N], and moments [N m]."""
ON_FACES = "vertex-face", "edge-edge"


class Program:
    """Some steps on a tape, and a weighted sum of where they end; :meth:`run` computes both for changed inputs.

    Attributes:
        model, solver: What is stepped.
        kinds: The kinds of contacts that push in it.
        reference: What solves the steps in float64, after :meth:`refine`.
        inputs: Values of all inputs by name: of arrays of the model; of ``friction`` of particles, or of its table; of
            distances that pairs keep; of the state at the start; of external forces, which all steps have; of ``poses``
            of kinematic bodies and of ``places`` of particles without mass, in each step, which the program writes
            before it.
        free: Which particles have a mass.
        weights: Those of positions and of velocities at the end, by the name of the array of the state.
        forces: Names of external forces.
        states, tape: Of the last run.
    """

    def __init__(self, builder, device, kinds, *, friction, steps=3, poses=None, places=None, distances=(), **options):
        """Finalizes a builder; ``poses`` and ``places`` are those of each step.

        ``distances`` names the arrays of :data:`DISTANCES` that act; those without an option are of the model.
        """
        builder.color()
        model = self.model = builder.finalize(device=device, requires_grad=True)
        self.kinds, self.steps, self.reference, n = kinds, steps, None, model.particle_count
        missing = () if model.body_count and poses is None else ("body_",)  # none is free
        missing += ("tri_", "edge_") if model.tet_count else ()  # surfaces of soft bodies have no elasticity
        found = {name: getattr(model, name, None) for name in OF_MODEL if not name.startswith(missing)}
        self.arrays = {name: array for name, array in found.items() if array is not None and len(array)}
        of_state = [name for name in OF_STATE if not name.startswith(missing)]
        self.forces = [name for name in of_state if name in FORCES]
        if isinstance(friction, bsc.FrictionTable):
            self.arrays["friction_table"] = friction.coefficients
        else:
            friction = self.arrays["friction"] = wp.array(np.full(n, friction), dtype=float, device=device)
        self.arrays |= {name: options.get(name, getattr(model, name, None)) for name in distances}
        for array in self.arrays.values():
            array.requires_grad = True
        self.solver = bsc.SolverImplicit(model, max_iterations=60, friction=friction, **options)
        self.free, self.weights = model.particle_inv_mass.numpy() > 0.0, {}
        start, rng = model.state(), np.random.default_rng(3)
        self.inputs = {name: array.numpy().copy() for name, array in self.arrays.items()}
        for name in of_state:
            values = getattr(start, name).numpy().astype(float)
            random = rng.normal(size=values.shape)
            if name in FORCES:
                self.inputs[name] = np.float32(FORCES[name] * random)
            else:
                self.inputs[name] = values
                self.weights[name] = (1.0 if name.endswith("_q") else 0.02) / len(values) * random
        if poses is not None:
            self.inputs["poses"] = _normalized(np.array(poses)).astype(np.float32)
        if places is not None:
            self.inputs["places"] = np.float32(places)

    def refine(self):
        """Lets steps be solved in float64 from now on."""
        self.reference = ReferenceSteps(self.solver)

    def begin(self, inputs):
        """Returns the states of a run, with what all inputs but poses and places say."""
        for name, array in self.arrays.items():
            array.assign(inputs[name])
        self.solver.notify_model_changed(0)
        states = [self.model.state() for _ in range(self.steps + 1)]
        for name in self.weights:
            getattr(states[0], name).assign(np.float32(inputs[name]))
        for state, name in itertools.product(states, self.forces):
            getattr(state, name).assign(inputs[name])
        self.solver.reset(states[0])
        return states

    def write(self, state, inputs, k):
        """Writes poses and places before a step, as programs do that no tape sees."""
        if "poses" in inputs:
            state.body_q.assign(inputs["poses"][k])
        if "places" in inputs:
            x = state.particle_q.numpy().copy()
            x[~self.free] = inputs["places"][k]
            state.particle_q.assign(x)

    def run(self, held=None, **changed):
        """Takes all steps on a tape, and returns the weighted sum of where they end.

        Raises:
            RuntimeError: If a step in float64 did not converge.
        """
        inputs = self.inputs | changed
        states = self.states = self.begin(inputs)
        if self.reference is not None:
            self.reference.begin(held, *(inputs[name] for name in self.weights))
        self.tape = wp.Tape()
        for k, (start, end) in enumerate(itertools.pairwise(states)):
            self.write(start, inputs, k)
            with self.tape:
                self.solver.step(start, end, None, None, DT)
        ends = {name: getattr(states[-1], name).numpy() for name in self.weights}
        if self.reference is not None:
            ends |= self.reference.ends()
            if self.reference.unsolved.any() or not self.reference.residual < 1e-9:
                raise RuntimeError(f"a step did not converge: {self.reference.residual} of a weight is left")
        return sum((weights * ends[name]).sum() for name, weights in self.weights.items())

    def seeds(self):
        """Returns the gradients of the weighted sum with respect to the last state."""
        arrays = {name: getattr(self.states[-1], name) for name in self.weights}
        return {
            array: wp.array(self.weights[name], dtype=array.dtype, device=array.device)
            for name, array in arrays.items()
        }

    def gradients(self):
        """Runs, and returns the gradient with respect to each input, of the same shapes."""
        self.run()
        for array in self.arrays.values():
            array.grad.zero_()
        self.tape.backward(grads=self.seeds())
        starts = self.states[:-1]
        found = {name: array.grad.numpy().copy() for name, array in self.arrays.items()}
        found |= {name: getattr(starts[0], name).grad.numpy() for name in self.weights}
        found |= {name: sum(getattr(state, name).grad.numpy() for state in starts) for name in self.forces}
        if "poses" in self.inputs:
            found["poses"] = np.stack([state.body_q.grad.numpy() for state in starts])
        if "places" in self.inputs:
            found["places"] = np.stack([state.particle_q.grad.numpy()[~self.free] for state in starts])
        return found

    def difference(self, name, held, share, part):
        """Returns the change of the sum along a random way of a part of the last dimension of an input, and that way.

        The way is a share of its size, rounded to what float32 has.
        """
        values = self.inputs[name]
        size = SIZES.get(name, np.where(np.isfinite(values), values, 0.0))
        way, moved = np.zeros(values.shape), COARSER.get(name, 1.0) * share * size
        way[..., part] = (moved * np.random.default_rng(5).normal(size=values.shape))[..., part]
        if name in ("particle_q", "particle_qd"):
            way[~self.free] = 0.0
        ends = values + way, values - way
        normalized = _normalized if name in ("poses", "body_q") else np.asarray
        ends = [normalized(end).astype(values.dtype) for end in ends]
        above, below = (self.run(held, **{name: end}) for end in ends)
        above_end, below_end = (normalized(np.where(np.isfinite(values), end, 0.0).astype(float)) for end in ends)
        return above - below, above_end - below_end


def _normalized(poses):
    return np.concatenate([poses[..., :3], poses[..., 3:] / np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)], -1)


TILT = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.2)


def radii(builder, least, most, device):
    """Returns different radii of particles: the larger one of two that are equal is not smooth."""
    return wp.array(np.linspace(most, least, builder.particle_count), dtype=float, device=device)


def add_cloth(builder, at, velocity=(0.0, 0.0, 0.0), *, rot=TILT, cell=0.05, **options):
    """Adds a cloth of two by two cells."""
    dims = {"dim_x": 2, "dim_y": 2, "cell_x": cell, "cell_y": cell, "mass": 0.002}
    builder.add_cloth_grid(pos=wp.vec3(*at), rot=rot, vel=wp.vec3(*velocity), **dims, **(CLOTH | options))


def cloth_on_sphere(device):
    """A cloth thrown on a sphere; each particle has its friction."""
    builder = newton.ModelBuilder()
    at = wp.transform(wp.vec3(0.01, 0.005, -0.1), wp.quat_identity())
    builder.add_shape_sphere(-1, radius=0.1, xform=at, cfg=newton.ModelBuilder.ShapeConfig(mu=0.4))
    add_cloth(builder, (-0.05, -0.05, 0.006), (0.4, 0.1, -0.6))
    return Program(builder, device, ON_FACES, steps=2, friction=np.linspace(0.2, 0.5, builder.particle_count))


def cloth_on_edge(device):
    """A cloth that falls on an edge of a box, with a table of friction."""
    builder = newton.ModelBuilder()
    turned = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.05, 0.03)), 0.8)
    builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1414), turned), hx=0.2, hy=0.1, hz=0.1)
    add_cloth(builder, (-0.05, -0.03, 0.008), (0.3, 0.2, -0.5))
    table = wp.array([[-1.0, 0.3], [0.3, -1.0]], dtype=float, device=device)
    return Program(builder, device, ["edge-edge"], friction=bsc.FrictionTable(table, 0, 1))


def block_on_plane(device):
    """A soft block that falls on an infinite plane, which a program shifts and tilts, and from which it keeps 1 mm."""
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_plane(body=body, width=0.0, length=0.0, cfg=newton.ModelBuilder.ShapeConfig(mu=0.5, margin=5e-4))
    cells = dict.fromkeys(("dim_x", "dim_y", "dim_z"), 1) | dict.fromkeys(("cell_x", "cell_y", "cell_z"), 0.05)
    material = {"density": 300.0, "k_mu": 3000.0, "k_lambda": 4000.0, "k_damp": 2.0, "particle_radius": 0.0}
    at, velocity = wp.vec3(0.0, 0.0, 0.012), wp.vec3(0.3, 0.1, -0.4)
    builder.add_soft_grid(pos=at, rot=TILT, vel=velocity, **cells, **material)
    poses = [[[0.002 * k, 0.001 * k, 0.0, 0.003 * k, -0.003 * k, 0.002 * k, 1.0]] for k in range(3)]
    options = {"min_distance": "model", "particle_radius": radii(builder, 4e-4, 6e-4, device)}
    return Program(builder, device, ["plane"], friction=0.4, poses=poses, distances=DISTANCES[1:], **options)


def cloth_on_sheet(device):
    """A cloth that falls on a sheet, two sides of which a program moves; particles have radii."""
    builder = newton.ModelBuilder()
    add_cloth(builder, (-0.03, -0.02, 0.012), (0.3, 0.1, -0.6))
    held = dict.fromkeys(["fix_left", "fix_right"], True)
    add_cloth(builder, (-0.08, -0.08, 0.0), rot=wp.quat_identity(), cell=0.08, **held)
    x, is_held = np.array(builder.particle_q), np.array(builder.particle_mass) == 0.0
    places = [x[is_held] + k * np.array([0.001, 0.0005, 0.002]) for k in range(3)]
    options = {"particle_radius": radii(builder, 5e-4, 1e-3, device), "distances": ["particle_radius"]}
    return Program(builder, device, ON_FACES, friction=0.3, places=places, **options)


def rope_over_bar(device):
    """A rope of springs that falls over a bar, and keeps its radii, those of the model, from it."""
    builder = newton.ModelBuilder()
    turned = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), np.pi / 2.0)
    bar = wp.transform(wp.vec3(0.0, 0.0, -0.05), turned)
    builder.add_shape_capsule(-1, xform=bar, radius=0.05, half_height=0.2)
    for i in range(5):
        at, velocity = wp.vec3(0.04 * (i - 2), 0.01 * i, 0.012), wp.vec3(0.1, 0.2, -0.6)
        builder.add_particle(at, velocity, 0.01, radius=0.0045 + 2e-4 * i)
        if i:
            builder.add_spring(i - 1, i, 60.0, 0.5, 0.0)
    return Program(builder, device, ["edge-edge"], friction=0.3, distances=["particle_radius"])


def cloth_on_body(device):
    """A cloth that lies on a body, which a program moves, with springs to it, and two particles that it holds."""
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    at = wp.transform(wp.vec3(0.01, 0.0, -0.1), wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.1, 0.0)), 0.7))
    builder.add_shape_box(body, xform=at, hx=0.2, hy=0.06, hz=0.08)
    add_cloth(builder, (-0.05, -0.05, 0.006), (0.3, 0.1, -0.5))
    x = np.array(builder.particle_q)
    for p, stiffness in ((0, np.inf), (2, 40.0), (6, 20.0), (7, np.inf)):
        point = wp.vec3(*(1.02 * x[p]))  # which stretches the cloth
        builder.add_attachment_particle_body(p, body, body_point=point, stiffness=stiffness, damping=0.3)
    poses = [[[0.003 * k, 0.002 * k, -0.001 * k, 0.01 * k, 0.0, 0.02 * k, 1.0]] for k in range(4)]
    return Program(builder, device, ["edge-edge"], steps=4, friction=0.3, poses=poses)


def pushed_cloth(device):
    """A cloth that a box pushes, which a program moves and turns, and that keeps 2 mm from it."""
    builder = newton.ModelBuilder()
    body = builder.add_body(is_kinematic=True)
    builder.add_shape_box(body, hx=0.15, hy=0.15, hz=0.02, cfg=newton.ModelBuilder.ShapeConfig(margin=1e-3))
    add_cloth(builder, (-0.05, -0.04, 0.035), (0.1, 0.0, -0.2))
    poses = [[[0.002 * k, 0.001 * k, 0.006 * k, 0.02 * k, 0.01 * k, 0.02 * k, 1.0]] for k in range(3)]
    options = {"min_distance": "model", "particle_radius": radii(builder, 8e-4, 1e-3, device)}
    return Program(builder, device, ON_FACES, friction=0.4, poses=poses, distances=DISTANCES[1:], **options)


def boxes_on_plane(device):
    """A box on an infinite plane, one that falls on it, and a cloth that falls on that one, which keep a distance."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.4))
    cfg = newton.ModelBuilder.ShapeConfig(density=100.0, mu=0.5)
    axes = wp.vec3(1.0, 0.3, 0.2), wp.vec3(-0.4, 1.0, 0.3)
    for axis, at, angle in zip(axes, ((0.0, 0.0, 0.0425), (0.01, -0.005, 0.121)), (0.3, 0.2), strict=True):
        turn = wp.quat_from_axis_angle(wp.normalize(axis), angle)
        body = builder.add_body(xform=wp.transform(wp.vec3(*at), turn))
        builder.add_shape_box(body, hx=0.04, hy=0.03, hz=0.03, cfg=cfg)
        builder.body_qd[body] = wp.spatial_vector(0.1, -0.05, -0.2, 0.5, -0.3, 0.2)
    add_cloth(builder, (-0.05, -0.05, 0.165), (0.3, 0.1, -0.6))
    options = {"min_distance": wp.array([2e-5], dtype=float, device=device), "distances": ["min_distance"]}
    return Program(builder, device, ["edge-edge", "plane", BETWEEN_BODIES], steps=2, friction=0.3, **options)


OF_PARTICLES = (
    cloth_on_sphere,
    cloth_on_edge,
    block_on_plane,
    cloth_on_sheet,
    rope_over_bar,
    cloth_on_body,
    pushed_cloth,
)
SCENES = *OF_PARTICLES, boxes_on_plane


def marks_of(scene):
    """Returns the marks of tests of a scene."""
    return [needs_attachments, needs_hard_attachments] if scene is cloth_on_body else []
