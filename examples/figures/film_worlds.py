"""Films 1,024 worlds that one solver steps, in each of which a cloth falls on a ball.

    python examples/figures/film_worlds.py worlds.webp

From column to column it falls farther beside the ball, from row to row it has more friction. Needs Pillow.
"""

import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp
from PIL import Image, ImageDraw, ImageFilter, ImageFont

import warp_bsc as bsc

sys.path.append(str(Path(__file__).parent))  # for what films share
import film

_WORLDS, _COLUMNS = 1024, 32
_STEPS, _RATE = 54, 60
_CELLS, _SIDE, _RADIUS = 5, 0.32, 0.12  # cells and side of a cloth, radius of a ball [m]
_CLOTH = {"mass": 0.0007, "tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 0.1, "edge_ke": 1e-3, "edge_kd": 1e-4}
_BESIDE, _FRICTION = 1.5 * _RADIUS, 0.4  # at most

_SIZE, _FINER = (880, 460), 2  # pixels, and how much finer they are drawn
_EYE, _TARGET, _FOCUS = (0.0, -40.0, 25.0), (0.0, -1.35, 0.0), 2120.0  # m, m, pixels
_LIGHT = np.array([-0.45, -0.35, 0.82]) / np.linalg.norm([-0.45, -0.35, 0.82])
_SPACING = 0.49, 0.52  # of balls in the picture [m]
_GROUND, _SHADOW, _INK = "#f3f1ec", "#c0beb9", "#26303a"


def place(worlds):
    """Returns the column and the row of worlds, each in [0, 1]."""
    row, column = np.divmod(np.arange(worlds), _COLUMNS)
    return column / (_COLUMNS - 1), row / (worlds // _COLUMNS - 1)


def build(worlds):
    """Returns a model of worlds, and the friction of its particles."""
    world, cell = newton.ModelBuilder(), _SIDE / _CELLS
    world.add_ground_plane()
    world.add_shape_sphere(-1, radius=_RADIUS, xform=wp.transform(wp.vec3(0.0, 0.0, _RADIUS), wp.quat_identity()))
    pose = {"pos": wp.vec3(-0.5 * _SIDE, -0.5 * _SIDE, 0.0), "rot": wp.quat_identity(), "vel": wp.vec3()}
    size = {"dim_x": _CELLS, "dim_y": _CELLS, "cell_x": cell, "cell_y": cell, "particle_radius": 0.005}
    world.add_cloth_grid(**pose, **size, **_CLOTH)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    flat = np.reshape(builder.particle_q, (worlds, -1, 3))
    column, row = place(worlds)
    rng = np.random.default_rng(0)
    angle, slope = rng.uniform(0.0, 0.5 * np.pi, worlds), rng.uniform(-0.3, 0.3, (worlds, 2))
    axes = np.stack([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
    x = np.empty_like(flat)
    x[..., :2] = flat[..., :2] @ axes
    x[..., 2] = 2.0 * _RADIUS + 0.1 + (x[..., :2] @ slope[:, :, None])[..., 0]
    x[..., 0] += _BESIDE * (0.05 + 0.95 * column[:, None])
    builder.particle_q = [wp.vec3(position) for position in x.reshape(-1, 3)]
    model = builder.finalize(device="cpu")
    return model, wp.array(np.repeat(_FRICTION * row, x.shape[1]), dtype=float, device="cpu")


def simulate():
    """Returns faces, positions after each step, shape [steps + 1, particles, 3], and uncertified steps until each."""
    model, friction = build(_WORLDS)
    solver = bsc.SolverImplicit(model, friction=friction)
    start, end = model.state(), model.state()
    states, uncertified = [start.particle_q.numpy().copy()], [0]
    for _ in range(_STEPS):
        solver.step(start, end, None, None, 1.0 / _RATE)
        start, end = end, start
        states.append(start.particle_q.numpy().copy())
        uncertified.append(solver.report.totals.uncertified_steps)
    return model.tri_indices.numpy(), np.array(states), uncertified


class Camera:
    """Where points are in the picture, which is drawn finer than it is shown."""

    def __init__(self):
        self.eye = np.array(_EYE)
        forward = np.array(_TARGET) - self.eye
        forward /= np.linalg.norm(forward)
        self.right = np.cross(forward, [0.0, 0.0, 1.0])
        self.right /= np.linalg.norm(self.right)
        self.axes = np.stack([self.right, np.cross(forward, self.right), forward], axis=1)

    def see(self, points):
        """Returns pixels to the right and down, and distances along the view [m]."""
        seen = (points - self.eye) @ self.axes
        middle = 0.5 * np.array(_SIZE)
        return _FINER * (_FOCUS * seen[..., :2] / seen[..., 2:] + middle), seen[..., 2]

    def is_hidden(self, balls, points):
        """Returns whether the ball of each world hides each of its points, shapes [n, 3] and [n, m, 3]."""
        way = points - self.eye
        length = np.linalg.norm(way, axis=-1)
        way /= length[..., None]
        along = np.einsum("nmi,ni->nm", way, balls - self.eye)
        beside = np.linalg.norm(balls[:, None] - self.eye - along[..., None] * way, axis=-1)
        half = np.sqrt(np.maximum((0.96 * _RADIUS) ** 2 - beside**2, 0.0))  # of the chord; cloths lie on the ball
        return (half > 0.0) & (along - half < length)


def encode(light):
    """Returns colors of linear light, uint8."""
    return np.uint8(255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / 2.2) + 0.5)


def ball_picture(radius, light):
    """Returns a picture of a ball and its mask, given the direction of the light in the picture."""
    y, x = np.mgrid[: 2 * radius, : 2 * radius] / radius - 1.0 + 0.5 / radius
    normal = np.stack([x, y, -np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))], axis=-1)
    shaded = film.linear(film.GREY) * (0.45 + 0.55 * np.maximum(normal @ light, 0.0))[..., None]
    return Image.fromarray(encode(shaded)), Image.fromarray(np.uint8(255 * (x * x + y * y <= 1.0)))


def shadows(camera, triangles, balls):
    """Returns where the ground is in the shadow of triangles, shape [n, 3, 3], and balls, as a mask."""
    mask = Image.new("L", [_FINER * side for side in _SIZE])
    pen = ImageDraw.Draw(mask)
    angle = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    ring = _RADIUS * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    for shapes in (triangles, balls[:, None] + ring):
        pixels, _ = camera.see(shapes - shapes[..., 2:] / _LIGHT[2] * _LIGHT)
        for corners in pixels.reshape(len(shapes), -1).tolist():
            pen.polygon(corners, fill=255)
    return mask.filter(ImageFilter.GaussianBlur(1.5 * _FINER))


def make():
    """Returns the film."""
    faces, states, uncertified = simulate()
    column, row = place(_WORLDS)
    middles = np.stack([column - 0.5, row - 0.5, 0.0 * row], axis=1) * (_COLUMNS - 1) * (*_SPACING, 0.0)
    balls = middles + np.array([0.0, 0.0, _RADIUS])
    camera = Camera()
    ball_pixels, ball_distance = camera.see(balls)
    beside, _ = camera.see(balls + _RADIUS * camera.right)
    radii = np.linalg.norm(beside - ball_pixels, axis=-1).round().astype(int)
    ball_corners = (ball_pixels - radii[:, None]).round().astype(int).tolist()
    pictures = {radius: ball_picture(radius, _LIGHT @ camera.axes) for radius in set(radii.tolist())}
    count = len(faces)
    world = np.repeat(np.arange(_WORLDS), count // _WORLDS)
    tint = (film.linear(film.BLUE) + row[:, None] * (film.linear(film.ORANGE) - film.linear(film.BLUE)))[world]

    def draw(step):
        """Returns the picture after a step: triangles behind the ball of their world, balls, triangles before them."""
        x = (states[step].reshape(_WORLDS, -1, 3) + middles[:, None]).reshape(-1, 3)
        triangles = x[faces]
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        colors = list(map(tuple, encode(tint * (0.4 + 0.6 * np.abs(normal @ _LIGHT))[:, None]).tolist()))
        pixels, distance = camera.see(triangles)
        hidden = camera.is_hidden(balls, triangles.mean(axis=1).reshape(_WORLDS, -1, 3)).ravel()
        layer = np.concatenate([np.where(hidden, 0, 2), np.ones(_WORLDS)])
        distance = np.concatenate([distance.mean(axis=1), ball_distance])
        order = np.lexsort([-distance, layer, -np.concatenate([row[world], row])])  # rows from the back
        picture = Image.new("RGB", [_FINER * side for side in _SIZE], _GROUND)
        picture.paste(_SHADOW, mask=shadows(camera, triangles, balls))
        pen, pixels = ImageDraw.Draw(picture), pixels.reshape(count, -1).tolist()
        for i in order.tolist():
            if i < count:
                pen.polygon(pixels[i], fill=colors[i])
            else:
                ball, mask = pictures[int(radii[i - count])]
                picture.paste(ball, ball_corners[i - count], mask)
        picture = picture.resize(_SIZE, Image.Resampling.BOX)
        pen, font = ImageDraw.Draw(picture), ImageFont.load_default(17)
        worlds = f"{_WORLDS:,} worlds, {count:,} triangles, one SolverImplicit"
        steps = f"step {step} of 1/{_RATE} s, {uncertified[step]} uncertified"
        for left, anchor, text in ((14, "ls", worlds), (_SIZE[0] - 14, "rs", steps)):
            pen.text((left, _SIZE[1] - 12), text, fill=_INK, font=font, anchor=anchor)
        return picture

    return film.Film(len(states), draw, duration=50, pause=1500, quality=50)


def main():
    """Reads the command line, and renders the film."""
    film.main(__doc__, make)


if __name__ == "__main__":
    main()
