"""A vectorised Gymnasium environment in which fingers lift cloths by what they feel. Needs the extra ``gym``.

Each of the worlds of ``cloth_worlds.py`` is an environment. An action closes and lifts two fingers; an observation has
their places, the cloth's, and the contact forces on the fingers; the reward is what the cloth is lifted by, the share
of its weight that the fingers carry, and a price of pressing harder than needed. Worlds whose episode has ended start
anew in the next step, in which they take no part (``AutoresetMode.NEXT_STEP``), so that the others change no bit by it.
``train_cloth_env.py`` trains a policy.
"""

import gymnasium
import numpy as np
from cloth_worlds import HORIZON, OBSERVATIONS, SHIFT, ClothWorlds
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space


class ClothEnv(gymnasium.vector.VectorEnv):
    """Worlds with a cloth and two fingers, as environments of Gymnasium's vector interface.

    ``info`` has ``"certified"``, whether the stage certified all steps of a world since its reset: bool, shape
    [num_envs].

    Attributes:
        worlds: The simulation, whose observations and rewards are also on the device.
    """

    def __init__(self, num_envs=16, device=None):
        """Builds the worlds, on a Warp device."""
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self.num_envs, self.render_mode, self.spec = num_envs, None, None
        size = (len(OBSERVATIONS),)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.worlds = ClothWorlds(num_envs, device)
        self._done = np.zeros(num_envs, dtype=bool)
        self._certified = np.ones(num_envs, dtype=bool)

    def reset(self, *, seed=None, options=None):
        """Starts an episode in all worlds, or in those of ``options["reset_mask"]``, bool, shape [num_envs]."""
        if seed is not None:
            self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random(seed)
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.dtype != bool or mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask must be bool, of shape ({self.num_envs},), not {mask.dtype} {mask.shape}")
        self._start(mask)
        self._done[mask] = False
        return self._observations(), {"certified": self._certified.copy()}

    def step(self, actions):
        """Takes a control step in worlds whose episode goes on; the others start anew.

        Args:
            actions: Speeds of closing and lifting as shares of the largest, finite, shape [num_envs, 2]; those beyond
                1 count as 1.

        Raises:
            ValueError: If they have another shape, or are not finite. No world takes a step then.
        """
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions must have the shape {self.action_space.shape}, not {actions.shape}")
        wrong = np.flatnonzero(~np.isfinite(actions).all(axis=1))
        if len(wrong):
            raise ValueError(f"actions must be finite, not {actions[wrong[0]].tolist()}, in worlds {wrong.tolist()}")
        resets = self._done
        active = ~resets
        self.worlds.step(actions, active)
        rewards, terminated = self.worlds.rewards.numpy().copy(), self.worlds.terminated.numpy().copy()
        self._certified &= self.worlds.certified.numpy()
        if resets.any():
            self._start(resets)
        truncated = active & ~terminated & (self.worlds.gripper.time.numpy() >= HORIZON)
        self._done = terminated | truncated
        return self._observations(), rewards, terminated, truncated, {"certified": self._certified.copy()}

    def _start(self, worlds):
        self.worlds.reset(worlds, self.np_random.uniform(-SHIFT, SHIFT, (self.num_envs, 2)))
        self._certified[worlds] = True

    def _observations(self):
        return self.worlds.observations.numpy().copy()


gymnasium.register("warp_bsc/ClothLift-v0", vector_entry_point=ClothEnv)
