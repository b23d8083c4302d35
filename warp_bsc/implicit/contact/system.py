"""The unknowns of a step, and what kernels know of them and of their worlds."""

import warp as wp

from ...kernels.pipeline.queues import take_slot_of
from ...response.state.vectors import ZERO
from ..vector_access import READ_BLOCK, integers_at, mat34, numbers_at, store_block, stored_block
from .sums import sum_of

wp.set_module_options({"enable_backward": False})

NOT_UNKNOWN = wp.constant(-1)
"""In place of the unknown of a vertex that is where a program puts it."""


@wp.struct
class Unknowns:
    """The unknowns of a step: displacements of particles, and of a body its shift and its turn, one after the other."""

    # unknown of each vertex of the mesh; NOT_UNKNOWN, or -2 less the first unknown of its body
    of_vertex: wp.array[int]
    particle: wp.array[int]  # particle of each unknown, -1 of those of bodies
    body: wp.array[int]  # body of each unknown, -1 of those of particles
    # first unknown of each world, and the end of the last. Those of bodies come last in a world.
    of_worlds: wp.array[int]
    first_of_bodies: wp.array[int]  # first unknown of a body in each world, or where its unknowns end
    is_free: wp.array[int]  # 1 for each unknown that is solved for; the others are given
    # mass over the square of the length of the step, and attachments, of each particle [N/m]
    inertia: wp.array[wp.float64]
    arm: wp.array[wp.vec3]  # of each vertex of a body that is solved for, from its centre of mass [m]


@wp.struct
class Worlds:
    """What is in each world; the first of it in each, and the end of the last."""

    vertices: wp.array[int]  # those that are solved for, and all particles, come first in a world
    first_vertex: wp.array[int]  # of each world
    first_given: wp.array[int]  # first of the others in each
    elements: wp.array[int]  # world by world
    first_element: wp.array[int]  # of each world


@wp.struct
class Progress:
    """How far each world is with its step."""

    active: wp.array[int]  # 1 while a world takes another Newton step, shape [worlds], like all that follow
    solving: wp.array[int]  # 1 of a world for which a solve comes next
    steps: wp.array[int]  # Newton steps so far
    scale: wp.array[float]  # share of the displacements that is taken
    scale_before: wp.array[float]  # the same in the Newton step before
    damping: wp.array[float]  # share that is taken at most
    square: wp.array[wp.int64]  # of the displacements, in units
    square_before: wp.array[wp.int64]  # of those of the Newton step before, in units
    product: wp.array[wp.int64]  # of both, in units
    bound: wp.array[float]  # share of the displacements before two elements meet
    searches: wp.array[int]  # 1 while the share is halved, as the energy has risen
    energy: wp.array[wp.int64]  # energy at the positions, in units
    reached: wp.array[wp.int64]  # energy where the Newton step before ended, in units
    trial: wp.array[wp.int64]  # energy at the displaced positions, in units
    uncut: wp.array[wp.int64]  # the same, before displacements of single vertices are cut
    cuts: wp.array[int]  # 1 if those are cut
    change: wp.array[float]  # largest displacement of an unknown in the Newton step [m]
    before: wp.array[float]  # the same in the one before it, as far as it was taken, -1 if it was not [m]
    # how far a vertex has been, or is led by the displacements, from where it was at the start of the step [m]
    way: wp.array[float]
    way_before: wp.array[float]  # the same in the step before
    fastest: wp.array[float]  # longest way of a particle in the step as predicted, without this step's gravity [m]
    longest: wp.array[float]  # longest displacement of a vertex in the Newton step, or more [m]
    given_way: wp.array[float]  # the same of what a program moves
    remaining: wp.array[float]  # largest way of what a program moves that is left [m]
    held: wp.array[int]  # 1 if pairs are held in the solve
    late: wp.array[int]  # Newton steps that began before what a program moves had arrived, but for the first of them
    fall: wp.array[float]  # how far gravity moves what is at rest in the step [m]
    driven: wp.array[float]  # largest way of what a program moves in the step [m]
    given_moves: wp.array[int]  # 1 if something moves in the step that is not solved for
    leaves: wp.array[int]  # 1 if a vertex leaves its box
    plane_share: wp.array[float]  # share of their ways that infinite planes have gone
    whole: wp.array[float]  # share that is taken without cuts of single vertices
    goes_back: wp.array[int]  # 1 if the step ends at an earlier Newton step, ``place``
    place: wp.array[int]


@wp.func
def is_near_end(progress: Progress, w: int, least_change: float) -> bool:
    """Returns whether unknowns of a world are so near their end that it takes no other Newton step.

    They may be farther by up to ten times where a program moves something fast: by a hundredth of its way.
    """
    return change_left(progress, w) <= wp.clamp(0.01 * progress.driven[w], least_change, 10.0 * least_change)


@wp.func
def change_left(progress: Progress, w: int) -> float:
    """Returns how far unknowns of a world are from their end [m]: at most as far as they have come last.

    The sum of the changes to come, if each is less than the one before it by the same factor as the last one was.
    """
    change, before = progress.change[w], progress.before[w]
    if progress.scale[w] < 1.0 or progress.cuts[w] != 0 or change >= 0.5 * before:
        return change
    return change * change / (before - change)


@wp.struct
class Contacts:
    """Pairs of elements that are near each other, and particles near planes, with their closest points as fixed.

    The energy of one, as a function of the vector between the closest points, has ``gradient`` and ``hessian``.
    """

    count: wp.array[int]  # number of contacts of each world; those that did not fit are counted, but are not there
    start: wp.array[int]  # where those of each world begin, and the end of all room
    corners: wp.array[wp.vec4i]  # vertices; of a particle at a plane, four times the particle
    unknowns: wp.array[wp.vec4i]  # the ``of_vertex`` of the corners
    # of the vertices in the vector from the second closest point to the first; all 0 of what is merged
    weights: wp.array[wp.vec4]
    normal: wp.array[wp.vec3]  # unit vector from the second closest point to the first
    load: wp.array[float]  # force that pushes them apart [N]
    limit: wp.array[float]  # force of friction at most [N]
    gradient: wp.array[wp.vec3]  # [N]
    hessian: wp.array[mat34]  # positive semidefinite [N/m]
    key: wp.array[wp.int64]  # number of the pair, by which contacts of an unknown are ordered
    # 1 of a contact of two elements that are both solved for, or of a body. The blocks of others, between vertices of
    # one element, are parts of the rows of elements.
    couples: wp.array[int]
    feature: wp.array[wp.vec3i]  # vertices of a contact of two vertices, or of one and an edge; -1 of others
    parts: int  # threads that share a contact, and buckets of each hash of vertices
    first_bucket: wp.array[int]  # first hash of each world, and the end of the last
    bucket: wp.array[int]  # 1 more than the first contact there, 0 for none; ``next`` has those that follow
    next: wp.array[int]
    listed: wp.array[int]  # number of entries of each world
    first: wp.array[int]  # first entry of each unknown
    several: wp.array[int]  # the first of those whose contacts have other unknowns as well
    middle: wp.array[int]  # the first of those that couple
    end: wp.array[int]  # the end of them
    entries: wp.array[int]  # contact and place of the vertex in it, as four times the contact plus the place
    entries_of_each: int  # entries for which there is room, by contact
    unsorted: wp.array[int]  # entries in any order
    row: wp.array[int]  # unknown of each of these
    order: wp.array[wp.int64]  # number by which each of these is ordered
    coupled: wp.array[int]  # contacts that couple, those of a world from ``coupled_first`` to ``coupled_end``
    coupled_first: wp.array[int]
    coupled_end: wp.array[int]
    # of each contact that couples, the ``of_vertex`` of its corners, -1 of corners without weight
    coupled_unknowns: wp.array[wp.vec4i]
    place_in_coupled: wp.array[int]  # place of each contact that couples among those of its world
    pulled: wp.array[int]  # the same of each entry of one that couples
    entry_weight: wp.array[float]  # weight of each of these
    pull: wp.array[wp.vec3]  # product of the Hessian of each of ``coupled`` with a displacement [N]


AT_PLANE = wp.constant(8)
"""Kind of a contact of a particle and a plane, after those of pairs of elements."""


@wp.func
def kind_of_key(key: wp.int64) -> int:
    """Returns the kind of a pair."""
    return int(key >> wp.int64(56))


@wp.func
def second_of_key(key: wp.int64) -> int:
    """Returns the second element of a pair, or its plane: the last 28 bits."""
    return int(key & wp.int64(268435455))


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    const unsigned mask = (parts == 32 ? ~0u : (1u << parts) - 1u) << (threadIdx.x & 31u & ~(unsigned)(parts - 1));
    for (int offset = parts / 2; offset > 0; offset /= 2)
        for (int c = 0; c < 3; ++c)
            value[c] += __shfl_xor_sync(mask, value[c], offset);
#endif
    return value;
"""
)
def sum_of_parts(value: wp.vec3, parts: int) -> wp.vec3:
    """Returns the sum of the values of ``parts`` threads that follow each other, a power of 2, in each; 1 on a CPU."""
    ...


@wp.func
def block_sum_of_parts(block: wp.mat33, parts: int) -> wp.mat33:
    """Returns the sum of blocks, as :func:`sum_of_parts` does."""
    return wp.matrix_from_rows(
        sum_of_parts(block[0], parts), sum_of_parts(block[1], parts), sum_of_parts(block[2], parts)
    )


_EXTREME = """
#if defined(__CUDA_ARCH__)
    atomic{0}((int*)values.data + i, __float_as_int(value));
#else
    values.data[i] = wp::{1}(values.data[i], value);
#endif
"""


@wp.func_native(snippet=_EXTREME.format("Max", "max"))
def raise_to(values: wp.array[float], i: int, value: float):
    """Raises a value to another one, both not negative; on GPUs faster than Warp's, by their bits."""
    ...


@wp.func_native(snippet=_EXTREME.format("Min", "min"))
def lower_to(values: wp.array[float], i: int, value: float):
    """Lowers a value to another one, as :func:`raise_to`."""
    ...


@wp.func
def first_unknown(of_vertex: int) -> int:
    """Returns the unknown of a vertex, given its ``of_vertex``: the first of its body, or -1."""
    return wp.where(of_vertex < -1, -2 - of_vertex, of_vertex)


@wp.func
def unknown_of_corner(unknowns: Unknowns, vertex: int) -> int:
    """Returns the unknown of a vertex, the first of its body, or -1."""
    return first_unknown(unknowns.of_vertex[vertex])


@wp.func
def is_solved(unknowns: Unknowns, vertex: int) -> bool:
    """Returns whether a vertex is solved for, by itself or with its body."""
    u = unknown_of_corner(unknowns, vertex)
    if u < 0:
        return False
    return unknowns.is_free[u] != 0


@wp.func
def displacement(unknowns: Unknowns, vertex: int, d: wp.array[wp.vec3]) -> wp.vec3:
    """Returns the displacement of a vertex, given those of unknowns; 0 where a program puts it."""
    u = unknowns.of_vertex[vertex]
    if u >= 0:
        return d[u]
    if u < -1:
        return d[-2 - u] + wp.cross(d[-1 - u], unknowns.arm[vertex])
    return wp.vec3()


@wp.func
def end_of_contacts(contacts: Contacts, world: int) -> int:
    """Returns where the contacts of a world end."""
    return wp.min(contacts.start[world] + contacts.count[world], contacts.start[world + 1])


@wp.func
def take_contact(contacts: Contacts, world: int) -> int:
    """Returns a place for another contact of a world; -1 if there is none."""
    slot = contacts.start[world] + take_slot_of(contacts.count, world)
    return wp.where(slot < contacts.start[world + 1], slot, -1)


@wp.func
def write_contact(
    contacts: Contacts,
    unknowns: Unknowns,
    slot: int,
    corners: wp.vec4i,
    weights: wp.vec4d,
    normal: wp.vec3,
    load: float,
    limit: float,
    gradient: wp.vec3,
    hessian: wp.mat33d,
    key: wp.int64,
):
    """Writes a contact to its place."""
    of_vertex = unknowns.of_vertex
    of_corners = wp.vec4i(of_vertex[corners[0]], of_vertex[corners[1]], of_vertex[corners[2]], of_vertex[corners[3]])
    contacts.corners[slot] = corners
    contacts.unknowns[slot] = of_corners
    contacts.weights[slot] = wp.vec4(float(weights[0]), float(weights[1]), float(weights[2]), float(weights[3]))
    contacts.normal[slot] = normal
    contacts.load[slot] = load
    contacts.limit[slot] = limit
    contacts.gradient[slot] = gradient
    store_block(contacts.hessian, slot, hessian)
    contacts.key[slot] = key
    contacts.couples[slot] = _couples(of_corners, weights)


@wp.func_native(
    snippet=sum_of(
        "wp::mat_t<3, 3, float>",
        9,
        places="contacts.entries.data",
        term="int corner; wp::vec4i of; wp::vec4 weights; wp::mat_t<3, 3, float> hessian;",
        read=READ_BLOCK
        + """
            const int i = place >> 2;
            t.corner = place & 3;
            t.hessian = read_block(contacts.hessian.data, i);
#if defined(__CUDA_ARCH__)
            const int4 of = *(const int4*)(contacts.unknowns.data + i);
            const float4 w = *(const float4*)(contacts.weights.data + i);
            t.of = wp::vec4i(of.x, of.y, of.z, of.w), t.weights = wp::vec4(w.x, w.y, w.z, w.w);
#else
            t.of = contacts.unknowns.data[i], t.weights = contacts.weights.data[i];
#endif
        """,
        add="""
            float weight = 0.0f;
            for (int j = 0; j < 4; ++j) weight += t.of[j] == v ? t.weights[j] : 0.0f;
            if (weight == 0.0f) return;
            weight *= t.weights[t.corner];
            for (int c = 0; c < 9; ++c) sum[c] += weight * t.hessian.data[c / 3][c % 3];
        """,
    )
)
def contact_block(contacts: Contacts, first: int, end: int, v: int, part: int, parts: int) -> wp.mat33:
    """Returns the block of an unknown and another one of the Hessian of contacts, given its first entry and the end."""
    ...


@wp.func
def contact_gradient(contacts: Contacts, unknowns: Unknowns, u: int, part: int, parts: int):
    """Returns the gradient of contacts by an unknown, and the block of the diagonal of those that couple, or a part."""
    gradient, block = wp.vec3(), wp.mat33()
    for n in range(contacts.first[u] + part, contacts.end[u], parts):
        entry = contacts.entries[n]
        i = entry >> 2
        weight = numbers_at(contacts.weights, i)[entry & 3]
        force, hessian = weight * contacts.gradient[i], weight * weight * stored_block(contacts.hessian, i)
        if integers_at(contacts.unknowns, i)[entry & 3] == -1 - u:  # the turn of a body, which is behind its shift
            turn = wp.skew(unknowns.arm[contacts.corners[i][entry & 3]])
            force, hessian = turn * force, turn * hessian * wp.transpose(turn)
        gradient += force
        if n >= contacts.middle[u]:
            block += hessian
    return gradient, block


@wp.func
def key_of_pair(group: int, kind: int, first: int, second: int) -> wp.int64:
    """Returns a number of a pair, different for each pair of a kind, and for each group of contacts."""
    return (wp.int64(8 * group + kind) << wp.int64(56)) | (wp.int64(first) << wp.int64(28)) | wp.int64(second)


@wp.func
def key_in_group(group: int, key: wp.int64) -> wp.int64:
    """Returns the number of a pair in a group of contacts, from its number in group 0."""
    return key | (wp.int64(8 * group) << wp.int64(56))


@wp.func
def _couples(of_corners: wp.vec4i, weights: wp.vec4d) -> int:
    """Returns whether both elements of a contact are solved for, or one is of a body."""
    first, second = int(0), int(0)
    for j in range(4):
        u = of_corners[j]
        if u < -1:
            return 1
        if u >= 0 and weights[j] > ZERO:
            first = 1
        if u >= 0 and weights[j] < ZERO:
            second = 1
    return first * second
