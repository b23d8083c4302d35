"""Bases of the examples with gradients: a search from several starts; particles whose centre is to end on a mark."""

import itertools

import newton
import numpy as np
import warp as wp
from common import ExampleBase
from searches import QuasiNewton

import warp_bsc as bsc

MAX_ITERATIONS = 100  # so that more steps converge: others carry no gradients
RADIUS = 0.25  # distance from the mark at which the loss grows fastest [m]


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


def add_cube(builder, cells, cell, centre, axis, angle, *, stiffness, density=200.0):
    """Adds a soft cube with ``cells`` cells of width ``cell`` [m] along each side, turned about an axis.

    Its stiffness [Pa] is that against shear and that against a change of volume; its density is in kg/m^3.
    """
    rotation = wp.quat_from_axis_angle(wp.normalize(axis), angle)
    corner = centre - wp.quat_rotate(rotation, wp.vec3(0.5 * cells * cell))
    cube = {f"dim_{axis}": cells for axis in "xyz"} | {f"cell_{axis}": cell for axis in "xyz"}
    cube |= {"density": density, "k_mu": stiffness, "k_lambda": stiffness, "k_damp": 0.0}
    builder.add_soft_grid(pos=corner, rot=rotation, vel=wp.vec3(), **cube)


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
    """A search by gradients of SolverImplicit in several worlds at once, in the format of Newton's examples.

    A frame is an evaluation of the loss and its gradient. A derived class calls :meth:`start_solver`,
    :meth:`prepare_descent` and :meth:`search_from` at the end of its ``__init__``, and makes its ``forward`` depend on
    the parameters. It adds the losses of all worlds in ``add_losses``, and says in ``distances`` how far from their
    marks they ended.

    Attributes:
        loss_history: The losses of all worlds in each evaluation so far.
        distance: Least distance from the mark so far, at which each world ended [m].
        motion: Positions of particles in that evaluation [m], shape [steps + 1, worlds, particles, 3].
        lost: Evaluations of each world so far that had a step without gradients, as it did not converge.
    """

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        self.sim_dt = self.frame_dt

    def start_solver(self, model, camera, **options):
        """Makes the solver, without contacts if ``--no-ccd`` is given, and shows the model.

        Args:
            model: The model.
            camera: As for :meth:`.common.ExampleBase.start`.
            options: Options of the solver.
        """
        apart = None if self.ccd else bsc.CollisionFilter(particle_mask=0)
        options |= {"report": ["contacts"] if self.draws_contacts else []}
        solver = bsc.SolverImplicit(model, collision_filter=apart, max_iterations=MAX_ITERATIONS, **options)
        self.start(model, solver, camera)

    def prepare_descent(self, parameters, steps):
        """Prepares the descent, which :meth:`search_from` begins.

        Args:
            parameters: The arrays to improve, an element for each world.
            steps: How many steps a simulation has.
        """
        model, device = self.model, self.model.device
        self.parameters = parameters
        self.states = [self.state_0, *(model.state() for _ in range(steps - 1)), self.state_1]
        self.worlds = model.world_count
        self.losses = wp.zeros(self.worlds, dtype=float, device=device, requires_grad=True)
        self.loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        self.tape = None
        self.loss_history = []
        self.distance = np.full(self.worlds, np.inf)
        self.motion = self.positions()

    def search_from(self, starts, *, first, longest, method=QuasiNewton):
        """Begins a search in each world.

        Args:
            starts: First values of each of the parameters, shape [worlds, n] each.
            first: Length of the first step.
            longest: Length of the longest step.
            method: Class of the searches.
        """
        self.sizes = [np.shape(start)[1] for start in starts]
        rows = np.concatenate(starts, axis=1)
        self.searches = [method(row, first, longest) for row in rows]
        self.lost = np.zeros(self.worlds, dtype=int)
        self.set_parameters(rows)

    def set_parameters(self, rows):
        """Sets the parameters of the worlds, shape [worlds, n]."""
        for array, values in zip(self.parameters, np.split(rows, np.cumsum(self.sizes)[:-1], axis=1), strict=True):
            array.assign(values.astype(np.float32))

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
            self.former.zero()  # of the last evaluation; or NaN, of a graph whose buffers were too small
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
        """Chooses the next parameters by losses and gradients, which are NaN where a step did not converge."""
        gradients = np.concatenate([array.grad.numpy() for array in self.parameters], axis=1).astype(float)
        self.lost += ~np.isfinite(gradients).all(axis=1)
        for search, loss, gradient in zip(self.searches, self.losses.numpy(), gradients, strict=True):
            search.take(float(loss), gradient)
        self.set_parameters(np.array([search.trial for search in self.searches]))

    def run_best(self):
        """Simulates all worlds again with the best parameters; returns how many steps did not converge."""
        before = self.solver.report.unconverged_steps
        self.set_parameters(self.best())
        self.forward()
        return self.solver.report.unconverged_steps - before

    def best(self):
        """Returns the best parameters of each world so far, shape [worlds, n]."""
        return np.array([search.x for search in self.searches])

    def positions(self):
        """Returns all positions of the last simulation [m], shape [steps + 1, worlds, particles, 3]."""
        positions = np.array([state.particle_q.numpy() for state in self.states])
        return positions.reshape(len(positions), self.worlds, -1, 3)

    def print_report(self):
        """Prints what the solver did, and what had no gradient."""
        super().print_report()
        evaluations = self.worlds * self.frame
        print(f"{self.lost.sum()} of {evaluations} evaluations without a gradient, as a step did not converge")

    def test_final(self):
        """Checks that all steps are certified, and that the best ones converge, so that they have gradients."""
        if self.ccd:
            assert self.solver.report.totals.uncertified_steps == 0, self.solver.report
        unconverged = self.run_best()
        assert unconverged == 0, f"{unconverged} steps did not converge"
        assert len(self.solver.report.intersections) == 0, self.solver.report.intersections


class MarkExample(DiffsimExample):
    """Particles whose centre is to end on a mark."""

    def prepare_descent(self, parameters, steps, *, count, mark):
        """Prepares the descent, which :meth:`search_from` begins.

        Args:
            parameters: The arrays to improve, an element for each world.
            steps: How many steps a simulation has.
            count: How many particles are to end on the mark, the first ones of each world.
            mark: Where their centre is to end [m].
        """
        super().prepare_descent(parameters, steps)
        model, device = self.model, self.model.device
        self.count, self.mark = count, mark
        is_meant = np.arange(model.particle_count) % (model.particle_count // self.worlds) < count
        # of each particle in the centre of its world
        self.shares = wp.array(is_meant / count, dtype=float, device=device)
        self.centres = wp.zeros(self.worlds, dtype=wp.vec3, device=device, requires_grad=True)

    def add_losses(self):
        """Computes the losses of all worlds, and their sum."""
        self.centres.zero_()
        inputs = [self.states[-1].particle_q, self.shares, self.model.particle_world]
        wp.launch(add_to_centre, self.model.particle_count, inputs=inputs, outputs=[self.centres])
        wp.launch(add_loss, self.worlds, inputs=[self.centres, self.mark, RADIUS], outputs=[self.losses, self.loss])

    def distances(self):
        """Returns how far from the mark the centre of each world ended [m]."""
        return np.linalg.norm(self.centres.numpy() - np.array(self.mark), axis=1)

    def path(self):
        """Returns the path of the centre in each world in its best evaluation [m], shape [steps + 1, worlds, 3]."""
        return self.motion[:, :, : self.count].mean(axis=2)

    def render(self):
        """Shows where the particles end, and the paths of the centres."""
        paths = self.positions()[::4, :, : self.count].mean(axis=2)
        starts, ends = (wp.array(part.reshape(-1, 3), dtype=wp.vec3) for part in (paths[:-1], paths[1:]))
        self.viewer.begin_frame(float(self.frame))
        self.viewer.log_state(self.states[-1])
        self.viewer.log_lines("/paths", starts, ends, (0.9, 0.5, 0.2))
        self.draw_contacts()
        self.viewer.end_frame()

    def test_final(self):
        """Checks that all end within a centimetre of the mark; without contacts, that nothing better was found."""
        super().test_final()
        if self.ccd:
            assert self.distance.max() < 0.01, self.distance

    def print_report(self):
        """Prints what the solver did, and how far from the mark the centres end."""
        super().print_report()
        print(f"they end {', '.join(f'{distance:.4f}' for distance in self.distance)} m from the mark")
