"""Draws a cloth on a ball as three solvers leave it in steps of 1/60 s, coloured by how far its edges are stretched.

    python examples/figures/drape.py drape.png

The scene is ``sphere`` of ``warp-bsc bench response``. Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import io
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import warp as wp
from matplotlib.colors import Normalize
from PIL import Image

from warp_bsc.bench.scenes.contact import build_scene
from warp_bsc.bench.scenes.simulation import Samples, Simulation
from warp_bsc.response.state.mesh import ModelMesh

sys.path.append(str(Path(__file__).parent))  # for the other figures
from scenes import PIXELS, View, shade

_RATE = 60
_SOLVERS = {
    "VBD with self-contact": ("vbd", {"has_self_contact": True, "has_contacts": True}),
    "SolverCCD(VBD)": ("vbd", {"stage_options": {}}),
    "SolverImplicit": ("implicit", {"stage_options": {}}),
}
_VIEW = View(0, "", 17.0, -62.0, (0.0, 0.0, -0.06), 0.68)
_BALL = (0.81, 0.78, 0.72)
_COLORS, _SCALE = plt.get_cmap("YlOrRd"), Normalize(0.0, 10.0)  # stretch [%]
_BOTTOM, _RIGHT = 56, 120
"""Pixels below the pictures and right of them."""


class LastState(Samples):
    """What is measured of each state, and where the vertices of cloth and ball are in the last one."""

    def __init__(self, model):
        super().__init__(model)
        self.mesh = ModelMesh(model)
        self.x = wp.zeros(self.mesh.vertex_count, dtype=wp.vec3)

    def add(self, state):
        """Measures a state; returns whether it is finite."""
        self.mesh.positions(state.particle_q, state.body_q, self.x)
        return super().add(state)


def drape(solver, options):
    """Lets a cloth fall.

    Returns:
        Corners of cloth and ball [m], their faces, how far each face of the cloth is stretched [%], and a line of
        figures.
    """
    scene = build_scene("sphere", "vbd")
    model, samples = scene.model, LastState(scene.model)
    simulation = Simulation(scene, solver, _RATE, samples=samples, **options)
    steps = simulation.run(scene.seconds, lambda done, steps: None)
    mesh, x = samples.mesh, samples.x.numpy().astype(float)
    corners = mesh.faces[: model.tri_count]

    def lengths(x):
        return np.linalg.norm(x[corners] - x[np.roll(corners, 1, axis=1)], axis=2)

    stretch = 100.0 * (lengths(x) / lengths(model.particle_q.numpy()) - 1.0).max(axis=1)
    last = steps // 10
    figures = 100.0 * np.mean(samples.stretch[-last:]), 1e3 * np.mean(samples.speed[-last:])
    line = "stretched by {:.1f}%, {:.0f} mm/s".format(*figures)
    return x, mesh.faces, stretch, f"{line}, {simulation.count_crossings()} crossings"


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png.")
    picture = parser.parse_args().picture
    wp.config.log_level = wp.LOG_WARNING
    size = len(_SOLVERS) * PIXELS + _RIGHT, PIXELS + _BOTTOM
    figure = plt.figure(figsize=(size[0] / 100.0, size[1] / 100.0), dpi=100)
    for i, (title, (solver, options)) in enumerate(_SOLVERS.items()):
        x, faces, stretch, line = drape(solver, options)
        colors = np.concatenate([_COLORS(_SCALE(stretch))[:, :3], np.tile(_BALL, (len(faces) - len(stretch), 1))])
        axes = figure.add_axes((i * PIXELS / size[0], _BOTTOM / size[1], PIXELS / size[0], PIXELS / size[1]))
        axes.imshow(shade(x, faces, colors, _VIEW))
        axes.set_axis_off()
        middle = (i + 0.5) * PIXELS / size[0]
        figure.text(middle, 0.68 * _BOTTOM / size[1], title, ha="center", va="center", fontsize=13)
        figure.text(middle, 0.26 * _BOTTOM / size[1], line, ha="center", va="center", fontsize=10)
    bar = figure.add_axes((1.0 - 0.8 * _RIGHT / size[0], 0.3, 0.12 * _RIGHT / size[0], 0.5))
    scale = plt.cm.ScalarMappable(_SCALE, _COLORS)
    figure.colorbar(scale, cax=bar, extend="max", label="stretch of edges [%]")
    buffer = io.BytesIO()
    figure.savefig(buffer)
    Image.open(buffer).convert("RGB").quantize(256).save(picture, optimize=True)


if __name__ == "__main__":
    main()
