"""Contacts on arcs, of single pairs and of a detector, against interval arithmetic: see certify_arcs.py."""

import importlib.util

import numpy as np
import pytest
from arc_intervals import FREE, HIT, decide_by_mpmath, decide_by_numpy
from certify_arcs import GENERATORS, KINDS, certify
from sample_sizes import cases


def test_no_collision_on_arcs_is_missed_and_nothing_farther_apart_than_the_tolerance_is_reported(device):
    searches, detections = certify(cases(1600), 5, device, of_detector=10)
    for name, verdict in searches.items():
        assert (verdict.missed, verdict.late, verdict.beyond, verdict.undecided) == (0, 0, 0, 0), (name, verdict)
        assert verdict.colliding > 0 and verdict.unsure == 0
    assert searches["tip"].colliding < 0.7 * searches["tip"].pairs
    assert searches["anywhere"].at_once > 0.5 * searches["anywhere"].pairs
    for name, verdict in detections.items():
        assert (verdict.missed, verdict.late, verdict.beyond) == (0, 0, 0), (name, verdict)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mpmath") is None, reason="needs mpmath, of the extra dev")
def test_intervals_of_numpy_prove_what_those_of_mpmath_do():
    rng = np.random.default_rng(2)
    decided = set()
    for name, generate in GENERATORS.items():
        for kind in KINDS:
            pairs = generate(kind, rng, 4)
            truth = decide_by_numpy(pairs)
            for row in range(len(pairs)):
                status, _before = decide_by_mpmath(pairs, row)
                assert truth.status[row] == status, (name, kind, row)
                decided.add(status)
    assert decided == {FREE, HIT}
