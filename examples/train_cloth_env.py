"""Grippers learn to fold cloths in the environment of ``cloth_env.py``.

    python examples/train_cloth_env.py

Training is plain REINFORCE in PyTorch: a Gaussian policy, rewards to go without a critic, the mean of the worlds at
each time as the baseline. All of it stays on the device of the worlds. Needs the extras ``gym`` and ``torch``; 16
worlds take some minutes on two cores. On a GPU, take more: ``--worlds 1024``.
"""

import argparse
import time

import cloth_env  # noqa: F401 (registers the environment)
import gymnasium
import torch
import warp as wp
from cloth_env import HORIZON, OBSERVATIONS

from warp_bsc.bench.crossings import CrossingCounter

DISCOUNT = 0.95


class Policy(torch.nn.Module):
    """A Gaussian policy whose mean is a small network."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.mean = torch.nn.Sequential(torch.nn.Linear(inputs, 32), torch.nn.Tanh(), torch.nn.Linear(32, outputs))
        self.log_deviation = torch.nn.Parameter(torch.full((outputs,), -0.5))
        torch.nn.init.zeros_(self.mean[2].weight)
        torch.nn.init.zeros_(self.mean[2].bias)

    def forward(self, observations):
        """Returns the distribution of actions."""
        return torch.distributions.Normal(self.mean(observations), self.log_deviation.exp())


@torch.no_grad()
def roll_out(env, policy, *, explore=True):
    """Runs one episode in each world.

    Returns:
        Observations, actions, rewards, and whether the world took part, with shapes [steps, worlds, ...]; and the share
        of worlds that folded their cloth.
    """
    observations, _ = env.reset()
    rows, alive = [], torch.ones(env.num_envs, dtype=torch.bool, device=observations.device)
    folded = torch.zeros_like(alive)
    for _ in range(HORIZON):
        seen = observations.clone()  # the next step overwrites it
        distribution = policy(seen)
        actions = distribution.sample() if explore else distribution.mean
        _, rewards, terminated, truncated, _ = env.step(actions)
        rows.append((seen, actions, rewards * alive, alive))
        folded |= alive & terminated
        alive = alive & ~(terminated | truncated)
    return *(torch.stack(column) for column in zip(*rows, strict=True)), float(folded.float().mean())


def train(worlds=16, iterations=40, seed=0, device=None):
    """Trains a policy.

    Returns:
        The mean return of an episode in each iteration, the return and the share of folded cloths of new episodes
        without exploration, before training and after, and the environment.
    """
    torch.manual_seed(seed)
    env = gymnasium.make_vec("warp_bsc/ClothFold-v0", num_envs=worlds, device=device)
    observations, _ = env.reset(seed=seed)
    policy = Policy(OBSERVATIONS, 3).to(observations.device)
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.02)

    def measure():
        _, _, rewards, _, folded = roll_out(env, policy, explore=False)
        return float(rewards.sum(dim=0).mean()), folded

    history, measured = [], [measure()]
    for iteration in range(iterations):
        seen, actions, rewards, alive, folded = roll_out(env, policy)
        returns, to_go = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
        for step in reversed(range(HORIZON)):
            to_go = rewards[step] + DISCOUNT * to_go
            returns[step] = to_go
        advantages = returns - returns.mean(dim=1, keepdim=True)
        advantages /= advantages[alive].std() + 1e-6
        log_likelihoods = policy(seen).log_prob(actions).sum(dim=2)
        loss = -(log_likelihoods * advantages)[alive].mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        history.append(float(rewards.sum(dim=0).mean()))
        if iteration % 5 == 0 or iteration == iterations - 1:
            print(f"iteration {iteration}: return {history[-1]:.2f}, {folded:.0%} folded", flush=True)
    measured.append(measure())
    return history, measured, env


def main():
    """Trains with the options of the command line, and prints the returns of new episodes before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    start, processor = time.perf_counter(), time.process_time()
    _, measured, env = train(args.worlds, args.iterations, args.seed, args.device)
    print(f"{time.perf_counter() - start:.0f} s, {time.process_time() - processor:.0f} s of processor time")
    for when, (mean, folded) in zip(("before", "after"), measured, strict=True):
        print(f"{when} training, new episodes return {mean:.2f}, and {folded:.0%} of the cloths are folded")
    solver, state = env.unwrapped.solver, env.unwrapped.state
    print(f"{solver.report}; {CrossingCounter(solver.model).count(state)} crossings at the end")


if __name__ == "__main__":
    main()
