"""A layer around all surfaces in which contacts push gradually, so that what comes of a step is continuous.

A contact that acts where it hits makes trajectories jump: whether a hit falls into this step or the next decides which
velocities the inner solver sees in the next. In the layer a contact is a spring with a damper instead. It acts at the
positions y = x1 + theta (x0 - x1) between start and end of the step, and removes the share kappa of the depth of its
pair in the layer at y; velocities change by as much over the length of the step. Alone, such a depth obeys a linear
recurrence, with kappa and theta such that its roots are rho exp(+-i pi / 4): four steps after it came in, the pair
leaves with rho^4 of its speed, which is the restitution, whatever the speed and whatever part of a step it came in at.

Contacts of one vertex divide its mass among them, by the squares of their depths (mass splitting, Tonge et al. 2012):
one pass without sweeps, in which a contact that comes or goes does nothing at that moment. Several contacts push a
little less than one, so that some hundredths more of the speed come back. Friction is Coulomb's where contacts slide
fast; near its limit it is less, without a corner, so that what rests on a slope creeps. All is differentiable, see
:meth:`ContactLayer.backward`.
"""

from dataclasses import dataclass

import warp as wp

from ...detection.approach_phase import MinDistances
from ...detection.launch import retry_until_fits
from ...detection.pipeline import DetectionPipeline
from ..adjoint.arrays import attach_gradients, launch_adjoint
from ..contacts.queue import PairQueue, queues_of
from ..state.friction import Friction
from ..state.mesh import ModelMesh
from ..state.motion import ModelMotion
from ..state.planes import MovingPlanes
from ..state.structs import Motion
from ..tuning import PAIRS_PER_FACE
from .kernels import (
    Layer,
    add_pushes,
    add_pushes_of_planes,
    add_shares,
    add_shares_of_planes,
    begin_backward,
    finish_backward,
    finish_shares,
    move_particles,
    place_vertices_between,
    sum_pushes,
    sum_shares,
)


@dataclass(frozen=True)
class PushedStep:
    """What :meth:`ContactLayer.backward` needs of a step.

    Attributes:
        motion: The motion that was predicted.
        planes: The planes.
        pairs: The pairs that may be in the layer, of each kind.
        shares: The sums of what the contacts of each vertex count.
        dt: Length of the step [s].
    """

    motion: Motion
    planes: MovingPlanes
    pairs: list[PairQueue]
    shares: wp.array
    dt: float


class ContactLayer:
    """Pushes what comes into a layer around all surfaces, before :class:`.response.Response` resolves hits.

    Pairs that passed each other since the start of the step are left to that, and so are contacts with bodies that the
    response moves. Pushes conserve linear momentum, but angular momentum only to the first order of the step, as they
    act along directions at y.
    """

    def __init__(
        self,
        mesh: ModelMesh,
        friction: Friction,
        *,
        thickness: float,
        restitution: wp.array[float],
        distances: MinDistances,
        layerless_steps: wp.array[wp.int64],
    ):
        """Allocates buffers.

        Args:
            mesh: The mesh.
            friction: The coefficients of its vertices and planes.
            thickness: Of the layer [m].
            restitution: Share of the approaching velocity that comes back, in [0, 1], array of one float.
            distances: Minimum distances of pairs, above which the layer begins; their reach is the thickness.
            layerless_steps: Is increased in a step in which a queue of a CUDA graph was too small, and the layer pushed
                nothing, array of one int.
        """
        self._mesh, self._friction, self._device = mesh, friction, mesh.device
        self._layerless_steps = layerless_steps
        self._layer = layer = Layer()
        layer.thickness, layer.distances, layer.restitution = thickness, distances, restitution
        pairs_per_face = None if mesh.device.is_cpu else PAIRS_PER_FACE
        self._detector = DetectionPipeline(mesh, pairs_per_face=pairs_per_face, keeping=distances)
        n = mesh.vertex_count
        self._y = wp.zeros(n, dtype=wp.vec3, device=self._device)
        self._share_sums = wp.zeros(n, dtype=wp.int64, device=self._device)
        self._shares = wp.zeros(n, dtype=wp.float64, device=self._device)
        self._sums = wp.zeros((n, 3), dtype=wp.int64, device=self._device)

    def prepare(self, motion: ModelMotion) -> None:
        """Finds the pairs that may be in the layer; allocates buffers, which a CUDA graph cannot."""
        detector = self._detector
        self._launch(place_vertices_between, len(self._y), [motion.vertices, self._layer, self._y])
        retry_until_fits(lambda: detector.find_contacts(self._y, self._y), detector, self._device)

    def push(
        self,
        motion: ModelMotion,
        particle_q: wp.array[wp.vec3],
        particle_qd: wp.array[wp.vec3],
        dt: float,
        *,
        record: bool = False,
    ) -> PushedStep | None:
        """Changes the predicted motion, and the state that it was copied from, by the pushes of contacts in the layer.

        Args:
            motion: The motion.
            particle_q: The predicted positions of particles.
            particle_qd: Their predicted velocities.
            dt: Length of the step [s].
            record: Whether to return what :meth:`backward` needs; None otherwise.
        """
        self.prepare(motion)
        vertices, layer, detector = motion.vertices, self._layer, self._detector
        n = len(vertices.x1)
        pairs = queues_of(detector)
        for of_kind in pairs:
            self._launch_over(sum_shares, of_kind, [vertices, layer, of_kind, self._share_sums])
        inputs = [vertices, motion.planes, layer, detector.counters.array, detector.capacities]
        self._launch(finish_shares, n, [*inputs, self._share_sums, self._shares, self._layerless_steps])
        for of_kind in pairs:
            self._launch_over(sum_pushes, of_kind, [vertices, layer, of_kind, self._shares, self._sums])
        step = self._recorded(motion, pairs, dt) if record else None
        inputs = [vertices, motion.planes, layer, self._shares, dt, self._sums]
        self._launch(move_particles, len(particle_q), [*inputs, particle_q, particle_qd])
        return step

    def backward(
        self,
        step: PushedStep,
        start_q: wp.array[wp.vec3],
        particle_q: wp.array[wp.vec3],
        particle_qd: wp.array[wp.vec3],
    ) -> None:
        """Turns gradients with respect to a pushed state into those with respect to the predicted one, in place.

        Adds to the gradients of inverse masses, of what coefficients of friction are read from, and of restitution,
        where these have such arrays.

        Args:
            step: The step.
            start_q: Gradient with respect to positions at the start, shape [particle_count]; is added to.
            particle_q: Gradient with respect to the pushed positions; becomes that with respect to the predicted ones.
            particle_qd: The same for the velocities.
        """
        motion, planes, layer, device = step.motion, step.planes, self._layer, self._device
        n, particles = len(motion.x0), len(particle_q)
        of_changes, changes = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
        self._launch(begin_backward, particles, [motion.is_not_finite, step.dt, particle_q, particle_qd, of_changes])
        of_motion = attach_gradients(motion, ("x0", "x1", "inverse_mass", "friction"))
        of_planes = attach_gradients(planes, ("friction",))
        shares = step.shares[:]
        shares.grad = of_shares = wp.zeros(n, dtype=wp.float64, device=device)
        sums = wp.zeros(n, dtype=wp.float64, device=device)
        over_planes = (particles, len(planes.end))
        for of_kind in step.pairs:
            inputs = [motion, layer, of_kind, shares]
            launch_adjoint(add_pushes, len(of_kind.pairs), inputs, [changes], [of_changes], device)
        inputs = [motion, planes, layer, shares]
        launch_adjoint(add_pushes_of_planes, over_planes, inputs, [changes], [of_changes], device)
        for of_kind in step.pairs:
            inputs = [motion, layer, of_kind]
            launch_adjoint(add_shares, len(of_kind.pairs), inputs, [sums], [of_shares], device)
        launch_adjoint(add_shares_of_planes, over_planes, [motion, planes, layer], [sums], [of_shares], device)
        inverse_mass = self._mesh.model.particle_inv_mass
        assert inverse_mass is not None
        inputs = [of_motion.x0, of_motion.x1, of_motion.inverse_mass]
        outputs = [start_q, particle_q, inverse_mass.grad]
        self._launch(finish_backward, particles, [*inputs, *outputs])
        self._friction.backward(of_motion.friction, of_planes.friction)

    def _recorded(self, motion, pairs, dt):
        """Copies what the adjoint of a step needs; in a CUDA graph, all of the queues."""
        copies = []
        for of_kind in pairs:
            copy = PairQueue()
            copy.kind, copy.count, copy.elements = of_kind.kind, of_kind.count, of_kind.elements
            count = len(of_kind.pairs)
            if not self._device.is_capturing:
                count = min(count, int(of_kind.counts.numpy()[of_kind.count]))
            if count:
                copy.pairs, copy.counts = wp.clone(of_kind.pairs[:count]), wp.clone(of_kind.counts)
                copies.append(copy)
        kept = Motion()
        for name in ("x0", "x1", "is_not_finite", "friction"):
            setattr(kept, name, wp.clone(getattr(motion.vertices, name)))
        kept.inverse_mass, kept.world = motion.vertices.inverse_mass, motion.vertices.world
        planes = MovingPlanes()
        for name in MovingPlanes.vars:
            array = getattr(motion.planes, name)
            setattr(planes, name, wp.clone(array) if name in ("start", "end", "friction") else array)
        return PushedStep(kept, planes, copies, wp.clone(self._shares), dt)

    def _launch(self, kernel, size, inputs):
        wp.launch(kernel, size, inputs=inputs, device=self._device)

    def _launch_over(self, kernel, of_kind, inputs):
        """Launches a kernel over the pairs of a kind: those found on the CPU, on one thread, as sums are not atomic."""
        count = len(of_kind.pairs)
        if self._device.is_cpu:
            count = min(count, int(of_kind.counts.numpy()[of_kind.count]))
        self._launch(kernel, count, inputs)
