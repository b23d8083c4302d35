"""Films the example Cloth Bullet in slow motion, without the collision stage and with it.

    python examples/figures/film_bullet.py bullet.webp

Needs Blender as a Python module (``pip install bpy``, Python 3.11) and Pillow.
"""

import sys
from pathlib import Path

import newton.viewer
import numpy as np

import warp_bsc as bsc

sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parent)]  # for the example and the studio
import film
from example_cloth_bullet import PATCH_CELLS, SHEET_CELLS, Example

_SIZE = 440, 400
_SPEED = 30.0  # m/s
_STEPS, _BETWEEN = 46, 2  # number of steps of 1/960 s, and of frames for each
_TURN = np.radians([28.0, -18.0, 20.0])  # of the patch about x, y and z, so that a corner comes first
_SHEET, _PATCH = (film.BLUE, "#8fb4de"), (film.ORANGE, "#f6b26b")
_HEAVIER = 5.0  # times the cloth of the sheet, 0.3 kg/m^2
_BAR = 0.012  # m, half the width of a bar of the frame


class ShortSteps(Example):
    """The example with steps of 1/960 s, and a patch of heavy cloth, which dents the sheet."""

    sim_substeps = 16

    def add_cloth(self, builder, cells, *args, **options):
        """Adds a square of cloth, of which the patch is heavy."""
        super().add_cloth(builder, cells, *args, **options)
        if cells == PATCH_CELLS:
            first = builder.particle_count - (cells + 1) ** 2
            builder.particle_mass[first:] = [_HEAVIER * mass for mass in builder.particle_mass[first:]]


def turn(angles):
    """Returns the matrix of turns about x, y and z, in this order."""
    matrix = np.eye(3)
    for axis, angle in enumerate(angles):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        about = np.eye(3)
        about[[i, j], [i, j]] = np.cos(angle)
        about[i, j], about[j, i] = -np.sin(angle), np.sin(angle)
        matrix = about @ matrix
    return matrix


def record(ccd):
    """Returns the example after a run, and its positions after each step, shape [_STEPS + 1, particles, 3]."""
    options = ["--viewer", "null", "--speed", str(_SPEED), "--ccd" if ccd else "--no-ccd"]
    example = ShortSteps(newton.viewer.ViewerNull(), Example.create_parser().parse_args(options))
    start = example.state_0.particle_q.numpy().copy()
    patch = start[example.sheet_particles :]
    middle = patch.mean(axis=0)
    patch[:] = (patch - middle) @ turn(_TURN).T + middle
    example.state_0.particle_q.assign(start)
    example.sim_substeps, states = 1, [start]
    for _ in range(_STEPS):
        example.simulate()
        states.append(example.state_0.particle_q.numpy().copy())
    return example, np.array(states)


def stripes(cells, colors, every):
    """Returns colors of the faces of a grid of cloth, with stripes of the second color, shape [n, 3]."""
    row, column = np.divmod(np.arange(cells**2), cells)
    striped = (row % every == every // 2) | (column % every == every // 2)
    return np.repeat(np.where(striped[:, None], film.linear(colors[1]), film.linear(colors[0])), 2, axis=0)


def frame_bars():
    """Returns vertices and faces of four bars, to which the border of the sheet is pinned."""
    vertices, faces = [], []
    for across in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]):
        corners, sides = film.box(np.where(across, _BAR, [0.5 + 2.0 * _BAR, 0.5 + 2.0 * _BAR, _BAR]))
        for side in (-1.0, 1.0):
            faces.append(sides + 8 * len(vertices))
            vertices.append(corners + side * (0.5 + _BAR) * np.array(across))
    return np.concatenate(vertices), np.concatenate(faces)


def make():
    """Returns the film."""
    runs = [record(ccd) for ccd in (False, True)]
    example = runs[0][0]
    faces, count = example.model.tri_indices.numpy(), example.sheet_particles
    studio = film.Studio(_SIZE, (0.8, -2.3, 1.0), (-0.025, 0.0, -0.03), lens=63.0)
    sheet = studio.add("sheet", faces[: example.sheet_triangles], stripes(SHEET_CELLS, _SHEET, 8))
    patch = studio.add("patch", faces[example.sheet_triangles :] - count, stripes(PATCH_CELLS, _PATCH, 5))
    bars, bar_faces = frame_bars()
    studio.move(studio.add("frame", bar_faces, "#4a4f57", sheen=0.0, smooth=False), bars)

    mesh = bsc.CollisionMesh(faces, len(runs[0][1][0]), device="cpu")
    detector = bsc.CollisionDetector(mesh)

    def shoot(x):
        """Returns the picture of positions, with red dots where edges cross faces."""
        studio.move(sheet, x[:count])
        studio.move(patch, x[count:])
        picture = studio.shoot()
        crossing = mesh.edges[detector.find_intersections(x)[:, 0]]
        film.dots(picture, studio.pixels(x[crossing].mean(axis=1)), film.RED, 3.0)
        return picture

    def draw(frame):
        step, part = divmod(frame, _BETWEEN)
        without, behind = (x[step] + part / _BETWEEN * (x[min(step + 1, _STEPS)] - x[step]) for _, x in runs)
        pictures = [shoot(without)]
        # the same until the patch meets the sheet
        pictures.append(pictures[0].copy() if np.array_equal(without, behind) else shoot(behind))
        milliseconds = 1e3 * frame / _BETWEEN * example.sim_dt
        return film.beside(pictures, ("VBD", "VBD + SolverCCD"), f"{milliseconds:.0f} ms")

    return film.Film(_STEPS * _BETWEEN + 1, draw, duration=45)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make)


if __name__ == "__main__":
    main()
