"""The contacts of each unknown, in an order that does not depend on threads, and those of each world that couple."""

import warp as wp

from ..vector_access import integers_at, numbers_at
from .system import NOT_UNKNOWN, Contacts, Unknowns, first_unknown

wp.set_module_options({"enable_backward": False})

_COUPLES = wp.constant(wp.int64(1 << 61))
"""What is added to the number of a contact that couples, so that it comes last."""
_ALONE = wp.constant(wp.int64(-(1 << 62)))
"""The same where it has no other unknown, so that it comes first, and is no part of blocks beside the diagonal."""


@wp.func
def count_entries(i: int, world: int, contacts: Contacts, unknowns: Unknowns):
    """Counts a contact in ``end`` of the unknowns that are solved for, and of its world if it couples."""
    weights, of_corners = numbers_at(contacts.weights, i), integers_at(contacts.unknowns, i)
    for j in range(4):
        if weights[j] != 0.0:
            u = first_unknown(of_corners[j])
            if u >= 0:
                if unknowns.is_free[u] != 0:
                    wp.atomic_add(contacts.end, u, 1)
                    if of_corners[j] < 0:
                        wp.atomic_add(contacts.end, u + 1, 1)
    if contacts.couples[i] != 0:
        wp.atomic_add(contacts.coupled_end, world, 1)


@wp.func
def clear_lists(world: int, contacts: Contacts):
    """Clears the number of entries of a world, and of contacts there that couple."""
    contacts.listed[world] = 0
    contacts.coupled_first[world] = contacts.start[world]
    contacts.coupled_end[world] = 0


@wp.func
def place_coupled(world: int, contacts: Contacts, lacks: wp.array[int]):
    """Lets the list of contacts of a world that couple begin."""
    if contacts.count[world] > contacts.start[world + 1] - contacts.start[world]:
        lacks[0] = 1
    contacts.coupled_end[world] = contacts.coupled_first[world]


@wp.func
def place_entries(u: int, world: int, contacts: Contacts):
    """Gives an unknown room for its contacts, anywhere in that of its world; ``end`` becomes the first of them."""
    count = contacts.end[u]
    if count > 0:
        first = contacts.entries_of_each * contacts.start[world] + wp.atomic_add(contacts.listed, world, count)
        contacts.first[u] = first
        contacts.end[u] = first
    else:
        contacts.first[u] = 0
        contacts.several[u] = 0
        contacts.middle[u] = 0


@wp.func
def _list_entry(contacts: Contacts, u: int, entry: int, count: int):
    """Lists an entry of a contact of so many unknowns."""
    n = wp.atomic_add(contacts.end, u, 1)
    contacts.unsorted[n] = entry
    contacts.row[n] = u
    place = wp.where(contacts.couples[entry >> 2] != 0, _COUPLES, wp.where(count == 1, _ALONE, wp.int64(0)))
    contacts.order[n] = place + contacts.key[entry >> 2]


@wp.func
def _list_coupled(contacts: Contacts, world: int, i: int):
    n = wp.atomic_add(contacts.coupled_end, world, 1)
    contacts.coupled[n] = i
    contacts.place_in_coupled[i] = n - contacts.coupled_first[world]
    of_corners, weights = integers_at(contacts.unknowns, i), numbers_at(contacts.weights, i)
    for j in range(4):
        if weights[j] == 0.0:
            of_corners[j] = -1
    contacts.coupled_unknowns[n] = of_corners


@wp.func
def list_entries(i: int, world: int, contacts: Contacts, unknowns: Unknowns):
    """Lists a contact for its unknowns, behind their ``end``, which moves on, and for its world if it couples."""
    if contacts.couples[i] != 0:
        _list_coupled(contacts, world, i)
    weights, of_corners = numbers_at(contacts.weights, i), integers_at(contacts.unknowns, i)
    count = int(0)
    for j in range(4):
        if weights[j] == 0.0:
            of_corners[j] = NOT_UNKNOWN
        u = first_unknown(of_corners[j])
        if u >= 0:
            if unknowns.is_free[u] == 0:
                of_corners[j] = NOT_UNKNOWN
            else:
                count += wp.where(of_corners[j] < 0, 2, 1)
    for j in range(4):
        u = first_unknown(of_corners[j])
        if u >= 0:
            _list_entry(contacts, u, 4 * i + j, count)
            if of_corners[j] < 0:
                _list_entry(contacts, u + 1, 4 * i + j, count)


@wp.func
def _put_entry(contacts: Contacts, at: int, order: wp.int64, entry: int):
    contacts.entries[at] = entry
    if order >= _COUPLES:
        contacts.pulled[at] = contacts.place_in_coupled[entry >> 2]
        contacts.entry_weight[at] = contacts.weights[entry >> 2][entry & 3]


@wp.func
def sort_entries(n: int, contacts: Contacts):
    """Puts an entry of an unknown to its place by its pair, so that sums do not depend on the order of threads.

    Those that have no other unknown come first, those that couple last.
    """
    u, own, entry = contacts.row[n], contacts.order[n] + wp.int64(0), contacts.unsorted[n] + int(0)
    first = contacts.first[u]
    rank, alone, single = int(0), int(0), int(0)
    for m in range(first, contacts.end[u]):
        other = contacts.order[m] + wp.int64(0)
        alone += wp.where(other < wp.int64(0), 1, 0)
        single += wp.where(other < _COUPLES, 1, 0)
        if other < own or (other == own and contacts.unsorted[m] < entry):
            rank += 1
    _put_entry(contacts, first + rank, own, entry)
    if rank == 0:
        contacts.several[u] = first + alone
        contacts.middle[u] = first + single


@wp.func
def sort_list(u: int, contacts: Contacts):
    """Puts all entries of an unknown to their places, as :func:`sort_entries`, by one thread: by shell sort."""
    first, end = contacts.first[u], contacts.end[u]
    step = end - first
    while step > 1:
        step = step * 5 // 11 + int(step == 2)
        for i in range(first + step, end):
            own, entry = contacts.order[i] + wp.int64(0), contacts.unsorted[i] + int(0)
            at, moves = int(i), bool(True)
            while moves:
                moves = False
                if at - step >= first:
                    other, of_other = contacts.order[at - step] + wp.int64(0), contacts.unsorted[at - step] + int(0)
                    moves = own < other or (own == other and entry < of_other)
                    if moves:
                        contacts.order[at] = other
                        contacts.unsorted[at] = of_other
                        at -= step
            contacts.order[at] = own
            contacts.unsorted[at] = entry
    alone, single = int(0), int(0)
    for n in range(first, end):
        order = contacts.order[n] + wp.int64(0)
        alone += wp.where(order < wp.int64(0), 1, 0)
        single += wp.where(order < _COUPLES, 1, 0)
        _put_entry(contacts, n, order, contacts.unsorted[n])
    if end > first:
        contacts.several[u] = first + alone
        contacts.middle[u] = first + single
