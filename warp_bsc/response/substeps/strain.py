"""How much contacts strain the elements of a model, and how many substeps follow from that."""

import newton
import numpy as np
import warp as wp

from ..schedule import Loop, SolveStatus
from ..state.structs import Motion
from ..tuning import COMPRESSION, STRAIN

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


@wp.kernel
def choose_substeps(
    # in
    strain: wp.array[float],
    choices: wp.array[int],
    # in and out
    status: SolveStatus,
    # out
    number: wp.array[int],
    is_chosen: wp.array[int],
    substeps: wp.array[int],
):
    """Chooses the number of substeps of each world, 0 where contacts strain little; ``substeps`` is the largest."""
    world = wp.tid()
    status.loop[Loop.RECOUNT] = 0  # the start remains where crossings are counted
    predicted = strain[world] / STRAIN
    number[world] = 0
    if predicted > 1.0:
        choice = int(0)
        while choice < choices.shape[0] - 1 and float(choices[choice]) < predicted:
            choice += 1
        number[world] = choices[choice]
        is_chosen[choice] = 1
        wp.atomic_max(substeps, 0, choices[choice])


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
