"""Draws three frames of the dancer and of their repair: what collides before the next, and how far vertices move.

    warp-bsc repair assets/dancer.usd --output fixed.usdc
    python examples/figures/repaired_shot.py assets/dancer.usd fixed.usdc shot.png

Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import io
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

import warp_bsc as bsc
from warp_bsc.usd.scene import Scene

sys.path.append(str(Path(__file__).parent))  # for the other figures
from repaired_mesh import CROSSING, MOVES, color_faces
from scenes import View, shade

_FRAMES, _APART = 3, 8  # number of frames, and how many are at least from one to the next
_VIEW = View(0, "", 6.0, -92.0, (0.05, 0.0, 0.78), 0.96)
_RIGID = to_rgb("#b9b4ae")


def colliding_faces(detector, interval):
    """Returns the faces that collide, or of which an edge or a vertex does, bool, and the number of pairs."""
    mesh, found = detector.mesh, detector.detect(interval.x0, interval.x1)
    vertices, edges = np.zeros(mesh.vertex_count, dtype=bool), np.zeros(len(mesh.edges), dtype=bool)
    vertices[found.vertex_face[:, 0]] = True
    edges[found.edge_edge.ravel()] = True
    colliding = vertices[mesh.faces].any(axis=1) | edges[mesh.face_edges].any(axis=1)
    colliding[found.vertex_face[:, 1]] = True
    return colliding, len(found.vertex_face) + len(found.edge_edge)


def worst_frames(counts):
    """Returns the frames after which most pairs collide, apart from each other, in their order."""
    chosen = []
    for frame in np.argsort(-np.asarray(counts), kind="stable"):
        if len(chosen) < _FRAMES and all(abs(frame - other) >= _APART for other in chosen):
            chosen.append(int(frame))
    return sorted(chosen)


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shot", help="The shot, assets/dancer.usd.")
    parser.add_argument("repaired", help="What warp-bsc repair wrote for it.")
    parser.add_argument("picture", help="File to write, .png.")
    arguments = parser.parse_args()
    shots = [Scene(path, sample_turns=False) for path in (arguments.shot, arguments.repaired)]
    segment = shots[0].interval(0).segment
    faces = segment.faces
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, segment.vertex_count), method="exact")
    soft = np.zeros(len(faces), dtype=bool)
    soft[next(mesh.faces for mesh in segment.meshes if mesh.name.endswith("triangles"))] = True
    ends = shots[0].interval(0).x0[detector.mesh.edges[np.isin(detector.mesh.edges, faces[soft]).all(axis=1)]]
    edge = np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))

    found = [[colliding_faces(detector, shot.interval(i)) for i in range(len(shot))] for shot in shots]
    frames = worst_frames([count for _, count in found[0]])
    moves = [np.linalg.norm(shots[1].interval(i).x0 - shots[0].interval(i).x0, axis=1) / edge for i in frames]
    largest = max(move.max() for move in moves)
    figure, rows = plt.subplots(2, _FRAMES, figsize=(10.0, 7.6), dpi=100, gridspec_kw={"hspace": 0.12, "wspace": 0.02})
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.12, top=0.95)
    for row, shot, results, verb in zip(rows, shots, found, ("before", "after"), strict=True):
        for axes, frame, move in zip(row, frames, moves, strict=True):
            colliding, count = results[frame]
            colors = color_faces(faces, move if shot is shots[1] else 0.0 * move, largest, colliding)
            colors[~soft & ~colliding] = _RIGID
            axes.imshow(shade(shot.interval(frame).x0.astype(float), faces, colors, _VIEW))
            axes.set_title(f"{verb}: frame {shot.times[frame]:g}, {count} pairs collide", fontsize=10)
            axes.set_axis_off()
    scale = plt.cm.ScalarMappable(plt.Normalize(0.0, largest), MOVES)
    bar = figure.colorbar(scale, cax=figure.add_axes((0.38, 0.075, 0.5, 0.018)), orientation="horizontal")
    bar.set_label("move [median edge lengths]")
    figure.text(0.06, 0.076, "red: collides before the next frame", color=CROSSING, fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer)
    Image.open(buffer).convert("RGB").quantize(256).save(arguments.picture, optimize=True)


if __name__ == "__main__":
    main()
