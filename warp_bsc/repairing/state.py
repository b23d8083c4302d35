"""Repairs a state of a Newton model: a legal start, in which nothing crosses and nothing is inside shapes."""

from collections.abc import Sequence
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from .._arguments import check_instance, checked_distance, checked_number
from ..detection.mesh import CollisionMesh
from ..response.report.inside import Inside
from .arguments import checked_sets
from .free import search
from .model_surface import ModelSurface
from .results import RepairResult, describe
from .sheets import joined_sheets


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
    sheet = None if order is None else checked_sets(order, "order", count)
    distance = checked_distance(min_distance, "min_distance")
    strain = checked_number(max_strain, "max_strain", 0.0, above=True)
    surface = ModelSurface(model, state, distance)
    if sheet is not None:
        others = np.full(len(surface.home) - count, -1)
        sheet = joined_sheets(np.append(sheet, others), surface.weld)
    before, after, chosen = search(surface, strain, sheet=sheet)
    x = surface.positions(after.x)
    if after is not before:
        assert state.particle_q is not None
        state.particle_q.assign(x[:count])
    return StateRepairResult(
        **describe(surface, before, after, chosen, count),
        x=x[:count],
        inside_before=len(before.inside),
        inside=surface.particles_inside(after.x),
        inverted_before=len(surface.inverted(before.x)),
        inverted=len(surface.inverted(after.x)),
        mesh=surface.given,
    )
