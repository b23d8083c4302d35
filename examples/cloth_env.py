"""A vectorised Gymnasium environment in which grippers fold cloths. Needs the extras ``gym`` and ``torch``.

In each world a square cloth lies on the ground, turned and shifted at random, and grippers hold two of its corners. An
action is the velocity of both; an observation says where they are, and where the corners are on which they are to lay
theirs. The reward is by how much both halves come nearer to each other. Observations, rewards and ends of episodes are
PyTorch tensors in the memory of Warp's arrays: a step copies nothing to the host and waits for nothing, and is a CUDA
graph on a GPU. Worlds whose episode has ended start anew in the next step, in which they take no part
(``AutoresetMode.NEXT_STEP``), so that the others change no bit by it. ``train_cloth_env.py`` trains a policy.
"""

import contextlib

import gymnasium
import newton
import numpy as np
import torch
import warp as wp
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import warp_bsc as bsc

DT = 1.0 / 30.0  # s, of a step
HORIZON = 24  # steps of an episode
CELLS, SIDE = 6, 0.16  # cells and m, of a side of the cloth
N = wp.constant(CELLS + 1)  # particles of a row, which follow each other along x
SPEED, LOWEST = 0.4, 0.004  # m/s and m: the largest of grippers along each axis, and where they go down to
TURN, SHIFT = 0.3, 0.02  # rad and m, by which a cloth is turned and shifted at most
FOLDED = 0.15  # mean distance of the particles of both halves at which a cloth is folded, as a share of the first one
OBSERVATIONS = 9


@wp.struct
class Worlds:
    """The episodes of all worlds."""

    seed: wp.array[int]  # of all
    episode: wp.array[int]
    time: wp.array[int]  # steps in the episode so far
    resets: wp.array[wp.bool]  # worlds that start anew in this step; False for what is in all worlds
    active: wp.array[wp.bool]  # worlds that take part in it; True
    distance: wp.array[float]  # as FOLDED
    observations: wp.array2d[float]
    rewards: wp.array[float]
    terminated: wp.array[wp.bool]
    truncated: wp.array[wp.bool]
    certified: wp.array[wp.bool]  # all steps of the episode


@wp.kernel(enable_backward=False)
def choose(worlds: Worlds):
    """Lets worlds start anew whose episode ended in the last step."""
    world = wp.tid()
    worlds.resets[world] = worlds.terminated[world] or worlds.truncated[world]
    worlds.active[world] = not worlds.resets[world]


@wp.kernel(enable_backward=False)
def move(
    # in
    actions: wp.array2d[float],
    start: wp.array[wp.vec3],
    worlds: Worlds,
    # out
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Moves the grippers of a world, or puts its cloth where an episode starts."""
    i = wp.tid()
    world = i // (N * N)
    corner = i % (N * N)
    if worlds.resets[world]:
        random = wp.rand_init(worlds.seed[0], worlds.episode[world] * worlds.time.shape[0] + world)
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.randf(random, -TURN, TURN))
        shift = wp.vec3(wp.randf(random, -SHIFT, SHIFT), wp.randf(random, -SHIFT, SHIFT), 0.0)
        particle_q[i] = wp.quat_rotate(turn, start[i]) + shift
        particle_qd[i] = wp.vec3()
    elif worlds.active[world] and (corner == N - 1 or corner == N * N - 1):
        for axis in range(3):
            if wp.isfinite(actions[world, axis]):
                particle_q[i][axis] += DT * SPEED * wp.clamp(actions[world, axis], -1.0, 1.0)
        particle_q[i][2] = wp.clamp(particle_q[i][2], LOWEST, SIDE)


@wp.kernel(enable_backward=False)
def observe(
    # in
    actions: wp.array2d[float],
    particle_q: wp.array[wp.vec3],
    certified: wp.array[wp.bool],
    # in and out
    worlds: Worlds,
):
    """Writes what a world shows at the start of an episode, or after a step."""
    world = wp.tid()
    first = N * N * world
    distance = float(0.0)
    for row in range(N):
        for column in range(N):
            i = first + N * row
            distance += wp.length(particle_q[i + column] - particle_q[i + CELLS - column])
    distance *= 2.0 * float(CELLS) / (float(N * CELLS * (CELLS + 2)) * SIDE)  # 1 at the start
    if worlds.resets[world]:
        worlds.episode[world] += 1
        worlds.time[world] = 0
        worlds.rewards[world] = 0.0
        worlds.terminated[world] = False
        worlds.truncated[world] = False
        worlds.certified[world] = True
    elif worlds.active[world]:
        worlds.time[world] += 1
        folded = distance < FOLDED
        reward = 10.0 * (worlds.distance[world] - distance) + wp.where(folded, 5.0, 0.0)
        for axis in range(3):
            reward = wp.where(wp.isfinite(actions[world, axis]), reward, wp.nan)
        worlds.rewards[world] = reward
        worlds.terminated[world] = folded
        worlds.truncated[world] = worlds.time[world] >= HORIZON and not folded
        worlds.certified[world] = worlds.certified[world] and certified[world]
    worlds.distance[world] = distance
    for side in range(2):
        corner = first + CELLS * N * side
        offset = (particle_q[corner] - particle_q[corner + CELLS]) / SIDE
        for axis in range(3):
            worlds.observations[world, 3 * side + axis] = offset[axis]
    worlds.observations[world, 6] = particle_q[first + CELLS][2] / SIDE
    worlds.observations[world, 7] = distance
    worlds.observations[world, 8] = float(worlds.time[world]) / float(HORIZON)


def build_world():
    """Returns a builder of one world."""
    world, cell = newton.ModelBuilder(), SIDE / CELLS
    world.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.5))
    world.add_cloth_grid(
        pos=wp.vec3(-0.5 * SIDE, -0.5 * SIDE, 0.002),
        rot=wp.quat_identity(),
        vel=wp.vec3(),
        dim_x=CELLS,
        dim_y=CELLS,
        cell_x=cell,
        cell_y=cell,
        mass=0.2 * cell**2,  # 0.2 kg/m^2
        tri_ke=200.0,
        tri_ka=200.0,
        tri_kd=0.0,
        edge_ke=1.0e-3,
        edge_kd=1.0e-4,
        particle_radius=0.002,
    )
    for corner in (CELLS, N * N - 1):  # grippers move them
        world.particle_mass[corner] = 0.0
    return world


class ClothEnv(gymnasium.vector.VectorEnv):
    """Worlds in which grippers fold a cloth, as environments of Gymnasium's vector interface, as tensors on the device.

    Tensors that it returns are always the same, and the next call writes into them: clone what is to be kept.
    ``info`` has ``"certified"``, whether all steps of a world since its reset are certified: bool, shape [num_envs].

    Attributes:
        actions: The tensor that a step reads, float32, shape [num_envs, 3]. A step that is given another copies it.
        solver: Steps all worlds.
        state: Their present state.
        worlds: What kernels read and write of each world, and what the tensors view.
    """

    def __init__(self, num_envs=16, device=None):
        """Builds the worlds, on a Warp device; :meth:`reset` starts them."""
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self.num_envs, self.render_mode, self.spec = num_envs, None, None
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        builder = newton.ModelBuilder()
        builder.replicate(build_world(), num_envs)
        model = builder.finalize(device=device)
        self.solver, self.state, self.device = (
            bsc.SolverImplicit(model, report=["worlds"]),
            model.state(),
            model.device,
        )
        self.worlds = worlds = Worlds()
        with wp.ScopedDevice(self.device):
            worlds.seed = wp.zeros(1, dtype=int)
            worlds.episode, worlds.time = (wp.zeros(num_envs, dtype=int) for _ in range(2))
            worlds.resets, worlds.active = (wp.full(num_envs + 1, entry, dtype=wp.bool) for entry in (False, True))
            worlds.distance, worlds.rewards = (wp.zeros(num_envs, dtype=float) for _ in range(2))
            worlds.terminated, worlds.truncated = (wp.zeros(num_envs, dtype=wp.bool) for _ in range(2))
            worlds.certified = wp.zeros(num_envs, dtype=wp.bool)
            worlds.observations = wp.zeros((num_envs, OBSERVATIONS), dtype=float)
            self._actions = wp.zeros((num_envs, 3), dtype=float)
        names = "observations", "rewards", "terminated", "truncated"
        self._tensors = [wp.to_torch(getattr(worlds, name)) for name in names]
        self._info, self.actions = {"certified": wp.to_torch(worlds.certified)}, wp.to_torch(self._actions)
        self._graph, self._outside = None, HORIZON  # steps before the graph, in which buffers grow

    def reset(self, *, seed=None, options=None):
        """Starts an episode in all worlds, or in those of ``options["reset_mask"]``, bool, shape [num_envs].

        A seed starts the count of episodes anew: the start of each follows from the seed, its world and its number.
        """
        mask = torch.as_tensor((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask must be bool, of shape ({self.num_envs},), not {mask.dtype} {mask.shape}")
        with self._on_stream_of_torch():
            if seed is not None or self._np_random is None:
                self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random(seed)
                self.worlds.seed.fill_(int(self.np_random.integers(2**31)))
                self.worlds.episode.zero_()
            wp.to_torch(self.worlds.resets)[:-1].copy_(mask)
            self.worlds.active.zero_()
            self._begin()
            self._observe()
        return self._tensors[0], self._info

    def step(self, actions):
        """Takes a step in worlds whose episode goes on; the others start anew.

        Args:
            actions: Velocity of the grippers as shares of the largest, shape [num_envs, 3]: a tensor, or an array of
                NumPy. Those beyond 1 count as 1. One that is not finite counts as 0, and the reward is NaN.

        Raises:
            ValueError: If they have another shape.
        """
        actions = torch.as_tensor(actions)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have the shape {self.action_space.shape}, not {tuple(actions.shape)}")
        self.actions.copy_(actions)
        with self._on_stream_of_torch():
            if self._graph is None:
                self._simulate()
            else:
                wp.capture_launch(self._graph)
        self._outside -= 1
        if self.device.is_cuda and self._outside == 0:
            with wp.ScopedCapture(self.device) as capture:
                self._simulate()
            self._graph = capture.graph
        return *self._tensors, self._info

    def _simulate(self):
        self.worlds.active.fill_(True)
        self._launch(choose, self.num_envs, [], [self.worlds])
        self._begin()
        self.solver.step(self.state, self.state, None, None, DT, world_mask=self.worlds.active)
        self._observe()

    def _begin(self):
        inputs = [self._actions, self.solver.model.particle_q, self.worlds]
        outputs = [self.state.particle_q, self.state.particle_qd]
        self._launch(move, self.solver.model.particle_count, inputs, outputs)
        self.solver.reset(self.state, self.worlds.resets, newton.StateFlags.NONE)

    def _observe(self):
        inputs = [self._actions, self.state.particle_q, self.solver.report.worlds.certified]
        self._launch(observe, self.num_envs, inputs, [self.worlds])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)

    def _on_stream_of_torch(self):
        if not self.device.is_cuda:
            return contextlib.nullcontext()
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.actions.device)))


gymnasium.register("warp_bsc/ClothFold-v0", vector_entry_point=ClothEnv)
