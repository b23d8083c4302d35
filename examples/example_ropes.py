"""Example Ropes: ropes fall into a heap on the ground, where each keeps its thickness.

    python examples/example_ropes.py
    python examples/example_ropes.py --no-ccd  # the ropes fall through the ground and through each other

A rope is a row of particles that springs join. It has no faces: the collision stage keeps the springs of different
ropes, and those of one, apart by the radii of their particles.
"""

import newton
import newton.examples
import numpy as np
import warp as wp
from common import ExampleBase, main

import warp_bsc as bsc

ROPES = 12
PARTICLES = 30  # of a rope
LENGTH = 0.02  # m, of a spring
RADIUS = 0.004  # m, of a rope


class Example(ExampleBase):
    """The scene, in the format of Newton's examples."""

    num_frames = 120
    sim_substeps = 8

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        builder = newton.ModelBuilder()
        builder.add_ground_plane()
        rng = np.random.default_rng(1)
        along = LENGTH * (np.arange(PARTICLES) - 0.5 * (PARTICLES - 1))
        for rope in range(ROPES):
            angle, (x, y), height = rng.uniform(0.0, np.pi), rng.uniform(-0.06, 0.06, size=2), 0.03 * (rope + 1)
            first = builder.particle_count
            for s in along:
                at = wp.vec3(x + s * np.cos(angle), y + s * np.sin(angle), height + 0.1 * RADIUS * np.sin(s / LENGTH))
                builder.add_particle(at, wp.vec3(), 0.002, radius=RADIUS)
            for i in range(first, builder.particle_count - 1):
                builder.add_spring(i, i + 1, 1.0e4, 0.01, 0.0)
        model = builder.finalize()

        solver = newton.solvers.SolverXPBD(model, iterations=8)
        camera = wp.vec3(0.7, -0.7, 0.4), -20.0, 135.0
        self.start(model, solver, camera, particle_radius=model.particle_radius, friction=0.4)

    def distance(self):
        """Returns the least distance between springs that no other spring joins, up to 4 radii [m]."""
        springs = self.model.spring_indices.numpy().reshape(-1, 2)
        mesh = bsc.CollisionMesh([], self.model.particle_count, edges=springs, device=self.model.device)
        near = bsc.CollisionDetector(mesh).find_proximities(self.state_0.particle_q, 4.0 * RADIUS)
        return float(near.distance.min(initial=4.0 * RADIUS))

    def test_final(self):
        """Checks that all steps are certified, that no ropes overlap, and that the ground holds them."""
        super().test_final()
        distance, height = self.distance(), float(self.state_0.particle_q.numpy()[:, 2].min())
        assert distance >= 2.0 * RADIUS, f"ropes come as near as {distance:.5f} m"
        assert height >= RADIUS, f"a rope is at a height of {height:.5f} m"


if __name__ == "__main__":
    main(Example)
