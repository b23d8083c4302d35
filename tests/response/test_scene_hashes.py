"""Hashes of scenes are the same in each run, and tell what a step does apart from what it did not do."""

from scene_hashes import hash_scene


def test_a_hash_is_that_of_the_results():
    first, report = hash_scene(0)
    assert hash_scene(0) == (first, report)
    assert hash_scene(17)[0] != first
    assert report.startswith("8 steps")
