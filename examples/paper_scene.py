"""What the five scenes of the paper share: options, a solver that moves what is driven, the loop, and the last test.

A scene is a class ``Example`` that derives from :class:`PaperScene` and says in ``build`` what is there, in ``motion``
how its bodies move, and in ``measure`` and ``test_scene`` what should have come of it.
"""

import argparse
import math

import newton
import newton.examples
import numpy as np
import warp as wp

import warp_bsc as bsc

__all__ = ["PaperScene", "SolverDrivenVBD", "add_cloth", "add_collider", "add_square_cloth", "grid_faces", "lathe"]

FEWEST_TRIANGLES = 1000
RECORDED_FPS = 60
"""Frames a second of a recording: where a scene has more, it is shown in slow motion."""


@wp.kernel(enable_backward=False)
def advance(dt: float, time: wp.array[float]):
    """Advances the clock, which is on the device because a CUDA graph repeats the same launches."""
    time[0] = time[0] + dt


@wp.kernel(enable_backward=False)
def carry(
    carried: wp.array[int],
    rest: wp.array[wp.vec3],
    rest_body_q: wp.array[wp.transform],
    body_q: wp.array[wp.transform],
    particle_q: wp.array[wp.vec3],
):
    """Puts the particles that are fastened to the first body to where it is."""
    particle = carried[wp.tid()]
    local = wp.transform_point(wp.transform_inverse(rest_body_q[0]), rest[particle])
    particle_q[particle] = wp.transform_point(body_q[0], local)


class SolverDrivenVBD(newton.solvers.SolverVBD):
    """VBD that also moves bodies and what is fastened to them, as a part of the step that the stage sees as a whole."""

    def __init__(self, model, motion, motion_inputs, carried, **options):
        """Fastens particles.

        Args:
            model: The model.
            motion: Kernel that writes the poses of all bodies at a time: ``time``, its inputs, ``body_q``; or None.
            motion_inputs: Its inputs.
            carried: Particles that move with the first body, int, shape [n].
            options: As for VBD.
        """
        # it leaves the bodies to others, so that both states keep the poses that they are given
        super().__init__(
            model, particle_enable_self_contact=False, integrate_with_external_rigid_solver=True, **options
        )
        self.motion, self.motion_inputs = motion, motion_inputs
        self.carried = wp.array(carried, dtype=int, device=model.device)
        self.time = wp.zeros(1, dtype=float, device=model.device)

    def step(self, state_in, state_out, control, contacts, dt, **options):
        """Moves what is driven, and steps the rest."""
        device = self.model.device
        wp.launch(advance, 1, inputs=[dt], outputs=[self.time], device=device)
        if self.motion:
            inputs = [self.time, *self.motion_inputs]
            wp.launch(self.motion, 1, inputs=inputs, outputs=[state_out.body_q], device=device)
        if len(self.carried):
            inputs = [self.carried, self.model.particle_q, self.model.body_q, state_out.body_q]
            wp.launch(carry, len(self.carried), inputs=inputs, outputs=[state_in.particle_q], device=device)
        super().step(state_in, state_out, control, contacts, dt, **options)


class PaperScene:
    """A scene, in the format of Newton's examples.

    Attributes:
        triangles: Default of ``--triangles``.
        frames: Default of ``--num-frames``.
        fps: Frames a second.
        sim_substeps: Steps a frame of a mesh as large as the default, see :meth:`count_substeps`.
        iterations: Of VBD.
        gravity: Acceleration [m/s^2].
        camera: Position [m], pitch and yaw [degrees].
        motion: Kernel that moves the bodies, see :class:`SolverDrivenVBD`.
        motion_inputs: What it takes.
        carried: Particles that move with the first body.
    """

    triangles = 5000
    frames = 120
    fps = 60
    sim_substeps = 4
    iterations = 10
    gravity = (0.0, 0.0, -9.81)
    camera = (wp.vec3(1.6, -1.6, 1.0), -20.0, 135.0)
    motion = None
    motion_inputs = ()
    carried = ()

    def __init__(self, viewer, args):
        if args.triangles < FEWEST_TRIANGLES:
            raise ValueError(f"--triangles must be at least {FEWEST_TRIANGLES}, not {args.triangles}")
        self.viewer = viewer
        self.ccd = args.ccd
        self.frame_dt = 1.0 / self.fps
        self.sim_substeps = self.count_substeps(args.triangles)
        self.sim_dt = self.frame_dt / self.sim_substeps
        self.sim_time = 0.0
        self.frame = 0
        self.graph = None

        builder = newton.ModelBuilder(gravity=self.gravity)
        self.build(builder, args.triangles)
        for particle in self.carried:
            builder.particle_flags[particle] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        self.model = builder.finalize()
        self.solver = SolverDrivenVBD(
            self.model, self.motion, self.motion_inputs, self.carried, iterations=self.iterations
        )
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.state_0, self.state_1 = self.model.state(), self.model.state()
        self.control = self.model.control()
        self.saved_state, self.saved_time = self.model.state(), wp.clone(self.solver.time)
        self.taken_back = 0

        self.viewer.set_model(self.model)
        position, pitch, yaw = self.camera
        self.viewer.set_camera(pos=position, pitch=pitch, yaw=yaw)

    def count_substeps(self, triangles):
        """Steps a frame of a mesh of about so many triangles; even, so that a CUDA graph ends where it began.

        The solver carries forces over so many cells a step: where these are smaller, steps are shorter in proportion.
        Cloth would else be stretched by its weight.
        """
        finer = max(math.sqrt(triangles / self.triangles), 1.0)
        return 2 * math.ceil(0.5 * self.sim_substeps * finer)

    def build(self, builder, triangles):
        """Adds what there is, of about so many triangles."""
        raise NotImplementedError

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, on a GPU from a graph.

        In a graph the stage's queues cannot grow. Where they were too small, the frame is simulated again without,
        which makes them larger, and captured anew.
        """
        if not self.launch_graph():
            self.simulate()
            self.capture()
        self.frame += 1
        self.sim_time += self.frame_dt

    def capture(self):
        """Captures a frame on a GPU."""
        self.graph = None
        if self.model.device.is_cuda:
            with wp.ScopedCapture() as capture:
                self.simulate()
            self.graph = capture.graph

    def launch_graph(self):
        """Simulates a frame from the graph; returns whether there is one, and all of its steps are certified."""
        if self.graph is None:
            return False
        self.saved_state.assign(self.state_0)
        wp.copy(self.saved_time, self.solver.time)
        uncertified = self.count_uncertified()
        wp.capture_launch(self.graph)
        uncertified = self.count_uncertified() - uncertified
        if uncertified == 0:
            return True
        self.state_0.assign(self.saved_state)
        wp.copy(self.solver.time, self.saved_time)
        self.taken_back += uncertified
        return False

    def count_uncertified(self):
        """Steps that were not certified, those that were taken back included."""
        return self.solver.report.uncertified_steps if self.ccd else 0

    def render(self):
        """Shows the frame."""
        self.viewer.begin_frame(self.frame / RECORDED_FPS)
        self.viewer.log_state(self.state_0)
        self.viewer.end_frame()

    def positions(self):
        """Positions of the particles now [m], float64, shape [n, 3]."""
        return self.state_0.particle_q.numpy().astype(np.float64)

    def find_intersections(self):
        """Edges and faces of what deforms that cross now."""
        mesh = bsc.CollisionMesh(self.model.tri_indices.numpy(), self.model.particle_count, device=self.model.device)
        return bsc.CollisionDetector(mesh).find_intersections(self.state_0.particle_q)

    def measure(self):
        """What has come of the scene, a number for each name."""
        raise NotImplementedError

    def test_scene(self, measured):
        """The scene is what it is called."""
        raise NotImplementedError

    def test_final(self):
        """The scene is what it is called, and the stage kept its promise."""
        if self.ccd:
            report = self.solver.report
            uncertified = self.count_uncertified() - self.taken_back
            assert uncertified == 0, f"{uncertified} steps are not certified"
            assert len(report.intersections) == 0, f"{len(report.intersections)} edges cross faces"
        assert np.isfinite(self.positions()).all(), "positions are not finite"
        intersections = self.find_intersections()
        assert len(intersections) == 0, f"{len(intersections)} edges of what deforms cross faces of it"
        self.test_scene(self.measure())

    def print_report(self):
        """Prints what the stage did, and what came of it."""
        print(f"{self.model.tri_count} triangles, {self.frame} frames of {self.sim_substeps} steps")
        if self.ccd:
            print(f"{self.solver.report}, {self.taken_back} of which were taken back")
        for name, value in self.measure().items():
            print(f"{name}: {value:.3f}")

    @classmethod
    def create_parser(cls):
        """The options."""
        parser = newton.examples.create_parser()
        parser.set_defaults(num_frames=cls.frames)
        parser.add_argument("--triangles", type=int, default=cls.triangles, help="About how many triangles.")
        parser.add_argument(
            "--ccd", action=argparse.BooleanOptionalAction, default=True, help="Put the collision stage behind it."
        )
        return parser


def add_collider(builder, body, vertices, faces, friction):
    """Adds a rigid mesh, which recordings contain as the triangles that they are.

    Args:
        builder: The builder.
        body: The body that it moves with, -1 for none.
        vertices: Positions [m], shape [n, 3].
        faces: Shape [m, 3].
        friction: Coefficient.
    """
    mesh = newton.Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int32).ravel(), compute_inertia=False)
    config = newton.ModelBuilder.ShapeConfig(density=0.0, mu=friction)
    builder.add_shape_mesh(body, mesh=mesh, cfg=config)


def add_square_cloth(builder, triangles, size, height):
    """Adds a square of cloth, flat, with its middle on the z axis.

    Args:
        builder: The builder.
        triangles: About how many.
        size: Of a side [m].
        height: Where it is [m].

    Returns:
        Cells along a side; rows of particles follow each other.
    """
    cells = max(round(math.sqrt(0.5 * triangles)), 8)
    side = size * (np.arange(cells + 1) / cells - 0.5)
    x, y = np.meshgrid(side, side)
    add_cloth(builder, np.stack([x, y, np.full_like(x, height)], axis=-1), grid_faces(cells + 1, cells + 1))
    return cells


def add_cloth(builder, vertices, faces, *, bending=1.0e-4):
    """Adds cloth.

    Args:
        builder: The builder.
        vertices: Positions at rest [m], shape [..., 3].
        faces: Shape [n, 3].
        bending: Stiffness of the edges against it [J].
    """
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=vertices.reshape(-1, 3),
        indices=faces.ravel(),
        density=0.2,
        tri_ke=1.0e3,
        tri_ka=1.0e3,
        tri_kd=1.0e-2,
        edge_ke=bending,
        edge_kd=1.0e-3,
        particle_radius=0.002,
    )


def grid_faces(rows, columns, *, around=False):
    """Faces of a grid of vertices, row after row, each cell cut along alternating diagonals.

    Args:
        rows: Vertices in a column.
        columns: Vertices in a row.
        around: Whether rows are closed.

    Returns:
        Shape [n, 3].
    """
    vertex = np.arange(rows * columns).reshape(rows, columns)
    if around:
        vertex = np.concatenate([vertex, vertex[:, :1]], axis=1)
    a, b, c, d = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, 1:], vertex[1:, :-1]
    odd = (np.indices(a.shape).sum(axis=0) % 2 == 1)[..., None]
    first = np.where(odd, np.stack([a, b, d], axis=-1), np.stack([a, b, c], axis=-1))
    second = np.where(odd, np.stack([b, c, d], axis=-1), np.stack([a, c, d], axis=-1))
    return np.stack([first, second], axis=2).reshape(-1, 3)


def lathe(profile, segments):
    """Turns a profile around the z axis.

    Args:
        profile: Radius and height [m] from bottom to top, the first and last radius 0 where the surface is closed,
            shape [n, 2].
        segments: Vertices around.

    Returns:
        Positions [m], shape [m, 3], and faces, shape [k, 3], without triangles of no area.
    """
    profile = np.asarray(profile, dtype=float)
    angle = 2.0 * np.pi / segments * np.arange(segments)
    circle = np.stack([np.cos(angle), np.sin(angle), np.ones(segments)], axis=1)
    positions, vertex = np.unique(
        (circle * profile[:, None][:, :, [0, 0, 1]]).reshape(-1, 3), axis=0, return_inverse=True
    )
    faces = vertex.reshape(-1)[grid_faces(len(profile), segments, around=True)]
    a, b, c = faces.T
    return positions, faces[(a != b) & (b != c) & (c != a)]
