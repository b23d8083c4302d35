"""The scenes of ``warp-bsc bench response``: cloth, soft bodies, ropes and a ball in contact, for any solver of Newton.

Lengths are in metres, z points up. No scene begins with a crossing.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import newton
import numpy as np
import warp as wp

_FRICTION = 0.5
_IDENTITY = wp.quat_identity()
_EXPLICIT_CONTACT = 1e2, 0.1, 0.5
"""Stiffness [N/m], damping and friction [N s/m] of Newton's contacts in an explicit solver."""
_XPBD_STIFFNESS = 0.1  # N/m of a spring for each kilogram of a particle, times the steps a second squared


class NotRunnable(Exception):
    """A solver cannot run a scene; the message says why."""


@dataclass(frozen=True)
class Motion:
    """What a program moves: kinematic bodies, which are the first of the model, and held particles."""

    # poses of the bodies at a time [s], shape [body_count, 7]; None if there are none
    poses: Callable[[float], np.ndarray] | None = None
    held: tuple[int, ...] = ()  # numbers of the particles
    # their positions at a time [m], shape [held_count, 3]; None if there are none
    positions: Callable[[float], np.ndarray] | None = None


@dataclass(frozen=True)
class Scene:
    """A scene."""

    model: newton.Model  # the model
    seconds: float  # simulated time [s]
    rate: int = 60  # steps a second
    motion: Motion | None = None  # what a program moves; None if nothing
    resets: dict[float, tuple[int, ...]] = field(default_factory=dict)  # worlds that a program resets, by time [s]
    stage_options: dict[str, Any] = field(default_factory=dict)  # arguments of the stage that the scene needs
    strands: bool = False  # whether springs without faces are edges that collide


class SceneBuilder:
    """Adds the parts of a scene to a builder of Newton, with materials for one solver.

    Attributes:
        solver: Name of the solver.
        rate: Steps a second.
        to: The builder.
    """

    def __init__(self, solver: str, rate: int = 60):
        self.solver, self.rate, self.to = solver, rate, newton.ModelBuilder()
        shape = self.to.default_shape_cfg
        shape.mu = _FRICTION
        if solver == "semi-implicit":  # explicit: its step takes no stiffer contacts, nor more damping
            shape.ke, shape.kd, shape.kf = _EXPLICIT_CONTACT
        if solver == "style3d":
            newton.solvers.SolverStyle3D.register_custom_attributes(self.to)

    def add_cloth(
        self,
        at: tuple[float, float, float],
        cells: tuple[int, int],
        cell: float,
        *,
        mass: float = 5e-4,
        stiffness: float = 2e2,
        radius: float = 0.005,
        is_held: bool = False,
    ):
        """Adds a rectangle of cloth in the xy plane around a centre; its border may be held.

        Args:
            at: The centre.
            cells: Cells along x and y.
            cell: Width of a cell.
            mass: Mass of a particle [kg].
            stiffness: Stiffness of the membrane [N/m].
            radius: Radius of particles.
            is_held: Whether the border is held.
        """
        sides = dict.fromkeys(("fix_left", "fix_right", "fix_top", "fix_bottom"), is_held)
        corner = np.subtract(at, (0.5 * cells[0] * cell, 0.5 * cells[1] * cell, 0.0))
        options = {"dim_x": cells[0], "dim_y": cells[1], "cell_x": cell, "cell_y": cell, "mass": mass}
        options |= {"pos": wp.vec3(*corner), "rot": _IDENTITY, "vel": wp.vec3(), "particle_radius": radius, **sides}
        if self.solver == "style3d":
            newton.solvers.style3d.add_cloth_grid(self.to, **options, **_anisotropic(stiffness))
        else:
            self.to.add_cloth_grid(**options, **self._membrane(stiffness, mass))

    def add_cloth_mesh(
        self, points: np.ndarray, faces: np.ndarray, *, density: float, stiffness: float, radius: float = 0.002
    ):
        """Adds cloth that is at rest as it is given; the density is in kg/m^2."""
        if self.solver == "style3d":
            raise NotRunnable("Style3D needs the cut of a cloth in its plane, and a tube has none here")
        a, b, c = points[faces].transpose(1, 0, 2)
        area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
        options = {"pos": wp.vec3(), "rot": _IDENTITY, "scale": 1.0, "vel": wp.vec3(), "particle_radius": radius}
        options |= {"vertices": [wp.vec3(*point) for point in points], "indices": faces.ravel().tolist()}
        options |= self._membrane(stiffness, density * area / len(points))
        self.to.add_cloth_mesh(**options, density=density)

    def add_block(
        self, at: tuple[float, float, float], cells: int, cell: float, *, stiffness: float = 2e4, turn: float = 0.0
    ):
        """Adds a cube of tetrahedra whose base has its centre at a place, turned about z; the stiffness is in Pa."""
        if self.solver == "style3d":
            raise NotRunnable("Style3D has no tetrahedra")
        rotation = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), turn)
        half = 0.5 * cells * cell
        to_corner = (half * (np.sin(turn) - np.cos(turn)), -half * (np.sin(turn) + np.cos(turn)), 0.0)
        self.to.add_soft_grid(
            pos=wp.vec3(*np.add(at, to_corner)),
            rot=rotation,
            vel=wp.vec3(),
            **dict.fromkeys(("dim_x", "dim_y", "dim_z"), cells),
            **dict.fromkeys(("cell_x", "cell_y", "cell_z"), cell),
            density=300.0,
            k_mu=stiffness,
            k_lambda=stiffness,
            k_damp=0.0 if self.solver == "xpbd" else 100.0,  # with that of XPBD they stretch more
            particle_radius=0.002,
        )

    def add_rope(self, points: np.ndarray, *, radius: float = 0.004):
        """Adds a row of particles that springs join."""
        if self.solver == "style3d":
            raise NotRunnable("Style3D moves no springs without cloth")
        first = self.to.particle_count
        for point in points:
            self.to.add_particle(wp.vec3(*point), wp.vec3(), 0.001, radius=radius)
        for i in range(first, self.to.particle_count - 1):
            self.to.add_spring(i, i + 1, 1e3, 0.01, 0.0)

    def add_box(self, at: tuple[float, float, float], half: tuple[float, float, float], body: int = -1):
        """Adds a box, in the frame of a body."""
        self.to.add_shape_box(body, xform=wp.transform(wp.vec3(*at), _IDENTITY), hx=half[0], hy=half[1], hz=half[2])

    def add_walled_floor(self, half: float, height: float):
        """Adds a fixed floor at height 0 with four walls around a square, whose half width is given."""
        self.add_box((0.0, 0.0, -0.05), (half + 0.04, half + 0.04, 0.05))
        for sign in (-1.0, 1.0):
            self.add_box((sign * (half + 0.02), 0.0, 0.5 * height), (0.02, half + 0.04, 0.5 * height))
            self.add_box((0.0, sign * (half + 0.02), 0.5 * height), (half + 0.04, 0.02, 0.5 * height))

    def add_kinematic_body(self, pose: np.ndarray) -> int:
        """Adds a body that a program moves."""
        return self.to.add_body(xform=wp.transform(*pose.tolist()), is_kinematic=True)

    def finish(self) -> newton.Model:
        """Returns the model on Warp's current device."""
        if self.solver == "vbd":
            self.to.color()
        model = self.to.finalize()
        model.soft_contact_ke, model.soft_contact_kd = 1e4, 1e-2
        model.soft_contact_mu = model.particle_mu = _FRICTION
        if self.solver == "semi-implicit":
            model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_kf = _EXPLICIT_CONTACT
            model.particle_ke = model.particle_kd = model.particle_kf = 0.0  # between particles, far too stiff here
        return model

    def _membrane(self, stiffness: float, mass: float) -> dict[str, Any]:
        """Returns the material of cloth as arguments of Newton; XPBD has springs instead of triangles."""
        if self.solver == "xpbd":  # stiffer springs than this, by the mass of a particle, burst in XPBD itself
            spring = min(stiffness, _XPBD_STIFFNESS * self.rate**2 * mass)
            return {"edge_ke": 0.0, "edge_kd": 0.0, "add_springs": True, "spring_ke": spring, "spring_kd": 0.0}
        return {"tri_ke": stiffness, "tri_ka": stiffness, "tri_kd": 1e-3, "edge_ke": 1e-3, "edge_kd": 1e-4}


def _anisotropic(stiffness: float) -> dict[str, Any]:
    return {"tri_aniso_ke": wp.vec3(stiffness, stiffness, 0.1 * stiffness), "edge_aniso_ke": wp.vec3(2e-5, 1e-5, 5e-6)}


def _ease(t: float) -> float:
    """Returns a ramp from 0 to 1 without a jump of the velocity."""
    t = min(max(t, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


def _pose(x: float, y: float, z: float, rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)):
    return np.array([x, y, z, *rotation])


def _revolve(profile: np.ndarray, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the points and faces of a profile (radius, height) turned about z, without caps."""
    angle = 2.0 * np.pi * np.arange(around) / around
    radius, height = profile.T[:, :, None]
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height + 0.0 * angle], axis=-1).reshape(-1, 3)
    ring, i = np.mgrid[: len(profile) - 1, :around]
    a, b = ring * around + i, ring * around + (i + 1) % around
    faces = np.stack([np.stack([a, b, a + around], axis=-1), np.stack([b, b + around, a + around], axis=-1)], axis=2)
    return points, faces.reshape(-1, 3)


def _build_sphere(builder: SceneBuilder) -> Scene:
    """A cloth drapes over a fixed sphere."""
    builder.to.add_shape_sphere(body=-1, radius=0.2)
    builder.add_cloth((0.0, 0.0, 0.23), (16, 16), 0.05)
    return Scene(builder.finish(), 2.5)


def _build_box_edge(builder: SceneBuilder) -> Scene:
    """A cloth falls across the edge of a fixed box, and hangs from it by friction."""
    builder.add_box((-0.25, 0.0, -0.15), (0.25, 0.3, 0.15))
    builder.add_cloth((-0.06, 0.0, 0.03), (16, 12), 0.035)
    return Scene(builder.finish(), 2.0)


def _build_tube_cone(builder: SceneBuilder) -> Scene:
    """An elastic tube is pulled over a fixed cone by its flared mouth, which is wider than the cone."""
    upside_down = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), np.pi)
    place = wp.transform(wp.vec3(0.0, 0.0, 0.1), upside_down)
    builder.to.add_shape_cone(-1, xform=place, radius=0.062, half_height=0.1)  # its tip at the origin
    around, mouth, narrow = 14, 0.066, 0.03
    height = np.linspace(0.02, -0.14, 11)
    radius = narrow + (mouth - narrow) * np.clip((height + 0.03) / 0.05, 0.0, 1.0)
    points, faces = _revolve(np.stack([radius, height], axis=1), around)
    builder.add_cloth_mesh(points, faces, density=1.0, stiffness=50.0)
    for i in range(around):
        builder.to.particle_mass[i] = 0.0
        builder.to.particle_flags[i] &= ~newton.ParticleFlags.ACTIVE

    def positions(t: float) -> np.ndarray:
        return points[:around] + np.array([0.0, 0.0, 0.15 * _ease(t / 1.6)])

    motion = Motion(held=tuple(range(around)), positions=positions)
    return Scene(builder.finish(), 2.4, motion=motion)


def _build_fold(builder: SceneBuilder) -> Scene:
    """A hinged plate under half of a cloth on a table turns by 150 degrees, folds the cloth, and turns back."""
    hinge, half = 0.01, (0.1, 0.15, 0.004)

    def poses(t: float) -> np.ndarray:
        angle = np.radians(150.0) * (_ease(t - 0.3) - _ease((t - 1.4) / 0.8))
        return _pose(0.0, 0.0, hinge, (0.0, -np.sin(0.5 * angle), 0.0, np.cos(0.5 * angle)))[None]

    plate = builder.add_kinematic_body(poses(0.0)[0])
    builder.add_box((half[0], 0.0, -half[2]), half, plate)
    builder.add_box((0.0, 0.0, -0.05), (0.3, 0.3, 0.05))
    builder.add_cloth((0.0, 0.0, hinge + 0.006), (16, 10), 0.025, mass=2e-4, stiffness=1e2)
    return Scene(builder.finish(), 2.8, motion=Motion(poses))


def _build_soft_bowl(builder: SceneBuilder) -> Scene:
    """A soft block falls into a bowl."""
    inner, outer = (
        np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        for radius, angle in ((0.15, np.linspace(-0.48 * np.pi, 0.0, 7)), (0.17, np.linspace(0.0, -0.48 * np.pi, 7)))
    )
    points, faces = _revolve(np.concatenate([inner, outer]), 24)
    centres = [len(points), len(points) + 1]  # they close both ends of the profile
    points = np.concatenate([points, [[0.0, 0.0, -0.15], [0.0, 0.0, -0.17]]])
    around = np.arange(24)
    last = 13 * 24
    caps = [[centres[0], i, (i + 1) % 24] for i in around]
    caps += [[centres[1], last + (i + 1) % 24, last + i] for i in around]
    faces = np.concatenate([faces[:, ::-1], caps])
    a, b, c = points[faces].transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0.0  # counterclockwise from outside
    builder.to.add_shape_mesh(-1, mesh=newton.Mesh(points, faces.ravel()))
    builder.add_block((0.03, 0.02, 0.02), 4, 0.03)
    return Scene(builder.finish(), 2.0)


def _build_pile(builder: SceneBuilder) -> Scene:
    """Five soft cubes fall on each other, in a box without a lid."""
    builder.add_walled_floor(0.16, 0.5)
    places = (-0.06, 0.0, 0.01), (0.06, 0.005, 0.02), (0.01, 0.0, 0.14), (-0.01, 0.03, 0.26), (0.02, -0.02, 0.38)
    for place, turn in zip(places, (0.1, 0.4, 0.8, 0.2, 1.1), strict=True):
        builder.add_block(place, 3, 0.03, turn=turn)
    return Scene(builder.finish(), 2.5)


def _build_press(builder: SceneBuilder, *, height: float = 0.6, walls: bool = False) -> Scene:
    """A plate presses a soft block on a table to a share of its height, between walls or with room at its sides."""
    side, gap, half = 0.2, 0.002, 0.01
    width = 0.5 * side + (gap if walls else 0.1)

    def poses(t: float) -> np.ndarray:
        top = gap + side
        return _pose(0.0, 0.0, top + gap - _ease(t) * (top + gap - height * side) + half)[None]

    plate = builder.add_kinematic_body(poses(0.0)[0])
    builder.add_box((0.0, 0.0, 0.0), (width, width, half), plate)
    if walls:
        builder.add_walled_floor(width + 0.0005, 0.3)
    else:
        builder.add_box((0.0, 0.0, -0.05), (0.3, 0.3, 0.05))
    builder.add_block((0.0, 0.0, gap), 4, 0.05)
    return Scene(builder.finish(), 2.0, motion=Motion(poses))


def _build_ropes(builder: SceneBuilder) -> Scene:
    """Six ropes of springs fall across a cloth that is held at its border."""
    builder.add_cloth((0.0, 0.0, 0.0), (12, 12), 0.04, radius=0.004, is_held=True)
    rng = np.random.default_rng(1)
    along = 0.015 * (np.arange(20) - 9.5)
    for rope in range(6):
        angle, (x, y), height = rng.uniform(0.0, np.pi), rng.uniform(-0.05, 0.05, size=2), 0.03 + 0.02 * rope
        wave = height + 4e-4 * np.sin(along / 0.015)
        builder.add_rope(np.stack([x + along * np.cos(angle), y + along * np.sin(angle), wave], axis=1))
    model = builder.finish()
    options = {"particle_radius": model.particle_radius}  # without a distance springs collide with nothing
    return Scene(model, 2.0, stage_options=options, strands=True)


_BALL_RADIUS, _BALL_MASS, _BALL_SPEED, _BALL_HEIGHT = 0.02, 0.034, 40.0, 0.3


def _add_net(builder: SceneBuilder):
    """Adds the cloth that the balls meet."""
    if builder.solver == "semi-implicit":
        raise NotRunnable("the cloth is too stiff for the steps of an explicit solver")
    builder.add_cloth((0.0, 0.0, 0.0), (12, 12), 0.05, mass=1e-3, stiffness=4e3, is_held=True)


def _build_ball(builder: SceneBuilder) -> Scene:
    """A program moves a ball at 40 m/s into a cloth that is held at its border, and stops it 8 cm below."""

    def poses(t: float) -> np.ndarray:
        return _pose(0.013, 0.007, max(_BALL_HEIGHT - _BALL_SPEED * t, -0.08))[None]

    ball = builder.add_kinematic_body(poses(0.0)[0])
    builder.to.add_shape_sphere(ball, radius=_BALL_RADIUS)
    _add_net(builder)
    return Scene(builder.finish(), 1.5, rate=120, motion=Motion(poses))


def _build_ball_two_way(builder: SceneBuilder) -> Scene:
    """A ball of 34 g flies at 40 m/s into a cloth that is held at its border, which throws it back."""
    if builder.solver == "style3d":
        raise NotRunnable("Style3D moves no rigid bodies")
    inertia = 0.4 * _BALL_MASS * _BALL_RADIUS**2
    ball = builder.to.add_body(
        xform=wp.transform(wp.vec3(0.013, 0.007, _BALL_HEIGHT), _IDENTITY),
        mass=_BALL_MASS,
        inertia=wp.mat33(*np.diag([inertia] * 3).ravel().tolist()),
        lock_inertia=True,
    )
    config = builder.to.default_shape_cfg.copy()
    config.density = 0.0
    builder.to.add_shape_sphere(ball, radius=_BALL_RADIUS, cfg=config)
    _add_net(builder)
    model = builder.finish()
    assert model.body_qd is not None
    model.body_qd.assign(np.array([[0.0, 0.0, -_BALL_SPEED, 0.0, 0.0, 0.0]], dtype=np.float32))
    return Scene(model, 1.5, rate=120)


def _build_worlds(builder: SceneBuilder) -> Scene:
    """Eight worlds, in each of which a cloth drapes over a sphere from another height; two are reset on the way."""
    for number in range(8):
        world = SceneBuilder(builder.solver)
        world.to.add_shape_sphere(body=-1, radius=0.1)
        world.add_cloth((0.0, 0.0, 0.12 + 0.03 * number), (8, 8), 0.04)
        builder.to.add_world(world.to, xform=wp.transform(wp.vec3(number, 0.0, 0.0), _IDENTITY))
    return Scene(builder.finish(), 2.0, resets={0.8: (2, 5)})


SCENES: dict[str, Callable[[SceneBuilder], Scene]] = {
    "sphere": _build_sphere,
    "box_edge": _build_box_edge,
    "tube_cone": _build_tube_cone,
    "fold": _build_fold,
    "soft_bowl": _build_soft_bowl,
    "pile": _build_pile,
    "press": _build_press,
    "press_tight": functools.partial(_build_press, height=0.75, walls=True),
    "ropes": _build_ropes,
    "ball": _build_ball,
    "ball_two_way": _build_ball_two_way,
    "worlds": _build_worlds,
}
"""Functions that build the scenes, by name, in the order of :data:`..measure.response.SCENES`."""


def build_scene(name: str, solver: str, rate: int = 60) -> Scene:
    """Builds a scene for a solver on Warp's current device.

    Args:
        name: A key of :data:`SCENES`.
        solver: One of :data:`..measure.response.SOLVERS`.
        rate: Steps a second for which the springs of XPBD are made.

    Raises:
        NotRunnable: If the solver cannot run the scene; the message says why.
    """
    return SCENES[name](SceneBuilder(solver, rate))
