"""Films the throws of the example Diffsim Throw, as a search by gradients improves them.

    python examples/figures/film_throw.py throw.webp

Needs Blender as a Python module (``pip install bpy``, Python 3.11) and Pillow.
"""

import sys
from pathlib import Path

import newton.viewer
import numpy as np
import trimesh
from rich.progress import track

sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parent)]  # for the example and the studio
import film
from example_diffsim_throw import MARK, STARTS, Example

_SIZE = 600, 412
_EVALUATIONS = 1, 2, 5, 10  # which are shown
_EVERY = 12  # steps from one frame to the next
_COLORS = film.BLUE, film.ORANGE, "#3a9a5b"


def record():
    """Returns faces of a world, and positions in the shown evaluations, shape [evaluations, frames, worlds, n, 3]."""
    example = Example(newton.viewer.ViewerNull(), Example.create_parser().parse_args(["--viewer", "null"]))
    shown = []
    for evaluation in track(range(max(_EVALUATIONS)), "Learning"):
        example.step()
        if evaluation + 1 in _EVALUATIONS:
            shown.append(example.positions()[::_EVERY])
    faces = example.model.tri_indices.numpy()
    return faces[: len(faces) // len(STARTS)], example.count, np.array(shown)


def make():
    """Returns the film."""
    faces, count, shown = record()
    studio = film.Studio(_SIZE, (-0.9, -4.2, 1.5), (-0.25, 0.0, 0.0), lens=62.0, light=(-0.5, -0.6, 0.9))
    sheet = studio.add("sheet", faces[(faces >= count).all(axis=1)] - count, "#8a97a6", smooth=False)
    studio.move(sheet, shown[0, 0, 0, count:])
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.035)
    studio.move(studio.add("mark", ball.faces, film.RED, sheen=0.0), ball.vertices + np.array(MARK))
    cubes = [studio.add("cube", faces[(faces < count).all(axis=1)], color, smooth=False) for color in _COLORS]
    paths = shown[:, :, :, :count].mean(axis=3)
    frames = shown.shape[1]

    def draw(frame):
        evaluation, moment = divmod(frame, frames)
        for world, cube in enumerate(cubes):
            studio.move(cube, shown[evaluation, moment, world, :count])
        picture = studio.shoot()
        for world, color in enumerate(_COLORS):
            film.dots(picture, studio.pixels(paths[evaluation, : moment + 1, world]), color, 2.5)
        film.dots(picture, studio.pixels(np.array([MARK])), film.RED, 5.0)  # also where a cube hides it
        return film.beside([picture], [f"evaluation {_EVALUATIONS[evaluation]}"], band=52)

    return film.Film(len(_EVALUATIONS) * frames, draw, duration=70, part=frames)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make)


if __name__ == "__main__":
    main()
