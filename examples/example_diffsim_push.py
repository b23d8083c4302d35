"""Example Diffsim Push: finds the path of a paddle that lifts and pushes a cloth so that it ends on a mark.

    python examples/example_diffsim_push.py
    python examples/example_diffsim_push.py --no-ccd  # the paddle passes through the cloth, and the gradient is zero

Gradient descent improves three paths, each in a world of its own: how far the paddle goes, and how far it turns. The
gradient of the loss goes back through the flight of the cloth and its contacts with the paddle, with friction and
restitution, to the poses of the paddle in all steps.
"""

import itertools

import newton
import numpy as np
import warp as wp
import warp.optim
from common import create_parser, main
from newton.solvers import SolverSemiImplicit

import warp_bsc as bsc

MARK = wp.vec3(0.15, 0.08, 0.25)  # [m]
RADIUS = 0.3  # distance from the mark at which the loss grows fastest [m]
# first paths: how far the paddle goes [m], and how far it turns, as axis times angle [rad]
STARTS = [
    ((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)),
    ((0.05, -0.05, 0.3), (-0.3, 0.2, 0.0)),
    ((-0.05, 0.05, 0.15), (0.3, 0.3, 0.2)),
]
FALL = -0.3  # velocity of the cloth at the start [m/s]
STEPS = 60
FIRST_RATE, RATE_DECAY = 0.05, 0.94  # learning rate of the first iteration [m, rad], and its factor per iteration


@wp.kernel
def swing(shifts: wp.array[wp.vec3], turns: wp.array[wp.vec3], share: float, body_q: wp.array[wp.transform]):
    """Places each paddle on its path, after a share of the time, in which it accelerates from rest."""
    paddle = wp.tid()
    way = share * share
    half = 0.5 * way * turns[paddle]
    body_q[paddle] = wp.transform(way * shifts[paddle], wp.normalize(wp.quat(half, 1.0)))


@wp.kernel
def add_to_centre(
    particle_q: wp.array[wp.vec3], particle_world: wp.array[int], share: float, centres: wp.array[wp.vec3]
):
    """Adds a particle's share to the centre of the cloth of its world."""
    particle = wp.tid()
    wp.atomic_add(centres, particle_world[particle], share * particle_q[particle])


@wp.kernel
def judge(centres: wp.array[wp.vec3], mark: wp.vec3, radius: float, losses: wp.array[float], loss: wp.array[float]):
    """Computes the loss of each path, 0 on the mark and 1 far from it, and adds it to the total."""
    world = wp.tid()
    value = 1.0 - wp.exp(-0.5 * wp.length_sq(centres[world] - mark) / (radius * radius))
    losses[world] = value
    wp.atomic_add(loss, 0, value)


class PaddleSolver(SolverSemiImplicit):
    """Moves the paddles, which are all bodies, along their paths.

    The solver itself leaves kinematic bodies where they are. It writes them elsewhere: an array that is written twice
    in a step would get the gradients of both.
    """

    def __init__(self, model, shifts, turns, time):
        super().__init__(model, enable_tri_contact=False)
        self.shifts, self.turns, self.time, self.elapsed = shifts, turns, time, 0.0
        self.unmoved = model.state()

    def step(self, state_in, state_out, control, contacts, dt):
        """Steps the cloth, and moves the paddles."""
        self.unmoved.particle_q, self.unmoved.particle_qd = state_out.particle_q, state_out.particle_qd
        super().step(state_in, self.unmoved, control, contacts, dt)
        self.elapsed += dt
        inputs, outputs = [self.shifts, self.turns, self.elapsed / self.time], [state_out.body_q]
        wp.launch(swing, len(self.shifts), inputs=inputs, outputs=outputs, device=self.model.device)


class Example:
    """The scene, in the format of Newton's examples; a step is an iteration of the optimisation."""

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.ccd = args.ccd
        self.sim_dt = 1.0 / 600.0
        self.iteration = 0

        world = newton.ModelBuilder()
        cells, cell = 3, 0.04
        rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.6, 0.0)), 0.2)
        corner = wp.vec3(-0.5 * cells * cell, -0.5 * cells * cell, 0.0)
        world.add_cloth_grid(
            pos=wp.vec3(0.01, -0.01, 0.025) + wp.quat_rotate(rotation, corner),
            rot=rotation,
            vel=wp.vec3(0.0, 0.0, FALL),
            dim_x=cells,
            dim_y=cells,
            cell_x=cell,
            cell_y=cell,
            mass=0.001,
            tri_ke=50.0,
            tri_ka=50.0,
            tri_kd=5.0e-2,
            edge_ke=1.0e-2,
            edge_kd=1.0e-3,
        )
        self.share = 1.0 / world.particle_count
        paddle = world.add_body(is_kinematic=True)
        world.add_shape_box(paddle, hx=0.15, hy=0.15, hz=0.005, cfg=newton.ModelBuilder.ShapeConfig(mu=0.6))
        builder = newton.ModelBuilder()
        builder.replicate(world, len(STARTS))
        self.model = model = builder.finalize(requires_grad=True)
        model.soft_contact_restitution = 0.0
        model.particle_mu = 0.6
        # the solver's own contacts between particles are penalties, and not needed here
        model.particle_ke = model.particle_kd = model.particle_kf = 0.0
        model.particle_grid = None

        device = model.device
        self.shifts, self.turns = self.path = [
            wp.array(values, dtype=wp.vec3, device=device, requires_grad=True) for values in zip(*STARTS, strict=True)
        ]
        self.inner = self.solver = PaddleSolver(model, *self.path, STEPS * self.sim_dt)
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.states = [model.state() for _ in range(STEPS + 1)]
        self.control = model.control()
        self.centres = wp.zeros(len(STARTS), dtype=wp.vec3, device=device, requires_grad=True)
        self.losses = wp.zeros(len(STARTS), dtype=float, device=device, requires_grad=True)
        self.loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        self.optimizer = warp.optim.Adam(self.path, lr=FIRST_RATE)
        self.loss_history = []
        self.distance = np.full(len(STARTS), np.inf)  # least so far of each cloth from the mark at the end [m]

        self.viewer.set_model(model)
        self.viewer.set_camera(pos=wp.vec3(0.2, -1.8, 0.4), pitch=-5.0, yaw=90.0)
        self.tape = None
        self.run_iteration = bsc.CapturedSteps(self.differentiate, self.solver)

    def simulate(self):
        """Simulates the pushes, and computes their losses."""
        states = self.states
        self.inner.elapsed = 0.0
        for start, end in itertools.pairwise(states):
            start.clear_forces()
            self.solver.step(start, end, self.control, None, self.sim_dt)
        self.centres.zero_()
        self.loss.zero_()
        inputs = [states[-1].particle_q, self.model.particle_world, self.share]
        wp.launch(add_to_centre, self.model.particle_count, inputs=inputs, outputs=[self.centres])
        wp.launch(judge, len(STARTS), inputs=[self.centres, MARK, RADIUS], outputs=[self.losses, self.loss])

    def differentiate(self):
        """Simulates the pushes, and computes the gradient of the loss."""
        if self.tape is not None:
            self.tape.zero()  # of the last iteration; or NaN, of a graph whose buffers were too small
        self.tape = wp.Tape()
        with self.tape:
            self.simulate()
        self.tape.backward(self.loss)

    def step(self):
        """Improves the paths by the gradient, computed on a GPU from a CUDA graph."""
        self.run_iteration()
        self.loss_history.append(self.losses.numpy().copy())
        distance = np.linalg.norm(self.centres.numpy() - np.array(MARK), axis=1)
        self.distance = np.minimum(self.distance, distance)
        self.optimizer.lr = FIRST_RATE * RATE_DECAY**self.iteration
        self.optimizer.step([array.grad for array in self.path])
        self.iteration += 1

    def render(self):
        """Shows where the cloth ends, and its paths."""
        positions = np.array([state.particle_q.numpy() for state in self.states[::8]])
        centres = positions.reshape(len(positions), len(STARTS), -1, 3).mean(axis=2)
        starts, ends = (wp.array(part.reshape(-1, 3), dtype=wp.vec3) for part in (centres[:-1], centres[1:]))
        self.viewer.begin_frame(float(self.iteration))
        self.viewer.log_state(self.states[-1])
        self.viewer.log_lines("/paths", starts, ends, (0.9, 0.5, 0.2))
        self.viewer.end_frame()

    def test_final(self):
        """Checks that all cloths end within two centimetres of the mark; without the stage, that paths are the same."""
        if self.ccd:
            assert self.distance.max() < 0.02, self.distance
            report = self.solver.report
            assert report.uncertified_steps + report.lost_gradients == 0, report
        else:
            changes = np.stack([array.numpy() for array in self.path], axis=1) - STARTS
            assert np.abs(changes).max() < 1e-6, changes
            assert self.distance.min() > 0.2, self.distance

    def print_report(self):
        """Prints what the stage did, and how far from the mark the cloths end."""
        if self.ccd:
            print(self.solver.report)
        print(f"the cloths end {', '.join(f'{distance:.3f}' for distance in self.distance)} m from the mark")

    @staticmethod
    def create_parser():
        """Returns the options."""
        return create_parser(num_frames=40)


if __name__ == "__main__":
    main(Example)
