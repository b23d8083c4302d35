"""Example Crashing: the hollow body of a car, with a thin wall of tetrahedra, runs into a rigid wall.

    python examples/paper/example_crashing.py
    python examples/paper/example_crashing.py --triangles 1100000  # as in the paper, needs a GPU
    python examples/paper/example_crashing.py --no-ccd             # the car passes through the wall and itself

The fifth benchmark of the paper. The wall of the body, of a rubber that is too soft to stop it early, is one layer of
tetrahedra thick; hood, front and floor fold up onto each other, and the wheels are pressed into the body. Only the
collision stage stops the car and keeps its folds apart. The crash lasts a tenth of a second, in which gravity does not
matter.
"""

import math

import newton
import numpy as np
import warp as wp
from paper_scene import PaperScene, add_collider, main

LENGTH, HALF_WIDTH, FLOOR = 4.2, 0.86, 0.25  # m
ROOF = [(0.0, 0.68), (0.04, 0.78), (0.26, 0.88), (0.41, 1.36), (0.5, 1.4), (0.7, 1.38), (0.85, 0.98), (1.0, 0.92)]
"""Profile of the upper side of the body: position along it, from 0 to 1, and height [m]."""
BELT = 0.9  # m, above which the cabin is narrower
THICKNESS = 0.02  # m, of the wall of the body
WHEELS = [(0.19, 1.0), (0.19, -1.0), (0.8, 1.0), (0.8, -1.0)]  # where along the body, and on which side
WHEEL_RADIUS, WHEEL_WIDTH, WHEEL_HEIGHT = 0.31, 0.2, 0.31  # m
CLEARANCE = 0.04  # m, around the wheels
AREA = 25.4  # m^2, of the body without openings and the wheels
GAP = 0.01  # m, between the front and the wall at the start
SPEED = 18.0  # m/s
DENSITY, STIFFNESS, DAMPING = 1000.0, 2.0e6, 50.0  # kg/m^3, of both Lame parameters [Pa], and Pa s


class Example(PaperScene):
    """The scene, in the format of Newton's examples."""

    triangles = 14000
    num_frames = 60
    fps = 500
    sim_substeps = 8
    iterations = 5
    gravity = (0.0, 0.0, 0.0)
    camera = (wp.vec3(-2.0, -5.0, 2.2), -15.0, 65.0)

    def count_substeps(self, triangles):
        """Returns the steps per frame: sound should pass at most one cell a step, as contacts come after the solver."""
        sound = math.sqrt(3.0 * STIFFNESS / DENSITY)
        return max(self.sim_substeps, 2 * math.ceil(0.5 * self.frame_dt * sound / size_cell(triangles)))

    def build(self, builder, triangles):
        """Adds the wall, the body and the wheels."""
        # the wall is a box, whose front the car hits
        corners = np.array([[x, y, z] for x in (-0.3, 0.0) for y in (-1.4, 1.4) for z in (0.0, 1.8)])
        sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
        add_collider(builder, -1, corners, [*sides, [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], 0.3)

        cell = size_cell(triangles)
        add_shell(builder, *shell(count_cells((LENGTH, 2.0 * HALF_WIDTH, 1.0), cell), body_at, body_openings))
        wheel_cells = count_cells((0.5 * math.pi * WHEEL_RADIUS, WHEEL_WIDTH, 0.5 * math.pi * WHEEL_RADIUS), cell)
        vertices, tets = shell(wheel_cells, wheel_at)
        for along, side in WHEELS:
            centre = np.array([GAP + along * LENGTH, side * (HALF_WIDTH - 0.5 * WHEEL_WIDTH - 0.02), WHEEL_HEIGHT])
            add_shell(builder, vertices + centre, tets)

    def measure(self):
        """Returns how far the car is crushed."""
        q, rest = self.positions(), self.model.particle_q.numpy().astype(np.float64)
        corners = q[self.model.tet_indices.numpy()]
        volumes = np.linalg.det(corners[:, 1:] - corners[:, :1])
        rear = q[:, 0] > q[:, 0].max() - 0.5
        return {
            "length of the car over that before": np.ptp(q[:, 0]) / np.ptp(rest[:, 0]),
            "distance to the wall [m]": q[:, 0].min(),
            "speed of its rear [m/s]": -self.state_0.particle_qd.numpy()[rear, 0].mean(),
            "share of the tetrahedra that are inverted": (volumes <= 0.0).mean(),
        }

    def test_scene(self, measured):
        """Checks that the car is crushed in front of the wall."""
        length, distance, *_ = measured.values()
        assert length < 0.75, f"the car has {length:.1%} of its length"
        assert 0.0 < distance < 0.05, f"the car is {distance} m from the wall"


def size_cell(triangles):
    """Returns the width of a cell [m], which has two triangles outside and two inside."""
    return math.sqrt(4.0 * AREA / triangles)


def count_cells(lengths, cell):
    """Returns the number of cells of a width [m] along each side of a box, at least 2."""
    return [max(round(length / cell), 2) for length in lengths]


def shell(cells, at, openings=None):
    """Returns the wall of a hollow box, bent into a shape, as tetrahedra.

    Args:
        cells: Number of cells along each side of the box, shape [3].
        at: Function that bends the box: takes parameters in [-1, 1], shape [n, 3], and a depth below the surface [m],
            and returns positions [m].
        openings: Function that says where there is no wall: takes corners of cells [m], shape [n, 4, 3], and
            parameters of their centres, shape [n, 3].

    Returns:
        Positions [m], shape [n, 3], and tetrahedra, shape [m, 4].
    """
    cells = np.array(cells)
    quads = []
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        first, second = np.meshgrid(np.arange(cells[j]), np.arange(cells[k]), indexing="ij")
        for end in (0, cells[axis]):
            corner = np.zeros((first.size, 4, 3), dtype=int)
            corner[..., axis] = end
            corner[..., j] = first.reshape(-1, 1) + np.array([0, 1, 1, 0])
            corner[..., k] = second.reshape(-1, 1) + np.array([0, 0, 1, 1])
            quads.append(corner)
    corners, quads = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    quads = quads.reshape(-1, 4)
    parameters = 2.0 * corners / cells - 1.0
    outer, inner = at(parameters, 0.0), at(parameters, THICKNESS)
    if openings:
        quads = quads[~openings(outer[quads], parameters[quads].mean(axis=1))]
    # Prisms of two triangles each. With their corners in ascending order, neighbours cut common sides the same way.
    a, b, c = np.sort(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), axis=1).T
    d, e, f = len(outer) + a, len(outer) + b, len(outer) + c
    tets = np.stack([[a, b, c, f], [a, b, e, f], [a, d, e, f]]).transpose(0, 2, 1).reshape(-1, 4)
    used, tets = np.unique(tets, return_inverse=True)
    positions, tets = np.concatenate([outer, inner])[used], tets.reshape(-1, 4)
    sides = positions[tets[:, 1:]] - positions[tets[:, :1]]
    turned = np.linalg.det(sides) < 0.0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return positions, tets


def body_at(parameters, depth):
    """Returns positions on the body of the car, or ``depth`` [m] inside, see :func:`shell`."""
    u, v, w = np.moveaxis(parameters, -1, 0)
    u, v = (1.0 - 2.0 * depth / LENGTH) * u, (1.0 - depth / HALF_WIDTH) * v
    along = 0.5 * (u + 1.0)
    roof = np.interp(along, *np.transpose(ROOF))
    w = (1.0 - 2.0 * depth / (roof - FLOOR)) * w
    z = FLOOR + 0.5 * (w + 1.0) * (roof - FLOOR)
    narrow = (1.0 - 0.14 * np.abs(u) ** 5) * (
        1.0 - 0.5 * np.maximum(z - BELT, 0.0) ** 1.2 - 0.08 * np.maximum(0.45 - z, 0)
    )
    x = GAP + along * LENGTH + 0.12 * v**2 * (1.0 - along) ** 2 - 0.08 * v**2 * along**2
    return np.stack([x, HALF_WIDTH * v * narrow, z], axis=-1)


def body_openings(corners, centres):
    """Returns which cells are in windows or wheel arches."""
    along, v, w = 0.5 * (centres[:, 0] + 1.0), np.abs(centres[:, 1]), 0.5 * (centres[:, 2] + 1.0)
    side, top, bottom = v == 1.0, w == 1.0, w == 0.0
    cabin = ((along > 0.37) & (along < 0.54)) | ((along > 0.575) & (along < 0.74))
    windows = side & cabin & (w > 0.6) & (w < 0.92)
    screens = top & (v < 0.86) & (((along > 0.28) & (along < 0.4)) | ((along > 0.72) & (along < 0.83)))
    arches = np.zeros(len(centres), dtype=bool)
    for place, _ in WHEELS[::2]:
        x, z = corners[..., 0] - GAP - place * LENGTH, corners[..., 2] - WHEEL_HEIGHT
        near = (np.hypot(x, z) < WHEEL_RADIUS + CLEARANCE).any(axis=1)
        outside = (np.abs(corners[..., 1]) > HALF_WIDTH - WHEEL_WIDTH - 0.02 - CLEARANCE).any(axis=1)
        arches |= near & (side | (bottom & outside))
    return windows | screens | arches


def wheel_at(parameters, depth):
    """Returns positions on a wheel, or ``depth`` [m] inside, see :func:`shell`."""
    u, v, w = np.moveaxis(parameters, -1, 0)
    # squares become circles: points on a square keep their share of its perimeter
    largest = np.maximum(np.abs(u), np.abs(w))
    angle = np.where(np.abs(u) >= np.abs(w), 0.25 * np.pi * w / np.where(u == 0.0, 1.0, u), 0.0)
    other = 0.5 * np.pi - 0.25 * np.pi * u / np.where(w == 0.0, 1.0, w)
    angle = np.where(
        np.abs(u) >= np.abs(w), angle + np.where(u < 0.0, np.pi, 0.0), other + np.where(w < 0.0, np.pi, 0.0)
    )
    radius = largest * (WHEEL_RADIUS - depth)
    return np.stack([radius * np.cos(angle), v * (0.5 * WHEEL_WIDTH - depth), radius * np.sin(angle)], axis=-1)


def add_shell(builder, vertices, tets):
    """Adds a body of tetrahedra that runs towards the wall.

    It is equivalent to ``builder.add_soft_mesh``, which takes minutes for two million tetrahedra.

    Args:
        builder: The builder.
        vertices: Positions [m], shape [n, 3].
        tets: Vertices of the tetrahedra, whose volumes are positive, shape [m, 4].
    """
    sides = np.swapaxes(vertices[tets[:, 1:]] - vertices[tets[:, :1]], 1, 2)  # in columns
    mass = np.zeros(len(vertices))
    np.add.at(mass, tets, DENSITY / 24.0 * np.linalg.det(sides)[:, None])
    first = builder.particle_count
    builder.add_particles(
        pos=vertices.tolist(),
        vel=[(-SPEED, 0.0, 0.0)] * len(vertices),
        mass=mass.tolist(),
        radius=[0.002] * len(vertices),
    )
    builder.tet_indices.extend(map(tuple, (first + tets).tolist()))
    builder.tet_poses.extend(np.linalg.inv(sides).tolist())
    builder.tet_activations.extend([0.0] * len(tets))
    builder.tet_materials.extend([(STIFFNESS, STIFFNESS, DAMPING)] * len(tets))
    surface = newton.TetMesh.compute_surface_triangles(tets.reshape(-1)).reshape(-1, 3)
    names = ("tri_ke", "tri_ka", "tri_kd", "tri_drag", "tri_lift")
    builder.add_triangles(*(first + surface.T), **{name: [0.0] * len(surface) for name in names})


if __name__ == "__main__":
    main(Example)
