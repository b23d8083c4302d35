"""The time limit of detectors that others wrote, and what is counted."""

import os
import sys

import ccd_peers
import numpy as np
import pytest

linux = pytest.mark.skipif(sys.platform != "linux", reason="timers and forks of Linux")


@linux
def test_a_query_that_does_not_end_is_late():
    def ccd(query):
        while query == "slow":
            pass
        return query == "hit", 0.5

    queries = [["free"], ["slow"], ["hit"], ["slow"], ["slow"]]
    answers = ccd_peers.decide_within(ccd, queries, 0.05)
    assert answers.tolist() == [ccd_peers.FREE, ccd_peers.LATE, ccd_peers.HIT, ccd_peers.LATE, ccd_peers.LATE]


@linux
def test_a_crash_is_an_error():
    with pytest.raises(RuntimeError, match="query 1: exit code 3"):
        ccd_peers.decide_within(lambda crashes: os._exit(3) if crashes else (True, 0.0), [[False], [True]], 1.0)


def test_rows_count_what_is_wrong(monkeypatch):
    answers = {"float": [1, 0, 0, 0], "additive": [0, 1, 2, 1]}
    monkeypatch.setattr(ccd_peers, "DETECTORS", tuple(answers))
    monkeypatch.setattr(ccd_peers, "decide", lambda detector, *_: np.array(answers[detector]))
    first, second = ccd_peers.count_wrong([("set", "edge_edge", None, np.array([True, True, True, False]))], 1.0)
    assert first == dict(queries="set", detector="float", colliding=3, free=1, missed=2, false=0, late=0)
    assert second == dict(queries="set", detector="additive", colliding=3, free=1, missed=1, false=1, late=1)
