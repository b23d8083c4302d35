"""The rules of NVIDIA's USD validation, which run where its package is installed."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from usd_stages import CORNERS, FALLING, add_mesh, add_tets, falling_stage, moved, new_stage, save

nvidia = pytest.importorskip("usd_validation_nvidia")

from warp_bsc import nvidia_validation as rules  # noqa: E402


@pytest.fixture(autouse=True)
def registered():
    plugin = rules.Plugin()
    plugin.on_startup()
    yield
    plugin.on_shutdown()


def found(stage, *checkers):
    engine = nvidia.ValidationEngine(init_rules=False)
    for checker in checkers or (rules.MeshOverlapChecker, rules.MeshCollisionChecker):
        engine.enable_rule(checker)
    return list(engine.validate(stage).issues())


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor in the first second; another one crosses it all the time."""
    stage = falling_stage(tmp_path)
    add_mesh(stage, "/World/Crossing", moved(FALLING, (0.5, 1.0, -0.25)))
    return Usd.Stage.Open(save(stage))


def test_overlap_and_collision(stage):
    crossings = found(stage, rules.MeshOverlapChecker)
    assert [issue.requirement.code for issue in crossings] == 2 * ["com.nvidia.usd.VG.006"]
    assert "/World/Crossing" in crossings[0].message and "cross from time 0 to 1" in crossings[0].message
    (collision,) = found(stage, rules.MeshCollisionChecker)
    assert "collide from time 0 to 1" in collision.message
    assert {str(at.path) for at in collision.at} == {"/World/Falling", "/World/Floor"}
    assert all(issue.severity == nvidia.IssueSeverity.FAILURE for issue in (*crossings, collision))


def test_a_mesh_inside_another_is_a_warning(tmp_path):
    stage = new_stage(tmp_path / "boxes.usda")
    for name, size in (("Case", 2.0), ("Inside", 1.0)):
        UsdGeom.Cube.Define(stage, f"/World/{name}").CreateSizeAttr(size)
    (issue,) = found(Usd.Stage.Open(save(stage)))
    assert issue.severity == nvidia.IssueSeverity.WARNING and issue.suggestion is None


def test_tetrahedra_that_invert_fail_without_a_fix(tmp_path):
    stage = new_stage(tmp_path / "soft.usda")
    add_tets(stage, CORNERS, [(1, 0, 2, 3)])
    (issue,) = found(stage, rules.MeshCollisionChecker)
    assert issue.severity == nvidia.IssueSeverity.FAILURE and issue.suggestion is None


def test_what_is_not_checked_is_an_error():
    issues = found(Usd.Stage.CreateInMemory())
    assert [issue.severity for issue in issues] == 2 * [nvidia.IssueSeverity.ERROR]
    assert all(issue.message.startswith("Not checked: ") for issue in issues)


def sheet_through_a_wall(tmp_path):
    """A sheet of 8 x 8 cells goes a little through a wall that does not move, and back."""
    stage = new_stage(tmp_path / "sheet.usda")
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(2)
    n = 9
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, n)], [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=1)
    for name, heights in (("Sheet", (0.05, -0.02, 0.05)), ("Wall", None)):
        mesh = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        mesh.CreateFaceVertexCountsAttr(len(faces) * [4])
        mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
        if heights is None:
            mesh.CreatePointsAttr((2.0 * grid + (0.013, 0.017, 0.0)).tolist())
        else:
            bump = 0.04 * np.exp(-20.0 * (grid[:, :2] ** 2).sum(axis=1))
            for time, height in enumerate(heights):
                points = grid + np.stack([0 * bump, 0 * bump, height + 0.06 - 2.0 * bump], axis=1)
                mesh.CreatePointsAttr().Set(points.tolist(), time)
    return Usd.Stage.Open(save(stage))


def test_the_fix_moves_deforming_meshes_apart(tmp_path):
    stage = sheet_through_a_wall(tmp_path)
    issues = found(stage)
    assert {type(issue.suggestion) for issue in issues} == {nvidia.Suggestion}
    fixer = nvidia.IssueFixer(stage)
    (result,) = fixer.fix(issues[:1])
    assert result.status == nvidia.FixStatus.SUCCESS, result.exception
    assert not found(stage)
    fixer.save()
    assert not found(Usd.Stage.Open(stage.GetRootLayer().realPath))


def test_what_cannot_be_fixed_stays_as_it_is(stage):
    before = stage.GetRootLayer().ExportToString()
    (result, *_) = nvidia.IssueFixer(stage).fix(found(stage)[:1])
    assert result.status == nvidia.FixStatus.FAILURE and "remain" in str(result.exception)
    assert stage.GetRootLayer().ExportToString() == before


def test_what_is_meant_is_neither_an_issue_nor_repaired(tmp_path):
    """A sheet goes through a wall, as a file beside the root layer says it should."""
    stage = sheet_through_a_wall(tmp_path)
    entry = {"meshes": ["/World/Sheet", "/World/Wall"], "reason": "a ghost", "who": "ada", "date": "2026-11-29"}
    triage = tmp_path / "sheet.triage.json"
    triage.write_text(json.dumps({"version": 1, "meant": [entry]}))
    issues = found(stage)
    assert [issue.severity for issue in issues] == 2 * [nvidia.IssueSeverity.INFO]
    said = f"{triage} was read. Not counted: 1 meant pair of meshes, "
    assert all(issue.message.startswith(said) for issue in issues)
    before = stage.GetRootLayer().ExportToString()
    rules.repair_stage(stage)
    assert stage.GetRootLayer().ExportToString() == before


def test_rules_run_one_at_a_time(stage, monkeypatch):
    """Warp starts, and compiles, once for all; the engine runs rules in threads."""
    running, most, whole = [], [], rules.check_stage

    def counted(*arguments):
        running.append(1)
        most.append(len(running))
        time.sleep(0.05)
        issues = whole(*arguments)
        running.pop()
        return issues

    monkeypatch.setattr(rules, "check_stage", counted)
    with ThreadPoolExecutor(4) as pool:
        checkers = [rule() for rule in (rules.MeshOverlapChecker, rules.MeshCollisionChecker) for _ in range(2)]
        list(pool.map(lambda checker: checker.CheckStage(stage), checkers))
    assert most == [1, 1, 1, 1]
