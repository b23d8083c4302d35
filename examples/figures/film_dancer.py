"""Films a recorded dancer: the flamenco dress of four ruffles, which the collision stage keeps apart.

    python examples/figures/film_dancer.py assets/flamenco.usd flamenco.webp

Needs Blender as a Python module (``pip install bpy``, Python 3.11) and Pillow.
"""

import sys
from pathlib import Path

import numpy as np

from warp_bsc.usd.scene import Scene

sys.path.append(str(Path(__file__).parent))  # for the studio
import film

_SIZE = 480, 560
_DRESS, _BODY = "#c8322f", film.GREY


def make(path):
    """Returns the film of a recording, given its path."""
    scene = Scene(path, sample_turns=False)
    segment = scene.interval(0).segment
    soft = np.zeros(len(segment.faces), dtype=bool)
    soft[next(mesh.faces for mesh in segment.meshes if mesh.name.endswith("triangles"))] = True
    colors = np.where(soft[:, None], film.linear(_DRESS), film.linear(_BODY))
    studio = film.Studio(_SIZE, (1.6, -4.6, 1.5), (0.03, 0.0, 0.86), lens=64.0, ground=0.0, light=(-0.8, -0.35, 0.8))
    dancer = studio.add("dancer", segment.faces, colors)

    def draw(frame):
        interval = scene.interval(min(frame, len(scene) - 1))
        studio.move(dancer, interval.x0 if frame < len(scene) else interval.x1)
        return studio.shoot()

    return film.Film(len(scene) + 1, draw, duration=60)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make, recording="The recording, assets/flamenco.usd.")


if __name__ == "__main__":
    main()
