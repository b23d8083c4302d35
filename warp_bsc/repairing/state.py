"""Repairs a state of a Newton model: a legal start, in which nothing crosses and nothing is inside shapes."""

from collections.abc import Sequence
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from .._arguments import check_instance, checked_distance, checked_number
from ..detection.mesh import CollisionMesh
from ..response.report.inside import Inside
from .arguments import checked_sheets
from .free import free, restore_parts
from .model_surface import ModelSurface
from .motion import near_pairs
from .results import RepairResult
from .sheets import separate_sheets
from .tetrahedra import are_inverted, follow_surface, restore_inverted
from .unresolved import unresolved_contours


@dataclass(frozen=True, eq=False)
class StateRepairResult(RepairResult):
    """The result of :func:`warp_bsc.repair_state`. Rows of arrays are particles.

    Pairs of which no vertex can move do not count: two shapes, or what is kinematic.

    Attributes:
        inside_before: Number of particles inside rigid shapes, soft bodies and the solids of infinite planes in the
            input; one that is inside several counts for each.
        inside: Those in ``x``, see :class:`warp_bsc.response.report.inside.Inside`.
        inverted_before: Number of tetrahedra whose volume is not positive in the input.
        inverted: Number of those in ``x``. A tetrahedron that has a positive volume keeps one.
        mesh: The mesh of ``UnresolvedContour.elements``: the particles, then the vertices of shapes, then four for each
            infinite plane and world.
    """

    inside_before: int
    inside: Inside
    inverted_before: int
    inverted: int
    mesh: CollisionMesh


def repair_state(
    model: newton.Model,
    state: newton.State,
    *,
    order: np.ndarray | wp.array | Sequence | None = None,
    min_distance: float = 0.0,
    max_strain: float = 0.1,
) -> StateRepairResult:
    """Moves particles of a state, as little as it finds, so that nothing crosses: a legal start for a simulation.

    Cloth and the surfaces of soft bodies leave themselves, each other, and rigid shapes; particles inside rigid shapes
    and behind infinite planes leave these. Kinematic and inactive particles, shapes and bodies stay. Tetrahedra do not
    invert. The positions are written to the state, unless none are found that cross less; what need not move keeps
    every bit::

        state = model.state()
        result = bsc.repair_state(model, state)
        print(result.crossings_before, result.crossings, result.moved.max())

    Particles at borders that have the same position are one: the two sides of a seam do not part. Velocities stay.

    Args:
        model: The model.
        state: The state, which is changed.
        order: Which sheets of particles are inside which, as for :func:`warp_bsc.repair`.
        min_distance: Distance that pairs keep [m], as for :class:`warp_bsc.SolverCCD`: 0 or at least 2^-1021. With one,
            springs without triangles and single particles take part. What is nearer is moved apart as far as that is
            possible; ``result.near`` tells.
        max_strain: Largest change of the length of an edge that is sought, as a share of its length in the state, more
            than 0. The result may exceed it where nothing else is free.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If a position is not finite, or an argument has another shape or is out of range.
        NotImplementedError: If the model has shapes that are not supported, see :class:`.state.mesh.ModelMesh`.
    """
    check_instance(model, "model", newton.Model, "a newton.Model")
    check_instance(state, "state", newton.State, "a newton.State")
    count = model.particle_count
    sheet = None if order is None else checked_sheets(order, count)
    distance = checked_distance(min_distance, "min_distance")
    strain = checked_number(max_strain, "max_strain", 0.0, above=True)
    placed = ModelSurface(model, state, np.full(count, -1) if sheet is None else sheet, distance)
    surface, weld = placed.surface, placed.weld
    before = _Faults(placed, surface.home)
    after = _repaired(placed, before, sheet, strain) if before else before
    x = placed.positions(after.x)
    if after is not before:
        assert state.particle_q is not None
        state.particle_q.assign(x[:count])
    return StateRepairResult(
        x=x[:count],
        certified=not len(after.crossings) and not len(after.inside) and bool(np.isin(after.near, before.near).all()),
        crossings_before=len(before.crossings),
        crossings=len(after.crossings),
        near_before=len(before.near),
        near=len(after.near),
        moved=(surface.moves(after.x)[weld] * surface.unit)[:count],
        max_strain=surface.strain(after.x),
        unresolved=unresolved_contours(surface, placed.mesh, weld, after.crossings),
        order=None,
        inside_before=len(before.inside),
        inside=after.inside,
        inverted_before=before.inverted,
        inverted=after.inverted,
        mesh=placed.mesh,
    )


class _Faults:
    """What is wrong with positions.

    Attributes:
        x: Positions, in units of the surface, shape [n, 3].
        crossings: (edge, face) of the surface, shape [m, 2].
        inside: Particles inside solids.
        near: Pairs that are nearer than the minimum distance.
        inverted: Number of inverted tetrahedra.
    """

    def __init__(self, placed: ModelSurface, x: np.ndarray):
        """Finds them."""
        self.x = x
        self.crossings, self.inside = placed.crossings(x), placed.inside(x)
        self.near = near_pairs(placed.surface, x)
        self.inverted = int(are_inverted(placed.positions(x), placed.tetrahedra).sum())

    def __bool__(self) -> bool:
        """Whether there is anything to repair; inverted tetrahedra alone stay."""
        return bool(len(self.crossings) or len(self.inside) or len(self.near))

    @property
    def counts(self) -> tuple[int, int]:
        """Crossings and particles inside solids; pairs that are too near."""
        return len(self.crossings) + len(self.inside), len(self.near)

    def are_no_more(self, before: "_Faults") -> bool:
        """Whether nothing is worse than before."""
        are_fewer = len(self.crossings) <= len(before.crossings) and self.inverted <= before.inverted
        return are_fewer and self.counts <= before.counts


def _repaired(placed: ModelSurface, before: _Faults, sheet: np.ndarray | None, max_strain: float) -> _Faults:
    """Returns the best positions that are found, the input if these are not better.

    What is deep inside a solid may leave it only as a whole: that is tried if the way out of its particles is not free.
    """
    surface, best = placed.surface, before
    start = surface.home if sheet is None else separate_sheets(surface, placed.sheet, surface.home)
    for whole in (False, True) if len(before.inside) else (False,):
        outside, movable = placed.leave_solids(start, whole=whole)
        movable = movable if sheet is None else ~surface.fixed
        x = free(surface, outside, surface.crossings(outside), max_strain, movable=movable)
        if len(placed.tetrahedra):
            x = restore_inverted(surface, follow_surface(surface, x, placed.tetrahedra), placed.tetrahedra)
        found = _Faults(placed, x)
        if found:
            inside = placed.weld[before.inside.particles], placed.weld[found.inside.particles]
            restored = _Faults(placed, restore_parts(surface, x, (before.crossings, found.crossings), inside))
            if restored.are_no_more(before):
                found = restored
        if found.are_no_more(before) and found.counts < best.counts:
            best = found
        if not best:
            break
    return best
