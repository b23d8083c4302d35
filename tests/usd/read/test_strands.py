"""Curves and points of USD: they collide between samples as their widths say, with meshes and with each other."""

import csv
import json

import numpy as np
import pytest
from boxes import CORNERS, SIDES
from chromium import CHROMIUM, Browser
from pxr import Usd, UsdGeom
from replay_files import Page, add_up, prims_of_pairs
from usd_stages import FALLING, FLOOR, add_instancer, add_mesh, animate, find, floor_stage, hits, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.cli.main import main

ALONG = [(0.0, -0.5, 0.0), (0.5, -0.5, 0.0), (1.0, -0.5, 0.0)]
"""A rope above the floor's first triangle."""


@pytest.fixture
def stage(tmp_path):
    return floor_stage(tmp_path)


def add_rope(stage, path, points, widths=(), interpolation="constant", counts=None, kind="linear"):
    """Curves; points are one list, or a dictionary of lists by time."""
    rope = UsdGeom.BasisCurves.Define(stage, path)
    rope.CreateTypeAttr(kind)
    by_time = points if isinstance(points, dict) else {None: points}
    rope.CreateCurveVertexCountsAttr(counts or [len(next(iter(by_time.values())))])
    return with_points(rope, by_time, widths, interpolation)


def add_points(stage, path, points, widths=(), interpolation="vertex"):
    by_time = points if isinstance(points, dict) else {None: points}
    return with_points(UsdGeom.Points.Define(stage, path), by_time, widths, interpolation)


def with_points(prim, by_time, widths, interpolation):
    for time, value in by_time.items():
        prim.CreatePointsAttr().Set(value, *([] if time is None else [time]))
    if len(widths):
        prim.CreateWidthsAttr(list(widths))
        prim.SetWidthsInterpolation(interpolation)
    return prim


def hits_as_numbers(found):
    """Times and places of collisions, rounded."""
    contacts = [contact for interval in found["intervals"] for contact in interval["contacts"]]
    return [(round(c["time"], 6), tuple(round(float(x), 6) for x in c["position"])) for c in contacts]


def lowered(points, *heights):
    return {time: moved(points, (0, 0, height)) for time, height in enumerate(heights)}


@pytest.mark.parametrize(
    ("widths", "interpolation", "radii"),
    [
        ([0.25], "constant", [0.125] * 3),
        ([0.25], "uniform", [0.125] * 3),
        ([0.25, 0.5, 0.25], "vertex", [0.125, 0.25, 0.125]),
        ([0.25, 0.5, 0.25], "varying", [0.125, 0.25, 0.125]),
        ([], "", [0, 0, 0]),
    ],
)
def test_a_rope_meets_a_floor_at_half_its_width(stage, widths, interpolation, radii):
    """From a height of 1 to -1, each point comes within its radius of the floor at (1 - radius) / 2."""
    add_rope(stage, "/World/Rope", lowered(ALONG, 1, -1), widths, interpolation)
    found = find(stage)
    expected = [
        ("/World/Rope", f"vertex {index}", "/World/Floor", "face 0", (1 - radius) / 2, (0.5 * index, -0.5, 0))
        for index, radius in enumerate(radii)
    ]
    listed = hits(found)
    for hit in expected:
        assert hit in [one for one in listed if one[1].startswith("vertex")]
    (interval,) = found["intervals"]
    assert interval["vertex_face_hits"] == 3 and interval["hits"] == len(listed)
    assert all((contact["phase"], contact["separate"]) == ("passes", True) for contact in interval["contacts"])
    (warning,) = found["warnings"]
    assert warning.startswith("curves and points are checked with half their widths as radii between the times; ")
    assert found["certified"] and found["intersections"] == []


def test_primvars_of_widths_come_first_and_scale_lengthens_them(stage):
    rope = add_rope(stage, "/World/Rope", ALONG, [9.0])
    primvar = UsdGeom.PrimvarsAPI(rope).CreatePrimvar("widths", rope.GetWidthsAttr().GetTypeName(), "constant")
    primvar.Set([0.125])
    animate(rope, (0, 0, 1), (0, 0, -1))
    rope.AddScaleOp().Set((0.5, 2.0, 1.0))
    listed = hits(find(stage))
    assert ("/World/Rope", "vertex 0", "/World/Floor", "face 0", 7 / 16, (0, -1, 0)) in listed
    assert len(listed) == 3


def test_widths_that_change_count_as_the_largest(stage, capsys):
    rope = add_rope(stage, "/World/Rope", lowered(ALONG, 1, 0, 1))
    for time, width in ((0, 0.25), (0.5, 0.5), (2, 0.25)):  # the rope has no sample at the second of these
        rope.CreateWidthsAttr().Set([width], time)
    rope.SetWidthsInterpolation("constant")
    assert find(stage)["intervals"][0]["contacts"][0]["time"] == pytest.approx(0.75, abs=1e-5)
    assert "widths or scales that change count as the largest: 1, the first /World/Rope" in capsys.readouterr().out


def test_points_with_all_kinds(stage, tmp_path, capsys):
    """Points come down on a floor, on a rope and on another point, at different times."""
    add_rope(stage, "/World/Rope", moved(ALONG, (0, -0.5, 0.25)), [0.125])
    low = [(1.0, 0.5, 0.0), (0.25, -1.0, 0.25), (-1.0, -1.0, 0.25)]
    add_points(stage, "/World/Falling", lowered(low, 1, 0), [0.125, 0.125, 0.125])
    add_points(stage, "/World/Lying", [low[2]], [0.125])
    out = tmp_path / "hits.csv"
    options = "--csv", str(out), "--overlay", str(tmp_path / "overlay.usda"), "--report", str(tmp_path / "page.html")
    found = find(stage, *options)
    by_kind = {contact["kind"]: contact for contact in found["intervals"][0]["contacts"]}
    assert set(by_kind) == {"vertex-face", "vertex-edge", "vertex-vertex"}
    pairs = {kind: [*zip(contact["meshes"], contact["elements"], strict=True)] for kind, contact in by_kind.items()}
    assert pairs["vertex-face"] == [("/World/Falling", "vertex 0"), ("/World/Floor", "face 0")]
    assert pairs["vertex-edge"] == [("/World/Falling", "vertex 1"), ("/World/Rope", "edge 0-1")]
    assert pairs["vertex-vertex"] == [("/World/Falling", "vertex 2"), ("/World/Lying", "vertex 0")]
    tois = {kind: contact["toi"] for kind, contact in by_kind.items()}
    near = {"vertex-face": 1 - 0.0625, "vertex-edge": 1 - 0.125, "vertex-vertex": 1 - 0.125}
    assert tois == pytest.approx(near, abs=1e-5)
    assert by_kind["vertex-edge"]["position"] == pytest.approx([0.25, -1, 0.25])
    assert by_kind["vertex-vertex"]["position"] == pytest.approx([-1, -1, 0.3125], abs=1e-5)
    assert by_kind["vertex-vertex"]["normal"] == pytest.approx([0, 0, 1])
    assert all(contact["phase"] is contact["separate"] is None for contact in by_kind.values())
    assert found["hits"] == 3
    assert "1 vertex-face, 0 edge-edge, 1 vertex-edge and 1 vertex-vertex pairs." in capsys.readouterr().out
    with out.open() as file:
        assert {row["kind"] for row in csv.DictReader(file)} == set(by_kind)
    overlay = (tmp_path / "overlay.usda").read_text()
    assert 'def PointInstancer "VertexEdge"' in overlay and 'def PointInstancer "VertexVertex"' in overlay


UPRIGHT = [(0.25, -0.5, -0.5), (0.25, -0.5, 0.5), (0.25, -0.5, 1.5)]
"""A rope whose first edge passes through the floor's first triangle."""


@pytest.fixture
def pierced(stage):
    """A rope that is above the floor, comes through it, stays, and leaves it, and one that passes through a wall."""
    add_rope(stage, "/World/Rope", lowered(UPRIGHT, 1, 0, -0.25, 0, 1), [0.0625])
    add_rope(stage, "/World/Still", moved(UPRIGHT, (0.5, 0.25, 0)), [0.0625])
    add_rope(stage, "/World/Standing", moved(UPRIGHT, (0, 0.25, 0.5)))
    return stage


def test_edges_of_curves_through_faces_are_found_at_rest(pierced, tmp_path, capsys):
    names = {name: tmp_path / f"out.{name}" for name in ("csv", "usda", "html")}
    words = ("--csv", str(names["csv"]), "--overlay", str(names["usda"]), "--report", str(names["html"]))
    found = find(pierced, *words)
    printed = capsys.readouterr().out
    assert "Already crosses at 0: 1 edge through faces, 1 edge touching faces." in printed
    assert "  /World/Floor with /World/Still: from 0 to 4, 1 edge at first, 1 at last: stays\n" in printed
    assert "  /World/Floor with /World/Rope: from 1 to 3, 1 edge at first, 1 at last: heals\n" in printed
    assert "  /World/Floor with /World/Standing: from 0 to 4, 1 edge at first, 1 at last: touches only\n" in printed
    spans = {(span["meshes"][1], span["since"], span["until"], span["crossings"]) for span in found["intersections"]}
    assert spans == {("/World/Still", 0, 4, 1), ("/World/Rope", 1, 3, 1), ("/World/Standing", 0, 4, 0)}
    rows = [row for row in found["intervals"][2]["edges_through_faces"] if row["meshes"][0] == "/World/Rope"]
    assert [(row["elements"], row["meshes"], row["phase"], row["position"], row["time"]) for row in rows] == [
        (["edge 0-1", "face 0"], ["/World/Rope", "/World/Floor"], "crosses", [0.25, -0.5, 0], 2)
    ]
    # the rope's first point comes through the floor and goes back; its edge in the floor meets no other edge
    of_rope = [[c for c in interval["contacts"] if "/World/Rope" in c["meshes"]] for interval in found["intervals"]]
    phases = [{(contact["phase"], contact["separate"]) for contact in contacts} for contacts in of_rope]
    assert phases == [{("enters", True)}, set(), set(), {("leaves", False)}]
    with names["csv"].open() as file:
        written = [row for row in csv.DictReader(file) if row["phase"] == "crosses"]
    assert len(written) == 5 + 3 and {row["first_mesh"] for row in written} == {"/World/Rope", "/World/Still"}
    layer = Usd.Stage.Open(str(names["usda"]))
    points = [UsdGeom.PointInstancer(prim) for prim in prims_of_pairs(layer, "CurveIntersections")]
    for time, count in ((0, 1), (1, 2), (2, 2), (3, 2), (4, 1)):
        assert sum(len(of_pair.GetPositionsAttr().Get(time) or ()) for of_pair in points) == count, time
    assert prims_of_pairs(layer, "Intersections") == []
    block = Page(names["html"].read_text()).block("rest-2")
    through = block["position"].reshape(-1, 3)[block["through"]]
    np.testing.assert_allclose(sorted(np.diff(through, axis=0)[0]), [0, 0.25, 0.5])


def test_ignored_initial_curves_and_no_intersections(pierced):
    found = find(pierced, "--ignore-initial")
    assert {span["meshes"][1] for span in found["intersections"]} == {"/World/Rope", "/World/Standing"}
    without = find(pierced, "--no-intersections")
    assert "intersections" not in without["intervals"][0] and without["hits"] == find(pierced)["hits"]


def test_curves_of_a_still_stage_are_checked_at_rest(stage):
    add_rope(stage, "/World/Still", UPRIGHT)
    found = find(stage)
    assert [(span["meshes"], span["crossings"]) for span in found["intersections"]] == [
        (["/World/Floor", "/World/Still"], 1)
    ]
    assert found["hits"] == 0


def test_random_curves_through_random_meshes(stage):
    """All edges that the exact checker finds, and no others, at each time."""
    rng = np.random.default_rng(0)
    at = {t: rng.uniform(-1, 1, (30, 3)).astype(np.float32) for t in range(3)}
    add_mesh(stage, "/World/Soup", {t: x[:12].tolist() for t, x in at.items()}, [3] * 4, list(range(12)))
    add_rope(stage, "/World/Ropes", {t: x[12:].tolist() for t, x in at.items()}, [0.01], counts=[9, 9])
    scene = bsc.Scene(save(stage), selection=bsc.Selection(exclude=("/World/Floor",)))
    faces = np.arange(12).reshape(4, 3)
    ends = np.delete(np.stack([np.arange(17), np.arange(1, 18)], axis=1), 8, axis=0) + 12
    total = 0
    for result in bsc.replay(scene, device="cpu"):
        start, end = result.intersections
        for found, time in ((start, result.summary.start), (end, result.summary.end)):
            x = at[time]
            edge, face = (grid.ravel() for grid in np.meshgrid(range(len(ends)), range(len(faces)), indexing="ij"))
            corners = x[faces[face]]
            passes = checker.edges_pass_faces(x[ends[edge]], corners, corners)
            expected = {(*(ends[i] - 12), j) for i, j in zip(edge[passes], face[passes], strict=True)}
            rows = found.of_curves
            assert {(*i, j) for i, (j, _) in found.indices[rows]} == expected and len(rows) == len(expected)
            assert found.crossings > len(rows)  # the soup crosses itself, too
            total += len(rows)
    assert total > 10


def test_curves_inside_a_box(stage, tmp_path):
    """Of two curves of a prim one is inside; another is tied to a corner of the box; one passes through a wall."""
    box = moved(CORNERS, (4, 0, 0))
    add_mesh(stage, "/World/Box", {t: box for t in range(2)}, [4] * 6, SIDES)
    inner = [(4.25, 0.25, 0.25), (4.5, 0.5, 0.5), (4.75, 0.5, 0.5)]
    add_rope(
        stage, "/World/Two", {0: inner + moved(inner, (2, 0, 0)), 1: moved(inner + inner, (2, 0, 0))}, counts=[3, 3]
    )
    add_rope(stage, "/World/Tied", [tuple(box[0]), *moved(inner[1:], (0, 0, 0.125))])
    add_rope(stage, "/World/Through", [*moved(inner, (0, 0.25, 0)), (9, 0, 0)])
    add_points(stage, "/World/Dust", [inner[0]])
    out = tmp_path / "overlay.usda"
    found = find(stage, "--overlay", str(out))
    inside = {(*span["meshes"], span["until"], span["last"]) for span in found["intersections"] if span["inside"]}
    assert inside == {("/World/Two", "/World/Box", 0, 1), ("/World/Tied", "/World/Box", 1, 1)}
    (row,) = [row for row in found["intervals"][0]["inside"] if row["meshes"][0] == "/World/Two"]
    assert row["elements"][0] == "vertex 0" and row["position"] == list(inner[0])
    assert {span["meshes"][1] for span in found["intersections"] if not span["inside"]} == {"/World/Through"}


def test_a_thick_rope_meets_itself_only_where_it_comes_back(stage):
    """Its points are closer than it is thick: neighbours along it always touch."""
    x = np.arange(0.0, 1.01, 0.0625)
    straight = [(float(a), -1.0, 1.0) for a in x]
    rope = add_rope(stage, "/World/Rope", lowered(straight, 0, 0.5), [0.25])
    assert find(stage)["hits"] == 0
    folded = [(float(min(a, 1.0 - a)), -1.0, 1.0 + (0.125 if a > 0.5 else 0.0)) for a in x]
    rope.GetPointsAttr().Set(folded, 1)
    contacts = find(stage)["intervals"][0]["contacts"]
    ends = {tuple(index for pair in contact["indices"] for index in pair) for contact in contacts}
    assert (0, 1, 15, 16) in ends and {contact["kind"] for contact in contacts} == {"edge-edge"}
    gaps = [min(c, d) - max(a, b) for a, b, c, d in ends]
    assert min(gaps) * 0.0625 > 0.5  # twice the width
    assert find(stage, "--no-self")["hits"] == 0


def test_a_closed_rope_is_near_itself_at_its_seam(stage):
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = [(float(np.cos(a)), float(np.sin(a)), 1.0) for a in angles]
    rope = add_rope(stage, "/World/Rope", lowered(ring, 0, 0.5), [0.5])
    rope.CreateWrapAttr("periodic")
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    assert len(result.contacts.segment.free_edges) == 32 and len(result.contacts) == 0
    rope.CreateWrapAttr("nonperiodic")
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    assert len(result.contacts.segment.free_edges) == 31 and len(result.contacts) > 0  # its ends meet


def test_points_of_a_curve_in_one_place_have_no_edge_between_them(tmp_path):
    """Recorded tracks have such points; a curve that is all in one place is a point with its radius."""
    first, middle, last = [(0.1, -0.5, 0.0), (0.5, -0.5, 0.0), (0.9, -0.5, 0.0)]
    alone = (-0.5, -0.25, 0.0)
    ropes = [first, middle, last], [first, first, middle, last, last, last, alone, alone]
    found = []
    for number, (points, counts) in enumerate(zip(ropes, ([3], [6, 2]), strict=True)):
        stage = floor_stage(tmp_path / str(number))
        add_rope(stage, "/World/Rope", lowered(points, 1, -1), [0.25], counts=counts)
        found.append(sorted(hits_as_numbers(find(stage))))
    plain, repeated = found
    assert [hit for hit in repeated if hit[1] != alone] == plain
    assert [hit for hit in repeated if hit[1] == alone] == [(0.4375, alone)]


def test_a_closed_rope_may_end_where_it_begins(stage):
    angles = np.linspace(0, 2 * np.pi, 33)
    ring = [(float(np.cos(a)), float(np.sin(a)), 1.0) for a in angles]
    ring[-1] = ring[0]
    add_rope(stage, "/World/Rope", lowered(ring, 0, 0.5), [0.5]).CreateWrapAttr("periodic")
    assert find(stage)["hits"] == 0


def test_meshes_collide_as_they_do_without_ropes(stage):
    """A mesh beside its neighbours: minimum distances would exclude these, and touching would not be enough."""
    points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    folded = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.25, 0.25, -0.25)]
    above = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.25, 0.25, 0.25)]
    sheet = {t: moved(p, (0, 0, 1)) for t, p in enumerate((points, above, folded))}
    add_mesh(stage, "/World/Sheet", sheet, [3, 3], [0, 1, 2, 1, 3, 2])
    add_mesh(stage, "/World/Falling", {t: moved(FALLING, (0, 0, 0.75 - 0.5 * t)) for t in range(3)})
    without = find(stage)
    assert without["hits"] > 0
    add_rope(stage, "/World/Rope", lowered(ALONG, 9, 8, 7), [0.5])
    found = find(stage)
    keys = "contacts", "earliest", "mesh_pairs", "edges_through_faces", "phases", "separate_hits"
    for before, after in zip(without["intervals"], found["intervals"], strict=True):
        assert {key: before[key] for key in keys} == {key: after[key] for key in keys}


def test_a_rope_that_is_fixed_to_a_mesh(stage):
    """Its first point is one of the mesh's: it is welded, and neither thickens the mesh nor collides with it."""
    carrier = {time: moved(FLOOR, (0, 0, 2 + time)) for time in range(2)}
    add_mesh(stage, "/World/Carrier", carrier)
    corner = FLOOR[0]
    hanging = [tuple(float(c) for c in np.add(corner, (0, 0, -0.5 * n))) for n in range(3)]
    add_rope(stage, "/World/Rope", {time: moved(hanging, (0, 0, 2 + time)) for time in range(2)}, [0.25])
    add_mesh(stage, "/World/Close", moved(FLOOR, (4.0625, 0, 2)))
    (result,) = bsc.replay(bsc.Scene(save(stage)), device="cpu")
    segment = result.contacts.segment
    assert segment.welded == 1 and sorted(segment.radius.tolist())[-3:] == [0, 0.125, 0.125]
    assert len(result.contacts) == 0


def test_ropes_in_instances(stage):
    add_rope(stage, "/World/Many/Rope", ALONG, [0.25])
    places = {0: [(0, 0, 1), (0, -0.5, 1)], 1: [(0, 0, 0), (0, -0.5, 0)]}
    instancer = add_instancer(stage, "/World/Many", places, ["/World/Many/Rope"])
    instancer.CreateScalesAttr([(1, 1, 1), (2, 2, 2)])
    contacts = find(stage)["intervals"][0]["contacts"]
    first = {contact["meshes"][0]: contact["time"] for contact in contacts if contact["kind"] == "vertex-face"}
    assert first == pytest.approx({"/World/Many[0]/Rope": 1 - 0.125, "/World/Many[1]/Rope": 1 - 0.25}, abs=1e-5)


def test_emitted_points_split_the_motion(stage):
    at = [(0.5, -0.5, 1.0), (0.5, -0.75, 1.0), (0.25, -0.5, 1.0)]
    points = {0: at[:2], 1: moved(at, (0, 0, -0.5)), 2: moved(at, (0, 0, -1.5))}
    add_points(stage, "/World/Dust", points, [0.0625], "constant")
    found = find(stage)
    assert [interval["hits"] for interval in found["intervals"]] == [0, 3]
    assert any("/World/Dust changes its topology at time 1" in warning for warning in found["warnings"])


def test_a_scene_without_faces(tmp_path, capsys):
    stage = new_stage(tmp_path / "ropes.usda")
    add_rope(stage, "/World/Still", [(-1, 0, 0), (1, 0, 0)], [0.25])
    add_rope(stage, "/World/Falling", lowered([(0, -1, 0), (0, 1, 0)], 1, -1), [0.25])
    add_points(stage, "/World/Thin", lowered([(0.5, 0, 0)], 1, -1))
    words = [word for name in ("csv", "overlay", "report") for word in (f"--{name}", str(tmp_path / f"{name}.usda"))]
    found = find(stage, "--clearance", "0.1", *words)
    said = "at 2 times; between times, distances are not checked, nor are those of curves and points at all.\n"
    assert said in capsys.readouterr().out
    notes = Page((tmp_path / "report.usda").read_text()).data["notes"]
    assert "Distances of curves and points are not checked, only their collisions." in notes
    assert [(contact["kind"], contact["triangle"]) for contact in found["intervals"][0]["contacts"]] == [
        ("edge-edge", None), ("vertex-edge", None)
    ]  # fmt: skip
    times = [contact["time"] for contact in found["intervals"][0]["contacts"]]
    assert times == pytest.approx([0.375, 0.4375], abs=1e-5)  # 0.25 and 0.125 apart


def test_points_with_ids_move_on_while_others_come_and_go(stage):
    """Two fall through the floor while one ends and two begin; between samples they move straight, in either order."""
    add_mesh(stage, "/World/Far", {0: moved(FALLING, (9, 9, 9)), 0.5: moved(FALLING, (9, 9, 8))})
    places = {1: (0.5, -0.5), 2: (0.75, -0.5), 3: (1.0, -0.5), 7: (1.25, -0.5), 8: (1.5, -0.5)}
    dust = add_points(stage, "/World/Dust", [])
    for time, height, ids in ((0, 1.0, (1, 2, 3)), (1, -0.5, (7, 3, 1, 8)), (2, -1.0, (7, 3, 1, 8))):
        dust.GetPointsAttr().Set([(*places[number], height) for number in ids], time)
        dust.CreateIdsAttr().Set(list(ids), time)
        dust.CreateWidthsAttr().Set([0.1875] * len(ids), time)
    dust.SetWidthsInterpolation("vertex")
    found = find(stage)
    assert [(interval["start"], interval["end"], interval["hits"]) for interval in found["intervals"]] == [
        (0, 0.5, 0), (0.5, 1, 2), (1, 2, 0)
    ]  # fmt: skip
    # from a height of 1 to -0.5 in a time code, a radius of 0.09375 comes to the floor after 0.90625 / 1.5
    assert {(contact["elements"][0], round(contact["time"], 4)) for contact in found["intervals"][1]["contacts"]} == {
        ("vertex 0", 0.6042), ("vertex 2", 0.6042)
    }  # fmt: skip


def test_what_is_not_read_is_named(stage, capsys):
    add_rope(stage, "/World/Hair", [(0, 0, 9)] * 4, [1.0], kind="cubic")
    add_rope(stage, "/World/Short", lowered(ALONG, 1, 0), [1.0], counts=[2, 1])
    add_rope(stage, "/World/Long", lowered(ALONG, 1, 0), [1.0], counts=[4])
    add_rope(stage, "/World/Thin", lowered(ALONG, 1, 0), [1.0, 1.0], "vertex")
    add_rope(stage, "/World/Negative", lowered(ALONG, 1, 0), [-1.0])
    add_mesh(stage, "/World/Falling", {t: moved(FALLING, (0, 0, 1 - 2 * t)) for t in range(2)})
    found = find(stage, status=4)
    reasons = " ".join(found["left_out"])
    for text in ("curve 1 has 1 points", "add up to 4", "2 widths of interpolation vertex, which has 3", "at least 0"):
        assert text in reasons
    assert "shapes without polygons are not checked: 1 BasisCurves that are not linear" in found["warnings"]
    assert found["hits"] > 0


@pytest.mark.slow
def test_selection_and_workers(stage, tmp_path):
    add_rope(stage, "/World/Rope", lowered(ALONG, 1, 0.5, -0.5, 0.5), [0.25])
    add_points(stage, "/World/Dust", lowered([(0.25, -1.0, 0.0)], 1, 0.5, 0, 0.5), [0.25])
    path = save(stage)
    assert find(stage, "--ignore", "/World/Rope", "/World/Floor")["intervals"][1]["ignored"] == [
        {"meshes": ["/World/Floor", "/World/Rope"], "hits": 3}
    ]
    assert find(stage, "--exclude", "/World/Rope", "/World/Dust")["hits"] == 0
    files = {}
    for workers in ("1", "2"):
        names = {
            option: tmp_path / f"{workers}{option}.usdc" for option in ("--json", "--csv", "--overlay", "--report")
        }
        words = [word for option, name in names.items() for word in (option, str(name))]
        assert main(["replay", path, "--device", "cpu", "--workers", workers, *words]) == 0
        files[workers] = [name.read_bytes() for name in names.values()]
    assert files["1"] == files["2"]
    # a run that was stopped after its first intervals goes on
    whole = json.loads(files["1"][0])
    lines = files["1"][0].splitlines(keepends=True)
    out = tmp_path / "again.json"
    out.write_bytes(b"".join([*lines[:2], lines[2].rstrip(b",\n") + b"],\n", lines[-1]]))
    assert main(["replay", path, "--device", "cpu", "--json", str(out), "--resume"]) == 0
    assert json.loads(out.read_text()) == whole


@pytest.fixture
def shown(stage, tmp_path):
    """The page of a rope and a point that come down."""
    add_rope(stage, "/World/Rope", lowered(ALONG, 1, 0), [0.25])
    add_points(stage, "/World/Dust", lowered([(0.25, -1.0, 0.0)], 1, 0.5), [0.25])
    path = tmp_path / "page.html"
    assert main(["replay", save(stage), "--device", "cpu", "--report", str(path)]) == 0
    return path


def test_page_has_curves_and_points(shown):
    page = Page(shown.read_text())
    block, view = page.block("faces-0"), page.block("view-0")
    names = [page.data["meshes"][number]["name"] for number in block["mesh_of_vertex"]]
    assert [names[vertex] for vertex in block["edges"]] == ["/World/Rope"] * 4
    assert [names[vertex] for vertex in block["points"]] == ["/World/Dust"]
    start = add_up(view)[0] + page.data["center"]
    assert view["step"] < 1e-5
    np.testing.assert_allclose(start[block["edges"]], np.add(ALONG, (0, 0, 1))[[0, 1, 1, 2]], atol=view["step"])
    assert page.data["intervals"] == [[0, 1, 3, 0, 0]]


@pytest.mark.browser
def test_page_in_chromium(shown, tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here")
    with Browser(tmp_path / "profile") as browser:
        browser.open(shown)
        assert "/World/Rope" in browser.value("document.getElementById('viewer-legend').textContent")
        assert browser.value("document.getElementById('viewer-message').hidden") and browser.console == []
