"""Whether a step behind a coupled solver is free of collisions in the state that the program gets.

The stage of an entry knows where the elements of other entries end only once the coupler gives it that state: in the
next step, or when the program calls ``sync_entry_states``. Until then its step is not certified. Then the motion is
detected once more, with its own elements where it left them, and those of other entries where they have been and are.
"""

from collections import Counter

import numpy as np
import warp as wp
from newton import BodyFlags, Model, ParticleFlags, ShapeFlags

from ...detection.at_rest.intersections import find_intersections
from ..contacts.detect import inspect
from ..report.totals import StepTotals
from ..state.certificate import certify, is_certified, revoke
from ..state.last_step import interrupt_worlds
from ..state.mesh import ModelMesh
from ..state.motion import ModelMotion, StateArrays, arrays_of
from ..state.status import Loop, Result, SolveStatus
from ..state.structs import add_zeros
from ..state.workspace import Workspace

wp.set_module_options({"enable_backward": False})


@wp.struct
class _Step:
    """The last step of an entry, until its end is seen."""

    awaits: wp.array[int]  # 1 if the end in the state of the program has not been seen
    certified: wp.array[int]  # 1 if it is certified as the entry sees it
    certified_worlds: wp.array[wp.bool]  # the same by world; empty if the report has no worlds
    lost: wp.array[int]  # by world, then of any: 1 where the end cannot be seen any more


@wp.struct
class _Others:
    """Which elements are of other entries."""

    particle_flags: wp.array[int]
    bodies: wp.array[int]  # 1 of those
    particle_world: wp.array[int]
    body_world: wp.array[int]


@wp.func
def _is_of_other_entry(others: _Others, particle: int) -> bool:
    flags = others.particle_flags[particle]
    return flags & ParticleFlags.PROXY != 0 or flags & ParticleFlags.ACTIVE == 0


@wp.func
def _is_lost(lost: wp.array[int], world: int) -> bool:
    return lost[wp.where(world < 0, lost.shape[0] - 1, world)] == 1


@wp.kernel
def _await(results: wp.array[int], worlds: wp.array[wp.bool], step: _Step, totals: StepTotals):
    """Takes the certificate from a step whose end is not seen yet; of several passes over a step, from the last."""
    i = wp.tid()
    if i < worlds.shape[0]:
        step.certified_worlds[i] = worlds[i]
        worlds[i] = False
    if i == 0:
        step.certified[0] = results[Result.CERTIFIED]
        revoke(results)
        totals.unseen_steps[0] += wp.int64(1 - step.awaits[0])
        step.awaits[0] = 1


@wp.kernel
def _find_lost(
    given: StateArrays, own: StateArrays, inverse_mass: wp.array[float], others: _Others, lost: wp.array[int]
):
    """Marks worlds in which the program has moved movable particles of the entry since the end of the step."""
    i = wp.tid()
    if inverse_mass[i] == 0.0 or _is_of_other_entry(others, i):
        return
    for axis in range(3):
        if given.particle_q[i][axis] != own.particle_q[i][axis]:
            lost[others.particle_world[i]] = 1
            lost[lost.shape[0] - 1] = 1


@wp.kernel
def _write_end(
    # in
    start: StateArrays,
    given: StateArrays,
    own: StateArrays,
    others: _Others,
    lost: wp.array[int],
    # out
    end: StateArrays,
):
    """Writes where a step ended in the state of the program; nothing moves in worlds whose end cannot be seen."""
    i = wp.tid()
    if i < end.particle_q.shape[0]:
        if _is_lost(lost, others.particle_world[i]):
            end.particle_q[i] = start.particle_q[i]
        elif _is_of_other_entry(others, i):
            end.particle_q[i] = given.particle_q[i]
        else:
            end.particle_q[i] = own.particle_q[i]
    if i < end.body_q.shape[0]:
        if _is_lost(lost, others.body_world[i]):
            end.body_q[i] = start.body_q[i]
        elif others.bodies[i] == 1:
            end.body_q[i] = given.body_q[i]
        else:
            end.body_q[i] = own.body_q[i]


@wp.kernel
def _conclude(
    # in
    seen: SolveStatus,
    crossings: wp.array[int],
    # in and out
    results: wp.array[int],
    worlds: wp.array[wp.bool],
    step: _Step,
    totals: StepTotals,
):
    """Certifies a step whose end has been seen, or counts that it is not certified.

    What crosses or touches at its start is excluded from detection: there may be no more of it than the entry sees.
    """
    i = wp.tid()
    if i < worlds.shape[0]:
        free = seen.of_worlds.remaining[i] == 0 and seen.crossings[i] <= crossings[i] and step.lost[i] == 0
        worlds[i] = step.certified_worlds[i] and free
    if i == 0:
        is_lost = step.lost[step.lost.shape[0] - 1] == 1
        is_free = is_certified(seen.results)
        is_free = is_free and seen.results[Result.CROSSINGS] <= results[Result.CROSSINGS]
        is_free = is_free and seen.results[Result.EXCLUDED] <= results[Result.EXCLUDED]
        if not is_free or not is_lost:
            totals.unseen_steps[0] -= wp.int64(1)
        if not is_free:
            totals.uncertified_steps[0] += wp.int64(step.certified[0])
            totals.revoked_steps[0] += wp.int64(step.certified[0])
            if results[Result.NEW_CROSSINGS] == 0:  # a step that has some is counted
                totals.penetrated_steps[0] += wp.int64(step.certified[0])
        elif not is_lost:
            certify(results, step.certified[0] == 1)
        step.awaits[0] = 0


class CoupledCheck:
    """Checks the steps of an entry in the states that the program gets, on the device.

    Attributes:
        mesh: The mesh of the stage.
        bodies: The bodies of other entries, sorted, int32, shape [n].
    """

    def __init__(self, work: Workspace, results: wp.array[int], totals: StepTotals, worlds: wp.array[wp.bool] | None):
        """Allocates a detection of its own, for a stage with a workspace, results, totals and certificates by world."""
        self._of_stage, self._results, self._totals, self._worlds = work, results, totals, worlds
        self.mesh, model, device = work.mesh, work.mesh.model, work.device
        self._motion = motion = ModelMotion(self.mesh, work.motion.friction, watches_turns=True)
        options = {"separation": work.step.separation, "restitution": work.step.restitution}
        self._work = Workspace(motion, **options)
        if worlds is not None:
            self._work.count_worlds()
        self._step, self._others = step, others = _Step(), _Others()
        add_zeros(step, ("awaits", "certified"), 1, device)
        add_zeros(step, ["certified_worlds"], 0 if worlds is None else len(worlds), device)
        add_zeros(step, ["lost"], len(motion.last.interrupted), device)
        others.particle_flags, others.particle_world = model.particle_flags, self.mesh.device_world
        self.bodies = bodies_of_other_entries(model)
        others.bodies = wp.array(np.isin(np.arange(model.body_count), self.bodies), dtype=int, device=device)
        others.body_world = model.body_world
        self._start, self._end = model.state(), model.state()
        self._inspect()
        motion.last.begin()
        step.lost.fill_(1)

    @property
    def crossings(self) -> int:
        """Edges that cross faces at the start of the last step that was seen, in the state of the program."""
        return int(self._work.results[Result.CROSSINGS].numpy()[0])

    def lose(self, world_mask: wp.array[wp.bool] | None = None) -> None:
        """Gives up the end of the step in worlds that are reset, with a mask as of :meth:`.LastStep.interrupt`."""
        interrupt_worlds(self._step.lost, world_mask)

    def end(self) -> None:
        """Takes the certificate from the step that has ended, until its end is seen."""
        work = self._of_stage
        work.launch(_await, work.worlds, [self._results, self._worlds, self._step, self._totals])

    def see(self, given: StateArrays, own: StateArrays, *, begins: bool) -> None:
        """Checks the step that awaits it, given the state of the program; keeps the start of a step that ``begins``.

        The stage's ``own`` state is that at the end of the step, as the stage made it.
        """
        wp.capture_if(self._step.awaits, self._see, given=given, own=own)
        if begins:
            wp.copy(self._motion.last.interrupted, self._step.lost)
            self._step.lost.zero_()
            self._motion.set_start(given)
            for name in ("particle_q", "body_q"):
                if getattr(given, name) is not None:
                    wp.copy(getattr(self._start, name), getattr(given, name))

    def _see(self, given, own):
        step, others, end = self._step, self._others, arrays_of(self._end)
        size = len(given.particle_q) if given.particle_q is not None else 0
        self._work.launch(_find_lost, size, [given, own, self.mesh.inverse_masses, others, step.lost])
        size = max(size, len(others.bodies))
        self._work.launch(_write_end, size, [arrays_of(self._start), given, own, others, step.lost, end])
        self._inspect()
        inputs = [self._work.status, self._of_stage.status.crossings, self._results, self._worlds, step, self._totals]
        self._work.launch(_conclude, self._work.worlds, inputs)

    def _inspect(self):
        """Detects the motion from the start to the end, and counts what crosses at the start."""
        self._motion.set_end(arrays_of(self._end), 1.0)
        self._work.loop[Loop.RECOUNT].fill_(1)
        inspect(self._work)
        self._motion.last.end(self._end.body_q, self._motion.planes.end)

    def find_bodies(self) -> np.ndarray:
        """Returns the bodies of other entries that the certificate of the last step lacks, sorted, int32, shape [n].

        These are all of them if the end of the step is not seen yet, else those that have contacts or crossings in the
        last step that was seen. Gathered on the host.
        """
        if self._step.awaits.numpy()[0]:
            return self.bodies
        return self.find_passed()

    def find_passed(self) -> np.ndarray:
        """Returns the bodies of other entries with contacts or crossings in the last step that was seen, as above."""
        mesh, first = self.mesh, self.mesh.model.particle_count
        listed = self._work.vertices.changed.numpy() != 0
        for x in (self._motion.vertices.x0, self._work.vertices.x1):
            if np.isfinite(x.numpy()).all():
                pairs = find_intersections(mesh, x)
                crossing = np.concatenate([mesh.edges[pairs[:, 0]].ravel(), mesh.faces[pairs[:, 1]].ravel()])
                listed[crossing] = True
        return np.intersect1d(mesh.shape_vertices.body[listed[first:]], self.bodies).astype(np.int32)


def bodies_of_other_entries(model: Model) -> np.ndarray:
    """Returns the bodies in the view of an entry that another one steps: proxies and those without dynamics, int32."""
    if not model.body_count:
        return np.empty(0, dtype=np.int32)
    flags, mass, inverse = (getattr(model, f"body_{name}").numpy() for name in ("flags", "mass", "inv_mass"))
    of_others = ((flags & int(BodyFlags.PROXY)) != 0) | ((mass > 0.0) & (inverse == 0.0))
    return np.flatnonzero(of_others).astype(np.int32)


def has_elements_of_other_entries(mesh: ModelMesh) -> bool:
    """Returns whether elements of other entries take part in a mesh."""
    model = mesh.model
    bodies = np.concatenate([mesh.shape_vertices.body, mesh.planes.body])
    if np.isin(bodies, bodies_of_other_entries(model)).any():
        return True
    flags = np.zeros(0, dtype=int) if model.particle_flags is None else model.particle_flags.numpy()
    of_others = ((flags & int(ParticleFlags.PROXY)) != 0) | ((flags & int(ParticleFlags.ACTIVE)) == 0)
    return bool(of_others[mesh.vertices[mesh.vertices < model.particle_count]].any())


def unseen_shapes(model: Model) -> list[str]:
    """Returns the labels of shapes that collide with particles, but not in the view of a model that an entry has."""
    parent = getattr(model, "parent", None)
    if parent is None:
        return []
    labels = Counter(_colliding(parent))
    labels.subtract(_colliding(model))
    return sorted(labels.elements())


def _colliding(model):
    if not model.shape_count:
        return []
    collide = (model.shape_flags.numpy() & int(ShapeFlags.COLLIDE_PARTICLES)) != 0
    return [model.shape_label[shape] for shape in np.flatnonzero(collide)]
