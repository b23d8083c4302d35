"""What the programs of films share: a studio that Blender renders on the CPU, text on pictures, and files that move.

Needs Blender as a Python module (``pip install bpy``, Python 3.11), only to render, and Pillow, which comes with
matplotlib.
"""

import argparse
import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.progress import track

from warp_bsc._atomic_file import OutputFile

BLUE, ORANGE, RED, GREY = "#5b8fc7", "#e8842a", "#d4101c", "#b9b4ae"
"""Colors of cloths, of what crosses, and of rigid bodies; blue and orange differ to all kinds of sight."""

_SENSOR = 36.0  # mm
_BACKGROUND = "#f3f1ec"
_INK = "#26303a"


class Film(NamedTuple):
    """A film that is rendered frame by frame.

    Attributes:
        frames: Number of frames.
        draw: Returns the picture of a frame, given its number.
        duration: Time that a frame is shown [ms].
        pause: Time that the last frame of each part is shown [ms].
        part: Number of frames of a part; by default the film is one part.
        quality: Quality of the pictures, 0 to 100.
    """

    frames: int
    draw: Callable
    duration: int
    pause: int = 800
    part: int | None = None
    quality: int = 90


def main(description, make, **inputs):
    """Reads the command line, and renders a film.

    Args:
        description: What the program does, whose first line is shown.
        make: Returns the :class:`Film`, given the paths of the inputs.
        inputs: What each input file is, by its name on the command line; an option, which may be None, has dashes.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    for name, text in inputs.items():
        parser.add_argument(name, help=text)
    parser.add_argument("picture", help="File to write, .webp for the film, .png for a strip of a few frames.")
    parser.add_argument("--frames", type=int, nargs="+", help="Frames of the strip; by default 5 of equal distance.")
    arguments = parser.parse_args()
    path = Path(arguments.picture)
    if path.suffix not in {".webp", ".png"}:
        parser.error(f"picture: {path} is not .webp or .png")
    if arguments.frames and path.suffix != ".png":
        parser.error("--frames chooses the frames of a .png")
    try:
        file = OutputFile(path)
    except OSError as error:
        parser.error(f"picture: {error}")
    try:
        film = make(*[getattr(arguments, name.lstrip("-")) for name in inputs])
        chosen = range(film.frames)
        if path.suffix == ".png":
            chosen = arguments.frames or np.linspace(0, film.frames - 1, 5).round().astype(int).tolist()
        if not all(0 <= frame < film.frames for frame in chosen):
            parser.error(f"--frames: the film has frames 0 to {film.frames - 1}")
        pictures = [film.draw(frame) for frame in track(chosen, "Rendering")]
        file.write(_strip(pictures) if path.suffix == ".png" else _animation(pictures, film))
        file.commit()
    finally:
        file.discard()


def _animation(pictures, film):
    """Returns an animated WebP of pictures that goes on for ever, as bytes."""
    buffer = io.BytesIO()
    part = film.part or film.frames
    durations = [film.duration if (i + 1) % part else film.pause for i in range(film.frames)]
    options = {"save_all": True, "append_images": pictures[1:], "duration": durations, "loop": 0}
    pictures[0].save(buffer, "WEBP", quality=film.quality, method=4, **options)
    return buffer.getvalue()


def _strip(pictures):
    """Returns a PNG of pictures below each other, or beside each other if they are higher than wide, as bytes."""
    width, height = pictures[0].size
    across = height > width
    step = (width, 0) if across else (0, height)
    size = (width * len(pictures), height) if across else (width, height * len(pictures))
    strip = Image.new("RGB", size)
    for i, picture in enumerate(pictures):
        strip.paste(picture, (i * step[0], i * step[1]))
    buffer = io.BytesIO()
    strip.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def beside(pictures, titles, note="", band=0):
    """Returns pictures beside each other.

    Args:
        pictures: The pictures.
        titles: A title above each.
        note: Words in the corner at the right and the bottom.
        band: Height of a band above the pictures for the titles, which otherwise stand in the pictures [pixels].
    """
    gap = 4
    width, height = pictures[0].size
    whole = Image.new("RGB", (len(pictures) * (width + gap) - gap, height + band), "white")
    draw = ImageDraw.Draw(whole)
    font = ImageFont.load_default(max(15, width // 20))
    for i, (picture, title) in enumerate(zip(pictures, titles, strict=True)):
        left = i * (width + gap)
        draw.rectangle((left, 0, left + width - 1, band), fill=_BACKGROUND)
        whole.paste(picture, (left, band))
        draw.text((left + 0.5 * width, 14), title, fill=_INK, font=font, anchor="ma", align="center", stroke_width=0.4)
    draw.text((whole.width - 12, height - 10), note, fill=_INK, font=ImageFont.load_default(15), anchor="rs")
    return whole


def dots(picture, pixels, color, radius):
    """Draws dots over a picture.

    Args:
        picture: The picture, which is changed.
        pixels: Middles of the dots, to the right and down [pixels], shape [n, 2].
        color: Color of the dots.
        radius: Radius of the dots [pixels].
    """
    finer = 4
    mask = Image.new("L", [finer * side for side in picture.size])
    draw = ImageDraw.Draw(mask)
    for x, y in finer * np.asarray(pixels):
        draw.circle((float(x), float(y)), finer * radius, fill=255)
    picture.paste(color, mask=mask.resize(picture.size, Image.Resampling.BOX))


def box(half):
    """Returns corners and faces, shapes [8, 3] and [6, 4], of a box around the origin, given half its sides [m]."""
    corners = (np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0) * half
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners, np.array(faces)


def linear(color):
    """Returns a color "#rrggbb" in linear light, shape [3]."""
    encoded = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


class Studio:
    """Meshes, a camera, an area light and a sky, rendered by Cycles on the CPU.

    There is one at a time: the next one begins with an empty scene.
    """

    def __init__(self, size, eye, target, lens=50.0, ground=None, light=(-1.0, 0.25, 0.65), samples=16):
        """Makes an empty studio.

        Args:
            size: Width and height of pictures [pixels].
            eye: Position of the camera [m].
            target: Position in the middle of the picture [m].
            lens: Focal length of the camera, whose sensor is 36 mm wide [mm].
            ground: Height of the ground [m], by default none.
            light: Position of the light, relative to the target, in distances of the camera.
            samples: Paths of light through each pixel.
        """
        import bpy  # noqa: PLC0415
        from mathutils import Vector  # noqa: PLC0415

        self._bpy, self._vector = bpy, Vector
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = scene = bpy.context.scene
        scene.render.engine = "CYCLES"
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.image_settings.file_format = "PNG"
        scene.render.use_persistent_data = scene.render.film_transparent = True
        scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = samples, True, 3
        scene.cycles.denoising_prefilter, scene.cycles.denoising_quality = "NONE", "BALANCED"  # a third of the time
        scene.view_settings.view_transform = "Khronos PBR Neutral"
        eye, target = np.array(eye, dtype=float), np.array(target, dtype=float)
        distance = np.linalg.norm(eye - target)
        scene.camera = self._place("camera", bpy.data.cameras.new("camera"), eye, target)
        scene.camera.data.lens = lens
        scene.camera.data.clip_start, scene.camera.data.clip_end = 0.01 * distance, 100.0 * distance
        lamp = bpy.data.lights.new("light", "AREA")
        lamp.size, lamp.energy = 0.3 * distance, 24.0 * distance**2
        self._place("light", lamp, target + distance * np.array(light), target)
        fill = bpy.data.lights.new("fill", "AREA")
        fill.size, fill.energy = 1.0 * distance, 12.0 * distance**2
        self._place("fill", fill, eye - (0.0, 0.0, 1.2 * distance), target)
        self._add_sky()
        if ground is not None:
            self._add_ground(ground, target, distance)

    def _place(self, name, data, position, target):
        """Adds something that looks at a target, and returns it."""
        placed = self._bpy.data.objects.new(name, data)
        self._scene.collection.objects.link(placed)
        placed.location = position
        placed.rotation_euler = self._vector(target - position).to_track_quat("-Z", "Y").to_euler()
        return placed

    def _add_sky(self):
        """Adds a sky that lights evenly."""
        self._scene.world = world = self._bpy.data.worlds.new("sky")
        world.use_nodes = True
        sky = world.node_tree.nodes["Background"]
        sky.inputs["Color"].default_value = (0.80, 0.90, 1.0, 1.0)
        sky.inputs["Strength"].default_value = 0.38

    def _add_ground(self, height, target, distance):
        """Adds a ground on which only shadows are seen."""
        w = 4.0 * distance
        middle = np.array([target[0], target[1], height])
        ground = self.add("ground", np.array([[0, 1, 2, 3]]), "#ffffff", sheen=0.0)
        ground.is_shadow_catcher = True
        self.move(ground, middle + np.array([[-w, -w, 0.0], [w, -w, 0.0], [w, w, 0.0], [-w, w, 0.0]]))

    def add(self, name, faces, colors, sheen=0.25, smooth=True):
        """Adds a mesh, which :meth:`move` must place, and returns it.

        Args:
            name: Name of the mesh.
            faces: Vertex indices, shape [n, corners of a face].
            colors: A color "#rrggbb", or one of each face in linear light, shape [n, 3].
            sheen: Share of light that fibres scatter at grazing angles.
            smooth: Whether normals are interpolated.
        """
        bpy = self._bpy
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(np.zeros((faces.max() + 1, 3)).tolist(), [], faces.tolist())
        mesh.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
        rgba = np.ones((len(faces), 4), dtype=np.float32)
        rgba[:, :3] = linear(colors) if isinstance(colors, str) else colors
        mesh.attributes.new("tint", "FLOAT_COLOR", "FACE").data.foreach_set("color", rgba.ravel())
        material = bpy.data.materials.new(name)
        material.use_nodes = True
        nodes = material.node_tree.nodes
        surface = nodes["Principled BSDF"]
        surface.inputs["Roughness"].default_value = 0.75
        surface.inputs["Sheen Weight"].default_value = sheen
        attribute = nodes.new("ShaderNodeAttribute")
        attribute.attribute_name = "tint"
        material.node_tree.links.new(attribute.outputs["Color"], surface.inputs["Base Color"])
        mesh.materials.append(material)
        placed = bpy.data.objects.new(name, mesh)
        self._scene.collection.objects.link(placed)
        return placed

    def move(self, mesh, positions):
        """Sets the positions of the vertices of a mesh that :meth:`add` returned [m], shape [n, 3]."""
        mesh.data.vertices.foreach_set("co", np.asarray(positions, dtype=np.float32).ravel())
        mesh.data.update()

    def shoot(self):
        """Returns a picture, as an image of Pillow."""
        with tempfile.TemporaryDirectory() as folder:
            self._scene.render.filepath = str(Path(folder) / "frame.png")
            self._bpy.ops.render.render(write_still=True)
            seen = Image.open(self._scene.render.filepath).convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", seen.size, _BACKGROUND), seen).convert("RGB")

    def pixels(self, points):
        """Returns where points [m], shape [n, 3], are in a picture, to the right and down [pixels], shape [n, 2]."""
        view = np.array(self._scene.camera.matrix_world.inverted())
        seen = np.asarray(points, dtype=float) @ view[:3, :3].T + view[:3, 3]
        width, height = self._scene.render.resolution_x, self._scene.render.resolution_y
        across = seen[:, :2] / -seen[:, 2:] * self._scene.camera.data.lens / _SENSOR * max(width, height)
        return across * (1.0, -1.0) + (0.5 * width, 0.5 * height)
