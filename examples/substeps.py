"""Measures how far cloth and soft bodies stretch between the inner solver and the contacts, by the substeps of both.

    python examples/substeps.py
    python examples/substeps.py --scenes blocks --substeps 4

Three scenes in which contact works against elasticity: a cloth drapes over a sphere; a cylinder moves into a sleeve a
third narrower than itself; two plates press two soft blocks to half their height. The first row of each scene is the
stage without substeps at a small step, the reference. The second has twice that step, and shows how far the reference
can be trusted. The others have larger steps: without substeps, with a number of substeps, and with one that the stage
chooses. Distances are root mean squares.
"""

import argparse
import sys
import time

import newton
import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

import warp_bsc as bsc
from warp_bsc.bench.provenance import write_measurement

REFERENCE = 1.0 / 1920.0
"""Length of the reference's step [s]."""
STEPS = (1.0 / 240.0, 1.0 / 60.0)
"""Lengths of the other steps [s]."""
CLOTH = {"tri_ke": 2e2, "tri_ka": 2e2, "tri_kd": 1e-3, "edge_ke": 1e-3, "edge_kd": 1e-4, "particle_radius": 0.005}


class Scene:
    """A scene: what it measures at the end, and how bodies move.

    Attributes:
        duration: Simulated time [s].
        iterations: Iterations of VBD in a step.
        friction: Coefficient.
        measures: Names of what :meth:`measure` returns.
    """

    friction = 0.5
    iterations = 20
    measures = ("largest stretch [%]",)

    def build(self, builder):
        """Adds shapes and particles to a builder."""
        raise NotImplementedError

    def pose(self, t):
        """Returns positions of the bodies at a time [m], shape [bodies, 3]."""
        return np.zeros((0, 3))

    def measure(self, run):
        """Returns the quantities named by ``measures``."""
        return (100.0 * run.stretch(),)


class Drape(Scene):
    """A cloth of 0.8 m drapes over a fixed sphere."""

    duration = 0.8

    def build(self, builder):
        """Adds the sphere and the cloth."""
        config = newton.ModelBuilder.ShapeConfig(mu=self.friction)
        builder.add_shape_sphere(body=-1, radius=0.2, cfg=config)
        cells = {"dim_x": 24, "dim_y": 24, "cell_x": 0.8 / 24, "cell_y": 0.8 / 24, "mass": 0.0005}
        at = wp.vec3(-0.4, -0.4, 0.23)
        builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(), **cells, **CLOTH)


class Sleeve(Scene):
    """A cylinder with a conical tip moves into a sleeve that is held at its mouth, and a third narrower than it."""

    duration = 0.4
    friction = 0.1
    radius, sleeve_radius, length = 0.06, 0.04, 0.2  # m
    around, along = 24, 20  # cells

    def build(self, builder):
        """Adds the cylinder and the sleeve, which is widened at its mouth."""
        profile = [(0.0, 0.6), (0.5 * self.radius, 0.6), (self.radius, 0.5), (self.radius, 0.0), (0.0, 0.0)]
        angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        points = [[r * np.cos(a), r * np.sin(a), z] for r, z in profile for a in angles]
        n = len(angles)
        faces = []
        for ring in range(len(profile) - 1):
            for i in range(n):
                a, b = ring * n + i, ring * n + (i + 1) % n
                faces += [[a, a + n, b], [b, a + n, b + n]]
        corners = np.array(points)[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        faces = np.array(faces)[np.linalg.norm(normals, axis=1) > 0.0]  # not those at the centres of both ends
        body = builder.add_body(is_kinematic=True)
        config = newton.ModelBuilder.ShapeConfig(mu=self.friction)
        builder.add_shape_mesh(body, mesh=newton.Mesh(np.array(points), faces.ravel()), cfg=config)
        rest, start = [], []
        for j in range(self.along + 1):
            z = self.length * j / self.along
            wide = self.sleeve_radius + (1.05 * self.radius - self.sleeve_radius) * max(0.0, 1.0 - z / 0.08)
            for angle in 2.0 * np.pi * np.arange(self.around) / self.around:
                direction = np.array([np.cos(angle), np.sin(angle), 0.0])
                rest.append(self.sleeve_radius * direction + [0.0, 0.0, z])
                start.append(wide * direction + [0.0, 0.0, z])
        faces = []
        for j in range(self.along):
            for i in range(self.around):
                a, b = j * self.around + i, j * self.around + (i + 1) % self.around
                faces += [[a, b, a + self.around], [b, b + self.around, a + self.around]]
        first = builder.particle_count
        vertices = [wp.vec3(*x) for x in rest]
        options = {"pos": wp.vec3(), "rot": wp.quat_identity(), "scale": 1.0, "vel": wp.vec3(), "density": 0.3}
        builder.add_cloth_mesh(vertices=vertices, indices=np.ravel(faces).tolist(), **options, **CLOTH)
        for i, x in enumerate(start):
            builder.particle_q[first + i] = wp.vec3(*x)
        for i in range(self.around):  # the mouth
            builder.particle_mass[first + i] = 0.0
        self.rest = np.array(rest)

    def pose(self, t):
        """Returns the position of the cylinder."""
        way = 0.15 * min(t / 0.3, 1.0)
        return np.array([[0.0, 0.0, way - 0.59]])


class Blocks(Scene):
    """Two plates press two soft blocks, one on the other, to half their height."""

    duration = 0.44  # later, the blocks slip out from between the plates
    friction = 0.5
    iterations = 10
    measures = ("largest stretch [%]", "stress on the lower plate [Pa]")
    cells, cell, gap = 4, 0.05, 0.002  # m

    def build(self, builder):
        """Adds the plates and the blocks."""
        self.height = 2 * self.cells * self.cell
        for z in self.pose(0.0)[:, 2]:
            pose = wp.transform(wp.vec3(0.0, 0.0, z), wp.quat_identity())
            body = builder.add_body(xform=pose, is_kinematic=True)
            builder.add_shape_box(body, hx=0.3, hy=0.3, hz=0.02)
        for z in (self.gap, 0.5 * self.height + 2 * self.gap):
            side = -0.5 * self.cells * self.cell
            sizes = dict.fromkeys(("dim_x", "dim_y", "dim_z"), self.cells)
            sizes |= dict.fromkeys(("cell_x", "cell_y", "cell_z"), self.cell)
            material = {"density": 100.0, "k_mu": 1e4, "k_lambda": 1e4, "k_damp": 20.0, "particle_radius": 0.002}
            builder.add_soft_grid(
                pos=wp.vec3(side, side, z), rot=wp.quat_identity(), vel=wp.vec3(), **sizes, **material
            )

    def pose(self, t):
        """Returns the positions of the plates."""
        opening = 2 * self.cells * self.cell + 3 * self.gap
        s = min(t / 0.4, 1.0)
        way = 0.5 * s * s * (3.0 - 2.0 * s) * (opening - self.cells * self.cell)
        return np.array([[0.0, 0.0, way - 0.02], [0.0, 0.0, opening - way + 0.02]])

    def measure(self, run):
        """Returns the stretch, and the stress from the elastic forces of the particles on the lower plate."""
        z = run.positions()[:, 2]
        lowest = np.arange(len(z)) < len(z) // 2
        lowest &= run.model.particle_q.numpy()[:, 2] < self.gap + 0.1 * self.cell
        area = (self.cells * self.cell) ** 2
        return 100.0 * run.stretch(), -run.elastic_forces()[lowest, 2].sum() / area


SCENES = {"drape": Drape, "sleeve": Sleeve, "blocks": Blocks}


class Run:
    """A simulation of a scene."""

    def __init__(self, scene, dt, substeps):
        self.scene, self.dt = scene, dt
        builder = newton.ModelBuilder()
        scene.build(builder)
        builder.color()
        self.model = model = builder.finalize()
        self.inner = newton.solvers.SolverVBD(
            model, iterations=scene.iterations, integrate_with_external_rigid_solver=model.body_count > 0
        )
        self.solver = bsc.SolverCCD(self.inner, friction=scene.friction, substeps=substeps)
        self.states, self.control = [model.state(), model.state()], model.control()
        rest = getattr(scene, "rest", model.particle_q.numpy())
        corners = model.tri_indices.numpy()
        if model.tet_count:
            tets = model.tet_indices.numpy()
            corners = np.concatenate([tets[:, [0, 1, 2]], tets[:, [0, 1, 3]], tets[:, [1, 2, 3]], tets[:, [2, 0, 3]]])
        edges = np.unique(np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        self.edges = edges[(model.particle_mass.numpy()[edges] > 0.0).all(axis=1)]  # without those that are held
        self.lengths = self.edge_lengths(rest)
        self.largest, self.substeps, self.seconds = [], [], 0.0

    def edge_lengths(self, x):
        """Returns the lengths of the edges between movable particles [m]."""
        return np.linalg.norm(x[self.edges[:, 0]] - x[self.edges[:, 1]], axis=1)

    def positions(self):
        """Returns the positions of particles [m]."""
        return self.states[0].particle_q.numpy().astype(np.float64)

    def stretch(self):
        """Returns the largest stretch of an edge, averaged over the last tenth of a second."""
        return float(np.mean(self.largest[-max(1, round(0.1 / self.dt)) :]))

    def place_bodies(self, state, t):
        """Writes the poses of bodies at a time to a state."""
        if self.model.body_count:
            pose = np.zeros((self.model.body_count, 7), dtype=np.float32)
            pose[:, :3], pose[:, 6] = self.scene.pose(t), 1.0
            state.body_q.assign(pose)

    def simulate(self):
        """Steps to the end."""
        self.place_bodies(self.states[0], 0.0)
        begin = time.perf_counter()
        for step in range(round(self.scene.duration / self.dt)):
            start, end = self.states
            start.clear_forces()
            self.place_bodies(end, (step + 1) * self.dt)
            self.solver.step(start, end, self.control, None, self.dt)
            self.states = [end, start]
            self.largest.append((self.edge_lengths(self.positions()) / self.lengths).max() - 1.0)
            self.substeps.append(self.solver.report.substeps)
        self.seconds = time.perf_counter() - begin
        return self

    def elastic_forces(self):
        """Returns the elastic forces on particles [N], from a short step of the inner solver from rest."""
        start, end, dt = self.model.state(), self.model.state(), 1e-4
        start.assign(self.states[0])
        start.particle_qd.zero_()
        gravity = self.model.gravity.numpy()
        self.model.gravity.zero_()
        before = start.particle_q.numpy().astype(np.float64)
        self.inner.step(start, end, self.control, None, dt)
        self.model.gravity.assign(gravity)
        mass = self.model.particle_mass.numpy()[:, None].astype(np.float64)
        return mass * (end.particle_q.numpy() - before) / dt**2


def main():
    """Prints a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES), help="scenes (default: all)")
    parser.add_argument("--substeps", type=int, default=4, help="substeps at 1/240 s; four times as many at 1/60 s")
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    parser.add_argument("--json", metavar="FILE", help="file to which the results are written as well")
    options = parser.parse_args()
    found = []
    wp.config.log_level = wp.LOG_WARNING
    with wp.ScopedDevice(options.device or wp.get_preferred_device()):
        for name in options.scenes:
            scene = SCENES[name]()
            columns = "substeps a step", "distance [mm]", "uncertified", "time [s]"
            table = Table("step", "substeps", *scene.measures, *columns, title=type(scene).__doc__)
            rows = [(REFERENCE, None), (2.0 * REFERENCE, None)]
            for dt in STEPS:
                rows += [(dt, None), (dt, round(options.substeps * dt / STEPS[0])), (dt, "auto")]
            reference = None
            for dt, substeps in rows:
                run = Run(scene, dt, substeps).simulate()
                reference = run.positions() if reference is None else reference
                distance = 1e3 * np.sqrt(((run.positions() - reference) ** 2).sum(axis=1).mean())
                measured = [float(value) for value in (*scene.measure(run), np.mean(run.substeps), distance)]
                uncertified = run.solver.report.totals.uncertified_steps
                rate, values = round(1.0 / dt), [f"{value:.3g}" for value in measured]
                table.add_row(f"1/{rate}", str(substeps or "-"), *values, str(uncertified), f"{run.seconds:.1f}")
                names = (*scene.measures, *columns)
                row = dict(zip(names, (*measured, uncertified, run.seconds), strict=True))
                found.append({"scene": name, "rate": rate, "substeps": substeps, "measured": row})
            Console().print(table)
    if options.json:
        device = wp.get_device(options.device or wp.get_preferred_device())
        write_measurement(options.json, {"benchmark": "substeps", "runs": found}, sys.argv, [device])


if __name__ == "__main__":
    main()
