"""The plugin of usdview, run by stand-ins for usdview: it checks intervals, and goes from hit to hit."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from usd_stages import (
    CORNERS,
    FALLING,
    add_floor,
    add_instancer,
    add_mesh,
    add_tets,
    floor_stage,
    moved,
    new_stage,
    save,
)
from usdview import Menu, Registry, UsdviewApi, define_usdview

import warp_bsc as bsc

SUPPORT = Path(__file__).parents[1] / "support"
PLUGIN = Path(bsc.__file__).parent / "scene_replay" / "plugin"


@pytest.fixture
def stage(tmp_path):
    """A triangle falls through a floor from time 2 to 4, another one next to it later in that interval."""
    stage = floor_stage(tmp_path)
    for name, x, z in (("Falling", 0, 0.25), ("Later", 1, 0.4)):
        heights = {0: 2, 2: z, 4: z - 0.5, 6: z - 0.5}
        add_mesh(stage, f"/World/{name}", {time: moved(FALLING, (x, 0, height)) for time, height in heights.items()})
    return Usd.Stage.Open(save(stage))


@pytest.fixture
def menu():
    """The commands by their labels, with a usdview that shows a stage."""
    define_usdview()
    from warp_bsc.scene_replay.usdview_plugin import HitsContainer  # noqa: PLC0415 (needs the stand-ins)

    def start(api):
        container, registry, menus = HitsContainer(), Registry(api), {}
        container.registerPlugins(registry, api)
        container.configureView(registry, SimpleNamespace(findOrCreateMenu=lambda name: Menu(menus, name)))
        return menus["warp-bsc"]

    return start


def test_usdview_finds_it(stage):
    """By the folder that the package has, through OpenUSD's plugins, as usdview loads them."""
    program = f"""
import sys
sys.path.insert(0, {str(SUPPORT)!r})
from pxr import Usd
from usdview import UsdviewApi, load_plugins
api = UsdviewApi(Usd.Stage.Open({stage.GetRootLayer().realPath!r}), 2.5)
menus = load_plugins(api)
print(list(menus), list(menus["warp-bsc"]))
menus["warp-bsc"]["Check This Interval"]()
print(api.said[-1])
"""
    environment = os.environ | {"PXR_PLUGINPATH_NAME": str(PLUGIN)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    listed, said = (line for line in done.stdout.splitlines() if line.startswith(("[", "warp-bsc")))
    assert listed == "['warp-bsc'] ['Check This Interval', 'Next Hit', 'Select Both Prims', 'Frame Hit']"
    assert said.startswith("warp-bsc: from 2 to 4 2 collisions, the first at 3")


@pytest.mark.parametrize(
    ("time", "said"),
    [
        (0, "from 0 to 2 0 collisions; at 0 0 edges through faces"),
        (1.99, "from 0 to 2 0 collisions"),
        (2, "from 2 to 4 2 collisions, the first at 3; at 2 0 edges through faces, 0 parts inside"),
        (4, "from 4 to 6 0 collisions; at 4 4 edges through faces"),
        (100, "from 4 to 6 0 collisions"),
        (-3, "from 0 to 2 0 collisions"),
        (Usd.TimeCode.Default(), "from 0 to 2 0 collisions"),
    ],
)
def test_the_interval_of_the_current_frame_is_checked(stage, menu, time, said):
    api = UsdviewApi(stage, time)
    menu(api)["Check This Interval"]()
    assert api.said[-1].startswith(f"warp-bsc: {said}")
    assert api.frame == Usd.TimeCode(time)


def test_what_is_meant_is_not_counted(stage, menu):
    triage = Path(stage.GetRootLayer().realPath).with_suffix(".triage.json")
    meant = {"meshes": ["/World/Later", "/World/Floor"], "reason": "it sinks", "who": "ada", "date": "2026-11-29"}
    triage.write_text(json.dumps({"version": 1, "meant": [meant]}))
    api = UsdviewApi(stage, 2)
    menu(api)["Check This Interval"]()
    assert api.said[-1].startswith("warp-bsc: from 2 to 4 1 collisions")
    assert api.said[-1].endswith(f"; 1 more are meant by {triage}")


def test_tetrahedra_that_invert_are_counted(tmp_path, menu):
    stage = new_stage(tmp_path / "soft.usda")
    add_tets(stage, CORNERS, [(1, 0, 2, 3)])
    api = UsdviewApi(stage, 0)
    menu(api)["Check This Interval"]()
    assert api.said[-1].endswith("; 1 inverted tetrahedra")


def test_from_hit_to_hit(stage, menu):
    """Also where intervals without any come first; both prims are selected, and seen."""
    api = UsdviewApi(stage, 0.5)
    run = menu(api)
    expected = (("/World/Falling", 3.0, (0.5, -0.5, 0), 0), ("/World/Later", 3.6, (1.5, -0.5, 0), 1))
    for path, time, place, number in expected:
        run["Next Hit"]()
        assert api.frame.GetValue() == pytest.approx(time, abs=1e-5)
        assert api.said[-1].startswith(
            f"warp-bsc: {number + 1} of 2 from 2 to 4: {path}, vertex 0, with /World/Floor, "
        )
        assert sorted(map(str, api.dataModel.selection.paths)) == sorted([path, "/World/Floor"])
        camera = api.dataModel.viewSettings.freeCamera
        assert np.linalg.norm(np.subtract(camera.center, place)) < camera.size / 2
        assert api.drawn == number + 1
    run["Next Hit"]()
    assert api.said[-1] == "warp-bsc: no more collisions up to the last time, 6."
    assert api.frame.GetValue() == pytest.approx(3.6, abs=1e-5) and api.drawn == 2


def test_checking_begins_anew(stage, menu):
    api = UsdviewApi(stage, 3)
    run = menu(api)
    run["Next Hit"]()
    run["Next Hit"]()
    run["Check This Interval"]()
    run["Next Hit"]()
    assert api.said[-1].startswith("warp-bsc: 1 of 2")


def test_select_and_frame_the_hit_again(stage, menu):
    api = UsdviewApi(stage, 2)
    run = menu(api)
    for label in ("Select Both Prims", "Frame Hit"):
        run[label]()
        assert api.said[-1] == "warp-bsc: no collision is shown: choose Next Hit"
    run["Next Hit"]()
    paths, camera = list(api.dataModel.selection.paths), api.dataModel.viewSettings.freeCamera
    center, size = camera.center, camera.size
    api.dataModel.selection.clearPrims()
    camera.center = camera.size = None
    api.dataModel.viewSettings.cameraPrim = stage.GetPrimAtPath("/World")
    run["Select Both Prims"]()
    run["Frame Hit"]()
    assert api.dataModel.selection.paths == paths
    assert (camera.center, camera.size) == (center, size) and api.dataModel.viewSettings.cameraPrim is None


def test_a_stage_that_changes_is_read_again(stage, menu):
    """Edits that are not saved count."""
    api = UsdviewApi(stage, 2)
    run = menu(api)
    run["Next Hit"]()
    stage.SetEditTarget(stage.GetSessionLayer())
    UsdGeom.Imageable(stage.GetPrimAtPath("/World/Falling")).MakeInvisible()
    run["Frame Hit"]()
    assert api.said[-1] == "warp-bsc: no collision is shown: choose Next Hit"
    run["Next Hit"]()
    assert api.said[-1].startswith("warp-bsc: 1 of 1 from 2 to 4: /World/Later, ")


def test_another_stage_is_read(stage, menu, tmp_path):
    api = UsdviewApi(stage, 2)
    run = menu(api)
    run["Next Hit"]()
    other = new_stage(tmp_path / "other.usda")
    add_floor(other)
    add_mesh(other, "/World/Many/Leaf", FALLING)
    add_instancer(other, "/World/Many", {0: [(0, 0, 0.25)], 1: [(0, 0, -0.25)]}, ["/World/Many/Leaf"])
    api.dataModel.stage = other
    run["Next Hit"]()
    assert api.said[-1].startswith("warp-bsc: 1 of 1 from 0 to 1: /World/Many[0]/Leaf, vertex 0, with /World/Floor")
    assert sorted(map(str, api.dataModel.selection.paths)) == ["/World/Floor", "/World/Many/Leaf"]


def test_a_stage_that_cannot_be_checked(menu):
    api = UsdviewApi(Usd.Stage.CreateInMemory(), 0)
    menu(api)["Check This Interval"]()
    assert "no visible mesh in the scene" in api.said[-1]
