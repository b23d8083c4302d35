"""Worlds in which two kinematic fingers pinch a folded cloth and lift it, with observations and rewards on the device.

The simulation of ``cloth_env.py``, without Gymnasium. A world has a folded, stiff cloth that stands on the ground like
a tent, and two fingers beside it that a program closes and lifts. What the fingers feel are the contact forces that the
stage reports; all of a step but its actions stays on the device, on a GPU in a CUDA graph.
"""

import newton
import numpy as np
import warp as wp

import warp_bsc as bsc

DT = 1.0 / 240.0  # [s]
STEPS = 6  # of a control step, even, so that it ends with the states that it began with
HORIZON = 30  # control steps of an episode
SIDE, WIDTH, CELLS = 0.07, 0.06, (4, 3)  # m and cells, of one side of the folded cloth
TILT = np.radians(20.0)  # of both sides, from the vertical
DENSITY, FRICTION = 0.2, 0.8  # kg/m^2
WEIGHT = 9.81 * DENSITY * 2.0 * SIDE * WIDTH  # N, of the cloth
FINGER = wp.constant(wp.vec3(0.004, 0.03, 0.012))  # m, half the lengths of the sides
OPENING, CLOSED, HEIGHT = 0.016, 0.0015, 0.05  # m, from the middle to a finger at the start and at least; of its centre
SPEED = wp.constant(wp.vec2(0.04, 0.2))  # m/s, largest, of closing and lifting
TARGET = 0.04  # m, to which the lowest particle is to be lifted
PINCH = 0.025  # N, with which a finger may press; three times that crushes the cloth
SHIFT = 0.003  # m, by which a cloth stands off the middle at most
OBSERVATIONS = ("opening", "height", "cloth x", "cloth z", "lowest z", "pinch", "carried", "time")


@wp.struct
class Gripper:
    """What the fingers of each world do and feel."""

    place: wp.array[wp.vec2]  # opening and height [m]
    force: wp.array[wp.vec2]  # with which a finger presses, and which both carry, means of a control step [N]
    lowest: wp.array[float]  # height of the lowest particle [m]
    time: wp.array[int]  # control steps so far


@wp.kernel(enable_backward=False)
def move_fingers(
    actions: wp.array2d[float], active: wp.array[wp.bool], gripper: Gripper, body_q: wp.array[wp.transform]
):
    """Moves the fingers of a world by a step."""
    world = wp.tid()
    if not active[world]:
        return
    closing = wp.clamp(actions[world, 0], -1.0, 1.0) * SPEED[0]
    lifting = wp.clamp(actions[world, 1], -1.0, 1.0) * SPEED[1]
    opening = wp.clamp(gripper.place[world][0] - DT * closing, CLOSED, OPENING + 2.0 * SHIFT)
    height = wp.clamp(gripper.place[world][1] + DT * lifting, HEIGHT, HEIGHT + 1.5 * TARGET)
    gripper.place[world] = wp.vec2(opening, height)
    place_fingers(world, opening, height, body_q)


@wp.func
def place_fingers(world: int, opening: float, height: float, body_q: wp.array[wp.transform]):
    """Places both fingers of a world."""
    x = opening + FINGER[0]
    body_q[2 * world] = wp.transform(wp.vec3(-x, 0.0, height), wp.quat_identity())
    body_q[2 * world + 1] = wp.transform(wp.vec3(x, 0.0, height), wp.quat_identity())


@wp.kernel(enable_backward=False)
def feel(
    first: int,
    body_impulse: wp.array[wp.spatial_vector],
    is_certified: wp.array[wp.bool],
    gripper: Gripper,
    certified: wp.array[wp.bool],
):
    """Adds the contact forces on the fingers of a world, in a step, to their means over a control step."""
    world = wp.tid()
    certified[world] = is_certified[world] and (first != 0 or certified[world])
    left, right = wp.spatial_top(body_impulse[2 * world]), wp.spatial_top(body_impulse[2 * world + 1])
    share = 1.0 / (float(STEPS) * DT)
    if first != 0:
        gripper.force[world] = wp.vec2()
    gripper.force[world] += share * wp.vec2(0.5 * (right[0] - left[0]), -(left[2] + right[2]))


@wp.kernel(enable_backward=False)
def observe(
    # in
    particle_q: wp.array[wp.vec3],
    count: int,
    active: wp.array[wp.bool],
    is_step: int,
    # in and out
    gripper: Gripper,
    # out
    observations: wp.array2d[float],
    rewards: wp.array[float],
    terminated: wp.array[wp.bool],
):
    """Writes the observation of a world; after a step, also its reward, and whether the episode is over."""
    world = wp.tid()
    rewards[world] = 0.0
    terminated[world] = False
    if not active[world]:
        return
    centre, lowest = wp.vec3(), float(1.0)
    for i in range(count * world, count * (world + 1)):
        centre += particle_q[i] / float(count)
        lowest = wp.min(lowest, particle_q[i][2])
    pinch, carried = gripper.force[world][0] / PINCH, gripper.force[world][1] / WEIGHT
    if is_step != 0:
        gripper.time[world] += 1
        reward = 5.0 * (lowest - gripper.lowest[world]) / TARGET  # lifted
        reward += 0.1 * wp.clamp(carried, 0.0, 1.0)  # the fingers carry the cloth, not the ground
        reward -= 0.1 * wp.clamp(pinch - 1.0, 0.0, 2.0)  # and do not press too hard
        if lowest >= TARGET:
            reward += 5.0
            terminated[world] = True
        elif pinch > 3.0:
            reward -= 2.0
            terminated[world] = True
        rewards[world] = reward
    gripper.lowest[world] = lowest
    place = gripper.place[world]
    observations[world, 0] = (place[0] - 0.5 * OPENING) / (0.5 * OPENING)
    observations[world, 1] = (place[1] - HEIGHT) / TARGET
    observations[world, 2] = centre[0] / SHIFT
    observations[world, 3] = centre[2] / HEIGHT - 1.0
    observations[world, 4] = lowest / TARGET
    observations[world, 5] = wp.min(pinch, 10.0)
    observations[world, 6] = wp.clamp(carried, -10.0, 10.0)
    observations[world, 7] = float(gripper.time[world]) / float(HORIZON)


@wp.kernel(enable_backward=False)
def restart(
    # in
    resets: wp.array[wp.bool],
    shifts: wp.array[wp.vec2],
    start: wp.array[wp.vec3],
    particle_world: wp.array[int],
    # out
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    gripper: Gripper,
):
    """Puts the cloth and the fingers of some worlds where an episode starts."""
    i = wp.tid()
    world = particle_world[i]
    if not resets[world]:
        return
    particle_q[i] = start[i] + wp.vec3(shifts[world][0], shifts[world][1], 0.0)
    particle_qd[i] = wp.vec3()
    if i == 0 or particle_world[i - 1] != world:
        gripper.place[world] = wp.vec2(OPENING, HEIGHT)
        gripper.force[world] = wp.vec2()
        gripper.time[world] = 0
        place_fingers(world, OPENING, HEIGHT, body_q)


def folded_cloth():
    """Returns positions and faces of a cloth that is folded over a ridge along y, and stands on both ends."""
    u = np.linspace(-1.0, 1.0, 2 * CELLS[0] + 1)
    y = np.linspace(-0.5 * WIDTH, 0.5 * WIDTH, CELLS[1] + 1)
    x, z = SIDE * np.sin(TILT) * u, 0.001 + SIDE * np.cos(TILT) * (1.0 - np.abs(u))
    positions = np.stack([np.repeat(x, len(y)), np.tile(y, len(u)), np.repeat(z, len(y))], axis=1)
    a = (np.arange(len(u) - 1)[:, None] * len(y) + np.arange(CELLS[1])).ravel()
    b, c, d = a + len(y), a + len(y) + 1, a + 1
    return positions, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def build_world():
    """Returns a builder of one world."""
    world = newton.ModelBuilder()
    material = newton.ModelBuilder.ShapeConfig(mu=FRICTION)
    world.add_ground_plane(cfg=material)
    for side, label in ((-1.0, "left finger"), (1.0, "right finger")):
        place = wp.transform(wp.vec3(side * (OPENING + FINGER[0]), 0.0, HEIGHT), wp.quat_identity())
        body = world.add_body(xform=place, is_kinematic=True, label=label)
        world.add_shape_box(body, hx=FINGER[0], hy=FINGER[1], hz=FINGER[2], cfg=material, label=label)
    positions, faces = folded_cloth()
    world.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*position) for position in positions.tolist()],
        indices=faces.ravel().tolist(),
        density=DENSITY,
        tri_ke=2.0e3,
        tri_ka=2.0e3,
        tri_kd=0.1,
        edge_ke=8.0,
        edge_kd=1.0e-3,
        particle_radius=0.002,
    )
    world.color()
    return world


class ClothWorlds:
    """Worlds with a cloth and two fingers each, which are stepped and reset by world.

    Attributes:
        count: Number of worlds.
        solver: The stage.
        states: Two states, the first of which is the present one between steps.
        observations: float, shape [count, 8], see :data:`OBSERVATIONS`; those of worlds that take no part stay.
        rewards: Rewards of the last control step, float, shape [count], 0 in worlds that took no part.
        terminated: Whether an episode ended in the last control step, as the cloth was lifted or crushed, bool, shape
            [count].
        certified: Whether all steps of the last control step are certified, bool, shape [count].
        gripper: What the fingers of each world do and feel.
    """

    def __init__(self, count, device=None):
        """Builds the worlds; :meth:`reset` starts them."""
        builder = newton.ModelBuilder()
        builder.replicate(build_world(), count)
        self.model = model = builder.finalize(device=device)
        model.particle_mu = FRICTION
        self.count, self.device = count, model.device
        inner = newton.solvers.SolverVBD(
            model, iterations=10, integrate_with_external_rigid_solver=True, particle_enable_self_contact=False
        )
        self.solver = bsc.SolverCCD(inner, report_contacts=True, report_worlds=True)
        self.states = [model.state(), model.state()]
        with wp.ScopedDevice(self.device):
            self._actions = wp.zeros((count, 2), dtype=float)
            self._active = wp.zeros(count + 1, dtype=wp.bool)
            self._shifts = wp.zeros(count, dtype=wp.vec2)
            self.observations = wp.zeros((count, len(OBSERVATIONS)), dtype=float)
            self.rewards, self.terminated = wp.zeros(count, dtype=float), wp.zeros(count, dtype=wp.bool)
            self.certified = wp.zeros(count, dtype=wp.bool)
            self.gripper = Gripper()
            self.gripper.place, self.gripper.force = (wp.zeros(count, dtype=wp.vec2) for _ in range(2))
            self.gripper.lowest, self.gripper.time = wp.zeros(count, dtype=float), wp.zeros(count, dtype=int)
        gripper = [self.gripper.place, self.gripper.lowest, self.gripper.time]
        self._run = bsc.CapturedSteps(self._simulate, self.solver, [self.states[0], *gripper])

    def reset(self, worlds, shifts):
        """Starts an episode in some worlds, and touches no other.

        Args:
            worlds: Which, bool, shape [count].
            shifts: Where the cloth of each world stands off the middle [m], shape [count, 2].
        """
        state, model = self.states[0], self.model
        resets = wp.array([*worlds, False], dtype=bool, device=self.device)
        self._shifts.assign(np.asarray(shifts, dtype=np.float32))
        inputs = [resets, self._shifts, model.particle_q, model.particle_world]
        outputs = [state.particle_q, state.particle_qd, state.body_q, self.gripper]
        wp.launch(restart, model.particle_count, inputs=inputs, outputs=outputs, device=self.device)
        # without flags, VBD would copy the positions of the model over those of this episode
        self.solver.reset(state, resets, newton.StateFlags.NONE)
        self._observe(resets, is_step=False)

    def step(self, actions, active=None):
        """Takes a control step.

        Args:
            actions: Speeds of closing and lifting as shares of the largest, in [-1, 1], float, shape [count, 2], an
                array of NumPy or Warp.
            active: Which worlds take part, bool, shape [count]; None for all.
        """
        self._actions.assign(actions)
        self._active.assign(np.append(np.ones(self.count, dtype=bool) if active is None else active, True))
        self._run()

    def _simulate(self):
        for step in range(STEPS):
            start, end = self.states
            start.clear_forces()
            self._launch(move_fingers, [self._actions, self._active], [self.gripper, end.body_q])
            self.solver.step(start, end, None, None, DT, world_mask=self._active)
            report = self.solver.report
            inputs = [int(step == 0), report.body_impulse, report.worlds.certified]
            self._launch(feel, inputs, [self.gripper, self.certified])
            self.states.reverse()
        self._observe(self._active, is_step=True)

    def _observe(self, active, *, is_step):
        count = self.model.particle_count // self.count
        inputs = [self.states[0].particle_q, count, active, int(is_step), self.gripper]
        self._launch(observe, inputs, [self.observations, self.rewards, self.terminated])

    def _launch(self, kernel, inputs, outputs):
        wp.launch(kernel, self.count, inputs=inputs, outputs=outputs, device=self.device)
