"""Gradients through rigid bodies, against central differences: of a step by all that it reads, and of a rollout."""

import itertools

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import Still, add_square

import warp_bsc as bsc
from warp_bsc.response.adjoint.adjoint import RecordedStep, StepAdjoint

DT = 0.01
SOFT = {"tri_ke": 50.0, "tri_ka": 50.0, "tri_kd": 5e-2, "edge_ke": 1e-2, "edge_kd": 1e-3}


def add_triangles(builder, vertices):
    """Separate triangles of cloth."""
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*vertex) for vertex in vertices],
        indices=[*range(len(vertices))],
        density=1.0,
    )


def add_wedge(builder, at, **options):
    """A body with a tetrahedron as its shape, off its centre of mass, of mass 0.5 kg."""
    inertia = np.array([[0.03, 0.004, -0.002], [0.004, 0.05, 0.003], [-0.002, 0.003, 0.04]])
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, -0.5)), 0.4)
    body = builder.add_body(
        xform=wp.transform(wp.vec3(*at), rotation),
        mass=0.5,
        inertia=wp.mat33(*inertia.ravel().tolist()),
        com=wp.vec3(0.02, -0.03, 0.05),
        lock_inertia=True,
        **options,
    )
    points = np.array([(0.0, 0.0, -0.2), (0.25, 0.1, 0.1), (-0.2, 0.2, 0.1), (0.0, -0.25, 0.12)], dtype=np.float32)
    mesh = newton.Mesh(points, np.array([0, 2, 1, 0, 3, 2, 0, 1, 3, 1, 2, 3]), compute_inertia=False)
    builder.add_shape_mesh(body, mesh=mesh, cfg=newton.ModelBuilder.ShapeConfig(mu=0.4, density=0.0))
    return body


SHEET = [(-0.6, -0.5, 0.0), (0.7, -0.4, 0.02), (0.1, 0.8, -0.01)]


class Step:
    """One step of a scene whose start and wanted end are given, and everything that it reads, as numbers."""

    def __init__(
        self, device, shape, *, projections=40, truncations=8, turn=0.2, friction=0.5, restitution=0.4, layer=None
    ):
        builder = newton.ModelBuilder()
        add_triangles(builder, np.add(SHEET, (5.0, 0.0, 1.0)) if shape == "on the ground" else SHEET)
        if shape == "on the ground":
            builder.add_ground_plane(height=0.02, cfg=newton.ModelBuilder.ShapeConfig(mu=0.4))
        if shape == "plane":
            up = wp.transform(wp.vec3(0.0, 0.0, -0.05), wp.quat_from_axis_angle(wp.vec3(0.8, 0.6, 0.0), 0.02))
            config = newton.ModelBuilder.ShapeConfig(mu=0.4)
            builder.add_shape_plane(
                body=builder.add_body(xform=up, is_kinematic=True), width=0.0, length=0.0, cfg=config
            )
        else:
            add_wedge(builder, (0.05, 0.02, 0.25), is_kinematic=shape == "kinematic")
        self.model = model = builder.finalize(device=device, requires_grad=True)
        self.friction, self.restitution = (
            wp.array([value], dtype=float, device=device, requires_grad=True) for value in (friction, restitution)
        )
        options = {"friction": self.friction, "restitution": self.restitution, "bodies": "separated"}
        inner = Still(model) if layer is None else bsc.ContactLayer(Still(model), thickness=layer, **options)
        self.solver = bsc.SolverCCD(inner, contact_layer=False, max_iterations=projections, **options)
        self.solver.work.status.max_truncations = truncations
        self.states = start, end = model.state(), model.state()
        self.arrays = {
            "start_q": start.particle_q,
            "particle_q": end.particle_q,
            "particle_qd": end.particle_qd,
            "start_body_q": start.body_q,
            "body_q": end.body_q,
            "body_qd": end.body_qd,
            "particle_inv_mass": model.particle_inv_mass,
            "body_inv_mass": model.body_inv_mass,
            "body_inv_inertia": model.body_inv_inertia,
            "body_mass": model.body_mass,
            "body_inertia": model.body_inertia,
            "friction": self.friction,
            "shape_material_mu": model.shape_material_mu,
            "restitution": self.restitution,
        }
        self.values = {name: array.numpy().astype(float) for name, array in self.arrays.items()}
        random = np.random.default_rng(1)
        body_q = self.values["body_q"]
        body_q[0, :3] += (0.02, -0.01, 0.01 if shape == "plane" else -0.07)
        rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, -0.4, 2.0)), turn)
        body_q[0, 3:] = np.array(rotation * wp.quat(*body_q[0, 3:].tolist()))
        start_q = self.values["start_q"]
        self.values["particle_q"] += random.normal(scale=0.004, size=start_q.shape)
        self.values["particle_q"][:, 2] += -0.1 if shape == "plane" else 0.01
        velocity = (self.values["particle_q"] - start_q) / DT
        self.values["particle_qd"] = velocity + random.normal(scale=0.1, size=start_q.shape)
        twist = np.array([[2.0, -1.0, -7.0, 40.0 * turn, -15.0 * turn, 80.0 * turn]])
        self.values["body_qd"] = twist + random.normal(scale=0.1, size=(1, 6))
        self.values = {name: value.astype(np.float32).astype(float) for name, value in self.values.items()}
        self.results = "particle_q", "particle_qd", "body_q", "body_qd"

    def assign(self, values):
        for name, array in self.arrays.items():
            array.assign(values[name].astype(np.float32))
        self.solver.notify_model_changed(0)  # it reads the masses of particles then

    def end(self, values):
        self.assign(values)
        self.solver.step(*self.states, None, None, DT)
        return {name: self.arrays[name].numpy().astype(float) for name in self.results}

    def gradients(self, cotangents):
        self.assign(self.values)
        tape = wp.Tape()
        with tape:
            self.solver.step(*self.states, None, None, DT)
        for array in self.arrays.values():
            array.grad.zero_()
        for name, cotangent in cotangents.items():
            self.arrays[name].grad.assign(cotangent.astype(np.float32))
        tape.backward()
        return {name: array.grad.numpy().astype(float) for name, array in self.arrays.items()}

    def directions(self, random):
        """For each input, a direction and the length of its difference; of poses, those in which they stay poses."""
        for name, value in self.values.items():
            direction = random.integers(-2, 3, size=value.shape).astype(float)
            h = 2.0**-13
            if name in ("particle_qd", "body_qd"):
                h = 2.0**-6
            elif name in ("body_inertia", "body_inv_inertia"):
                direction = direction + direction.swapaxes(-1, -2)
                h = 2.0**-8 * np.abs(value).max()
            elif name in ("particle_inv_mass", "body_inv_mass", "body_mass"):
                direction = random.choice([-2.0, -1.0, 1.0, 2.0], size=value.shape)
                h = 2.0**-10 * np.abs(value).max()
            elif name in ("friction", "shape_material_mu", "restitution"):
                direction = np.ones(value.shape)
                h = 2.0**-8
            elif name in ("body_q", "start_body_q"):
                q = value[:, 3:]
                direction[:, 3:] -= (direction[:, 3:] * q).sum(axis=1, keepdims=True) * q
            yield name, h, direction


STEPS = {
    "projection": ("wedge", {}),
    "no friction": ("wedge", {"friction": 0.0, "restitution": 0.0}),
    "no turn": ("wedge", {"turn": 0.0}),
    "truncation": ("wedge", {"projections": 0}),
    "frozen": ("wedge", {"projections": 0, "truncations": 0}),
    "kinematic": ("kinematic", {}),
    "body on a plane": ("on the ground", {}),
    "body on a plane, truncation": ("on the ground", {"projections": 0, "turn": 0.5}),
    "moving plane": ("plane", {"turn": 0.02}),
    "moving plane, truncation": ("plane", {"projections": 0, "turn": 0.02}),
    "layer": ("wedge", {"layer": 0.3, "restitution": 0.1}),
    "layer, kinematic": ("kinematic", {"layer": 0.3}),
    "layer, moving plane": ("plane", {"layer": 0.2, "turn": 0.02}),
}


@pytest.mark.parametrize("case", STEPS)
def test_gradient_of_a_step_is_that_of_central_differences(case, device):
    shape, options = STEPS[case]
    scene = Step(device, shape, **options)
    end = scene.end(scene.values)
    report, moved = scene.solver.report, {name: end[name] - scene.values[name] for name in end}
    assert (report.predicted_contacts == 0) == ("layer" in case) and report.certified
    assert (report.truncated > 0) == ("truncation" in case) and (report.totals.frozen_steps > 0) == (case == "frozen")
    assert (np.abs(moved["particle_q"]).max() > 1e-3) == (shape != "on the ground")
    assert (np.abs(moved["body_q"]).max() > 1e-3) == (shape in ("wedge", "on the ground"))
    random = np.random.default_rng(0)
    for _ in range(2):
        cotangents = {
            name: random.normal(size=value.shape) * (DT if name.endswith("qd") else 1.0) for name, value in end.items()
        }
        rounding = 2.0**-24 * np.sqrt(sum(((end[name] * cotangents[name]) ** 2).sum() for name in end))
        gradients = scene.gradients(cotangents)
        for name, h, direction in scene.directions(random):
            if h == 0.0 or (name == "friction" and options.get("friction") == 0.0):
                continue  # there is no mass, and no less friction
            sides = []
            for sign in (1.0, -1.0):
                values = scene.values | {name: scene.values[name] + sign * h * direction}
                result = scene.end(values)
                sides.append(sum((result[key] * cotangents[key]).sum() for key in result))
            expected = (sides[0] - sides[1]) / (2.0 * h)
            actual = (gradients[name] * direction).sum()
            np.testing.assert_allclose(actual, expected, rtol=2e-3, atol=8.0 * rounding / h, err_msg=name)


def test_an_incomplete_record_gives_nan(device):
    """As in a CUDA graph whose buffers are too small."""
    scene = Step(device, "wedge")
    scene.end(scene.values)
    with wp.Tape():
        scene.solver.step(*scene.states, None, None, DT)
    work = scene.solver.work
    recorded = RecordedStep(work, DT)
    arrays = [scene.arrays[name] for name in list(scene.arrays)[:6]]
    for complete in (1, 0):
        for array in scene.arrays.values():
            array.grad.fill_(1.0)
        recorded.counts.complete.fill_(complete)
        StepAdjoint(recorded).backward(*(array.grad for array in arrays))
        for name, array in scene.arrays.items():
            assert np.isfinite(array.grad.numpy()).all() == (complete == 1), name


@wp.kernel
def move_paddle(
    path: wp.array[wp.vec3],
    time: float,
    paddle: int,
    pose: wp.transform,
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    # out
    moved_q: wp.array[wp.transform],
    moved_qd: wp.array[wp.spatial_vector],
):
    """Moves the paddle from its pose at the start by a path of two coefficients; the other bodies stay."""
    body = wp.tid()
    moved_q[body] = body_q[body]
    moved_qd[body] = body_qd[body]
    if body == paddle:
        position = wp.transform_get_translation(pose) + time * path[0] + time * time * path[1]
        moved_q[body] = wp.transform(position, wp.transform_get_rotation(pose))


@wp.kernel
def add_along(
    particle_q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    plate: int,
    along: wp.vec3,
    body_along: wp.vec3,
    # out
    value: wp.array[float],
):
    i = wp.tid()
    wp.atomic_add(value, 0, wp.dot(particle_q[i], along) / float(particle_q.shape[0]))
    if i == 0:
        wp.atomic_add(value, 0, wp.dot(wp.transform_get_translation(body_q[plate]), body_along))


PATH = np.array([[0.1, -0.1, -1.5], [0.5, 0.3, -2.0]])
"""Velocity of the paddle, and half its acceleration."""


class PaddleSolver(newton.solvers.SolverSemiImplicit):
    """Lets the paddle go along a path."""

    def step(self, state_in, state_out, control, contacts, dt):
        state = self.model.state()
        state.particle_q, state.particle_qd = state_out.particle_q, state_out.particle_qd
        super().step(state_in, state, control, contacts, dt)
        self.time += dt
        inputs = [self.path, self.time, self.paddle, self.pose, state.body_q, state.body_qd]
        wp.launch(move_paddle, self.model.body_count, inputs=inputs, outputs=[state_out.body_q, state_out.body_qd])


class Push:
    """A paddle pushes a small patch of cloth against a plate that is free, for 40 steps."""

    def __init__(self, device, *, contact_layer):
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        add_square(builder, 2, 0.03, (0.0, 0.0, 0.04), (0.6190, -0.7751, 0.1268), 0.5911, **SOFT)
        poses = [
            wp.transform(wp.vec3(*at), wp.quat_from_axis_angle(wp.normalize(wp.vec3(*axis)), angle))
            for at, axis, angle in (
                ((0.0, 0.0, 0.0), (1.0, 0.4, 0.0), 0.25),
                ((0.02, 0.01, 0.085), (-0.5, 1.0, 0.0), 0.3),
            )
        ]
        inertia = wp.mat33(*np.diag([4e-5, 5e-5, 8e-5]).ravel().tolist())
        self.plate = builder.add_body(xform=poses[0], mass=0.02, inertia=inertia, lock_inertia=True)
        paddle = builder.add_body(xform=poses[1], is_kinematic=True)
        for body in (self.plate, paddle):
            config = newton.ModelBuilder.ShapeConfig(mu=0.3, density=0.0)
            builder.add_shape_box(body, hx=0.15, hy=0.15, hz=0.003, cfg=config)
        self.model = model = builder.finalize(device=device, requires_grad=True)
        model.particle_ke = model.particle_kd = model.particle_kf = 0.0
        model.particle_grid = None
        self.inner = PaddleSolver(model, enable_tri_contact=False)
        self.inner.paddle, self.inner.pose = paddle, poses[1]
        numbers = {"dtype": float, "device": device, "requires_grad": True}
        self.inner.path = wp.array(PATH, dtype=wp.vec3, device=device, requires_grad=True)
        self.friction, self.restitution, self.value = (wp.array([x], **numbers) for x in (0.3, 0.3, 0.0))
        options = {"friction": self.friction, "restitution": self.restitution, "contact_layer": contact_layer}
        self.solver = bsc.SolverCCD(self.inner, **options)
        self.states = [model.state() for _ in range(41)]
        self.inputs = {
            "path": self.inner.path,
            "friction": self.friction,
            "restitution": self.restitution,
            "shape_material_mu": model.shape_material_mu,
            "body_inv_mass": model.body_inv_mass,
            "body_mass": model.body_mass,
        }
        self.contacts = []

    def forward(self):
        """Simulates, and returns what is differentiated: how far cloth and plate are along two directions."""
        model, start = self.model, self.states[0]
        for name in ("particle_q", "particle_qd", "body_q", "body_qd"):
            getattr(start, name).assign(getattr(model, name))
        self.inner.time, self.contacts = 0.0, []
        for start, end in itertools.pairwise(self.states):
            start.clear_forces()
            self.solver.step(start, end, model.control(), None, DT / 6.0)
            self.contacts.append(self.solver.report.predicted_contacts)
        self.value.zero_()
        last = self.states[-1]
        along = np.array([1.0, 0.6, 0.8]), np.array([0.3, -0.5, 0.7])
        inputs = [last.particle_q, last.body_q, self.plate, *(wp.vec3(*x) for x in along)]
        wp.launch(add_along, model.particle_count, inputs=inputs, outputs=[self.value], device=model.device)
        ends = last.particle_q.numpy().astype(float).mean(axis=0), last.body_q.numpy()[self.plate, :3].astype(float)
        return sum(end @ direction for end, direction in zip(ends, along, strict=True))


@pytest.mark.parametrize(
    "contact_layer, length",
    [pytest.param(False, 1.0, marks=pytest.mark.slow), (True, 1.0), pytest.param(True, 5.0, marks=pytest.mark.slow)],
)
def test_gradient_of_a_rollout_is_that_of_central_differences(contact_layer, length, device):
    """By the path of a paddle, the mass of a body, and coefficients.

    Without a layer, in steps small enough that contacts stay; steps of five times the ``length`` are off by up to 150%.
    """
    scene = Push(device, contact_layer=contact_layer)
    with wp.Tape() as tape:
        scene.forward()
    tape.backward(scene.value)
    report, contacts = scene.solver.report, scene.contacts
    assert (sum(contacts) >= 20) == (not contact_layer)
    assert (report.totals.uncertified_steps, report.totals.truncated_steps) == (0, 0)
    first = {name: array.numpy().astype(float) for name, array in scene.inputs.items()}
    gradients = {name: array.grad.numpy().astype(float) for name, array in scene.inputs.items()}
    mass = first["body_mass"][scene.plate]
    on_plate = (np.arange(2) == scene.plate).astype(float)
    changes = [({"path": np.outer(row, [1.0, 1.0, 1.0])}, h) for row, h in (((1.0, 0.0), 3e-4), ((0.0, 1.0), 3e-3))]
    changes += [({"body_mass": on_plate, "body_inv_mass": -on_plate / mass**2}, 1e-4)]
    changes += [({name: np.ones(first[name].shape)}, 1e-3) for name in ("friction", "restitution", "shape_material_mu")]
    for change, least in changes:
        sides, h = [], length * least
        for sign in (1.0, -1.0):
            for name, direction in change.items():
                scene.inputs[name].assign((first[name] + sign * h * direction).astype(np.float32))
            sides.append(scene.forward())
        for name in change:
            scene.inputs[name].assign(first[name].astype(np.float32))
        expected = (sides[0] - sides[1]) / (2.0 * h)
        actual = sum((gradients[name] * direction).sum() for name, direction in change.items())
        np.testing.assert_allclose(actual, expected, rtol=0.01, err_msg=str(list(change)))
