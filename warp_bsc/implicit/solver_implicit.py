"""The solver with contact inside: inertia, elasticity, contact and friction in one solve of each step."""

import functools

import newton
import warp as wp
from newton import ParticleFlags
from newton.solvers import SolverBase

from ..detection.host_function import run_on_host
from ..response.solver_ccd import SolverCCD
from ..response.state.motion import arrays_of
from ..response.step import begin, detect_contacts, resolve_contacts
from .contact import steps
from .contact.newton_method import NewtonMethod

MAX_STEPS = 4


class _Inertia(SolverBase):
    """Moves particles as if nothing but gravity and external forces acted on them; bodies stay where they are."""

    def step(self, state_in, state_out, control, contacts, dt):
        """Writes the positions and velocities that inertia leads to."""
        model = self.model
        if state_in.body_q is not None and state_in is not state_out:
            wp.copy(state_out.body_q, state_in.body_q)
            wp.copy(state_out.body_qd, state_in.body_qd)
        inputs = [state_in.particle_q, state_in.particle_qd, state_in.particle_f, model.particle_inv_mass]
        inputs += [model.particle_flags, int(ParticleFlags.ACTIVE), model.gravity, model.particle_world, float(dt)]
        outputs = [state_out.particle_q, state_out.particle_qd]
        wp.launch(steps.predict_positions, model.particle_count, inputs=inputs, outputs=outputs, device=model.device)


class SolverImplicit(SolverCCD):
    """Steps cloth and soft bodies with contact in the solve."""

    def __init__(self, model: newton.Model, *, max_newton_steps: int = MAX_STEPS, **options):
        """Prepares steps of a model."""
        super().__init__(_Inertia(model), substeps=None, contact_layer=False, restitution=0.0, **options)
        self._newton = NewtonMethod(self._work, max_steps=max_newton_steps)

    def _finish_step(self, state_in, state_out, control, contacts, passed, dt, options, tape):
        end = arrays_of(state_out)
        solve = functools.partial(self._solve, end, dt)
        run_on_host(lambda: self._resolve(end, dt, solve, self._mask), self.mesh.device)

    def _solve(self, end, dt):
        work = self._work
        begin(work)
        self._newton.solve(end.particle_q, end.particle_qd, dt)
        detect_contacts(work)
        resolve_contacts(work, dt)
