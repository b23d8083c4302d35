"""How much contacts strain the elements of a model, and how many substeps follow from that."""

import newton
import numpy as np
import warp as wp

from ..schedule import Loop, SolveStatus
from ..state.structs import Motion
from ..tuning import COMPRESSION, MAX_REPEATS, STRAIN, SUBSTEP_STRAIN
from .kernels import mark_choice

wp.set_module_options({"enable_backward": False})


@wp.kernel
def measure_strain(
    # in
    motion: Motion,
    x1: wp.array[wp.vec3],
    edges: wp.array[wp.vec2i],
    lengths: wp.array[float],
    is_solid: wp.array[bool],
    # out
    strain: wp.array[float],
):
    """Finds the largest strain of an edge, in each world, between predicted positions and ``x1``.

    Cloth that is compressed buckles, and resists less than cloth that is stretched: a quarter of its compression
    counts.
    """
    i = wp.tid()
    a = edges[i][0]
    b = edges[i][1]
    predicted = wp.length(motion.x1[a] - motion.x1[b])
    length = wp.length(x1[a] - x1[b])
    change = wp.max(length - wp.max(predicted, lengths[i]), COMPRESSION * (wp.min(predicted, lengths[i]) - length))
    if is_solid[i]:
        change = wp.abs(length - predicted)
    if change > 0.0:
        wp.atomic_max(strain, motion.world[a], change / lengths[i])


@wp.func
def _choice(choices: wp.array[int], predicted: float) -> int:
    """Returns the smallest number of substeps that is not less than the predicted one; 0 for one step."""
    if not predicted > 1.0:
        return 0
    choice = int(0)
    while choice < choices.shape[0] - 1 and float(choices[choice]) < predicted:
        choice += 1
    return choices[choice]


@wp.kernel
def choose_substeps(
    # in
    strain: wp.array[float],
    has_constraints: wp.array[int],
    choices: wp.array[int],
    # in and out
    status: SolveStatus,
    number: wp.array[int],
    # out
    is_chosen: wp.array[int],
    substeps: wp.array[int],
    largest: wp.array[float],
):
    """Chooses the substeps of each world that has none, 0 where contacts strain little; ``substeps`` is the largest."""
    world = wp.tid()
    status.loop[Loop.RECOUNT] = 0  # the start remains where crossings are counted
    if number[world] == 0 and has_constraints[world] == 1:
        n = _choice(choices, strain[world] / STRAIN)
        number[world] = n
        if n > 0:
            mark_choice(choices, n, is_chosen, substeps)
        else:
            wp.atomic_max(largest, 0, strain[world])


@wp.func
def _predicted(n: int, strain: float) -> float:
    """Returns how many substeps a step should have had that was taken in ``n``, with this strain in one of them."""
    return float(n) * strain / (SUBSTEP_STRAIN * STRAIN)


@wp.kernel
def review_substeps(
    # in
    strain: wp.array[float],
    final_strain: wp.array[float],
    choices: wp.array[int],
    passes: wp.array[int],
    # in and out
    number: wp.array[int],
    # out
    is_pending: wp.array[int],
    is_chosen: wp.array[int],
    substeps: wp.array[int],
    repeats: wp.array[int],
    largest: wp.array[float],
):
    """Repeats the substeps of worlds whose strain asks for twice as many; of others, predicts those of the next step.

    So it does where contacts that the substeps did not know strain an element after them: they know these then.
    """
    world = wp.tid()
    n = number[world]
    is_pending[world] = 0
    if n == 0:
        return
    predicted = float(n) * strain[world] / (SUBSTEP_STRAIN * STRAIN)
    missed = final_strain[world] / STRAIN
    too_few = predicted > 2.0 * float(n) and n < choices[choices.shape[0] - 1]
    if passes[0] <= MAX_REPEATS and (too_few or missed > 2.0):
        number[world] = wp.max(n, _choice(choices, predicted))
        is_pending[world] = 1
        repeats[0] = 1
        mark_choice(choices, number[world], is_chosen, substeps)
    else:
        wp.atomic_max(largest, 0, wp.max(strain[world], final_strain[world]))


@wp.kernel
def predict_substeps(
    # in
    strain: wp.array[float],
    final_strain: wp.array[float],
    choices: wp.array[int],
    # in and out
    number: wp.array[int],
):
    """Predicts the substeps of the next step in each world that took some, by the strain of this step."""
    world = wp.tid()
    n = number[world]
    if n > 0:
        predicted = float(n) * strain[world] / SUBSTEP_STRAIN
        number[world] = _choice(choices, wp.max(predicted, final_strain[world]) / STRAIN)


def edges_at_rest(model: newton.Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns edges of triangles and tetrahedra, their lengths at rest [m], and which are of tetrahedra."""
    kinds = []
    for indices, poses, n in ((model.tri_indices, model.tri_poses, 3), (model.tet_indices, model.tet_poses, 4)):
        elements = np.zeros((0, n), dtype=int) if indices is None else indices.numpy().reshape(-1, n)
        inverse = np.zeros((0, n - 1, n - 1)) if poses is None else poses.numpy().astype(np.float64)
        valid = np.linalg.det(inverse) != 0.0
        sides = np.linalg.inv(inverse[valid])  # from the first vertex to the others, in columns
        x = np.concatenate([np.zeros_like(sides[:, :, :1]), sides], axis=2)
        a, b = np.triu_indices(n, k=1)
        edges = np.sort(elements[valid][:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1)
        kinds.append((edges, np.linalg.norm(x[:, :, a] - x[:, :, b], axis=1).ravel()))
    edges, of_edge = np.unique(np.concatenate([edges for edges, _ in kinds]), axis=0, return_inverse=True)
    lengths, is_solid = np.zeros(len(edges)), np.zeros(len(edges), dtype=bool)
    np.maximum.at(lengths, of_edge.ravel(), np.concatenate([lengths for _, lengths in kinds]))
    is_solid[of_edge.ravel()[len(kinds[0][0]) :]] = True
    return edges, lengths, is_solid
