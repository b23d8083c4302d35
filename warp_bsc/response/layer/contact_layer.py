"""A solver around another one that pushes gradually in a layer around all surfaces, so that results are continuous.

A contact that acts where it hits makes trajectories jump: whether a hit falls into this step or the next decides which
velocities the inner solver sees in the next. In the layer a contact is a spring with a damper instead. It acts at the
positions y = x1 + theta (x0 - x1) between start and end of the step, and removes the share kappa of the depth of its
pair in the layer at y; velocities change by as much over the length of the step. Alone, such a depth obeys a linear
recurrence, with kappa and theta such that its roots are rho exp(+-i pi / 4): four steps after it came in, the pair
leaves with rho^4 of its speed, which is the restitution, whatever the speed and whatever part of a step it came in at.

Contacts of one vertex divide its mass among them, by the squares of their depths (mass splitting, Tonge et al. 2012):
one pass without sweeps, in which a contact that comes or goes does nothing at that moment. Several contacts push a
little less than one, so that some hundredths more of the speed come back. Friction is Coulomb's where contacts slide
fast; near its limit it is less, without a corner, so that what rests on a slope creeps. All is differentiable.

A body takes part with its inverse mass at the contact, 1/m + (r x n) I^-1 (r x n), and divides it among its contacts in
the same way. Its pushes act where it was predicted to be.
"""

from typing import Literal

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ..._arguments import checked_distance, checked_number
from ..._one_thread import one_at_a_time
from ..._private_names.of_newton import SHAPES_CHANGE, body_q_prev
from ..._private_names.of_warp import paused_tape
from ..._warnings import warn_caller
from ...detection.pipeline import DetectionPipeline
from ...detection.run.host_function import run_on_host
from ...detection.run.launch import retry_until_fits
from ..adjoint.arrays import filled
from ..adjoint.pose_kernels import set_centres
from ..adjoint.structs import StateGradients
from ..contacts.queue import queues_of
from ..options import (
    Bodies,
    checked_bodies,
    checked_friction,
    checked_restitution,
    friction_of,
    in_eight_bits,
    moves_bodies,
    particle_edge_lengths,
)
from ..state.collision_filter import CollisionFilter, checked_filter
from ..state.friction_table import FrictionTable
from ..state.kept_distances import KeptDistances
from ..state.mesh import ModelMesh
from ..state.motion import ModelMotion, arrays_of
from ..state.structs import add_zeros
from ..tuning import LAYER_THICKNESS, PAIRS_PER_FACE, START_DEPTH
from ..wrapped_solver import WrappedSolver, innermost
from . import kernels
from .adjoint import RecordedPushes, go_back, record_pushes
from .pushes import Layer
from .thickness import ThicknessRule, choose_thickness, find_extremes


class ContactLayer(WrappedSolver):
    """Lets another solver step, then pushes what has come into a layer around all surfaces.

    Behind it, ``SolverCCD(ContactLayer(solver))``, the stage resolves what the layer leaves: pairs that passed each
    other since the start of the step. With the layer results are continuous in the inputs, and gradients hold where
    contacts come and go. Particles and dynamic bodies push each other, as in the stage. Pushes conserve linear
    momentum, but angular momentum only to the first order of the step, as they act along directions at y (see above).

    Cloth rests on the layer, and should start outside of it: otherwise it is pushed out within a few steps, and thrown,
    of which the layer warns in its first step. Elements that touch, at the start of a step or at its end, are delegated
    to the stage.

    Limitations:
        Only contacts within one step are seen: what a program moves between steps is passed on to the stage. Contacts
        between bodies, and of bodies with infinite planes, are delegated to the inner solver and the stage; they make
        results jump. So does what moves farther in a step than the layer is thick: behind the layer,
        ``report.gradient_counts.layer_passed_steps`` of the stage counts such steps.

    References:
        R. Tonge, F. Benevolenski and A. Voroshilov, Mass Splitting for Jitter-Free Parallel Rigid Body Simulation, ACM
        Transactions on Graphics 31(4), 2012, doi:10.1145/2185520.2185601.

    Attributes:
        solver: The inner solver.
        mesh: The triangles that collide, :class:`.state.mesh.ModelMesh`.
        friction: Coefficients of particles, Warp array of float, shape [1] or [particle_count].
        restitution: Share of the approaching velocity that comes back, Warp array of float, shape [1].
        thickness_values: Thickness [m], Warp array of float64, shape [1], as :attr:`thickness`.
        skipped: Steps as of :attr:`skipped_steps`, Warp array of int64, shape [1].
    """

    def __init__(
        self,
        solver: SolverBase,
        *,
        thickness: float | None = None,
        friction: float | wp.array[float] | FrictionTable | None = None,
        restitution: float | wp.array[float] | None = None,
        min_distance: float | Literal["model"] | None = None,
        particle_radius: float | np.ndarray | wp.array | None = None,
        collision_filter: CollisionFilter | None = None,
        bodies: Bodies = "pushed",
    ):
        """Puts the layer around a solver.

        Args:
            solver: Any Newton solver that moves particles.
            thickness: Thickness of the layer [m], above the minimum distances. It should be more than twice the longest
                path of a step, and with the minimum distance less than half of the shortest edge, as neighbours beyond
                the next push each other as well. Default: a quarter of the median edge length, or 0.45 of the shortest
                less the minimum distance where the first step shows that motion is too fast for that, see
                :mod:`.layer.thickness`.
            friction: As for :class:`.solver_ccd.SolverCCD`, like ``restitution`` and ``particle_radius``. A stage
                around the layer has its own: give it the same.
            restitution: Share of the approaching velocity that comes back, in [0, 1].
            min_distance: Distance of pairs at the bottom of the layer [m], or ``"model"``; None or 0: they touch.
            particle_radius: Radius of each particle [m], shape [particle_count], or one for all.
            collision_filter: Groups and masks of particles and shapes, as for :class:`.solver_ccd.SolverCCD`. A stage
                around the layer has its own: give it the same.
            bodies: Whether particles push dynamic bodies, as for :class:`.solver_ccd.SolverCCD`; ``"separated"`` is as
                ``"pushed"`` here.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number, or the friction of a shape that collides with particles, is out of range.
            NotImplementedError: If the model has shapes that are not supported, see :class:`.state.mesh.ModelMesh`.
        """
        super().__init__(solver)
        self.friction, table, self._reads_friction = checked_friction(friction, self.model)
        self.restitution = checked_restitution(restitution, self.model)
        distances, bodies = KeptDistances.of(self.model, min_distance, particle_radius), checked_bodies(bodies)
        collision_filter = checked_filter(collision_filter, self.model)
        self.mesh = mesh = ModelMesh(self.model, strands=distances.any, collision_filter=collision_filter)
        thin, thick = default_thicknesses(mesh, distances.largest)
        if thickness is not None:
            thin = thick = checked_distance(thickness, "thickness", zero=False)
        moves = moves_bodies(bodies, mesh, innermost(solver))
        self._motion = ModelMotion(mesh, friction_of(mesh, self.friction, table=table), moves_bodies=moves)
        layer, device = Layer(), mesh.device
        n, body_count = mesh.vertex_count, self.model.body_count if moves else 0
        layer.thickness = self.thickness_values = wp.full(1, thin, dtype=wp.float64, device=device)
        layer.restitution = self.restitution
        layer.motion, layer.planes = self._motion.vertices, self._motion.planes
        layer.distances = mesh.min_distances(distances, reach=thick)
        self._rule = rule = ThicknessRule()
        rule.thin, rule.thick = thin, thick
        add_zeros(rule, ["is_chosen"], 1, device)
        rule.is_chosen.fill_(int(thickness is not None))
        rule.least = wp.full(4, np.inf, dtype=float, device=device)
        rule.largest = wp.full(4, -np.inf, dtype=float, device=device)
        self._chooses_thickness, self._checks_start = thickness is None, True
        pairs = None if device.is_cpu else PAIRS_PER_FACE * len(mesh.faces)
        self._detector = DetectionPipeline(mesh, pairs=pairs, min_distances=layer.distances)
        self._y = wp.zeros(n, dtype=wp.vec3, device=device)
        self._share_sums = wp.zeros(n + body_count, dtype=wp.int64, device=device)
        layer.shares = wp.zeros(n + body_count, dtype=wp.float64, device=device)
        self._sums = wp.zeros((n + body_count, 6 if body_count else 3), dtype=wp.int64, device=device)
        if body_count:
            add_zeros(layer.bodies, ("centre", "inverse_inertia"), body_count, device)
            add_zeros(layer, ["changes"], body_count, device)
            self._poses = wp.zeros(body_count, dtype=wp.transform, device=device)
        self._layer, self._body_count = layer, body_count
        self.skipped, self._not_followed = (wp.zeros(1, dtype=wp.int64, device=device) for _ in range(2))
        self._detect()  # allocates buffers, which a CUDA graph cannot

    @property
    def thickness(self) -> float:
        """Thickness of the layer [m]; before the first step, that for slow motion. Synchronizes with the device."""
        return float(self.thickness_values.numpy()[0])

    @property
    def skipped_steps(self) -> int:
        """Steps so far in which the layer pushed nothing, because a queue of a CUDA graph was too small.

        Contacts then act where they hit, and results are not continuous. Synchronizes with the device.
        """
        return int(self.skipped.numpy()[0])

    @one_at_a_time
    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        **options,
    ) -> None:
        """Steps the inner solver, and pushes particles that have come into the layer.

        Arguments are those of :meth:`.stage.CollisionStage.step`; on a tape, ``state_out`` must not be ``state_in``.

        Raises:
            TypeError: If ``dt`` is no number.
            ValueError: If ``dt`` is not finite or not more than 0, or if a tape records gradients, and ``state_out`` is
                ``state_in``.
            RuntimeError: If another thread is using this layer.
        """
        checked_number(dt, "dt", 0.0, above=True)
        with paused_tape() as tape:
            if tape is not None and self.model.requires_grad and state_in is state_out:
                raise ValueError("on a tape, state_out must not be state_in")
            start = arrays_of(state_in)  # now: some solvers replace it
            self._motion.set_start(start)
        self.solver.step(state_in, state_out, control, contacts, dt, **options)
        with paused_tape() as tape:
            end, device = arrays_of(state_out), self.mesh.device
            if end.particle_q is None:
                return
            if tape is None or not end.particle_q.requires_grad:
                run_on_host(lambda: self._push(end, dt), device)
                return
            self._record(start, end, dt, tape)

    def _record(self, start, end, dt, tape):
        """Pushes the end of a step; a tape records the adjoint."""
        model, motion, device = self.model, self._motion, self.mesh.device
        of_state = StateGradients()
        arrays = {"start_q": start.particle_q, "particle_q": end.particle_q, "particle_qd": end.particle_qd}
        if model.body_count:
            arrays |= {"start_body_q": start.body_q, "body_q": end.body_q, "body_qd": end.body_qd}
        read = [*motion.friction.inputs, self.restitution, model.particle_inv_mass]
        if self._body_count:
            read += [model.body_inv_mass, model.body_inv_inertia, model.body_com]
        read = [array for array in read if array is not None and len(array) and array.requires_grad]
        pushed: RecordedPushes | None = None

        def forward():
            nonlocal pushed
            pushed = self._push(end, dt, record=True)

        def backward():
            assert pushed is not None
            for name, array in arrays.items():
                setattr(of_state, name, array.grad)
            with self._lock:
                go_back(pushed, motion, of_state)

        run_on_host(forward, device)
        tape.record_func(lambda: run_on_host(backward, device), [*arrays.values(), *read])

    def _detect(self):
        """Finds the pairs that may be in the layer."""
        detector = self._detector
        self._launch(kernels.place_vertices_between, len(self._y), [self._layer, self._y])
        retry_until_fits(lambda: detector.find_contacts(self._y, self._y), detector, self.mesh.device)

    @one_at_a_time
    def _push(self, end, dt, *, record=False):
        """Changes the end of a step by the pushes of contacts; returns what the adjoint needs if that is recorded."""
        if self._reads_friction:
            self._motion.friction.read()
        self._motion.set_end(end, dt)
        if self._chooses_thickness:
            self._choose_thickness(dt)
        if self._checks_start and not self.mesh.device.is_capturing:
            self._check_start()
        self._detect()
        layer, detector, bodies = self._layer, self._detector, self._body_count
        layer.dt = dt
        pairs = queues_of(detector)
        if bodies:
            motion = layer.motion
            self._launch(set_centres, bodies, [motion, motion.bodies.end, layer.bodies])
        self._launch_over(kernels.sum_shares, pairs, self._share_sums, None)
        inputs = [layer, detector.counters.array, detector.capacities, self._share_sums, self.skipped]
        self._launch(kernels.finish_shares, len(self._share_sums), inputs)
        self._launch_over(kernels.sum_pushes, pairs, self._sums, None, None)
        if bodies:
            self._launch(kernels.sum_body_pushes, bodies, [layer, self._sums])
            self._launch(kernels.push_poses, bodies, [layer, self._poses])
        recorded = record_pushes(layer, pairs, self._motion) if record else None
        self._launch(kernels.move_particles, len(end.particle_q), [layer, self._sums, end])
        if bodies:
            self._launch(kernels.move_bodies, bodies, [layer, self._poses, end, body_q_prev(self.solver)])
        return recorded

    def _check_start(self):
        """Warns of particles that start deep in the layer, in the first step outside a graph."""
        self._checks_start = False
        layer, count = self._layer, self.model.particle_count
        depths = wp.zeros(len(self._y), dtype=wp.float64, device=self.mesh.device)
        motion, planes = layer.motion, layer.planes
        x1, end = motion.x1, planes.end
        motion.x1, planes.end = motion.x0, planes.start
        self._detect()
        self._launch_over(kernels.find_depths, queues_of(self._detector), depths)
        self._launch(kernels.find_depths_at_planes, count, [layer, depths])
        motion.x1, planes.end = x1, end
        of_particles = depths.numpy()[:count] * (self.mesh.inverse_masses.numpy()[:count] > 0.0)
        deep = np.count_nonzero(of_particles > START_DEPTH * self.thickness)
        if deep:
            warn_caller(
                f"{deep} particles start up to {1e3 * of_particles.max():.3g} mm deep in the contact layer of "
                f"{1e3 * self.thickness:.3g} mm, which throws them out: start farther apart, or give SolverCCD a "
                "ContactLayer(solver, thickness=...) that is thinner"
            )

    def _choose_thickness(self, dt):
        """Chooses the thickness on the device, in the first step; a captured one may run again, and keeps it then."""
        gravity, rule = self.model.gravity, self._rule
        self._launch(find_extremes, len(self._y), [self._motion.vertices, self._motion.planes, gravity, rule])
        self._launch(choose_thickness, 1, [gravity, dt, rule, self.thickness_values])
        self._chooses_thickness = self.mesh.device.is_capturing

    def _launch(self, kernel, size, inputs):
        wp.launch(kernel, size, inputs=inputs, device=self.mesh.device)

    def _launch_over(self, kernel, pairs, *outputs):
        """Launches a kernel over pairs: those found on the CPU, on one thread, as sums are not atomic."""
        for queue in pairs:
            on_cpu = self.mesh.device.is_cpu
            count = filled(queue.pairs, queue.counts, queue.count) if on_cpu else len(queue.pairs)
            self._launch(kernel, count, [self._layer, queue, *outputs])

    @one_at_a_time
    def notify_model_changed(self, flags: int) -> None:
        """Notifies the inner solver, and reads masses and shapes again, see :class:`..stage.CollisionStage`."""
        super().notify_model_changed(flags)
        self.mesh.refresh_inverse_masses()
        if flags & SHAPES_CHANGE:
            self.mesh.follow_shapes(self._not_followed)  # the stage around the layer warns
            self._motion.friction.read_shapes(self.model)


def default_thicknesses(mesh: ModelMesh, of_pairs: float) -> tuple[float, float]:
    """Returns the default thickness for slow motion and that for fast motion [m], see :mod:`.layer.thickness`.

    They have eight bits, as :func:`.options.default_separation`.

    Args:
        mesh: The mesh.
        of_pairs: The largest minimum distance of a pair [m], above which the layer begins.
    """
    lengths = particle_edge_lengths(mesh)
    if not len(lengths) and mesh.model.particle_radius is not None:  # then diameters take the place of edges
        lengths = 2.0 * mesh.model.particle_radius.numpy()
        lengths = lengths[lengths > 0.0]
    shares = np.array(LAYER_THICKNESS) * ((np.median(lengths), lengths.min()) if len(lengths) else (1.0, 1.0))
    thick = max(shares[1] - of_pairs, 0.1 * shares[1])
    return in_eight_bits(min(shares[0], thick)), in_eight_bits(thick)
