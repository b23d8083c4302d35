"""The scenes of ``warp-bsc bench penetration``: cloth and a soft body that meet, as models of Newton.

Lengths are in metres, z points up. No scene begins with a crossing, and no shape moves, so that other simulators can be
given the same scenes: their meshes, masses and stiffness are read from the model.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp

from .contact import Motion, Scene, SceneBuilder, build_scene

_STIFFNESS = 1e3  # N/m of the membranes that are hit
_FREE = 0.75
"""Share of the way to what it meets over which the speed of what flies is measured."""


@dataclass(frozen=True)
class PenetrationScene:
    """A scene.

    Attributes:
        scene: The model, and how held particles move.
        margin, gap: Distances of VBD's self-contact [m], those of the example of Newton that is nearest to the scene.
        flying: Particles that fly freely at first, whose speed is measured; empty if there are none.
        flight: Velocity at which they begin [m/s], shape [3].
        seconds: Time after which that speed is measured [s]; from 4/3 of it on they meet something.
    """

    scene: Scene
    margin: float = 0.01  # as in softbody_dropping_to_cloth, whose cloth has cells of 0.05 m too
    gap: float = 0.01
    flying: range = range(0)
    flight: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seconds: float = 0.0


def _throw(model: newton.Model, particles: range, velocity: tuple[float, float, float]) -> None:
    """Gives particles a velocity."""
    assert model.particle_qd is not None
    qd = model.particle_qd.numpy()
    qd[particles.start : particles.stop] = velocity
    model.particle_qd.assign(qd)


def _build_bullet(builder: SceneBuilder) -> PenetrationScene:
    """A patch is shot at 20 m/s, at a sheet that is held at its border."""
    speed, distance = 20.0, 0.4
    cell = 0.05
    builder.add_cloth((0.0, 0.0, 0.0), (16, 16), cell, mass=0.3 * cell**2, stiffness=_STIFFNESS, is_held=True)
    sheet = builder.to.particle_count
    builder.add_cloth((0.013, 0.007, distance), (8, 8), 0.04, mass=0.3 * 0.04**2, stiffness=_STIFFNESS)
    patch, velocity = range(sheet, builder.to.particle_count), (0.0, 0.0, -speed)
    model = builder.finish()
    _throw(model, patch, velocity)
    scene = Scene(model, 0.5)
    return PenetrationScene(scene, flying=patch, flight=velocity, seconds=_FREE * distance / speed)


def _build_drape(builder: SceneBuilder) -> PenetrationScene:
    """A cloth drapes over a fixed sphere: the scene of the bench of contact."""
    return PenetrationScene(replace(build_scene("sphere", builder.solver, builder.rate), seconds=1.0))


def _build_stack(builder: SceneBuilder) -> PenetrationScene:
    """Five sheets fall on a sphere, on each other and on a floor."""
    # a little above the floor: libuipc refuses scenes in which shapes cross
    builder.to.add_shape_sphere(body=-1, xform=wp.transform(wp.vec3(0.0, 0.0, 0.16), wp.quat_identity()), radius=0.15)
    builder.add_box((0.0, 0.0, -0.05), (0.6, 0.6, 0.05))
    for sheet in range(5):
        builder.add_cloth((0.02 * sheet - 0.04, 0.013 * sheet, 0.34 + 0.04 * sheet), (12, 12), 0.05)
    return PenetrationScene(Scene(builder.finish(), 1.0))


def _build_twist(builder: SceneBuilder) -> PenetrationScene:
    """Two opposite borders of a cloth are turned against each other, two turns together, without gravity."""
    cells, cell = (32, 12), 0.025
    builder.to.gravity = (0.0, 0.0, 0.0)
    builder.add_cloth((0.0, 0.0, 0.0), cells, cell, mass=0.2 * cell**2, stiffness=5e2, radius=0.002)
    across = cells[0] + 1
    held = tuple(row * across + column for row in range(cells[1] + 1) for column in (0, cells[0]))
    for i in held:
        builder.to.particle_mass[i] = 0.0
        builder.to.particle_flags[i] &= ~newton.ParticleFlags.ACTIVE
    start = np.array([builder.to.particle_q[i] for i in held], dtype=np.float64)
    turn = 2.0 * np.pi * np.sign(start[:, 0])  # one turn a second at each border

    def positions(t: float) -> np.ndarray:
        y, z = start[:, 1], start[:, 2]
        c, s = np.cos(turn * t), np.sin(turn * t)
        return np.stack([start[:, 0], c * y - s * z, s * y + c * z], axis=1)

    motion = Motion(held=held, positions=positions)
    return PenetrationScene(Scene(builder.finish(), 1.0, motion=motion), 0.002, 0.0015)  # as in cloth_twist


def _build_soft(builder: SceneBuilder) -> PenetrationScene:
    """A soft block is thrown at 4 m/s on a sheet that is held at its border."""
    velocity, cell, distance = (0.0, 0.0, -4.0), 0.05, 0.04
    builder.add_cloth((0.0, 0.0, 0.0), (16, 16), cell, mass=0.3 * cell**2, stiffness=_STIFFNESS, is_held=True)
    sheet = builder.to.particle_count
    builder.add_block((0.013, 0.007, distance), 3, 0.05, turn=0.4)
    block = range(sheet, builder.to.particle_count)
    model = builder.finish()
    _throw(model, block, velocity)
    return PenetrationScene(Scene(model, 0.5), flying=block, flight=velocity, seconds=_FREE * distance / 4.0)


SCENES: dict[str, Callable[[SceneBuilder], PenetrationScene]] = {
    "bullet": _build_bullet,
    "drape": _build_drape,
    "stack": _build_stack,
    "twist": _build_twist,
    "soft": _build_soft,
}
"""Functions that build the scenes, by name, in the order of :data:`..measure.penetration.SCENES`."""


def build_penetration_scene(name: str, solver: str, rate: int) -> PenetrationScene:
    """Builds a scene of :data:`SCENES`, with other arguments and errors as of :func:`.contact.build_scene`."""
    return SCENES[name](SceneBuilder(solver, rate))
