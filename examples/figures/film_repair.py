"""Films the dancer and the repair of this shot: red dots are where it collides, from there four frames on.

    warp-bsc repair assets/dancer.usd --output fixed.usdc
    python examples/figures/film_repair.py assets/dancer.usd fixed.usdc repair.webp

Needs Blender as a Python module (``pip install bpy``, Python 3.11), Pillow and matplotlib.
"""

import sys
from pathlib import Path

import numpy as np

import warp_bsc as bsc
from warp_bsc.usd.scene import Scene

sys.path.append(str(Path(__file__).parent))  # for the studio and the other figure
import film
from repaired_shot import colliding_faces

_SIZE = 400, 400
_SKIRT, _BODY = "#4f86b8", film.GREY
_SHOWN = 4  # frames for which a collision stays red


def make(shot, repaired):
    """Returns the film of a shot and its repair, given their paths."""
    shots = [Scene(path, sample_turns=False) for path in (shot, repaired)]
    segment = shots[0].interval(0).segment
    detector = bsc.CollisionDetector(bsc.CollisionMesh(segment.faces, segment.vertex_count), method="exact")
    found = [[colliding_faces(detector, shot.interval(i)) for i in range(len(shot))] for shot in shots]
    soft = np.zeros(len(segment.faces), dtype=bool)
    soft[next(mesh.faces for mesh in segment.meshes if mesh.name.endswith("triangles"))] = True
    plain = np.where(soft[:, None], film.linear(_SKIRT), film.linear(_BODY))
    studio = film.Studio(_SIZE, (-0.1, -3.1, 1.1), (0.03, 0.0, 0.78), lens=86.0, light=(-0.9, -0.25, 0.6))
    dancer = studio.add("dancer", segment.faces, plain)

    def draw(frame):
        pictures, titles = [], []
        for scene, results, title in zip(shots, found, ("before", "after"), strict=True):
            x = scene.interval(frame).x0
            studio.move(dancer, x)
            picture = studio.shoot()
            for colliding, _ in results[max(frame - _SHOWN + 1, 0) : frame + 1]:
                film.dots(picture, studio.pixels(x[segment.faces[colliding]].mean(axis=1)), film.RED, 4.0)
            pictures.append(picture)
            titles.append(f"{title}: {sum(count for _, count in results[: frame + 1])} collisions")
        return film.beside(pictures, titles, band=44)

    return film.Film(len(shots[0]), draw, duration=90)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make, shot="The shot, assets/dancer.usd.", repaired="What warp-bsc repair wrote for it.")


if __name__ == "__main__":
    main()
