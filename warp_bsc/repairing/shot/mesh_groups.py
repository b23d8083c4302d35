"""The groups and masks by which pairs of meshes are left out of a repair."""

from collections.abc import Iterable, Set

import numpy as np

from ...usd.segment import Segment
from .findings import MeshPair

_MOST_KINDS = 32
"""Groups of a :class:`warp_bsc.CollisionMesh`."""


def groups_of(
    segment: Segment, kept: Set[str], pairs: Iterable[MeshPair]
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Returns the groups and the masks of vertices that leave pairs of meshes out, uint32; None if there are none.

    A vertex of two meshes has the groups of both: its elements meet what their other vertices meet. Other arguments and
    errors are those of :func:`bits_of`.
    """
    bits = bits_of([mesh.name for mesh in segment.meshes], kept, pairs)
    if all(both == (1, 1) for both in bits.values()):
        return None, None
    found = np.zeros((2, segment.vertex_count), dtype=np.uint32)
    for number, mesh in enumerate(segment.meshes):
        found[:, segment.vertices_of(number)] |= np.array(bits[mesh.name], dtype=np.uint32)[:, None]
    return found[0], found[1]


def bits_of(names: Iterable[str], kept: Set[str], pairs: Iterable[MeshPair]) -> dict[str, tuple[int, int]]:
    """Returns the group and the mask of each mesh, by their names: those that meet the same others are of one group.

    Meshes whose names are ``kept`` do not meet each other or themselves, nor do given pairs meet, twice the same name
    for a mesh with itself.

    Raises:
        ValueError: If there are more than 32 groups.
    """
    partners: dict[str, set[str]] = {name: set() for name in names}
    for first, second in pairs:
        if first in partners and second in partners and not kept >= {first, second}:
            partners[first].add(second)
            partners[second].add(first)
    kinds: dict[tuple[bool, frozenset[str]], list[str]] = {}
    for name, others in partners.items():
        kinds.setdefault((name in kept, frozenset(others)), []).append(name)
    if len(kinds) > _MOST_KINDS:
        raise ValueError(
            f"meshes that cross at the first frame, or are ignored, make {len(kinds)} combinations, of which at most "
            f"{_MOST_KINDS} can stay as they are; keep or exclude some meshes, or include them in the repair"
        )
    bits = {}
    for number, (are_kept, others) in enumerate(kinds):
        met = [not (are_kept and is_kept) and names[0] not in others for (is_kept, _), names in kinds.items()]
        bits.update(dict.fromkeys(kinds[are_kept, others], (1 << number, sum(1 << i for i, m in enumerate(met) if m))))
    return bits
