"""Bad values of every public argument and option get an error that names it; other spellings of good ones are taken."""

import bad_arguments
import numpy as np
import pytest

import warp_bsc as bsc


@pytest.fixture(scope="module")
def rows():
    return bad_arguments.rows()


def test_bad_values_get_errors_that_name_the_argument(rows):
    flagged = [f"{row.function}({row.argument}={row.value}): {row.got}: {row.flag}" for row in rows if row.flag]
    assert not flagged, "\n".join(flagged)
    assert len(rows) > 1500


def test_a_new_callable_and_a_new_argument_are_noticed():
    found = bad_arguments.calls()
    assert not list(bad_arguments.missing(found))
    del found["query_points"], found["replay"].bad["workers"]
    assert {(row.function, row.argument) for row in bad_arguments.missing(found)} == {
        ("query_points", ""),
        ("replay", "workers"),
    }


def test_what_is_accepted_misnamed_or_slow_is_flagged(monkeypatch):
    monkeypatch.setattr(bad_arguments, "SECONDS", 1)

    def flag(call):
        return bad_arguments.ask("f", "x", "", call, "", "x").flag

    def fail(error):
        raise error

    def hang():
        while True:
            pass

    assert flag(lambda: None) == "has no meaning"
    assert flag(hang) == "hangs"
    assert flag(lambda: fail(ValueError("max must be 1"))) == "does not name the argument"
    assert flag(lambda: fail(KeyError("x"))).startswith("neither")
    assert flag(lambda: fail(ValueError("x must be 1"))) == ""


def test_numpy_scalars_and_foreign_bytes_are_as_good_as_others():
    faces, x = np.array([[0, 1, 2], [3, 4, 5]]), np.random.default_rng(1).uniform(-1.0, 1.0, (2, 6, 3))
    mesh = bsc.CollisionMesh(faces, 6, radius=0.25, device="cpu")
    other = bsc.CollisionMesh(
        np.ma.MaskedArray(faces.astype(">i8"), False),
        np.uint8(6),
        radius=np.full(6, 0.25, ">f4"),
        only_free=np.False_,
        device="cpu",
    )
    options = {"tolerance": np.float32(0.25), "min_distance": np.int64(1), "rings": np.int32(0)}
    expected = bsc.CollisionDetector(mesh, tolerance=0.25, min_distance=1.0, rings=0).detect(*x)
    found = bsc.CollisionDetector(other, **options).detect(*x.astype(">f8"))
    assert len(expected.edge_edge)
    for name in ("vertex_face", "edge_edge", "edge_edge_toi"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))
    assert bsc.FrameRange(np.int64(1), np.float32(2.0)) == bsc.FrameRange(1.0, 2.0)
    assert bsc.Selection(prims=["/A"], self_collisions=np.True_) == bsc.Selection(prims=("/A",))
