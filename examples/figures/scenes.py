"""Draws one moment of each scene of the paper, side by side.

    python examples/figures/scenes.py assets scenes.png

Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import io
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from warp_bsc.usd.scene import Scene

PIXELS = 360
"""Height of the picture of a scene; it is computed with twice as many along each side."""
_CAPTION_PIXELS = 50
_SHADOW_PIXELS = 1000
_RIGID, _SMALL_PARTS = "#cfc6b8", "#4a4a4f"


class View(NamedTuple):
    """The view of a scene.

    Attributes:
        interval: Interval of the recording whose start is drawn.
        color: Color of the largest deforming part.
        elevation: Elevation of the eye [degrees].
        azimuth: Azimuth of the eye [degrees].
        centre: Position in the middle of the picture [m].
        extent: Height of the picture [m].
        width: Width of the picture over its height.
        opened: Whether rigid meshes are drawn only behind the z axis.
    """

    interval: int
    color: str
    elevation: float
    azimuth: float
    centre: tuple[float, float, float]
    extent: float
    width: float = 1.0
    opened: bool = False


VIEWS = {
    "twisting": View(18, "#4f86c6", 24.0, -60.0, (0.0, 0.0, 0.3), 1.25),
    "funnel": View(12, "#3d9e8f", 25.0, -60.0, (0.0, 0.0, 0.16), 1.85, opened=True),
    "dancer": View(29, "#d96c8a", 6.0, -92.0, (0.0, 0.0, 0.97), 2.05, width=0.72),
    "flamenco": View(29, "#c8322f", 6.0, -75.0, (0.0, 0.0, 0.97), 2.05, width=0.72),
    "crashing": View(14, "#e0912f", 16.0, -72.0, (1.35, 0.0, 0.7), 3.4, width=1.25),
}


def rasterise(corners, pixels):
    """Returns which triangle is in front at each pixel.

    Args:
        corners: Corners of the triangles, to the right and down [pixels], and their distances, shape [n, 3, 3].
        pixels: Height and width of the picture.

    Returns:
        Distance and triangle of each pixel, shape ``pixels``, infinite and -1 where there is no triangle, and its
        barycentric coordinates, shape [*pixels, 3].
    """
    depth, triangle = np.full(pixels, np.inf), np.full(pixels, -1)
    coordinates = np.zeros((*pixels, 3))
    low = np.maximum(np.ceil(corners[:, :, :2].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(corners[:, :, :2].max(axis=1)) + 1, pixels[::-1]).astype(int)
    a, b, c = np.moveaxis(corners, 1, 0)
    b, c = b - a, c - a
    twice_area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    for i in np.flatnonzero((low < high).all(axis=1) & (twice_area != 0.0)):
        box = np.s_[low[i, 1] : high[i, 1], low[i, 0] : high[i, 0]]
        x, y = np.arange(low[i, 0], high[i, 0]) - a[i, 0], np.arange(low[i, 1], high[i, 1])[:, None] - a[i, 1]
        v = (x * c[i, 1] - y * c[i, 0]) / twice_area[i]
        w = (b[i, 0] * y - b[i, 1] * x) / twice_area[i]
        z = a[i, 2] + v * b[i, 2] + w * c[i, 2]
        seen = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (z < depth[box])
        depth[box][seen] = z[seen]
        triangle[box][seen] = i
        coordinates[box][seen] = np.stack([1.0 - v - w, v, w], axis=-1)[seen]
    return depth, triangle, coordinates


def axes_of(elevation, azimuth):
    """Returns the directions to the right, down and away from an eye at angles [degrees], as rows of a matrix."""
    e, a = np.radians([elevation, azimuth])
    away = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.array([right, np.cross(away, right), away])


def project(axes, points, view, extent, pixels):
    """Returns points in pixels of a square picture, and their distances from the eye."""
    return (points - view.centre) @ axes.T * (pixels / extent) + (0.5 * pixels, 0.5 * pixels, 0.0)


def shade(x, faces, colors, view):
    """Returns a picture of triangles with light from the upper left and shadows, shape [h, w, 3]."""
    normals = np.zeros_like(x)
    across = np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]])
    np.add.at(normals, faces, across[:, None])

    eye = axes_of(view.elevation, view.azimuth)
    lamp = axes_of(50.0, view.azimuth - 25.0)
    pixels = 2 * round(PIXELS * max(view.width, 1.0))
    extent = view.extent * max(view.width, 1.0)
    _, triangle, coordinates = rasterise(project(eye, x, view, extent, pixels)[faces], (pixels, pixels))
    lamp_extent = 1.7 * extent
    corners = project(lamp, x, view, lamp_extent, _SHADOW_PIXELS)[faces]
    lit_depth, _, _ = rasterise(corners, (_SHADOW_PIXELS, _SHADOW_PIXELS))

    drawn = triangle >= 0
    corner, weight = faces[triangle[drawn]], coordinates[drawn][:, :, None]
    position = (x[corner] * weight).sum(axis=1)
    normal = (normals[corner] * weight).sum(axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= np.sign(normal @ -eye[2])[:, None]
    # a little towards the lamp, so that lit triangles do not shade themselves
    lifted = project(lamp, position - 6.0e-3 * extent * lamp[2], view, lamp_extent, _SHADOW_PIXELS)
    column, row = np.clip(np.round(lifted[:, :2]).astype(int), 0, _SHADOW_PIXELS - 1).T
    outside = ((lifted[:, :2] < 0.0) | (lifted[:, :2] >= _SHADOW_PIXELS)).any(axis=1)
    lit = outside | (lifted[:, 2] <= lit_depth[row, column])
    half = -(lamp[2] + eye[2]) / np.linalg.norm(lamp[2] + eye[2])
    diffuse = np.maximum(normal @ -lamp[2], 0.0) * np.where(lit, 1.0, 0.25)
    gloss = 0.12 * np.maximum(normal @ half, 0.0) ** 30 * lit
    picture = np.ones((pixels, pixels, 3))
    light = 0.38 + 0.14 * normal[:, 2] + 0.6 * diffuse
    picture[drawn] = np.clip(colors[triangle[drawn]] * light[:, None] + gloss[:, None], 0.0, 1.0)
    picture = picture.reshape(pixels // 2, 2, pixels // 2, 2, 3).mean(axis=(1, 3))
    height, width = (pixels // 2 - PIXELS) // 2, (pixels // 2 - round(PIXELS * view.width)) // 2
    return picture[height : height + PIXELS, width : width + round(PIXELS * view.width)]


def parts(faces, vertex_count):
    """Returns a number for each vertex, the same for all vertices that faces connect."""
    label = np.arange(vertex_count)
    while True:
        least = label[faces].min(axis=1)
        new = label.copy()
        np.minimum.at(new, faces, least[:, None])
        new = new[new]
        if (new == label).all():
            return label
        label = new


def picture_of(scene, view):
    """Returns the picture of a scene, whose mesh named "triangles" deforms and whose other meshes are rigid."""
    segment, x, _ = scene.interval(view.interval)
    x, faces = x.astype(float), segment.faces
    soft = np.zeros(len(faces), dtype=bool)
    soft[next(mesh.faces for mesh in segment.meshes if mesh.name.endswith("triangles"))] = True
    colors = np.where(soft[:, None], to_rgb(view.color), to_rgb(_RIGID))
    label = parts(faces, len(x))[faces[:, 0]]
    largest = np.bincount(label[soft]).argmax()
    colors[soft & (label != largest)] = to_rgb(_SMALL_PARTS)
    if view.opened:
        kept = soft | (x[faces].mean(axis=1) @ axes_of(0.0, view.azimuth)[2] > 0.0)
        faces, colors = faces[kept], colors[kept]
    return shade(x, faces, colors, view)


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="Where the recordings are, named after the scenes.")
    parser.add_argument("picture", help="File to write, .png.")
    arguments = parser.parse_args()
    size = sum(round(PIXELS * view.width) for view in VIEWS.values()), PIXELS + _CAPTION_PIXELS
    figure = plt.figure(figsize=(size[0] / 100.0, size[1] / 100.0), dpi=100)
    left = 0.0
    for name, view in VIEWS.items():
        scene = Scene(arguments.folder / f"{name}.usd", sample_turns=False)
        width = view.width * PIXELS / size[0]
        axes = figure.add_axes((left, _CAPTION_PIXELS / size[1], width, PIXELS / size[1]))
        axes.imshow(picture_of(scene, view))
        axes.set_axis_off()
        caption = f"{name.capitalize()}\n{scene.face_count:,} triangles"
        figure.text(left + 0.5 * width, 0.5 * _CAPTION_PIXELS / size[1], caption, ha="center", va="center", fontsize=13)
        left += width
    buffer = io.BytesIO()
    figure.savefig(buffer)
    Image.open(buffer).convert("RGB").quantize(256).save(arguments.picture, optimize=True)


if __name__ == "__main__":
    main()
