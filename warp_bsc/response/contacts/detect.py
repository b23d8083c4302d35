"""Detects the contacts of a motion, makes constraints or dividing planes of them, and decides what follows."""

import warp as wp

from ...detection.broad_phase_hierarchy import BroadPhaseHierarchy
from ...detection.launch import retry_until_fits
from ...detection.settings import Count, PairKind
from ..schedule import decide
from ..state.workspace import Workspace
from .collect import collect_contacts, collect_penetrations, count_crossings, drop_if_full
from .constraints import Contacts
from .impacts import count_grazing
from .search import find_contacts_without_queues


def detect_crossings(work: Workspace) -> None:
    """Counts the edges that cross faces at the start of the step, if they may have changed since the last."""
    wp.capture_if(work.status.loop.recount, _count_crossings, work=work)


def _count_crossings(work):
    motion, candidates, crossings = work.motion.vertices, work.crossing_candidates, work.status.results.crossings
    crossings.zero_()
    retry_until_fits(lambda: candidates.find(motion.x0), candidates, work.device)
    inputs = [motion, work.connectivity, candidates.pairs, candidates.counts, crossings]
    work.launch_over(count_crossings, [(candidates.pairs, candidates.counts, Count.QUEUED)], inputs)


def detect_penetrations(work: Workspace, *, ahead: bool) -> None:
    """Adds constraints for vertices that enter solids of planes; ``ahead`` of the first detection also those near."""
    motion = work.motion
    inputs = [motion.vertices, work.vertices, motion.planes, work.constraints, work.dividing, work.status]
    work.launch(collect_penetrations, work.vertices_at_planes, [*inputs, work.separation, ahead])


def detect(work: Workspace, *, only_changed: bool = False) -> None:
    """Detects the motion as it is now, adds constraints for its contacts, and decides whether to iterate again.

    Args:
        work: The workspace of the step.
        only_changed: Whether only vertices that changed since the last detection are looked at.
    """
    detector, motion, vertices = work.detector, work.motion.vertices, work.vertices
    changed = vertices.changed if only_changed else None
    retry_until_fits(
        lambda: detector.find_contacts(motion.x0, vertices.x1, refit=only_changed, changed=changed),
        detector,
        work.device,
    )
    work.reserve(work.max_contacts)
    if only_changed:  # before, nothing has changed, and there is always enough
        vertices.changed.zero_()
        work.launch(drop_if_full, 1, [work.constraints, work.record, work.max_contacts])
    of_elements, of_points = contacts_of(work)
    can_search = not work.differentiable and isinstance(detector.broad_phase, BroadPhaseHierarchy)
    overflow = [detector.counters.array, detector.capacities, can_search]
    for contacts in (of_elements, of_points) if of_points else (of_elements,):
        inputs = [motion, vertices, *contacts, work.constraints, work.dividing, work.status, work.separation]
        work.launch_over(collect_contacts, _queues(contacts), [*inputs, *overflow])
    if work.recorder is not None:
        work.launch_over(count_grazing, _queues(of_elements), [motion, vertices, *of_elements, work.record])
    if work.max_penetrations:
        detect_penetrations(work, ahead=False)
    work.launch(decide, 1, [work.constraints, *overflow], [work.status])
    if can_search:
        wp.capture_if(work.status.results.undetected, _search, work=work, overflow=overflow)


def _search(work, overflow):
    """Completes a detection whose queues were too small: all contacts that are left are divided from here on."""
    broad_phase, motion = work.detector.broad_phase, work.motion.vertices
    broad_phase.fit(motion.x0, work.vertices.x1)
    arguments = work.connectivity, motion, work.vertices, work.dividing, work.status, work.separation
    find_contacts_without_queues(broad_phase, *arguments)
    if work.max_penetrations:
        detect_penetrations(work, ahead=False)
    work.launch(decide, 1, [work.constraints, *overflow], [work.status])


def contacts_of(work: Workspace) -> tuple[list[Contacts], list[Contacts]]:
    """Returns the contacts that the last detection found: vertex-face and edge-edge, and those of points."""
    contacts = []
    for narrow_phase, elements in elements_of(work):
        of_kind, found = Contacts(), narrow_phase.contacts
        of_kind.mesh, of_kind.elements = work.connectivity, elements
        of_kind.kind, of_kind.edges = int(narrow_phase.kind), int(narrow_phase.kind == PairKind.EDGE_EDGE)
        of_kind.counts, of_kind.pairs, of_kind.status = narrow_phase.counts, found.pairs, found.status
        of_kind.within_tolerance, of_kind.toi = found.within_tolerance, found.toi
        of_kind.coordinates, of_kind.normal = found.coordinates, found.normal
        contacts.append(of_kind)
    return contacts[:2], contacts[2:]


def elements_of(work: Workspace) -> list[tuple]:
    """Returns each narrow phase with the vertices of its second elements, those of points last."""
    return [(n, work.detector.mesh.device_elements(n.kind)) for n in work.detector.narrow_phases]


def _queues(contacts):
    return [(of_kind.pairs, of_kind.counts, Count.CONTACTS) for of_kind in contacts]
