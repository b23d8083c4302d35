"""Moves the inside of tetrahedra with their repaired surfaces, without inverting any that the shot does not invert."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from ...detection.at_rest.body_parts import connect_cells
from ...detection.detector import CollisionDetector
from ...detection.mesh import CollisionMesh
from ...usd.scene import Scene
from ...usd.segment import Segment
from ...usd.write.points_layer import to_own_space
from ..elastic import Springs
from ..surface import Surface
from .stretch import InnerVertices, ShotFrame

Moment = tuple[float, bool]
"""A time code, and whether the moment just before it is meant."""

_SWEEPS = 200
"""Sweeps that spread the displacements of surfaces to their insides."""
_SHRINKING, _SHRINKINGS = 0.5, 8
"""Factor of the displacements around tetrahedra that invert, and how often; after that, their body stays in its place.
"""
_BY_EDGE, _BY_FRAME = 0.125, 0.25
"""Largest difference between the shares of displacements that are left, along an edge, and from frame to frame."""


class Insides:
    """The tetrahedra of a segment. Arrays of n rows are of their vertices, in the spaces of their prims."""

    def __init__(self, scene: Scene, segment: Segment, is_movable: np.ndarray, given: np.ndarray, device: Any):
        """Finds the vertices inside surfaces.

        Args:
            scene: The scene.
            segment: The segment.
            is_movable: Whether each vertex of the segment may be moved, bool.
            given: Positions at some time, float64, shape [n, 3].
            device: Warp device.
        """
        tetrahedra = segment.tetrahedra
        self._corners = tetrahedra.corners
        self._vertex = np.full(len(given), -1)  # of the segment; -1 inside surfaces
        self._parts, is_inner = [], np.zeros(len(given), dtype=bool)
        for number, mesh in enumerate(segment.meshes):
            vertices = segment.vertices_of(number)
            if mesh.name in tetrahedra.points and is_movable[vertices].any():
                rows, points = tetrahedra.points[mesh.name]
                at = np.minimum(np.searchsorted(mesh.points, points), len(mesh.points) - 1)
                self._vertex[rows] = np.where(mesh.points[at] == points, vertices[at], -1)
                is_inner[rows] = self._vertex[rows] < 0
                self._parts.append((scene.prim_of(mesh.name), rows))
        mesh = CollisionMesh(np.zeros((0, 3), int), len(given), tets=self._corners, device=device)
        self._detector = CollisionDetector(mesh, method="exact")
        surface = Surface(mesh, given, ~is_inner, tetrahedra=self._corners)
        self._edges, self._springs = surface.edges, Springs(surface, is_inner)
        self._body = connect_cells(self._corners, len(given))

    def follow(
        self, frames: list[ShotFrame], given: list[np.ndarray], moments: list[Moment], origin: np.ndarray
    ) -> tuple[list[ShotFrame], dict[str, list[float]]]:
        """Returns consecutive frames with what moves inside surfaces, and where it could not follow.

        There, around tetrahedra that would invert, surfaces are moved less than contacts need.

        Args:
            frames: The frames, whose surfaces are repaired.
            given: Positions in the shot at each, float64, shape [n, 3].
            moments: The moment of each.
            origin: The point in world space that the positions of frames are relative to.

        Returns:
            The frames, and by the name of a mesh the times at which it is moved less.
        """
        shot = list(zip(frames, given, moments, strict=True))
        moves = []
        for frame, x, moment in shot:
            _, on_surface = self._placed(frame, x, moment, np.zeros_like(x), np.ones(len(x)), origin)
            moves.append(self._springs.spread(on_surface - x, ~self._springs.movable, _SWEEPS))
        share, in_shot = np.ones((len(shot), len(self._body))), {}
        for attempt in itertools.count():
            found = [self._placed(*one, *how, origin) for one, *how in zip(shot, moves, share, strict=True)]
            inverts = self._inverting([x for _, x in found], given, in_shot)
            if not inverts.any():
                break
            if attempt < _SHRINKINGS:
                share = self._eased(np.where(inverts, _SHRINKING * share, share))
            else:
                share[:, np.isin(self._body, self._body[inverts.any(axis=0)])] = 0.0
        is_less = (share < 1.0) & np.array([move.any(axis=1) for move in moves])
        are_less = is_less.any(axis=1)
        after_less = are_less | np.append(False, are_less[:-1])
        frames = [replace(f, certified=f.certified and not less) for (f, _), less in zip(found, after_less, strict=True)]
        times = np.array([time for time, _ in moments])
        held = {prim.name: times[is_less[:, rows].any(axis=1)].tolist() for prim, rows in self._parts}
        return frames, {name: at for name, at in held.items() if at}

    def _placed(
        self,
        frame: ShotFrame,
        given: np.ndarray,
        moment: Moment,
        moves: np.ndarray,
        share: np.ndarray,
        origin: np.ndarray,
    ) -> tuple[ShotFrame, np.ndarray]:
        """Returns a frame with a share of its moves, and the positions that a layer has, float64, shape [n, 3]."""
        on_surface = self._vertex >= 0
        if (share < 1.0).any():
            of_vertex = np.ones(len(frame.x), np.float32)
            np.minimum.at(of_vertex, self._vertex[on_surface], share[on_surface].astype(np.float32))
            less = frame.given + of_vertex[:, None] * (frame.x - frame.given)
            frame = replace(frame, x=np.where(of_vertex[:, None] < 1.0, less, frame.x))
        moves = moves * share[:, None]
        is_moved = np.where(on_surface, (frame.x != frame.given).any(axis=1)[self._vertex], moves.any(axis=1))
        placed, world = given.copy(), np.where(on_surface[:, None], frame.x[self._vertex] + origin, 0.0)
        for prim, rows in self._parts:
            own = np.arange(rows.start, rows.stop)[is_moved[rows]]
            inner = own[~on_surface[own]]
            transform = prim.read_transform(moment[0], before=moment[1])
            world[inner] = (given[inner] + moves[inner]) @ transform[:3, :3] + transform[3, :3]
            placed[own] = to_own_space(prim, world[own], *moment)
        (inner,) = np.nonzero(is_moved & ~on_surface)
        lengths = np.linalg.norm(moves[inner], axis=1)
        return replace(frame, inner=InnerVertices(inner, world[inner], lengths)), placed

    def _inverting(
        self, x: list[np.ndarray], given: list[np.ndarray], in_shot: dict[int, np.ndarray]
    ) -> np.ndarray:
        """Returns the vertices of tetrahedra that invert at frames, or on the way to the next, and not in the shot.

        Args:
            x: Positions at each frame.
            given: Those of the shot.
            in_shot: The tetrahedra that invert in the shot, by the number of the frame; those that are found are added.
        """
        inverts = np.zeros((len(x), len(self._body)), dtype=bool)
        for start in range(max(1, len(x) - 1)):
            end = min(start + 1, len(x) - 1)
            found = self._detector.inversions(x[start], x[end]).tets
            if len(found):
                if start not in in_shot:
                    in_shot[start] = self._detector.inversions(given[start], given[end]).tets
                inverts[start : end + 1, self._corners[np.setdiff1d(found, in_shot[start])]] = True
        return inverts

    def _eased(self, share: np.ndarray) -> np.ndarray:
        """Returns shares that change slowly along edges and from frame to frame, none larger than it was."""
        ends, by_vertex = self._edges[:, [[0, 1], [1, 0]]].transpose(1, 2, 0).reshape(2, -1), share.T.copy()
        for _ in range(int(1.0 / _BY_EDGE)):
            np.minimum.at(by_vertex, ends[0], by_vertex[ends[1]] + _BY_EDGE)
        share = by_vertex.T
        for _ in range(int(1.0 / _BY_FRAME)):
            share[1:] = np.minimum(share[1:], share[:-1] + _BY_FRAME)
            share[:-1] = np.minimum(share[:-1], share[1:] + _BY_FRAME)
        return share
