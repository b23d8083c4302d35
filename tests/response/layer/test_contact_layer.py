"""The contact layer: results are continuous, gradients hold across changes of contacts, bounces give restitution."""

import itertools
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers.experimental.coupled import CouplingInterface
from newton_scenes import Rollout, Still, add_square

import warp_bsc as bsc
from warp_bsc.response.tuning import START_DEPTH

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


def semi_implicit(model):
    model.particle_ke = model.particle_kd = model.particle_kf = 0.0
    model.particle_grid = None
    return newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)


def layered(inner, thickness=LAYER, *, min_distance=None, **options):
    """A stage behind a contact layer around a solver; without the layer if its thickness is None."""
    if thickness is not None:
        inner = bsc.ContactLayer(inner, thickness=thickness, min_distance=min_distance, **options)
    return bsc.SolverCCD(inner, min_distance=min_distance, contact_layer=False, **options)


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
        self.solver = layered(inner, friction=0.3, restitution=0.2)
        self.states = [self.model.state() for _ in range(STEPS + 1)]
        vectors = {"shape": worlds, "dtype": wp.vec3, "device": device, "requires_grad": requires_grad}
        self.velocity, self.centre = wp.zeros(**vectors), wp.zeros(**vectors)

    def forward(self):
        """Steps, and sums the centres of the patches at the end."""
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

    def centres(self, velocities):
        """The centres of the patches after all steps, by their velocities, in double precision."""
        self.velocity.assign(np.asarray(velocities, dtype=np.float32))
        self.forward()
        particles = self.states[-1].particle_q.numpy().astype(float)
        return particles.reshape(-1, self.per_world, 3)[:, : self.thrown].mean(axis=1)

    def gradients(self, velocity):
        """The derivatives of the components of a centre by those of a velocity, shape [3 of the centre, 3]."""
        self.velocity.assign(velocity[None])
        tape = wp.Tape()
        with tape:
            self.forward()
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
    assert scene.solver.report.totals.uncertified_steps == 0
    steps = np.stack([velocities[:, k, 0, k] - velocities[:, k, 1, k] for k in range(3)], axis=1)
    return ((centres[:, :, 0] - centres[:, :, 1]) / steps[..., None]).swapaxes(1, 2)


@pytest.mark.parametrize(
    "target, velocity",
    [
        ("sphere", (-0.1, 0.0, -2.2)),
        pytest.param("box", (-0.4, 0.3, -2.6), marks=pytest.mark.slow),
        pytest.param("sheet", (-0.3, 0.4, -2.4), marks=pytest.mark.slow),
    ],
)
def test_central_differences_agree_with_each_other_and_with_the_tape(target, velocity, device):
    """Within 3% of the largest component, and in each component of at least a fifth of it.

    Without the layer, they are off the tape by up to 25 times its largest component. With it, the four and the tape
    are within 3% of the largest in 94 of 96 random throws; in smaller components, 1e-2 m/s is often too long a step.
    """
    velocity = np.array(velocity, dtype=np.float32)
    differences = central_differences(device, target, velocity)
    scene = Throws(device, target, 1, requires_grad=True)
    derivatives = np.concatenate([differences, scene.gradients(velocity)[None]])
    assert scene.solver.report.gradient_counts.lost_steps == 0
    sizes = np.abs(derivatives).min(axis=0)
    spread = derivatives.max(axis=0) - derivatives.min(axis=0)
    assert (spread <= 0.03 * sizes.max()).all()
    assert (spread <= 0.03 * sizes)[sizes >= 0.2 * sizes.max()].all()
    flight = np.eye(3) * STEPS * DT
    assert np.abs(derivatives - flight).max() > 0.2 * STEPS * DT  # of a patch that met its target


def add_floor(builder, kind, friction=0.0):
    """A floor at the height 0."""
    config = newton.ModelBuilder.ShapeConfig(mu=friction, density=0.0)
    if kind == "plane":
        builder.add_ground_plane(cfg=config)
        return
    corners = np.linspace(-0.3, 0.3, 21)
    vertices = [(x, y, 0.0) for x in corners for y in corners]
    faces = []
    for i, j in itertools.product(range(20), range(20)):
        a = 21 * i + j
        faces += [a, a + 22, a + 1, a, a + 21, a + 22]
    builder.add_shape_mesh(-1, mesh=newton.Mesh(vertices, faces), cfg=config)


@pytest.mark.parametrize("restitution, speed", [(0.0, 2.0), (0.2, 0.1), (0.2, 2.0), (1.0, 0.1)])
@pytest.mark.parametrize("floor, tolerance", [("plane", 1e-3), ("mesh", 0.05)])
def test_a_bounce_returns_the_restitution_whenever_it_begins(floor, tolerance, restitution, speed, device):
    """Patches that come down flat, each at another part of a step."""
    count = 7
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for i in range(count):
        height = LAYER + (3.0 + i / count) * speed * DT
        world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        add_square(world, 4, 0.03, (0.0, 0.0, height), velocity=(0.0, 0.0, -speed), **FREE)
        add_floor(world, floor)
        builder.add_world(world)
    model = builder.finalize(device=device)
    solver = layered(semi_implicit(model), friction=0.0, restitution=restitution)
    rollout = Rollout(model, solver)
    for _ in range(16):
        rollout.step(DT)
        assert solver.report.certified and solver.report.predicted_contacts == 0
    upward = rollout.states[0].particle_qd.numpy().reshape(count, -1, 3)[..., 2].mean(axis=1)
    np.testing.assert_allclose(upward / speed, restitution, atol=tolerance)


def colliding_patches(**options):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_square(builder, 4, 0.03, (0.0, 0.0, 0.02), (1.0, 0.3, 0.0), 0.2, (0.4, 0.1, -0.5), **options)
    add_square(builder, 3, 0.04, (0.01, 0.02, -0.01), (0.2, 1.0, 0.0), -0.3, (0.0, -0.2, 0.5), **options)
    return builder


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_pushes_conserve_momentum(friction, device):
    model = colliding_patches(**FREE).finalize(device=device)
    solver = layered(semi_implicit(model), friction=friction, restitution=0.5)
    rollout = Rollout(model, solver)
    mass = model.particle_mass.numpy().astype(float)[:, None]

    start = rollout.states[0].particle_qd.numpy().copy()
    for _ in range(30):
        rollout.step(DT)
        assert solver.report.certified and solver.report.predicted_contacts == 0
    assert np.abs(rollout.states[0].particle_qd.numpy() - start).max() > 0.3
    before, after = ((mass * velocities).sum(axis=0) for velocities in (start, rollout.states[0].particle_qd.numpy()))
    np.testing.assert_allclose(after, before, atol=1e-7 * mass.sum())


def test_many_worlds_are_each_bit_for_bit_as_alone(device):
    """Of cloth without forces, which the inner solver would add in any order on a GPU."""
    world = colliding_patches(**FREE)
    world.add_ground_plane(height=-0.03)
    many = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    many.replicate(world, 3)
    ends = []
    for builder in (world, many):
        model = builder.finalize(device=device)
        solver = layered(semi_implicit(model), friction=0.3, restitution=0.5)
        rollout = Rollout(model, solver)
        start = rollout.states[0].particle_qd.numpy().copy()
        for _ in range(15):
            rollout.step(DT)
        assert np.abs(rollout.states[0].particle_qd.numpy() - start).max() > 0.3
        ends.append(rollout.states[0].particle_q.numpy())
    np.testing.assert_array_equal(ends[1].reshape(3, -1, 3), np.broadcast_to(ends[0], (3, *ends[0].shape)))


@pytest.mark.parametrize("layer, min_distance", [(0.012, None), (0.008, 0.004)])
def test_cloth_comes_to_rest_on_the_layer(layer, min_distance, device):
    builder = newton.ModelBuilder()
    add_square(builder, 4, 0.03, (0.0, 0.0, 0.02), (1.0, 0.3, 0.0), 0.1, **SOFT)
    add_floor(builder, "mesh", friction=0.5)
    model = builder.finalize(device=device)
    solver = layered(semi_implicit(model), layer, min_distance=min_distance, friction=0.5, restitution=0.0)
    rollout = Rollout(model, solver)
    for _ in range(200):
        rollout.step(DT)
    assert solver.report.totals.uncertified_steps == 0
    q, qd = (x.numpy() for x in (rollout.states[0].particle_q, rollout.states[0].particle_qd))
    assert np.abs(qd).max() < 0.01
    np.testing.assert_allclose(q[:, 2], layer + (min_distance or 0.0), atol=0.02 * layer)


def test_particles_outside_of_the_layer_keep_every_bit(device):
    ends = []
    for layer in (None, LAYER):
        builder = newton.ModelBuilder()
        add_square(builder, 3, 0.03, (0.0, 0.0, 0.1), **SOFT)
        builder.add_ground_plane()
        model = builder.finalize(device=device)
        rollout = Rollout(model, layered(semi_implicit(model), layer))
        for _ in range(5):
            rollout.step(DT)
        ends.append([x.numpy() for x in (rollout.states[0].particle_q, rollout.states[0].particle_qd)])
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("restitution", [0.1, 0.6])
def test_gradient_of_a_step_is_that_of_central_differences(restitution, device):
    """A triangle above another one, which is above the ground, all in a layer of a fifth of their size."""
    start = np.array(
        [(0, 0, 0.15), (1, 0, 0.16), (0, 1, 0.14), (0.3, 0.3, 0.3), (0.8, -0.5, 0.32), (-0.2, 0.6, 0.34)], dtype=float
    )
    shift = [(0.01, 0, -0.04), (0.02, 0.01, -0.05), (0, 0.02, -0.03), *3 * [(0.02, 0.01, -0.06)]]
    builder = newton.ModelBuilder()
    vertices = [wp.vec3(*vertex) for vertex in start]
    placed = {"pos": wp.vec3(), "rot": wp.quat_identity(), "vel": wp.vec3(), "scale": 1.0, "density": 1.0}
    builder.add_cloth_mesh(vertices=vertices, indices=[*range(6)], **placed)
    builder.add_ground_plane()
    model = builder.finalize(device=device, requires_grad=True)
    numbers = {"dtype": float, "device": device, "requires_grad": True}
    friction, bounce = wp.array([0.3], **numbers), wp.array([restitution], **numbers)
    solver = layered(Still(model), 0.2, friction=friction, restitution=bounce)
    states, dt = (model.state(), model.state()), 0.01
    arrays = [states[0].particle_q, states[1].particle_q, states[1].particle_qd]
    arrays += [model.particle_inv_mass, friction, bounce, model.shape_material_mu]
    first = [start, start + shift, np.array(shift) / dt, *(array.numpy() for array in arrays[3:])]
    first = [values.astype(np.float32).astype(float) for values in first]

    def end(values):
        for array, value in zip(arrays, values, strict=True):
            array.assign(value.astype(np.float32))
        solver.notify_model_changed(0)
        solver.step(*states, None, None, dt)
        return [states[1].particle_q.numpy().astype(float), states[1].particle_qd.numpy().astype(float)]

    pushed = np.abs(end(first)[0] - first[1]).max(axis=1)
    assert (pushed > 1e-3).all()
    assert solver.report.predicted_contacts == 0
    random = np.random.default_rng(1)
    for _ in range(3):
        cotangents = [random.normal(size=(6, 3)), dt * random.normal(size=(6, 3))]
        end(first)
        for array, value in zip(arrays, first, strict=True):
            array.assign(value.astype(np.float32))
            array.grad.zero_()
        tape = wp.Tape()
        with tape:
            solver.step(*states, None, None, dt)
        for array, cotangent in zip(arrays[1:3], cotangents, strict=True):
            array.grad.assign(cotangent.astype(np.float32))
        tape.backward()
        gradients = [array.grad.numpy().astype(float) for array in arrays]
        for which, h in enumerate((2.0**-12, 2.0**-12, 2.0**-5, 2.0**-6, 2.0**-6, 2.0**-9, 2.0**-6)):
            direction = random.integers(1, 3, size=first[which].shape) * random.choice([-1, 1], size=first[which].shape)
            sides = []
            for sign in (1.0, -1.0):
                values = [value.copy() for value in first]
                values[which] += sign * h * direction
                sides.append(sum((e * c).sum() for e, c in zip(end(values), cotangents, strict=True)))
            expected = (sides[0] - sides[1]) / (2.0 * h)
            scale = np.linalg.norm(gradients[which])
            assert scale > 0.0
            np.testing.assert_allclose((gradients[which] * direction).sum(), expected, rtol=0.01, atol=0.005 * scale)


def test_a_layer_without_room_for_its_pairs_pushes_nothing(device):
    """As in a CUDA graph, where queues cannot grow: the step is that without a layer, and it is counted."""
    ends = []
    for layer in (None, LAYER):
        model = colliding_patches(**SOFT).finalize(device=device)
        solver = layered(semi_implicit(model), layer)
        if layer is not None:
            detector = solver.solver._detector
            detector.capacities.zero_()
            detector.grow = lambda: False
        rollout = Rollout(model, solver)
        for _ in range(12):
            rollout.step(DT)
        assert solver.report.totals.uncertified_steps == 0
        ends.append(rollout.states[0].particle_q.numpy())
    assert 1 <= solver.solver.skipped_steps == solver.report.gradient_counts.layer_overflows <= 12
    assert "steps without their contact layer" in str(solver.report)
    np.testing.assert_array_equal(*ends)


def test_gradients_in_a_graph_are_those_without(device):
    velocity = np.array([(-0.3, 0.4, -2.4)], dtype=np.float32)
    gradients = []
    for captures in (False, True):
        scene = Throws(device, "sheet", 1, requires_grad=True)
        seed = wp.array([(1.0, 0.6, 0.8)], dtype=wp.vec3, device=device)

        def differentiate(scene=scene, seed=seed):
            tape = wp.Tape()
            with tape:
                scene.forward()
            tape.backward(grads={scene.centre: seed})
            return tape

        scene.velocity.assign(velocity)
        tape = differentiate()
        if captures:
            tape.zero()
            with wp.ScopedCapture(device) as capture:
                tape = differentiate()
            tape.zero()
            wp.capture_launch(capture.graph)
        assert scene.solver.report.gradient_counts.lost_steps + scene.solver.solver.skipped_steps == 0
        gradients.append(scene.velocity.grad.numpy())
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-5)


def test_a_layer_has_the_hooks_of_its_solver_for_couplers(device, monkeypatch):
    builder = newton.ModelBuilder()
    add_square(builder, 2, 0.03, (0.0, 0.0, 0.1), **SOFT)
    builder.color()
    inner = newton.solvers.SolverVBD(builder.finalize(device=device))
    layer = bsc.ContactLayer(inner)
    names = [name for name in dir(CouplingInterface) if name.startswith("coupling_")]
    assert len(names) > 5
    for name in names:
        monkeypatch.setattr(inner, name, lambda name=name: name)
        assert getattr(layer, name)() == name


def test_wrong_use(device):
    builder = newton.ModelBuilder()
    add_square(builder, 2, 0.03, (0.0, 0.0, 0.1), **SOFT)
    builder.add_shape_box(builder.add_body(mass=1.0), hx=0.02, hy=0.02, hz=0.02)
    model = builder.finalize(device=device, requires_grad=True)
    for layer in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="thickness"):
            bsc.ContactLayer(semi_implicit(model), thickness=layer)
    solver = layered(semi_implicit(model))
    state = model.state()
    with wp.Tape(), pytest.raises(ValueError, match="state_out must not be state_in"):
        solver.step(state, state, None, None, DT)


def test_the_stage_puts_a_layer_in_where_the_model_asks_for_gradients(device):
    """Of a quarter of an edge; not without gradients."""

    def layer_of(requires_grad=True, body=False, **options):
        builder = newton.ModelBuilder()
        add_square(builder, 3, 0.04, (0.0, 0.0, 0.1), **SOFT)
        builder.add_ground_plane()
        if body:
            builder.add_shape_box(builder.add_body(mass=1.0), hx=0.02, hy=0.02, hz=0.02)
        solver = bsc.SolverCCD(semi_implicit(builder.finalize(device=device, requires_grad=requires_grad)), **options)
        return solver.solver if isinstance(solver.solver, bsc.ContactLayer) else None

    layer = layer_of(friction=0.3)
    assert layer.thickness == pytest.approx(0.25 * 0.04, rel=0.01) and layer.friction.numpy() == np.float32(0.3)
    assert isinstance(layer.solver, newton.solvers.SolverSemiImplicit)
    assert layer_of(contact_layer=False) is None
    assert layer_of(requires_grad=False) is None
    assert layer_of(body=True) is not None
    distances = layer_of(min_distance=0.03)._layer.distances
    assert (distances.radius.numpy() == 0.015).all() and distances.of_planes.numpy().tolist() == [0.015]
    kept = layer_of(min_distance=0.01)  # neighbours beyond the next stay out of the layer
    assert kept.thickness == pytest.approx(0.45 * 0.04 - 0.01, rel=0.01)


@pytest.mark.parametrize("share", [0.0, 1e-8, 0.5, 0.95, 1.05])
@pytest.mark.parametrize("floor", ["plane", "mesh"])
def test_a_start_in_the_layer_is_named_and_gradients_are_finite(floor, share, device):
    """A patch that slides flat at a height; of one on the floor the sides are not known, and nothing pushes it."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_square(builder, 2, 0.05, (0.011, 0.013, share * LAYER), velocity=(1.0, 0.0, 0.0), **SOFT)
    add_floor(builder, floor)
    model = builder.finalize(device=device, requires_grad=True)
    solver = layered(semi_implicit(model), friction=0.2, restitution=0.5)
    states = [model.state() for _ in range(5)]
    with warnings.catch_warnings(record=True) as said, wp.Tape() as tape:
        warnings.simplefilter("always")
        for start, end in itertools.pairwise(states):
            start.clear_forces()
            solver.step(start, end, model.control(), None, DT)
    named = [str(warning.message) for warning in said if "deep in the contact layer" in str(warning.message)]
    in_layer = 1.0 - share > START_DEPTH and (share > 0.0 or floor == "plane")
    if share > 0.0 or floor == "plane":  # beside it, edges in the plane of the patch are near
        assert [text.partition(" ")[0] for text in named] == (["9"] if in_layer else [])
    thrown = states[-1].particle_q.numpy()[:, 2].max() - share * LAYER
    assert (thrown > 0.2 * LAYER) == in_layer or share == 0.5
    states[-1].particle_q.grad.fill_(wp.vec3(0.0, 0.0, 1.0))
    tape.backward()
    for name in ("particle_q", "particle_qd"):
        assert np.isfinite(getattr(states[0], name).grad.numpy()).all()
