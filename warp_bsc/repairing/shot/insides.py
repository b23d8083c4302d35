"""Moves the inside of tetrahedra with their repaired surfaces, without inverting any that the shot does not invert."""

from collections.abc import Container
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
from ..surface import Surface, differ
from .stretch import InnerVertices, ShotFrame

Moment = tuple[float, bool]
"""A time code, and whether the moment just before it is meant."""

_SWEEPS = 200
"""Sweeps that spread the displacements of surfaces to their insides."""
_SMALLEST, _INFLATIONS, _OVERSHOOT = 0.1, 100, 2.0
"""Volume that inner vertices are moved for, as a share of that in the shot, in at most so many Jacobi sweeps, and the
factor of their moves, which are means over tetrahedra."""
_ATTEMPTS = 8
"""Times that vertices of tetrahedra that invert are left as in the shot; after that, their bodies are."""
_BY_EDGE, _BY_FRAME = 1.0 / 16.0, 1.0 / 8.0
"""Growth of the share of the displacements that is kept around these, along an edge and from frame to frame."""


class Insides:
    """The tetrahedra of a segment. Arrays of n rows are of their vertices, in the spaces of their prims."""

    def __init__(
        self,
        scene: Scene,
        segment: Segment,
        is_movable: np.ndarray,
        given: np.ndarray,
        origin: np.ndarray,
        *,
        rigid: Container[str] = (),
        device: Any = None,
    ):
        """Finds the vertices inside surfaces.

        Positions ``given`` at some time are float64, shape [n, 3]; those of frames are relative to an ``origin`` in
        world space. Connected pieces of the meshes whose names are in ``rigid`` move as a whole.
        """
        tetrahedra, count, self._origin = segment.tetrahedra, len(given), origin
        self._corners, self._body = tetrahedra.corners, connect_cells(tetrahedra.corners, count)
        self._vertex = np.full(count, -1)  # of the segment; -1 inside surfaces
        self._parts, fixed, group = [], np.ones(count, dtype=bool), np.full(count, -1)
        for number, mesh in enumerate(segment.meshes):
            vertices = segment.vertices_of(number)
            if mesh.name in tetrahedra.points and is_movable[vertices].any():
                rows, points = tetrahedra.points[mesh.name]
                at = np.minimum(np.searchsorted(mesh.points, points), len(mesh.points) - 1)
                self._vertex[rows] = np.where(mesh.points[at] == points, vertices[at], -1)
                fixed[rows] = False
                group[rows] = self._body[rows] if mesh.name in rigid else -1
                self._parts.append((scene.prim_of(mesh.name), rows))
        mesh = CollisionMesh(np.zeros((0, 3), int), count, tets=self._corners, device=device)
        self._detector = CollisionDetector(mesh, method="exact")
        surface = Surface(mesh, given, fixed, tetrahedra=self._corners, rigid=group)
        self._edges, self._rigid = surface.edges, surface.rigid
        self._is_inner = (self._vertex < 0) & ~fixed
        self._springs = Springs(surface, self._is_inner)
        self._around = self._corners[self._is_inner[self._corners].any(axis=1)]

    def follow(
        self, frames: list[ShotFrame], given: list[np.ndarray], moments: list[Moment]
    ) -> tuple[list[ShotFrame], dict[str, list[float]]]:
        """Returns consecutive frames with what moves inside surfaces, and the times of each mesh at which it could not.

        Then, tetrahedra that would invert are as in the shot, and surfaces around them move less than contacts need.
        ``given`` are the positions in the shot at each frame, float64, shape [n, 3].
        """
        share, is_new, in_shot = np.ones((len(frames), len(self._body))), np.ones(len(frames), dtype=bool), {}
        found: dict[int, tuple[ShotFrame, np.ndarray]] = {}
        attempt = 0
        while is_new.any():
            for k in np.flatnonzero(is_new).tolist():
                found[k] = self._placed(frames[k], given[k], moments[k], share[k])
            inverts = self._inverting([found[k][1] for k in range(len(frames))], given, in_shot)
            if attempt < _ATTEMPTS:
                less = self._eased(np.where(inverts, 0.0, share))
            else:
                less = np.where(np.isin(self._body, self._body[inverts.any(axis=0)]), 0.0, share)
            is_new, share, attempt = (less != share).any(axis=1), less, attempt + 1
        is_moved = [differ(frame.x, frame.given)[self._vertex] for frame in frames]
        is_less: np.ndarray = (share < 1.0) & (self._vertex >= 0) & is_moved
        are_less = np.any(is_less, axis=1)
        certified = ~(are_less | np.append(False, are_less[:-1]))
        frames = [replace(found[k][0], certified=f.certified and bool(certified[k])) for k, f in enumerate(frames)]
        times = np.array([time for time, _ in moments])
        held = {prim.name: times[is_less[:, rows].any(axis=1)].tolist() for prim, rows in self._parts}
        return frames, {name: at for name, at in held.items() if at}

    def _placed(self, frame: ShotFrame, given: np.ndarray, moment: Moment, share: np.ndarray):
        """Returns a frame with a share of its moves, and the positions that a layer has, float64, shape [n, 3]."""
        on_surface = self._vertex >= 0
        if (share < 1.0).any():
            of_vertex = np.ones((len(frame.x), 1), np.float32)
            np.minimum.at(of_vertex[:, 0], self._vertex[on_surface], share[on_surface].astype(np.float32))
            less = frame.given + of_vertex * (frame.x - frame.given)
            frame = replace(frame, x=np.where(of_vertex < 1.0, less, frame.x))
        x, world = given.copy(), frame.x[self._vertex] + self._origin

        def place(is_moved: np.ndarray) -> None:
            for prim, rows in self._parts:
                moved = rows.start + np.flatnonzero(is_moved[rows])
                x[moved] = to_own_space(prim, world[moved], *moment)

        place(on_surface & differ(frame.x, frame.given)[self._vertex])
        inside = self._inside(x, given)
        moved = self._is_inner & differ(inside, given)
        for prim, rows in self._parts:
            transform = prim.read_transform(moment[0], before=moment[1])
            world[rows] = inside[rows] @ transform[:3, :3] + transform[3, :3]
        place(moved)
        inner = np.flatnonzero(moved)
        moves = np.linalg.norm(inside[inner] - given[inner], axis=1)
        return replace(frame, inner=InnerVertices(inner, world[inner], moves)), x

    def _inside(self, x: np.ndarray, given: np.ndarray) -> np.ndarray:
        """Returns positions in which the vertices inside surfaces follow, given those of the shot."""
        if (x == given).all():
            return x
        x = given + self._springs.spread(x - given, ~self._is_inner, _SWEEPS)
        if len(vertices := self._rigid.vertices):
            fitted = self._rigid.fitted(x, given, np.where(self._is_inner[vertices], 0.0, 1.0))
            x[vertices] = np.where(self._is_inner[vertices][:, None], fitted, x[vertices])
        volumes = _volumes(given[self._around])[0]
        corners, least = self._around[volumes > 0.0], _SMALLEST * volumes[volumes > 0.0]
        for _ in range(_INFLATIONS):
            volumes, slopes = _volumes(x[corners])
            (low,) = np.nonzero(volumes < least)
            if not len(low):
                break
            at, slopes = corners[low], slopes[low] * self._is_inner[corners[low]][:, :, None]
            moves, counts = np.zeros_like(x), np.bincount(at.ravel(), minlength=len(x))[:, None]
            steps = (least[low] - volumes[low]) / np.maximum((slopes**2).sum(axis=(1, 2)), 1e-30)
            np.add.at(moves, at, steps[:, None, None] * slopes)
            x = x + _OVERSHOOT * moves / np.maximum(counts, 1)
        return x

    def _inverting(self, x: list[np.ndarray], given: list[np.ndarray], in_shot: dict[int, np.ndarray]) -> np.ndarray:
        """Returns the vertices of tetrahedra that invert at frames, or on the way to the next, and not in the shot.

        ``in_shot`` gets the tetrahedra that invert in the shot, by the number of the frame, where others do.
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
        first, second = np.concatenate([self._edges, self._edges[:, ::-1]]).T
        by_vertex = share.T.copy()
        for _ in range(int(1.0 / _BY_EDGE)):
            np.minimum.at(by_vertex, first, by_vertex[second] + _BY_EDGE)
        share = by_vertex.T
        for _ in range(int(1.0 / _BY_FRAME)):
            share[1:] = np.minimum(share[1:], share[:-1] + _BY_FRAME)
            share[:-1] = np.minimum(share[:-1], share[1:] + _BY_FRAME)
        return share


def _volumes(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns six times the volumes of tetrahedra, and their gradients, given positions of shape [m, 4, 3]."""
    b, c, d = (x[:, i] - x[:, 0] for i in (1, 2, 3))
    slopes = np.cross(c, d), np.cross(d, b), np.cross(b, c)
    return np.einsum("ij,ij->i", d, slopes[2]), np.stack([-slopes[0] - slopes[1] - slopes[2], *slopes], axis=1)
