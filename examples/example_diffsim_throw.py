"""Example Diffsim Throw: finds the throw for which a small cloth bounces off a thin tilted sheet onto a mark.

    python examples/example_diffsim_throw.py
    python examples/example_diffsim_throw.py --no-ccd  # the cloth flies through the sheet, and the gradient is zero

Gradient descent improves three throws, each in a world of its own. The gradient of the loss goes back through the
flight, the bounce off the sheet, with friction and restitution, and the throw. The cloth flies two centimetres a step,
so that without continuous collision detection it never meets the sheet. It then lands far from the mark, where the loss
is flat and its gradient zero.
"""

import itertools

import newton
import numpy as np
import warp as wp
import warp.optim
from common import create_parser, main

import warp_bsc as bsc

MARK = wp.vec3(-0.55, 0.1, 0.75)  # [m]
RADIUS = 0.3  # distance from the mark at which the loss grows fastest [m]
STARTS = [(13.5, 0.0, -1.0), (9.5, 1.6, 1.0), (12.5, -1.2, 1.6)]  # first throws [m/s]
PATCH_CELLS = 4
STEPS = 160
FIRST_RATE, RATE_DECAY = 0.3, 0.94  # learning rate of the first iteration [m/s], and its factor per iteration


@wp.kernel
def throw(
    throws: wp.array[wp.vec3], thrown: wp.array[int], particle_world: wp.array[int], particle_qd: wp.array[wp.vec3]
):
    """Sets the velocity of the thrown particles to the throw of their world."""
    particle = wp.tid()
    velocity = wp.vec3()
    if thrown[particle] == 1:
        velocity = throws[particle_world[particle]]
    particle_qd[particle] = velocity


@wp.kernel
def add_to_centre(
    particle_q: wp.array[wp.vec3],
    thrown: wp.array[int],
    particle_world: wp.array[int],
    share: float,
    centres: wp.array[wp.vec3],
):
    """Adds a particle's share to the centre of the cloth."""
    particle = wp.tid()
    if thrown[particle] == 1:
        wp.atomic_add(centres, particle_world[particle], share * particle_q[particle])


@wp.kernel
def judge(centres: wp.array[wp.vec3], mark: wp.vec3, radius: float, losses: wp.array[float], loss: wp.array[float]):
    """Computes the loss of each throw, 0 on the mark and 1 far from it, and adds it to the total."""
    world = wp.tid()
    value = 1.0 - wp.exp(-0.5 * wp.length_sq(centres[world] - mark) / (radius * radius))
    losses[world] = value
    wp.atomic_add(loss, 0, value)


class Example:
    """The scene, in the format of Newton's examples; a step is an iteration of the optimisation."""

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.ccd = args.ccd
        self.sim_dt = 1.0 / 600.0
        self.iteration = 0

        world = newton.ModelBuilder()
        self.add_cloth(world, PATCH_CELLS, 0.03, wp.vec3(-0.9, 0.0, 0.1), wp.vec3(0.2, 1.0, 0.1), -1.35)
        patch = world.particle_count
        fixed = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], True)
        # a sheet of two triangles; the cloth meets one of them
        self.add_cloth(world, 1, 1.4, wp.vec3(0.0, -0.35, 0.0), wp.vec3(0.0, 1.0, 0.0), -1.05, **fixed)
        builder = newton.ModelBuilder()
        builder.replicate(world, len(STARTS))
        self.model = model = builder.finalize(requires_grad=True)
        model.soft_contact_restitution = 0.6
        model.particle_mu = 0.2
        # the solver's own contacts between particles are penalties, and not needed here
        model.particle_ke = model.particle_kd = model.particle_kf = 0.0
        model.particle_grid = None

        self.solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
        if self.ccd:
            self.solver = bsc.SolverCCD(self.solver)
        self.states = [model.state() for _ in range(STEPS + 1)]
        self.control = model.control()
        device = model.device
        thrown = np.arange(model.particle_count) % world.particle_count < patch
        self.thrown = wp.array(thrown, dtype=int, device=device)
        self.share = 1.0 / patch
        self.throws = wp.array(STARTS, dtype=wp.vec3, device=device, requires_grad=True)
        self.centres = wp.zeros(len(STARTS), dtype=wp.vec3, device=device, requires_grad=True)
        self.losses = wp.zeros(len(STARTS), dtype=float, device=device, requires_grad=True)
        self.loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        self.optimizer = warp.optim.Adam([self.throws], lr=FIRST_RATE)
        self.loss_history = []
        self.throw = self.throws.numpy().copy()  # best so far, in each world
        self.distance = np.full(len(STARTS), np.inf)  # of its landing from the mark [m]
        self.path = np.zeros((STEPS + 1, len(STARTS), 3))  # of its centre [m]

        self.viewer.set_model(model)
        self.viewer.set_camera(pos=wp.vec3(-0.3, -3.2, 0.5), pitch=-5.0, yaw=90.0)
        self.tape = None
        self.run_iteration = bsc.CapturedSteps(self.differentiate, self.solver)

    def add_cloth(self, builder, cells, cell, center, axis, angle, **fixed):
        """Adds a square of cloth with ``cells`` cells of width ``cell`` [m] along each side, turned about an axis."""
        rotation = wp.quat_from_axis_angle(wp.normalize(axis), angle)
        side = cells * cell
        builder.add_cloth_grid(
            pos=center + wp.quat_rotate(rotation, wp.vec3(-0.5 * side, -0.5 * side, 0.0)),
            rot=rotation,
            vel=wp.vec3(),
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
            **fixed,
        )

    def simulate(self):
        """Simulates the throws, and computes their losses."""
        states, world = self.states, self.model.particle_world
        inputs, outputs = [self.throws, self.thrown, world], [states[0].particle_qd]
        wp.launch(throw, self.model.particle_count, inputs=inputs, outputs=outputs)
        for start, end in itertools.pairwise(states):
            start.clear_forces()
            self.solver.step(start, end, self.control, None, self.sim_dt)
        self.centres.zero_()
        self.loss.zero_()
        inputs = [states[-1].particle_q, self.thrown, world, self.share]
        wp.launch(add_to_centre, self.model.particle_count, inputs=inputs, outputs=[self.centres])
        wp.launch(judge, len(STARTS), inputs=[self.centres, MARK, RADIUS], outputs=[self.losses, self.loss])

    def differentiate(self):
        """Simulates the throws, and computes the gradient of the loss."""
        if self.tape is not None:
            self.tape.zero()  # of the last iteration; or NaN, of a graph whose buffers were too small
        self.tape = wp.Tape()
        with self.tape:
            self.simulate()
        self.tape.backward(self.loss)

    def step(self):
        """Improves the throws by the gradient, computed on a GPU from a CUDA graph."""
        self.run_iteration()
        self.loss_history.append(self.losses.numpy().copy())
        distance = np.linalg.norm(self.centres.numpy() - np.array(MARK), axis=1)
        nearer = distance < self.distance
        self.distance[nearer] = distance[nearer]
        self.throw[nearer] = self.throws.numpy()[nearer]
        self.path[:, nearer] = self.centre_paths()[:, nearer]
        self.optimizer.lr = FIRST_RATE * RATE_DECAY**self.iteration
        self.optimizer.step([self.throws.grad])
        self.iteration += 1

    def centre_paths(self):
        """Returns the path of the centre of each cloth in the last simulation [m], shape [STEPS + 1, worlds, 3]."""
        thrown = self.thrown.numpy().astype(bool)
        positions = np.array([state.particle_q.numpy()[thrown] for state in self.states])
        return positions.reshape(len(self.states), len(STARTS), -1, 3).mean(axis=2)

    def render(self):
        """Shows where the throws land, and their paths."""
        ends = self.centre_paths()[::8].astype(np.float32)
        starts, ends = (wp.array(part.reshape(-1, 3), dtype=wp.vec3) for part in (ends[:-1], ends[1:]))
        self.viewer.begin_frame(float(self.iteration))
        self.viewer.log_state(self.states[-1])
        self.viewer.log_lines("/paths", starts, ends, (0.9, 0.5, 0.2))
        self.viewer.end_frame()

    def test_final(self):
        """Checks that all throws land within two centimetres of the mark; without the stage, that none has changed."""
        if self.ccd:
            assert self.distance.max() < 0.02, self.distance
            report = self.solver.report
            assert report.uncertified_steps + report.lost_gradients == 0, report
        else:
            assert np.abs(self.throws.numpy() - STARTS).max() < 1e-3, self.throws
            assert self.distance.min() > 1.0, self.distance
            assert np.ptp(self.loss_history, axis=0).max() < 1e-6, self.loss_history

    def print_report(self):
        """Prints what the stage did, and how far from the mark the throws land."""
        if self.ccd:
            print(self.solver.report)
        print(f"the throws land {', '.join(f'{distance:.3f}' for distance in self.distance)} m from the mark")

    @staticmethod
    def create_parser():
        """Returns the options."""
        return create_parser(num_frames=60)


if __name__ == "__main__":
    main(Example)
