"""Groups and masks of a mesh: every detection leaves out the same pairs, counts them, and changes no other."""

import numpy as np
import pytest
from filters import left_in, random_bits

import warp_bsc as bsc
from warp_bsc.detection.at_rest.intersections import IntersectionFinder
from warp_bsc.detection.run.settings import PairKind

KINDS = [kind.label for kind in PairKind]


def scene(seed):
    """Triangles, ropes and points that cross one another, as arguments of a mesh, and their motion."""
    rng = np.random.default_rng(seed)
    x0 = rng.uniform(-1, 1, (94, 3)).astype(np.float32)
    x1 = x0 + rng.uniform(-0.6, 0.6, (94, 3)).astype(np.float32)
    elements = {"faces": np.arange(60).reshape(-1, 3), "vertex_count": 94}
    elements["edges"], elements["points"] = np.array([[60, 61], [61, 62], [62, 63]]), np.arange(64, 94)
    group, mask = random_bits(rng, 94)
    return elements, {"group": group, "mask": mask}, x0, x1


@pytest.mark.parametrize("min_distance", [0.0, 0.2])
@pytest.mark.parametrize("method", ["conservative", "exact"])
def test_only_the_pairs_that_are_left_in_are_found(method, min_distance, broad_phase):
    elements, bits, x0, x1 = scene(2)
    options = {"method": method, "min_distance": min_distance, "rings": 0}
    whole = bsc.CollisionDetector(bsc.CollisionMesh(**elements), **options).detect(x0, x1)
    mesh = bsc.CollisionMesh(**elements, **bits)
    found = bsc.CollisionDetector(mesh, **options).detect(x0, x1)
    assert found.certified and found.stats.filtered > 20 and whole.stats.filtered == 0
    for kind in KINDS if min_distance else KINDS[:2]:
        all_pairs, pairs = getattr(whole, kind), getattr(found, kind)
        np.testing.assert_array_equal(pairs, left_in(mesh, kind, all_pairs))
        assert 0 < len(pairs) < len(all_pairs), kind
        counts, all_counts = getattr(found.stats, kind), getattr(whole.stats, kind)
        assert counts.candidates + counts.filtered == all_counts.candidates
        assert counts.candidates == counts.free + counts.hits + counts.unsure


def test_groups_that_all_meet_change_no_bit(broad_phase):
    elements, _bits, x0, x1 = scene(4)
    plain = bsc.CollisionDetector(bsc.CollisionMesh(**elements)).detect(x0, x1)
    mesh = bsc.CollisionMesh(**elements, group=2**31, mask=2**31 + 1)
    found = bsc.CollisionDetector(mesh).detect(x0, x1)
    for kind in KINDS[:2]:
        np.testing.assert_array_equal(getattr(found, kind), getattr(plain, kind))
        np.testing.assert_array_equal(getattr(found, f"{kind}_toi"), getattr(plain, f"{kind}_toi"))
        assert getattr(found.stats, kind) == getattr(plain.stats, kind)
    assert len(plain.edge_edge)


def test_group_zero_meets_nothing_and_a_mask_is_needed_on_both_sides(broad_phase):
    elements, _bits, x0, x1 = scene(5)
    second = np.arange(94) >= 30
    for bits in ({"group": 0}, {"mask": 0}, {"group": 1 << second, "mask": np.where(second, -1, 0)}):
        found = bsc.CollisionDetector(bsc.CollisionMesh(**elements, **bits)).detect(x0, x1)
        both = [left_in(bsc.CollisionMesh(**elements, **bits), kind, getattr(found, kind)) for kind in KINDS[:2]]
        assert [len(pairs) for pairs in both] == [len(found.vertex_face), len(found.edge_edge)]
        assert found.stats.filtered and (len(found.vertex_face) > 0) == ("mask" in bits and "group" in bits)


def test_elements_meet_where_all_of_their_vertices_do():
    faces = [[0, 1, 2], [3, 4, 5]]
    x0 = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 1], [2, 1, 2], [1, 2, 2]], dtype=np.float32)
    x1 = x0 - np.float32([0, 0, 4]) * (np.arange(6) >= 3)[:, None]
    for group, hits in ([1, 1, 1, 4, 4, 4], [3, 4, 5]), ([1, 1, 1, 4, 2, 4], [3, 5]), ([1, 1, 8, 4, 4, 4], []):
        mesh = bsc.CollisionMesh(faces, 6, group=group, mask=[4, 4, 4, 1, 1, 1])
        found = bsc.CollisionDetector(mesh, method="exact").detect(x0, x1)
        assert found.vertex_face.tolist() == [[vertex, 0] for vertex in hits] and found.certified
        assert found.stats.vertex_face.filtered == 3 - len(hits)


def test_intersections_and_proximities_are_filtered_alike(broad_phase):
    elements, bits, x0, x1 = scene(2)
    whole, mesh = bsc.CollisionMesh(**elements), bsc.CollisionMesh(**elements, **bits)
    all_crossings, crossings = (IntersectionFinder(m).find(x0) for m in (whole, mesh))
    np.testing.assert_array_equal(crossings.pairs, left_in(mesh, "edge_face", all_crossings.pairs))
    assert 0 < len(crossings.pairs) < len(all_crossings.pairs)
    assert crossings.filtered > all_crossings.filtered == 0
    detector = bsc.CollisionDetector(mesh)
    start, moved = IntersectionFinder(mesh).find(x0), detector.detect(x0, x1)
    at_end = detector.intersection_finder().find_at_end(x1, start, moved)
    np.testing.assert_array_equal(at_end.pairs, left_in(mesh, "edge_face", IntersectionFinder(whole).find(x1).pairs))
    all_near, near = (bsc.CollisionDetector(m).find_proximities(x0, 0.5, rings=0) for m in (whole, mesh))
    assert near.filtered > all_near.filtered == 0
    for kind in KINDS:
        np.testing.assert_array_equal(getattr(near, kind), left_in(mesh, kind, getattr(all_near, kind)))
        assert 0 < len(getattr(near, kind)) < len(getattr(all_near, kind)), kind
