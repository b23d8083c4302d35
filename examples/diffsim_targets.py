"""Base of the examples with gradients of SolverImplicit: particles that are to be at targets in the last steps."""

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


class TargetExample(DiffsimExample):
    """Cloths whose particles are to be at targets, in the format of Newton's examples.

    The loss is the mean of the squared distances, the distance from the mark its root.
    """

    def prepare_descent(self, parameters, steps, *, targets):
        """Prepares the descent, which :meth:`search_from` begins.

        Args:
            parameters: The arrays to improve, an element for each world.
            steps: How many steps a simulation has.
            targets: Where the particles of each world are to be after each of the last n steps [m], shape
                [n, particles, 3].
        """
        super().prepare_descent(parameters, steps)
        self.targets = wp.array(np.asarray(targets, dtype=np.float32), dtype=wp.vec3, device=self.model.device)

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
        self.draw_contacts()
        self.viewer.end_frame()

    def print_report(self):
        """Prints what the solver did, and how far from the targets the cloths were."""
        super().print_report()
        print(f"{', '.join(f'{distance:.4f}' for distance in self.distance)} m from the targets")
