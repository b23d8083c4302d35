"""Takes a surface back towards its input along a certified path, as near as contact and strain allow."""

import numpy as np

from .contacts import Contacts
from .elastic import Springs
from .motion import contacts_at, move_freely, pushed
from .surface import Surface

_ROUNDS = 60
_LEAP = 4.0
"""Largest way of a round towards the input, in edges: from far, all springs relax after each."""
_FAR = 32.0
"""Way to the input, in edges, on which no vertex stays behind those around it: springs would not bring it back in time.
"""
_MOMENTUM, _MOMENTUM_FAR = 0.8, 0.9
_SWEEPS, _MORE_SWEEPS = 40, 160
"""Sweeps of a round in which strains are below the limit at its start, and above it; as many more after each round
that comes no nearer."""
_RINGS = 10
"""Edges around vertices in contact within which springs move others."""
_SETTLED = 2.0**-10
"""Move, in edges, below which the approach ends."""
_PROGRESS = 0.98
"""Share of the strain above the limit, or of the moves once there is none, to which a round must come down."""
_PATIENCE = 8
"""Rounds that do not, after which the approach ends; one if strains are below the limit."""
_SMALL = 0.03
"""Move, in edges, that in the end is taken back where that meets nothing."""
_SOUGHT = 0.5
"""Strain that springs leave, as a share of the limit."""


def approach(surface: Surface, x: np.ndarray, springs: Springs, max_strain: float, rounds: int = _ROUNDS) -> np.ndarray:
    """Returns positions near the input that can be reached from a start without a collision, in units, shape [n, 3].

    What is free to go returns to its input. What contact keeps from it takes its neighbours along until strains are
    below the limit. Meanwhile known contacts keep their elements apart, so that a motion meets few others. Of the
    positions passed, the result has the least strain above the limit, then the least moves.

    Of the start ``x``, what crosses there may cross in the end, nothing else. The springs are those of the vertices
    that may move. It ends after ``rounds`` motions.
    """
    best, score = x, score_of(surface, x, max_strain)
    best_score = score
    held, stalled, contacts, nearest = np.zeros(len(x), dtype=bool), 0, Contacts.none(), np.inf
    for _ in range(rounds):
        goal = np.where(held[:, None], x, surface.home)
        farthest = np.abs(goal - x).max(initial=0.0)
        is_far = farthest > _LEAP * surface.edge
        if is_far:
            goal = x + _LEAP * surface.edge / farthest * (goal - x)
        is_relaxed = is_far or bool(held.any())
        if is_relaxed:
            # planes of earlier positions would keep pairs from places that are free
            known = Contacts.joined([contacts, contacts_at(surface, x, held)]).latest()
            goal = springs.relax(
                goal,
                _MORE_SWEEPS * (1 + stalled) if score[0] else _SWEEPS,
                _SOUGHT * max_strain,
                momentum=_MOMENTUM_FAR if is_far else _MOMENTUM,
                contacts=known,
                around=None if is_far else springs.around(held, _RINGS),
            )
            goal = pushed(surface, goal, known)
        goal = surface.rounded(goal)
        if _are_near(x, goal, surface.edge):
            break
        start, (x, contacts) = x, move_freely(surface, x, goal, together=farthest > _FAR * surface.edge)
        if is_relaxed and not is_far and not _are_near(x, goal, surface.edge):
            # what one contact has stopped early is strained, and goes on beside the others
            x, more = move_freely(surface, x, goal)
            contacts = Contacts.joined([contacts, more])
        held[contacts.vertices] = True
        score = score_of(surface, x, max_strain)
        is_nearer = is_far and farthest < _PROGRESS * nearest
        nearest = min(nearest, farthest)
        stalled = 0 if is_nearer or _is_better(best_score, score) else stalled + 1
        if score < best_score:
            best, best_score = x, score
        if _are_near(start, x, surface.edge) or stalled >= (_PATIENCE if score[0] else 1) or surface.is_late:
            break
    goes_home = surface.moves(best) < _SMALL * surface.edge
    while True:
        goal = surface.rounded(np.where(goes_home[:, None], surface.home, best))
        strained = surface.strained(goal, max_strain)
        if not goes_home[strained].any():
            sent, _ = move_freely(surface, best, goal, slides=False)
            return sent if score_of(surface, sent, max_strain) < best_score else best
        goes_home[strained] = False


def _are_near(start: np.ndarray, end: np.ndarray, edge: float) -> bool:
    """Returns whether no vertex moves by more than a small share of an edge."""
    return bool(np.abs(end - start).max(initial=0.0) < _SETTLED * edge)


def score_of(surface: Surface, x: np.ndarray, max_strain: float) -> tuple[float, float]:
    """Returns the strain above the limit and the sum of squared moves, in units: less is better."""
    return max(surface.strain(x) - max_strain, 0.0), float((surface.moves(x) ** 2).sum())


def _is_better(before: tuple[float, float], after: tuple[float, float]) -> bool:
    """Returns whether a score is much better than another one."""
    if before[0] or after[0]:
        return after[0] < _PROGRESS * before[0]
    return after[1] < _PROGRESS * before[1]
