"""The tools of the page of a replay, in a browser: cameras, meshes of the view, exports, prints, and a clean scene."""

import csv
import io
import json

import matplotlib.image
import numpy as np
import pytest
from pxr import Gf, UsdGeom
from replay_files import Page, falling_through_quads, many_hits, near_and_inside_stage, replay
from usd_stages import FALLING, add_mesh, falling, floor_stage, moved, new_stage

pytestmark = pytest.mark.browser


def picture(browser, folder):
    """The colours of the view, shape [height, width, 3]."""
    browser.value("document.getElementById('canvas').scrollIntoView({block: 'center'})")
    browser.value("(async () => { for (let i = 0; i < 4; i += 1) await new Promise(requestAnimationFrame); })()")
    left, top, right, bottom = map(round, browser.box("#canvas"))
    browser.screenshot(folder / "view.png", whole=False)
    return matplotlib.image.imread(folder / "view.png")[top:bottom, left:right, :3]


def choose_camera(browser, number):
    change = "byId('camera').dispatchEvent(new Event('change'))"
    browser.value(f"(byId('camera').value = '{number}', {change}, new Promise((done) => setTimeout(done, 200)))")


@pytest.mark.parametrize("up_axis", [pytest.param("Y", marks=pytest.mark.slow), "Z"])
def test_view_is_that_of_the_chosen_camera(tmp_path, browser, up_axis):
    """A small triangle is where OpenUSD's frustum has it, at the start, in the middle and at the end of an interval."""
    stage = new_stage(tmp_path / "scene.usda", up_axis=up_axis)
    small = np.array([(0, 0, 0), (0.04, 0, 0), (0.02, 0.03, 0.02)])
    corner = (0.55, 0.3, -0.2)
    add_mesh(stage, "/World/Small", {time: moved(small, (0.55 + 0.1 * time, 0.3, -0.2)) for time in (0, 1)})
    cameras = []
    for number, (width, height) in enumerate(((36.0, 18.0), (10.0, 20.0))):
        camera = UsdGeom.Camera.Define(stage, f"/World/Camera{number}")
        camera.CreateHorizontalApertureAttr(width)
        camera.CreateVerticalApertureAttr(height)
        camera.CreateFocalLengthAttr(20.0)
        place = UsdGeom.Xformable(camera).AddTransformOp()
        for time in (0, 1):
            eye = Gf.Vec3d(1.2 + number, 0.8 + 0.4 * time, 2.5)
            place.Set(
                Gf.Matrix4d().SetLookAt(eye, Gf.Vec3d(0.5, 0.2 - 0.2 * time, 0), Gf.Vec3d(0, 1, 0)).GetInverse(), time
            )
        cameras.append(camera)
    browser.open(replay(stage)[3])
    assert browser.value("[...byId('camera').options].map((option) => option.textContent)") == [
        "Free view", "/World/Camera0", "/World/Camera1"
    ]  # fmt: skip
    for number, camera in enumerate(cameras):
        choose_camera(browser, number)
        assert browser.value("new URLSearchParams(location.hash.slice(1)).get('camera')") == f"/World/Camera{number}"
        for time in (0, 1):
            browser.value(f"(byId('time').value = {1000 * time}, byId('time').dispatchEvent(new Event('input')))")
            colors = picture(browser, tmp_path)
            height, width, _ = colors.shape
            frustum = camera.GetCamera(time).frustum
            middle = Gf.Vec3d(*(small.mean(axis=0) + corner + np.array([0.1 * time, 0, 0])))
            x, y, _ = (frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()).Transform(middle)
            shape = camera.GetHorizontalApertureAttr().Get() / camera.GetVerticalApertureAttr().Get()
            part = np.array([min(width, height * shape), min(height, width / shape)])
            expected = np.array([width, height]) / 2 + np.array([x, -y]) * part / 2
            red, _, blue = colors.transpose(2, 0, 1)
            rows, columns = np.nonzero((blue - red > 0.08) & (blue > 0.3))  # the mesh alone is blue
            assert len(rows) > 10
            np.testing.assert_allclose((columns.mean(), rows.mean()), expected, atol=3)
    browser.value("viewer.turn(1, 0)")
    assert browser.value("byId('camera').value") == "" and "camera" not in browser.value("location.hash")
    assert browser.console == []


def test_meshes_are_isolated_hidden_and_ghosts(tmp_path, browser):
    page = replay(many_hits(tmp_path / "scene.usda"))[3]
    browser.open(page)
    names = browser.value("data.meshes.map(({name}) => name)")
    shown = "[...byId('meshes').querySelectorAll('tr[data-at] .mesh-name:not(.off)')].map((cell) => cell.textContent)"
    assert browser.value("byId('meshes-count').textContent") == "4 meshes" and browser.value("byId('show-all').hidden")
    browser.click("#mesh-list summary")
    browser.wait("document.querySelectorAll('#meshes tr[data-at]').length === 4")

    before = picture(browser, tmp_path)
    browser.click("#meshes .states button", 4 * 1 + 0)  # the second by name: isolate Strip0
    assert browser.value(shown) == ["/World/Strip0"]
    assert browser.value("byId('meshes-count').textContent") == "4 meshes, 3 hidden"
    assert browser.value("location.hash").endswith("only=%2FWorld%2FStrip0")
    alone = picture(browser, tmp_path)
    assert (np.abs(alone - before).max(axis=2) > 0.1).mean() > 0.001
    orange = [((c > (0.85, 0.45, 0)) & (c < (1.1, 0.75, 0.4))).all(axis=2).sum() for c in (before, alone)]
    assert orange[0] > 20 and orange[1] == 0  # no contacts with hidden meshes
    visible = "loadView(state.interval).then((shown) => [shown.hits.first.length, visibleRows(shown.hits).length])"
    number, seen = browser.value(visible)
    assert number > 100 and seen == 0
    browser.click("#meshes .states button", 4 * 1 + 0)
    assert browser.value(shown) == sorted(names) and browser.value("byId('show-all').hidden")
    np.testing.assert_array_equal(picture(browser, tmp_path), before)

    browser.click("#meshes .states button", 4 * 0 + 1)  # the floor as a ghost
    ghost = picture(browser, tmp_path)
    assert browser.value("byId('meshes-count').textContent") == "4 meshes, 1 ghost"
    browser.click("#meshes .states button", 4 * 0 + 2)
    hidden = picture(browser, tmp_path)
    assert (np.abs(ghost - hidden).max(axis=2) > 0.02).sum() > 500 < (np.abs(ghost - before).max(axis=2) > 0.02).sum()
    address = browser.value("location.hash")
    browser.open(page, address)
    browser.click("#mesh-list summary")
    browser.wait(f"({shown}).length === 3")
    browser.click("#show-all")
    assert browser.value(shown) == sorted(names)

    first = browser.value("document.querySelector('#pairs tr[data-at] td').textContent")
    browser.click("#pairs tr[data-at] .states button", 0)  # isolates the deepest pair
    assert len(browser.value(shown)) == 2 and all(name in first for name in browser.value(shown))
    assert browser.value("location.hash").count("hide=") == 2
    browser.value("setMeshes([0], HIDDEN), showInterval(1)")  # the choice holds in the next interval
    browser.wait("byId('viewer-heading').textContent === 'Time 1 to 2'")
    assert len(browser.value(shown)) in (1, 2)
    assert browser.console == []


def test_filtered_rows_are_saved_and_paths_copied(tmp_path, browser):
    files = replay(many_hits(tmp_path / "scene.usda"))
    browser.open(files[3], "#prim=/World/Strip1")
    browser.value("(byId('kind').value = '0', byId('kind').dispatchEvent(new Event('change')))")
    browser.value("URL.createObjectURL = (blob) => { window.saved = blob; return 'about:blank'; }")
    browser.value("HTMLAnchorElement.prototype.click = function () { window.savedAs = this.download; }")
    browser.value("byId('save-csv').dispatchEvent(new Event('click'))")
    saved = list(csv.DictReader(io.StringIO(browser.value("window.saved.text()"))))
    assert browser.value("window.savedAs") == "findings.csv"
    lines = [line for line in csv.DictReader(files[1].read_text().splitlines())]
    expected = [
        line for line in lines
        if "/World/Strip1" in (line["first_mesh"], line["second_mesh"]) and line["kind"] == "vertex-face"
        and line["phase"] != "inside"
    ]  # fmt: skip
    assert len(saved) == len(expected) > 10 and set(saved[0]) <= set(lines[0])
    exact = [name for name in saved[0] if name not in ("time", "toi", "x", "y", "z", "separate", "start", "end")]

    def key(line):
        return [line[name] for name in ("interval", "first_element", "second_element")]

    for line, row in zip(sorted(expected, key=key), sorted(saved, key=key), strict=True):
        assert [row[name] for name in exact] == [line[name] for name in exact]
        assert row["separate"].lower() == line["separate"].lower()
        for name in ("time", "toi", "x", "y", "z", "start", "end"):
            assert float(row[name]) == pytest.approx(float(line[name]), abs=2e-6)
    times = [float(row["time"]) for row in saved]
    assert times == sorted(times)

    browser.value(
        "Object.defineProperty(navigator, 'clipboard', {value: {writeText: async (text) => { window.copied = text; }}})"
    )
    browser.click("#copy-paths")
    browser.wait("byId('copy-paths').textContent === 'Copied'")
    assert browser.value("window.copied").split("\n") == ["/World/Floor", "/World/Strip1"]
    browser.value("(byId('filter').value = 'nothing', byId('filter').dispatchEvent(new Event('input')))")
    browser.wait("byId('save-csv').disabled && byId('copy-paths').disabled")
    assert browser.console == []


def test_pairs_are_in_order_of_depth(tmp_path, browser):
    page = replay(near_and_inside_stage(tmp_path), "--clearance", "0.3")[3]
    depths = [pair["depth"] for pair in Page(page.read_text()).data["pairs"]]
    # A cube of 0.25 in the middle of one of 1; the triangle that is near the floor is not behind it.
    assert depths == [[pytest.approx(0.375), 0], None]
    browser.open(page)
    cells = "[...document.querySelectorAll('#pairs tr[data-at] td:nth-child(2)')].map((cell) => cell.textContent)"
    assert browser.value(cells) == ["37.5 cmat 0", ""]
    browser.click("#pairs th button", 1)
    assert browser.value(cells) == ["", "37.5 cmat 0"]


def test_depth_is_of_the_deepest_time(tmp_path):
    stage = floor_stage(tmp_path)
    heights = enumerate([0.1, -0.1, -0.05, -0.2])
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, height)) for time, height in heights})
    (pair,) = Page(replay(stage)[3].read_text()).data["pairs"]
    assert pair["depth"] == [pytest.approx(0.2, abs=1e-6), 3]  # at the end of the last interval


def test_clean_scene_is_one_sentence(tmp_path, browser):
    stage = new_stage(tmp_path / "scene.usda")
    add_mesh(stage, "/World/Falling", falling(1, 0.5))
    page = replay(stage)[3]
    sentence = (
        "Nothing collides, nothing intersects: 1 interval and 2 times of 1 mesh and 1 triangle were checked, "
        "time 0 to 1, certified for vertices that move straight or turn about one axis between the times checked."
    )
    assert Page(page.read_text()).data["nothing"] == sentence
    browser.open(page)
    assert browser.value("byId('nothing').textContent") == sentence and not browser.value("byId('nothing').hidden")
    hidden = "['tiles', 'timeline', 'findings', 'pairs-panel', 'impacts-panel'].map((id) => byId(id).offsetHeight)"
    assert browser.value(hidden) == [0] * 5
    assert browser.box("#canvas")[3] > 0 and browser.value("document.querySelectorAll('.chart svg').length") == 0
    assert browser.console == []


def sentence_of(stage, *options, status=0):
    return Page(replay(stage, *options, status=status)[3].read_text()).data["nothing"]


def test_sentence_says_what_was_not_checked(tmp_path):
    stage = floor_stage(tmp_path)
    add_mesh(stage, "/World/Falling", falling(0.25, -0.25))
    assert sentence_of(stage) == ""
    said = sentence_of(stage, "--ignore", "/World/Floor", "/World/Falling")
    assert said.startswith("Nothing collides, nothing intersects: 1 interval and 2 times of 2 meshes and 3 triangles ")
    assert said.endswith(
        " Not counted: 1 ignored pair of meshes, 1 collision. Only some pairs of meshes were checked, as options say."
    )
    said = sentence_of(stage, "--prims", "/World/Falling", "--no-intersections", "--method", "float")
    assert said == (
        "Nothing collides: 1 interval of 1 mesh and 1 triangle were checked, time 0 to 1, not certified: "
        "collisions may be missing. Intersections at rest were not checked."
    )
    said = sentence_of(stage, "--prims", "/World/Falling", "--clearance", "0.1")
    assert said.startswith("Nothing collides, nothing intersects, nothing is within 0.1 of another: ")
    add_mesh(stage, "/World/Broken", {0: FALLING, 1: FALLING[:2]})
    said = sentence_of(stage, "--exclude", "/World/Floor", status=4)
    assert said.endswith(" Not checked: 1 part that cannot be read, named as left out.")


def test_charts_without_bars_are_left_out(tmp_path, browser):
    browser.open(replay(falling_through_quads(tmp_path), "--no-intersections")[3])
    assert browser.value("document.querySelectorAll('#intervals svg').length") == 1
    assert not browser.value("byId('nothing').offsetHeight")


def test_print_has_the_first_rows_in_full(tmp_path, browser):
    page = replay(many_hits(tmp_path / "scene.usda"))[3]
    browser.resize(500, 800)
    browser.open(page)
    total = browser.value("rows.count")
    browser.call("Emulation.setEmulatedMedia", media="print")
    browser.value("dispatchEvent(new Event('beforeprint'))")
    browser.value("byId('rows').dispatchEvent(new Event('scroll'))")  # as when sizes change
    assert total > 50 == browser.value("document.querySelectorAll('#rows tbody tr').length")
    assert (
        browser.value("document.querySelector('#rows .print-only').textContent") == f"The first 50 of {total:,} rows."
    )
    rows, page_rows = (browser.box(selector) for selector in ("#rows", "#rows table"))
    assert rows[3] >= page_rows[3]  # nothing of the table is cut off
    assert (
        browser.value("document.querySelector('#rows td.kind span').offsetWidth") > 40
    )  # the words, not only a colour
    for hidden in (".controls", ".filters", "#save-csv", "details"):
        assert browser.value(f"document.querySelector('{hidden}').offsetHeight") == 0
    pdf = browser.call("Page.printToPDF", printBackground=True)["data"]
    assert len(pdf) > 20_000
    browser.call("Emulation.setEmulatedMedia", media="screen")
    browser.value("dispatchEvent(new Event('afterprint'))")
    assert browser.value("document.querySelectorAll('#rows tbody tr[data-at]').length") < total
    assert browser.console == []


def test_names_are_listed_only_where_there_are_some(tmp_path):
    stage = falling_through_quads(tmp_path)
    stage.GetPrimAtPath("/World/Floor").SetDisplayName("Ground")
    data = Page(replay(stage)[3].read_text()).data
    assert [fact for fact in data["facts"] if fact[0].startswith("Mesh ")] == [["Mesh /World/Floor", "Ground"]]
    assert "no display name" not in json.dumps(data)


def test_paths_of_instances_are_those_of_their_prims(tmp_path):
    stage = new_stage(tmp_path / "scene.usda")
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Many")
    add_mesh(stage, "/World/Many/Proto", falling(0.5, 0.2))
    instancer.CreatePrototypesRel().AddTarget("/World/Many/Proto")
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (5, 0, 0)])
    meshes = Page(replay(stage)[3].read_text()).data["meshes"]
    assert len({mesh["name"] for mesh in meshes}) == 2
    assert {mesh["path"] for mesh in meshes} == {"/World/Many/Proto"}
