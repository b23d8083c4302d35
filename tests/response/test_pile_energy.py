"""Piles of sheets come to rest without gaining energy."""

from pile_energy import gained, rest


def test_a_pile_gains_no_energy(device):
    """With planes that do not move, and projection of all proximities, ten sheets gained 12% of what they had."""
    totals, steps = rest(10, 70, device=device, show=lambda line: None)
    assert gained(totals) < 0.01 * totals[0]
    assert totals[-1] < 0.03 * totals[0]
    report = steps.solver.report
    assert report.totals.uncertified_steps == 0 and report.totals.frozen_steps == 0
