"""Measurements of repair: meshes that are freed or need a hint, files, and what repairs have in common."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import warp_bsc as bsc
from warp_bsc.bench.measure import repair
from warp_bsc.bench.measure.repair import FILE, KNOWN_MESH, RepairAttempt, RepairRun, measure_repair, summarize
from warp_bsc.bench.peers import ipc_toolkit
from warp_bsc.bench.scenes.repair import TangledMesh, damaged, load_tangled


def cross(*, size=32):
    """Two sheets, one through the other from border to border."""
    u, v = np.mgrid[:size, :size].reshape(2, -1) / (size - 1.0)
    i = np.arange(size * size).reshape(size, size)
    corners = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
    faces = np.concatenate(
        [np.stack([corners[k] for k in three], -1).reshape(-1, 3) for three in ((0, 1, 2), (0, 2, 3))]
    )
    flat = np.stack([u, v, 0 * u], -1)
    slope = np.stack([u + 0.013, v + 0.0071, 0.3 * (u - 0.7) + 0.0003], -1)
    sheet = np.repeat([0, 1], len(u))
    x = np.concatenate([flat, slope])
    free = x + (sheet == 1)[:, None] * np.array([0.0, 0.0, 0.3])
    return TangledMesh(np.concatenate([faces, faces + len(u)]), x, free, np.zeros(len(x), bool), sheet)


def test_what_is_free_without_a_hint(device):
    mesh = damaged("bodies", 0)
    run = measure_repair("bodies", "0", mesh, device=device)
    (attempt,) = run.attempts
    result = bsc.repair(mesh.faces, mesh.x, device=device)
    assert (run.kind, run.name, run.vertices, run.faces) == ("bodies", "0", len(mesh.x), len(mesh.faces))
    assert (run.crossings, attempt.crossings, attempt.certified) == (result.crossings_before, 0, True)
    edges = bsc.CollisionMesh(mesh.faces, len(mesh.x), device="cpu").edges
    edge = np.median(np.linalg.norm(mesh.x[edges[:, 0]] - mesh.x[edges[:, 1]], axis=1))
    assert attempt.largest_move == pytest.approx(result.moved.max() / edge)
    assert attempt.mean_move == pytest.approx(result.moved[result.moved > 0].mean() / edge)
    assert attempt.strain == result.max_strain
    assert attempt.seconds > 0.0
    assert (attempt.hint, attempt.reasons) == ("none", ())
    assert attempt.toolkit_agrees is (True if ipc_toolkit.is_installed() else None)
    assert run.keeps_free is True


@pytest.mark.slow
def test_what_needs_a_hint_is_repaired_with_each(device, monkeypatch):
    """Sheets that no time is left for without one."""
    repaired = repair.repair

    def is_hasty(*mesh, **options):
        hasty = {} if options.keys() & {"order", "x_previous"} else {"time_limit": 1e-6}
        return repaired(*mesh, **options, **hasty)

    monkeypatch.setattr(repair, "repair", is_hasty)
    run = measure_repair(KNOWN_MESH, "cross", cross(), device=device)
    assert [attempt.hint for attempt in run.attempts] == ["none", "order", "x_previous"]
    assert [attempt.certified for attempt in run.attempts] == [False, True, True]
    first = run.attempts[0]
    assert first.crossings == run.crossings > 0
    assert (first.largest_move, first.mean_move, first.strain) == (0.0, 0.0, 0.0)
    assert len(first.reasons) == 1 and "time limit" in first.reasons[0]
    assert (run.is_freed(), run.is_freed("order"), run.is_freed("x_previous")) == (False, True, True)


def test_what_has_no_hints(device):
    mesh = cross(size=8)
    held = replace(mesh, free=None, sheet=np.full(len(mesh.x), -1), fixed=np.ones(len(mesh.x), bool))
    run = measure_repair(FILE, "held.obj", held, device=device)
    assert [attempt.hint for attempt in run.attempts] == ["none"]
    assert (run.is_freed("order", "x_previous"), run.keeps_free) == (False, None)


def test_what_moves_where_nothing_crosses_is_found(device, monkeypatch):
    repaired = repair.repair

    def moves_all(faces, x, **options):
        result = repaired(faces, x, **options)
        return replace(result, x=result.x + 1e-9)

    monkeypatch.setattr(repair, "repair", moves_all)
    assert measure_repair("bodies", "0", damaged("bodies", 0), device=device).keeps_free is False


def test_a_file_is_welded_and_keeps_its_order(tmp_path, device):
    """Two balls in each other, whose faces have corners of their own; one face has two corners at one place."""
    balls = trimesh.util.concatenate([trimesh.creation.icosphere(2).apply_translation([x, 0, 0]) for x in (0.0, 1.95)])
    soup = np.concatenate([balls.vertices[balls.faces].reshape(-1, 3), balls.vertices[[0, 0, 1]]])
    trimesh.Trimesh(soup, np.arange(len(soup)).reshape(-1, 3), process=False).export(tmp_path / "soup.ply")
    mesh = load_tangled(str(tmp_path / "soup.ply"))
    assert (len(mesh.x), len(mesh.faces)) == (len(balls.vertices), len(balls.faces))
    assert (mesh.x[mesh.faces] == balls.triangles.astype(np.float32)).all()
    assert mesh.free is None and not mesh.fixed.any() and (mesh.sheet == -1).all()
    run = measure_repair(FILE, "soup.ply", mesh, device=device)
    assert run.crossings > 0 and run.is_freed() and run.keeps_free is True


def test_files_that_are_no_meshes(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.obj: no such file"):
        load_tangled(str(tmp_path / "none.obj"))
    path = tmp_path / "flat.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 0 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"flat\.obj: it has no triangles with three different corners"):
        load_tangled(str(path))
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"flat\.obj: it has positions that are not finite"):
        load_tangled(str(path))


def test_what_repairs_have_in_common():
    def run(crossings, *attempts):
        return RepairRun("folds", "0", 9, 9, crossings, attempts, True)

    def attempt(hint, left, move, strain, seconds):
        return RepairAttempt(hint, left, left == 0, move, 0.1, strain, seconds, (), None)

    found = summarize(
        [
            run(4, attempt("none", 0, 0.5, 0.02, 0.1)),
            run(90, attempt("none", 0, 1.0, 0.11, 0.4)),
            run(
                7,
                attempt("none", 3, 9.0, 0.05, 0.3),
                attempt("order", 2, 1.0, 0.9, 9.0),
                attempt("x_previous", 0, 1, 1, 1),
            ),
        ]
    )
    assert found == {
        "meshes": 3,
        "freed": 2,
        "freed_by_hint": {"order": 2, "x_previous": 3},
        "crossings": (4, 90),
        "move": (1.0, 9.0),
        "strain": (0.05, 0.11),
        "strained": 1,
        "seconds": 0.3,
    }
