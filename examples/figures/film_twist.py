"""Films a cloth that is wrung, with VBD and its self-contact, and with SolverImplicit.

    python examples/figures/film_twist.py twist.webp

The scene is ``twist`` of ``warp-bsc bench penetration``, with the settings of that benchmark. Needs Blender as a Python
module (``pip install bpy``, Python 3.11) and Pillow.
"""

import sys
from pathlib import Path

import numpy as np

import warp_bsc as bsc
from warp_bsc.bench.measure.penetration import FRAME_RATE, SIMULATORS
from warp_bsc.bench.peers.newton_solvers import simulate_newton
from warp_bsc.bench.scenes.penetration import build_penetration_scene

sys.path.append(str(Path(__file__).parent))  # for the studio
import film

_SIZE = 440, 470
_TITLES = {"vbd-self-contact": "VBD, self-contact on", "implicit": "SolverImplicit"}
_CLOTH, _STRIPE, _GRIP = film.BLUE, "#a9c6e6", "#4a4f57"
_BETWEEN = 2  # frames for each frame of the scene
_GRIP_SIZE = np.array([0.16, 0.012, 0.012])  # m, half the sides


def upright(x):
    """Returns positions turned so that the cloth hangs: its length along z."""
    return np.roll(x, -1, axis=-1)


def record(key):
    """Returns the model of a run, and its positions at each frame, shape [frames, particles, 3]."""
    simulator = SIMULATORS[key]
    built = build_penetration_scene("twist", simulator.solver, simulator.rate)
    run = simulate_newton(
        built,
        simulator.solver,
        simulator.rate,
        built.scene.seconds,
        lambda done, count: None,
        has_self_contact=simulator.has_self_contact,
        has_stage=simulator.has_stage,
    )
    return built.scene.model, np.array(run.states)[:: simulator.rate // FRAME_RATE]


def grips(x, held):
    """Returns vertices and faces of the two bars that hold the ends of the cloth."""
    vertices, faces = [], []
    corners, sides = film.box(_GRIP_SIZE)
    for end in held:
        across = x[end[-1]] - x[end[0]]
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross([0.0, 0.0, 1.0], across), [0.0, 0.0, 1.0]])
        faces.append(sides + 8 * len(vertices))
        vertices.append(corners @ axes + x[end].mean(axis=0))
    return np.concatenate(vertices), np.concatenate(faces)


def make():
    """Returns the film."""
    runs = {title: record(key) for key, title in _TITLES.items()}
    model, states = runs[_TITLES["implicit"]]
    faces, last = model.tri_indices.numpy(), len(states) - 1
    ends = upright(states[0])[:, 2]
    held = [np.flatnonzero(np.isclose(ends, end)) for end in (ends.min(), ends.max())]
    studio = film.Studio(_SIZE, (0.75, -2.0, 0.25), (0.0, 0.0, 0.0), lens=85.0, samples=24)
    middle = upright(states[0])[faces].mean(axis=1)
    striped = (np.floor(middle[:, 0] / 0.05) % 2 == 0)[:, None]
    cloth = studio.add("cloth", faces, np.where(striped, film.linear(_STRIPE), film.linear(_CLOTH)))
    bars = studio.add("grips", grips(upright(states[0]), held)[1], _GRIP, sheen=0.0, smooth=False)
    mesh = bsc.CollisionMesh(faces, states.shape[1], device="cpu")
    detector = bsc.CollisionDetector(mesh)

    def shoot(x):
        """Returns the picture of positions, with red dots where edges cross faces, and the number of these."""
        studio.move(cloth, x)
        studio.move(bars, grips(x, held)[0])
        picture = studio.shoot()
        crossing = detector.find_intersections(x)[:, 0]
        film.dots(picture, studio.pixels(x[mesh.edges[crossing]].mean(axis=1)), film.RED, 3.0)
        return picture, len(crossing)

    def draw(number):
        frame, part = divmod(number, _BETWEEN)
        pictures, titles = [], []
        for title, (_, x) in runs.items():
            between = x[frame] + part / _BETWEEN * (x[min(frame + 1, last)] - x[frame])
            picture, crossings = shoot(upright(between).astype(np.float32))
            pictures.append(picture)
            titles.append(f"{title}\n{crossings} edges through faces")
        return film.beside(pictures, titles, f"{number / _BETWEEN / FRAME_RATE:.2f} s", band=66)

    return film.Film(last * _BETWEEN + 1, draw, duration=40, pause=1500)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make)


if __name__ == "__main__":
    main()
