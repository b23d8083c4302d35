"""The hooks of Newton's coupled solvers for a stage behind another solver: that solver's, and what the stage adds."""

import warp as wp
from newton import BodyFlags, ParticleFlags, StateFlags
from newton.solvers import SolverBase
from newton.solvers.experimental.coupled import CouplingInterface

from ..state.motion import ModelMotion, continues
from ..state.poses import inertia_at
from ..state.structs import Motion, Vertices
from ..state.vectors import to_double, to_single
from ..substeps.inner_contacts import InnerContacts

wp.set_module_options({"enable_backward": False})


def _make_find_starts(kind: type) -> wp.Kernel:
    """Returns the kernel below for poses or positions: of a generic one, a graph on the CPU runs the wrong overload."""

    @wp.kernel(enable_backward=False, module="unique")
    def find_starts(
        # in
        motion: Motion,
        ends: wp.array[kind],
        world: wp.array[int],
        flags: wp.array[int],
        proxy: int,
        places: wp.array[kind],
        # out
        starts: wp.array[kind],
    ):
        """Writes where bodies or particles start: proxies where the last step ended, others where they are.

        So are proxies in a world in which no step has ended yet, or that was reset.
        """
        i = wp.tid()
        starts[i] = places[i]
        if flags[i] & proxy != 0 and continues(motion, world[i]):
            starts[i] = ends[i]

    return find_starts


_find_starts_of_bodies, _find_starts_of_particles = _make_find_starts(wp.transform), _make_find_starts(wp.vec3)


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
    """Adds the changes of momentum by the response, angular momentum about centres of mass [N s, N m s]."""
    i = wp.tid()
    if i < of_particles.shape[0] and vertices.outcome[i] != 0:
        of_particles[i] += particle_mass[i] * (vertices.velocity[i] - motion.velocity[i])
    if i < vertices.bodies.outcome.shape[0] and vertices.bodies.outcome[i] != 0:
        change = vertices.bodies.velocity[i] - motion.bodies.velocity[i]
        inertia = inertia_at(motion.bodies, i, vertices.bodies.pose[i])
        angular = to_single(inertia * to_double(wp.spatial_bottom(change)))
        of_bodies[i] += wp.spatial_vector(motion.bodies.mass[i] * wp.spatial_top(change), angular)


def _make_add_forces(kind: type) -> wp.Kernel:
    """Returns the kernel below for wrenches or forces, see :func:`_make_find_starts`."""

    @wp.kernel(enable_backward=False, module="unique")
    def add_forces(
        # in
        impulses: wp.array[kind],
        proxy: wp.array[int],
        dt: float,
        # out
        forces: wp.array[kind],
    ):
        """Adds the forces that make impulses on bodies or particles in a step, to the places of their proxies."""
        i = wp.tid()
        if proxy[i] >= 0:
            wp.atomic_add(forces, proxy[i], impulses[i] / dt)

    return add_forces


_add_wrenches, _add_forces = _make_add_forces(wp.spatial_vector), _make_add_forces(wp.vec3)


def _is_default(solver, hook):
    """Returns whether a solver has a hook of the interface itself."""
    return getattr(type(solver), hook, None) in (None, getattr(CouplingInterface, hook))


class CouplingHooks(CouplingInterface):
    """Makes a stage with an inner ``solver`` an entry of ``newton.solvers.experimental.coupled``.

    Hooks are those of the inner solver, or those that the interface derives from the model if it has none, with two
    additions. A proxy, which the coupler sets to the pose of its source before a step, moves from where it was at the
    end of the last step: so nothing is passed where the two differ. Each pass of a coupler over a step begins where the
    first one did. And what the response changes of the momentum of a proxy is fed back to its source, also by inner
    solvers that harvest only the forces of their own contacts.

    The source feels the impulses on its proxy a step late. If a contact stops a proxy outright, as one of a finger and
    cloth on another finger does, ``mode="staggered"`` is stable if the proxy has less than 4/3 of the mass of the
    source along the contact. Some solvers, such as ``SolverMuJoCo``, give proxies an average over directions, which may
    be more: choose ``mass_scale`` then. With ``mode="lagged"`` and one pass, errors grow by a factor of 1.2 to 1.7 in
    each step behind VBD, whatever the mass and the relaxation, because VBD takes the way from the last pose of a proxy
    to its source for a velocity: the two bounce apart.

    The stage resolves and certifies the motion in the view of its entry: that of the entry's own particles, of proxies,
    and of the shapes that the entry sees. Particles of another entry without proxies are obstacles if the view has
    their faces. They take the way of the last step in the present one: two entries may pass through each other in one
    step, and are pushed back in the next. The report counts a step for each substep of the entry and each pass.
    ``SolverCoupledADMM`` takes hard attachments of bodies to particles for those of one entry only if its solver is
    ``SolverVBD`` itself: behind a stage it raises, and warns of soft ones, which VBD applies all the same.

    Attributes:
        solver: The inner solver.
    """

    solver: SolverBase

    _motion: ModelMotion
    _coupled: "_Coupled | None" = None  # None outside coupled simulations
    _inner_contacts: InnerContacts | None = None  # None where the inner solver gets all contacts

    def _hook(self, name):
        return getattr(self.solver if isinstance(self.solver, CouplingInterface) else super(), name)

    def coupling_notify_iteration_restarts(self, enabled: bool) -> None:
        """Delegates to the inner solver, and prepares for a coupled simulation.

        Its first step begins where its state is: joints that the view of the entry lacks may place proxies.
        """
        self._hook("coupling_notify_iteration_restarts")(enabled)
        self._motion.interrupt()
        self._coupled = _Coupled(self.model, self._motion, restarts=enabled)

    def coupling_notify_input_state_update(self, state, flags, *, iteration_restart=False, dt=0.0) -> None:
        """Delegates to the inner solver; in a step, makes proxies move from where they were at the end of the last."""
        options = {"iteration_restart": iteration_restart, "dt": dt}
        self._hook("coupling_notify_input_state_update")(state, flags, **options)
        if self._coupled is not None and int(flags) & (StateFlags.BODY_Q | StateFlags.PARTICLE_Q):
            self._coupled.update_input(**options)

    def coupling_harvest_proxy_wrenches(self, body_local_to_proxy_global, out_body_f, **options) -> None:
        """Delegates to the inner solver, and adds the forces of the response if that does not see them."""
        hook = "coupling_harvest_proxy_wrenches"
        self._harvest(hook, _add_wrenches, "body_impulses", body_local_to_proxy_global, out_body_f, options)

    def coupling_harvest_proxy_particle_forces(self, particle_local_to_proxy_global, out_particle_f, **options) -> None:
        """Delegates to the inner solver, and adds the forces of the response if that does not see them."""
        hook = "coupling_harvest_proxy_particle_forces"
        self._harvest(hook, _add_forces, "particle_impulses", particle_local_to_proxy_global, out_particle_f, options)

    def _harvest(self, hook, kernel, name, proxy, forces, options):
        if self._inner_contacts is not None and options["contacts"] is not None:
            options["contacts"] = self._inner_contacts.packed(options["contacts"])
        self._hook(hook)(proxy, forces, **options)
        if self._coupled is not None and not _is_default(self.solver, hook):  # that sees the changed velocities
            impulses = getattr(self._coupled, name)
            inputs = [impulses, proxy, options["dt"]]
            wp.launch(kernel, len(impulses), inputs=inputs, outputs=[forces], device=impulses.device)


def _delegate(name):
    """Returns a hook that is that of the inner solver."""

    def hook(self, *arguments, **options):
        return self._hook(name)(*arguments, **options)

    hook.__name__ = name
    hook.__doc__ = "Delegates to the inner solver."
    return hook


for _name in dir(CouplingInterface):
    if _name.startswith("coupling_") and _name not in vars(CouplingHooks):
        setattr(CouplingHooks, _name, _delegate(_name))


class _Coupled:
    """What a stage keeps for a coupler: where proxies were, where a step began, and the impulses on proxies."""

    def __init__(self, model, motion, *, restarts):
        self._model, self._motion, device = model, motion, model.device
        self._last, self._first, self._start = model.state(), model.state(), model.state()
        self._continues = False
        starts = motion.starts() if restarts else []
        self._starts = [(start, wp.clone(start)) for start in starts]
        self.body_impulses = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=device)
        self.particle_impulses = wp.zeros(model.particle_count, dtype=wp.vec3, device=device)

    def update_input(self, *, iteration_restart, dt):
        """Notes that a coupler has set positions for a pass over a step of length ``dt``; 0 where it has for a reset.

        Each pass begins where the first one did, also where that is not where the positions are.
        """
        if dt <= 0.0:  # ``reset`` interrupts the motion
            return
        if iteration_restart:
            for start, kept in self._starts:
                wp.copy(start, kept)
        elif not self._continues:
            _copy_positions(self._first, self._last)
            for start, kept in self._starts:
                wp.copy(kept, start)
        self._continues = True
        self.body_impulses.zero_()  # those of an earlier pass
        self.particle_impulses.zero_()

    def start_of(self, state):
        """Returns the state that a step starts from, as far as positions go, given that which it is called with."""
        if not self._continues:
            return state
        self._continues = False
        model, first, start = self._model, self._first, self._start
        bodies = first.body_q, model.body_world, model.body_flags, int(BodyFlags.PROXY), state.body_q
        particles = first.particle_q, model.particle_world, model.particle_flags, int(ParticleFlags.PROXY)
        particles += (state.particle_q,)
        for kernel, arrays, starts in (
            (_find_starts_of_bodies, bodies, start.body_q),
            (_find_starts_of_particles, particles, start.particle_q),
        ):
            if starts is not None:
                inputs = [self._motion.vertices, *arrays]
                wp.launch(kernel, len(starts), inputs=inputs, outputs=[starts], device=model.device)
        return start

    def finish(self, state, motion, vertices):
        """Notes where a step has ended, and what the response did."""
        _copy_positions(self._last, state)
        outputs = [self.particle_impulses, self.body_impulses]
        inputs, size = [motion, vertices, self._model.particle_mass], max(map(len, outputs))
        wp.launch(_add_impulses, size, inputs=inputs, outputs=outputs, device=self._model.device)


def _copy_positions(to, state):
    for name in ("particle_q", "body_q"):
        if getattr(to, name) is not None:
            wp.copy(getattr(to, name), getattr(state, name))
