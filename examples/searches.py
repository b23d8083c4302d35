"""Searches for parameters by values and gradients, which may be NaN, for the examples with gradients."""

import numpy as np

FLAT = 1e-5  # share of the loss: where the first step of a search promises less, it stays where it is


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
            if self._inverse is not None:
                step, longest = -self._inverse @ gradient, self._longest
                self._step = step * min(1.0, longest / max(np.linalg.norm(step), 1e-30))
            else:
                length = np.linalg.norm(gradient)
                is_flat = self._first * length < FLAT * value
                self._step = np.zeros_like(gradient) if is_flat else -self._first / length * gradient
        elif before is None:  # no gradient is known yet: to the other side of the start, a little farther each time
            self._step = -1.5 * self._step if self._step.any() else np.full(self.x.shape, 0.1 * self._first)
        else:  # too far: less, to where a parabola with these slopes is least
            share = 0.5
            if is_known and self._step.any():
                slope, end_slope = before @ self._step, gradient @ self._step
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
