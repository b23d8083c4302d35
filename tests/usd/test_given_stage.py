"""Stages that a program has opened: read as they are in memory, and not changed meanwhile."""

import functools
import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom
from replay_files import falling_through_quads, many_hits
from usd_stages import save

import warp_bsc as bsc
from warp_bsc.scene_replay.usd_overlay import Overlay
from warp_bsc.usd.write.points_layer import PointsLayer


def hits_of(scene, **options):
    """Returns the time and the elements of each collision."""
    found = []
    for result in bsc.replay(scene, device="cpu", **options):
        contacts = result.contacts
        found += zip(contacts.time.tolist(), contacts.indices.tolist(), contacts.mesh_names(slice(None)), strict=True)
    return found


def test_a_stage_in_memory_has_what_its_file_has(tmp_path):
    """Also one without a file, and a layer."""
    path = save(falling_through_quads(tmp_path))
    expected = hits_of(bsc.Scene(path))
    assert len(expected) == 1
    stage = Usd.Stage.Open(path)
    scene = bsc.Scene(stage)
    assert hits_of(scene) == expected and Path(scene.path).samefile(path) and scene.has_file
    anonymous = Sdf.Layer.CreateAnonymous()
    anonymous.TransferContent(stage.GetRootLayer())
    for source in (anonymous, Usd.Stage.Open(anonymous)):
        scene = bsc.Scene(source)
        assert hits_of(scene) == expected and scene.path == anonymous.identifier and not scene.has_file


def test_edits_that_are_not_saved_count(tmp_path):
    """In the session layer, and in a layer that has a file."""
    stage = Usd.Stage.Open(save(falling_through_quads(tmp_path)))
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        UsdGeom.Imageable(stage.GetPrimAtPath("/World/Falling")).MakeInvisible()
    assert hits_of(bsc.Scene(stage)) == []
    stage.GetSessionLayer().Clear()
    floor = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Floor"))
    floor.AddTranslateOp().Set((0.0, 0.0, -9.0))
    assert hits_of(bsc.Scene(stage)) == []


def test_what_a_mask_leaves_out_is_not_read(tmp_path):
    path = save(many_hits(tmp_path / "scene.usda", columns=4))
    mask = Usd.StagePopulationMask(["/World/Floor", "/World/Strip1"])
    scene = bsc.Scene(Usd.Stage.OpenMasked(path, mask))
    assert scene.names == ["/World/Floor", "/World/Strip1"]
    expected = [hit for hit in hits_of(bsc.Scene(path)) if "/World/Strip1" in hit[2]]
    assert hits_of(scene) == expected and len(expected) > 10


def test_a_stage_that_changes_meanwhile_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("warp_bsc.scene_replay.checking.FACES_AT_ONCE", 0)
    stage = Usd.Stage.Open(save(falling_through_quads(tmp_path)))
    scene = bsc.Scene(stage, subdivide=8)  # else all has been read before
    results = bsc.replay(scene, device="cpu")
    next(results)
    UsdGeom.Imageable(stage.GetPrimAtPath("/World/Falling")).MakeInvisible()
    with pytest.raises(ValueError, match=r"scene.usda: the stage has changed since the scene was made"):
        list(results)


def test_other_processes_read_a_file_of_it(tmp_path):
    """It is named, and gone with the scene."""
    stage = Usd.Stage.Open(save(falling_through_quads(tmp_path)))
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        UsdGeom.Xformable(stage.GetPrimAtPath("/World/Falling")).AddTranslateOp().Set((1.0, 0.0, 0.0))
    scene = bsc.Scene(stage)
    expected = hits_of(scene)
    with pytest.warns(UserWarning, match="flattened into .*stage.usdc, for other processes") as said:
        assert hits_of(scene, workers=2) == expected
    (message,) = (str(warning.message) for warning in said if "flattened" in str(warning.message))
    written = Path(message.split("flattened into ")[1].split(", for")[0])
    assert written.exists()
    del scene
    assert not written.parent.exists()


def test_a_layer_needs_a_file(tmp_path):
    stage, anonymous = falling_through_quads(tmp_path), Sdf.Layer.CreateAnonymous()
    anonymous.TransferContent(stage.GetRootLayer())
    scene = bsc.Scene(anonymous)
    for make in (functools.partial(Overlay, command=""), PointsLayer):
        with pytest.raises(ValueError, match="a USD stage in memory has no file for a layer to be over: export it"):
            make(tmp_path / "layer.usda", scene=scene)
    assert not (tmp_path / "layer.usda").exists()


@pytest.mark.parametrize("source", [None, 3, np.zeros(3), ["scene.usda"]])
def test_what_is_no_stage_is_refused(source):
    with pytest.raises(TypeError, match=r"source must be the path of a file, a Usd\.Stage or an Sdf\.Layer, not "):
        bsc.Scene(source)


def test_a_file_writes_nothing_for_other_processes(tmp_path):
    scene = bsc.Scene(save(falling_through_quads(tmp_path)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(hits_of(pickle.loads(pickle.dumps(scene)))) == 1  # as a process gets it
