"""Base of the five scenes of the paper: options, a solver that moves bodies, checks, and parts to build scenes from.

A scene is a class ``Example`` that derives from :class:`PaperScene`: ``build`` adds its parts, ``motion`` moves its
bodies, ``measure`` and ``test_scene`` check its final state.
"""

import math
import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp

sys.path.append(str(Path(__file__).parents[1]))  # for common.py, whichever script of this folder runs
from common import ExampleBase, main

__all__ = [
    "PaperScene",
    "SolverDrivenVBD",
    "add_cloth",
    "add_collider",
    "add_square_cloth",
    "grid_faces",
    "lathe",
    "main",
]

MIN_TRIANGLES, MAX_TRIANGLES = 1000, 20_000_000
RECORDED_FPS = 60
"""Frames per second of a recording; a scene that has more is shown in slow motion."""


@wp.kernel(enable_backward=False)
def advance(
    # in
    dt: float,
    # in and out
    time: wp.array[float],
):
    """Advances the clock, which is on the device because a CUDA graph repeats the same launches."""
    time[0] = time[0] + dt


@wp.kernel(enable_backward=False)
def carry(
    # in
    carried: wp.array[int],
    rest: wp.array[wp.vec3],
    rest_body_q: wp.array[wp.transform],
    body_q: wp.array[wp.transform],
    # out
    particle_q: wp.array[wp.vec3],
):
    """Moves the particles that are fastened to the first body with it."""
    particle = carried[wp.tid()]
    local = wp.transform_point(wp.transform_inverse(rest_body_q[0]), rest[particle])
    particle_q[particle] = wp.transform_point(body_q[0], local)


class SolverDrivenVBD(newton.solvers.SolverVBD):
    """VBD that also moves bodies and particles fastened to them, so that the stage detects their collisions, too."""

    def __init__(self, model, motion, motion_inputs, carried, **options):
        """Fastens particles to the first body.

        Args:
            model: The model.
            motion: Kernel that writes the poses of all bodies at a time: ``time``, its inputs, ``body_q``; or None.
            motion_inputs: Inputs of the kernel.
            carried: Particles that move with the first body, int, shape [n].
            options: As for VBD.
        """
        # VBD itself does not move the bodies: both states keep the poses that ``motion`` writes
        super().__init__(
            model, particle_enable_self_contact=False, integrate_with_external_rigid_solver=True, **options
        )
        self.motion, self.motion_inputs = motion, motion_inputs
        self.carried = wp.array(carried, dtype=int, device=model.device)
        self.time = wp.zeros(1, dtype=float, device=model.device)

    def step(self, state_in, state_out, control, contacts, dt, **options):
        """Moves the bodies and the particles fastened to them, and steps the others."""
        device = self.model.device
        wp.launch(advance, 1, inputs=[dt], outputs=[self.time], device=device)
        if self.motion:
            inputs = [self.time, *self.motion_inputs]
            wp.launch(self.motion, 1, inputs=inputs, outputs=[state_out.body_q], device=device)
        if len(self.carried):
            inputs = [self.carried, self.model.particle_q, self.model.body_q, state_out.body_q]
            wp.launch(carry, len(self.carried), inputs=inputs, outputs=[state_in.particle_q], device=device)
        super().step(state_in, state_out, control, contacts, dt, **options)


class PaperScene(ExampleBase):
    """A scene of the paper, in the format of Newton's examples.

    Attributes:
        triangles: Default of ``--triangles``.
        sim_substeps: Steps per frame at the default number of triangles, see :meth:`count_substeps`.
        iterations: Iterations of VBD.
        gravity: Acceleration [m/s^2].
        camera: Position [m], pitch and yaw [degrees].
        motion: Kernel that moves the bodies, see :class:`SolverDrivenVBD`.
        motion_inputs: Inputs of the kernel.
        carried: Particles that move with the first body.
    """

    triangles = 5000
    num_frames = 120
    iterations = 10
    gravity = (0.0, 0.0, -9.81)
    camera = (wp.vec3(1.6, -1.6, 1.0), -20.0, 135.0)
    motion = None
    motion_inputs = ()
    carried = ()

    def __init__(self, viewer, args):
        if not MIN_TRIANGLES <= args.triangles <= MAX_TRIANGLES:
            raise ValueError(f"--triangles must be in [{MIN_TRIANGLES}, {MAX_TRIANGLES}], not {args.triangles}")
        self.frame_dt = 1.0 / self.fps
        self.sim_substeps = self.count_substeps(args.triangles)
        super().__init__(viewer, args)

        builder = newton.ModelBuilder(gravity=self.gravity)
        self.build(builder, args.triangles)
        for particle in self.carried:
            builder.particle_flags[particle] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color()
        model = builder.finalize()
        solver = SolverDrivenVBD(model, self.motion, self.motion_inputs, self.carried, iterations=self.iterations)
        # as recorded: the steps of a frame are many, and each is resolved as a whole
        self.start(model, solver, self.camera)

    def count_substeps(self, triangles):
        """Returns the steps per frame of a mesh of about ``triangles`` triangles, an even number.

        The solver carries forces over a fixed number of cells per step, so that smaller cells need shorter steps:
        otherwise cloth stretches under its weight.
        """
        finer = max(math.sqrt(triangles / self.triangles), 1.0)
        return 2 * math.ceil(0.5 * self.sim_substeps * finer)

    def build(self, builder, triangles):
        """Adds the parts of the scene, whose deforming meshes have about ``triangles`` triangles."""
        raise NotImplementedError

    def render(self):
        """Shows the frame."""
        self.viewer.begin_frame(self.frame / RECORDED_FPS)
        self.viewer.log_state(self.state_0)
        self.draw_contacts()
        self.viewer.end_frame()

    def positions(self):
        """Returns the positions of the particles [m], float64, shape [n, 3]."""
        return self.state_0.particle_q.numpy().astype(np.float64)

    def measure(self):
        """Returns measured quantities of the scene by name."""
        raise NotImplementedError

    def test_scene(self, measured):
        """Checks the measured quantities of the scene."""
        raise NotImplementedError

    def test_final(self):
        """Checks that all steps are certified, nothing intersects, and the measured quantities are as expected."""
        super().test_final()
        assert np.isfinite(self.positions()).all(), "positions are not finite"
        intersections = self.find_intersections()
        assert len(intersections) == 0, f"{len(intersections)} edges of deforming meshes cross their faces"
        self.test_scene(self.measure())

    def print_report(self):
        """Prints the report of the stage and the measured quantities of the scene."""
        print(f"{self.model.tri_count} triangles, {self.frame} frames of {self.sim_substeps} steps")
        super().print_report()
        for name, value in self.measure().items():
            print(f"{name}: {value:.3f}")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        parser.add_argument("--triangles", type=int, default=cls.triangles, help="Approximate number of triangles.")
        return parser


def add_collider(builder, body, vertices, faces, friction):
    """Adds a rigid mesh; recordings contain its triangles as they are.

    Args:
        builder: The builder.
        body: Body that the mesh moves with, -1 for none.
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
        size: Length of a side [m].
        height: Height of the cloth [m].

    Returns:
        Number of cells along a side. Particles are stored row by row.
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
        bending: Bending stiffness of the edges [J].
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
    """Returns the faces of a grid of vertices stored row by row, its cells cut along alternating diagonals.

    Args:
        rows: Vertices in a column.
        columns: Vertices in a row.
        around: Whether the last vertex of a row is joined to its first.

    Returns:
        Vertices of the faces, shape [n, 3].
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
    """Returns the surface of revolution of a profile about the z axis.

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
