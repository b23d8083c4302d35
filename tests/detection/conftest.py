"""Fixtures of tests of the detector."""

import pytest

from warp_bsc.detection.broad.broad_phase_hierarchy import BroadPhaseHierarchy
from warp_bsc.detection.broad.broad_phase_simd import BroadPhaseSimd


@pytest.fixture(params=[BroadPhaseSimd, BroadPhaseHierarchy], ids=["simd", "hierarchy"])
def broad_phase(request, monkeypatch, device):
    """Both broad phases where both run, whatever the detector would choose."""
    if device.is_cuda and request.param is BroadPhaseSimd:
        pytest.skip("SIMD packets are for the CPU")
    chosen = "BroadPhaseSimd" if device.is_cpu else "BroadPhaseHierarchy"
    monkeypatch.setattr(f"warp_bsc.detection.broad.broad_phase.{chosen}", request.param)
    return request.param
