"""Positions of a mesh at one time from those at the time before: near given ones, and reached without a collision."""

import functools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ...detection.arcs.rigid_motion import RigidMotion, points_on_arcs
from ...detection.detector import CollisionDetector
from ...detection.mesh import CollisionMesh
from ...detection.run.launch import launch, launch_in_turn
from ..contacts import Contacts, as_contacts, projected
from ..elastic import Springs
from ..surface import Surface
from .follow_kernels import find_directions, smooth
from .stretch import ShotFrame, edge_ratios

if TYPE_CHECKING:
    from .playback import Playback

_SWEEPS = 64, 16, 8
"""Sweeps that spread the displacements by contacts over the mesh, one number after the other."""
_DETECTIONS = 16
"""Detections after which a step is delegated to the stage."""
_PROJECTIONS = 20
"""Sweeps over the contacts after each detection."""
_FITS = 4
"""Times that contacts are moved apart and rigid groups are fitted, in turn."""
_GAP = 0.005
"""Distance that contacts are moved apart, as a share of the median edge length: a larger one pushes sheets that lie on
each other into the next ones."""
_REACH = 0.07
"""Distance, as a share of that length, from which a contact of the frame before is none."""
_PEAK = 0.5
"""Weight that stays at a single vertex after one sweep, times the number of sweeps: on a triangle mesh, the peak of the
Gaussian falls with their number."""
_SMALLEST = 1e-4
"""Displacement, as a share of that length, that is none: a contact does not reach all of a mesh."""
_EARLIEST = 0.06
"""Time of a contact on an arc, as a share of the step: an earlier one is resolved as one at this time."""
_STRAINED = 0.095
"""Strain of an edge, as a logarithm, from which on springs relax a frame, and twice what they leave."""
_RELAXATIONS, _RELAXING = 16, {"sweeps": 40, "slack": 0.5 * _STRAINED, "momentum": 0.8}
"""Detections, and what springs do before each."""
_FAILURES = 5
"""Detections with collisions after which the vertices that collide stay where they were; all, if a distance is kept."""
_RINGS = 10
"""Edges around displaced vertices within which springs move others."""
_TIMES = 9
"""Times from a contact on an arc on at which it is looked how far the elements would pass through each other."""


class Follower:
    """Moves a mesh from positions that are free to others near given ones.

    Contacts are moved apart, which would strain the edges around them. So their displacements are spread over the mesh,
    first widely, then less, and added to the given positions: the neighbourhood of a contact moves with it, and keeps
    the shape that it has in the given positions. All contacts that are known stay apart meanwhile, so that few are new
    in the next detection, which looks at the vertices alone whose motion has changed. What contacts strain all the same
    is relaxed by springs. What still collides after many detections is delegated to :class:`warp_bsc.SolverCCD`.

    Attributes:
        mesh: The mesh.
        edges: Vertices of the edges of the movable part, the smaller first, shape [n, 2].
        length: Median length of these at the start.
    """

    def __init__(
        self,
        mesh: CollisionMesh,
        x: np.ndarray,
        is_movable: np.ndarray,
        *,
        rigid: np.ndarray | None = None,
        min_distance: float = 0.0,
    ):
        """Prepares detection.

        Args:
            mesh: The mesh. Pairs that its groups and masks leave out are not kept apart.
            x: Positions at the start, float32, shape [vertex_count, 3].
            is_movable: Whether each vertex may be displaced, bool, shape [vertex_count]; others move as given.
            rigid: Group of each vertex that keeps the shape it has in the given positions, -1 for none, int, shape
                [vertex_count]; default: none.
            min_distance: Distance that pairs keep, see :class:`warp_bsc.SolverCCD`.
        """
        self.mesh, self._is_movable, self._device = mesh, is_movable, mesh.device
        self.edges = edges = mesh.edges[is_movable[mesh.edges].all(axis=1)].astype(np.int64)
        lengths = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
        self.length = float(np.median(lengths)) if len(lengths) else 1.0
        self._rigid, self._x, self._min_distance = rigid, x, min_distance
        self._gaps = {CollisionDetector(mesh): _GAP * self.length}
        if min_distance:
            detector = CollisionDetector(mesh, min_distance=min_distance)
            self._gaps[detector] = min_distance + _GAP * self.length
        both = np.concatenate([edges, edges[:, ::-1]])
        order = np.argsort(both[:, 0], kind="stable")
        first = np.concatenate([[0], np.cumsum(np.bincount(both[:, 0], minlength=len(x)))])
        self._first = wp.array(first, dtype=int, device=self._device)
        self._neighbours = wp.array(both[order, 1], dtype=int, device=self._device)
        self._values = wp.empty(len(x), dtype=wp.vec4, device=self._device)
        self._smoothed = wp.empty_like(self._values)

    def follow(
        self,
        start: np.ndarray,
        given: np.ndarray,
        displacement: np.ndarray,
        *,
        tolerance: float,
        known: Contacts,
        free_start: np.ndarray | None = None,
        arcs: RigidMotion | None = None,
    ) -> ShotFrame:
        """Returns positions near given ones that a straight motion reaches without a collision.

        Args:
            start: Positions at the start of the motion, float32, shape [vertex_count, 3].
            given: Positions to follow, float32, shape [vertex_count, 3]. Vertices that no response displaces get these
                bit for bit.
            displacement: Displacements to begin with, float, shape [vertex_count, 3].
            tolerance: Displacement by contacts, as a share of the median edge length, that is not spread: the
                neighbourhood need not follow.
            known: Contacts to keep apart from the first detection on.
            free_start: Positions from which the straight motion to the given ones is known to be free, so that only
                vertices that move otherwise are looked at; None if it is not known.
            arcs: The obstacles that turn on their way and how; None if all move straight.
        """
        tolerance *= self.length
        best: tuple[float, ShotFrame] | None = None
        sweeps = list(_SWEEPS)
        target = _displaced(given, displacement)
        x, changed = self._moved_apart(target, given, known), self._is_movable
        if free_start is not None:
            changed = (start != free_start).any(axis=1) | (x.astype(np.float32) != given).any(axis=1)
        for number in range(_DETECTIONS):
            x = x.astype(np.float32)
            contacts, touched = self._contacts(start, x, changed, arcs)
            is_free = not touched.any()
            if is_free:
                unspread = float(np.linalg.norm(x.astype(np.float64) - target, axis=1).max(initial=0.0))
                if best is None or unspread < best[0]:
                    best = unspread, ShotFrame(given, x, displacement, True, known, arcs)
                if unspread < tolerance or not sweeps:
                    break
            elif not len(contacts.toi):
                break
            known = Contacts.joined([known, contacts])
            last, x = x, self._moved_apart(target, given, known)
            while sweeps and (is_free or number == 0):
                residual = x - target
                if np.linalg.norm(residual, axis=1).max(initial=0.0) < tolerance:
                    break
                spread = self._spread_out(residual, sweeps.pop(0))
                displacement = displacement + spread
                target = _displaced(given, displacement)
                x = self._moved_apart(target, given, known)
            changed = touched | (x.astype(np.float32) != last).any(axis=1)
        if best is not None:
            return best[1]
        x, certified = self._playback.step(start, x.astype(np.float32))
        if certified and arcs is not None:  # the stage knows the chords alone
            _, touched = self._contacts(start, x, self._is_movable, arcs)
            certified = not touched.any()
        return ShotFrame(given, x, displacement, certified, known, arcs)

    def relax(self, before: ShotFrame, frame: ShotFrame, after: ShotFrame | None) -> tuple[ShotFrame, ShotFrame | None]:
        """Returns a frame that springs, which rest in the shot, have relaxed, and the frame after it.

        The frames before and after it stay where they are, and the motions from one and to the other are certified. If
        they were not, any positions with which they are will do.
        """
        is_free = frame.certified and (after is None or after.certified)
        largest, total = self._strain(frame)
        if is_free and largest < _STRAINED:
            return frame, after
        # Both motions lead to the frame: that to the frame after it backwards, which passes the same positions.
        motions = [(before.x, frame.arcs), *([] if after is None else [(after.x, None)])]
        springs, known = self._springs, frame.contacts
        springs.rest_at(frame.given.astype(np.float64), self.length)
        displaced = np.asarray((frame.x != frame.given).any(axis=1))
        displaced[known.vertices] = True
        moving, failures = (around := springs.around(displaced, _RINGS)), 0
        for _ in range(_FAILURES if self._min_distance else _RELAXATIONS):
            x = springs.relax(frame.x.astype(np.float64), contacts=known, around=moving, **_RELAXING)
            x = self._moved_apart(x, frame.given, known, moving).astype(np.float32)
            changed, collide = (x != frame.x).any(axis=1) if is_free else self._is_movable, np.zeros_like(moving)
            for start, arcs in motions:
                contacts, touched = self._contacts(start, x, changed, arcs)
                known, collide = Contacts.joined([known, contacts]), collide | touched
            if after is not None and after.arcs is not None:  # whose contacts are those of the chords
                collide |= self._contacts(x, after.x, changed, after.arcs)[1]
            if collide.any():
                failures += 1
                if is_free and failures >= _FAILURES:
                    moving = moving & ~collide
                continue
            relaxed = replace(frame, x=x, certified=True)
            largest, remaining = self._strain(relaxed)
            if is_free and remaining >= total:
                break
            frame, total, is_free = relaxed, remaining, True
            if after is not None:
                after = replace(after, certified=True)
            if largest < _STRAINED:
                break
            moving, failures = around, 0
        return frame, after

    def _strain(self, frame: ShotFrame) -> tuple[float, float]:
        """Returns the largest strain of an edge, as a logarithm, and the sum of what springs would relax of all."""
        strains = np.abs(np.log(np.maximum(edge_ratios(frame, self.edges, self.length), 1e-9)))
        return float(strains.max(initial=0.0)), float(np.maximum(strains - 0.5 * _STRAINED, 0.0).sum())

    def near(self, contacts: Contacts, x: np.ndarray) -> Contacts:
        """Returns the contacts of a frame whose elements are still near each other at its end, with directions there.

        ``x`` are the positions at its end, which are free, float32, shape [vertex_count, 3].
        """
        at = self.mesh.device_positions(x, "x")
        contacts = self._directed(contacts.latest(), at, at)
        ends = x[contacts.vertices].astype(np.float64)
        distance = np.einsum("ik,ikj,ij->i", contacts.weights, ends, contacts.normals)
        are_near = (distance > 0.0) & (distance < self._min_distance + _REACH * self.length)
        return replace(contacts, gap=np.minimum(contacts.gap, distance)).rows(are_near)

    def _moved_apart(self, x, given, known: Contacts, moving=None) -> np.ndarray:
        """Returns positions, float64 or ``x`` itself, with contacts moved apart and rigid groups as in given ones."""
        movable, groups = self._is_movable if moving is None else moving, self._surface.rigid
        vertices = groups.vertices
        for _ in range(_FITS if len(vertices) else 1):
            before = x
            if len(known.toi):
                x = projected(~movable, x.astype(np.float64), known, _PROJECTIONS, device=self._device)
            if len(vertices):
                x = groups.carried(x, given, (x != before).any(axis=1))
                x = groups.placed(x, given, np.finfo(np.float32).eps * np.abs(x[vertices]))
        return x

    def _contacts(self, start, target, changed, arcs) -> tuple[Contacts, np.ndarray]:
        """Returns the contacts of a motion that can be moved apart, and which vertices collide or come too near.

        Pairs that start too near are delegated to the stage, which lets them come no nearer. Those of which no vertex
        is movable do not count, nor do those of which none is changed.
        """
        x0, x1 = self.mesh.device_positions(start, "start"), self.mesh.device_positions(target, "target")
        found, touched = [], np.zeros(len(target), dtype=bool)
        for detector, gap in self._gaps.items():
            contacts = as_contacts(detector.mesh, detector.detect(x0, x1, vertices=changed, rigid_motion=arcs), gap)
            contacts = contacts.rows(np.asarray(self._is_movable[contacts.vertices].any(axis=1)))
            touched[contacts.vertices] = True
            found.append(contacts.rows(contacts.toi > 0.0) if detector.min_distance else contacts)
        contacts = Contacts.joined(found)
        if arcs is None:
            return self._directed(contacts, x0, x1), touched
        turning = np.any(arcs.body[contacts.vertices] >= 0, axis=1)
        straight = self._directed(contacts.rows(~turning), x0, x1)
        return Contacts.joined([straight, _on_arcs(contacts.rows(turning), arcs, start, target)]), touched

    def _directed(self, contacts: Contacts, x0: wp.array, x1: wp.array) -> Contacts:
        """Returns contacts of a motion with the closest points, and the directions between them, a moment before.

        At the time itself the normal of a contact at a border, as of an edge that passes a vertex, may be far from the
        way that parts the two.
        """
        count = len(contacts.toi)
        if not count:
            return contacts
        types = {"vertices": wp.vec4i, "are_of_edges": wp.bool, "toi": wp.float64, "gap": wp.float64}
        types |= {"weights": wp.vec4d, "normals": wp.vec3d}
        arrays = [wp.array(getattr(contacts, name), dtype=t, device=self._device) for name, t in types.items()]
        *inputs, weights, normals = arrays
        launch(find_directions, count, inputs=[x0, x1, *inputs], outputs=[weights, normals], device=self._device)
        return replace(contacts, weights=weights.numpy(), normals=normals.numpy())

    @functools.cached_property
    def _surface(self) -> Surface:
        return Surface(self.mesh, self._x, ~self._is_movable, rigid=self._rigid)

    @functools.cached_property
    def _springs(self) -> Springs:
        # a shot that passes through itself often has folds that it cannot keep
        return Springs(self._surface, self._is_movable, bending=0.0)

    @functools.cached_property
    def _playback(self) -> "Playback":
        from .playback import Playback  # noqa: PLC0415 (Newton takes seconds, and few shots need it)

        return Playback(self.mesh, self._x, self._is_movable, self._min_distance)

    def _spread_out(self, displacement, sweeps) -> np.ndarray:
        """Returns the displacements of some vertices, and of those around them.

        Sweeps make a Gaussian of the displacements and one of their weights, and the quotient counts: where many
        vertices are displaced it is their mean, and around a single one it decreases with the distance.
        """
        weights = (displacement != 0.0).any(axis=1, keepdims=True)
        self._values.assign(np.concatenate([displacement, weights], axis=1).astype(np.float32))
        inputs, values = [self._first, self._neighbours], [self._values, self._smoothed]
        smoothed = launch_in_turn(smooth, len(weights), sweeps, inputs=inputs, values=values).numpy()
        spread = (smoothed[:, :3] / np.maximum(smoothed[:, 3:], np.float32(_PEAK / sweeps))).astype(np.float64)
        spread[~self._is_movable | (np.linalg.norm(spread, axis=1) < _SMALLEST * self.length)] = 0.0
        return spread


def _on_arcs(contacts: Contacts, arcs: RigidMotion, x0: np.ndarray, x1: np.ndarray) -> Contacts:
    """Returns contacts of a motion with a turning vertex, with the distances that they are to have at its end.

    At the time of a contact on an arc the chords may be apart. Where the elements are nearest on the rest of the way,
    along the normal, the movable side is to be farther: as it moves straight, it ends farther by that over the time.
    """
    gap, toi = contacts.gap, contacts.toi

    def distances(time: np.ndarray) -> np.ndarray:
        at = points_on_arcs(arcs, x0, x1, contacts.vertices, time[:, None])
        return np.einsum("ik,ikj,ij->i", contacts.weights, at, contacts.normals)

    needed = gap / np.maximum(toi, _EARLIEST)
    for time in (toi + share * (1.0 - toi) for share in np.linspace(0.0, 1.0, _TIMES)):
        needed = np.maximum(needed, (gap - distances(time)) / np.maximum(time, _EARLIEST))
    return replace(contacts, gap=np.maximum(gap, distances(np.ones(len(toi))) + needed))


def _displaced(given, displacement) -> np.ndarray:
    """Returns displaced positions in single precision; those without a displacement keep every bit."""
    is_displaced = displacement.any(axis=1, keepdims=True)
    return np.where(is_displaced, (given + displacement).astype(np.float32), given)
