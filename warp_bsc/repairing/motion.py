"""Certified motions of a surface: as far towards a goal as contacts allow, and apart to a minimum distance; faults."""

import functools
from dataclasses import replace

import numpy as np

from .contacts import Contacts, as_contacts, projected
from .surface import Surface, differ

_PROJECTIONS = 6
"""Detections after which contacts no longer slide, but stop."""
_DETECTIONS = 40
"""Detections after which nothing moves."""
_GAP = 2.0**-7
"""Gap that contacts leave, in edges of the median length, or the shortest ones of their vertices."""
_MORE_DISTANCE = 1.0 + 2.0**-7
"""Distance at which contacts with a minimum distance are put, as a multiple of it."""
_KEPT_TIME = 0.8
"""Share of the time to a contact after which a vertex stops."""
_LEAST_TIME = 0.05
"""Shares of the way that are less count as 0, so that the search for a motion ends."""
_PATIENCE = 4
"""Pushes that come no nearer to the distances after which the search ends."""


class Faults:
    """What is wrong with positions.

    Attributes:
        x: Positions, in units of the surface, shape [n, 3].
        crossings: What crosses and counts, (edge, face), shape [m, 2].
        inside: Vertices inside solids, int.
    """

    def __init__(self, surface: Surface, x: np.ndarray):
        """Finds them."""
        self._surface, self.x = surface, x
        self.crossings, self.inside = surface.counted(surface.crossings(x)), surface.inside(x)

    @functools.cached_property
    def near(self) -> np.ndarray:
        """Pairs that are at most the minimum distance apart, by a number for each."""
        return near_pairs(self._surface, self.x)

    @property
    def count(self) -> int:
        """Number of crossings and of vertices inside solids."""
        return len(self.crossings) + len(self.inside)

    def __bool__(self) -> bool:
        """Whether there is anything to repair."""
        return bool(self.count or len(self.near))

    def are_fewer(self, before: "Faults") -> bool:
        """Whether less is wrong than before, and no more crosses."""
        are_less = (self.count, len(self.near)) < (before.count, len(before.near))
        return are_less and len(self.crossings) <= len(before.crossings)


def move_freely(
    surface: Surface, start: np.ndarray, goal: np.ndarray, *, slides: bool = True, together: bool = False
) -> tuple[np.ndarray, Contacts]:
    """Returns positions on the way to a goal that are reached without a collision, and the contacts on the way.

    At first contacts are projected: they slide, and leave a gap. Later each vertex stops before its first contact, or
    contacts slide as long as they get fewer, and all vertices stop together: the second if the first ends nowhere.
    Pairs that keep the minimum distance at the start keep it.

    Args:
        surface: The surface.
        start: Positions, in units, shape [n, 3].
        goal: Likewise, as rounded to the type of the input.
        slides: Whether contacts slide at first.
        together: Whether that is tried first.
    """
    near = near_pairs(surface, start)
    for are_joint in (together, not together)[: 1 + slides]:
        x, known, count = goal, [Contacts.none()], 0
        for detection in range(_DETECTIONS):
            before, contacts = count, _contacts(surface, start, x, near)
            count = len(contacts.toi)
            if not count:
                return x, Contacts.joined(known)
            known.append(contacts)
            if slides and (detection < _PROJECTIONS or (are_joint and count < before)):
                x = pushed(surface, x, Contacts.joined(known))
            else:
                kept = np.ones(len(start))
                np.minimum.at(kept, contacts.vertices.ravel(), np.repeat(_KEPT_TIME * contacts.toi, 4))
                kept = surface.rigid.least(np.where(kept < _LEAST_TIME, 0.0, kept))
                x = start + (kept.min() if are_joint else kept[:, None]) * (x - start)
            if surface.is_late or (x == start).all():
                break
            x = surface.rounded(x)
    return start, Contacts.joined(known)


def push_apart(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns positions that lack the least of the distances to keep of those that are reached without a collision."""
    best, least, since = x, np.inf, 0
    while since < _PATIENCE and not surface.is_late:
        near = _near_contacts(surface, x)
        between = np.einsum("ij,ijk->ik", near.weights, x[near.vertices])
        lacking = float((near.gap - np.einsum("ij,ij->i", between, near.normals)).sum())
        since += 1
        if lacking < least:
            best, least, since = x, lacking, 0
        if not len(near.keys):
            break
        x, _ = move_freely(surface, x, surface.rounded(pushed(surface, x, near)))
    return best


def pushed(surface: Surface, x: np.ndarray, contacts: Contacts) -> np.ndarray:
    """Returns positions at which contacts have their gaps, nearly; rigid groups follow their vertices in contact."""
    moved = projected(surface.fixed, x, contacts, device=surface.device)
    return surface.rigid.carried(moved, surface.home, differ(moved, x))


def near_pairs(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns a number for each pair that is at most the minimum distance apart at positions in units, int64."""
    return _near_contacts(surface, x).keys if surface.keeps_distance else np.zeros(0, dtype=np.int64)


def _near_contacts(surface: Surface, x: np.ndarray) -> Contacts:
    """Returns the pairs that are at most the minimum distance apart at positions in units, as contacts."""
    positions = surface.detected(x)
    found = surface.distance_detector.detect(positions, positions)
    contacts = _between_bodies(surface, as_contacts(surface.mesh, found))
    return replace(contacts, gap=_distances(surface, contacts))


def _distances(surface: Surface, contacts: Contacts) -> np.ndarray:
    """Returns the distance at which the elements of each contact are put, more than the one that they keep, [n]."""
    distance = np.full(len(contacts.toi), surface.min_distance)
    if surface.radius is not None:
        radii = surface.radius[contacts.vertices]
        is_second = np.arange(4) >= 1 + contacts.are_of_edges[:, None]
        distance += np.where(is_second, 0.0, radii).max(axis=1) + np.where(is_second, radii, 0.0).max(axis=1)
    return _MORE_DISTANCE * distance


def _between_bodies(surface: Surface, contacts: Contacts) -> Contacts:
    """Returns the contacts that are not within one rigid group, whose shape cannot change."""
    return contacts.rows(~surface.are_of_one(surface.rigid.of, contacts.vertices))


def contacts_at(surface: Surface, x: np.ndarray, held: np.ndarray) -> Contacts:
    """Returns the pairs with held vertices that are near at positions in units, as contacts."""
    positions = surface.detected(x)
    found = as_contacts(surface.mesh, surface.reach_detector.detect(positions, positions, vertices=held))
    found = _between_bodies(surface, found.rows(np.asarray(held[found.vertices].any(axis=1))))
    return _with_gaps(surface, found, near_pairs(surface, x))


def _contacts(surface: Surface, start: np.ndarray, goal: np.ndarray, near: np.ndarray) -> Contacts:
    """Returns the contacts of a motion between positions in units; pairs at rest stay as they are.

    ``near`` are the keys of the pairs that do not keep the minimum distance at the start: they must only not touch.
    """
    x0, x1 = surface.detected(start), surface.detected(goal)
    contacts = as_contacts(surface.mesh, surface.detector.detect(x0, x1))
    if surface.keeps_distance:
        too_near = as_contacts(surface.mesh, surface.distance_detector.detect(x0, x1))
        too_near = too_near.rows(~np.isin(too_near.keys, near))
        contacts = Contacts.joined([contacts.rows(~np.isin(contacts.keys, too_near.keys)), too_near])
    moves = differ(start, goal)
    contacts = _between_bodies(surface, contacts.rows(np.asarray(moves[contacts.vertices].any(axis=1))))
    return _with_gaps(surface, contacts, near)


def _with_gaps(surface: Surface, contacts: Contacts, near: np.ndarray) -> Contacts:
    """Returns contacts with the distances that they are to have: the minimum distance, unless they are near ones."""
    # short edges would be strained by the gap of longer ones
    gap = _GAP * surface.shortest[contacts.vertices].min(axis=1)
    if surface.keeps_distance:
        gap = np.where(np.isin(contacts.keys, near), gap, _distances(surface, contacts))
    return replace(contacts, gap=gap)
