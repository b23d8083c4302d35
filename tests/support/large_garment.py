"""Measures the repair of a garment of 102,102 vertices that has sunk into a fixed body at three places.

``python tests/support/large_garment.py [DEVICE]`` prints crossings before and after, whether the result is certified,
the strain, the median and the largest move in median edge lengths, and the time of the third repair.
"""

import sys
import time

import numpy as np
import warp as wp

import warp_bsc as bsc

DENTS = (1.0, 0.2), (3.0, -0.4), (5.0, 0.5)
"""Angle and height of the places."""


def shape(angle, height):
    """Returns the radius of the body at an angle and a height."""
    return 1.0 + 0.05 * np.sin(3.0 * angle) * np.cos(2.0 * height)


def garment(angle, height):
    """Returns the radius of the garment."""
    near = sum(np.exp(-(((angle - a) / 0.13) ** 2) - ((height - h) / 0.13) ** 2) for a, h in DENTS)
    return shape(angle, height) + 0.03 - 0.04 * near


def tube(around, along, radius, half_height):
    """Returns positions and faces of a tube."""
    angle = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    angle, height = np.meshgrid(angle, np.linspace(-half_height, half_height, along))
    r = radius(angle, height)
    i = np.arange(around * along).reshape(along, around)
    j = np.roll(i, -1, axis=1)
    a, b, c, d = (corners.ravel() for corners in (i[:-1], j[:-1], j[1:], i[1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([r * np.cos(angle), r * np.sin(angle), height], axis=2).reshape(-1, 3), faces


def main():
    """Prints the line."""
    device = sys.argv[1] if len(sys.argv) > 1 else "cpu"
    wp.config.log_level = wp.LOG_WARNING
    (body, body_faces), (cloth, cloth_faces) = tube(160, 128, shape, 1.2), tube(357, 286, garment, 1.0)
    x = np.concatenate([body, cloth]).astype(np.float32)
    faces = np.concatenate([body_faces, cloth_faces + len(body)])
    for _ in range(3):
        started = time.perf_counter()
        result = bsc.repair(faces, x, fixed=np.arange(len(body)), device=device)
        seconds = time.perf_counter() - started
    edges = bsc.CollisionMesh(cloth_faces, len(cloth), device="cpu").edges
    moves = result.moved[len(body) :] / np.median(np.linalg.norm(cloth[edges[:, 1]] - cloth[edges[:, 0]], axis=1))
    print(
        f"{len(cloth):,} vertices: {result}, strain {result.max_strain:.1%}, moves {np.median(moves):.2g}, "
        f"{moves.max():.2f}, {seconds:.2f} s on {wp.get_device(device)}"
    )


if __name__ == "__main__":
    main()
