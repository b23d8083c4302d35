"""Base of the examples with gradients behind VBD: particles that are to be at targets in the last steps."""

import numpy as np
import warp as wp
from diffsim import DiffsimExample


@wp.kernel
def add_squares(
    # in
    particle_q: wp.array[wp.vec3],
    targets: wp.array2d[wp.vec3],
    step: int,
    particle_world: wp.array[int],
    share: float,
    # in and out
    losses: wp.array[float],
    loss: wp.array[float],
):
    """Adds the squared distance of a particle from its target, times a share, to the loss of its world and to all."""
    particle = wp.tid()
    target = targets[step, particle % targets.shape[1]]
    value = share * wp.length_sq(particle_q[particle] - target)
    wp.atomic_add(losses, particle_world[particle], value)
    wp.atomic_add(loss, 0, value)


class QuasiNewton:
    """Minimises a function of a few parameters by the method of Broyden, Fletcher, Goldfarb and Shanno (BFGS).

    Attributes:
        x: The best parameters so far.
        trial: Parameters to evaluate next.
    """

    def __init__(self, x, first, longest):
        """Takes the parameters at the start, and lengths of the first step and of the longest."""
        self.trial = self.x = np.array(x)
        self._first, self._longest = first, longest
        self._value, self._gradient, self._inverse = np.inf, None, None

    def take(self, value, gradient):
        """Takes value and gradient at the trial, and chooses the next one."""
        if value < self._value and np.isfinite(gradient).all():
            if self._gradient is not None:
                self._learn(self.trial - self.x, gradient - self._gradient)
            self.x, self._value, self._gradient = self.trial, value, gradient
            step = -gradient if self._inverse is None else -self._inverse @ gradient
            longest = self._first if self._inverse is None else self._longest
            length = np.linalg.norm(step)
            self._step = step * (longest / length if self._inverse is None else min(1.0, longest / length))
        else:  # too far
            self._step = 0.25 * self._step
        self.trial = self.x + self._step

    def _learn(self, step, change):
        """Updates the inverse of the Hessian by the change of the gradient in a step."""
        product = step @ change
        if product <= 0.0:  # no curvature that a minimum could have
            return
        one = np.eye(len(step))
        if self._inverse is None:
            self._inverse = product / (change @ change) * one
        factor = one - np.outer(step, change) / product
        self._inverse = factor @ self._inverse @ factor.T + np.outer(step, step) / product


class TargetExample(DiffsimExample):
    """Cloths whose particles are to be at targets, behind VBD, in the format of Newton's examples.

    The loss is the mean of the squared distances, the distance from the mark its root. A step is one of 1/60 s.
    """

    def start_solver(self, adjoint, camera, **options):
        """Puts the stage behind the adjoint of VBD, and shows the model.

        Args:
            adjoint: The ``SolverImplicitAdjoint``.
            camera: As for :meth:`.common.ExampleBase.start`.
            options: Options of the stage.
        """
        self.sim_dt, self.adjoint = self.frame_dt, adjoint
        self.start(adjoint.model, adjoint, camera, **options)

    def prepare_descent(self, parameters, steps, *, targets):
        """Prepares the descent, which :meth:`search_from` begins.

        Args:
            parameters: The arrays to improve, an element for each world.
            steps: How many steps a simulation has.
            targets: Where the particles of each world are to be after each of the last n steps [m], shape
                [n, particles, 3].
        """
        super().prepare_descent(parameters, None, steps)
        self.targets = wp.array(np.asarray(targets, dtype=np.float32), dtype=wp.vec3, device=self.model.device)

    def search_from(self, starts, *, first, longest):
        """Begins a search in each world.

        Args:
            starts: First values of each of the parameters, shape [worlds, n] each.
            first: Length of the first step.
            longest: Length of the longest step.
        """
        self.sizes = [np.shape(start)[1] for start in starts]
        rows = np.concatenate(starts, axis=1)
        self.searches = [QuasiNewton(row, first, longest) for row in rows]
        self.set_parameters(rows)

    def set_parameters(self, rows):
        """Sets the parameters of the worlds, shape [worlds, n]."""
        for array, values in zip(self.parameters, np.split(rows, np.cumsum(self.sizes)[:-1], axis=1), strict=True):
            array.assign(values.astype(np.float32))

    def improve(self):
        """Chooses the next parameters by losses and gradients."""
        gradients = np.concatenate([array.grad.numpy() for array in self.parameters], axis=1).astype(float)
        for search, loss, gradient in zip(self.searches, self.losses.numpy(), gradients, strict=True):
            search.take(float(loss), gradient)
        self.set_parameters(np.array([search.trial for search in self.searches]))

    def run_best(self):
        """Simulates all worlds again with the best parameters; returns how many steps were not solved."""
        before = self.adjoint.report.unconverged_steps
        self.set_parameters(np.array([search.x for search in self.searches]))
        with wp.Tape():  # so that steps leave their start as it is, and are in the report
            self.forward()
        return self.adjoint.report.unconverged_steps - before

    def add_losses(self):
        """Computes the losses of all worlds, and their sum."""
        model, targets = self.model, self.targets
        self.losses.zero_()
        share = self.worlds / (model.particle_count * len(targets))
        for step, state in enumerate(self.states[-len(targets) :]):
            inputs = [state.particle_q, targets, step, model.particle_world, share]
            wp.launch(add_squares, model.particle_count, inputs=inputs, outputs=[self.losses, self.loss])

    def distances(self):
        """Returns how far from their targets the particles of each world were, as root of the mean square [m]."""
        return np.sqrt(self.losses.numpy())

    def render(self):
        """Shows where the cloths end."""
        self.viewer.begin_frame(float(self.frame))
        self.viewer.log_state(self.states[-1])
        self.viewer.end_frame()

    def test_final(self):
        """Checks that all steps are certified and have gradients, and that the best ones are solved."""
        super().test_final()
        unsolved = self.run_best()
        assert unsolved == 0, f"{unsolved} steps end with more than 1% of the weight"
        report = self.adjoint.report
        assert report.failed_solves == 0, report.failed_solves
        if self.ccd:
            assert len(self.solver.report.intersections) == 0, self.solver.report.intersections

    def print_report(self):
        """Prints what the stage did, how well steps were solved, and how far from the targets the cloths were."""
        super().print_report()
        report = self.adjoint.report
        print(f"{report.unconverged_steps} of {report.steps} steps were left with more than 1% of the weight")
        print(f"{', '.join(f'{distance:.4f}' for distance in self.distance)} m from the targets")
