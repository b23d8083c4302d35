"""Whether a recorded step is free of contacts on the arcs of turning bodies, whose response knows their chords alone.

Gradients of contacts are those of straight paths. Where an arc passes through something that its chord does not, the
step loses its certificate.
"""

import warp as wp

from ..._profiling import phase
from ...detection.run.launch import retry_until_fits
from ...kernels.arcs import Arcs, turns
from ...kernels.pipeline.queues import has_overflowed
from ..state.certificate import revoke
from ..state.status import Result, SolveStatus
from ..state.structs import Step
from ..state.workspace import Workspace
from . import constraints, rules
from .collect import mark_changed
from .queue import PairQueue, has_pair, pair_count, queues_of, vertices_of
from .rules import ContactClass

wp.set_module_options({"enable_backward": False})


@wp.func
def _count(step: Step, contacts: PairQueue, i: int, arcs: Arcs, status: SolveStatus):
    """Counts a contact on arcs as one that remains."""
    if not has_pair(contacts, i):
        return
    motion, corners = step.motion, vertices_of(contacts, i)
    if not turns(arcs, corners):
        return
    owner = rules.owner_of(motion, corners)
    if owner != ContactClass.OURS:
        return
    bound = contacts.toi[i]
    if motion.distances.radius:
        start, _kept = constraints.distances_at_start(motion, corners, contacts.kind)
        bound = start
    world = motion.world[corners[0]]
    may_cross = status.crossings[world] > 0
    found = rules.classify_contact(step, contacts.kind, contacts.pairs[i], corners, owner, bound, may_cross)
    if found == ContactClass.OURS:
        wp.atomic_add(status.results, int(Result.REMAINING), 1)
        revoke(status.results)
        if status.of_worlds.remaining:
            wp.atomic_add(status.of_worlds.remaining, world, 1)
        mark_changed(step.vertices, corners)


@wp.kernel
def _count_contacts(
    # in
    first: PairQueue,
    second: PairQueue,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    arcs: Arcs,
    # in and out
    step: Step,
    status: SolveStatus,
    threads: int,
):
    """Counts the contacts of two kinds on arcs; if a queue overflowed, some may be missing, and nothing is certain."""
    if wp.tid() == 0 and has_overflowed(counts, capacities):
        revoke(status.results)
    for i in range(wp.tid(), wp.max(pair_count(first), pair_count(second)), threads):
        number = int(0)
        while number < 2:  # one body for both, which is large
            _count(step, wp.where(number == 0, first, second), i, arcs, status)
            number += 1


@phase("check arcs")
def check_arcs(work: Workspace) -> None:
    """Takes the certificate from a resolved motion whose arcs collide, if it was resolved by its chords."""
    if work.turns is None or work.on_arcs:
        return
    work.write_arcs()
    wp.capture_if(work.arcs.turning, _find, work=work)


def _find(work):
    detector, ends = work.detector, (work.step.motion.x0, work.vertices.x1)
    retry_until_fits(lambda: detector.find_contacts(*ends, proximities=False), detector, work.device)
    queues = queues_of(detector)
    for pair in (queues[:2], queues[2:]) if queues[2:] else (queues[:2],):
        inputs = [*pair, detector.counters.array, detector.capacities, work.arcs, work.step, work.status]
        work.launch_over_entries(_count_contacts, inputs)
    work.arcs.turning.zero_()  # the next step begins by chords
    work.arcs.deviation.zero_()
