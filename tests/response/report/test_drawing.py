"""What is seen of a step: drawings in Newton's viewers, the table of contacts, and the warning of uncertified steps."""

import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton.viewer import ViewerNull, ViewerUSD
from newton_scenes import DT, SOLVERS, Changed, add_patch, add_plates, bullet, place_plates
from pxr import Usd, UsdGeom

import warp_bsc as bsc


class Recorder(ViewerNull):
    """Keeps what is drawn of a step, by name: points, or starts and ends, or positions and faces; None if hidden."""

    def __init__(self, model):
        super().__init__(num_frames=1)
        self.drawn = {}
        self.set_model(model)

    def log_points(self, name, points, radii=None, colors=None, hidden=False):
        self.drawn[name] = None if hidden else points.numpy()

    def log_lines(self, name, starts, ends, colors, width=0.01, hidden=False):
        self.drawn[name] = None if hidden else (starts.numpy(), ends.numpy())

    def log_mesh(self, name, points, indices, *arguments, **options):
        self.drawn[name] = points.numpy(), indices.numpy().reshape(-1, 3), options.get("opacity")

    def log_instances(self, name, mesh, xforms, scales, *arguments, **options):
        self.drawn[name] = xforms.numpy()[:, :3], scales.numpy()


def shot(device, **options):
    """Steps a patch until it has hit a sheet; returns the stage, and the state at the end."""
    model = bullet(30, device=device)
    solver = bsc.SolverCCD(SOLVERS["xpbd"](model), **options)
    state, end = model.state(), model.state()
    for _ in range(3):
        solver.step(state, end, model.control(), None, DT)
        state, end = end, state
        if solver.report.predicted_contacts:
            break
    return solver, state


def test_contacts_are_drawn_where_they_are(device):
    solver, state = shot(device, report=["contacts"])
    report, viewer = solver.report, Recorder(solver.model)
    report.draw(viewer)
    contacts = report.forces.contacts.numpy()
    assert len(contacts["point"]) > 10
    for name, expected in (
        ("normals", contacts["normal"]),
        ("impulses", contacts["normal_impulse"][:, None] * contacts["normal"] + contacts["tangential_impulse"]),
    ):
        starts, ends = viewer.drawn[f"/ccd/{name}"]
        np.testing.assert_array_equal(starts, contacts["point"])
        scale = np.linalg.norm(ends - starts, axis=1).max() / np.linalg.norm(expected, axis=1).max()
        np.testing.assert_allclose(ends - starts, scale * expected, atol=1e-3 * scale * np.abs(expected).max())
    report.draw(viewer, impulse_scale=2.0)
    starts, ends = viewer.drawn["/ccd/impulses"]
    np.testing.assert_allclose(ends - starts, 2.0 * expected, atol=1e-6)
    assert all(viewer.drawn[f"/ccd/{name}"] is None for name in ("truncated", "frozen", "uncertified"))
    assert "/ccd/shells" not in viewer.drawn
    solver.reset(state)
    solver.step(solver.model.state(), state, None, None, 1e-6)  # nothing touches
    report.draw(viewer)
    assert viewer.drawn["/ccd/impulses"] is None and viewer.drawn["/ccd/normals"] is None


def test_minimum_distances_are_shells(device):
    builder = newton.ModelBuilder()
    add_patch(builder, 3, 0.05, (0.0, 0.0, 0.5))
    builder.add_particle(wp.vec3(0.0, 0.0, 1.0), wp.vec3(), 0.01)
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(Changed(model), min_distance=0.01, particle_radius=0.002, report=["contacts"])
    viewer = Recorder(model)
    solver.report.draw(viewer)
    points, faces, opacity = viewer.drawn["/ccd/shells"]
    cloth = np.arange(model.particle_count - 1)
    np.testing.assert_allclose(points[cloth, 2], 0.507, atol=1e-6)
    np.testing.assert_allclose(points[model.particle_count + cloth, 2], 0.493, atol=1e-6)
    assert len(faces) == 2 * model.tri_count and 0.0 < opacity < 1.0
    centres, scales = viewer.drawn["/ccd/shells_of_points"]
    np.testing.assert_allclose(centres, [[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(scales, 0.007, rtol=1e-6)


def squeezed(device, times=1):
    """Steps cloth between plates that in the end leave it no space; returns the stage and its warnings."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.05)
    for i in range(builder.particle_count):
        builder.particle_qd[i] = wp.vec3(0.0, 0.0, 3.0 * (-1.0) ** i)
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(Changed(model), max_iterations=0, report=["contacts"])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(times):
            state, end = model.state(), model.state()
            solver.reset(state)
            for i in range(6):
                place_plates(state, 0.05 - 0.01 * i)
                solver.step(state, end, None, None, DT)
                assert solver.report.totals.steps  # a read waits for a GPU, and warns
                state, end = end, state
    return solver, [str(warning.message) for warning in said if "not certified" in str(warning.message)]


def test_vertices_are_drawn_by_what_became_of_them(device):
    solver, _ = squeezed(device)
    report, viewer = solver.report, Recorder(solver.model)
    report.draw(viewer)
    for name in ("truncated", "frozen"):
        points = viewer.drawn[f"/ccd/{name}"]
        assert (0 if points is None else len(points)) == getattr(report, name)
    assert report.frozen + report.truncated > 0
    x, uncertified = solver.work.vertices.x1.numpy(), report.uncertified_vertices
    drawn = {tuple(point) for point in viewer.drawn["/ccd/uncertified"]}
    assert len(uncertified) and {tuple(x[i]) for i in uncertified} < drawn  # and vertices of the plates


def test_the_first_step_that_is_not_certified_is_named_once(device):
    solver, said = squeezed(device, times=2)
    assert solver.report.totals.uncertified_steps > 1
    assert len(said) == 1
    assert "particle " in said[0] and "shape 0 (" in said[0] and "report.draw(viewer)" in said[0]


def test_a_certified_step_warns_of_nothing(device):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver, _ = shot(device)
    assert solver.report.certified


def test_a_stage_that_keeps_no_contacts_says_so_where_it_is_drawn(device):
    solver, _ = shot(device)
    with pytest.warns(UserWarning, match=r'report=\["contacts"\]'):
        solver.report.draw(Recorder(solver.model))
    with pytest.raises(RuntimeError, match=r'report=\["contacts"\]'):
        solver.report.forces.table()
    monitor = bsc.CollisionMonitor(Changed(solver.model))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        monitor.report.draw(Recorder(solver.model))


def test_table_by_shape(device):
    builder = newton.ModelBuilder()
    long = "a finger with a label that is far too long for a column"
    for label, x in (("scale", -0.3), (long, 0.3)):
        place = wp.transform(wp.vec3(x, 0.0, -0.1), wp.quat_identity())
        builder.add_shape_box(-1, xform=place, hx=0.2, hy=0.2, hz=0.1, label=label)
        add_patch(builder, 4, 0.05, (x, 0.0, 0.001))
    builder.color()
    model = builder.finalize(device=device)
    solver = bsc.SolverCCD(SOLVERS["xpbd"](model), report=["contacts"])
    state, end = model.state(), model.state()
    solver.step(state, end, None, None, 1e-6)
    assert solver.report.forces.table().splitlines()[1] == "no contact had an impulse"
    for _ in range(12):
        solver.step(state, end, None, None, DT)
        state, end = end, state
    contacts, table = solver.report.forces.contacts.numpy(), solver.report.forces.table(DT)
    lines = table.splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) == 4
    assert "[N]" in lines[0] and "[N s]" in solver.report.forces.table()
    rows = {line[:36].strip(): line[36:].split() for line in lines[1:]}
    assert rows.keys() == {"particles", "scale", "..." + long[-33:]}
    count, normal, tangential = rows["particles"]
    assert int(count) == len(contacts["kind"])
    assert float(normal) == pytest.approx(contacts["normal_impulse"].sum() / DT, rel=1e-3)
    friction = np.linalg.norm(contacts["tangential_impulse"], axis=1).sum() / DT
    assert float(tangential) == pytest.approx(friction, rel=1e-3)
    of_scale = (contacts["shapes"] == 0).any(axis=1)
    assert float(rows["scale"][1]) == pytest.approx(contacts["normal_impulse"][of_scale].sum() / DT, rel=1e-3)


def test_usd_has_what_is_drawn(device, tmp_path):
    """A layer of Newton's viewer: impulses in the frame in which there are some, and none in the next."""
    solver, state = shot(device, report=["contacts"], min_distance=1e-3)
    path = tmp_path / "contacts.usda"
    viewer = ViewerUSD(str(path), fps=60, num_frames=2)
    viewer.set_model(solver.model)
    count = len(solver.report.forces.contacts.numpy()["point"])
    for frame in range(2):
        viewer.begin_frame(frame / 60)
        viewer.log_state(state)
        solver.report.draw(viewer)
        viewer.end_frame()
        solver.reset(state)
        solver.step(solver.model.state(), state, None, None, 1e-6)
    viewer.close()
    stage = Usd.Stage.Open(str(path))
    found = {prim.GetName(): prim for prim in stage.Traverse()}
    impulses = UsdGeom.PointInstancer(found["impulses"])
    assert len(impulses.GetPositionsAttr().Get(0)) == count > 10
    assert [impulses.GetVisibilityAttr().Get(frame) for frame in range(2)] == ["inherited", "invisible"]
    assert len(UsdGeom.Mesh(found["shells"]).GetPointsAttr().Get(0)) == 2 * solver.mesh.vertex_count
