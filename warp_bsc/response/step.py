"""One step: detects the contacts of a predicted motion, and moves vertices until the motion is certified without them.

Read :func:`resolve` first. Conditions are on the device, so that a CUDA graph holds them: ``wp.capture_if`` and
``wp.capture_while`` call a function if, or as long as, the only element of an array is not 0. What a world does in an
iteration, when it freezes and what makes a step uncertified stands in :mod:`.schedule`.

The vertices of each contact are moved apart in their end positions, and the changed motion is detected again. Bodies
that can be moved are projected with the particles, each by its pose, see :mod:`.solve.bodies`. Where the mesh has
minimum distances, a contact is a pair that comes nearer than it may.
"""

import warp as wp

from .._profiling import phase
from .contacts import detect, proximities
from .contacts.inversions import find_inversions
from .schedule import begin_prevention, decide_cut
from .solve import division, positions, velocities
from .solve.bodies import begin_bodies
from .state.status import Loop
from .state.workspace import Workspace


def resolve(work: Workspace, dt: float) -> None:
    """Makes the predicted motion free of its contacts, except for those that cannot be resolved.

    The motion is only read; buffers hold the result until the next step. ``dt`` is the length of the step [s].
    """
    find_contacts(work)
    resolve_contacts(work, dt)


def find_contacts(work: Workspace) -> None:
    """Detects the contacts of the motion, as the first half of :func:`resolve`."""
    begin(work)
    detect_contacts(work)


@phase("detect contacts")
def detect_contacts(work: Workspace) -> None:
    """Adds constraints for the contacts of the motion that :func:`begin` has initialized."""
    if work.max_penetrations:
        work.reserve(work.max_contacts)
        detect.detect_penetrations(work, ahead=True)
        positions.leave_planes(work)
    detect.detect(work)  # contacts become constraints; without any the motion is certified, and the step is done


def resolve_contacts(work: Workspace, dt: float) -> None:
    """Resolves the contacts that :func:`find_contacts` found, as the second half of :func:`resolve`."""
    wp.capture_if(work.loop[Loop.UNFINISHED], _resolve_contacts, work=work, dt=dt)


def _resolve_contacts(work, dt):
    add_proximities(work)
    wp.capture_while(work.loop[Loop.ACTIVE], _iterate, work=work, dt=dt)
    wp.capture_if(work.constraints.count, velocities.project, work=work, dt=dt)


def _iterate(work, dt):
    """Projects worlds, and divides those that are past their projections; then detects what has changed."""
    positions.project(work)
    division.divide(work, dt)
    detect.detect(work, only_changed=True)


@phase("inversions")
def resolve_inversions(work: Workspace, dt: float) -> None:
    """Counts the tetrahedra that the resolved motion inverts, and cuts paths until there is none, if that is asked for.

    Does nothing unless :meth:`.Workspace.watch_inversions` asks for it. The motion stays free of contacts. It is the
    last change of a step, after velocities: what it moves has the velocity of its path.
    """
    if work.tetrahedra is None:
        return
    find_inversions(work)
    if work.ends is not None:
        work.launch(begin_prevention, 1, [work.status])
        wp.capture_if(work.loop[Loop.ACTIVE], _prevent_inversions, work=work, dt=dt)


def _prevent_inversions(work, dt):
    wp.copy(work.ends, work.vertices.x1, count=work.particle_count)
    wp.capture_while(work.loop[Loop.ACTIVE], _iterate_cuts, work=work, dt=dt)
    work.launch_over_particles(division.take_velocities_of_paths, work.ends, dt)
    find_inversions(work)  # those that remain


def _iterate_cuts(work, dt):
    """Divides what collides, and cuts paths until no tetrahedron inverts; then detects what has changed."""
    division.divide(work, dt)
    find_inversions(work)
    work.launch(decide_cut, 1, [True, work.status])
    wp.capture_while(work.loop[Loop.CUTTING], _cut_paths, work=work)
    detect.detect(work, only_changed=True, keeps_constraints=True)


def _cut_paths(work):
    work.launch_over_particles(division.truncate_before_inversions, work.tetrahedra, work.dividing, work.status)
    find_inversions(work)
    work.launch(decide_cut, 1, [False, work.status])


@phase("add proximities")
def add_proximities(work: Workspace) -> None:
    """Adds constraints for near, slow pairs, in worlds with contacts: a stack is solved at once, not sheet by sheet."""
    wp.capture_if(work.loop[Loop.ACTIVE], proximities.add_proximities, work=work)


def prepare(work: Workspace) -> None:
    """Resolves the motion to allocate buffers, which a CUDA graph cannot; clears the status."""
    resolve(work, 1.0)
    for values in (work.status.loop, work.status.detection, work.status.results):
        values.zero_()
    work.vertices.outcome.zero_()


@phase("begin")
def begin(work: Workspace) -> None:
    """Initializes vertices and bodies by their prediction, and counts what crosses at the start, which is excluded."""
    work.begin()
    work.launch_over_bodies(begin_bodies)
    detect.detect_crossings(work)
