"""Detects the contacts of a motion, makes constraints or dividing planes of them, and decides what follows."""

import warp as wp

from ...detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from ...detection.run.launch import retry_until_fits
from ..schedule import decide, decide_worlds
from ..state.certificate import revoke_if_not_finite
from ..state.status import Loop, Result, SolveStatus
from ..state.workspace import Workspace
from .collect import clear_changed, collect_contacts, collect_penetrations, count_crossings, count_new_crossings
from .queue import queues_of
from .search import find_contacts_without_queues

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _finish_inspection(outcome: wp.array[int], particle_count: int, status: SolveStatus):
    """Makes the status of an inspection that of a step in which nothing was changed.

    The inspection took vertices without a finite end to stand. Their motion as it is stored is not certified.
    """
    vertex = wp.tid()
    if vertex == 0:
        status.results[Result.FIRST_HITS] = status.results[Result.REMAINING]
        status.results[Result.ITERATIONS] = 0
    revoke_if_not_finite(outcome[vertex], vertex < particle_count, status)


def inspect(work: Workspace) -> None:
    """Detects the contacts of a motion without movable bodies, and leaves it as it is.

    ``remaining`` of the status counts them.
    """
    work.begin()
    detect_crossings(work)
    detect(work)
    inputs = [work.vertices.outcome, work.particle_count]
    work.launch(_finish_inspection, len(work.vertices.outcome), inputs, [work.status])


def detect_crossings(work: Workspace) -> None:
    """Counts the edges that cross faces at the start of the step, if they may have changed since the last."""
    wp.capture_if(work.loop[Loop.RECOUNT], _count_crossings, work=work)


def _count_crossings(work):
    detector, crossings, of_edges = work.detector, work.results[Result.CROSSINGS], work.crossings_of_edges
    for counts in (crossings, work.results[Result.NEW_CROSSINGS], work.status.crossings, of_edges):
        counts.zero_()
    retry_until_fits(lambda: detector.find_edges_with_faces(work.step.motion.x0), detector, work.device)
    pairs = detector.edge_edge
    with work.all_worlds():
        inputs = [work.step, pairs.queue, pairs.counts, crossings, work.status.crossings, of_edges]
        work.launch_over_entries(count_crossings, inputs)
    work.launch(count_new_crossings, len(of_edges), [of_edges, work.last_crossings, work.status])


def detect_penetrations(work: Workspace, *, ahead: bool) -> None:
    """Adds constraints for vertices that enter solids of planes; ``ahead`` of the first detection also those near."""
    inputs = [work.step, work.motion.planes, ahead, work.dividing, work.status]
    work.launch(collect_penetrations, work.vertices_at_planes, inputs)


def detect(work: Workspace, *, only_changed: bool = False, keeps_constraints: bool = False) -> None:
    """Detects the motion as it is now, adds constraints for its contacts, and decides whether to iterate again.

    With ``only_changed``, only vertices that changed since the last detection are looked at. Those of earlier
    detections are dropped where there might be too many, unless ``keeps_constraints``: then new ones may be missing.
    """
    detector, vertices = work.detector, work.vertices
    changed = vertices.changed if only_changed else work.active
    work.write_arcs()

    def find():
        ends = work.step.motion.x0, vertices.x1
        detector.find_contacts(*ends, changed=changed, proximities=not only_changed)

    retry_until_fits(find, detector, work.device)
    work.reserve(work.max_contacts)
    if only_changed:  # before, nothing has changed, and there is always enough
        if keeps_constraints:
            vertices.changed.zero_()
        else:
            work.launch(clear_changed, len(vertices.changed), [work.step, work.max_contacts])
    queues = queues_of(detector)
    overflow = [detector.counters.array, detector.capacities]
    for pair in (queues[:2], queues[2:]) if queues[2:] else (queues[:2],):
        inputs = [*pair, *overflow, work.arcs, work.step, work.dividing, work.status]
        work.launch_over_entries(collect_contacts, inputs, is_large=True)
    _decide(work, overflow)
    wp.capture_if(work.loop[Loop.SEARCHING], _search, work=work, overflow=overflow)


def _search(work, overflow):
    """Finds contacts again where queues were too small: all that remain are divided from here on."""
    broad_phase = work.detector.broad_phase
    assert isinstance(broad_phase, BroadPhaseHierarchy)  # on the CPU queues always grow
    broad_phase.fit(work.step.motion.x0, work.vertices.x1)
    find_contacts_without_queues(broad_phase, work.step, work.arcs, work.dividing, work.status)
    _decide(work, overflow)


def _decide(work, overflow):
    if work.max_penetrations:
        detect_penetrations(work, ahead=False)
    if work.status.of_worlds.found is not None:
        work.launch(decide_worlds, work.worlds, [*overflow, work.status])
    work.launch(decide, 1, [work.step, *overflow], [work.status])
