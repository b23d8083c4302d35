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
"""

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverBase

from ..._arguments import checked_distance, checked_number
from ..._one_thread import one_at_a_time
from ..._private_names.of_warp import paused_tape
from ...detection.host_function import run_on_host
from ...detection.launch import retry_until_fits
from ...detection.pipeline import DetectionPipeline
from ..adjoint.arrays import copied, filled, launch_adjoint, with_gradients
from ..contacts.queue import PairQueue, queues_of
from ..integration.wrapped_solver import WrappedSolver
from ..options import StageOptions, friction_of, particle_edge_lengths
from ..state.mesh import ModelMesh
from ..state.motion import ModelMotion, arrays_of
from ..tuning import LAYER_THICKNESS, PAIRS_PER_FACE
from . import kernels


class ContactLayer(WrappedSolver):
    """Lets another solver step, then pushes what has come into a layer around all surfaces.

    Behind it, ``SolverCCD(ContactLayer(solver))``, the stage resolves what the layer leaves: pairs that passed each
    other since the start of the step, and contacts with dynamic bodies that the inner solver integrates. With the layer
    results are continuous in the inputs, and gradients hold where contacts come and go. Pushes conserve linear
    momentum, but angular momentum only to the first order of the step, as they act along directions at y (see above).

    Cloth rests on the layer, and should start outside of it: otherwise it is pushed out within a few steps.

    Limitations:
        Only contacts within one step are seen: what a program moves between steps is passed on to the stage. On a tape,
        a layer carries no gradients to poses of bodies: a step raises NotImplementedError if shapes move with bodies.

    References:
        R. Tonge, F. Benevolenski and A. Voroshilov, Mass Splitting for Jitter-Free Parallel Rigid Body Simulation, ACM
        Transactions on Graphics 31(4), 2012, doi:10.1145/2185520.2185601.

    Attributes:
        solver: The inner solver.
        mesh: The triangles that collide, :class:`.state.mesh.ModelMesh`.
        thickness: Thickness of the layer [m].
        friction: Coefficients of particles, Warp array of float, shape [1] or [particle_count].
        restitution: Share of the approaching velocity that comes back, Warp array of float, shape [1].
    """

    def __init__(
        self,
        solver: SolverBase,
        *,
        thickness: float | None = None,
        friction: float | wp.array[float] | None = None,
        restitution: float | wp.array[float] | None = None,
        min_distance: float | None = None,
        particle_radius: float | np.ndarray | wp.array | None = None,
    ):
        """Puts the layer around a solver.

        Args:
            solver: Any Newton solver that moves particles.
            thickness: Thickness of the layer [m], above the minimum distances. It should be more than the longest path
                of a step, and less than half of the shortest edge, as neighbours beyond the next push each other as
                well. Default: a quarter of the median edge length, at most 0.45 of the shortest.
            friction: As for :class:`.solver_ccd.SolverCCD`, like ``restitution`` and ``particle_radius``.
            restitution: Share of the approaching velocity that comes back, in [0, 1].
            min_distance: Distance of pairs at the bottom of the layer [m]; None or 0: they touch.
            particle_radius: Radius of each particle [m], shape [particle_count], or one for all.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number, or the friction of a shape that collides with particles, is out of range.
            NotImplementedError: If the model has shapes that are not supported, see :class:`.state.mesh.ModelMesh`.
        """
        super().__init__(solver)
        options = StageOptions.of(
            self.model,
            friction=friction,
            restitution=restitution,
            min_distance=min_distance,
            particle_radius=particle_radius,
        )
        self.mesh = mesh = ModelMesh(self.model, strands=options.keeps_distances)
        self.friction, self.restitution = options.friction, options.restitution
        self._reads_friction = options.reads_friction
        if thickness is None:
            lengths = particle_edge_lengths(mesh)
            shares = np.array(LAYER_THICKNESS) * ((np.median(lengths), lengths.min()) if len(lengths) else (1.0, 1.0))
            thickness = float(shares.min())
        self.thickness = checked_distance(thickness, "thickness", zero=False)
        moves_bodies = options.moves_bodies(mesh, solver)
        self._motion = ModelMotion(mesh, friction_of(mesh, self.friction), moves_bodies=moves_bodies)
        layer = kernels.Layer()
        layer.thickness, layer.restitution = self.thickness, self.restitution
        layer.motion, layer.planes = self._motion.vertices, self._motion.planes
        layer.distances = mesh.min_distances(options.min_distance, options.radii, reach=self.thickness)
        device, n = mesh.device, mesh.vertex_count
        pairs_per_face = None if device.is_cpu else PAIRS_PER_FACE
        self._detector = DetectionPipeline(mesh, pairs_per_face=pairs_per_face, min_distances=layer.distances)
        self._y = wp.zeros(n, dtype=wp.vec3, device=device)
        self._share_sums = wp.zeros(n, dtype=wp.int64, device=device)
        layer.shares = wp.zeros(n, dtype=wp.float64, device=device)
        self._layer = layer
        self._sums = wp.zeros((n, 3), dtype=wp.int64, device=device)
        self.skipped = wp.zeros(1, dtype=wp.int64, device=device)
        self._motion.set_start(arrays_of(self.model))
        self._motion.set_end(arrays_of(self.model), 1.0)
        self._detect()  # allocates buffers, which a CUDA graph cannot

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
            NotImplementedError: If a tape records gradients, and shapes move with bodies.
            RuntimeError: If another thread is using this layer.
        """
        checked_number(dt, "dt", 0.0, above=True)
        with paused_tape() as tape:
            if tape is not None and self.model.requires_grad:
                if state_in is state_out:
                    raise ValueError("on a tape, state_out must not be state_in")
                if self.mesh.has_shapes_on_bodies:
                    raise NotImplementedError(
                        "on a tape, a contact layer carries no gradients to poses of bodies: omit the layer"
                    )
            self._motion.set_start(arrays_of(state_in))
        self.solver.step(state_in, state_out, control, contacts, dt, **options)
        with paused_tape() as tape:
            end, device = arrays_of(state_out), self.mesh.device
            if end.particle_q is None:
                return
            if tape is None or not end.particle_q.requires_grad:
                run_on_host(lambda: self._push(end, dt), device)
                return
            arrays = [state_in.particle_q, end.particle_q, end.particle_qd]
            read = [self._motion.friction.of_particles, self._motion.friction.of_shapes, self.restitution]
            read = [a for a in [*read, self.model.particle_inv_mass] if a is not None and len(a) and a.requires_grad]
            pushed: tuple[kernels.Layer, list[PairQueue]] | None = None

            def forward():
                nonlocal pushed
                pushed = self._push(end, dt, record=True)

            def backward():
                assert pushed is not None
                with self._lock:
                    self._backward(*pushed, *(array.grad for array in arrays))

            run_on_host(forward, device)
            tape.record_func(lambda: run_on_host(backward, device), [*arrays, *read])

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
        self._detect()
        layer, detector = self._layer, self._detector
        layer.dt = dt
        pairs = queues_of(detector)
        self._launch_over(kernels.sum_shares, pairs, self._share_sums)
        inputs = [layer, detector.counters.array, detector.capacities, self._share_sums, self.skipped]
        self._launch(kernels.finish_shares, len(self._y), inputs)
        self._launch_over(kernels.sum_pushes, pairs, self._sums)
        recorded = self._recorded(pairs) if record else None
        self._launch(kernels.move_particles, len(end.particle_q), [layer, self._sums, end])
        return recorded

    def _backward(self, layer, pairs, start_q, particle_q, particle_qd):
        """Turns gradients with respect to a pushed state into those with respect to the predicted one, in place.

        Adds to the gradients of positions at the start, of inverse masses, of what coefficients of friction are read
        from, and of restitution, where these have such arrays.
        """
        n, particles, device = len(layer.motion.x0), len(particle_q), self.mesh.device
        of_changes = wp.zeros(n, dtype=wp.vec3, device=device)
        self._launch(kernels.begin_backward, particles, [layer, particle_q, particle_qd, of_changes])
        motion, of_motion = with_gradients(layer.motion, ("x0", "x1", "inverse_mass", "friction"))
        planes, of_planes = with_gradients(layer.planes, ["friction"])
        layer, of_layer = with_gradients(layer, ["shares"])
        layer.motion, layer.planes, of_shares = motion, planes, of_layer.shares
        over_planes = (particles, len(planes.end))
        for queue in pairs:
            launch_adjoint(kernels.sum_pushes, len(queue.pairs), [layer, queue, None], [of_changes], device)
        launch_adjoint(kernels.add_pushes_of_planes, over_planes, [layer], [of_changes], device)
        for queue in pairs:
            launch_adjoint(kernels.sum_shares, len(queue.pairs), [layer, queue, None], [of_shares], device)
        launch_adjoint(kernels.add_shares_of_planes, over_planes, [layer], [of_shares], device)
        inverse_mass = self.model.particle_inv_mass
        assert inverse_mass is not None
        self._launch(kernels.finish_backward, particles, [of_motion, start_q, particle_q, inverse_mass.grad])
        self._motion.friction.backward(of_motion.friction, of_planes.friction)

    def _recorded(self, pairs):
        """Copies the layer and the pairs that may be in it for the adjoint; in a CUDA graph, all of the queues."""
        copies = []
        for queue in pairs:
            if count := filled(queue.pairs, queue.counts, queue.count):
                copies.append(copied(queue, {"pairs": count, "counts": None}))
        layer = copied(self._layer, ("shares",))
        layer.motion = copied(self._motion.vertices, ("x0", "x1", "is_not_finite", "friction"))
        layer.planes = copied(self._motion.planes, ("start", "end", "friction"))
        return layer, copies

    def _launch(self, kernel, size, inputs):
        wp.launch(kernel, size, inputs=inputs, device=self.mesh.device)

    def _launch_over(self, kernel, pairs, sums):
        """Launches a kernel over pairs: those found on the CPU, on one thread, as sums are not atomic."""
        for queue in pairs:
            on_cpu = self.mesh.device.is_cpu
            count = filled(queue.pairs, queue.counts, queue.count) if on_cpu else len(queue.pairs)
            self._launch(kernel, count, [self._layer, queue, sums, None])

    @one_at_a_time
    def notify_model_changed(self, flags: int) -> None:
        """Notifies the inner solver, and reads masses and flags of particles again; shapes stay as they were."""
        super().notify_model_changed(flags)
        self.mesh.refresh_inverse_masses()
