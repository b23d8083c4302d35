"""Imports pause the collection of garbage, and leave it as it was."""

import gc
import subprocess
import sys

import pytest

import warp_bsc
from warp_bsc._garbage import paused_collection


@pytest.mark.parametrize("enabled", [True, False])
def test_it_is_left_as_it_was(enabled):
    (gc.enable if enabled else gc.disable)()
    frozen = gc.get_freeze_count()
    try:
        with pytest.raises(KeyError), paused_collection():
            assert not gc.isenabled()
            raise KeyError
        assert gc.isenabled() is enabled and gc.get_freeze_count() == frozen
    finally:
        gc.enable()


@pytest.mark.parametrize("frozen", [False, True])
def test_garbage_of_before_is_collected_after(frozen):
    code = f"""
import gc, weakref
if {frozen}:
    gc.freeze()
import warp_bsc
class Loop: pass
loop = Loop()
loop.self = loop
gone = weakref.ref(loop)
del loop
warp_bsc.CollisionDetector
count = gc.get_freeze_count()
gc.collect()
assert gone() is None and gc.isenabled() and (count > 0) is {frozen}, (gone(), count)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_name_that_is_imported_pauses_nothing(monkeypatch):
    """It would make all objects of the program old again and again, and count those that are frozen."""
    assert warp_bsc.CollisionDetector
    monkeypatch.setattr(warp_bsc, "paused_collection", lambda: pytest.fail("paused"))
    assert warp_bsc.CollisionDetector


def test_a_name_is_imported_in_a_pause():
    code = """
import gc, sys, warp_bsc
seen = []
class Finder:
    def find_spec(name, path, target=None):
        seen.append(gc.isenabled())
sys.meta_path.insert(0, Finder)
warp_bsc.CollisionDetector
assert len(seen) > 10 and not any(seen) and gc.isenabled(), seen
"""
    subprocess.run([sys.executable, "-c", code], check=True)
