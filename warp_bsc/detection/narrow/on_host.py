"""Contacts that the device leaves to the host: the exact checker decides them, with a minimum distance or without."""

import numpy as np
import warp as wp

from ... import checker
from ...kernels.closest import contact_at
from ...kernels.min_distance import closest_at
from ...kernels.motion import relative_motion
from ...kernels.pairs import ends_of, points_of_pair
from ...kernels.signs import FREE, HIT
from ..run.launch import launch, made_once
from ..run.settings import NO_FUSED_OPERATIONS, PairKind
from .contact_buffer import HostContacts


@made_once
def _kernel(dtype: type, with_distance: bool) -> wp.Kernel:
    """Returns the kernel that finds coordinates and normals of contacts at given times, for one type of position."""

    @wp.kernel(**NO_FUSED_OPERATIONS)
    def find_contact_points(
        # mesh
        x0: wp.array[dtype],
        x1: wp.array[dtype],
        elements: wp.array2d[int],
        kind: int,
        # in
        pairs: wp.array[wp.vec2i],
        time: wp.array[wp.float64],
        # out
        coordinates: wp.array[wp.vec3d],
        normal: wp.array[wp.vec3d],
    ):
        i = wp.tid()
        v = points_of_pair(kind, elements, pairs[i])
        a0, b0, c0, d0, a1, b1, c1, d1 = ends_of(x0, x1, v)
        motion = relative_motion(kind, a0, b0, c0, d0, a1, b1, c1, d1, wp.float64(0.0))
        if wp.static(with_distance):
            at, direction = closest_at(kind, motion, time[i])
        else:
            at, direction = contact_at(motion, time[i])
        coordinates[i] = at
        normal[i] = direction

    return find_contact_points


def pair_distances(
    kind: PairKind, elements: np.ndarray, pairs: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the vertices of pairs of a kind, int, shape [n, kind.points], and their minimum distances, shape [n].

    Args:
        kind: The kind of pair.
        elements: Vertex indices of faces or edges; not used for (vertex, vertex).
        pairs: (vertex, face) and so on, shape [n, 2].
        radius: Radius of each vertex, float64.
    """
    first = elements[pairs[:, 0]] if kind == PairKind.EDGE_EDGE else pairs[:, :1]
    second = pairs[:, 1:] if kind == PairKind.VERTEX_VERTEX else elements[pairs[:, 1]]
    distance = radius[first].max(axis=1, initial=0.0) + radius[second].max(axis=1, initial=0.0)
    return np.concatenate([first, second], axis=1), distance


def decide_on_host(
    kind: PairKind,
    x0: wp.array,
    x1: wp.array,
    elements: wp.array,
    radius: np.ndarray | None,
    contacts: HostContacts,
    which: np.ndarray,
    *,
    timed: bool = True,
) -> None:
    """Decides some contacts with the exact checker, on the host, and changes their rows.

    Args:
        kind: The kind of pair.
        x0: Positions at the start of the step, Warp array.
        x1: Positions at its end.
        elements: Vertex indices of faces or edges, Warp array.
        radius: Radius of each vertex, float64; None without minimum distances.
        contacts: The contacts.
        which: Which of them to decide, bool, shape [n].
        timed: Whether to find times of impact, coordinates and normals.
    """
    if not which.any():
        return
    radii = np.zeros(len(x0)) if radius is None else radius
    corners, distance = pair_distances(kind, elements.numpy(), contacts.pairs[which], radii)
    query = [np.concatenate([x0.numpy()[corners], x1.numpy()[corners]], axis=1)]
    if radius is not None:
        query.append(distance)
    if not timed:
        contacts.decided[which] = np.where(getattr(checker, kind.label)(*query), HIT, FREE)
        return
    toi = contacts.toi
    toi[which] = getattr(checker, f"{kind.label}_toi")(*query)[:, 0]
    contacts.decided[which] = np.where(np.isnan(toi[which]), FREE, HIT)
    toi[~contacts.hit] = 2.0
    contacts.within_tolerance[which] = contacts.hit[which]
    again = np.flatnonzero(which & contacts.hit)
    outputs = [wp.empty(len(again), dtype=wp.vec3d, device=x0.device) for _ in range(2)]
    timed_pairs = wp.array(contacts.pairs[again], dtype=wp.vec2i, device=x0.device)
    inputs = [x0, x1, elements, int(kind), timed_pairs, wp.array(toi[again], dtype=wp.float64, device=x0.device)]
    kernel = _kernel(x0.dtype, radius is not None)
    launch(kernel, len(again), inputs=inputs, outputs=outputs, device=x0.device, record_tape=False)
    contacts.coordinates[again], contacts.normal[again] = (output.numpy() for output in outputs)
