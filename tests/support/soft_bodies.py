"""Blocks of tetrahedra in shots, as volume deformables are, and what their repair leaves, by the exact checker."""

import numpy as np
from pxr import Gf, Usd, UsdGeom
from usd_stages import add_mesh, add_tets, new_stage

from warp_bsc import checker

CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
CUBE_SIDES = [0, 3, 2, 1, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]


def as_tuples(points):
    return [tuple(map(float, point)) for point in points]


def block(cells, size):
    """Points of a block of cubes of a size, and the tetrahedra that they consist of, five each."""
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    cube = np.stack(np.meshgrid(*3 * [np.arange(2)], indexing="ij"), axis=-1).reshape(-1, 3)
    corner = grid[(grid < cells).all(axis=1)]
    numbers = (corner[:, None] + cube) @ [(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1]
    numbers = np.where(corner.sum(axis=1, keepdims=True) % 2, numbers[:, [1, 0, 3, 2, 5, 4, 7, 6]], numbers)
    tets = numbers[:, [(0, 1, 2, 4), (1, 2, 4, 7), (1, 2, 3, 7), (1, 4, 5, 7), (2, 4, 6, 7)]].reshape(-1, 4)
    is_inverted = np.linalg.det(grid[tets[:, 1:]] - grid[tets[:, :1]]) < 0
    tets[is_inverted] = tets[is_inverted][:, [1, 0, 2, 3]]
    return grid * size, tets


def pressed_bar(path, frames=12, depth=0.25, cells=(5, 2, 2), transform=None, surface=False):
    """A bar of cells of 0.2 that waves, a box that comes down into it and leaves, and a transform of the bar."""
    stage = new_stage(path)
    points, tets = block(cells, 0.2)
    transform = np.eye(4) if transform is None else transform
    inverse = np.linalg.inv(transform)
    waves = [points + np.outer(0.02 * np.sin(0.4 * frame + points[:, 0]), [0, 0, 1]) for frame in range(frames)]
    own = {frame: as_tuples(x @ inverse[:3, :3] + inverse[3, :3]) for frame, x in enumerate(waves)}
    is_mirrored = np.linalg.det(transform) < 0  # volumes are positive in the space of the prim
    mesh = add_tets(stage, own, (tets[:, [1, 0, 2, 3]] if is_mirrored else tets).tolist(), path="/World/Bar")
    if surface:
        mesh.CreateSurfaceFaceVertexIndicesAttr(UsdGeom.TetMesh.ComputeSurfaceFaces(mesh, 0))
    mesh.AddTransformOp().Set(Gf.Matrix4d(transform))
    box = add_mesh(stage, "/World/Box", as_tuples(np.array(CUBE) * [0.3, 2, 1] + [0.43, -0.7, 0]), [4] * 6, CUBE_SIDES)
    lift = box.AddTranslateOp()
    for frame in range(frames):
        lift.Set((0.0, 0.0, 0.2 * cells[2] - depth + 0.1 * abs(frame - frames // 2)), frame)
    return stage


def motion_of(path, name="/World/Bar"):
    """Points of a TetMesh at each of its times, float64, and its tetrahedra."""
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.TetMesh(stage.GetPrimAtPath(name))
    attribute = mesh.GetPointsAttr()
    times = attribute.GetTimeSamples() or [Usd.TimeCode.Default()]
    return np.array([attribute.Get(time) for time in times]), np.array(mesh.GetTetVertexIndicesAttr().Get())


def inverting(x, tets):
    """Whether each tetrahedron inverts from each frame to the next, or is inverted in a single one, exactly."""
    ends = [(a, b) for a, b in zip(x, [*x[1:], x[-1]], strict=True)]
    return np.array([checker.tetrahedron(np.concatenate([a[tets], b[tets]], axis=1)) for a, b in ends])


def inner_vertices(tets):
    """The vertices that no face of a single tetrahedron has."""
    faces = np.sort(tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    faces, counts = np.unique(faces, axis=0, return_counts=True)
    return np.setdiff1d(tets, faces[counts == 1])
