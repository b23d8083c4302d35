"""What a report says of gradients that are NaN, or grow, on their way back through steps."""

import pytest
import warp as wp

from warp_bsc.implicit.gradients import kernels
from warp_bsc.implicit.gradients.report import GradientCounts, GradientReport


def report_of(device, *, before, after, failed=(0, 0), not_solved=(0, 0)):
    """A report of the second step of a tape in two worlds, given squared norms at its end and at its start."""
    report = GradientReport(2, device)
    tape = wp.Tape()
    report.add_step(tape)
    number, norms = report.add_step(tape)
    norms.assign([before, after])
    largest = wp.array([7, 11], dtype=wp.int64, device=device)
    flags = (wp.array(values, dtype=int, device=device) for values in (failed, not_solved))
    inputs = [number, *flags, largest, norms, report.counts]
    wp.launch(kernels.report_gradients, 2, inputs=inputs, device=device)
    report.copy_counts()
    wp.synchronize_device(device)
    return report


def test_growth_names_step_and_particle(device):
    report = report_of(wp.get_device(device), before=[1.0, 1.0], after=[0.9e6, 1.1e6])
    assert report.totals() == GradientCounts(
        steps=1, unsolved=0, failed_solves=0, growing=1, ambiguous_moves=0, unrepeated=0
    )
    assert "within step 1 of a tape, most of it at particle 11" in report.warnings()["growing"]
    assert report.norms[1] == pytest.approx([0.9e6**0.5, 1.1e6**0.5]) and report.norms[2] == pytest.approx([1.0, 1.0])


def test_what_is_lost_counts_once(device):
    """Not in a world without gradients, and not again where it was NaN before."""
    report = report_of(wp.get_device(device), before=[1.0, 0.0], after=[1.0, 0.0], failed=(1, 1))
    report.counts[kernels.Count.AMBIGUOUS_MOVES : kernels.Count.AMBIGUOUS_MOVES + 1].fill_(3)
    assert report.totals() == GradientCounts(
        steps=1, unsolved=1, failed_solves=0, growing=0, ambiguous_moves=3, unrepeated=0
    )
    assert set(report.warnings()) == {"unsolved"} and "NaN in 1 worlds" in report.totals().text()
    report = report_of(wp.get_device(device), before=[1.0, float("nan")], after=[1.0, 1.0], not_solved=(1, 1))
    assert report.totals().failed_solves == 1 and set(report.warnings()) == {"failed solves"}
