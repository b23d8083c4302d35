"""How far each world came in a solve."""

import warp as wp

from ...kernels.pipeline.queues import has_overflowed
from .system import Progress, is_near_end

wp.set_module_options({"enable_backward": False})


@wp.struct
class StepResults:
    """How far each world came in a step, shape [worlds], see :class:`..report.ImplicitStepReport`."""

    newton_steps: wp.array[int]
    last_change: wp.array[float]
    converged: wp.array[wp.bool]
    arrived: wp.array[wp.bool]


@wp.kernel
def note_overflow(counts: wp.array[wp.int64], capacities: wp.array[wp.int64], lacks: wp.array[int]):
    """Notes whether candidates did not fit, as can be in a CUDA graph."""
    if has_overflowed(counts, capacities):
        lacks[0] = 1


@wp.kernel
def write_results(
    # in
    progress: Progress,
    dt: float,
    least_speed: float,
    # in and out
    lacks: wp.array[int],
    # out
    results: StepResults,
    unconverged_steps: wp.array[wp.int64],
):
    """Writes what each world did in a solve, and counts the step if one did not converge.

    The first of ``lacks`` is 1 if candidates or contacts did not fit; the second becomes 1 once the step is counted.
    """
    w = wp.tid()
    arrived = progress.remaining[w] == 0.0 or progress.scale[w] == 1.0
    converged = arrived and lacks[0] == 0 and is_near_end(progress, w, least_speed * dt)
    converged = wp.isfinite(progress.change[w]) and (progress.steps[w] == 0 or converged)
    results.newton_steps[w] = progress.steps[w]
    results.last_change[w] = progress.change[w] / dt
    results.arrived[w] = arrived
    results.converged[w] = converged
    if not converged and wp.atomic_max(lacks, 1, 1) == 0:
        unconverged_steps[0] += wp.int64(1)
