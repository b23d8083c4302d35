"""Bases of the examples with gradients: gradient descent from several starts; cloth that is to end on a mark."""

import itertools

import newton
import numpy as np
import warp as wp
import warp.optim
from common import ExampleBase

RADIUS = 0.3  # distance from the mark at which the loss grows fastest [m]
RATE_DECAY = 0.94  # factor of the learning rate per iteration


@wp.kernel
def add_to_centre(
    particle_q: wp.array[wp.vec3], shares: wp.array[float], particle_world: wp.array[int], centres: wp.array[wp.vec3]
):
    """Adds a particle's share to the centre of the cloth of its world."""
    particle = wp.tid()
    wp.atomic_add(centres, particle_world[particle], shares[particle] * particle_q[particle])


@wp.kernel
def add_loss(centres: wp.array[wp.vec3], mark: wp.vec3, radius: float, losses: wp.array[float], loss: wp.array[float]):
    """Computes the loss of each world, 0 on the mark and 1 far from it, and adds it to the total."""
    world = wp.tid()
    value = 1.0 - wp.exp(-0.5 * wp.length_sq(centres[world] - mark) / (radius * radius))
    losses[world] = value
    wp.atomic_add(loss, 0, value)


def add_cloth(builder, cells, cell, centre, axis, angle, **options):
    """Adds a square of cloth with ``cells`` cells of width ``cell`` [m] along each side, turned about an axis."""
    rotation = wp.quat_from_axis_angle(wp.normalize(axis), angle)
    side = cells * cell
    cloth = {"dim_x": cells, "dim_y": cells, "cell_x": cell, "cell_y": cell, "mass": 0.001, "vel": wp.vec3()}
    cloth |= {"tri_ke": 50.0, "tri_ka": 50.0, "tri_kd": 5.0e-2, "edge_ke": 1.0e-2, "edge_kd": 1.0e-3}
    corner = centre + wp.quat_rotate(rotation, wp.vec3(-0.5 * side, -0.5 * side, 0.0))
    builder.add_cloth_grid(pos=corner, rot=rotation, **cloth | options)


def build_worlds(world, count):
    """Returns a model of this many copies of a world, with gradients."""
    builder = newton.ModelBuilder()
    builder.replicate(world, count)
    model = builder.finalize(requires_grad=True)
    # the solver's own contacts between particles are penalties, and not needed here
    model.particle_ke = model.particle_kd = model.particle_kf = 0.0
    model.particle_grid = None
    return model


class DiffsimExample(ExampleBase):
    """Gradient descent in several worlds at once, in the format of Newton's examples; a frame is an iteration.

    A derived class calls :meth:`start` and :meth:`prepare_descent` at the end of its ``__init__``, and makes its
    ``forward`` depend on the parameters. It adds the losses of all worlds in ``add_losses``, and says in ``distances``
    how far from their marks they ended.

    Attributes:
        loss_history: The losses of all worlds in each iteration so far.
        distance: Least distance from the mark so far, at which each world ended [m].
        motion: Positions of particles in that iteration [m], shape [steps + 1, worlds, particles, 3].
    """

    def prepare_descent(self, parameters, rate, steps):
        """Prepares gradient descent.

        Args:
            parameters: The arrays to improve, an element for each world.
            rate: Learning rate of the first iteration; None if ``improve`` is not that of Adam.
            steps: How many steps a simulation has.
        """
        model, device = self.model, self.model.device
        self.parameters, self.rate = parameters, rate
        self.states = [self.state_0, *(model.state() for _ in range(steps - 1)), self.state_1]
        self.worlds = model.world_count
        self.losses = wp.zeros(self.worlds, dtype=float, device=device, requires_grad=True)
        self.loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        if rate is not None:
            self.optimizer = warp.optim.Adam(parameters, lr=rate)
        self.tape = None
        self.loss_history = []
        self.distance = np.full(self.worlds, np.inf)
        self.motion = self.positions()

    def forward(self):
        """Simulates all worlds, and computes their losses."""
        for start, end in itertools.pairwise(self.states):
            start.clear_forces()
            self.solver.step(start, end, self.control, None, self.sim_dt)
        self.loss.zero_()
        self.add_losses()

    def simulate(self):
        """Simulates all worlds, and computes the gradient of their loss."""
        self.former, self.tape = self.tape, wp.Tape()
        if self.former is not None:  # it stays, as a CUDA graph of this function clears its gradients again
            self.former.zero()  # of the last iteration; or NaN, of a graph whose buffers were too small
        with self.tape:
            self.forward()
        self.tape.backward(self.loss)

    def step(self):
        """Computes the gradient, on a GPU from a CUDA graph, and improves the parameters."""
        super().step()
        self.loss_history.append(self.losses.numpy().copy())
        distance = self.distances()
        nearer = distance < self.distance
        self.distance[nearer] = distance[nearer]
        self.motion[:, nearer] = self.positions()[:, nearer]
        self.improve()

    def improve(self):
        """Improves the parameters by their gradients, in a step of Adam."""
        self.optimizer.lr = self.rate * RATE_DECAY ** (self.frame - 1)
        self.optimizer.step([array.grad for array in self.parameters])

    def positions(self):
        """Returns all positions of the last simulation [m], shape [steps + 1, worlds, particles, 3]."""
        positions = np.array([state.particle_q.numpy() for state in self.states])
        return positions.reshape(len(positions), self.worlds, -1, 3)

    def test_final(self):
        """Checks that all steps are certified."""
        if self.ccd:
            assert self.solver.report.totals.uncertified_steps == 0, self.solver.report


class MarkExample(DiffsimExample):
    """Cloths that are to end on a mark, behind the semi-implicit solver."""

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.sim_dt = 1.0 / 600.0

    def prepare_descent(self, parameters, rate, steps, *, cloth_count, mark):
        """Prepares gradient descent.

        Args:
            parameters: The arrays to improve, an element for each world.
            rate: Learning rate of the first iteration.
            steps: How many steps a simulation has.
            cloth_count: Particles of the cloth that is to end on the mark, the first ones of each world.
            mark: Where its centre is to end [m].
        """
        super().prepare_descent(parameters, rate, steps)
        model, device = self.model, self.model.device
        self.cloth_count, self.mark = cloth_count, mark
        is_cloth = np.arange(model.particle_count) % (model.particle_count // self.worlds) < cloth_count
        # of each particle in the centre of the cloth of its world
        self.shares = wp.array(is_cloth / cloth_count, dtype=float, device=device)
        self.centres = wp.zeros(self.worlds, dtype=wp.vec3, device=device, requires_grad=True)

    def add_losses(self):
        """Computes the losses of all worlds, and their sum."""
        self.centres.zero_()
        inputs = [self.states[-1].particle_q, self.shares, self.model.particle_world]
        wp.launch(add_to_centre, self.model.particle_count, inputs=inputs, outputs=[self.centres])
        wp.launch(add_loss, self.worlds, inputs=[self.centres, self.mark, RADIUS], outputs=[self.losses, self.loss])

    def distances(self):
        """Returns how far from the mark the cloth of each world ended [m]."""
        return np.linalg.norm(self.centres.numpy() - np.array(self.mark), axis=1)

    def path(self):
        """Returns the path of the centre of each cloth in its best iteration [m], shape [steps + 1, worlds, 3]."""
        return self.motion[:, :, : self.cloth_count].mean(axis=2)

    def render(self):
        """Shows where the cloths end, and their paths."""
        paths = self.positions()[::8, :, : self.cloth_count].mean(axis=2)
        starts, ends = (wp.array(part.reshape(-1, 3), dtype=wp.vec3) for part in (paths[:-1], paths[1:]))
        self.viewer.begin_frame(float(self.frame))
        self.viewer.log_state(self.states[-1])
        self.viewer.log_lines("/paths", starts, ends, (0.9, 0.5, 0.2))
        self.draw_contacts()
        self.viewer.end_frame()

    def test_final(self):
        """Checks that all cloths end within two centimetres of the mark, and that all steps have gradients."""
        super().test_final()
        if self.ccd:
            assert self.solver.report.gradient_counts.lost_steps == 0, self.solver.report
            assert self.distance.max() < 0.02, self.distance

    def print_report(self):
        """Prints what the stage did, and how far from the mark the cloths end."""
        super().print_report()
        print(f"the cloths end {', '.join(f'{distance:.3f}' for distance in self.distance)} m from the mark")
