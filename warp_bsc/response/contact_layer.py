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

from ..detection.approach_phase import MinDistances
from ..detection.launch import retry_until_fits
from ..detection.pipeline import DetectionPipeline
from ..detection.rings import are_within_rings
from ..detection.settings import Count
from ..kernels.closest import closest_coordinates
from ..kernels.pipeline.pairs import distance_of_corners, firsts_of, points_of_pair
from ..kernels.pipeline.queues import is_filled
from ..kernels.polynomials import EDGE_EDGE, VERTEX_FACE
from .body_adjoint import attach_gradients, launch_adjoint
from .buffers import Motion
from .constraints import are_on_body, contact_friction, has_overflowed, to_double, to_single
from .friction import Friction
from .model_mesh import ModelMesh
from .model_motion import ModelMotion
from .planes import MovingPlanes, signed_distance
from .projection import with_delta

__all__ = ["ContactLayer", "PushedStep"]

_CONTACTS = wp.constant(int(Count.CONTACTS))
_UNITS = wp.constant(wp.float64(2.0**40))
"""Units in a metre and in 1; sums are of integers in these units, so that they are the same in any order."""
_ROOT_OF_2 = wp.constant(2.0**0.5)
_PARALLEL = wp.constant(wp.float64(0.03))
"""Squared sine of the angle of two edges at which their depth counts half: where they are parallel, their closest
points jump, and vertices hold them."""
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))

_PAIRS_PER_FACE = 32
"""Capacity of the detector's queues on a GPU, for each face: those of a CUDA graph cannot grow."""

_KERNEL = {"enable_backward": False}


@wp.struct
class _Pairs:
    """The pairs of one kind that may be in the layer."""

    kind: int
    elements: wp.array2d[int]
    pairs: wp.array[wp.vec2i]
    counts: wp.array[wp.int64]


@wp.struct
class _Layer:
    """The layer and what is at its bottom."""

    thickness: wp.float64  # [m]
    distances: MinDistances  # of pairs [m]
    restitution: wp.array[float]  # in [0, 1]


@wp.func
def _gains(restitution: float):
    """Returns kappa and theta of the layer for a coefficient of restitution.

    The roots of z^2 - (2 - 2 kappa + kappa theta) z + (1 - kappa + kappa theta) are rho exp(+-i pi / 4). Below a
    restitution of 1/4, theta is negative: contacts act where the motion would be somewhat later.
    """
    rho = float(0.0)
    if restitution > 0.0:  # at 0 there is no derivative
        rho = wp.sqrt(wp.sqrt(restitution))
    kappa = 1.0 + rho * (rho - _ROOT_OF_2)
    theta = rho * (2.0 * rho - _ROOT_OF_2) / kappa
    return wp.float64(kappa), wp.float64(theta)


@wp.func
def _between(x0: wp.vec3, x1: wp.vec3, theta: wp.float64) -> wp.vec3d:
    return to_double(x1) + theta * (to_double(x0) - to_double(x1))


@wp.func
def _weights(kind: int, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec4d:
    """Returns the weights of four vertices in the vector between the closest points of two elements."""
    if kind == EDGE_EDGE:
        at = closest_coordinates(EDGE_EDGE, b - a, d - c, c - a)
        return wp.vec4d(_ONE - at[0], at[0], at[1] - _ONE, -at[1])
    at = closest_coordinates(VERTEX_FACE, c - b, d - b, a - b)
    return wp.vec4d(_ONE, at[0] + at[1] - _ONE, -at[0], -at[1])


@wp.func
def _vector(weights: wp.vec4d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec3d:
    return weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d


@wp.func
def _is_on_the_same_side(motion: Motion, kind: int, corners: wp.vec4i, normal: wp.vec3d) -> bool:
    """Returns whether two elements were on the same sides of each other at the start: not if they have passed."""
    a = to_double(motion.x0[corners[0]])
    b = to_double(motion.x0[corners[1]])
    c = to_double(motion.x0[corners[2]])
    d = to_double(motion.x0[corners[3]])
    return wp.dot(normal, _vector(_weights(kind, a, b, c, d), a, b, c, d)) > _ZERO


@wp.func
def _contact_of_pair(motion: Motion, layer: _Layer, kind: int, corners: wp.vec4i):
    """Returns the weights of four vertices in a contact, its normal, and its depth in the layer [m], 0 if it is not."""
    _kappa, theta = _gains(layer.restitution[0])
    a = _between(motion.x0[corners[0]], motion.x1[corners[0]], theta)
    b = _between(motion.x0[corners[1]], motion.x1[corners[1]], theta)
    c = _between(motion.x0[corners[2]], motion.x1[corners[2]], theta)
    d = _between(motion.x0[corners[3]], motion.x1[corners[3]], theta)
    weights = _weights(kind, a, b, c, d)
    vector = _vector(weights, a, b, c, d)
    distance = wp.length(vector)
    depth = layer.thickness + distance_of_corners(kind, corners, layer.distances.radius) - distance
    if depth <= _ZERO or distance <= _ZERO:
        return weights, vector, _ZERO
    normal = vector / distance
    if are_within_rings(corners, firsts_of(kind), layer.distances.rings) or are_on_body(motion, corners):
        return weights, normal, _ZERO
    if not _is_on_the_same_side(motion, kind, corners, normal):
        return weights, normal, _ZERO
    if kind == EDGE_EDGE:
        u = b - a
        v = d - c
        sines = wp.length_sq(wp.cross(u, v))
        depth *= sines / (sines + _PARALLEL * wp.length_sq(u) * wp.length_sq(v))
    return weights, normal, depth


@wp.func
def _contact_with_plane(motion: Motion, planes: MovingPlanes, layer: _Layer, plane: int, vertex: int):
    """Returns the normal of a contact of a vertex with a plane, and its depth in the layer [m], 0 if it is not."""
    _kappa, theta = _gains(layer.restitution[0])
    end = planes.end[plane]
    normal = wp.vec3d(end[0], end[1], end[2])
    if planes.world[plane] >= 0 and planes.world[plane] != motion.world[vertex]:
        return normal, _ZERO
    before, error = signed_distance(planes.start[plane], motion.x0[vertex])
    after, _error = signed_distance(end, motion.x1[vertex])
    least = layer.distances.radius[vertex] + layer.distances.of_planes
    depth = layer.thickness + least - after - theta * (before - after)
    if not (depth > _ZERO and before >= -error):
        return normal, _ZERO
    return normal, depth


@wp.func
def _share_of(layer: _Layer, depth: wp.float64) -> wp.float64:
    """Returns what a contact of this depth counts where contacts divide the mass of a vertex."""
    return (depth / layer.thickness) * (depth / layer.thickness)


@wp.func
def _push(
    motion: Motion,
    layer: _Layer,
    normal: wp.vec3d,
    depth: wp.float64,
    path: wp.vec3d,
    resistance: wp.float64,
    friction: float,
) -> wp.vec3d:
    """Returns the push of a contact, an impulse times a time [kg m].

    Args:
        motion: The motion.
        layer: The layer.
        normal: The normal.
        depth: The depth [m].
        path: Of the first contact point relative to the second [m].
        resistance: The sum over its vertices of inverse mass, weight, and what all contacts of the vertex count [1/kg].
        friction: The coefficient.
    """
    kappa, _theta = _gains(layer.restitution[0])
    part = _share_of(layer, depth) / resistance  # the mass that the vertices have for this contact
    along = kappa * depth * part
    across = path - wp.dot(path, normal) * normal
    length = wp.length(across)
    if length == _ZERO:
        return along * normal
    holding = wp.float64(friction) * along / (length * part)  # more than 1 if friction could stop the contact
    return along * normal - across * (part * holding / wp.sqrt(_ONE + holding * holding))


@wp.func
def _resistance(motion: Motion, corners: wp.vec4i, weights: wp.vec4d, shares: wp.array[wp.float64]) -> wp.float64:
    resistance = _ZERO
    for j in range(4):
        vertex = corners[j]
        resistance += wp.abs(weights[j]) * wp.float64(motion.inverse_mass[vertex]) * shares[vertex]
    return resistance


@wp.func
def _push_of_pair(motion: Motion, layer: _Layer, kind: int, corners: wp.vec4i, shares: wp.array[wp.float64]):
    """Returns the weights of four vertices in a contact and its push, 0 if there is none."""
    weights, normal, depth = _contact_of_pair(motion, layer, kind, corners)
    resistance = _resistance(motion, corners, weights, shares)
    if depth <= _ZERO or resistance <= _ZERO:
        return weights, wp.vec3d()
    path = wp.vec3d()
    for j in range(4):
        vertex = corners[j]
        path += weights[j] * (to_double(motion.x1[vertex]) - to_double(motion.x0[vertex]))
    friction = contact_friction(motion.friction[corners[0]], motion.friction[corners[3]])
    return weights, _push(motion, layer, normal, depth, path, resistance, friction)


@wp.func
def _push_of_plane(
    motion: Motion, planes: MovingPlanes, layer: _Layer, plane: int, vertex: int, shares: wp.array[wp.float64]
) -> wp.vec3d:
    """Returns the push of a plane on a vertex, 0 if there is none."""
    normal, depth = _contact_with_plane(motion, planes, layer, plane, vertex)
    resistance = wp.float64(motion.inverse_mass[vertex]) * shares[vertex]
    if depth <= _ZERO or resistance <= _ZERO:
        return wp.vec3d()
    path = to_double(motion.x1[vertex]) - to_double(motion.x0[vertex])
    friction = contact_friction(motion.friction[vertex], planes.friction[plane])
    return _push(motion, layer, normal, depth, path, resistance, friction)


@wp.kernel(**_KERNEL)
def _place(motion: Motion, layer: _Layer, y: wp.array[wp.vec3]):
    """Writes the positions at which contacts act, to which the detection is near enough in single precision."""
    vertex = wp.tid()
    _kappa, theta = _gains(layer.restitution[0])
    y[vertex] = to_single(_between(motion.x0[vertex], motion.x1[vertex], theta))


@wp.kernel(**_KERNEL)
def _sum_shares(motion: Motion, layer: _Layer, of_kind: _Pairs, sums: wp.array[wp.int64]):
    """Adds what contacts count, by their weights, to the sums of their vertices."""
    i = wp.tid()
    if not is_filled(i, of_kind.pairs, of_kind.counts, _CONTACTS):
        return
    corners = points_of_pair(of_kind.kind, of_kind.elements, of_kind.pairs[i])
    weights, _normal, depth = _contact_of_pair(motion, layer, of_kind.kind, corners)
    if depth > _ZERO:
        for j in range(4):
            wp.atomic_add(sums, corners[j], wp.int64(wp.rint(_UNITS * wp.abs(weights[j]) * _share_of(layer, depth))))


@wp.kernel(**_KERNEL)
def _finish_shares(
    motion: Motion,
    planes: MovingPlanes,
    layer: _Layer,
    counts: wp.array[wp.int64],
    capacities: wp.array[wp.int64],
    sums: wp.array[wp.int64],
    shares: wp.array[wp.float64],
    layerless_steps: wp.array[wp.int64],
):
    """Adds what contacts with planes count, and writes the sums; zeros if pairs are missing, so that nothing pushes."""
    vertex = wp.tid()
    share = wp.float64(sums[vertex]) / _UNITS
    sums[vertex] = wp.int64(0)
    for plane in range(planes.end.shape[0]):
        _normal, depth = _contact_with_plane(motion, planes, layer, plane, vertex)
        share += _share_of(layer, depth)
    if has_overflowed(counts, capacities):
        share = _ZERO
        if vertex == 0:
            layerless_steps[0] += wp.int64(1)
    shares[vertex] = share


@wp.kernel(**_KERNEL)
def _sum_pushes(
    motion: Motion, layer: _Layer, of_kind: _Pairs, shares: wp.array[wp.float64], sums: wp.array2d[wp.int64]
):
    """Adds what contacts move vertices by to their sums."""
    i = wp.tid()
    if not is_filled(i, of_kind.pairs, of_kind.counts, _CONTACTS):
        return
    corners = points_of_pair(of_kind.kind, of_kind.elements, of_kind.pairs[i])
    weights, push = _push_of_pair(motion, layer, of_kind.kind, corners, shares)
    for j in range(4):
        vertex = corners[j]
        share = weights[j] * wp.float64(motion.inverse_mass[vertex])
        for axis in range(3):
            wp.atomic_add(sums, vertex, axis, wp.int64(wp.rint(_UNITS * share * push[axis])))


@wp.kernel(**_KERNEL)
def _move(
    motion: Motion,
    planes: MovingPlanes,
    layer: _Layer,
    shares: wp.array[wp.float64],
    dt: float,
    sums: wp.array2d[wp.int64],
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Moves each particle by the pushes of its contacts, in the motion and in the state; others keep every bit."""
    vertex = wp.tid()
    moved = bool(False)
    for plane in range(planes.end.shape[0]):
        push = _push_of_plane(motion, planes, layer, plane, vertex, shares)
        for axis in range(3):
            sums[vertex, axis] += wp.int64(wp.rint(_UNITS * wp.float64(motion.inverse_mass[vertex]) * push[axis]))
    for axis in range(3):
        moved = moved or sums[vertex, axis] != wp.int64(0)
    if moved and motion.is_lost[vertex] == 0:
        motion.x1[vertex] = with_delta(motion.x1[vertex], sums, vertex)
        for axis in range(3):
            motion.velocity[vertex][axis] += float(wp.float64(sums[vertex, axis]) / (_UNITS * wp.float64(dt)))
        particle_q[vertex] = motion.x1[vertex]
        particle_qd[vertex] = motion.velocity[vertex]
    for axis in range(3):
        sums[vertex, axis] = wp.int64(0)


@wp.kernel
def _add_shares(motion: Motion, layer: _Layer, of_kind: _Pairs, shares: wp.array[wp.float64]):
    """Computes what :func:`_sum_shares` does."""
    i = wp.tid()
    if not is_filled(i, of_kind.pairs, of_kind.counts, _CONTACTS):
        return
    corners = points_of_pair(of_kind.kind, of_kind.elements, of_kind.pairs[i])
    weights, _normal, depth = _contact_of_pair(motion, layer, of_kind.kind, corners)
    if depth > _ZERO:
        for j in range(4):
            wp.atomic_add(shares, corners[j], wp.abs(weights[j]) * _share_of(layer, depth))


@wp.kernel
def _add_shares_of_planes(motion: Motion, planes: MovingPlanes, layer: _Layer, shares: wp.array[wp.float64]):
    """Computes what :func:`_finish_shares` adds, with a thread for each vertex and plane."""
    vertex, plane = wp.tid()
    _normal, depth = _contact_with_plane(motion, planes, layer, plane, vertex)
    wp.atomic_add(shares, vertex, _share_of(layer, depth))


@wp.kernel
def _add_pushes(
    motion: Motion, layer: _Layer, of_kind: _Pairs, shares: wp.array[wp.float64], changes: wp.array[wp.vec3]
):
    """Computes what :func:`_sum_pushes` does."""
    i = wp.tid()
    if not is_filled(i, of_kind.pairs, of_kind.counts, _CONTACTS):
        return
    corners = points_of_pair(of_kind.kind, of_kind.elements, of_kind.pairs[i])
    weights, push = _push_of_pair(motion, layer, of_kind.kind, corners, shares)
    for j in range(4):
        share = weights[j] * wp.float64(motion.inverse_mass[corners[j]])
        wp.atomic_add(changes, corners[j], to_single(share * push))


@wp.kernel
def _add_pushes_of_planes(
    motion: Motion, planes: MovingPlanes, layer: _Layer, shares: wp.array[wp.float64], changes: wp.array[wp.vec3]
):
    """Computes what :func:`_move` adds, with a thread for each particle and plane."""
    vertex, plane = wp.tid()
    push = _push_of_plane(motion, planes, layer, plane, vertex, shares)
    wp.atomic_add(changes, vertex, to_single(wp.float64(motion.inverse_mass[vertex]) * push))


@wp.kernel(**_KERNEL)
def _begin_backward(
    is_lost: wp.array[int],
    dt: float,
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    changes: wp.array[wp.vec3],
):
    """Writes the gradient with respect to what contacts move particles by."""
    particle = wp.tid()
    if is_lost[particle] == 0:
        changes[particle] = particle_q[particle] + particle_qd[particle] / dt


@wp.kernel(**_KERNEL)
def _finish_backward(
    x0: wp.array[wp.vec3],
    x1: wp.array[wp.vec3],
    inverse_mass: wp.array[float],
    start_q: wp.array[wp.vec3],
    particle_q: wp.array[wp.vec3],
    particle_inv_mass: wp.array[float],
):
    """Adds to the gradients of the inputs of the step."""
    particle = wp.tid()
    start_q[particle] = start_q[particle] + x0[particle]
    particle_q[particle] = particle_q[particle] + x1[particle]
    if particle_inv_mass:
        particle_inv_mass[particle] = particle_inv_mass[particle] + inverse_mass[particle]


@dataclass(frozen=True)
class PushedStep:
    """What :meth:`ContactLayer.backward` needs of a step.

    Attributes:
        motion: The motion that was wanted.
        planes: The planes.
        pairs: The pairs that may be in the layer, of each kind.
        shares: The sums of what the contacts of each vertex count.
        dt: Length of the step [s].
    """

    motion: Motion
    planes: MovingPlanes
    pairs: list[_Pairs]
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
        self._layer = layer = _Layer()
        layer.thickness, layer.distances, layer.restitution = thickness, distances, restitution
        pairs_per_face = None if mesh.device.is_cpu else _PAIRS_PER_FACE
        self._detector = DetectionPipeline(mesh, pairs_per_face=pairs_per_face, min_distances=distances)
        n = mesh.vertex_count
        self._y = wp.zeros(n, dtype=wp.vec3, device=self._device)
        self._share_sums = wp.zeros(n, dtype=wp.int64, device=self._device)
        self._shares = wp.zeros(n, dtype=wp.float64, device=self._device)
        self._sums = wp.zeros((n, 3), dtype=wp.int64, device=self._device)

    def prepare(self, motion: ModelMotion) -> None:
        """Finds the pairs that may be in the layer; allocates buffers, which a CUDA graph cannot."""
        detector = self._detector
        self._launch(_place, len(self._y), [motion.vertices, self._layer, self._y])
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
        """Changes the wanted motion, and the state that it was copied from, by the pushes of contacts in the layer.

        Args:
            motion: The motion.
            particle_q: The wanted positions of particles.
            particle_qd: Their wanted velocities.
            dt: Length of the step [s].
            record: Whether to return what :meth:`backward` needs; None otherwise.
        """
        self.prepare(motion)
        vertices, layer, detector = motion.vertices, self._layer, self._detector
        n = len(vertices.x1)
        pairs = [self._pairs_of(narrow_phase) for narrow_phase in detector.narrow_phases]
        for of_kind in pairs:
            self._launch_over(_sum_shares, of_kind, [vertices, layer, of_kind, self._share_sums])
        inputs = [vertices, motion.planes, layer, detector.counters.array, detector.capacities]
        self._launch(_finish_shares, n, [*inputs, self._share_sums, self._shares, self._layerless_steps])
        for of_kind in pairs:
            self._launch_over(_sum_pushes, of_kind, [vertices, layer, of_kind, self._shares, self._sums])
        step = self._recorded(motion, pairs, dt) if record else None
        inputs = [vertices, motion.planes, layer, self._shares, dt, self._sums]
        self._launch(_move, len(particle_q), [*inputs, particle_q, particle_qd])
        return step

    def backward(
        self,
        step: PushedStep,
        start_q: wp.array[wp.vec3],
        particle_q: wp.array[wp.vec3],
        particle_qd: wp.array[wp.vec3],
    ) -> None:
        """Turns gradients with respect to a pushed state into those with respect to the wanted one, in place.

        Adds to the gradients of inverse masses, of what coefficients of friction are read from, and of restitution,
        where these have such arrays.

        Args:
            step: The step.
            start_q: Gradient with respect to positions at the start, shape [particle_count]; is added to.
            particle_q: Gradient with respect to the pushed positions; becomes that with respect to the wanted ones.
            particle_qd: The same for the velocities.
        """
        motion, planes, layer, device = step.motion, step.planes, self._layer, self._device
        n, particles = len(motion.x0), len(particle_q)
        of_changes, changes = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
        self._launch(_begin_backward, particles, [motion.is_lost, step.dt, particle_q, particle_qd, of_changes])
        of_motion = attach_gradients(motion, ("x0", "x1", "inverse_mass", "friction"))
        of_planes = attach_gradients(planes, ("friction",))
        shares = step.shares[:]
        shares.grad = of_shares = wp.zeros(n, dtype=wp.float64, device=device)
        sums = wp.zeros(n, dtype=wp.float64, device=device)
        over_planes = (particles, len(planes.end))
        for of_kind in step.pairs:
            inputs = [motion, layer, of_kind, shares]
            launch_adjoint(_add_pushes, len(of_kind.pairs), inputs, [changes], [of_changes], device)
        inputs = [motion, planes, layer, shares]
        launch_adjoint(_add_pushes_of_planes, over_planes, inputs, [changes], [of_changes], device)
        for of_kind in step.pairs:
            inputs = [motion, layer, of_kind]
            launch_adjoint(_add_shares, len(of_kind.pairs), inputs, [sums], [of_shares], device)
        launch_adjoint(_add_shares_of_planes, over_planes, [motion, planes, layer], [sums], [of_shares], device)
        inverse_mass = self._mesh.model.particle_inv_mass
        assert inverse_mass is not None
        inputs = [of_motion.x0, of_motion.x1, of_motion.inverse_mass]
        outputs = [start_q, particle_q, inverse_mass.grad]
        self._launch(_finish_backward, particles, [*inputs, *outputs])
        self._friction.backward(of_motion.friction, of_planes.friction)

    def _recorded(self, motion, pairs, dt):
        """Copies what the adjoint of a step needs; in a CUDA graph, all of the queues."""
        copies = []
        for of_kind in pairs:
            copy = _Pairs()
            copy.kind, copy.elements = of_kind.kind, of_kind.elements
            count = len(of_kind.pairs)
            if not self._device.is_capturing:
                count = min(count, int(of_kind.counts.numpy()[int(Count.CONTACTS)]))
            if count:
                copy.pairs, copy.counts = wp.clone(of_kind.pairs[:count]), wp.clone(of_kind.counts)
                copies.append(copy)
        kept = Motion()
        for name in ("x0", "x1", "is_lost", "friction"):
            setattr(kept, name, wp.clone(getattr(motion.vertices, name)))
        kept.inverse_mass, kept.world = motion.vertices.inverse_mass, motion.vertices.world
        planes = MovingPlanes()
        for name in MovingPlanes.vars:
            array = getattr(motion.planes, name)
            setattr(planes, name, wp.clone(array) if name in ("start", "end", "friction") else array)
        return PushedStep(kept, planes, copies, wp.clone(self._shares), dt)

    def _pairs_of(self, narrow_phase):
        pairs = _Pairs()
        pairs.kind, pairs.elements = int(narrow_phase.kind), self._mesh.device_elements(narrow_phase.kind)
        pairs.pairs, pairs.counts = narrow_phase.contacts.pairs, narrow_phase.counts
        return pairs

    def _launch(self, kernel, size, inputs):
        wp.launch(kernel, size, inputs=inputs, device=self._device)

    def _launch_over(self, kernel, of_kind, inputs):
        """Launches a kernel over the pairs of a kind: those found on the CPU, on one thread, as sums are not atomic."""
        count = len(of_kind.pairs)
        if self._device.is_cpu:
            count = min(count, int(of_kind.counts.numpy()[int(Count.CONTACTS)]))
        self._launch(kernel, count, inputs)
