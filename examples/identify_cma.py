"""Counts the simulations that CMA-ES needs where the example Diffsim Identify follows gradients.

    python examples/identify_cma.py

Both see the same noisy frames and begin at the same guesses. An evaluation is one simulation of one cloth; with
gradients it also goes back. The count is that after which the best stiffness found so far is within two percent of the
truth, and stays so. Needs the package of N. Hansen and others, which nothing else here needs: ``pip install cma``.
"""

import argparse

import cma
import newton.viewer
import numpy as np
from example_diffsim_identify import STARTS, TRUTH, Example

SPREAD = 0.5  # standard deviation of the first samples, of logarithms


def make_example(starts, triangles):
    """Returns the example with a number of worlds."""
    options = ["--viewer", "null", "--triangles", str(triangles), "--starts", str(starts)]
    return Example(newton.viewer.ViewerNull(), Example.create_parser().parse_args(options))


def count(errors):
    """Returns after how many of the errors all that follow are within two percent; None if the last one is not."""
    outside = np.flatnonzero(np.abs(errors).max(axis=1) >= 0.02)
    first = 0 if len(outside) == 0 else outside[-1] + 1
    return first + 1 if first < len(errors) else None


def sample(start, most, triangles, seed):
    """Runs CMA-ES from a guess; returns the errors of the best stiffness so far after each evaluation, [n, 2]."""
    search = cma.CMAEvolutionStrategy(np.log(start), SPREAD, {"seed": seed, "verbose": -9})
    example = make_example(search.popsize, triangles)
    best, errors = np.inf, []
    while len(errors) < most:
        samples = search.ask()
        example.logarithms.assign(np.float32(samples))
        example.forward()
        losses = example.losses.numpy().astype(float)
        search.tell(samples, losses.tolist())
        for x, loss in zip(samples, losses, strict=True):
            if loss < best:
                best, error = loss, np.exp(x) / TRUTH - 1.0
            errors.append(error)
    return np.array(errors)


def main():
    """Prints the counts for each guess."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, default=128, help="Triangles of the cloth, about.")
    parser.add_argument("--gradients", type=int, default=9, help="Most evaluations with gradients.")
    parser.add_argument("--samples", type=int, default=126, help="Most evaluations of CMA-ES.")
    parser.add_argument("--seed", type=int, default=1, help="Seed of CMA-ES.")
    args = parser.parse_args()
    example = make_example(len(STARTS), args.triangles)
    for _ in range(args.gradients):
        example.step()
    for world, start in enumerate(STARTS):
        print(f"from {start}: {count(np.array(example.errors)[:, world])} evaluations with gradients", flush=True)
        sampled = sample(start, args.samples, args.triangles, args.seed)
        print(f"from {start}: {count(sampled)} evaluations of CMA-ES", flush=True)


if __name__ == "__main__":
    main()
