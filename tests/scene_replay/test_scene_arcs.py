"""Replay of meshes that turn: found on their arcs between two samples, with their places, welds, curves and files."""

import json

import numpy as np
import pytest
from pxr import UsdGeom
from usd_stages import FALLING, add_mesh, animate, find, hits, moved, new_stage, save

import warp_bsc as bsc
from warp_bsc.cli.main import main
from warp_bsc.scene_replay.scene_arcs import arcs_of

PIN = [(0.0, 1.0, -1.0), (0.0, 1.2, -1.0), (0.0, 1.0, 1.0)]
BLADE = [(0.2, 0.0, 0.0), (2.0, 0.0, 0.1), (2.0, 0.0, -0.1)]


@pytest.fixture
def stage(tmp_path):
    return new_stage(tmp_path / "scene.usda")


def spinning(stage, *angles, path="/World/Blade", points=BLADE):
    """A mesh that turns around z from one angle to the other between two time codes."""
    mesh = add_mesh(stage, path, points)
    turn = mesh.AddRotateZOp()
    for time, angle in enumerate(angles):
        turn.Set(float(angle), time)
    return mesh


@pytest.mark.parametrize(
    ("angles", "time"), [((0, 180), 0.5), ((0, 360), 0.25), ((-180, 180), 0.75), ((0, 3600), 0.025)]
)
def test_a_blade_that_spins_between_two_samples_strikes_a_pin(stage, angles, time):
    add_mesh(stage, "/World/Pin", PIN)
    spinning(stage, *angles)
    found = find(stage)
    assert found["hits"] > 0 and found["certified"] and len(found["intervals"]) == 1
    assert found["validation"]["disagreements"] == []
    contacts = [contact for interval in found["intervals"] for contact in interval["contacts"]]
    assert min(contact["time"] for contact in contacts) == pytest.approx(time, abs=1e-4)
    for contact in contacts:
        x, y, z = contact["position"]
        assert abs(x) < 2e-3 and 1.0 - 1e-3 <= y <= 1.2 + 1e-3 and abs(z) <= 0.1
    times = [hit[4].expected for hit in hits(find(stage, "--subdivide", "7"))]
    assert min(times) == pytest.approx(time, abs=1e-4)  # there is nothing left for it to find


@pytest.mark.parametrize("baked", [False, True])
def test_a_propeller_goes_through_a_cloth_between_two_samples(stage, baked):
    """Points at the samples alone, as of a baked cache, pass on their chords, inside of the cloth."""
    across = np.linspace(-0.1, 0.1, 3)
    points = [(1.3 + x, 1.3 + x, z) for x in across for z in across]
    counts, corners = [4] * 4, [i + k for i in (0, 1, 3, 4) for k in (0, 3, 4, 1)]
    cloth = add_mesh(stage, "/World/Cloth", points, counts, corners)
    ends = [[(float(x + shift), float(y), float(z)) for x, y, z in points] for shift in (0.0, 0.01)]
    for time, x in enumerate(ends):
        cloth.GetPointsAttr().Set(x, time)
    if baked:
        propeller = add_mesh(stage, "/World/Blade", BLADE)
        for time, x in enumerate((BLADE, [(-y, x, z) for x, y, z in BLADE])):
            propeller.GetPointsAttr().Set(x, time)
    else:
        spinning(stage, 0, 90)
    found = find(stage)
    assert found["certified"] and (found["hits"] > 0) == (not baked)


def test_places_are_on_the_arcs(stage):
    """A spike whose tip passes through the blade, and one that the edge of the blade meets."""
    add_mesh(stage, "/World/Spike", [(0.0, 1.0, 0.0), (-0.01, 1.2, -1.0), (0.01, 1.2, -1.0)])
    spinning(stage, 0, 360)
    found = hits(find(stage))
    assert any(hit[1] == "vertex 0" and hit[0] == "/World/Spike" for hit in found)
    for hit in found:
        x, y, z = hit[5].expected
        assert abs(x) < 2e-2 and 1.0 - 1e-3 <= y <= 1.2 and -0.1 <= z <= 1e-3, hit


def test_a_pin_that_the_tip_does_not_reach_is_not_struck(stage):
    """The chord of a small turn is inside the arc: the pin just outside of the chord is struck, outside the arc not."""
    for name, y, struck in (("Near", 2.0 - 1e-4, True), ("Far", 2.0 + 1e-4, False)):
        path = f"/World/{name}"
        add_mesh(stage, path, [(0.0, y, -1.0), (0.0, y + 0.2, -1.0), (0.0, y, 1.0)])
        if name == "Near":
            spinning(stage, 60, 120)
        found = find(stage)
        assert bool([hit for hit in hits(found) if path in (hit[0], hit[2])]) == struck


def test_a_mesh_that_turns_does_not_collide_with_itself_but_with_others_that_turn(stage):
    flat = [(0.5, -0.1, 0.0), (2.0, -0.1, 0.0), (2.0, 0.1, 0.0), (0.5, 0.1, 0.0), *moved(BLADE, (0.5, 0.0, 0.0))]
    mesh = add_mesh(stage, "/World/Crossed", flat, [4, 3], list(range(7)))
    turn = mesh.AddRotateZOp()
    turn.Set(0.0, 0)
    turn.Set(180.0, 1)
    assert find(stage, "--no-intersections")["hits"] == 0
    spinning(stage, 180, 0)
    found = hits(find(stage, "--no-intersections"))
    assert found and {frozenset((hit[0], hit[2])) for hit in found} == {frozenset(("/World/Crossed", "/World/Blade"))}


def test_vertices_that_are_welded_to_what_does_not_turn_stay(stage):
    """A blade whose hub is a vertex of a post, and a rim that turns with it: the welded vertices have one path."""
    spinning(stage, 0, 90, points=[(0, 0, 0), *BLADE[1:]])
    spinning(stage, 0, 90, path="/World/Rim", points=[BLADE[1], BLADE[2], (2.5, 0.0, 0.0)])
    add_mesh(stage, "/World/Post", [(0, 0, 0), (-0.5, 0.2, -1), (-0.5, -0.2, -1)])
    (interval,) = bsc.Scene(save(stage))
    arcs, segment = arcs_of(interval), interval.segment
    assert segment.welded == 3
    hub = np.flatnonzero((interval.x0 == 0).all(axis=1))
    tips = np.flatnonzero(interval.x0[:, 0] == 2.0)
    assert arcs.body[hub].tolist() == [-1] and (arcs.body[tips] >= 0).all()
    x = arcs.positions(interval.x0, interval.x1, 0.5)
    np.testing.assert_allclose(np.linalg.norm(x[tips, :2], axis=1), 2.0, rtol=1e-12)
    assert find(stage)["hits"] == 0


def test_curves_and_points_that_turn_are_found_on_their_arcs(stage):
    add_mesh(stage, "/World/Pin", PIN)
    parent = UsdGeom.Xform.Define(stage, "/World/Arm")
    turn = parent.AddRotateZOp()
    turn.Set(0.0, 0)
    turn.Set(360.0, 1)
    curve = UsdGeom.BasisCurves.Define(stage, "/World/Arm/Rope")
    curve.CreateTypeAttr("linear")
    curve.CreateCurveVertexCountsAttr([2])
    curve.CreatePointsAttr([(0.5, 0, 0), (1.5, 0, 0)])
    points = UsdGeom.Points.Define(stage, "/World/Arm/Beads")
    points.CreatePointsAttr([(1.03, 0, 0.3)])
    points.CreateWidthsAttr([0.04])
    found = find(stage)
    struck = {tuple(sorted((hit[0], hit[2]))): hit[4].expected for hit in hits(found)}
    assert set(struck) == {("/World/Arm/Rope", "/World/Pin"), ("/World/Arm/Beads", "/World/Pin")}
    assert struck["/World/Arm/Rope", "/World/Pin"] == pytest.approx(0.25, abs=1e-4)
    assert struck["/World/Arm/Beads", "/World/Pin"] == pytest.approx(0.25 - 0.02 / 1.03 / (2 * np.pi), abs=1e-3)


def test_crossings_at_the_end_of_a_turn_are_found(stage):
    add_mesh(stage, "/World/Wall", [(-0.5, 1.0, -1.0), (0.5, 1.0, -1.0), (0.0, 1.0, 1.0)])
    spinning(stage, -20, 0, 90, 180)
    crossings = [
        [interval["intersections"][side]["crossings"] for side in ("start", "end")]
        for interval in find(stage)["intervals"]
    ]
    assert crossings == [[0, 0], [0, 2], [2, 0]]


@pytest.mark.slow
def test_workers_write_the_same_bytes(stage, tmp_path):
    add_mesh(stage, "/World/Pin", PIN)
    spinning(stage, 0, 180, 540, 600)
    animate(add_mesh(stage, "/World/Falling", FALLING), (0, 0, 1), (0, 0, 0), (0, 0, -1))
    path = save(stage)
    written = []
    for workers in ("1", "2"):
        out = tmp_path / f"hits{workers}.json"
        assert main(["replay", path, "--device", "cpu", "--workers", workers, "--json", str(out)]) == 0
        written.append(out.read_bytes())
    assert written[0] == written[1] and json.loads(written[0])["hits"] > 0
