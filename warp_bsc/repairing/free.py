"""The search of a repair: untangles a surface, or parts or smooths its pieces, and returns towards the input."""

from collections.abc import Callable

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from .approach import approach, score_of
from .elastic import Springs, follow_surface, near
from .motion import Faults, push_apart
from .part import Part
from .sheets import separate_sheets
from .surface import Surface, differ, sums
from .untangle import untangle

_RINGS = 10
"""Edges around vertices that are pushed apart within which others may follow."""
_OFFSET = 0.1
"""Distance by which layers that lie on each other leave each other, in edges."""
_FAR = 4.0
"""Move, in edges, above which another order of pieces is tried, which may be nearer."""
_ROUNDS_CROSSING, _ROUNDS_OF_ORDER = 8, 2
"""Motions of returns that are hardly the result, of what still crosses or of a part, and of those that tell which order
is the nearer."""
_FARTHER = 2.0
"""Squared moves at the start of an order, as a multiple of those that free the other one, above which it is not tried.
"""
_FLATTEST = 0.01
"""Length of the sum of normals around a vertex, as a share of that of their lengths, below which it has no normal."""
_SWEEPS, _DOUBLINGS = 8, 10
"""Sweeps after which a smoothed surface is looked at first, and how often they are doubled."""


def search(
    surface: Surface, max_strain: float, *, history: np.ndarray | None = None, sheet: np.ndarray | None = None
) -> tuple[Faults, Faults, np.ndarray]:
    """Returns what is wrong with the input, and with the best positions that are found, the input if none are better.

    Args:
        surface: The surface.
        max_strain: Largest strain that is sought, as in the other functions.
        history: Positions at which nothing crosses, in units, shape [n, 3]; default: none.
        sheet: Sheet of each vertex from inside to outside, -1 for none, int, shape [n]; default: not known.

    Returns:
        Both, and the sheet of each vertex in an order that was chosen, see :func:`free_by_order`.
    """
    before, chosen = Faults(surface, surface.home), np.full(len(surface.home), -1)
    if not before:
        return before, before, chosen
    if history is None and sheet is None and (found := _found_in_part(surface, before, max_strain)) is not None:
        return before, found, chosen
    after = Faults(surface, _found(surface, before, max_strain, history, sheet, chosen))
    if after.count:
        restored = Faults(surface, _restored(surface, before, after))
        if len(restored.crossings) <= len(before.crossings):
            after = restored
    if after.are_fewer(before) and not surface.is_wrecked(after.x):
        return before, after, chosen
    return before, before, np.full_like(chosen, -1)


def _found_in_part(surface: Surface, before: Faults, max_strain: float) -> Faults | None:
    """Returns what is wrong with positions, only what is fixed, that a search of a part alone gives; None for none."""
    part = Part.around(surface, before.crossings[~surface.are_fixed(before.crossings)])
    if part is None:
        return None
    x, springs = _opened(part, part.home, part.crossings(part.home), None)
    if not part.are_fixed(part.crossings(x)).all() or not part.is_apart(x):
        return None
    x = approach(part, x, springs, max_strain, _ROUNDS_CROSSING)
    if not part.is_apart(x) or part.strain(x) > max_strain:
        return None
    found = Faults(surface, part.in_whole(x))
    return None if found.inside.size or not surface.are_fixed(found.crossings).all() else found


def _found(surface: Surface, before: Faults, max_strain: float, history, sheet, chosen: np.ndarray) -> np.ndarray:
    """Returns the best positions that :func:`search` finds, in units; they may be worse than the input."""
    if history is not None:
        reached = approach(surface, history, Springs(surface, ~surface.fixed), max_strain)
        # fixed vertices that contact keeps from their places cannot stay elsewhere
        if (reached == surface.home)[surface.fixed].all():
            return reached

    def rank(x):
        faults = Faults(surface, x)
        return surface.is_wrecked(x), faults.count, len(faults.near), *score_of(surface, x, max_strain)

    found, start, movable = [], surface.home, None
    if sheet is not None:
        start, movable = separate_sheets(surface, sheet, start), ~surface.fixed
    elif (parted := offset(surface, before.crossings)) is not start:
        moved = differ(parted, start)
        found.append(free(surface, parted, surface.crossings(parted), max_strain, movable=moved))
    if not found or any(rank(found[0])[:4]):
        for begin, may_move in surface.starts(start, movable):
            found.append(free(surface, begin, surface.crossings(begin), max_strain, movable=may_move))
            if not Faults(surface, found[-1]):
                break
    x = min(found, key=rank)
    if sheet is None and not surface.are_fixed(surface.crossings(x)).all():
        x = free_by_order(surface, x, max_strain, rank, chosen)
        x = min(x, free_by_smoothing(surface, x, max_strain), key=rank)
    # what is inside solids has left them, and is no sheet
    elif sheet is None and not before.inside.size and (rank(x)[3] or surface.moves(x).max() > _FAR * surface.edge):
        ordered = free_by_order(surface, surface.home, max_strain, rank, chosen)
        if rank(x) <= rank(ordered):
            chosen[:] = -1
        else:
            x = ordered
    if surface.are_fixed(surface.crossings(x)).all():
        return x
    springs = Springs(surface, near(surface, surface.moved(x), _RINGS))
    return _returned(surface, x, springs, max_strain)


def free(
    surface: Surface, start: np.ndarray, crossings: np.ndarray, max_strain: float, *, movable: np.ndarray | None = None
) -> np.ndarray:
    """Returns positions near the input at which less crosses, or is near, in units of the surface; or worse ones.

    At the start, where the search begins, are the ``crossings``, (edge, face), shape [m, 2]. Beside vertices near
    contours and near pairs, ``movable`` ones may move, bool, shape [n].
    """
    x, springs = _opened(surface, start, crossings, movable)
    left = _pieces_that_cross(surface, x)
    if not len(left):
        return _returned(surface, x, springs, max_strain)
    is_of_two = (left[:, 0] != left[:, 1]).all()  # pieces that an order may free
    return _returned(surface, x, springs, max_strain, rounds=_ROUNDS_OF_ORDER if is_of_two else _ROUNDS_CROSSING)


def _pieces_that_cross(surface: Surface, x: np.ndarray) -> np.ndarray:
    """Returns the pieces of edges and faces that cross and are not fixed, shape [m, 2]."""
    left = surface.crossings(x)
    left = left[~surface.are_fixed(left)]
    return surface.piece[np.stack([surface.mesh.edges[left[:, 0], 0], surface.mesh.faces[left[:, 1], 0]], axis=1)]


def _opened(
    surface: Surface, start: np.ndarray, crossings: np.ndarray, movable: np.ndarray | None
) -> tuple[np.ndarray, Springs]:
    """Returns positions at which less crosses, or is near, and springs of what may move; as :func:`free` otherwise."""
    untangled, springs = untangle(surface, start, crossings)
    x = push_apart(surface, untangled) if surface.keeps_distance else untangled
    may_move = springs.movable | near(surface, differ(x, untangled), _RINGS)
    if movable is not None:
        may_move |= movable
    return x, springs if (may_move == springs.movable).all() else Springs(surface, may_move)


def _returned(surface: Surface, x: np.ndarray, springs: Springs, max_strain: float, **options) -> np.ndarray:
    """Returns positions as :func:`.approach`, whose arguments it has, with the inside of tetrahedra."""
    return follow_surface(surface, approach(surface, x, springs, max_strain, **options))


def offset(surface: Surface, crossings: np.ndarray) -> np.ndarray:
    """Returns the input with its crossings, (edge, face), moved along normals, if nothing crosses then; else the input.

    Layers that lie on each other have no contours that tell a side. Those of one sheet that is folded have opposite
    normals, and pieces move by different distances.
    """
    faces, x = surface.mesh.faces, surface.home
    a, b, c = (x[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    normals = sums(faces.ravel(), np.repeat(areas, 3, axis=0), len(x))
    size = np.bincount(faces.ravel(), np.repeat(np.linalg.norm(areas, axis=1), 3), len(x))
    lengths = np.linalg.norm(normals, axis=1)
    # at a crease, normals cancel each other
    normals *= (lengths > _FLATTEST * size)[:, None] / np.maximum(lengths, 1e-30)[:, None]
    moves = near(surface, np.append(surface.mesh.edges[crossings[:, 0]], surface.mesh.faces[crossings[:, 1]]), 1)
    _, piece = np.unique(surface.piece[moves], return_inverse=True)
    distances = np.zeros((len(x), 1))
    distances[moves, 0] = _OFFSET * surface.edge * (1.0 + piece.reshape(-1)) / (1.0 + piece.max(initial=0))
    for side in (1.0, -1.0):
        start = surface.rounded(x + side * distances * normals)
        if surface.are_fixed(surface.crossings(start)).all():
            return start
    return x


def free_by_smoothing(surface: Surface, start: np.ndarray, max_strain: float) -> np.ndarray:
    """Returns positions as :func:`free`, from where pieces that cross themselves are too smooth for that; or the start.

    Smoothing opens what a piece has folded through itself from a border, whose contours have nowhere else to go. A
    piece keeps its place and the lengths of its edges, in the mean.
    """
    edges, piece = surface.edges, surface.piece
    first, second = _pieces_that_cross(surface, start).T
    crossing = first[first == second]
    if not len(crossing):
        return start
    springs, x = Springs(surface, np.isin(piece, crossing) & ~surface.fixed), start
    sizes = np.bincount(piece, minlength=len(x))[:, None]

    def means(values, rows):
        return sums(rows, values, len(x)) / np.maximum(sizes, 1)

    def lengths(x):
        return means(np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)[:, None], piece[edges[:, 0]])

    is_whole = springs.movable & ~np.isin(piece, piece[surface.fixed])
    for doubling in range(_DOUBLINGS):
        x = springs.spread(x, ~springs.movable, _SWEEPS << doubling)
        scale = (lengths(start) / np.maximum(lengths(x), 1e-30))[piece]
        placed = means(start, piece)[piece] + scale * (x - means(x, piece)[piece])
        opened = surface.rounded(np.where(is_whole[:, None], placed, x))
        if surface.are_fixed(surface.crossings(opened)).all():
            return _returned(surface, opened, springs, max_strain)
        if surface.is_late:
            break
    return start


def free_by_order(
    surface: Surface, x: np.ndarray, max_strain: float, rank: Callable[[np.ndarray], tuple], chosen: np.ndarray
) -> np.ndarray:
    """Returns positions in which pieces that cross each other have left each other, to the side where they move less.

    The search begins at ``x``, in units, shape [n, 3]. ``rank`` tells of positions whether they are wrecked, how much
    crosses, how much is near, the strain above the limit, and the squared moves. The sheets that are chosen are written
    to those of the vertices, from inside to outside, -1 for none, int, shape [n].
    """
    piece, tried = surface.piece, set()
    while True:
        ends = _pieces_that_cross(surface, x)
        pairs = sorted(set(map(tuple, np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1).tolist())) - tried)
        if not pairs or surface.is_late:
            return x
        tried.add(pairs[0])
        starts, found = [], []
        for inner, outer in (pairs[0], pairs[0][::-1]):
            sheet = np.where(piece == inner, 0, np.where(piece == outer, 1, -1))
            y = separate_sheets(surface, sheet, np.where(sheet[:, None] < 0, x, surface.home))
            starts.append((float((surface.moves(y) ** 2).sum()), inner, outer, y))
        for moves, inner, outer, start in sorted(starts, key=lambda each: each[0]):
            if found and not any(found[0][0][:2]) and moves > _FARTHER * found[0][0][-1]:
                break
            y, springs = _opened(surface, start, surface.crossings(start), ~surface.fixed)
            nearly = _returned(surface, y, springs, max_strain, rounds=_ROUNDS_OF_ORDER)
            found.append((rank(nearly), inner, outer, y, springs))
        best, inner, outer, y, springs = min(found, key=lambda each: (each[0][:2], each[0][-1]))
        if best[:2] < rank(x)[:2]:
            x = _returned(surface, y, springs, max_strain)
            chosen[(piece == inner) & (chosen < 0)] = 0
            chosen[piece == outer] = np.maximum(chosen[piece == outer], chosen[piece == inner].max() + 1)


def _restored(surface: Surface, before: Faults, after: Faults) -> np.ndarray:
    """Returns positions in which parts that still have most of their faults are as in the input.

    A part is connected by vertices that have moved and by crossings. What is fixed on both sides is no fault of a part.
    """
    mesh = surface.mesh
    moved = surface.moved(after.x)
    links, faults = [surface.edges[moved[surface.edges].all(axis=1)]], []
    for found in (before, after):
        pairs = found.crossings[~surface.are_fixed(found.crossings)]
        ends, corners = mesh.edges[pairs[:, 0]], mesh.faces[pairs[:, 1]]
        links += [np.stack([ends[:, i], other], axis=1) for i in (0, 1) for other in corners.T]
        faults.append(np.append(ends[:, 0], found.inside))
    part = connect_cells(np.concatenate(links), len(after.x))
    counts = [np.bincount(part[vertices], minlength=len(part)) for vertices in faults]
    return np.where((2 * counts[1] > counts[0])[part][:, None], surface.home, after.x)
