"""Comparison of the results of detections."""

FIELDS = [
    f"{kind}{field}" for kind in ("vertex_face", "edge_edge") for field in ("", "_toi", "_coordinates", "_normal")
]


def assert_same(collisions, others):
    """Asserts that two results are the same, bit by bit."""
    for field in FIELDS:
        assert getattr(collisions, field).tobytes() == getattr(others, field).tobytes(), field
