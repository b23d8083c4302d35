"""The overlay's prims for pairs of meshes, the rest of the pairs, its variants, and what it says of its origin."""

import json
import shlex

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdUtils
from replay_files import (
    errors_of,
    falling_through_quads,
    many_hits,
    near_and_inside_stage,
    prims_of_pairs,
    read_contacts,
    read_polygons,
    replay,
)
from usd_stages import FALLING, add_mesh, falling, floor_stage, moved, save, with_names

import warp_bsc as bsc
from warp_bsc._version import __version__
from warp_bsc.cli.main import main
from warp_bsc.scene_replay import usd_overlay
from warp_bsc.scene_replay.usd_overlay import MOST_PAIRS, VARIANTS


def pairs_of(overlay):
    """The meshes of each pair, by the name of its prim."""
    children = overlay.GetPrimAtPath("/Collisions").GetChildren()
    return {
        child.GetName(): list(child.GetAttribute("meshes").Get() or ())
        for child in children
        if child.GetName() != "Materials"
    }


def shown(overlay):
    """The visible prims that are below a pair."""
    prims = [prim for kind in usd_overlay.COLORS for prim in prims_of_pairs(overlay, kind)]
    visible = [prim for prim in prims if UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible]
    return {(prim.GetParent().GetName(), prim.GetName()) for prim in visible}


def test_each_pair_has_a_prim_that_can_be_hidden(tmp_path):
    found = with_names(json.loads(replay(many_hits(tmp_path / "scene.usda", columns=5))[0].read_text()))
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    assert errors_of(overlay) == []
    pairs = pairs_of(overlay)
    assert pairs == {f"Floor_with_Strip{n}": ["/World/Floor", f"/World/Strip{n}"] for n in range(3)}
    for name, meshes in pairs.items():
        assert overlay.GetPrimAtPath(f"/Collisions/{name}").GetDisplayName() == " with ".join(meshes)
        for interval in found["intervals"]:
            rows = [row for row in interval["contacts"] if set(row["meshes"]) == set(meshes)]
            places = [tuple(np.float32(row["position"])) for row in rows]
            prims = map(overlay.GetPrimAtPath(f"/Collisions/{name}").GetChild, ("VertexFace", "EdgeEdge"))
            own = [
                tuple(place)
                for instancer in map(UsdGeom.PointInstancer, filter(None, prims))
                for place in instancer.GetPositionsAttr().Get(interval["start"])
            ]
            assert len(own) > 0 and sorted(own) == sorted(places)
    UsdGeom.Imageable(overlay.GetPrimAtPath("/Collisions/Floor_with_Strip1")).MakeInvisible()
    assert {pair for pair, _ in shown(overlay)} == {"Floor_with_Strip0", "Floor_with_Strip2"}


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_the_rest_of_the_pairs(tmp_path, suffix):
    """More pairs than have prims of their own: the two of the first interval with the most collisions do."""
    scene, path = save(many_hits(tmp_path / "scene.usda", columns=3)), tmp_path / f"overlay.{suffix}"
    contents = []
    for most in (MOST_PAIRS, 1):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(usd_overlay, "MOST_PAIRS", most)
            assert main(["replay", scene, "--device", "cpu", "--overlay", str(path)]) == 0
        overlay = Usd.Stage.Open(str(path))
        overlay.Reload()
        assert errors_of(overlay) == []
        contents.append(
            [
                (
                    sorted(map(tuple, read_contacts(overlay, time)[0].tolist())),
                    np.unique(read_polygons(overlay, time), axis=0).tolist(),  # pairs may share polygons
                )
                for time in (0, 0.5, 1, 2.5, 3)
            ]
        )
        assert len(pairs_of(overlay)) == min(most + 1, 3)
    assert contents[0] == contents[1] and contents[0][0][1]
    (first, *_) = bsc.replay(bsc.Scene(scene), device="cpu")
    most = max(first.summary.mesh_pairs, key=first.summary.mesh_pairs.get)
    (name,) = pairs_of(overlay).keys() - {"Rest"}
    assert pairs_of(overlay) == {name: list(most), "Rest": []}
    prims = overlay.GetPrimAtPath("/Collisions").GetAttribute("prims").Get()
    rest = UsdGeom.PrimvarsAPI(overlay.GetPrimAtPath("/Collisions/Rest/VertexFace"))
    both = {prims[number] for name in ("primA", "primB") for number in rest.GetPrimvar(name).Get(0)}
    others = {mesh for meshes in first.summary.mesh_pairs.keys() - {most} for mesh in meshes}
    assert both == others and len(others) == 3


def test_names_of_pairs_are_valid_and_unique(tmp_path):
    stage = floor_stage(tmp_path)
    names = ["/A/Falling", "/B/Falling", "/C/Falling_2", "/D/_9"]
    for number, path in enumerate(names):
        add_mesh(stage, path, {t: moved(points, (0.1 * number, 0, 0)) for t, points in falling(0.25, -0.25).items()})
    replay(stage)
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    of_floor = {meshes[1]: name for name, meshes in pairs_of(overlay).items() if meshes[0] == "/World/Floor"}
    assert of_floor.keys() == set(names) and len(set(of_floor.values())) == 4
    assert of_floor["/A/Falling"] == "Floor_with_Falling" and of_floor["/B/Falling"] == "Floor_with_Falling_2"
    assert errors_of(overlay) == []


def test_a_pair_that_meets_late_is_empty_before(tmp_path):
    replay(falling_through_quads(tmp_path))
    overlay = Usd.Stage.Open(str(tmp_path / "overlay.usda"))
    points = overlay.GetPrimAtPath("/Collisions/Floor_with_Falling/VertexFace").GetAttribute("positions")
    assert [len(points.Get(time)) for time in (-5, 0, 1.5, 2, 2.5, 3)] == [0, 0, 0, 1, 1, 0]


def near_inside_and_colliding(folder):
    """Findings of each kind: a triangle falls through a floor, after it was near; a cube is in another one."""
    stage = near_and_inside_stage(folder)
    heights = {0: 0.5, 1: 0.25, 2: -0.25}
    add_mesh(stage, "/World/Colliding", {time: moved(FALLING, (0.5, 1.0, z)) for time, z in heights.items()})
    return stage


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_variants(tmp_path, suffix):
    path = tmp_path / f"overlay.{suffix}"
    arguments = ["replay", save(near_inside_and_colliding(tmp_path)), "--device", "cpu", "--overlay", str(path)]
    assert main([*arguments, "--clearance", "0.3"]) == 0
    overlay = Usd.Stage.Open(str(path))
    variants = overlay.GetPrimAtPath("/Collisions").GetVariantSets().GetVariantSet("warp_bsc")
    pairs = pairs_of(overlay)
    assert variants.GetVariantSelection() == "all"
    assert sorted(variants.GetVariantNames()) == sorted([*VARIANTS, *pairs])
    whole = shown(overlay)
    assert {name for _, name in whole} >= {"Polygons", "VertexFace", "Intersections", "Inside", "Near"}
    for variant in variants.GetVariantNames():
        assert variants.SetVariantSelection(variant)
        expected = {(pair, name) for pair, name in whole if pair == variant or name in VARIANTS.get(variant, ())}
        assert shown(overlay) == expected and expected
        assert errors_of(overlay) == []


def test_where_an_overlay_comes_from(tmp_path):
    """Its command finds the same: it has what results depend on, and nothing of files and processes."""
    stage, overlay = near_and_inside_stage(tmp_path), tmp_path / "overlay.usda"
    options = ["--clearance", "0.3", "--exclude", "/World/Case*", "--frames", "0:1", "--limit", "7"]
    replay(stage, *options, "--workers", "1", "--progress", "json")
    layer = Usd.Stage.Open(str(overlay))
    asset = layer.GetPrimAtPath("/Collisions").GetAssetInfo()
    assert asset == {"name": "Collisions in scene.usda", "version": f"warp-bsc {__version__}"}
    data = layer.GetRootLayer().customLayerData["collisions"]
    words = shlex.split(data["command"])
    assert words[:3] == ["warp-bsc", "replay", stage.GetRootLayer().realPath]
    assert "--workers" not in words and str(tmp_path / "hits.json") not in words
    assert (data["limit"], data["collisionsNotListed"]) == (7, 0)
    before = overlay.read_bytes()
    overlay.unlink()
    assert main([*words[1:], "--overlay", str(overlay)]) == 0
    assert overlay.read_bytes() == before
    layers, assets, unresolved = UsdUtils.ComputeAllDependencies(str(overlay))
    assert ({layer.GetDisplayName() for layer in layers}, assets, unresolved) == (
        {"overlay.usda", "scene.usda"}, [], []
    )  # fmt: skip
