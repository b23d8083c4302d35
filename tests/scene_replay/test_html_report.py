"""The page of a replay: its data, and what a browser shows of them."""

import base64
import hashlib
import html
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from chromium import CHROMIUM, Browser
from replay_files import Page, add_up, falling_through_quads, many_hits, near_and_inside_stage, replay
from usd_stages import FALLING, add_floor, add_mesh, falling, moved, new_stage, with_names

import warp_bsc as bsc
from warp_bsc.scene_replay import html_report, view_blocks

ASSETS = Path(__file__).resolve().parents[2] / "assets"
HOSTILE = "<img src=x onerror=alert(1)>{{script}}"
KIND_TEXTS = ("vertex-face", "edge-edge", "edge through face", "edge touches face")


@pytest.fixture
def stage(tmp_path):
    return falling_through_quads(tmp_path)


@pytest.fixture
def near_and_inside(tmp_path):
    return near_and_inside_stage(tmp_path)


def hostile_stage(folder):
    stage = new_stage(folder / f"{HOSTILE}.usda")
    add_floor(stage).GetPrim().SetDisplayName(HOSTILE)
    falling_mesh = add_mesh(stage, "/World/Falling", falling(0.25, -0.25))
    falling_mesh.GetPrim().SetDisplayName("</script><script>alert(2)</script>")
    falling_mesh.GetPrim().SetCustomDataByKey("note", HOSTILE)
    stage.GetRootLayer().comment = f"<!-- {HOSTILE}"
    stage.GetRootLayer().documentation = f"]]>{HOSTILE}</title>"
    return stage


def test_page_is_self_contained_and_escapes(tmp_path):
    page_path = replay(hostile_stage(tmp_path))[3]
    text = page_path.read_text()
    page = Page(text)
    assert "img" not in page.tags
    assert not [name for name, _ in page.attributes if name.startswith("on")]
    assert not [value for name, value in page.attributes if name in ("src", "href", "action", "data")]
    assert text.count(html.escape(HOSTILE)) == 2  # the title of the document and that of the page
    assert "http" not in re.sub(r'"http://www\.w3\.org/2000/svg"|http-equiv', "", text)
    (script,) = page.scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page.policy and "default-src 'none'" in page.policy
    assert "unsafe" not in page.policy
    assert page.data["title"] == f"Collisions in {HOSTILE}.usda"
    facts = dict(page.data["facts"])
    assert facts["Mesh /World/Floor"] == HOSTILE
    assert facts["Comment"] == f"<!-- {HOSTILE}"


def test_page_has_every_interval_with_hits(stage, tmp_path):
    found = with_names(json.loads(replay(stage, "--validate", "all")[0].read_text()))
    page = Page((tmp_path / "page.html").read_text())
    data = page.data
    assert data["intervals"] == [[0, 1, 0, 0], [1, 2, 0, 0], [2, 3, 1, 0], [3, 4, 0, 0]]
    assert [at for at, *_ in data["rest"]] == [0, 1, 2, 3, 4]
    assert [crossings > 0 for _, crossings, *_ in data["rest"]] == [False, False, False, True, True]
    at_rest = [[0, data["rest"][time][1], 0] for time in (3, 4)]
    assert data["rows"] == [[0, 0, 0], [0, 0, 0], [1, 0, 0], *at_rest] and data["near"] == []
    assert sum(data["toi"]) == 1 and data["toi"][9] + data["toi"][10] == 1
    (pair,) = data["pairs"]
    assert (pair["meshes"], pair["hits"]) == (["/World/Falling", "/World/Floor"], 1)
    assert pair["spans"] == [[2, 3, 1]] and pair["rest"] == [[3, 4, data["rest"][3][1], "stays", ""]]
    assert data["up_axis"] == "Z" and data["validation"]["disagreements"] == []
    assert page.blocks == {"view-0", "faces-0", "hits-2", "view-2", "rest-3", "view-3", "rest-4"}
    center = np.array(data["center"])

    (contact,) = (contact for interval in found["intervals"] for contact in interval["contacts"])
    block = page.block("hits-2")
    assert [data["meshes"][int(block[side][0])]["name"] for side in ("first", "second")] == contact["meshes"]
    assert (block["kind"][0], block["elements"][0], block["first_0"][0], block["second_0"][0]) == (0, 1, 0, 1)
    assert block["toi"] == pytest.approx([0.5], abs=1e-5) and block["separate"][0] == 1
    np.testing.assert_allclose(block["position"] + center, contact["position"], atol=1e-6)

    faces, view = page.block("faces-0")["faces"].reshape(-1, 3), page.block("view-2")
    start, end = (points + center for points in add_up(view))
    assert len(faces) == 5 and faces.max() == len(start) - 1 and view["faces"] == 0
    assert view["step"] == 8 / 2**20  # the scene is 8 units wide
    np.testing.assert_allclose((end - start)[-3:], [(0, 0, -0.5)] * 3, atol=view["step"])
    np.testing.assert_allclose(start[-3:], moved(FALLING, (0, 0, 0.25)), atol=view["step"])
    assert [data["meshes"][mesh] for mesh in page.block("faces-0")["mesh_of_vertex"][[0, -1]]] == [
        {"name": "/World/Floor", "moves": False}, {"name": "/World/Falling", "moves": True}
    ]  # fmt: skip

    scene = bsc.Scene(str(tmp_path / "scene.usda"))
    *_, last = bsc.replay(scene, device="cpu")
    for index, at_rest in ((3, last.intersections[0]), (4, last.intersections[1])):
        block = page.block(f"rest-{index}")
        assert (block["kind"] == np.where(at_rest.crosses, 4, 5)).all()
        curves = np.stack(add_up(block, "curve_"), axis=1) + center
        np.testing.assert_allclose(curves, at_rest.cuts.points, atol=block["curve_step"])
        assert (block["curve_meshes"].reshape(-1, 2) == [0, 1]).all()


def test_page_without_collisions(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    add_mesh(stage, "/World/Falling", falling(1, 0.5))
    replay(stage)
    page = Page((tmp_path / "page.html").read_text())
    assert page.blocks == {"view-0", "faces-0"}  # the scene is there to be seen
    assert page.data["rows"] == [[0, 0, 0], [0, 0, 0]] and page.data["pairs"] == []


def test_page_has_what_is_near_and_inside(near_and_inside, tmp_path):
    found = json.loads(replay(near_and_inside, "--clearance", "0.3")[0].read_text())
    page = Page((tmp_path / "page.html").read_text())
    data = page.data
    assert data["near"] == [[0, 0], [1, 1], [2, 1]] and [at[3] for at in data["rest"]] == [1, 1, 1]
    assert data["rows"] == [[0, 1, 0], [0, 1, 1], [0, 1, 1]]
    block = page.block("near-2")
    assert (block["kind"][0], block["distance"][0]) == (7, 0.125) and page.block("rest-2")["kind"][0] == 6
    (row,) = found["intervals"][-1]["proximity_pairs_at_end"]
    np.testing.assert_allclose(block["position"] + data["center"], row["position"], atol=1e-6)
    inside, near = data["pairs"]
    assert (inside["rest"], near["near"]) == ([[0, 2, 1, "stays", "/World/Inside"]], [[1, 2, 0.125]])
    assert ["0.125", "smallest distance"] in data["tiles"]
    replay(near_and_inside, "--clearance", "0.1")
    assert ["> 0.1", "smallest distance"] in Page((tmp_path / "page.html").read_text()).data["tiles"]


def test_page_without_intersections(stage, tmp_path):
    replay(stage, "--no-intersections")
    page = Page((tmp_path / "page.html").read_text())
    assert page.data["rest"] == [] and page.blocks == {"view-0", "faces-0", "hits-2", "view-2"}
    assert "separate" not in page.block("hits-2")


@pytest.mark.parametrize("visible", ["inherited", "invisible"])
def test_page_where_little_is_there(tmp_path, visible):
    stage = new_stage(tmp_path / "scene.usda")
    mesh = add_mesh(stage, "/World/Falling", falling(1, 0.5))
    mesh.CreateVisibilityAttr().Set(visible, 0)
    mesh.GetVisibilityAttr().Set("inherited", 1)
    mesh.GetPointsAttr().Set(FALLING, 2)
    replay(stage)
    blocks = Page((tmp_path / "page.html").read_text()).blocks
    assert ("view-0" in blocks) == (visible == "inherited")


def test_page_says_what_it_leaves_out(tmp_path, monkeypatch):
    for name, value in {"_ALL_ROWS": 40, "_FEWEST_ROWS": 5}.items():
        monkeypatch.setattr(html_report, name, value)
    for name, value in {"_ALL_FACES": 90, "_FEWEST_FACES": 10, "_FEWEST_OUTLINE": 30, "_ALL_OUTLINES": 90}.items():
        monkeypatch.setattr(view_blocks, name, value)
    stage = many_hits(tmp_path / "scene.usda")
    found = json.loads(replay(stage)[0].read_text())
    page = Page((tmp_path / "page.html").read_text())
    listed = sum(hits for hits, *_ in page.data["rows"])
    assert [hits for hits, *_ in page.data["rows"][:3]] == [6, 6, 6] and found["hits"] > 300
    (note, rest) = page.data["notes"][-2:]
    assert (
        note.startswith(f"The table has {listed} of {found['hits']} collisions: ") and "intersections at rest" in rest
    )
    for index in range(3):
        block = page.block(f"hits-{index}")
        assert block["of"] == found["intervals"][index]["hits"]
        assert len(set(block["first"]) | set(block["second"])) == 4  # every pair of meshes is there
        view = page.block(f"view-{index}")
        faces = page.block(f"faces-{view['faces']}")["faces"].reshape(-1, 3)
        assert view["of"] == 200 and 0 < len(faces) <= 30 and view["lit"].max() < len(faces)

    monkeypatch.setattr(view_blocks, "_BYTES", 1000)
    replay(stage)
    page = Page((tmp_path / "page.html").read_text())
    assert "view-0" in page.blocks and "view-2" not in page.blocks and "hits-2" in page.blocks
    assert page.data["notes"][-1].endswith("intervals have no view in 3D, as the page is full.")


@pytest.fixture
def browser(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with Browser(tmp_path / "profile") as opened:
        yield opened


@pytest.mark.browser
def test_page_in_chromium(tmp_path, browser):
    scene = tmp_path / "cloth_twist.usd"
    shutil.copy(ASSETS / scene.name, scene)
    page = replay(scene)[3]
    browser.open(page)
    assert browser.value("document.querySelectorAll('.hover').length") == 14 + 14 + 20  # bars: hits, at rest, impacts
    assert browser.value("document.getElementById('viewer-message').hidden")  # it would say why there is no view in 3D
    assert browser.value("document.getElementById('viewer-heading').textContent") == "Time 250 to 251"
    assert browser.value("location.hash") == "#interval=4"
    assert browser.value("rows.count") > 30
    assert browser.value("rows.time.every((time, row) => !row || rows.time[row - 1] <= time)")

    def pixels():
        picture = tmp_path / "page.png"
        browser.value("document.getElementById('canvas').scrollIntoView({block: 'center'})")
        left, top, right, bottom = map(int, browser.box("#canvas"))
        browser.screenshot(picture, whole=False)
        return np.moveaxis(matplotlib.image.imread(picture)[top:bottom, left:right, :3], 2, 0)

    import matplotlib.image  # noqa: PLC0415

    red, green, blue = pixels()
    assert (blue > red + 0.15).mean() > 0.03  # the cloth
    assert ((red > 0.7) & (green < 0.75) & (blue < 0.4)).sum() > 30  # contacts
    assert ((blue > 0.7) & (green < 0.4) & (red > 0.4) & (red < 0.75)).sum() > 10  # cut curves
    for width in (1400, 390):
        browser.resize(width, 900)
        assert browser.value("document.documentElement.scrollWidth") <= width
        assert browser.box("#viewer-legend")[1] >= browser.box("#canvas")[3]  # the legend does not cover the view
    assert browser.console == []


@pytest.mark.browser
def test_near_and_inside_in_chromium(near_and_inside, tmp_path, browser):
    browser.open(replay(near_and_inside, "--clearance", "0.3")[3])
    assert browser.value("document.getElementById('viewer-title').textContent").endswith(
        "; 1 part inside at the start, 1 at the end; 1 pair within the clearance at the start, 1 at the end"
    )
    legend = browser.value("document.getElementById('viewer-legend').textContent")
    assert "part of a mesh inside another" in legend and "proximity" in legend
    kinds = "[...document.querySelectorAll('#rows tr[data-at] td.kind')].map((cell) => cell.textContent)"
    # in order of time, what is there from the start after what begins later
    assert browser.value(kinds) == ["proximity", "proximity", "inside", "inside", "inside"]
    browser.click("#rows tr[data-at]", 1)
    browser.wait("!document.getElementById('selected').hidden")
    assert browser.value("document.getElementById('selected').textContent").startswith("proximity at time 2: ")
    assert "0.125 apart" in browser.value("document.getElementById('rows').textContent")
    assert browser.console == []


@pytest.mark.browser
def test_intervals_are_gone_through_in_chromium(stage, tmp_path, browser):
    browser.open(replay(stage)[3])
    heading = "document.getElementById('viewer-heading').textContent"
    assert browser.value(heading) == "Time 2 to 3"
    for key, expected in (
        ("ArrowRight", "3 to 4"),
        ("ArrowRight", "3 to 4"),
        ("ArrowLeft", "2 to 3"),
        ("End", "3 to 4"),
        ("Home", "2 to 3"),
    ):
        browser.press(key)
        assert browser.value(heading) == f"Time {expected}"
    browser.click("#intervals .hover", 3)  # the fourth bar
    assert browser.value(heading) == "Time 3 to 4" and browser.value("location.hash") == "#interval=3"
    browser.click("#intervals .hover", 1)
    browser.wait("!document.getElementById('viewer-message').hidden")
    assert "Nothing collides or intersects here" in browser.value(
        "document.getElementById('viewer-message').textContent"
    )
    browser.click("#next")
    browser.wait("document.getElementById('viewer-message').hidden")
    assert browser.value(heading) == "Time 2 to 3"
    assert browser.value("document.getElementById('time-label').textContent").startswith("time 2.5")
    browser.click("#viewer-heading")  # off the button, which the space bar would press
    browser.press(" ")
    assert browser.value("document.getElementById('play').textContent") == "Pause"
    assert browser.console == []


@pytest.mark.browser
def test_table_is_sorted_and_filtered_in_chromium(tmp_path, browser):
    found = with_names(json.loads(replay(many_hits(tmp_path / "scene.usda"))[0].read_text()))
    page = tmp_path / "page.html"
    browser.open(page)
    total = sum(map(sum, Page(page.read_text()).data["rows"]))
    count = "document.getElementById('rows-count').textContent"
    assert browser.value(count) == f"{total:,} of {total:,} rows"
    assert (
        browser.value("document.querySelectorAll('#rows tbody tr').length") < 90
    )  # only those around what is in sight
    column = "[...document.querySelectorAll('#rows tr[data-at] td:nth-child({})')].map((cell) => cell.textContent)"

    assert browser.value("document.querySelector('#rows th').getAttribute('aria-sort')") == "ascending"
    assert browser.value("rows.time.every((time, row) => !row || rows.time[row - 1] <= time)")
    assert browser.value("table.rows.every((row, place) => row === place)")
    browser.click("#rows th button", 0)  # the latest first
    assert browser.value("document.querySelector('#rows th').getAttribute('aria-sort')") == "descending"
    times = [float(text) for text in browser.value(column.format(1))]
    assert times == sorted(times, reverse=True) and times[0] == 3

    browser.press("/")
    browser.type("strip1 face")
    browser.wait(f"{count} !== '{total:,} of {total:,} rows'")
    pairs = list(zip(browser.value(column.format(3)), browser.value(column.format(4)), strict=True))
    assert pairs and all("/World/Strip1" in first + second and "face" in first + second for first, second in pairs)
    of_strip = [
        contact for interval in found["intervals"] for contact in interval["contacts"]
        if "/World/Strip1" in contact["meshes"] and contact["kind"] == "vertex-face"
    ]  # fmt: skip
    browser.value("(byId('kind').value = '0', byId('kind').dispatchEvent(new Event('change')))")
    assert browser.value(count) == f"{len(of_strip):,} of {total:,} rows"

    browser.open(page, "#prim=/World/Strip2")  # an address that leads to a prim
    both = [
        contact
        for interval in found["intervals"]
        for contact in interval["contacts"]
        if "/World/Strip2" in contact["meshes"]
    ]
    names = "[rows.first[row], rows.second[row]].map((mesh) => data.meshes[mesh].name)"
    rows = browser.value(f"table.rows.map((row) => {names})")
    assert len(rows) > len(both) > 0 and all("/World/Strip2" in names for names in rows)
    prim = browser.value("document.querySelectorAll('#rows tr[data-at] a.prim')[1].textContent")
    browser.click("#rows tr[data-at] a.prim", 1)
    browser.wait(f"document.querySelector('.chip').textContent.startsWith('{prim} ')")
    assert browser.value("new URLSearchParams(location.hash.slice(1)).get('prim')") == prim
    browser.click(".chip")
    browser.wait(f"{count} === '{total:,} of {total:,} rows'")

    browser.click("#rows tr[data-at]", 3)
    chosen = browser.value("document.querySelector('#rows tr.chosen').dataset.at")
    browser.wait("!document.getElementById('frame-contacts').hidden")  # the interval of the row is in the view
    assert chosen == "3" and not browser.value("document.getElementById('selected').hidden")
    browser.value("document.getElementById('rows').focus()")
    browser.press("ArrowDown")
    assert browser.value("document.querySelector('#rows tr.chosen').dataset.at") == "4"
    assert browser.value("document.getElementById('selected').textContent").startswith(tuple(KIND_TEXTS))
    assert browser.console == []


@pytest.mark.browser
def test_hostile_names_do_nothing_in_chromium(tmp_path, browser):
    browser.open(replay(hostile_stage(tmp_path))[3])
    assert browser.console == []  # neither an error nor a refusal by the policy: there was nothing to refuse
    dom = browser.value("document.documentElement.outerHTML")
    assert "<img" not in dom
    assert "&lt;img src=x onerror=alert(1)&gt;{{script}}" in dom
