"""Bases of the examples with gradients of SolverImplicit: a search in each world; particles that have targets."""

import numpy as np
import warp as wp
from diffsim import DiffsimExample

import warp_bsc as bsc

MAX_ITERATIONS = 100  # so that more steps converge: others carry no gradients


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
        self._step = np.zeros_like(self.x)

    def take(self, value, gradient):
        """Takes value and gradient at the trial, and chooses the next one."""
        is_known, before = np.isfinite(gradient).all(), self._gradient
        if is_known and value < self._value:
            if before is not None:
                self._learn(self.trial - self.x, gradient - before)
            self.x, self._value, self._gradient = self.trial, value, gradient
            step = -gradient if self._inverse is None else -self._inverse @ gradient
            longest = self._first if self._inverse is None else self._longest
            length = max(np.linalg.norm(step), 1e-30)
            self._step = step * (longest / length if self._inverse is None else min(1.0, longest / length))
        elif before is None:  # no gradient is known yet: to the other side of the start, a little farther each time
            self._step = -1.5 * self._step if self._step.any() else np.full(self.x.shape, 0.1 * self._first)
        else:  # too far: less, to where a parabola with these slopes is least
            share, slope = 0.5, before @ self._step
            if is_known and slope < 0.0:
                end_slope = gradient @ self._step
                share = min(slope / min(slope - end_slope, slope), 0.5)
            self._step = max(share, 0.1) * self._step
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


class FittedNewton:
    """Minimises a function of a few parameters by steps of Newton's method, with a Hessian fitted to all gradients.

    The Hessian is the symmetric matrix that fits best, by least squares, how gradients change from the best parameters
    to all others; the nearer, the more they count. A trust region limits the steps. In contrast to
    :class:`QuasiNewton`, evaluations that were no better count as much as others, and parameters of very different
    influence slow it down little.

    Attributes:
        x: The best parameters so far.
        trial: Parameters to evaluate next.
    """

    NEAR = 0.02  # distance below which differences count no more than farther ones
    PRIOR = 0.1  # weight of the first guess of the Hessian
    OFF = 0.9  # by how much all parameters are off at the start, which that guess says

    def __init__(self, x, first, longest):
        """Takes the parameters at the start, and lengths of the first step and of the longest."""
        self.trial = self.x = np.array(x)
        self._radius, self._longest = first, longest
        self._value, self._gradient, self._first_hessian = np.inf, None, None
        self._known = []  # parameters and gradients of all evaluations that have one
        self._step, self._decrease = np.zeros_like(self.x), np.inf

    def take(self, value, gradient):
        """Takes value and gradient at the trial, and chooses the next one."""
        length = np.linalg.norm(self._step)
        is_known = np.isfinite(value) and np.isfinite(gradient).all()
        if is_known:
            self._known.append((self.trial, gradient))
        if is_known and value < self._value:
            if self._gradient is not None:
                share = (self._value - value) / self._decrease  # of what the model predicts
                if share > 0.5:
                    self._radius = min(max(self._radius, 2.0 * length), self._longest)
                elif share < 0.2:
                    self._radius = 0.5 * length
            self.x, self._value, self._gradient = self.trial, value, gradient
        elif self._gradient is not None:  # too far, or no gradient: less
            self._radius = max(0.4 * length, 1e-12)
        if self._gradient is None:  # to the other side of the start, a little farther each time
            self._step = -1.5 * self._step if length else np.full(self.x.shape, 0.1 * self._radius)
        else:
            self._step = self._newton_step(self._fit())
        self.trial = self.x + self._step

    def _fit(self):
        """Returns the Hessian."""
        if self._first_hessian is None:
            self._first_hessian = np.diag(np.abs(self._gradient) / self.OFF)
        row, column = np.triu_indices(len(self.x))
        basis = np.zeros((len(row), *self._first_hessian.shape))
        basis[np.arange(len(row)), row, column] = basis[np.arange(len(row)), column, row] = 1.0
        factors, changes = [self.PRIOR * np.eye(len(row))], [self.PRIOR * self._first_hessian[row, column]]
        for x, gradient in self._known:
            step = x - self.x
            weight = (step @ step + self.NEAR**2) ** -1.5
            factors.append(weight * (basis @ step).T)
            changes.append(weight * (gradient - self._gradient))
        entries = np.linalg.lstsq(np.concatenate(factors), np.concatenate(changes), rcond=None)[0]
        return np.tensordot(entries, basis, axes=1)

    def _newton_step(self, hessian):
        """Returns the step to the least value of the model in the trust region, with curvatures taken as positive."""
        curvatures, axes = np.linalg.eigh(hessian)
        curvatures = np.maximum(np.abs(curvatures), 1e-3 * np.abs(curvatures).max())
        slopes = axes.T @ self._gradient
        low, high = 0.0, np.linalg.norm(slopes) / self._radius  # with this much more curvature it is short enough
        step = -slopes / curvatures
        if np.linalg.norm(step) > self._radius:
            for _ in range(50):
                more = 0.5 * (low + high)
                step = -slopes / (curvatures + more)
                low, high = (more, high) if np.linalg.norm(step) > self._radius else (low, more)
        self._decrease = -(slopes @ step + 0.5 * step @ (curvatures * step))
        return axes @ step


class SearchExample(DiffsimExample):
    """A search in each world by gradients of ``SolverImplicit``, in the format of Newton's examples.

    The loss is a mean of squared distances, the distance from the mark its root. A step is one of 1/60 s. A derived
    class calls :meth:`start_solver`, ``prepare_descent`` and :meth:`search_from`.

    Attributes:
        lost: Evaluations of each world so far that had a step without gradients, as it did not converge.
    """

    def start_solver(self, model, camera, **options):
        """Makes the solver, without contacts if ``--no-ccd`` is given, and shows the model.

        Args:
            model: The model.
            camera: As for :meth:`.common.ExampleBase.start`.
            options: Options of the solver.
        """
        self.sim_dt = self.frame_dt
        apart = None if self.ccd else bsc.CollisionFilter(particle_mask=0)
        options |= {"report": ["contacts"] if self.draws_contacts else []}
        solver = bsc.SolverImplicit(model, collision_filter=apart, max_iterations=MAX_ITERATIONS, **options)
        self.start(model, solver, camera)

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

    def improve(self):
        """Chooses the next parameters by losses and gradients."""
        gradients = np.concatenate([array.grad.numpy() for array in self.parameters], axis=1).astype(float)
        self.lost += ~np.isfinite(gradients).all(axis=1)
        for search, loss, gradient in zip(self.searches, self.losses.numpy(), gradients, strict=True):
            search.take(float(loss), gradient)
        self.set_parameters(np.array([search.trial for search in self.searches]))

    def run_best(self):
        """Simulates all worlds again with the best parameters; returns how many steps did not converge."""
        before = self.solver.report.unconverged_steps
        self.set_parameters(np.array([search.x for search in self.searches]))
        self.forward()
        return self.solver.report.unconverged_steps - before

    def distances(self):
        """Returns the roots of the losses of all worlds [m]."""
        return np.sqrt(self.losses.numpy())

    def render(self):
        """Shows where the cloths end."""
        self.viewer.begin_frame(float(self.frame))
        self.viewer.log_state(self.states[-1])
        self.draw_contacts()
        self.viewer.end_frame()

    def test_final(self):
        """Checks that all steps are certified, and that the best ones converge, so that they have gradients."""
        super().test_final()
        unconverged = self.run_best()
        assert unconverged == 0, f"{unconverged} steps did not converge"
        assert len(self.solver.report.intersections) == 0, self.solver.report.intersections

    def print_report(self):
        """Prints what the solver did, how far from the targets the cloths were, and what had no gradient."""
        super().print_report()
        print(f"{', '.join(f'{distance:.4f}' for distance in self.distance)} m from the targets")
        evaluations = self.worlds * self.frame
        print(f"{self.lost.sum()} of {evaluations} evaluations without a gradient, as a step did not converge")


class TargetExample(SearchExample):
    """Cloths whose particles are to be at targets: the loss is the mean of the squared distances from these."""

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

    def add_losses(self):
        """Computes the losses of all worlds, and their sum."""
        model, targets = self.model, self.targets
        self.losses.zero_()
        share = self.worlds / (model.particle_count * len(targets))
        for step, state in enumerate(self.states[-len(targets) :]):
            inputs = [state.particle_q, targets, step, model.particle_world, share]
            wp.launch(add_squares, model.particle_count, inputs=inputs, outputs=[self.losses, self.loss])
