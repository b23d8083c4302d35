"""The collision mesh of a Newton model: shapes cut into triangles, surfaces, worlds, positions, inverse masses."""

from collections import Counter

import newton
import numpy as np
import pytest
import trimesh
import warp as wp

import warp_bsc as bsc
from warp_bsc.response.state import mesh as model_mesh
from warp_bsc.response.state.mesh import ModelMesh

BOX = newton.Mesh.create_box(1.0, 1.0, 1.0)  # with the vertices of each side for itself

SHAPES = {  # how to add it, half of its bounding box, its volume
    "box": ("box", {"hx": 0.2, "hy": 0.3, "hz": 0.4}, (0.2, 0.3, 0.4), 0.192),
    "sphere": ("sphere", {"radius": 0.3}, (0.3, 0.3, 0.3), 4 / 3 * np.pi * 0.027),
    "ellipsoid": ("ellipsoid", {"rx": 0.2, "ry": 0.3, "rz": 0.4}, (0.2, 0.3, 0.4), 4 / 3 * np.pi * 0.024),
    "capsule": (
        "capsule",
        {"radius": 0.2, "half_height": 0.3},
        (0.2, 0.2, 0.5),
        np.pi * (0.04 * 0.6 + 4 / 3 * 0.008),
    ),
    "capsule without height": (
        "capsule",
        {"radius": 0.2, "half_height": 0.0},
        (0.2, 0.2, 0.2),
        4 / 3 * np.pi * 0.008,
    ),
    "cylinder": ("cylinder", {"radius": 0.2, "half_height": 0.3}, (0.2, 0.2, 0.3), np.pi * 0.04 * 0.6),
    "barrel": (  # its side is half a circle: the axis is 0.2 from the circle's centre
        "cylinder",
        {"radius": 0.2, "half_height": 0.3, "barrel_radius": 0.3},
        (0.5, 0.5, 0.3),
        np.pi * (0.04 * 0.6 + 0.2 * np.pi * 0.09 + 4 / 3 * 0.027),
    ),
    "cone": ("cone", {"radius": 0.2, "half_height": 0.3}, (0.2, 0.2, 0.3), np.pi * 0.04 * 0.6 / 3),
    "mesh": ("mesh", {"mesh": BOX, "scale": (0.2, 0.3, 0.4)}, (0.2, 0.3, 0.4), 0.192),
    "mirrored mesh": ("mesh", {"mesh": BOX, "scale": (-0.2, 0.3, 0.4)}, (0.2, 0.3, 0.4), -0.192),
    "convex mesh": ("convex_hull", {"mesh": BOX, "scale": (0.2, 0.3, 0.4)}, (0.2, 0.3, 0.4), 0.192),
}


def pose(x, y, z, axis=(0.0, 0.0, 1.0), angle=0.0):
    return wp.transform(wp.vec3(x, y, z), wp.quat_from_axis_angle(wp.normalize(wp.vec3(*axis)), angle))


def matrix(transform):
    """The 4 x 4 matrix of a transform, without Warp."""
    x, y, z, i, j, k, w = map(float, transform)
    result = trimesh.transformations.quaternion_matrix((w, i, j, k))
    result[:3, 3] = x, y, z
    return result


def apply(transform, points):
    return trimesh.transform_points(points, matrix(transform))


def positions(mesh, particle_q, body_q):
    out = wp.empty(mesh.vertex_count, dtype=wp.vec3)
    mesh.positions(particle_q, body_q, out)
    return out.numpy()


def add_cloth(builder, height=0.0, **options):
    """A sheet of 2 x 2 quads of 10 cm: 9 particles, 8 triangles."""
    builder.add_cloth_grid(
        pos=wp.vec3(0.0, 0.0, height),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        dim_x=2,
        dim_y=2,
        cell_x=0.1,
        cell_y=0.1,
        mass=0.5,
        **options,
    )


def add_soft_body(builder):
    builder.add_soft_grid(
        pos=wp.vec3(0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0),
        dim_x=3,
        dim_y=2,
        dim_z=1,
        cell_x=0.1,
        cell_y=0.1,
        cell_z=0.1,
        density=100.0,
        k_mu=1.0,
        k_lambda=1.0,
        k_damp=0.0,
    )


def surface(tets):
    """The corners of every side that one tetrahedron has alone."""
    sides = Counter(frozenset(np.delete(tet, corner).tolist()) for tet in tets for corner in range(4))
    return {side for side, count in sides.items() if count == 1}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_and_where_they_are(name):
    kind, options, half, volume = SHAPES[name]
    body_pose = pose(0.3, -0.2, 0.1, (1.0, 2.0, 3.0), 0.7)
    shape_pose = pose(-0.1, 0.4, 0.2, (-1.0, 1.0, 0.5), 1.9)
    builder = newton.ModelBuilder()
    builder.default_shape_cfg.density = 0.0
    builder.add_body()
    body = builder.add_body()
    getattr(builder, f"add_shape_{kind}")(body, xform=shape_pose, **options)
    model = builder.finalize()
    mesh = ModelMesh(model)

    local = mesh.shape_vertices.position
    in_shape = trimesh.transform_points(local, np.linalg.inv(matrix(shape_pose)))
    solid = trimesh.Trimesh(in_shape, mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert len(np.unique(local, axis=0)) == len(local) == mesh.vertex_count
    assert solid.volume == pytest.approx(volume, rel=0.02)
    np.testing.assert_allclose(solid.bounds * [[-1.0], [1.0]], [half, half], atol=1e-6)
    if kind == "cone":
        tip = in_shape[np.abs(in_shape[:, 2] - 0.3) < 1e-6]
        np.testing.assert_allclose(tip, [[0.0, 0.0, 0.3]], atol=1e-6)
    else:
        np.testing.assert_allclose(in_shape.mean(axis=0), 0.0, atol=1e-6)

    assert (mesh.shape_vertices.body == body).all()
    body_q = wp.array([pose(9.0, 9.0, 9.0), body_pose], dtype=wp.transform)
    np.testing.assert_allclose(positions(mesh, None, body_q), apply(body_pose, local), atol=1e-6)


def test_small_and_large_shapes_are_closed():
    builder = newton.ModelBuilder()
    for radius in (1e-5, 1e5):
        builder.add_shape_sphere(-1, radius=radius)
    mesh = ModelMesh(builder.finalize())
    assert trimesh.Trimesh(mesh.shape_vertices.position, mesh.faces, process=False).is_watertight
    assert len(mesh.faces) == 2 * (2 * 32 + 2 * 14 * 32)  # two fans and 14 bands each


@pytest.mark.parametrize("segments", [4, 16, 32, 96])
@pytest.mark.parametrize("name", ["sphere", "ellipsoid", "capsule", "cylinder", "barrel", "cone"])
def test_round_shapes_have_their_segments_and_vertices_on_the_surface(name, segments):
    kind, options, _, volume = SHAPES[name]
    builder = newton.ModelBuilder()
    getattr(builder, f"add_shape_{kind}")(-1, **options)
    mesh = ModelMesh(builder.finalize(), segments=segments)
    x = mesh.shape_vertices.position.astype(float)
    solid = trimesh.Trimesh(x, mesh.faces, process=False)
    assert mesh.segments == segments and solid.is_watertight and solid.is_winding_consistent
    half = segments // 2
    rings = {"sphere": half - 1, "ellipsoid": half - 1, "capsule": half, "cylinder": 2, "barrel": half + 1, "cone": 1}
    assert len(x) == 2 + rings[name] * segments
    assert 0.0 < volume - solid.volume < 20.0 / segments**2 * volume
    r, z = np.hypot(x[:, 0], x[:, 1]), np.abs(x[:, 2])
    if name == "sphere":
        off = np.linalg.norm(x, axis=1) - 0.3
    elif name == "ellipsoid":
        off = np.linalg.norm(x / [0.2, 0.3, 0.4], axis=1) - 1.0
    elif name == "capsule":
        off = np.hypot(r, np.maximum(z - 0.3, 0.0)) - 0.2
    elif name == "cylinder":
        off = np.where(r > 0.0, r - 0.2, z - 0.3)
    elif name == "barrel":
        off = np.where(r > 0.0, np.hypot(r - 0.2, z) - 0.3, z - 0.3)
    else:
        off = np.where(r > 0.0, r - 0.2, z - 0.3)
    np.testing.assert_allclose(off, 0.0, atol=1e-6)


def test_segments_are_checked():
    model = newton.ModelBuilder().finalize()
    with pytest.raises(ValueError, match="segments must be a multiple of four, not 30"):
        ModelMesh(model, segments=30)
    with pytest.raises(ValueError, match="segments"):
        ModelMesh(model, segments=0)
    with pytest.raises(TypeError, match="segments"):
        ModelMesh(model, segments=32.0)


def test_equal_shapes_are_tessellated_once(monkeypatch):
    calls = []
    tessellate = model_mesh.tessellate
    monkeypatch.setattr(model_mesh, "tessellate", lambda *given: calls.append(given) or tessellate(*given))
    builder = newton.ModelBuilder()
    for x, radius in ((0.0, 0.5), (2.0, 0.5), (4.0, 0.25)):
        builder.add_shape_sphere(-1, xform=pose(x, 0.0, 0.0), radius=radius)
    for mesh, scale in ((BOX, 1.0), (BOX, 1.0), (BOX.copy(), 1.0), (BOX, 2.0)):
        builder.add_shape_mesh(-1, mesh=mesh, scale=(scale, scale, scale))
    mesh = ModelMesh(builder.finalize())
    assert len(calls) == 1 + 2  # whatever their scale
    vertices = mesh.shape_vertices
    np.testing.assert_array_equal(np.unique(vertices.shape), np.arange(7))
    first, second = (vertices.position[vertices.shape == shape] for shape in (0, 1))
    np.testing.assert_allclose(second, first + np.array([2.0, 0.0, 0.0]), atol=1e-6)


def test_particles_keep_every_bit_and_static_shapes_stay():
    builder = newton.ModelBuilder()
    add_cloth(builder)
    builder.add_shape_box(-1, xform=pose(1.0, 2.0, 3.0), hx=0.5, hy=0.5, hz=0.5)
    model = builder.finalize()
    mesh = ModelMesh(model)
    np.testing.assert_array_equal(mesh.faces[:8], model.tri_indices.numpy())
    assert mesh.vertex_count == 9 + 8
    particles = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    particles[0] = (-0.0, 1e-42, np.inf)
    state = model.state()
    state.particle_q.assign(particles)
    assert state.body_q is None
    written = positions(mesh, state.particle_q, state.body_q)
    np.testing.assert_array_equal(written[:9].view(np.uint32), particles.view(np.uint32))
    np.testing.assert_array_equal(written[9:], mesh.shape_vertices.position)
    np.testing.assert_allclose(written[9:].mean(axis=0), (1.0, 2.0, 3.0), atol=1e-6)
    np.testing.assert_array_equal(mesh.device_shape_vertices.position.numpy(), written[9:])
    assert mesh.shape_vertices.body.tolist() == [-1] * 8


def test_positions_in_a_graph(device):
    if not device.is_cuda:
        pytest.skip("CUDA graphs need a GPU")
    builder = newton.ModelBuilder()
    add_cloth(builder)
    builder.add_shape_sphere(builder.add_body())
    model = builder.finalize()
    mesh, state = ModelMesh(model), model.state()
    out = wp.zeros(mesh.vertex_count, dtype=wp.vec3)
    with wp.ScopedCapture() as capture:
        mesh.positions(state.particle_q, state.body_q, out)
        mesh.refresh_inverse_masses()
    state.particle_q.fill_(1.0)
    state.body_q.assign([pose(3.0, 0.0, 0.0)])
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(out.numpy(), positions(mesh, state.particle_q, state.body_q))
    assert (out.numpy()[:9] == 1.0).all()


def test_positions_of_another_length_are_refused():
    builder = newton.ModelBuilder()
    add_cloth(builder)
    builder.add_shape_sphere(builder.add_body())
    model = builder.finalize()
    mesh, state = ModelMesh(model), model.state()
    out = wp.empty(mesh.vertex_count, dtype=wp.vec3)
    for given in (
        (state.particle_q[:-1], state.body_q, out),
        (state.particle_q, None, out),
        (state.particle_q, state.body_q, out[:-1]),
    ):
        with pytest.raises(ValueError, match="must have length"):
            mesh.positions(*given)


def test_soft_bodies_have_each_surface_triangle_once():
    builder = newton.ModelBuilder()
    add_soft_body(builder)
    model = builder.finalize()
    tets = model.tet_indices.numpy()
    mesh = ModelMesh(model)
    found = [frozenset(face) for face in mesh.faces.tolist()]
    assert len(found) == len(set(found)) == 2 * 2 * (3 * 2 + 3 * 1 + 2 * 1)
    assert set(found) == surface(tets)


def test_surfaces_that_the_model_has_no_triangles_for():
    builder = newton.ModelBuilder()
    add_cloth(builder, height=1.0)
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)]
    for corner in corners:
        builder.add_particle(wp.vec3(*corner), wp.vec3(0.0), 1.0)
    builder.add_tetrahedron(9, 10, 11, 12)
    builder.add_tetrahedron(10, 13, 11, 12)
    builder.add_triangle(12, 9, 10)
    model = builder.finalize()
    mesh = ModelMesh(model)
    np.testing.assert_array_equal(mesh.faces[:9], model.tri_indices.numpy())
    assert len(mesh.faces) == 8 + 6
    assert {frozenset(face) for face in mesh.faces[8:].tolist()} == surface(model.tet_indices.numpy())
    centre = np.mean(corners, axis=0)
    for a, b, c in model.particle_q.numpy()[mesh.faces[9:]]:
        assert np.cross(b - a, c - a) @ (a - centre) > 0  # seen from outside


def test_what_does_not_collide_with_particles_is_left_out():
    builder = newton.ModelBuilder()
    add_cloth(builder)
    builder.add_shape_sphere(-1, cfg=newton.ModelBuilder.ShapeConfig(has_particle_collision=False))
    builder.add_shape_sphere(-1, as_site=True)
    builder.add_shape_heightfield(
        heightfield=newton.Heightfield(np.zeros((3, 3)), 3, 3),
        cfg=newton.ModelBuilder.ShapeConfig(has_particle_collision=False),
    )
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(has_particle_collision=False))
    box = builder.add_shape_box(-1, cfg=newton.ModelBuilder.ShapeConfig(has_shape_collision=False))
    mesh = ModelMesh(builder.finalize())
    assert mesh.shape_vertices.shape.tolist() == [box] * 8
    assert len(mesh.faces) == 8 + 12
    assert len(mesh.planes.shape) == 0


@pytest.mark.parametrize("shape_type", ["HFIELD", "NONE"])
def test_shapes_without_triangles_are_named(shape_type):
    builder = newton.ModelBuilder()
    builder.add_shape_box(-1)
    if shape_type == "HFIELD":
        builder.add_shape_heightfield(heightfield=newton.Heightfield(np.zeros((3, 3)), 3, 3), label="hill")
    else:
        builder.add_shape(body=-1, type=newton.GeoType.NONE, label="hill")
    with pytest.raises(NotImplementedError, match=rf"shape 1 \('hill'\) of type {shape_type} "):
        ModelMesh(builder.finalize())


def test_planes():
    builder = newton.ModelBuilder()
    body = builder.add_body()
    tilted = pose(0.5, 0.0, 0.0, (0.0, 1.0, 0.0), np.pi / 2)  # z to x
    ground = builder.add_ground_plane(height=0.3)
    wall = builder.add_shape_plane(xform=tilted, width=0.0, length=2.0, body=body)
    sheet = builder.add_shape_plane(xform=tilted, width=4.0, length=2.0, body=body)
    mesh = ModelMesh(builder.finalize())
    planes = mesh.planes
    assert planes.shape.tolist() == [ground, wall]
    assert planes.body.tolist() == [-1, body]
    assert planes.world.tolist() == [-1, -1]
    np.testing.assert_allclose(planes.point, [(0.0, 0.0, 0.3), (0.5, 0.0, 0.0)], atol=1e-6)
    np.testing.assert_allclose(planes.normal, [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)], atol=1e-6)
    for on_device, values in zip(mesh.device_planes, planes, strict=True):
        np.testing.assert_array_equal(on_device.numpy(), values)
    assert mesh.shape_vertices.shape.tolist() == [sheet] * 4
    corners = mesh.shape_vertices.position
    np.testing.assert_allclose(corners[:, 0], 0.5, atol=1e-6)
    np.testing.assert_allclose(corners.min(axis=0)[1:], (-1.0, -2.0), atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0)[1:], (1.0, 2.0), atol=1e-6)
    assert trimesh.Trimesh(corners, mesh.faces, process=False).area == pytest.approx(8.0)


def test_worlds():
    world = newton.ModelBuilder()
    add_cloth(world, height=1.0)
    world.add_shape_sphere(world.add_body(xform=pose(5.0, 0.0, 0.0)), radius=0.5)
    builder = newton.ModelBuilder()
    builder.add_ground_plane()
    builder.add_shape_box(-1, hx=1.0, hy=1.0, hz=0.5)
    builder.replicate(world, 2)
    model = builder.finalize()
    mesh = ModelMesh(model)
    start, end = model.state(), model.state()
    end.particle_q.assign(start.particle_q.numpy() - np.float32([0.0, 0.0, 0.75]))
    x0, x1 = (positions(mesh, state.particle_q, state.body_q) for state in (start, end))
    shapes, bodies = mesh.shape_vertices.shape, mesh.shape_vertices.body
    worlds = mesh.world[model.particle_count :]
    np.testing.assert_array_equal(mesh.world[: model.particle_count], np.repeat([0, 1], 9))
    assert worlds[shapes == 1].tolist() == [0] * 8 + [1] * 8
    for shape, body in ((2, 0), (3, 1)):
        assert (worlds[shapes == shape] == body).all()
        assert (bodies[shapes == shape] == body).all()
        sphere = x0[model.particle_count :][shapes == shape]
        np.testing.assert_allclose(np.linalg.norm(sphere - np.array([5.0, 0.0, 0.0]), axis=1), 0.5, atol=1e-6)
    assert mesh.planes.world.tolist() == [-1]
    np.testing.assert_array_equal(mesh.device_world.numpy(), mesh.world)

    # both sheets fall through the box that is in both worlds, each through its own
    found = bsc.CollisionDetector(mesh).detect(x0, x1).vertex_face
    vertices, faces = found[found[:, 0] < model.particle_count].T
    assert set(vertices.tolist()) == set(range(18))
    np.testing.assert_array_equal(mesh.world[vertices], mesh.world[mesh.faces[faces, 0]])


def test_one_world_takes_in_what_is_in_all():
    world = newton.ModelBuilder()
    add_cloth(world)
    builder = newton.ModelBuilder()
    add_cloth(builder, height=1.0)
    builder.add_shape_box(-1)
    builder.add_world(world)
    mesh = ModelMesh(builder.finalize())
    assert mesh.world is None
    assert mesh.device_world.numpy().tolist() == [0] * (9 + 9 + 8)


def test_particles_in_all_of_several_worlds_are_refused():
    world = newton.ModelBuilder()
    add_cloth(world)
    builder = newton.ModelBuilder()
    builder.replicate(world, 2)
    builder.add_particle((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
    with pytest.raises(NotImplementedError, match="particle 18 is in all of 2 worlds"):
        ModelMesh(builder.finalize())


def test_inverse_masses():
    builder = newton.ModelBuilder()
    add_cloth(builder, fix_left=True)
    builder.add_shape_box(builder.add_body())
    builder.particle_flags[1] &= ~newton.ParticleFlags.ACTIVE
    model = builder.finalize()
    kinematic = np.flatnonzero(model.particle_mass.numpy() == 0.0)
    assert 0 < len(kinematic) < 9 and 1 not in kinematic
    mesh = ModelMesh(model)
    expected = np.zeros(9 + 8, dtype=np.float32)
    expected[:9] = model.particle_inv_mass.numpy()
    np.testing.assert_array_equal(expected[kinematic], 0.0)
    expected[1] = 0.0
    assert (expected > 0.0).sum() == 8 - len(kinematic)
    np.testing.assert_array_equal(mesh.inverse_masses.numpy(), expected)

    flags = model.particle_flags.numpy()
    flags[[1, 2]] ^= newton.ParticleFlags.ACTIVE
    model.particle_flags.assign(flags)
    expected[1], expected[2] = model.particle_inv_mass.numpy()[1], 0.0
    mesh.refresh_inverse_masses()
    np.testing.assert_array_equal(mesh.inverse_masses.numpy(), expected)


def test_nothing_at_all():
    mesh = ModelMesh(newton.ModelBuilder().finalize())
    assert mesh.faces.shape == (0, 3)
    assert positions(mesh, None, None).shape == (0, 3)
