"""Particles that are inside solids: boxes, polyhedra and tetrahedra of which a closed form says who is inside."""

import newton
import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, Changed, Rollout, add_patch, add_plates, place_plates

import warp_bsc as bsc
from warp_bsc.response.report.inside import InsideFinder
from warp_bsc.response.state.mesh import ModelMesh

TURN = wp.quat_from_axis_angle(wp.normalize(wp.vec3(0.3, 1.0, 0.1)), 0.7)


def add_particles(builder, points, **options):
    for point in points:
        builder.add_particle(wp.vec3(*point), wp.vec3(), options.get("mass", 1.0), radius=0.0)


def add_soft_box(builder, n, side, corner):
    """A soft body in the shape of a cube, with inner particles."""
    cell = {f"{name}_{axis}": value for axis in "xyz" for name, value in (("dim", n), ("cell", side / n))}
    material = {"density": 1.0, "k_mu": 1.0, "k_lambda": 1.0, "k_damp": 0.0}
    builder.add_soft_grid(pos=wp.vec3(*corner), rot=wp.quat_identity(), vel=wp.vec3(), **cell, **material)


def add_box(builder, half, at=(0.0, 0.0, 0.0), turn=None, body=-1):
    turn = wp.quat_identity() if turn is None else turn
    builder.add_shape_box(body, xform=wp.transform(wp.vec3(*at), turn), hx=half, hy=half, hz=half)


def find(builder, device, change=None):
    """Rows of a particle, a shape and a soft body; ``change`` moves the vertices before."""
    model = builder.finalize(device=device)
    mesh = ModelMesh(model)
    x = wp.zeros(mesh.vertex_count, dtype=wp.vec3, device=device)
    mesh.positions(model.particle_q, model.body_q if model.body_count else None, x)
    if change is not None:
        moved = x.numpy()
        change(moved)
        x.assign(moved)
    planes = np.column_stack([mesh.planes.normal, (mesh.planes.normal * mesh.planes.point).sum(axis=1)])
    inside = InsideFinder(mesh).find(x, planes.astype(np.float64))
    arrays = inside.particles, inside.shapes, inside.soft_bodies
    assert all(array.dtype == np.int32 and array.shape == (len(inside),) for array in arrays)
    return list(zip(*(array.tolist() for array in arrays), strict=True))


def test_a_sheet_wholly_in_a_box_and_one_outside(device):
    builder = newton.ModelBuilder()
    add_box(builder, 0.1, at=(5.0, 0.0, 0.0))
    add_box(builder, 0.5)
    add_patch(builder, 4, 0.1, (0.0, 0.0, 0.1))
    add_patch(builder, 4, 0.1, (0.0, 0.0, 0.6))
    assert find(builder, device) == [(particle, 1, -1) for particle in range(25)]


@pytest.mark.parametrize("add", ["add_shape_sphere", "add_shape_capsule", "add_shape_cone"])
def test_a_sheet_partly_in_a_round_shape(add, device):
    """The polyhedron is convex: a particle is inside if it is behind the planes of all faces."""
    builder = newton.ModelBuilder()
    getattr(builder, add)(-1, xform=wp.transform(wp.vec3(0.02, 0.01, 0.0), TURN), radius=0.2)
    add_patch(builder, 12, 0.05, (0.0, 0.0, 0.03))
    mesh = ModelMesh(builder.finalize(device="cpu"))
    x = np.concatenate([builder.particle_q, mesh.shape_vertices.position]).astype(np.float32).astype(float)
    faces = mesh.faces[mesh.faces[:, 0] >= builder.particle_count]
    a, b, c = x[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    depth = np.einsum("fi,pfi->pf", normal, x[: builder.particle_count, None] - a) / np.linalg.norm(normal, axis=1)
    assert np.abs(depth.max(axis=1)).min() > 1e-5  # far from rounding
    (expected,) = np.nonzero((depth < 0.0).all(axis=1))
    assert 10 < len(expected) < builder.particle_count
    assert find(builder, device) == [(particle, 0, -1) for particle in expected.tolist()]


def test_touching_is_not_inside(device):
    """On a face, an edge and a corner, an ulp outside, and an ulp inside, where rays run along faces and edges."""
    below, above = np.nextafter(np.float32([1.0, 1.0]), np.float32([0.0, 2.0]))
    builder = newton.ModelBuilder()
    add_box(builder, 1.0)
    points = [(1.0, 0.2, 0.3), (1.0, 1.0, 0.3), (1.0, 1.0, 1.0), (-1.0, 1.0, -1.0), (above, 0.0, 0.0), (-2.0, 1.0, 1.0)]
    points += [(below, 0.2, 0.3), (below, below, below), (0.0, 0.0, 0.0), (-below, 0.0, below)]
    add_particles(builder, points)
    assert find(builder, device) == [(particle, 0, -1) for particle in (6, 7, 8, 9)]


def test_particles_and_soft_bodies_in_a_soft_body(device):
    builder = newton.ModelBuilder()
    add_soft_box(builder, 3, 0.9, (0.0, 0.0, 0.0))
    small = builder.particle_count
    add_soft_box(builder, 2, 0.2, (0.8, 0.3, 0.3))  # those of 27 particles with x = 0.8 are in the other one
    lone = builder.particle_count
    add_particles(builder, [(0.45, 0.4, 0.31), (0.0, 0.4, 0.3), (0.85, 0.35, 0.35), (2.0, 0.4, 0.3)])
    of_small = [small + i for i, (x, _, _) in enumerate(builder.particle_q[small:lone]) if x < 0.85]
    assert len(of_small) == 9
    expected = [(particle, -1, 0) for particle in (*of_small, lone, lone + 2)] + [(lone + 2, -1, small)]
    assert find(builder, device) == sorted(expected)


def test_a_soft_body_where_it_is_now(device):
    """Bent and twisted, a soft body holds the points of its tetrahedra."""
    random = np.random.default_rng(4)
    builder = newton.ModelBuilder()
    add_soft_box(builder, 3, 1.0, (0.0, 0.0, 0.0))
    count = builder.particle_count
    add_particles(builder, np.zeros((300, 3)))
    rest = np.array(builder.particle_q[:count])
    z = rest[:, 2]
    moved = np.column_stack([rest[:, 0] + 0.4 * z * z, rest[:, 1] * (1.0 + 0.3 * z), z - 0.2 * rest[:, 0]])
    moved = (moved + random.uniform(-0.03, 0.03, moved.shape)).astype(np.float32)
    points = random.uniform(moved.min(axis=0), moved.max(axis=0), (300, 3)).astype(np.float32)
    corners = moved[np.array(builder.tet_indices)].astype(float)
    matrix = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    assert (np.linalg.det(matrix) > 0.0).all()
    weights = np.einsum("tij,ptj->pti", np.linalg.inv(matrix), points[:, None] - corners[:, 0])
    least = np.minimum(weights.min(axis=2), 1.0 - weights.sum(axis=2)).max(axis=1)
    assert np.abs(least).min() > 1e-6
    (expected,) = np.nonzero(least > 0.0)
    assert 50 < len(expected) < 250

    def place(x):
        x[:] = np.concatenate([moved, points])

    assert find(builder, device, place) == [(count + particle, -1, 0) for particle in expected.tolist()]


def test_a_hollow_soft_body_and_a_sheet_on_it(device):
    """What is in the cavity is outside, and cloth on the surface, which shares its particles, closes nothing else."""
    builder = newton.ModelBuilder()
    add_soft_box(builder, 3, 3.0, (0.0, 0.0, 0.0))
    center = np.array([1.5, 1.5, 1.5])
    particles = np.array(builder.particle_q)
    kept = [tuple(tet) for tet in builder.tet_indices if not (np.abs(particles[list(tet)] - center) <= 0.5).all()]
    walls = newton.ModelBuilder()
    add_particles(walls, particles)
    for tet in kept:
        walls.add_tetrahedron(*tet)
    assert len(kept) == len(builder.tet_indices) - 5
    add_particles(walls, [(1.5, 1.5, 1.5), (0.5, 1.5, 1.5), (3.5, 0.5, 0.5)])
    lone, corner = len(particles), int(np.argmin(particles @ [-1.0, 1.0, 1.0]))
    for i, j in ((corner, corner + 4), (corner + 4, corner + 16)):
        walls.add_triangle(i, j, lone + 2)
    assert find(walls, device) == [(lone + 1, -1, 0)]


def test_open_shapes_and_closed_cloth_hold_nothing(device):
    builder = newton.ModelBuilder()
    cube = newton.Mesh.create_box(1.0, 1.0, 1.0, compute_inertia=False)
    builder.add_shape_mesh(-1, mesh=newton.Mesh(cube.vertices, cube.indices[3:], compute_inertia=False))
    builder.add_shape_plane(-1, width=4.0, length=4.0, xform=wp.transform(wp.vec3(0.0, 0.0, 2.0), wp.quat_identity()))
    add_particles(builder, [(0.1, 0.2, 0.3), (-2.0, -2.0, -2.0), (2.0, -2.0, -2.0), (0.0, 2.0, -2.0), (0.0, 0.0, 3.0)])
    for i, j, k in ((1, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)):
        builder.add_triangle(i, j, k)
    assert find(builder, device) == []


def test_below_planes(device):
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.add_shape_plane(plane=(1.0, 0.0, 0.0, 1.0), width=0.0, length=0.0)  # x >= -1
    add_particles(builder, [(0.0, 0.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, -1e-6), (-2.0, 0.0, -1.0), (-2.0, 0.0, 1.0)])
    add_particles(builder, [(0.0, 0.0, -1.0)], mass=0.0)  # pinned
    assert find(builder, device) == [(2, 0, -1), (3, 0, -1), (3, 1, -1), (4, 1, -1)]


def test_worlds_hold_only_their_own(device):
    """A global box and a global plane hold particles of both worlds; each world's soft body and box hold its own."""
    builder = newton.ModelBuilder()
    add_box(builder, 0.5)
    builder.add_ground_plane(height=-1.0)
    for inner, outer in (((0.0, 0.0, 0.0), (2.0, 0.0, 0.0)), ((2.0, 0.0, 0.0), (4.0, 0.0, 0.0))):
        world = newton.ModelBuilder()
        add_particles(world, [inner, (2.0, 0.0, 0.0), (4.0, 0.0, 0.0), (9.0, 0.0, -2.0), (7.5, 0.5, 0.5)])
        add_box(world, 0.3, at=outer)
        if inner[0] > 0.0:
            add_soft_box(world, 1, 2.0, (7.0, -0.5, -0.5))
        builder.add_world(world)
    first = [(0, 0, -1), (1, 2, -1), (3, 1, -1)]
    second = [(7, 3, -1), (8, 1, -1), (9, -1, 10)]
    assert find(builder, device) == first + second


def test_pairs_that_nothing_can_move_are_left_out(device):
    """A pinned particle is inside a body and a soft body that can move, but not in a static shape or a pinned body."""
    builder = newton.ModelBuilder()
    add_box(builder, 0.5)
    bodies = [builder.add_body(mass=1.0, inertia=wp.mat33(np.eye(3)), is_kinematic=kinematic) for kinematic in (0, 1)]
    for body in bodies:
        add_box(builder, 0.4, body=body)
    add_soft_box(builder, 1, 0.2, (-0.1, -0.1, -0.1))
    add_particles(builder, [(0.02, 0.01, 0.03)], mass=0.0)
    add_particles(builder, [(0.02, 0.01, 0.03)])
    of_soft = [(particle, shape, -1) for particle in range(8) for shape in range(3)]
    expected = [*of_soft, (8, -1, 0), (8, 1, -1), (9, -1, 0), *((9, shape, -1) for shape in range(3))]
    assert find(builder, device) == expected
    for particle in range(8):
        builder.particle_mass[particle] = 0.0
    builder.particle_flags[9] = 0
    assert find(builder, device) == [(particle, 1, -1) for particle in range(9)]


def test_positions_that_are_not_finite(device):
    """They are in nothing, and what has one holds nothing."""
    builder = newton.ModelBuilder()
    builder.add_ground_plane(height=10.0)
    add_soft_box(builder, 1, 1.0, (0.0, 0.0, 0.0))
    lone = builder.particle_count
    add_box(builder, 0.5, at=(0.5, 0.5, 0.5))
    add_particles(builder, [(0.3, 0.4, 0.5), (0.3, 0.4, 0.5)])

    def break_soft_body(x):
        x[[0, lone + 1], [0, 1]] = np.nan, np.inf

    under = [(particle, 0, -1) for particle in range(1, lone)]
    assert find(builder, device, break_soft_body) == [*under, (lone, 0, -1), (lone, 1, -1)]


def test_models_without_solids_or_particles(device):
    builder = newton.ModelBuilder()
    assert find(builder, device) == []
    add_particles(builder, [(0.0, 0.0, 0.0)])
    assert find(builder, device) == []
    builder = newton.ModelBuilder()
    add_box(builder, 1.0)
    assert find(builder, device) == []


def test_wrong_shapes(device):
    builder = newton.ModelBuilder()
    add_particles(builder, [(0.0, 0.0, 0.0)])
    finder = InsideFinder(ModelMesh(builder.finalize(device=device)))
    with pytest.raises(ValueError, match=r"x must have shape \(1, 3\), not \(2, 3\)"):
        finder.find(np.zeros((2, 3)), np.zeros((0, 4)))
    with pytest.raises(ValueError, match=r"planes must have shape \(0, 4\), not \(1, 4\)"):
        finder.find(np.zeros((1, 3)), np.zeros((1, 4)))


def test_the_report_names_what_solids_have_swallowed(device):
    """Plates that close on cloth take it in: one step is not certified, the later ones are, and cross nothing."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_plates(builder, 0.03)
    builder.color()
    model = builder.finalize(device=device)
    gaps = iter([0.03, -0.04, -0.04, -0.04])
    rollout = Rollout(model, bsc.SolverCCD(Changed(model, lambda state: place_plates(state, next(gaps)))))
    report = rollout.solver.report
    certified, inside = [], []
    for _ in range(4):
        rollout.step(DT)
        certified.append(report.certified)
        inside.append(set(report.inside.particles.tolist()))
        penetrated = report.penetrated
        assert (penetrated.inside, penetrated.passed) == (len(inside[-1]), report.remaining)
        assert bool(penetrated) == (len(certified) > 1) and penetrated.steps == min(len(certified) - 1, 1)
        assert (f"{len(inside[-1])} particles inside solids" in str(report)) == (len(certified) > 1)
    everything = set(range(model.particle_count))
    assert certified == [True, False, True, True] and report.totals.uncertified_steps == 1
    assert inside == [set(), everything, everything, everything] and report.crossings == 0
    assert report.totals.remaining > 0 and f"{report.totals.remaining} remained" in str(report)
    assert set(report.inside.shapes.tolist()) == {0, 1} and (report.inside.soft_bodies == -1).all()
