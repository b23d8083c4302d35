"""Counts the simulations that CMA-ES needs where the examples of identification follow gradients.

    python examples/identify_cma.py
    python examples/identify_cma.py --example real_to_sim --gradients 24 --samples 420

Both see the same noisy frames and begin at the same guesses. An evaluation is one simulation of one cloth; with
gradients it also goes back. The count is that after which the best parameters found so far are within two percent of
the truth, and stay so. Other options are those of the example. Needs the package of N. Hansen and others, which nothing
else here needs: ``pip install cma``.
"""

import argparse
import importlib

import cma
import newton.viewer
import numpy as np

SPREAD = 0.5  # standard deviation of the first samples, of logarithms
WORLDS = {"identify": "--starts", "real_to_sim": "--worlds"}
"""The examples, and their options for the number of worlds."""


def make_example(name, options):
    """Returns an example."""
    example_class = importlib.import_module(f"example_diffsim_{name}").Example
    args = example_class.create_parser().parse_args(["--viewer", "null", *options])
    return example_class(newton.viewer.ViewerNull(), args)


def count(errors):
    """Returns after how many of the errors all that follow are within two percent; None if the last one is not."""
    outside = np.flatnonzero(np.abs(errors).max(axis=1) >= 0.02)
    first = 0 if len(outside) == 0 else outside[-1] + 1
    return first + 1 if first < len(errors) else None


def sample(example, start, truth, most, seed):
    """Runs CMA-ES from a guess, in an example with a world for each sample.

    Returns:
        The errors of the best parameters so far after each evaluation, shape [n, parameters].
    """
    search = cma.CMAEvolutionStrategy(np.log(start), SPREAD, {"seed": seed, "verbose": -9, "popsize": example.worlds})
    best, errors = np.inf, []
    while len(errors) < most:
        samples = search.ask()
        example.logarithms.assign(np.float32(samples))
        example.forward()
        losses = example.losses.numpy().astype(float)
        search.tell(samples, losses.tolist())
        for x, loss in zip(samples, losses, strict=True):
            if loss < best:
                best, error = loss, np.exp(x) / truth - 1.0
            errors.append(error)
    return np.array(errors)


def main():
    """Prints the counts for each guess."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--example", choices=list(WORLDS), default="identify", help="What is to be found.")
    parser.add_argument("--gradients", type=int, default=9, help="Most evaluations with gradients.")
    parser.add_argument("--samples", type=int, default=126, help="Most evaluations of CMA-ES.")
    parser.add_argument("--cma-seed", type=int, default=1, help="Seed of CMA-ES.")
    args, options = parser.parse_known_args()
    example = make_example(args.example, options)
    for _ in range(args.gradients):
        example.step()
    popsize = 4 + int(3.0 * np.log(len(example.truth)))  # the default of CMA-ES
    sampled = make_example(args.example, [*options, WORLDS[args.example], str(popsize)])
    for world, start in enumerate(example.starts):
        print(f"from {np.round(start, 4)}: {count(np.array(example.errors)[:, world])} evaluations with gradients")
        sampled.take_recording(example, world)
        errors = sample(sampled, start, example.truth, args.samples, args.cma_seed)
        print(f"from {np.round(start, 4)}: {count(errors)} evaluations of CMA-ES", flush=True)


if __name__ == "__main__":
    main()
