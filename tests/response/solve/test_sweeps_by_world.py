"""Sweeps by world: in one launch, by threads of its own, a world is solved as by launches for each sweep, and alone."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, Changed, bullet

import warp_bsc as bsc
from warp_bsc.response.state import workspace
from warp_bsc.response.state.cluster import threads_of_world

SPEEDS = 2.0, 60.0, 9.0, 30.0


def run(speeds, device, options):
    """Steps a patch that flies at a sheet, with a world for each speed; returns its state in each world, by steps.

    The second world takes no part in the third step, and the first one goes back to its start after the fifth.
    """
    model = bullet(1.0, device=device, worlds=len(speeds))
    count = model.particle_count // len(speeds)
    velocity = model.particle_qd.numpy() * np.repeat(speeds, count)[:, None]
    model.particle_qd.assign(velocity)
    solver = bsc.SolverCCD(Changed(model), friction=0.3, report=["worlds"], **options)
    states, ends, hits = [model.state(), model.state()], [], 0
    for step in range(8):
        mask = wp.array([speed != SPEEDS[1] or step != 2 for speed in speeds] + [True], dtype=bool, device=device)
        solver.step(*states, None, None, DT, world_mask=mask)
        states.reverse()
        if step == 4:
            back = np.repeat([speed == SPEEDS[0] for speed in speeds], count)[:, None]
            for name in ("particle_q", "particle_qd"):
                array = getattr(states[0], name)
                array.assign(np.where(back, getattr(model, name).numpy(), array.numpy()))
            solver.reset(states[0], wp.array([speed == SPEEDS[0] for speed in speeds] + [False], device=device))
        results = solver.report.worlds.numpy()
        hits += results["predicted_contacts"]
        arrays = [getattr(states[0], name).numpy().reshape(len(speeds), -1) for name in ("particle_q", "particle_qd")]
        ends.append(
            np.concatenate(
                [*arrays, *(results[name].reshape(-1, 1) for name in ("predicted_contacts", "strain"))], axis=1
            )
        )
    return np.stack(ends, axis=1), hits


@pytest.mark.filterwarnings("ignore:a step")
@pytest.mark.parametrize(
    "options", [pytest.param({}, marks=pytest.mark.slow), {"min_distance": 0.004}, {"substeps": 3}], ids=str
)
def test_worlds_swept_apart_are_solved_as_by_a_launch_for_each_sweep_and_alone(options, monkeypatch, device):
    together, hits = run(SPEEDS, device, options)
    assert hits[0] == 0 and (hits[1:] > 0).all()
    alone = [run([speed], device, options)[0] for speed in SPEEDS]
    np.testing.assert_array_equal(together, np.concatenate(alone))
    monkeypatch.setattr(workspace, "threads_of_world", lambda *_: 0)
    launched, _hits = run(SPEEDS, device, options)
    np.testing.assert_array_equal(together, launched)


@pytest.mark.parametrize(
    "arch, worlds, particles, threads",
    [
        (90, 1, 121, 2048),  # one world has a whole cluster
        (90, 1, 8192, 2048),
        (90, 1, 8193, 0),  # and a large one the whole GPU
        (90, 64, 121, 256),  # as many threads as there are at once, in one block
        (90, 200, 121, 128),
        (90, 264, 400, 128),
        (90, 265, 121, 0),  # fewer would not pay
        (75, 1, 121, 256),  # there are no clusters
        (75, 1024, 121, 0),
        (75, 4, 1025, 0),
    ],
)
def test_threads_of_a_world(arch, worlds, particles, threads):
    gpu = SimpleNamespace(is_cpu=False, arch=arch, sm_count=132)
    assert threads_of_world(gpu, worlds, particles) == threads
