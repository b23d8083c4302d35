"""The worlds of the particles of a model: systems of equations that are independent of each other."""

import newton
import numpy as np
import warp as wp


class Worlds:
    """Worlds as rows of results and as independent systems of a linear solve.

    Attributes:
        count: Number of worlds that have particles. Particles of no world count as one.
        ids: The worlds, in the order of their particles, -1 for particles of no world, int32, shape [count].
        of_particles: Row of the world of each particle, int32, shape [particle_count].
        offsets: First particle of each world, and the end of the last, int32, shape [count + 1].
    """

    def __init__(self, model: newton.Model):
        """Finds the worlds of a model with particles.

        Raises:
            NotImplementedError: If the particles of a world do not follow each other.
        """
        assert model.particle_world is not None
        world = model.particle_world.numpy()
        starts = np.flatnonzero(np.diff(world, prepend=world[0] - 1))
        self.ids, self.count = world[starts], len(starts)
        if len(np.unique(self.ids)) < self.count:
            raise NotImplementedError("solver: particles of a world must follow each other in the model")
        ends = np.append(starts[1:], len(world))
        rows = np.repeat(np.arange(self.count, dtype=np.int32), ends - starts)
        self.of_particles = wp.array(rows, dtype=int, device=model.device)
        offsets = np.append(starts, len(world)).astype(np.int32)
        self.offsets = wp.array(offsets, dtype=int, device=model.device)
