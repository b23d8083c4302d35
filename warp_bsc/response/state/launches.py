"""Launches of kernels over what a step has: elements of queues, constraints, particles, bodies, vertices of shapes."""

from collections.abc import Sequence

import warp as wp

from ...detection.run.launch import cores_for, launch_on_cores
from .mesh import ModelMesh
from .structs import Step


class Launches:
    """Launches kernels on the arrays of a step."""

    device: wp.Device
    mesh: ModelMesh
    step: Step
    particle_count: int
    body_count: int
    _threads: int  # of a launch over a queue

    def launch(self, kernel: wp.Kernel, size: int | tuple[int, ...], inputs: Sequence, outputs: Sequence = ()) -> None:
        """Launches a kernel on the device."""
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)

    def launch_over_entries(
        self, kernel: wp.Kernel, inputs: Sequence, *, on_cores: bool = False, is_large: bool = False
    ) -> None:
        """Launches a kernel that takes all entries of a queue, of which the device knows the number.

        Its last input is the number of its threads: each takes every so many-th entry, so that capacity that is not
        used costs nothing. On the CPU it is one thread, because Warp's additions are not atomic there, or eight for
        each core for a kernel that runs ``on_cores``, see :func:`.launch_on_cores`. Of one that ``is_large``, two
        blocks a multiprocessor of a GPU, as more do not run at once for their registers.
        """
        threads = 8 * cores_for(kernel, self.device) if on_cores and self.device.is_cpu else self._threads
        threads = threads // 4 if is_large and self.device.is_cuda else threads
        launch_on_cores(kernel, threads, inputs=[*inputs, threads], device=self.device)

    def launch_over_constraints(self, kernel: wp.Kernel, *inputs) -> None:
        """Launches a kernel that takes all constraints, with the step as its first input, as in all that follow."""
        self.launch_over_entries(kernel, [self.step, *inputs])

    def launch_over_particles(self, kernel: wp.Kernel, *inputs, at_least_once: bool = False) -> None:
        """Launches a kernel over the particles; ``at_least_once`` even if there are none."""
        self.launch(kernel, max(self.particle_count, int(at_least_once)), [self.step, *inputs])

    def launch_over_bodies(self, kernel: wp.Kernel, *inputs) -> None:
        """Launches a kernel over the bodies, if they can be moved."""
        if self.body_count:
            self.launch(kernel, self.body_count, [self.step, *inputs])

    def launch_over_shape_vertices(self, kernel: wp.Kernel, *inputs) -> None:
        """Launches a kernel over the vertices of shapes, if bodies can be moved."""
        if self.body_count:
            self.launch(kernel, self.mesh.vertex_count - self.particle_count, [self.step, *inputs])
