"""Newton's ``CouplingInterface`` for a stage behind another solver: the hooks of that solver, with two additions."""

from typing import Any

import warp as wp
from newton import BodyFlags, ParticleFlags, StateFlags
from newton.solvers.experimental.coupled import CouplingInterface, ModelView

from ..._private_names.of_newton import COUPLERS_DECLARE_RESTARTS
from ..._private_names.of_warp import paused_tape
from ...detection.run.host_function import run_on_host
from ..state.motion import StateArrays, arrays_of, continues
from ..state.poses import in_world
from ..state.structs import Motion, Vertices
from ..state.vectors import to_double, to_single
from ..state.workspace import Workspace
from ..wrapped_solver import WrappedSolver, innermost
from .snapshot import Snapshot

wp.set_module_options({"enable_backward": False})


def _make_kernels(kind: type, force: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the kernels below for bodies or particles: a graph on the CPU runs wrong overloads of generic ones."""

    @wp.kernel(enable_backward=False, module="unique")
    def find_starts(
        # in
        motion: Motion,
        ends: wp.array[kind],
        world: wp.array[int],
        flags: wp.array[int],
        proxy: int,
        given: wp.array[kind],
        # out
        starts: wp.array[kind],
    ):
        """Writes where bodies or particles start: proxies where the last step ended, others where they are.

        In a world that was reset, or in which no step has ended yet, proxies also start where they are.
        """
        i = wp.tid()
        starts[i] = given[i]
        if flags[i] & proxy != 0 and continues(motion, world[i]):
            starts[i] = ends[i]

    @wp.kernel(enable_backward=False, module="unique")
    def add_forces(impulses: wp.array[force], proxy: wp.array[int], dt: float, forces: wp.array[force]):
        """Adds the forces that make impulses on bodies or particles in a step, at the indices of their proxies."""
        i = wp.tid()
        if proxy[i] >= 0:
            wp.atomic_add(forces, proxy[i], impulses[i] / dt)

    return find_starts, add_forces


_find_starts_of_bodies, _add_wrenches = _make_kernels(wp.transform, wp.spatial_vector)
_find_starts_of_particles, _add_forces = _make_kernels(wp.vec3, wp.vec3)


@wp.kernel
def _add_impulses(
    # in
    motion: Motion,
    vertices: Vertices,
    particle_mass: wp.array[float],
    # in and out
    of_particles: wp.array[wp.vec3],
    of_bodies: wp.array[wp.spatial_vector],
):
    """Adds the changes of momentum by the response [N s], and of angular momentum about centres of mass [N m s]."""
    i = wp.tid()
    if i < of_particles.shape[0] and vertices.outcome[i] != 0:
        of_particles[i] += particle_mass[i] * (vertices.velocity[i] - motion.velocity[i])
    if i < vertices.bodies.outcome.shape[0] and vertices.bodies.outcome[i] != 0:
        change = vertices.bodies.velocity[i] - motion.bodies.velocity[i]
        inertia = in_world(motion.bodies.inertia[i], vertices.bodies.pose[i])
        angular = to_single(inertia * to_double(wp.spatial_bottom(change)))
        of_bodies[i] += wp.spatial_vector(motion.bodies.mass[i] * wp.spatial_top(change), angular)


def _is_default(solver, hook):
    """Returns whether a hook of a solver is the default of the interface."""
    return getattr(type(innermost(solver)), hook, None) in (None, getattr(CouplingInterface, hook))


class CouplingHooks(WrappedSolver):
    """Makes a stage with an inner ``solver`` an entry of ``newton.solvers.experimental.coupled``.

    Hooks are those of the inner solver, or the defaults of the interface if it has none, with two additions:

    - A proxy, which the coupler sets to the pose of its source before a step, starts where the last step ended, so that
      it passes nothing on the way between. Each pass of a coupler over a step starts where the first one did.
    - The change of momentum of a proxy by the response is fed back to its source, also if the inner solver harvests
      only the forces of its own contacts.

    The source feels the impulses on its proxy a step late. If a contact stops a proxy outright, for example of a finger
    that presses cloth on another finger, ``mode="staggered"`` is stable if the proxy has less than 4/3 of the mass of
    the source along the contact. Some solvers, such as ``SolverMuJoCo``, give proxies an average over directions, which
    may be more: choose ``mass_scale`` then. With ``mode="lagged"`` and one pass, errors grow by a factor of 1.2 to 1.7
    in each step behind VBD, whatever the mass and the relaxation, because VBD derives a velocity from the way of a
    proxy from its last pose to its source: the two bounce apart.

    The stage resolves the motion in the view of its entry: its own particles, proxies where the stage has pushed them,
    and the shapes that the entry has. The coupler moves bodies and particles of other entries, so that they may be
    elsewhere in the state of the program. Therefore, if the entry sees some, the certificate of a step is of that
    state, and given once the coupler gives it to the entry: when the next step begins, or when the program calls
    ``coupled.sync_entry_states(state)``. Until then ``report.certified`` is false, and ``report.totals.unseen_steps``
    counts the step. A step that is then not free of collisions is counted in ``uncertified_steps`` and
    ``revoked_steps``, and warned of with the names of the bodies. A body that the program itself moves between two
    steps counts as moved in the first. What is reset before it was seen is not seen.

    Limitations:
        What other entries move meets the certificate where they end, not the response: two entries may pass through
        each other in a step, which is then not certified, and are pushed back in the next. Particles of another entry
        without proxies lag a step. What the entry does not see is not certified; a warning names shapes that are not
        seen. The report counts a step for each substep of the entry and each pass.

        ``SolverCoupledADMM`` handles hard attachments of bodies to particles within one entry only if its solver is
        ``SolverVBD`` itself: behind a stage it raises, and warns of soft ones, which VBD applies all the same.
    """

    _work: Workspace
    _coupled: "_Coupled | None" = None  # None outside coupled simulations

    def _prepare_entry(self) -> None:
        """Prepares for a coupled simulation at construction, if couplers do not declare one: they give views."""
        if not COUPLERS_DECLARE_RESTARTS and isinstance(self.model, ModelView):
            self.coupling_notify_iteration_restarts(True)

    def coupling_notify_iteration_restarts(self, enabled: bool) -> None:
        """Delegates to the inner solver, and prepares for a coupled simulation.

        The first step starts where its state is: joints that the view of the entry lacks may place proxies.
        """
        if COUPLERS_DECLARE_RESTARTS:
            self._hook("coupling_notify_iteration_restarts")(enabled)
        self.work.motion.last.interrupt()
        self._coupled = _Coupled(self.work, self._make_check(), restarts=enabled)

    def _make_check(self) -> Any:
        """Returns the :class:`.coupled_check.CoupledCheck` of the steps; None if the entry sees nothing of others."""
        raise NotImplementedError

    def coupling_notify_input_state_update(self, state, flags, *, iteration_restart=False, dt=0.0) -> None:
        """Delegates to the inner solver, after a look at where the last step ended, if the coupler gives that.

        In a step, proxies then start where the last step ended. If it is but a look, for which a program has asked,
        nothing is delegated: VBD would begin the next step anew.
        """
        options = {"iteration_restart": iteration_restart, "dt": dt}
        if self._coupled is not None and not iteration_restart:
            self._coupled.see(state, int(flags), dt)
            if dt <= 0.0 and self._coupled.has_stepped:
                return
        self._hook("coupling_notify_input_state_update")(state, flags, **options)  # which may move proxies
        if self._coupled is not None and int(flags) & (StateFlags.BODY_Q | StateFlags.PARTICLE_Q):
            self._coupled.update_input(**options)

    def coupling_harvest_proxy_wrenches(self, body_local_to_proxy_global, out_body_f, **options) -> None:
        """Delegates to the inner solver, and adds the forces of the response unless the hook includes them."""
        kind = "coupling_harvest_proxy_wrenches", "body_impulses", _add_wrenches
        self._harvest(*kind, body_local_to_proxy_global, out_body_f, options)

    def coupling_harvest_proxy_particle_forces(self, particle_local_to_proxy_global, out_particle_f, **options) -> None:
        """Delegates to the inner solver, and adds the forces of the response unless the hook includes them."""
        kind = "coupling_harvest_proxy_particle_forces", "particle_impulses", _add_forces
        self._harvest(*kind, particle_local_to_proxy_global, out_particle_f, options)

    def _harvest(self, hook, impulses, kernel, proxy, forces, options):
        self._hook(hook)(proxy, forces, **options)
        if self._coupled is not None and not _is_default(self.solver, hook):  # which includes changes of velocities
            added = getattr(self._coupled, impulses)
            inputs = [added, proxy, options["dt"]]
            wp.launch(kernel, len(added), inputs=inputs, outputs=[forces], device=added.device)


class _Coupled:
    """State of a stage in a coupled simulation: where a step starts, and the impulses of the response."""

    def __init__(self, work: Workspace, check, *, restarts):
        self._model, self.work, self.check, self._last = work.mesh.model, work, check, work.motion.last
        model, device = self._model, work.device
        kinds = (StateFlags.PARTICLE_Q, model.particle_count), (StateFlags.BODY_Q, model.body_count)
        self._all_positions = sum(int(flag) for flag, count in kinds if count)
        self._start, self._before = model.state(), Snapshot(self._last.arrays if restarts else [])
        self._continues = False
        self.has_stepped = False  # since the last reset
        self.body_impulses = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=device)
        self.particle_impulses = wp.zeros(model.particle_count, dtype=wp.vec3, device=device)

    def see(self, state, flags, dt):
        """Checks the last step if this is the state of the program, before the first pass over a step of ``dt`` [s].

        If ``dt`` is 0, the program has asked the coupler to give its state.
        """
        if self.check is None or self._continues or flags & self._all_positions != self._all_positions:
            return
        given, own, begins = arrays_of(state), StateArrays(), dt > 0.0
        own.particle_q, own.body_q = self._last.positions, self._last.poses
        with paused_tape():
            run_on_host(lambda: self.check.see(given, own, begins=begins), self._model.device)

    def update_input(self, *, iteration_restart, dt):
        """Prepares for a pass over a step, for which a coupler has set positions; ``dt`` is 0 if no step begins.

        Each pass starts where the first one did, whatever the positions are.
        """
        if dt <= 0.0:  # ``reset`` interrupts the motion
            return
        if iteration_restart:
            self._before.restore()
        elif not self._continues:
            self._before.save()
        self._continues = True
        self.body_impulses.zero_()  # those of an earlier pass
        self.particle_impulses.zero_()

    def lose(self, world_mask):
        """Takes into account that worlds were reset, ``world_mask`` as of :meth:`.LastStep.interrupt`."""
        self.has_stepped = False
        if self.check is not None:
            self.check.lose(world_mask)

    def start_of(self, state):
        """Returns a state with the positions from which a step starts, given the state that it is called with."""
        if not self._continues:
            return state
        self._continues = False
        for kernel, kind, ends, proxy in (
            (_find_starts_of_bodies, "body", self._last.poses, BodyFlags.PROXY),
            (_find_starts_of_particles, "particle", self._last.positions, ParticleFlags.PROXY),
        ):
            given, starts = (getattr(x, f"{kind}_q") for x in (state, self._start))
            if starts is not None:
                of_model = [getattr(self._model, f"{kind}_{name}") for name in ("world", "flags")]
                inputs = [self.work.step.motion, ends, *of_model, int(proxy), given]
                self.work.launch(kernel, len(starts), inputs, [starts])
        return self._start

    def finish(self):
        """Adds the impulses of the response in a step."""
        self.has_stepped = True
        outputs = [self.particle_impulses, self.body_impulses]
        inputs = [self.work.step.motion, self.work.vertices, self._model.particle_mass]
        self.work.launch(_add_impulses, max(map(len, outputs)), inputs, outputs)
        if self.check is not None:
            self.check.end()
