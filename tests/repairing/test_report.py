"""The page of a repair: its data, and what a browser shows of them."""

import matplotlib.image
import numpy as np
import pytest
from chromium import Browser
from dipping import FRAMES, HIT, dipping_sheet, points_of, repaired, sheet
from pxr import UsdGeom
from replay_files import Page
from usd_stages import add_mesh

from warp_bsc.repairing.shot import report


@pytest.fixture(scope="module")
def page_path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    repaired(dipping_sheet(folder), "--report", str(folder / "page.html"))
    return folder / "page.html"


def test_page_has_the_moved_frames(page_path):
    page = Page(page_path.read_text())
    data = page.data
    assert "unsafe" not in page.policy and not [name for name, _ in page.attributes if name.startswith("on")]
    times = [frame["time"] for frame in data["frames"]]
    assert HIT in times and len(data["moves"]) == FRAMES
    assert page.blocks == {"faces-0", *(f"frame-{number}" for number in range(len(times)))}
    assert sum(row[2] for row in data["before"]) > 0 and not any(row[2] + row[3] for row in data["after"])
    hits = sum(row[2] for row in data["before"])
    assert data["tiles"][0] == ["0", f"collisions, of {hits} before"]
    frame = times.index(HIT)
    block, faces = page.block(f"frame-{frame}"), page.block("faces-0")
    shot = np.array(block["low"]) + block["step"] * block["before"].reshape(-1, 3)
    moved = block["moved"]
    x = shot[moved] + block["displacement"].reshape(-1, 3)
    is_sheet = faces["mesh_of_vertex"] == [mesh["name"] for mesh in data["meshes"]].index("/World/Sheet")
    fixed = points_of(page_path.with_name("fixed.usdc"), HIT)
    added = fixed - points_of(page_path.with_name("shot.usda"), HIT)
    np.testing.assert_allclose(block["displacement"].reshape(-1, 3), added[added.any(axis=1)], atol=1e-6)
    assert is_sheet[moved].all() and data["frames"][frame]["moved"] == len(moved)
    assert data["frames"][frame]["move"] == pytest.approx(np.linalg.norm(added, axis=1).max(), rel=1e-5)
    size = np.ptp(fixed[added.any(axis=1)], axis=0)
    np.testing.assert_allclose(np.ptp(x, axis=0), size, atol=2 * block["step"])  # the page has a center of its own


def test_page_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_MOST_VIEWS", 3)
    monkeypatch.setattr(report, "_ALL_FACES", 300)
    monkeypatch.setattr(report, "_FEWEST_FACES", 20)
    repaired(dipping_sheet(tmp_path), "--report", str(tmp_path / "page.html"))
    page = Page((tmp_path / "page.html").read_text())
    views = [frame["view"] for frame in page.data["frames"] if frame["view"] is not None]
    assert 3 <= len(views) <= 4 and page.blocks == {"faces-0", *(f"frame-{number}" for number in views)}
    moves = [frame["move"] for frame in page.data["frames"]]
    assert int(np.argmax(moves)) in views
    assert 20 <= len(page.block("faces-0")["faces"]) // 3 <= 100
    notes = " ".join(page.data["notes"])
    assert f"of {len(moves)} moved frames have a view" in notes and "of 256 triangles around what is moved" in notes


def test_views_of_frames_have_the_faces_of_their_meshes(tmp_path, monkeypatch):
    """Also where another mesh appears, and only frames after that have a view."""
    monkeypatch.setattr(report, "_MOST_VIEWS", 1)
    monkeypatch.setattr(report, "spread", lambda count, most: np.array([count - 1]))
    stage = dipping_sheet(tmp_path)
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Sheet")).GetPointsAttr()
    points.Set([tuple(map(float, p)) for p in sheet(0.1, -0.14)], HIT + 12)
    add_mesh(stage, "/World/Late", [(5.0, 5.0, 5.0), (6.0, 5.0, 5.0), (5.0, 6.0, 5.0)], [3], [0, 1, 2])
    visibility = UsdGeom.Imageable(stage.GetPrimAtPath("/World/Late")).CreateVisibilityAttr()
    visibility.Set("invisible", 0)
    visibility.Set("inherited", HIT + 6)
    repaired(stage, "--report", str(tmp_path / "page.html"))
    page = Page((tmp_path / "page.html").read_text())
    last = max(frame["view"] for frame in page.data["frames"] if frame["view"] is not None)
    block = page.block(f"frame-{last}")
    assert page.data["frames"][last]["time"] > HIT + 6
    names = [page.data["meshes"][mesh]["name"] for mesh in page.block(f"faces-{block['faces']}")["mesh_of_vertex"]]
    assert {"/World/Plate", "/World/Sheet", "/World/Late"} == set(names)


def test_page_is_named_twice(tmp_path, capsys):
    repaired(dipping_sheet(tmp_path), "--report", str(tmp_path / "fixed.usdc"), status=2)
    assert "named twice, as two files of a repair" in capsys.readouterr().err


@pytest.mark.browser
def test_page_in_chromium(page_path, tmp_path):
    with Browser(tmp_path / "profile") as browser:
        browser.open(page_path)
        heading = "document.getElementById('viewer-heading').textContent"
        moves = [frame["move"] for frame in Page(page_path.read_text()).data["frames"]]
        worst = int(np.argmax(moves))
        assert browser.value("location.hash") == f"#frame={worst}"
        shown = browser.value(heading)
        browser.press("ArrowRight")
        browser.wait(f"{heading} !== '{shown}'")
        assert browser.value("location.hash") == f"#frame={worst + 1}"
        browser.press("b")
        assert browser.value("document.getElementById('blend').value") == "0"
        browser.click("#moves .hover", 0)  # no frame is moved then: the first moved one is the nearest
        browser.wait("location.hash === '#frame=0'")
        assert "largest move" not in browser.value("document.getElementById('after-title').textContent")
        assert browser.console == []


@pytest.mark.browser
def test_moves_and_stretch_are_painted(page_path, tmp_path):
    """Moved points are between yellow and red by the root of their moves, as the legend says; others are not."""
    with Browser(tmp_path / "profile") as browser:
        browser.open(page_path)
        page = Page(page_path.read_text())
        index = int(np.argmax([frame["move"] for frame in page.data["frames"]]))
        block = page.block(f"frame-{page.data['frames'][index]['view']}")
        amount = np.array(browser.value(f"loadFrame(frames[{index}]).then((loaded) => [...loaded.amount])")).reshape(
            -1, 2
        )
        moves = np.linalg.norm(block["displacement"].reshape(-1, 3), axis=1)
        assert len(moves) > 10 and not np.delete(amount[:, 0], block["moved"]).any()
        np.testing.assert_allclose(amount[block["moved"], 0], np.sqrt(moves / page.data["largest"]), atol=1e-4)

        def colors(painted):
            browser.value(f"(byId('painted').value = '{painted}', byId('painted').dispatchEvent(new Event('change')))")
            browser.value(
                "(async () => { for (let i = 0; i < 4; i += 1) await new Promise(requestAnimationFrame); })()"
            )
            left, top, right, bottom = map(round, browser.box("#canvas"))
            browser.screenshot(tmp_path / "view.png", whole=False)
            return matplotlib.image.imread(tmp_path / "view.png")[top:bottom, left:right, :3].reshape(-1, 3)

        browser.value("byId('canvas').scrollIntoView({block: 'center'})")
        red, green, blue = colors("moves").T
        warm = (blue < 0.4 * red) & (red > 0.2)
        assert warm.sum() > 500  # shading scales all three channels: green against red goes from 0.82 to 0.11
        assert (green / np.maximum(red, 0.01))[warm].min() < 0.25  # the largest moves
        legend = browser.value(
            "[...document.querySelectorAll('#viewer-legend rect')].map((key) => getComputedStyle(key).fill)"
        )
        assert len(legend) == 4 + 2 and legend[3] == "rgb(204, 23, 28)"
        red, _, blue = colors("none").T
        assert not ((blue < 0.4 * red) & (red > 0.2)).any()
