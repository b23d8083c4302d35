"""Piles of sheets come to rest without gaining energy."""

from pile_energy import gained, rest


def test_a_pile_gains_no_energy(device):
    """With 16 sweeps on positions and 12 on velocities, ten sheets gained 12% of what they had begun with."""
    totals, report = rest(10, 70, device=device, show=lambda line: None)
    assert gained(totals) < 0.03 * totals[0]
    assert totals[-1] < 0.1 * totals[0]
    assert report.totals.uncertified_steps == 0 and report.totals.frozen_steps == 0
