"""The environment in which grippers fold cloths, by Gymnasium's vector interface, and its training."""

import numpy as np
import pytest

gymnasium, torch = pytest.importorskip("gymnasium"), pytest.importorskip("torch")

import cloth_env  # noqa: E402
import train_cloth_env  # noqa: E402

from warp_bsc.bench.crossings import CrossingCounter  # noqa: E402

WORLDS = 3


@pytest.fixture(scope="module")
def env(device):
    return gymnasium.make_vec("warp_bsc/ClothFold-v0", num_envs=WORLDS, device=str(device))


def arc(observations):
    """Actions that lay corners on the others on an arc."""
    way = 0.5 * (observations[:, :3] + observations[:, 3:6])
    far = way[:, :2].norm(dim=1, keepdim=True)
    rise = 1.6 * (far - 0.5)
    return torch.cat([way[:, :2] / (far + 0.05) * (1.0 - 0.6 * rise.abs()), rise], dim=1)


def positions(env):
    """The particles of each world."""
    return env.unwrapped.state.particle_q.numpy().reshape(WORLDS, -1, 3).copy()


def test_an_arc_folds_the_cloth(env):
    observations, _ = env.reset(seed=0)
    returns = torch.zeros(WORLDS, device=observations.device)
    for _ in range(cloth_env.HORIZON):
        _, rewards, terminated, truncated, info = env.step(arc(observations))
        returns += rewards
        if terminated.any():
            break
    assert terminated.all() and not truncated.any() and info["certified"].all()
    # 10 for what is left of the first distance, and 5: what the rewards of an episode add up to
    torch.testing.assert_close(returns, 15.0 - 10.0 * observations[:, 7], atol=1e-4, rtol=0.0)
    halves = positions(env).reshape(WORLDS, cloth_env.N, cloth_env.N, 3)  # rows along x
    distances = np.linalg.norm(halves - halves[:, :, ::-1], axis=3).mean(axis=(1, 2))
    assert (distances < 0.15 * 0.5 * 0.16 * 8 / 7).all()  # at the start, the mean of |2 x| of 7 columns
    solver, state = env.unwrapped.solver, env.unwrapped.state
    assert CrossingCounter(solver.model).count(state) == 0 and solver.report.totals.uncertified_steps == 0


def test_grippers_that_stand_fold_nothing(env):
    env.reset(seed=0)
    rewards = sum(env.step(torch.zeros(WORLDS, 3))[1] for _ in range(5))
    assert rewards.abs().max() < 0.1


def test_spaces_seeds_and_tensors(env):
    """A seed gives the same episodes bit by bit, in tensors that stay where they are, in Warp's memory."""
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(4)]
    runs, pointers = [], set()
    for seed in (7, 7, 8):
        results = [env.reset(seed=seed)[0]]
        assert results[0].cpu().numpy() in env.observation_space
        run = [results[0].clone()]
        for action in actions:
            results = env.step(action)
            observations, rewards, terminated, truncated, info = results
            assert observations.cpu().numpy() in env.observation_space
            assert rewards.dtype == torch.float32 and rewards.shape == (WORLDS,)
            assert terminated.dtype == truncated.dtype == info["certified"].dtype == torch.bool
            assert not (terminated | truncated).any()
            pointers.add(tuple(x.data_ptr() for x in (*results[:4], info["certified"], env.unwrapped.actions)))
            run += [observations.clone(), rewards.clone()]
        runs.append(run)
    assert len(pointers) == 1
    worlds = env.unwrapped.worlds
    assert next(iter(pointers))[:3] == (worlds.observations.ptr, worlds.rewards.ptr, worlds.terminated.ptr)
    assert all(torch.equal(one, other) for one, other in zip(*runs[:2], strict=True))
    assert not torch.equal(runs[0][0], runs[2][0]) and not torch.equal(runs[0][0][0], runs[0][0][1])


def test_a_mask_of_resets_starts_these_worlds_alone(env):
    env.reset(seed=3)
    for _ in range(3):
        observations = env.step(np.ones((WORLDS, 3)))[0].clone()
    before = positions(env)
    after = env.reset(options={"reset_mask": np.array([False, True, False])})[0]
    assert torch.equal(after[[0, 2]], observations[[0, 2]]) and after[1, 8] == 0.0 and after[1, 7] > 0.99
    np.testing.assert_array_equal(positions(env)[[0, 2]], before[[0, 2]])
    assert not np.array_equal(positions(env)[1], before[1])


def test_episodes_that_end_start_anew_in_the_next_step(env):
    """Worlds that end at different times: one starts while the others go on, and moves no cloth in that step."""
    env.reset(seed=3)
    first = positions(env)
    still = torch.zeros(WORLDS, 3)
    for _ in range(4):
        env.step(still)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    for _ in range(cloth_env.HORIZON - 4):
        observations, _, terminated, truncated, _ = env.step(still)
    assert truncated.tolist() == [False, True, False] and not terminated.any() and observations[1, 8] == 1.0
    before = positions(env)
    observations, rewards, terminated, truncated, _ = env.step(torch.ones(WORLDS, 3))
    assert not (terminated | truncated).any() and rewards[1] == 0.0 and observations[1, 8] == 0.0
    after = positions(env)
    assert not np.array_equal(after[0], before[0])
    np.testing.assert_allclose(after[1][:, 2], first[1][:, 2], atol=1e-7)  # flat, as at the start
    assert not np.allclose(after[1], first[1], atol=1e-4)  # but at another place
    sides = np.linalg.norm(np.diff(after[1].reshape(cloth_env.N, cloth_env.N, 3), axis=1), axis=2)
    np.testing.assert_allclose(sides, cloth_env.SIDE / cloth_env.CELLS, rtol=1e-5)


def test_an_action_that_is_not_finite_counts_as_none(env):
    env.reset(seed=3)
    _, rewards, _, _, info = env.step(torch.tensor([[0.0, 0.0, 0.0], [torch.nan] * 3, [1.0, -torch.inf, 0.0]]))
    assert rewards.isnan().tolist() == [False, True, True] and info["certified"].all()
    assert np.isfinite(positions(env)).all()


@pytest.mark.parametrize("shape", [(2,), (WORLDS, 2), (WORLDS + 1, 3)])
def test_actions_of_another_shape_are_refused(env, shape):
    with pytest.raises(ValueError, match=r"actions must have the shape \(3, 3\), not "):
        env.step(np.zeros(shape))


@pytest.mark.parametrize("mask", [[1, 0, 1], [True, False], [[True]] * WORLDS])
def test_a_mask_of_resets_that_is_none_is_refused(env, mask):
    with pytest.raises(ValueError, match=r"reset_mask must be bool, of shape \(3,\), not "):
        env.reset(options={"reset_mask": np.array(mask)})


def test_a_wrapper_that_works_in_numpy(env):
    """By Gymnasium's conversion of arrays."""
    conversion = pytest.importorskip("gymnasium.wrappers.vector.array_conversion", exc_type=ImportError)
    recorded = gymnasium.wrappers.vector.RecordEpisodeStatistics(conversion.ArrayConversion(env, torch, np))
    recorded.reset(seed=0)
    for _ in range(cloth_env.HORIZON):
        *_, info = recorded.step(np.zeros((WORLDS, 3), dtype=np.float32))
    assert list(info["episode"]["l"]) == [cloth_env.HORIZON] * WORLDS


def test_training(device):
    history, measured, _ = train_cloth_env.train(2, iterations=1, device=str(device))
    assert len(history) == 1 and np.isfinite(measured[1][0])


@pytest.mark.gpu
def test_training_of_many_worlds(device):
    """The return grows, all steps are certified, and nothing crosses, in a CUDA graph after the first episode."""
    history, _, env = train_cloth_env.train(1024, iterations=8, device=str(device))
    assert np.mean(history[-2:]) > history[0] + 0.5
    solver, state = env.unwrapped.solver, env.unwrapped.state
    assert solver.report.totals.uncertified_steps == 0 and CrossingCounter(solver.model).count(state) == 0
