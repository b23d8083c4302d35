"""How much contacts strain the elements of a model, and how many substeps follow from that."""

import newton
import numpy as np
import warp as wp

from ..schedule import Loop, SolveStatus
from ..state.structs import Motion
from ..state.workspace import Workspace
from ..tuning import (
    COMPRESSION,
    FORGOTTEN,
    FREE_STEPS,
    KEPT,
    LASTING,
    LOWERED,
    MAX_CALM_STEPS,
    MAX_MISSED,
    MAX_REPEATS,
    SOLID,
    STRAIN,
    SUBSTEP_STRAIN,
    WHOLE_STRAIN,
)
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
    """Finds the largest strain of an edge between predicted positions and ``x1`` in each world.

    Cloth that is compressed buckles, and resists less than cloth that is stretched: a quarter of its compression
    counts, and of the strain of a solid a third.
    """
    i = wp.tid()
    a = edges[i][0]
    b = edges[i][1]
    predicted = wp.length(motion.x1[a] - motion.x1[b])
    length = wp.length(x1[a] - x1[b])
    change = wp.max(length - wp.max(predicted, lengths[i]), COMPRESSION * (wp.min(predicted, lengths[i]) - length))
    if is_solid[i]:
        change = SOLID * wp.abs(length - predicted)
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


@wp.func
def _lose_calm(calm: wp.array[int], patience: wp.array[int], world: int):
    """Doubles the calm steps that a world needs for fewer substeps, if it has soon needed more again."""
    if calm[world] < 0:
        patience[world] = wp.min(2 * patience[world], MAX_CALM_STEPS)
    calm[world] = 0


@wp.func
def _lasts(strain: float, lasting: wp.array[float], world: int) -> bool:
    """Returns whether a strain is one that substeps do not lower, as they did not before; forgets what is past."""
    known = lasting[world]
    lasting[world] = wp.max(wp.min(known, strain), (1.0 - FORGOTTEN) * known)
    return strain <= LASTING * known


@wp.kernel
def choose_substeps(
    # in
    strain: wp.array[float],
    has_constraints: wp.array[int],
    choices: wp.array[int],
    # in and out
    status: SolveStatus,
    number: wp.array[int],
    calm: wp.array[int],
    patience: wp.array[int],
    lasting: wp.array[float],
    # out
    is_chosen: wp.array[int],
    substeps: wp.array[int],
    largest: wp.array[float],
):
    """Chooses the substeps of each world that has none, 0 where contacts strain little; ``substeps`` are the most."""
    world = wp.tid()
    status.loop[Loop.RECOUNT] = 0  # the start remains where crossings are counted
    if number[world] == 0 and has_constraints[world] == 1:
        n = int(0)
        if not _lasts(strain[world], lasting, world) and strain[world] > WHOLE_STRAIN:
            n = _choice(choices, strain[world] / STRAIN)
        number[world] = n
        if n > 0:
            mark_choice(choices, n, is_chosen, substeps)
            _lose_calm(calm, patience, world)
        else:
            largest[world] = strain[world]


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
    missed_strain: wp.array[float],
    lasting: wp.array[float],
    # out
    is_pending: wp.array[int],
    is_chosen: wp.array[int],
    substeps: wp.array[int],
    repeats: wp.array[int],
    largest: wp.array[float],
):
    """Repeats the substeps of worlds whose strain asks for more than twice as many.

    So it does where contacts that the substeps did not know strain an element after them: they know these then. If they
    strain it too far, what was found is not what is to be met, and elements would stick to it. A strain that is still
    there after that lasts: it is not tried again until it grows.
    """
    world = wp.tid()
    n = number[world]
    is_pending[world] = 0
    if n == 0:
        return
    predicted = _predicted(n, strain[world])
    final = final_strain[world]
    if passes[0] > 1 and final > LOWERED * missed_strain[world]:
        lasting[world] = wp.max(lasting[world], final)
    missed_strain[world] = final
    missed = wp.where(final <= LASTING * lasting[world], 0.0, final / STRAIN)
    too_few = predicted > 2.0 * float(n) and n < choices[choices.shape[0] - 1]
    if passes[0] <= MAX_REPEATS and (too_few or (missed > 2.0 and missed < MAX_MISSED)):
        number[world] = wp.max(n, _choice(choices, predicted))
        is_pending[world] = 1
        repeats[0] = 1
        mark_choice(choices, number[world], is_chosen, substeps)
    else:
        largest[world] = wp.max(strain[world], final_strain[world])


@wp.kernel
def predict_substeps(
    # in
    strain: wp.array[float],
    final_strain: wp.array[float],
    choices: wp.array[int],
    # in and out
    number: wp.array[int],
    calm: wp.array[int],
    patience: wp.array[int],
    lasting: wp.array[float],
):
    """Predicts the substeps of the next step in each world that took some, by the strain of this step.

    They become fewer slowly, half as many once a number of steps needed less than half of them: with another
    number, elements come to rest elsewhere, and the difference sets them in motion.
    """
    world = wp.tid()
    n = number[world]
    if n > 0:
        final = final_strain[world]
        predicted = wp.max(_predicted(n, strain[world]), wp.where(_lasts(final, lasting, world), 0.0, final / STRAIN))
        if predicted > float(n):
            number[world] = _choice(choices, predicted)
            _lose_calm(calm, patience, world)
        elif predicted >= KEPT * float(n):
            calm[world] = wp.min(calm[world] + 1, 0)
        elif calm[world] < patience[world]:
            calm[world] += wp.where(predicted > 0.0, 1, FREE_STEPS)
        else:
            number[world] = _choice(choices, 0.5 * float(n))
            calm[world] = -patience[world]


class StrainMeter:
    """Measures how much contacts strain the triangles, tetrahedra and springs of a model."""

    def __init__(self, work: Workspace):
        """Copies the edges of a model and their lengths at rest to the device."""
        self._work = work
        columns = zip(edges_at_rest(work.mesh.model), (wp.vec2i, float, bool), strict=True)
        self._edges = [wp.array(values, dtype=dtype, device=work.device) for values, dtype in columns]

    def measure(self, motion: Motion, strain: wp.array[float]) -> None:
        """Increases ``strain`` to that between predicted positions and positions as they are, of each world.

        Args:
            motion: The motion, as the inner solver predicted it.
            strain: Shape [worlds].
        """
        self._work.launch(measure_strain, len(self._edges[0]), [motion, self._work.vertices.x1, *self._edges], [strain])


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
