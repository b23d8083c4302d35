"""Draws a limb that is pushed into itself and its repair: faces that cross, how far vertices move, and a section.

    python examples/figures/repaired_mesh.py mesh.png

A mesh file and the middle, the extent and the angles of a view draw another mesh:

    python examples/figures/repaired_mesh.py --mesh body.obj --view 0.18 1.3 -0.01 0.3 10 -60 body.png

Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import io
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from PIL import Image

import warp_bsc as bsc
from warp_bsc.bench.scenes.repair import damaged, load_tangled

sys.path.append(str(Path(__file__).parent))  # for the other figures
from scenes import View, axes_of, shade

CROSSING = to_rgb("#d4101c")
MOVES = LinearSegmentedColormap.from_list("moves", ["#e6cdb8", "#7fb6d6", "#1d5c9e", "#0a1f4d"])
"""Colors of faces by how far their vertices move."""

_LIMB = 45  # the number of random damage
_LIMB_VIEW = (-0.78, 0.05, 0.03, 0.62, 48.0, 105.0)


def color_faces(faces, moves, largest, crossing):
    """Returns a color for each face: that of its mean move, or that of crossings, shape [n, 3].

    Args:
        faces: Vertex indices, shape [n, 3].
        moves: Distance of each vertex from its input.
        largest: The distance that has the last color.
        crossing: Whether a face crosses, shape [n].
    """
    colors = MOVES(moves[faces].mean(axis=1) / largest)[:, :3]
    colors[crossing] = CROSSING
    return colors


def crossing_faces(mesh, x):
    """Returns the faces that cross: those that an edge meets, and those of this edge, bool, shape [face_count]."""
    pairs = bsc.CollisionDetector(mesh).find_intersections(x)
    edges = np.zeros(len(mesh.edges), dtype=bool)
    edges[pairs[:, 0]] = True
    crossing = edges[mesh.face_edges].any(axis=1)
    crossing[pairs[:, 1]] = True
    return crossing


def section(faces, x, point, normal):
    """Returns the segments in which a plane cuts faces, shape [n, 2, 3]."""
    height = (x - point) @ normal
    segments = []
    for face in faces[np.ptp(np.sign(height[faces]), axis=1) > 0]:
        ends = [(face[i], face[(i + 1) % 3]) for i in range(3)]
        cut = [(a, b) for a, b in ends if height[a] * height[b] < 0.0]
        if len(cut) == 2:
            segments.append([x[a] + height[a] / (height[a] - height[b]) * (x[b] - x[a]) for a, b in cut])
    return np.array(segments)


def draw_section(axes, faces, before, after, crossing):
    """Draws where a plane through the crossings, across their longest direction, cuts the surface before and after."""
    corners = before[faces[crossing]].reshape(-1, 3)
    middle = corners.mean(axis=0)
    directions = np.linalg.svd(corners - middle, full_matrices=False)[2]
    for x, color, label in ((before, CROSSING, "before"), (after, "#1d5c9e", "after")):
        lines = (section(faces, x, middle, directions[0]) - middle) @ directions[1:].T
        for i, line in enumerate(lines):
            axes.plot(*line.T, color=color, linewidth=1.6, label=label if i == 0 else None)
    size = 1.2 * np.abs((corners - middle) @ directions[1:].T).max()
    axes.set(xlim=(-size, size), ylim=(-size, size), aspect="equal", xticks=[], yticks=[])
    axes.legend(loc="lower center", frameon=False)


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png.")
    parser.add_argument("--mesh", help="A mesh file instead of the limb.")
    parser.add_argument("--view", type=float, nargs=6, default=_LIMB_VIEW, help="x y z extent elevation azimuth.")
    arguments = parser.parse_args()
    *middle, extent, elevation, azimuth = arguments.view
    view = View(0, "", elevation, azimuth, tuple(middle), extent)
    tangled = load_tangled(arguments.mesh) if arguments.mesh else damaged("bodies", _LIMB)
    mesh = bsc.CollisionMesh(tangled.faces, len(tangled.x), device="cpu")
    result = bsc.repair(mesh, tangled.x)
    edge = np.median(np.linalg.norm(np.diff(tangled.x[mesh.edges], axis=1), axis=2))
    moves = result.moved / edge
    shown = np.abs((tangled.x[tangled.faces].mean(axis=1) - view.centre) @ axes_of(elevation, azimuth).T).max(axis=1)
    shown = shown < 0.5 * extent

    figure = plt.figure(figsize=(11.0, 4.2), dpi=110)
    before, after, cut = figure.subplots(1, 3, gridspec_kw={"left": 0.01, "right": 0.99, "bottom": 0.1, "top": 0.94})
    crossing = crossing_faces(mesh, tangled.x)
    largest = moves.max()
    still = color_faces(tangled.faces, 0.0 * moves, largest, crossing)
    before.imshow(shade(tangled.x, tangled.faces, still, view))
    before.set_title(f"before: {result.crossings_before} crossings")
    colors = color_faces(tangled.faces, moves, largest, crossing_faces(mesh, result.x))
    after.imshow(shade(result.x, tangled.faces, colors, view))
    after.set_title(f"after: {result.crossings}")
    for axes in (before, after):
        axes.set_axis_off()
    scale = plt.cm.ScalarMappable(plt.Normalize(0.0, largest), MOVES)
    bar = figure.colorbar(scale, cax=after.inset_axes((0.1, 0.04, 0.8, 0.04)), location="bottom")
    bar.set_label("move [median edge lengths]")
    draw_section(cut, tangled.faces, tangled.x, result.x, crossing & shown)
    cut.set_title("a section")
    buffer = io.BytesIO()
    figure.savefig(buffer)
    Image.open(buffer).convert("RGB").quantize(256).save(arguments.picture, optimize=True)


if __name__ == "__main__":
    main()
