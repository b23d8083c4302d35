"""The limit of the rows that files list: which are kept, that all are counted, and that each file says so."""

import json
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf
from replay_files import OPTIONS, OUTPUTS, Page, falling_through_quads, many_hits, near_and_inside_stage, replay
from usd_stages import save
from waving_sheets import write_scene

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.scene_replay.limit import limit_rows

ASSETS = Path(__file__).resolve().parents[2] / "assets"
TWIST = str(ASSETS / "cloth_twist.usd")


@pytest.fixture(scope="module")
def waves(tmp_path_factory):
    return str(write_scene(tmp_path_factory.mktemp("waves") / "waves.usdc", frames=6))


def first_rows(pairs, values, limit):
    """The first of each two meshes by value, then the first others, in plain Python."""
    order = sorted(range(len(pairs)), key=lambda row: (values[row], row))
    seen, firsts, others = set(), [], []
    for row in order:
        names = frozenset(pairs.mesh_names(slice(row, row + 1))[0])
        (others if names in seen else firsts).append(row)
        seen.add(names)
    return sorted((firsts + others)[:limit])


@pytest.mark.parametrize("limit", [1, 2, 5, 40, 10**6])
def test_which_collisions_are_kept(tmp_path, limit):
    scene = bsc.Scene(save(many_hits(tmp_path / "scene.usda", columns=4)))
    for result in bsc.replay(scene, device="cpu", clearance=0.3):
        few = limit_rows(result, limit)
        assert few.summary is result.summary
        for pairs, kept, values in (
            (result.contacts, few.contacts, result.contacts.toi),
            *((all_at, at, all_at.distance) for all_at, at in zip(result.proximities, few.proximities, strict=True)),
        ):
            rows = first_rows(pairs, values, limit)
            assert len(pairs) > 2 and len(kept) == min(limit, len(pairs))
            for name in pairs.BY_PAIR:
                np.testing.assert_array_equal(getattr(kept, name), getattr(pairs, name)[rows])


def test_curves_of_the_edges_that_are_kept_are_whole():
    """The first edges in the file's order make 60 segments."""
    (result,) = bsc.replay(bsc.Scene(str(ASSETS / "twisting.usd"), frames=bsc.FrameRange(77, 78)), device="cpu")
    whole, few = result.intersections[0], limit_rows(result, 100).intersections[0]
    assert len(whole) > 1000 and len(few) == 100
    segments = {(*map(tuple, ends.tolist()),) for ends in whole.cuts.points}
    assert {(*map(tuple, ends.tolist()),) for ends in few.cuts.points} <= segments
    assert len(few.cuts.points) >= 85


def test_parts_inside_are_limited_by_themselves(tmp_path):
    scene = bsc.Scene(save(near_and_inside_stage(tmp_path)))
    (result, _) = bsc.replay(scene, device="cpu")
    few = limit_rows(result, 1).intersections[0]
    assert few.mesh_names(few.inside_rows) == [("/World/Inside", "/World/Case")]


def listed_in(folder):
    """Numbers of rows, by kind and file: collisions, and pairs at rest."""
    found, page = json.loads((folder / "hits.json").read_text()), Page((folder / "page.html").read_text())
    lists = "edges_through_faces", "inside", "proximity_pairs"
    at_rest = [sum(len(interval.get(name, ())) for name in lists) for interval in found["intervals"]]
    at_rest.append(sum(len(found["intervals"][-1].get(f"{name}_at_end", ())) for name in lists))
    rows = (folder / "hits.csv").read_text().splitlines()[1:]
    toi_column = [row.split(",")[15] for row in rows if not row.startswith("#")]
    columns = dict(np.load(folder / "hits.npz"))
    collides = columns["normal"].any(axis=1)
    return {
        "json": (sum(len(interval["contacts"]) for interval in found["intervals"]), sum(at_rest)),
        "csv": (sum(map(bool, toi_column)), toi_column.count("")),
        "npz": (int(collides.sum()), int((~collides).sum())),
        "page": tuple(sum(column) for column in zip(*((a, b + c) for a, b, c in page.data["rows"]), strict=True)),
    }


def test_all_files_list_the_same_and_say_what_they_leave_out(tmp_path, capsys):
    options = ("--clearance", "0.3")
    replay(many_hits(tmp_path / "scene.usda", columns=4), *options)
    whole = json.loads((tmp_path / "hits.json").read_text())
    assert whole["not_listed"] is None
    capsys.readouterr()
    replay(tmp_path / "scene.usda", *options, "--limit", "5")
    printed = " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "hits.json").read_text())
    (rows,) = set(listed_in(tmp_path).values())
    assert rows[0] == 15 and rows[1] < sum(listed_in(tmp_path)["json"]) < whole["hits"]
    for sums in ("hits", "mesh_pairs", "collision_spans", "intersections", "nearest"):
        assert found[sums] == whole[sums]
    for now, then in zip(found["intervals"], whole["intervals"], strict=True):
        assert {name: value for name, value in now.items() if not isinstance(value, list)} == {
            name: value for name, value in then.items() if not isinstance(value, list)
        }
    missing = found["not_listed"]
    assert missing["limit"] == found["options"]["limit"] == 5
    assert missing["collisions"] == [whole["hits"] - 15, whole["hits"]]
    said = f"15 of {whole['hits']:,} collisions, the earliest; "
    csv = (tmp_path / "hits.csv").read_text().splitlines()[-1]
    page = Page((tmp_path / "page.html").read_text()).data
    assert csv.startswith("# limit: ") and said in csv and said in printed
    assert any(said in note for note in page["notes"]) and f"{whole['hits']:,}" in str(page["tiles"])
    assert json.loads(str(np.load(tmp_path / "hits.npz")["facts"]))["not_listed"] == missing
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "overlay.usda"))
    assert said in layer.documentation
    assert layer.customLayerData["collisions"]["collisionsNotListed"] == whole["hits"] - 15


def test_a_limit_leaves_depths_as_they_are(tmp_path):
    depths = []
    for limit in ("100000", "2"):
        page = str(tmp_path / "page.html")
        assert main(["replay", TWIST, "--device", "cpu", "--limit", limit, "--report", page]) == 0
        depths.append([pair["depth"] for pair in Page(Path(page).read_text()).data["pairs"]])
    assert depths[0] == depths[1] and all(depths[0])


def test_a_limit_that_leaves_nothing_out_says_nothing(tmp_path, capsys):
    replay(falling_through_quads(tmp_path), "--limit", "1000")
    assert "--limit" not in capsys.readouterr().out
    assert json.loads((tmp_path / "hits.json").read_text())["not_listed"]["collisions"] == [0, 1]
    assert "#" not in (tmp_path / "hits.csv").read_text()


@pytest.mark.slow
def test_limited_files_are_the_same_from_workers_and_resumed(tmp_path, waves, capsys):
    def run(folder, *more, status=0):
        named = [word for option, name in zip(OPTIONS, OUTPUTS, strict=True) for word in (option, str(folder / name))]
        assert main(["replay", waves, "--device", "cpu", "--limit", "9", *named, *more]) == status
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    alone, other = tmp_path / "1", tmp_path / "2"
    alone.mkdir()
    other.mkdir()
    whole = run(alone)
    torn = whole["hits.json"]
    (other / "hits.json.part").write_bytes(torn[: torn.index(b'{"index": 3') + 100])
    resumed = run(other, "--resume", "--workers", "2")
    assert [name for name in whole if resumed[name] != whole[name]] == []
    capsys.readouterr()
    run(other, "--resume", "--limit", "8", status=2)
    assert "cannot resume: limit was 9, and is 8" in capsys.readouterr().err


def test_a_limit_needs_a_file(tmp_path, capsys):
    path = save(falling_through_quads(tmp_path))
    assert main(["replay", path, "--device", "cpu", "--limit", "3"]) == 2
    assert "error: --limit needs a file" in capsys.readouterr().err
    assert main(["replay", path, "--device", "cpu", "--limit", "0", "--json"]) == 2
