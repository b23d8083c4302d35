"""How much a step strains the elements of a model."""

import newton
import numpy as np
import warp as wp

from ..state.structs import Motion
from ..state.workspace import Workspace
from ..tuning import COMPRESSION, SOLID

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
    const unsigned mask = __activemask();
    int same;
    __match_all_sync(mask, world, &same);
    if (same) {
        const unsigned most = __reduce_max_sync(mask, __float_as_uint(value));
        return (threadIdx.x & 31) == __ffs(mask) - 1 ? __uint_as_float(most) : 0.0f;
    }
#endif
    return value;
"""
)
def _largest_of_warp(value: float, world: int) -> float:
    """Returns the largest value, none negative, of a warp in one world to one of its threads, and 0 to the others."""
    ...


@wp.kernel
def measure_strain(
    # in
    motion: Motion,
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    edges: wp.array[wp.vec2i],
    lengths: wp.array[float],
    is_solid: wp.array[bool],
    # out
    strain: wp.array[float],
):
    """Finds the largest strain of an edge from positions ``before`` to those ``after``, in each world.

    Cloth that is compressed buckles, and resists less than cloth that is stretched: a quarter of its compression
    counts, and of the strain of a solid a third.
    """
    i = wp.tid()
    a = edges[i][0]
    b = edges[i][1]
    start = wp.length(before[a] - before[b])
    length = wp.length(after[a] - after[b])
    change = wp.max(length - wp.max(start, lengths[i]), COMPRESSION * (wp.min(start, lengths[i]) - length))
    if is_solid[i]:
        change = SOLID * wp.abs(length - start)
    largest = _largest_of_warp(wp.where(change > 0.0, change / lengths[i], 0.0), motion.world[a])
    if largest > 0.0:  # few atomic operations: those on one number wait for each other
        wp.atomic_max(strain, motion.world[a], largest)


class StrainMeter:
    """Measures how much contacts strain the triangles, tetrahedra and springs of a model."""

    def __init__(self, work: Workspace):
        """Copies the edges of a model and their lengths at rest to the device."""
        self._work = work
        columns = zip(edges_at_rest(work.mesh.model), (wp.vec2i, float, bool), strict=True)
        self._edges = [wp.array(values, dtype=dtype, device=work.device) for values, dtype in columns]

    def measure(self, motion: Motion, before: wp.array[wp.vec3], strain: wp.array[float]) -> None:
        """Increases ``strain``, shape [worlds], to that from positions ``before`` to positions as they are.

        The positions are those that the inner solver predicted, or those at the start of the motion.
        """
        inputs = [motion, before, self._work.vertices.x1, *self._edges]
        self._work.launch(measure_strain, len(self._edges[0]), inputs, [strain])


def edges_at_rest(model: newton.Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns edges of triangles, springs and tetrahedra, their lengths at rest [m], and which are of tetrahedra."""
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
    if model.spring_count:
        assert model.spring_indices is not None and model.spring_rest_length is not None
        rest = model.spring_rest_length.numpy().astype(np.float64)
        springs = np.sort(model.spring_indices.numpy().reshape(-1, 2), axis=1)
        kinds.insert(1, (springs[rest > 0.0], rest[rest > 0.0]))
    edges, of_edge = np.unique(np.concatenate([edges for edges, _ in kinds]), axis=0, return_inverse=True)
    lengths, is_solid = np.zeros(len(edges)), np.zeros(len(edges), dtype=bool)
    np.maximum.at(lengths, of_edge.ravel(), np.concatenate([lengths for _, lengths in kinds]))
    is_solid[of_edge.ravel()[len(of_edge.ravel()) - len(kinds[-1][0]) :]] = True
    return edges, lengths, is_solid
