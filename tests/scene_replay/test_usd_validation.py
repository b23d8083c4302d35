"""The rule of OpenUSD's validation framework, as other programs find and run it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from pxr import Gf, Sdf, Usd, UsdGeom
from usd_stages import CORNERS, FALLING, add_mesh, add_tets, falling_stage, moved, new_stage, save

UsdValidation = pytest.importorskip("pxr.UsdValidation")
if not hasattr(UsdValidation.ValidationRegistry, "RegisterPluginStageValidator"):
    pytest.skip("this version of OpenUSD registers no rules from Python", allow_module_level=True)

from warp_bsc.scene_replay import usd_validation as rules  # noqa: E402


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor in the first second; another one crosses it all the time."""
    stage = falling_stage(tmp_path)
    add_mesh(stage, "/World/Crossing", moved(FALLING, (0.5, 1.0, -0.25)))
    return Usd.Stage.Open(save(stage))


def found(stage, *time_range):
    validator = UsdValidation.ValidationRegistry().GetOrLoadValidatorByName(rules.NAME)
    return [
        (error.GetName(), error.GetMessage(), [str(site.GetPrim().GetPath()) for site in error.GetSites()])
        for error in validator.Validate(stage, *time_range)
    ]


def test_errors(stage):
    collision, *intersections = found(stage)
    assert collision[0] == "Collision" and sorted(collision[2]) == ["/World/Falling", "/World/Floor"]
    assert "/World/Falling" in collision[1] and "collide from time 0 to 1: " in collision[1]
    assert [(name, sorted(prims)) for name, _, prims in intersections] == [
        ("Intersection", ["/World/Crossing", "/World/Floor"]),
        ("Intersection", ["/World/Falling", "/World/Floor"]),
    ]
    assert "cross from time 0 to 1: at most " in intersections[0][1]
    assert "cross from time 1 to 1: at most " in intersections[1][1]


def test_duplicates_are_a_warning(stage):
    add_mesh(stage, "/World/Again", moved(FALLING, (0.5, 1.0, -0.25)))
    save(stage)
    name, text, prims = found(stage)[-1]
    assert (name, sorted(prims)) == ("Duplicates", ["/World/Again", "/World/Crossing"])
    assert text.startswith("2 meshes are duplicates of each other, from 0 to 1: ")


def test_tetrahedra_that_invert_are_an_error(tmp_path):
    stage = new_stage(tmp_path / "soft.usda")
    add_tets(stage, CORNERS, [(1, 0, 2, 3)])
    assert found(stage) == [
        (
            "Inversion",
            "1 tetrahedron is inverted in /World/Soft, at 0; the first is tetrahedron 0, at 0",
            ["/World/Soft"],
        )
    ]


def test_times(stage):
    until = UsdValidation.ValidationTimeRange(Gf.Interval(0.0, 0.25))
    assert [name for name, _, _ in found(stage, until)] == ["Intersection"]
    default = UsdValidation.ValidationTimeRange(Usd.TimeCode.Default())
    assert found(stage, default) == []


def test_stages_in_memory_and_edits_that_are_not_saved(stage):
    flat = Usd.Stage.CreateInMemory()
    flat.GetRootLayer().TransferContent(stage.GetRootLayer())
    assert [name for name, _, _ in found(flat)] == ["Collision", "Intersection", "Intersection"]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        stage.GetPrimAtPath("/World/Crossing").SetActive(False)
    assert [name for name, _, _ in found(stage)] == ["Collision", "Intersection"]


def test_a_stage_that_is_not_checked():
    (error,) = found(Usd.Stage.CreateInMemory())
    assert error[0] == "Unreadable" and error[1].endswith("no visible mesh in the scene")


def test_a_program_that_knows_only_the_plugin(stage):
    program = f"""
from pxr import Usd, UsdValidation
validator = UsdValidation.ValidationRegistry().GetOrLoadValidatorByName({rules.NAME!r})
print(*(error.GetName() for error in validator.Validate(Usd.Stage.Open({stage.GetRootLayer().realPath!r}))))
"""
    environment = os.environ | {"PXR_PLUGINPATH_NAME": rules.PLUGIN_FOLDER}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-3:] == ["Collision", "Intersection", "Intersection"]


def test_a_mesh_inside_another_is_a_warning(tmp_path):
    stage = new_stage(tmp_path / "boxes.usda")
    for name, size in (("Case", 2.0), ("Inside", 1.0)):
        UsdGeom.Cube.Define(stage, f"/World/{name}").CreateSizeAttr(size)
    stage = Usd.Stage.Open(save(stage))
    validator = UsdValidation.ValidationRegistry().GetOrLoadValidatorByName(rules.NAME)
    (error,) = validator.Validate(stage)
    assert (error.GetName(), error.GetType()) == ("Inside", UsdValidation.ValidationErrorType.Warn)
    assert error.GetMessage() == "/World/Inside is inside /World/Case from time 0 to 0"


def test_an_import_after_the_registry_has_read_its_plugins():
    program = """
from pxr import UsdValidation
UsdValidation.ValidationRegistry()
import warp_bsc.scene_replay.usd_validation
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (
        done.returncode == 1
        and "ImportError" in done.stderr
        and f"PXR_PLUGINPATH_NAME={rules.PLUGIN_FOLDER}" in done.stderr
    )
    environment = os.environ | {"PXR_PLUGINPATH_NAME": rules.PLUGIN_FOLDER}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)


@pytest.mark.parametrize("how", ["beside", "named", "asset"])
def test_what_is_meant_is_no_error(stage, tmp_path, how):
    """By the file beside the root layer, or the one that the root layer names."""
    beside = tmp_path / f"{Path(stage.GetRootLayer().realPath).stem}.triage.json"
    triage = beside if how == "beside" else tmp_path / "of_the_show.json"
    entry = {"meshes": ["/World/Crossing", "/World/Floor"], "reason": "grows in it", "who": "ada", "date": "2026-11-29"}
    triage.write_text(json.dumps({"version": 1, "meant": [entry, entry | {"meshes": ["/World/Gone"]}]}))
    if how != "beside":
        beside.write_text("not read")
        named = f"./{triage.name}" if how == "named" else Sdf.AssetPath(f"./{triage.name}")
        stage.GetRootLayer().customLayerData = {"warp_bsc:triage": named}
    *errors, meant = found(stage)
    assert [name for name, _, _ in errors] == ["Collision", "Intersection"]
    assert not any("/World/Crossing" in prims for _, _, prims in errors)
    assert meant[0] == "Meant" and meant[1].startswith(f"{triage} was read. Not counted: 1 meant pair of meshes, 0 ")
    assert meant[1].endswith("entries that match no meshes: 1, the first is /World/Gone")
    triage.write_text("{}")
    ((name, text, _),) = found(stage)
    assert name == "Unreadable" and text == f"{triage}: not a triage file: the file: version is missing"
    if how != "beside":
        triage.unlink()
        ((name, text, _),) = found(stage)
        assert name == "Unreadable" and text == f"{triage}: No such file or directory"
        stage.GetRootLayer().customLayerData = {"warp_bsc:triage": 3}
        ((name, text, _),) = found(stage)
        assert name == "Unreadable" and text.endswith("warp_bsc:triage must be the path of a triage file, not 3")
