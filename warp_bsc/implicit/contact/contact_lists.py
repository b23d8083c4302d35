"""The contacts of each unknown, in an order that does not depend on threads, and those of each world that couple."""

import warp as wp

from ..vector_access import integers_at, numbers_at
from .flow import Phase, Place, Problem, go_on
from .merge import merge_contact
from .merit import add_friction_energy
from .system import NOT_UNKNOWN, Contacts, end_of_contacts, first_unknown

wp.set_module_options({"enable_backward": False})

_COUPLES = wp.constant(wp.int64(1 << 61))
"""What is added to the number of a contact that couples, so that it comes last."""
_ALONE = wp.constant(wp.int64(-(1 << 62)))
"""The same where it has no other unknown, so that it comes first, and is no part of blocks beside the diagonal."""


@wp.func
def clear_lists(world: int, contacts: Contacts):
    """Clears the number of entries of a world, and of contacts there that couple."""
    contacts.listed[world] = 0
    contacts.coupled_first[world] = contacts.start[world]
    contacts.coupled_end[world] = 0


@wp.func
def count_contacts(at: Place, p: Problem) -> wp.vec4i:
    """Merges contacts, and counts in ``end`` those of each unknown that is solved for, and those that couple."""
    w, contacts, parts = at.world, p.contacts, p.contacts.parts
    first = contacts.start[w] + int(0)
    for k in range(at.thread, parts * (end_of_contacts(contacts, w) - first), at.threads):
        i, part = first + k // parts, k % parts
        if at.solves == 0:
            merge_contact(i, part, w, contacts)
        if part != 0:
            continue
        weights, of_corners = numbers_at(contacts.weights, i), integers_at(contacts.unknowns, i)
        for j in range(4):
            if weights[j] != 0.0:
                u = first_unknown(of_corners[j])
                if u >= 0:
                    if p.unknowns.is_free[u] != 0:
                        wp.atomic_add(contacts.end, u, 1)
                        if of_corners[j] < 0:
                            wp.atomic_add(contacts.end, u + 1, 1)
        if contacts.couples[i] != 0:
            wp.atomic_add(contacts.coupled_end, w, 1)
        if at.solves == 0:
            add_friction_energy(i, w, p.motion, contacts, p.settings, p.trial, p.progress.energy)
    return go_on(at, Phase.PLACE)


@wp.func
def place_contacts(at: Place, p: Problem) -> wp.vec4i:
    """Gives each unknown room for its contacts, anywhere in that of its world; ``end`` becomes the first of them."""
    w, contacts = at.world, p.contacts
    if at.thread == 0:
        if contacts.count[w] > contacts.start[w + 1] - contacts.start[w]:
            p.flow.lacks[0] = 1
        contacts.coupled_end[w] = contacts.coupled_first[w]
    for u in range(p.unknowns.of_worlds[w] + at.thread, p.unknowns.of_worlds[w + 1], at.threads):
        count = contacts.end[u] + int(0)
        if count > 0:
            first = contacts.entries_of_each * contacts.start[w] + wp.atomic_add(contacts.listed, w, count)
            contacts.first[u] = first
            contacts.end[u] = first
        else:
            contacts.first[u] = 0
            contacts.several[u] = 0
            contacts.middle[u] = 0
    return go_on(at, wp.where(contacts.count[w] > 0, int(Phase.LIST_CONTACTS), int(Phase.BLOCKS)))


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
def list_contacts(at: Place, p: Problem) -> wp.vec4i:
    """Lists contacts for their unknowns, behind their ``end``, which moves on, and for the world if they couple."""
    w, contacts = at.world, p.contacts
    for i in range(contacts.start[w] + at.thread, end_of_contacts(contacts, w), at.threads):
        if contacts.couples[i] != 0:
            _list_coupled(contacts, w, i)
        weights, of_corners = numbers_at(contacts.weights, i), integers_at(contacts.unknowns, i)
        count = int(0)
        for j in range(4):
            if weights[j] == 0.0:
                of_corners[j] = NOT_UNKNOWN
            u = first_unknown(of_corners[j])
            if u >= 0:
                if p.unknowns.is_free[u] == 0:
                    of_corners[j] = NOT_UNKNOWN
                else:
                    count += wp.where(of_corners[j] < 0, 2, 1)
        for j in range(4):
            u = first_unknown(of_corners[j])
            if u >= 0:
                _list_entry(contacts, u, 4 * i + j, count)
                if of_corners[j] < 0:
                    _list_entry(contacts, u + 1, 4 * i + j, count)
    return go_on(at, Phase.SORT)


@wp.func
def _put_entry(contacts: Contacts, at: int, order: wp.int64, entry: int):
    contacts.entries[at] = entry
    if order >= _COUPLES:
        contacts.pulled[at] = contacts.place_in_coupled[entry >> 2]
        contacts.entry_weight[at] = contacts.weights[entry >> 2][entry & 3]


@wp.func
def _sort_entries(n: int, contacts: Contacts):
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
def _sort_list(u: int, contacts: Contacts):
    """Puts all entries of an unknown to their places, as :func:`_sort_entries`, by one thread: by shell sort."""
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


@wp.func
def sort_contacts(at: Place, p: Problem) -> wp.vec4i:
    """Puts the contacts of each unknown into an order that does not depend on threads."""
    w, contacts = at.world, p.contacts
    if at.threads == 1:  # long lists in less than a thread for each entry takes
        for u in range(p.unknowns.of_worlds[w], p.unknowns.of_worlds[w + 1]):
            _sort_list(u, contacts)
    else:
        first = contacts.entries_of_each * contacts.start[w]
        for i in range(first + at.thread, first + contacts.listed[w], at.threads):
            _sort_entries(i, contacts)
    return go_on(at, Phase.BLOCKS)
