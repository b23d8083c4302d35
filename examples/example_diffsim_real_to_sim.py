"""Example Diffsim Real To Sim: finds friction and stiffness of a cloth from point clouds of a depth camera.

    python examples/example_diffsim_real_to_sim.py
    python examples/example_diffsim_real_to_sim.py --worlds 64  # as many guesses at once, on a GPU

A cloth falls on a bar, and slides off. A camera sees it in 20 frames: points of the surface that neither the cloth nor
the bar hides, with noise, other ones in each frame. Nothing says which point of the cloth a point is. Each world has a
recording of its own, and a guess of the coefficient of friction, of the stiffness against stretching, ``tri_ke``, and
of that against bending, ``edge_ke``, each two to three times too large or too small. The searches go on in all worlds
at once. The loss is the chamfer distance of the clouds from the simulated surface; its gradient goes back through
contact and friction in all steps of ``SolverImplicit``.
"""

import newton
import numpy as np
import trimesh
import warp as wp
from common import main
from diffsim import DiffsimExample, build_worlds
from searches import FittedNewton

import warp_bsc as bsc

CELLS = 12, 6
SIDES = 0.7, 0.35  # [m]
DENSITY = 0.2  # [kg/m^2]
RADIUS = 0.1  # of the bar, which lies along y through the origin [m]
TRUTH = 0.15, 10.0, 1.0e-2  # friction, tri_ke [N/m], edge_ke [N]
NAMES = "friction", "tri_ke", "edge_ke"
STEPS = 40
EVERY = 2  # steps from one frame to the next
POINTS = 300  # of a frame
NOISE = 2.0e-3  # standard deviation of each coordinate [m]
EYE = 1.3, -1.0, 0.9  # of the camera [m]


@wp.kernel
def set_parameters(
    # in
    logarithms: wp.array[wp.vec3],
    particles: int,
    triangles: int,
    edges: int,
    # out
    friction: wp.array[float],
    shape_material_mu: wp.array[float],
    tri_materials: wp.array2d[float],
    edge_bending_properties: wp.array2d[float],
):
    """Sets what the logarithms of each world say, for the bar and this many particles, triangles and edges of it."""
    element = wp.tid()
    if element < shape_material_mu.shape[0]:
        shape_material_mu[element] = wp.exp(logarithms[element][0])
    if element < friction.shape[0]:
        friction[element] = wp.exp(logarithms[element // particles][0])
    if element < tri_materials.shape[0]:
        stiffness = wp.exp(logarithms[element // triangles][1])
        tri_materials[element, 0] = stiffness
        tri_materials[element, 1] = stiffness
    if element < edge_bending_properties.shape[0]:
        edge_bending_properties[element, 0] = wp.exp(logarithms[element // edges][2])


@wp.kernel
def add(values: wp.array[float], total: wp.array[float]):
    """Adds values to their total."""
    wp.atomic_add(total, 0, values[wp.tid()])


@wp.kernel(enable_backward=False)
def mark_seen(cloth: wp.uint64, points: wp.array[wp.vec3], eye: wp.vec3, seen: wp.array[bool]):
    """Marks the points of a cloth that a camera sees: neither the cloth nor the bar is between them."""
    point = points[wp.tid()]
    way = eye - point
    length = wp.length(way)
    from_axis, way_from_axis = wp.vec2(point[0], point[2]), wp.vec2(way[0], way[2])
    share = wp.clamp(-wp.dot(from_axis, way_from_axis) / wp.length_sq(way_from_axis), 0.0, 1.0)
    is_free = wp.length(from_axis + share * way_from_axis) > RADIUS
    first = 1.0e-4  # from the triangle that it is on [m]
    hidden = wp.mesh_query_ray_anyhit(cloth, point + first * way / length, way / length, length)
    seen[wp.tid()] = is_free and not hidden


def record(x, faces, eye, rng):
    """Returns points of a cloth that a camera sees, with noise, and the share of the cloth that it sees.

    Args:
        x: Positions of particles [m], shape [n, 3].
        faces: Triangles of the cloth, shape [m, 3].
        eye: Position of the camera [m].
        rng: NumPy's random numbers.

    Returns:
        As many points as seen, at most ``POINTS``, shape [POINTS, 3]; 1 / POINTS for each of them, 0 for what is not
        filled, shape [POINTS]; the share.
    """
    sampled, _ = trimesh.sample.sample_surface(trimesh.Trimesh(x, faces, process=False), 8 * POINTS, seed=rng)
    cloth = wp.Mesh(wp.array(x, dtype=wp.vec3), wp.array(faces.reshape(-1), dtype=int))
    seen = wp.empty(len(sampled), dtype=bool)
    inputs = [cloth.id, wp.array(sampled, dtype=wp.vec3), wp.vec3(*eye)]
    wp.launch(mark_seen, len(sampled), inputs=inputs, outputs=[seen])
    seen = seen.numpy()
    points, weights = np.zeros((POINTS, 3)), np.zeros(POINTS)
    visible = sampled[seen][:POINTS]
    points[: len(visible)] = visible + rng.normal(scale=NOISE, size=visible.shape)
    weights[: len(visible)] = 1.0 / POINTS
    return points, weights, seen.mean()


class Example(DiffsimExample):
    """The scene, in the format of Newton's examples; a frame is an evaluation of the loss and its gradient.

    Attributes:
        truth: Friction, tri_ke [N/m] and edge_ke [N] of the cloth that is recorded.
        starts: The guesses, shape [worlds, 3].
        found: The best of these in each world so far.
        errors: Relative errors of these after each evaluation, shape [worlds, 3] each.
        points: The recordings [m], shape [frames, worlds, POINTS].
        weights: Weights of their points, 0 where a camera has seen fewer.
        seen: Mean share of the surface that is seen.
    """

    num_frames = 24
    truth = TRUTH

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        world = newton.ModelBuilder()
        along_y = wp.transform(wp.vec3(), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * wp.pi))
        world.add_shape_capsule(-1, xform=along_y, radius=RADIUS, half_height=0.5)
        cell = np.divide(SIDES, CELLS)
        cloth = {"dim_x": CELLS[0], "dim_y": CELLS[1], "cell_x": cell[0], "cell_y": cell[1], "vel": wp.vec3()}
        cloth |= {"tri_ke": TRUTH[1], "tri_ka": TRUTH[1], "tri_kd": 1.0e-2, "edge_ke": TRUTH[2], "edge_kd": 1.0e-4}
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.4)
        corner = wp.quat_rotate(turn, wp.vec3(0.12 - 0.5 * SIDES[0], -0.5 * SIDES[1], RADIUS + 0.01))
        world.add_cloth_grid(pos=corner, rot=turn, mass=DENSITY * cell[0] * cell[1], **cloth)
        model = build_worlds(world, args.worlds)
        for array in (model.tri_materials, model.edge_bending_properties, model.shape_material_mu):
            array.requires_grad = True
        self.friction = wp.zeros(model.particle_count, dtype=float, device=model.device, requires_grad=True)
        self.per_world = world.particle_count, world.tri_count, world.edge_count
        self.faces = model.tri_indices[: world.tri_count]
        self.start_solver(model, (wp.vec3(0.0, -2.2, 0.0), -5.0, 90.0), friction=self.friction)
        self.logarithms = wp.zeros(args.worlds, dtype=wp.vec3, device=model.device, requires_grad=True)
        self.prepare_descent([self.logarithms], STEPS)
        self.record(args.eye, np.random.default_rng(args.seed))
        signs, factors = np.random.default_rng(args.seed + 1).uniform(size=(2, args.worlds, 3))
        self.starts = TRUTH * np.where(signs < 0.5, 2.0 + factors, 1.0 / (2.0 + factors))
        self.errors = []
        self.search_from([np.log(self.starts)], first=1.0, longest=1.5, method=FittedNewton)

    def record(self, eye, rng):
        """Simulates the truth, and records it for each world."""
        self.logarithms.assign(np.tile(np.float32(np.log(TRUTH)), (self.worlds, 1)))
        shape, device = (STEPS // EVERY, self.worlds, POINTS), self.model.device
        self.points, self.weights = wp.zeros(shape, dtype=wp.vec3, device=device), wp.zeros(shape, device=device)
        self.forward()
        frames = self.positions()[EVERY::EVERY].reshape(shape[0] * shape[1], -1, 3)
        recorded = [record(x, self.faces.numpy(), eye, rng) for x in frames]
        points, weights, seen = (np.array(part, dtype=np.float32) for part in zip(*recorded, strict=True))
        self.points.assign(points.reshape(*shape, 3))
        self.weights.assign(weights.reshape(shape))
        self.seen = seen.mean()

    def take_recording(self, example, world):
        """Takes the recording of a world of another example for all worlds."""
        for own, other in ((self.points, example.points), (self.weights, example.weights)):
            own.assign(np.repeat(other.numpy()[:, world : world + 1], self.worlds, axis=1))

    def forward(self):
        """Simulates the cloths, and computes their losses."""
        model = self.model
        inputs = [self.logarithms, *self.per_world]
        outputs = [self.friction, model.shape_material_mu, model.tri_materials, model.edge_bending_properties]
        wp.launch(set_parameters, max(len(array) for array in outputs), inputs=inputs, outputs=outputs)
        super().forward()

    def add_losses(self):
        """Computes the chamfer distances of all frames from all worlds, and the sum of their means."""
        self.losses.zero_()
        for frame, state in enumerate(self.states[EVERY::EVERY]):
            x = state.particle_q.reshape((self.worlds, -1))
            weights = self.weights[frame]
            bsc.chamfer_distance(self.points[frame], x, self.faces, weights=weights, out=self.losses)
        wp.launch(add, self.worlds, inputs=[self.losses], outputs=[self.loss])

    def distances(self):
        """Returns the root of the mean squared distance of the points of each world from its surface [m]."""
        return np.sqrt(self.losses.numpy() / len(self.points))

    def improve(self):
        """Chooses the next parameters, and notes the errors of the best ones."""
        super().improve()
        self.found = np.exp([search.x for search in self.searches])
        self.errors.append(self.found / TRUTH - 1.0)

    def share_within(self, tolerance):
        """Returns the share of worlds in which all parameters are within a tolerance."""
        return (np.abs(self.errors[-1]).max(axis=1) < tolerance).mean()

    def test_final(self):
        """Checks that all worlds have found all parameters within two percent."""
        super().test_final()
        assert self.share_within(0.02) == 1.0, self.errors[-1]

    def print_report(self):
        """Prints what the solver did, and what was found."""
        super().print_report()
        print(f"{self.seen:.0%} of the surface is seen, with noise of {NOISE * 1e3:g} mm")
        for start, found, error in zip(self.starts, self.found, self.errors[-1], strict=True):
            values = zip(NAMES, start, found, error, strict=True)
            print(", ".join(f"{name} {a:.3g} to {b:.4g} ({c:+.1%})" for name, a, b, c in values))
        print(f"{self.share_within(0.02):.0%} of the worlds are within 2% of the truth")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        worlds = 64 if wp.get_preferred_device().is_cuda else 6
        parser.add_argument("--worlds", type=int, default=worlds, help="Guesses, and recordings, at once.")
        parser.add_argument("--eye", type=float, nargs=3, default=EYE, metavar=tuple("XYZ"), help="Camera [m].")
        parser.add_argument("--seed", type=int, default=1, help="Seed of the recordings and of the guesses.")
        return parser


if __name__ == "__main__":
    main(Example)
