"""The contours along which a surface crosses itself: traced from edge to edge, with their two sides and their kind."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..detection.at_rest.body_parts import connect_cells
from ..detection.mesh import CollisionMesh

ContourKind = Literal["closed", "border", "open"]
"""Whether a contour ends nowhere, at borders of the surface alone, or elsewhere: at a vertex that both sides share."""


@dataclass(frozen=True, eq=False)
class Contours:
    """The contours of some intersections.

    Attributes:
        number: Contour of each intersection, numbered from 0, int, shape [n].
        sign: 1 where the edge belongs to one of the two surfaces that cross along the contour, -1 where it belongs to
            the other; 0 on contours whose two surfaces are not told apart, int, shape [n].
        kinds: Kind of each contour.
    """

    number: np.ndarray
    sign: np.ndarray
    kinds: list[ContourKind]


def trace_contours(mesh: CollisionMesh, pairs: np.ndarray) -> Contours:
    """Traces the contours through intersections of edges with faces: pairs (edge, face), int, shape [n, 2].

    Two faces cross in a segment. Each of its ends is an edge of one in the other, or a vertex of both. A contour is a
    chain of segments. At each of its points an edge of one surface passes through a face of the other, so that the
    intersections of a contour have two signs.
    """
    n = len(pairs)
    rows, owners = mesh.edge_faces.find(pairs[:, 0])
    across = pairs[rows, 1]
    keys = np.minimum(owners, across).astype(np.int64) * len(mesh.faces) + np.maximum(owners, across)
    order = np.argsort(keys, kind="stable")
    rows, owners, keys = rows[order], owners[order], keys[order]
    same = np.flatnonzero(keys[1:] == keys[:-1])  # consecutive ends of one segment
    one, other = rows[same], rows[same + 1]
    turned = (owners[same] != owners[same + 1]).astype(np.int64)  # the edge of the next end is of the other face
    # each intersection is two nodes, one for each sign that it may have
    nodes = [np.stack([2 * one + i, 2 * other + (i ^ turned)], axis=1) for i in (0, 1)]
    label = connect_cells(np.concatenate(nodes), 2 * n)
    plus, minus = label[0::2], label[1::2]
    number = np.unique(np.minimum(plus, minus), return_inverse=True)[1].reshape(-1)
    count = number.max(initial=-1) + 1
    is_end_at_border = np.bincount(rows, minlength=n) < 2
    whole = np.isin(keys, keys[same])
    ends_inside = np.bincount(number[rows[~whole]], minlength=count) > 0
    ends_at_border = np.bincount(number[is_end_at_border], minlength=count) > 0
    kinds: list[ContourKind] = [
        "open" if inside else "border" if border else "closed"
        for inside, border in zip(ends_inside, ends_at_border, strict=True)
    ]
    return Contours(number, np.sign(minus - plus), kinds)
