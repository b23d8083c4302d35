"""Steps a scene of the bench of contact with a solver and a stage, and samples each state."""

import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import newton
import numpy as np
import warp as wp

from ..._private_names.of_newton import make_style3d
from ...implicit.solver_implicit import SolverImplicit
from ...response.report.strain import edges_at_rest
from ...response.solver_ccd import SolverCCD
from ...response.state.mesh import host_array
from ..crossings import CrossingCounter
from ..elastic_energy import ElasticEnergy
from .contact import Scene

_ITERATIONS = 10
_MARGIN = 0.005
"""Distance at which VBD's self-contact begins to push, and the gap beyond it [m]; smaller ones hinder a free fall."""


class NotFinite(Exception):
    """Positions are not finite; the message says since which step."""


def largest_stretch(x: np.ndarray, edges: np.ndarray, lengths: np.ndarray) -> float:
    """Returns the largest elongation of edges, as a share of their lengths at rest; negative if all are shorter.

    Args:
        x: Positions [m], shape [n, 3].
        edges: Their vertices, shape [m, 2].
        lengths: Lengths at rest [m], shape [m].
    """
    ends = x.astype(np.float64)[edges]
    return float((np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / lengths).max() - 1.0)


def total_energy(
    x: np.ndarray, v: np.ndarray, mass: np.ndarray, gravity: np.ndarray, world: np.ndarray, worlds: int
) -> np.ndarray:
    """Returns the kinetic and gravitational energy of point masses in each world [J].

    Args:
        x: Positions [m], shape [n, 3].
        v: Velocities [m/s], shape [n, 3].
        mass: Masses [kg], shape [n].
        gravity: Acceleration of each mass [m/s^2], shape [n, 3].
        world: World of each, shape [n].
        worlds: Number of worlds.
    """
    x, v = x.astype(np.float64), v.astype(np.float64)
    return np.bincount(world, mass * (0.5 * (v * v).sum(axis=1) - (gravity * x).sum(axis=1)), minlength=worlds)


def energy_gained(energy: np.ndarray, restarts: Sequence[tuple[int, int]] = ()) -> float:
    """Returns the largest rise of the energy of a world above its least value so far [J].

    Args:
        energy: Energy of each world by step [J], shape [step_count, world_count].
        restarts: Steps and worlds: the least value of that world begins anew with that step.
    """
    gained = 0.0
    for world in range(energy.shape[1]):
        begins = sorted(step for step, restarted in restarts if restarted == world)
        for part in np.split(energy[:, world], begins):
            if len(part):
                gained = max(gained, float((part - np.minimum.accumulate(part)).max()))
    return gained


@wp.kernel(enable_backward=False)
def _place_bodies(step: wp.array[int], poses: wp.array2d[wp.transform], body_q: wp.array[wp.transform]):
    body_q[wp.tid()] = poses[step[0], wp.tid()]


@wp.kernel(enable_backward=False)
def _place_particles(
    step: wp.array[int], held: wp.array[int], positions: wp.array2d[wp.vec3], particle_q: wp.array[wp.vec3]
):
    particle_q[held[wp.tid()]] = positions[step[0], wp.tid()]


@wp.kernel(enable_backward=False)
def _advance(step: wp.array[int]):
    step[0] += 1


class _Mover:
    """Writes where a program moves bodies and particles, from tables on the device, so that a graph can do it."""

    def __init__(self, scene: Scene, rate: int, steps: int, offset: float, *, poses_in_both: bool):
        device, motion = scene.model.device, scene.motion
        self._poses_in_both, self._poses, self._positions = poses_in_both, None, None
        times = [step / rate for step in range(1, steps + 1)]
        self._step = wp.zeros(1, dtype=int, device=device)
        if motion and motion.poses:
            poses = np.array([motion.poses(t) for t in times], dtype=np.float32)
            self._poses = wp.array(poses, dtype=wp.transform, device=device)
        if motion and motion.positions:
            positions = np.array([motion.positions(t) for t in times])
            positions[:, :, 0] += offset
            self._positions = wp.array(positions.astype(np.float32), dtype=wp.vec3, device=device)
            self._held = wp.array(motion.held, dtype=int, device=device)

    def move(self, start: newton.State, end: newton.State) -> None:
        """Writes the places at the end of the next step, where solvers read those of kinematic ones."""
        if self._poses is not None:
            for state in (start, end) if self._poses_in_both else (end,):
                wp.launch(_place_bodies, self._poses.shape[1], [self._step, self._poses], [state.body_q])
        if self._positions is not None:
            for state in (start, end):
                inputs = [self._step, self._held, self._positions]
                wp.launch(_place_particles, len(self._held), inputs, [state.particle_q])
        if self._poses is not None or self._positions is not None:
            wp.launch(_advance, 1, [], [self._step])


class Simulation:
    """A scene with its solver, which is stepped in pairs of steps: a graph ends with the states that it began with.

    Attributes:
        stage: The stage, which :class:`.SolverImplicit` is itself; None without one.
        solver: What is stepped: the stage, or the solver without one.
        states: The state at the start of the next pair of steps, and the one between them.
        samples: What was measured of each state.
        milliseconds: Time of each step [ms]; two steps are timed together.
        collisions: Pairs that meet on straight ways in each step, see :class:`..crossings.CrossingCounter`; empty if
            they are not counted.
    """

    def __init__(
        self,
        scene: Scene,
        solver: str,
        rate: int,
        *,
        has_self_contact: bool = False,
        has_contacts: bool = False,
        stage_options: dict[str, Any] | None = None,
        offset: float = 0.0,
        inner: Any = None,
        samples: Any = None,
        counts_collisions: bool = False,
        early_steps: int = 0,
    ):
        """Makes the solver and the states.

        Args:
            scene: The scene.
            solver: One of :data:`..measure.response.SOLVERS`, or ``"implicit"`` for :class:`.SolverImplicit`.
            rate: Steps a second.
            has_self_contact: Whether VBD has contacts between particles of its own.
            has_contacts: Whether the solver gets Newton's contacts.
            stage_options: Arguments of the stage or of :class:`.SolverImplicit`, beside those that the scene needs;
                None for no stage.
            offset: How far all particles are moved along x [m].
            inner: The solver that is stepped, behind the stage if there is one; default: that of the bench of contact.
            samples: What the states are given to, with a method ``add`` as that of :class:`Samples`; default:
                :class:`Samples`.
            counts_collisions: Whether collisions of each step are counted; it takes a detection, which is not timed.
            early_steps: Steps after which :class:`Samples` keep positions.
        """
        model = scene.model
        self._scene, self._model, self._rate, self._offset = scene, model, rate, offset
        if offset:
            assert model.particle_q is not None
            moved = host_array(model.particle_q).astype(np.float64)
            moved[:, 0] += offset
            model.particle_q.assign(moved.astype(np.float32))
        if solver == "implicit":
            self.stage = SolverImplicit(model, **scene.stage_options, **(stage_options or {}))
        else:
            moves_bodies = scene.motion is not None and scene.motion.poses is not None
            own = self_contact(_MARGIN, _MARGIN) if has_self_contact else {}
            own |= {"integrate_with_external_rigid_solver": moves_bodies}
            inner = inner or make_solver(model, solver, _ITERATIONS, **own)
            if isinstance(inner, newton.solvers.SolverStyle3D) and not has_contacts:
                inner.collision = None  # its own contacts, which need those of Newton
            self.stage = None if stage_options is None else SolverCCD(inner, **scene.stage_options, **stage_options)
        self.solver: Any = inner if self.stage is None else self.stage
        self._pipeline = newton.CollisionPipeline(model) if has_contacts else None
        self._contacts = self._pipeline.contacts() if self._pipeline else None
        self.states, self._control = (model.state(), model.state()), model.control()
        # VBD that does not move bodies reads their poses at the start and at the end; the others copy them
        self._poses_in_both = solver != "vbd"
        self._ends = [model.state() for _ in self.states]  # copies of both ends of a pair
        self._graph: wp.Graph | None = None
        self.samples, self.milliseconds = samples or Samples(model, early_steps), []
        self._counts_collisions, self.collisions = counts_collisions, []

    def run(self, seconds: float, progress: Callable[[int, int], None]) -> int:
        """Takes all steps, at least four and an even number, and returns how many.

        Raises:
            NotFinite: If positions or velocities are not finite.
        """
        scene, samples = self._scene, self.samples
        steps = 2 * max(2, math.ceil(round(seconds * self._rate, 6) / 2))
        self._mover = _Mover(scene, self._rate, steps, self._offset, poses_in_both=self._poses_in_both)
        resets = {2 * round(0.5 * t * self._rate): worlds for t, worlds in scene.resets.items()}
        samples.add(self.states[0])
        if self._counts_collisions:
            self._counter.begin(self.states[0])
        for step in range(0, steps, 2):
            progress(step, steps)
            if step in resets:
                self._reset(resets[step])
                samples.restart(self.states[0], resets[step])
                if self._counts_collisions:
                    self._counter.begin(self.states[0])
            self.milliseconds += [0.5 * self._take_pair()] * 2
            for i, state in enumerate(self._ends):
                if not samples.add(state):
                    raise NotFinite(f"positions are not finite after step {step + i + 1} of {steps}")
                if self._counts_collisions:
                    self.collisions.append(self._counter.count_collisions(state))
        progress(steps, steps)
        return steps

    @functools.cached_property
    def _counter(self):
        return CrossingCounter(self._model, strands=self._scene.strands)

    def count_crossings(self) -> int:
        """Returns the number of crossings now, see :class:`..crossings.CrossingCounter`."""
        return self._counter.count(self.states[0])

    def _take_pair(self) -> float:
        """Takes two steps, and returns their time [ms]."""
        device = self._model.device
        if self._graph is not None:
            stream = wp.get_stream(device)
            start, end = (wp.Event(device, enable_timing=True) for _ in range(2))
            stream.record_event(start)
            wp.capture_launch(self._graph)
            stream.record_event(end)
            return wp.get_event_elapsed_time(start, end)
        wp.synchronize_device(device)
        begin = time.perf_counter()
        self._step_twice()
        wp.synchronize_device(device)
        took = 1e3 * (time.perf_counter() - begin)
        if device.is_cuda:
            with wp.ScopedCapture(device) as capture:
                self._step_twice()
            self._graph = capture.graph
        return took

    def _step_twice(self):
        """Takes two steps, and copies the state at the end of each: some solvers overwrite that at their start."""
        first, second = self.states
        for start, end, copy in zip((first, second), (second, first), self._ends, strict=True):
            self._mover.move(start, end)
            start.clear_forces()
            if self._pipeline and self._contacts:
                self._pipeline.collide(start, self._contacts)
            self.solver.step(start, end, self._control, self._contacts, 1.0 / self._rate)
            for name in ("particle_q", "particle_qd", "body_q", "body_qd"):
                if getattr(end, name) is not None:
                    wp.copy(getattr(copy, name), getattr(end, name))

    def _reset(self, worlds: Sequence[int]):
        """Puts the particles of worlds where the model has them, as a trainer does."""
        model, state = self._model, self.states[0]
        mask = np.zeros(model.world_count + 1, dtype=bool)
        mask[list(worlds)] = True
        is_reset = mask[host_array(model.particle_world)][:, None]
        for name in ("particle_q", "particle_qd"):
            array = getattr(state, name)
            array.assign(np.where(is_reset, host_array(getattr(model, name)), array.numpy()))
        self.solver.reset(state, world_mask=wp.array(mask, dtype=bool))


class Samples:
    """What is measured of each state of a model.

    Attributes:
        stretch: The largest elongation of an edge that can move, as a share of its length at rest.
        speed: The mean speed of movable particles [m/s].
        energy: The kinetic, gravitational and elastic energy of each world [J], see :class:`.ElasticEnergy`.
        restarts: Indices of ``energy`` and worlds, where the energy of a world begins anew.
        early: Positions after the given number of steps [m]; None before.
    """

    def __init__(self, model: newton.Model, early_steps: int = 0):
        """Reads masses and lengths at rest; positions after ``early_steps`` are kept."""
        self._early_steps = early_steps
        self._worlds = max(1, model.world_count)
        self._movable = host_array(model.particle_inv_mass) > 0.0
        edges, lengths, _ = edges_at_rest(model)
        moves = self._movable[edges].any(axis=1)
        self._edges, self._lengths = edges[moves], lengths[moves]
        mass = np.where(self._movable, host_array(model.particle_mass), 0.0)
        world = host_array(model.particle_world)
        moment = np.zeros(0)
        if model.body_count:
            moves = host_array(model.body_inv_mass) > 0.0
            mass = np.append(mass, np.where(moves, host_array(model.body_mass), 0.0))
            world = np.append(world, host_array(model.body_world))
            # the bodies of the scenes are balls about their centres, whose inertia has no direction
            moment = np.where(moves, host_array(model.body_inertia)[:, 0, 0], 0.0)
        self._mass, self._moment, self._world = mass.astype(np.float64), moment, np.maximum(world, 0)
        gravity = host_array(model.gravity).reshape(-1, 3).astype(np.float64)
        self._gravity = gravity[self._world if len(gravity) > 1 else np.zeros_like(self._world)]
        self._elastic = ElasticEnergy(model)
        self.stretch: list[float] = []
        self.speed: list[float] = []
        self.energy: list[np.ndarray] = []
        self.restarts: list[tuple[int, int]] = []
        self.early: np.ndarray | None = None

    def add(self, state: newton.State) -> bool:
        """Measures a state; returns whether its positions and velocities are finite."""
        x, v = host_array(state.particle_q), host_array(state.particle_qd)
        if not (np.isfinite(x).all() and np.isfinite(v).all()):
            return False
        if len(self.stretch) == self._early_steps:  # the first state is that before all steps
            self.early = x.astype(np.float64)
        self.stretch.append(largest_stretch(x, self._edges, self._lengths))
        self.speed.append(float(np.linalg.norm(v[self._movable], axis=1).mean()))
        self.energy.append(self._energy_of(state))
        return True

    def restart(self, state: newton.State, worlds: Sequence[int]) -> None:
        """Begins the energy of worlds anew, with the state to which they were reset."""
        self.restarts += [(len(self.energy), world) for world in worlds]
        self.energy.append(self._energy_of(state))

    def _energy_of(self, state: newton.State) -> np.ndarray:
        x, v = host_array(state.particle_q), host_array(state.particle_qd)
        others = self._elastic.of(x)
        if len(self._moment):
            velocity = host_array(state.body_qd).astype(np.float64)
            x, v = np.concatenate([x, host_array(state.body_q)[:, :3]]), np.concatenate([v, velocity[:, :3]])
            energies = 0.5 * self._moment * (velocity[:, 3:] ** 2).sum(axis=1)
            others = others + np.bincount(self._world[-len(energies) :], energies, minlength=self._worlds)
        return total_energy(x, v, self._mass, self._gravity, self._world, self._worlds) + others


def make_solver(model: newton.Model, solver: str, iterations: int, **of_vbd: Any) -> Any:
    """Returns one of :data:`..measure.response.SOLVERS` for a model; only VBD has the other arguments."""
    solvers = newton.solvers
    if solver == "xpbd":
        # corrections of tetrahedra are added up at their vertices: with the default relaxation, soft bodies burst, and
        # Newton has no example of them
        return solvers.SolverXPBD(model, iterations=iterations, soft_body_relaxation=0.2)
    if solver == "style3d":
        return make_style3d(model, iterations)
    if solver == "semi-implicit":
        return solvers.SolverSemiImplicit(model)
    return solvers.SolverVBD(model, iterations=iterations, **of_vbd)


def self_contact(margin: float, gap: float) -> dict[str, Any]:
    """Returns the arguments of VBD for contacts between particles, with the buffers of Newton's cloth_twist."""
    return {
        "particle_enable_self_contact": True,
        "particle_self_contact_margin": margin,
        "particle_self_contact_gap": gap,
        "particle_vertex_contact_buffer_size": 64,
        "particle_edge_contact_buffer_size": 128,
    }
