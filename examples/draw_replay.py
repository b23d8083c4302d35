"""Draws what a replay found: the moving meshes with their contacts at the worst interval, and collisions over time.

    python examples/draw_replay.py assets/cloth_twist.usd collisions.png

Needs matplotlib (``pip install matplotlib``).
"""

import argparse
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from rich.progress import track

import warp_bsc as bsc
from warp_bsc.scene import Scene


def find_collisions(scene):
    """Collisions of every interval between two times of a scene."""
    detector = bsc.CollisionDetector(bsc.CollisionMesh(scene.faces, scene.vertex_count), method="exact")
    intervals = list(pairwise(scene.times))
    return detector.mesh, [
        detector.detect(scene.positions(start), scene.positions(end)) for start, end in track(intervals, "detecting")
    ]


def contact_points(scene, mesh, interval, collisions):
    """Where the contacts of one interval are, at the time of each, shape [n, 3]."""
    start, end = (scene.positions(time).astype(np.float64) for time in scene.times[interval : interval + 2])

    def at(corners, toi):
        toi = toi[:, None, None]
        return (1.0 - toi) * start[corners] + toi * end[corners]

    faces = at(mesh.faces[collisions.vertex_face[:, 1]], collisions.vertex_face_toi)
    edges = at(mesh.edges[collisions.edge_edge[:, 0]], collisions.edge_edge_toi)
    s = collisions.edge_edge_coordinates[:, :1]
    return np.concatenate(
        [
            np.einsum("ni,nij->nj", collisions.vertex_face_coordinates, faces),
            (1.0 - s) * edges[:, 0] + s * edges[:, 1],
        ]
    )


def draw(scene, path):
    """Writes the picture of a scene to a file."""
    mesh, found = find_collisions(scene)
    counts = np.array([(len(c.vertex_face), len(c.edge_edge)) for c in found])
    worst = int(counts.sum(axis=1).argmax())
    contacts = contact_points(scene, mesh, worst, found[worst])
    corners = scene.positions(scene.times[worst]).astype(np.float64)[mesh.faces]

    figure = plt.figure(figsize=(11, 4.4))
    axes = figure.add_axes([0.0, 0.0, 0.56, 1.0], projection="3d", computed_zorder=False)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
    light = 0.45 + 0.5 * np.abs(normals @ (np.array([0.4, -0.8, 0.45])))
    colors = np.clip(light[:, None] * np.array([[0.45, 0.66, 0.86]]), 0.0, 1.0)
    axes.add_collection3d(Poly3DCollection(corners, facecolors=colors, edgecolors=colors, linewidths=0.4, zorder=1))
    axes.scatter(
        *contacts.T, s=110, facecolors="none", edgecolors="#d62728", linewidths=1.8, depthshade=False, zorder=2
    )
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.2)
    axes.view_init(elev=24, azim=-75)
    axes.set_axis_off()
    axes.text2D(
        0.06,
        0.93,
        f"Time {scene.times[worst]:g} to {scene.times[worst + 1]:g}: "
        f"{len(contacts)} pairs collide among {len(mesh.faces):,} triangles",
        transform=axes.transAxes,
        fontsize=11,
    )

    axes = figure.add_axes([0.63, 0.15, 0.35, 0.72])
    times = np.array(scene.times[:-1])
    width = 0.8 * np.diff(scene.times)
    axes.bar(times, counts[:, 0], width, align="edge", color="#d62728", label="vertex-face")
    axes.bar(times, counts[:, 1], width, align="edge", bottom=counts[:, 0], color="#f4a582", label="edge-edge")
    axes.set_title("Collisions in each interval between time samples", fontsize=11, loc="left")
    axes.set_xlabel("time code")
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)


def main():
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="USD file")
    parser.add_argument("picture", help="file to write, .png, .svg or .pdf")
    arguments = parser.parse_args()
    draw(Scene(arguments.scene), arguments.picture)


if __name__ == "__main__":
    main()
