"""Spreads displacements over the frames before and after those that need them, smoothly."""

import numpy as np

BLEND = 4
"""Intervals over which a displacement grows before a collision, and fades after it."""
_SMOOTHINGS = 2
"""Times that displacements are averaged with those of the frames before and after."""
MARGIN = BLEND + _SMOOTHINGS
"""Intervals by which a displacement precedes and outlasts what needs it."""


def blend(displacements: np.ndarray) -> np.ndarray:
    """Returns displacements, shape [frames, n, 3], that grow before those given, and fade after them.

    The one of a vertex at a frame is the largest of those at the frames around it, each weighted by a smooth step that
    falls to 0 over :data:`BLEND` frames, then averaged over neighbouring frames. The first frame keeps its own.
    """
    given, count = displacements.astype(np.float32), len(displacements)
    size = np.linalg.norm(given, axis=2)
    blended, largest = np.zeros_like(given), np.zeros_like(size)
    for shift in range(-BLEND, BLEND + 1):
        share = 1.0 - abs(shift) / (BLEND + 1)
        weight = np.float32(share * share * (3.0 - 2.0 * share))
        for frame in range(max(0, -shift), min(count, count - shift)):
            is_larger = weight * size[frame + shift] > largest[frame]
            largest[frame, is_larger] = weight * size[frame + shift, is_larger]
            blended[frame, is_larger] = weight * given[frame + shift, is_larger]
    for _ in range(_SMOOTHINGS):
        blended[1:-1] = 0.25 * blended[:-2] + 0.5 * blended[1:-1] + 0.25 * blended[2:]
    blended[0] = displacements[0]
    return blended
