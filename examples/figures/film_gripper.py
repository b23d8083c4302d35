"""Films the example Gripper, without the collision stage and with it.

    python examples/figures/film_gripper.py gripper.webp

Needs Blender as a Python module (``pip install bpy``, Python 3.11) and Pillow.
"""

import sys
from pathlib import Path

import newton.viewer
import numpy as np

sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parent)]  # for the example and the studio
import film
from example_gripper import FINGER, Example

_SIZE = 440, 420
_FRAMES = 44


def record(ccd):
    """Returns the faces of the cloth, and each frame's positions of the cloth and of the middles of the fingers."""
    options = ["--viewer", "null", "--ccd" if ccd else "--no-ccd"]
    example = Example(newton.viewer.ViewerNull(), Example.create_parser().parse_args(options))
    cloth, fingers = [], []
    for _ in range(_FRAMES):
        cloth.append(example.state_0.particle_q.numpy().copy())
        fingers.append(example.state_0.body_q.numpy()[1:, :3].copy())
        example.step()
    return example.model.tri_indices.numpy(), np.array(cloth), np.array(fingers)


def make():
    """Returns the film."""
    runs = [record(ccd) for ccd in (False, True)]
    studio = film.Studio(_SIZE, (0.36, -0.62, 0.27), (0.0, 0.0, 0.104), lens=94.0, ground=0.0, light=(0.75, -0.75, 1.0))
    cloth = studio.add("cloth", runs[0][0], film.ORANGE)
    box, box_faces = film.box(FINGER)
    fingers = [studio.add(name, box_faces, "#5a6470", sheen=0.0, smooth=False) for name in ("left", "right")]

    def draw(frame):
        pictures = []
        for _, x, middles in runs:
            studio.move(cloth, x[frame])
            for finger, middle in zip(fingers, middles[frame], strict=True):
                studio.move(finger, box + middle)
            pictures.append(studio.shoot())
        return film.beside(pictures, ("VBD", "VBD + SolverCCD"), band=44)

    return film.Film(_FRAMES, draw, duration=60)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make)


if __name__ == "__main__":
    main()
