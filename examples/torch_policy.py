"""Trains a small PyTorch policy to steer thrown soft cubes, by gradients through their bounces.

    python examples/torch_policy.py

A soft cube is thrown at the ground, and wind of at most four times its weight is to bring it to a mark in the air 0.2 s
later, after it has bounced. The policy, a network of 355 weights, sees the centre of the cube, its velocity and the
time, and sets the wind ten times. ``warp_bsc.torch.rollout`` takes the steps of ``SolverImplicit`` between two of its
decisions, so that the gradient of the loss goes back through flight, bounce, friction and all decisions. Each iteration
takes eight random throws, in eight worlds; at the end, eight others tell how far from the mark cubes end, with the
policy and without wind. Needs the extra ``torch``; takes a minute on two cores, and ends about 1 cm from the mark.
"""

import argparse
import time

import newton
import numpy as np
import torch
import warp as wp
from diffsim import MAX_ITERATIONS, add_cube, build_worlds

import warp_bsc as bsc
import warp_bsc.torch

WORLDS = 8
DECISIONS = 10
STEPS_PER_DECISION = 4
DT = 1.0 / 200.0
MARK = (0.15, 0.05, 0.1)  # [m]
MOST_WIND = 40.0  # acceleration [m/s^2]
ITERATIONS = 40


def make_solver():
    """Returns a solver of a soft cube above the ground in each world."""
    world = newton.ModelBuilder()
    add_cube(world, 2, 0.03, wp.vec3(0.0, 0.0, 0.1), wp.vec3(1.0, 0.4, 0.0), 0.15, stiffness=2.0e3)
    world.add_ground_plane()
    model = build_worlds(world, WORLDS)
    return bsc.SolverImplicit(model, friction=0.3, max_iterations=MAX_ITERATIONS)


class Throws:
    """Throws of soft cubes that a policy steers.

    Attributes:
        solver: The solver.
        lost: How many gradients of wind, positions and velocities of a throw were NaN, and count as 0.
    """

    def __init__(self, seed):
        self.solver, self.lost = make_solver(), 0
        self._random = np.random.default_rng(seed)
        model = self.solver.model
        self._start = wp.to_torch(model.particle_q, requires_grad=False).clone().reshape(WORLDS, -1, 3)
        self._mass = wp.to_torch(model.particle_mass, requires_grad=False).clone().reshape(WORLDS, -1, 1)

    def states(self):
        """Returns random throws: cubes that fly to the ground."""
        shifts = self._random.uniform((-0.05, -0.05, 0.0), (0.05, 0.05, 0.03), (WORLDS, 1, 3))
        velocities = self._random.uniform((0.0, -0.5, -1.8), (1.0, 0.5, -1.2), (WORLDS, 1, 3))
        shifts, velocities = (
            torch.tensor(x, dtype=torch.float32, device=self._start.device) for x in (shifts, velocities)
        )
        positions = self._start + shifts
        velocities = velocities.expand_as(positions)
        return {"particle_q": positions.reshape(-1, 3), "particle_qd": velocities.reshape(-1, 3).contiguous()}

    def distances(self, state, policy):
        """Returns how far from the mark the cubes end [m], shape [worlds]; without wind if there is no policy."""
        mark = torch.tensor(MARK, device=self._start.device)
        for decision in range(DECISIONS):
            centres, velocities = (self._means(state[name]) for name in ("particle_q", "particle_qd"))
            controls = {}
            if policy is not None:
                times = torch.full((WORLDS, 1), decision / DECISIONS, device=mark.device)
                wind = MOST_WIND * torch.tanh(policy(torch.cat([(centres - mark) / 0.1, velocities, times], dim=1)))
                controls["particle_f"] = self._guarded(self._mass * wind[:, None]).reshape(1, -1, 3)
            state = {name: self._guarded(state[name]) for name in ("particle_q", "particle_qd")}
            state = warp_bsc.torch.rollout(self.solver, state, controls, dt=DT, steps=STEPS_PER_DECISION)
        return torch.linalg.vector_norm(self._means(state["particle_q"]) - mark, dim=1)

    def _guarded(self, vectors):
        """Returns vectors of particles whose gradient is 0 in worlds in which it is NaN.

        That is where a later step, or the solve of its gradient, did not converge. Decisions after it still count.
        """

        def stop(gradient):
            is_known = gradient.reshape(WORLDS, -1).isfinite().all(dim=1)
            self.lost += int((~is_known).sum())
            return torch.where(is_known[:, None], gradient.reshape(WORLDS, -1), 0.0).reshape(gradient.shape)

        if vectors.requires_grad:
            vectors = vectors.view_as(vectors)
            vectors.register_hook(stop)
        return vectors

    @staticmethod
    def _means(vectors):
        return vectors.reshape(WORLDS, -1, 3).mean(dim=1)


def train(iterations, seed=0):
    """Trains a policy.

    Returns:
        The mean distance from the mark in each iteration [m], the distances of other throws with the policy and those
        without wind, each of shape [worlds], and the throws.
    """
    torch.manual_seed(seed)
    throws = Throws(seed)
    policy = torch.nn.Sequential(torch.nn.Linear(7, 32), torch.nn.Tanh(), torch.nn.Linear(32, 3))
    torch.nn.init.zeros_(policy[-1].weight)  # no wind at first, so that no cube is held on the ground
    policy.to(wp.device_to_torch(throws.solver.model.device))
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.03)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations, eta_min=0.001)
    history = []
    for iteration in range(iterations):
        distances = throws.distances(throws.states(), policy)
        optimizer.zero_grad()
        (distances**2).mean().backward()
        optimizer.step()
        rates.step()
        history.append(float(distances.detach().mean()))
        if iteration % 10 == 0:
            print(f"iteration {iteration}: {history[-1]:.3f} m from the mark", flush=True)
    others = throws.states()
    with torch.no_grad():
        steered, free = (throws.distances(others, choice).cpu().numpy() for choice in (policy, None))
    return history, steered, free, throws


def main():
    """Trains with the options of the command line, and prints how far from the mark cubes end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    start = time.perf_counter()
    _, steered, free, throws = train(args.iterations, args.seed)
    print(f"{time.perf_counter() - start:.0f} s; {throws.solver.report}; {throws.lost} gradients of throws NaN")
    for what, distances in (("with the policy", steered), ("without wind", free)):
        print(f"other throws end {distances.mean():.4f} m from the mark {what}, at most {distances.max():.4f} m")


if __name__ == "__main__":
    main()
