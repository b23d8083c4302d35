"""How much contacts strain the elements of a model, and how many substeps follow from that."""

import newton
import numpy as np
import warp as wp

from ..schedule import Loop, SolveStatus
from ..state.structs import Motion
from ..state.workspace import Workspace
from ..tuning import (
    CALM_STEPS,
    COMPRESSION,
    FORGOTTEN,
    IMPACT_SUBSTEPS,
    KEPT,
    LASTING,
    LOWERED,
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
def _take_more(n: int, calm: wp.array[int], fewest: wp.array[int], world: int):
    """Ends a trial of ``n`` substeps, which failed and are not tried again at rest; else a rest that is over."""
    fewest[world] = wp.where(calm[world] < 0, n + 1, 0)
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
    own_strain: wp.array[float],
    strain: wp.array[float],
    has_constraints: wp.array[int],
    choices: wp.array[int],
    # in and out
    status: SolveStatus,
    number: wp.array[int],
    calm: wp.array[int],
    fewest: wp.array[int],
    lasting: wp.array[float],
    # out
    is_chosen: wp.array[int],
    substeps: wp.array[int],
    largest: wp.array[float],
):
    """Chooses the substeps of each world that has none, 0 where it is strained little; ``substeps`` are the most."""
    world = wp.tid()
    status.loop[Loop.RECOUNT] = 0  # the start remains where crossings are counted
    if number[world] == 0:
        most = own_strain[world]
        if has_constraints[world] == 1 and not _lasts(strain[world], lasting, world):
            most = wp.max(most, strain[world])
        if most > WHOLE_STRAIN:
            number[world] = wp.max(IMPACT_SUBSTEPS, _choice(choices, most / STRAIN))
            mark_choice(choices, number[world], is_chosen, substeps)
            _take_more(0, calm, fewest, world)
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
    has_constraints: wp.array[int],
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
    if passes[0] <= MAX_REPEATS and (
        too_few or (missed > 2.0 and (missed < MAX_MISSED or has_constraints[world] == 0))
    ):
        number[world] = wp.max(n, _choice(choices, predicted))
        is_pending[world] = 1
        repeats[0] = 1
        mark_choice(choices, number[world], is_chosen, substeps)
    else:
        largest[world] = wp.max(strain[world], final_strain[world])


@wp.kernel
def predict_substeps(
    # in
    own_strain: wp.array[float],
    strain: wp.array[float],
    final_strain: wp.array[float],
    choices: wp.array[int],
    # in and out
    number: wp.array[int],
    calm: wp.array[int],
    fewest: wp.array[int],
    lasting: wp.array[float],
):
    """Predicts the substeps of the next step in each world that took some, by the strain of this step.

    They become fewer slowly, half as many once a number of steps needed less than half of them: with another
    number, elements come to rest elsewhere, and the difference sets them in motion. A number that soon turns out to be
    too small is not tried again until the world needs more than it came from, or nothing touches.
    """
    world = wp.tid()
    n = number[world]
    if n > 0:
        final = final_strain[world]
        predicted = wp.max(_predicted(n, strain[world]), wp.where(_lasts(final, lasting, world), 0.0, final / STRAIN))
        predicted = wp.max(predicted, own_strain[world] / STRAIN)
        fewer = _choice(choices, 0.5 * float(n))
        if predicted > float(n):
            number[world] = _choice(choices, predicted)
            _take_more(n, calm, fewest, world)
        elif predicted >= KEPT * float(n):
            calm[world] = wp.min(calm[world] + 1, 0)
        elif calm[world] < CALM_STEPS or fewer < fewest[world]:
            calm[world] += 1
        else:
            number[world] = fewer
            calm[world] = -CALM_STEPS


class StrainMeter:
    """Measures how much contacts strain the triangles, tetrahedra and springs of a model."""

    def __init__(self, work: Workspace):
        """Copies the edges of a model and their lengths at rest to the device."""
        self._work = work
        columns = zip(edges_at_rest(work.mesh.model), (wp.vec2i, float, bool), strict=True)
        self._edges = [wp.array(values, dtype=dtype, device=work.device) for values, dtype in columns]

    def measure(self, motion: Motion, strain: wp.array[float], *, own: bool = False) -> None:
        """Increases ``strain`` to that between predicted positions and positions as they are, of each world.

        Args:
            motion: The motion, as the inner solver predicted it.
            strain: Shape [worlds].
            own: Whether to measure the prediction itself, from the start of the motion on.
        """
        ends = (motion.x0, motion.x1) if own else (motion.x1, self._work.vertices.x1)
        self._measure(motion, *ends, strain)

    def measure_step(self, motion: Motion, strain: wp.array[float]) -> None:
        """Increases ``strain`` to that from the start of a motion to positions as they are, of each world."""
        self._measure(motion, motion.x0, self._work.vertices.x1, strain)

    def _measure(self, motion, before, after, strain):
        self._work.launch(measure_strain, len(self._edges[0]), [motion, before, after, *self._edges], [strain])


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
