"""The proximities at one time of a scene: pairs of elements up to the clearance apart."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..detection.at_rest.proximities import Proximities
from ..detection.mesh import CollisionMesh
from ..usd.segment import Segment
from ..usd.selection import Selection
from .scene_pairs import NEAR, NO_PAIRS, ScenePairs, are_stiff, name_elements


@dataclass(frozen=True)
class SceneProximities(ScenePairs):
    """The proximities at one time of a scene; positions are halfway between the closest points of the two elements.

    Attributes:
        time: Time code.
        distance: Distances, in the scene's unit of length, shape [n].
    """

    time: float
    distance: np.ndarray

    BY_PAIR: ClassVar[tuple[str, ...]] = (*ScenePairs.BY_PAIR, "distance")

    @property
    def phase(self) -> np.ndarray:
        """Index in :data:`~warp_bsc.scene_replay.scene_pairs.ALL_PHASES`, shape [n]."""
        return np.full(len(self), NEAR)


def name_proximities(
    segment: Segment, mesh: CollisionMesh, found: Proximities, time: float, selection: Selection
) -> SceneProximities:
    """Names the proximities that are checked by prims and elements.

    Excluded are pairs that the selection excludes or ignores, and pairs of a mesh with itself if only its transform
    moves it. Meshes that never move are checked. Arguments are those of :func:`.name_intersections`.
    """
    if not len(found.distance):
        return SceneProximities(segment, **NO_PAIRS, time=time, distance=np.zeros(0))
    vertices, faces = found.vertex_face.T.astype(np.int64)
    ends = mesh.edges[found.edge_edge].astype(np.int64)
    named = name_elements(segment, vertices, faces, ends)
    meshes = named["meshes"]
    counted = selection.counted_pairs(segment.meshes, meshes) & ~selection.ignored_pairs(segment.meshes, meshes)
    counted &= ~are_stiff(segment, vertices, meshes[: len(vertices), 1], ends)
    arrays = named | {"position": found.position, "distance": found.distance}
    return SceneProximities(segment, **{name: array[counted] for name, array in arrays.items()}, time=time)
