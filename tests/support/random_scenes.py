"""Random scenes of cloth, soft bodies and rigid bodies on the ground, with a solver."""

from dataclasses import dataclass

import newton
import numpy as np
import warp as wp
from newton_scenes import grid

import warp_bsc as bsc
from warp_bsc._private_names.of_newton import make_style3d

GRAVITY = 9.81
KINDS = "drape", "block", "pile", "bodies"


@dataclass(frozen=True)
class Settings:
    """What a scene is, but for its random numbers.

    Attributes:
        seed: Seed of the random numbers.
        kind: One of ``KINDS``.
        inner: The inner solver: ``"vbd"``, ``"xpbd"`` or ``"style3d"``, the last one for drapes and piles.
        contacts: Whether the program passes Newton's contacts on.
        rate: Steps a second.
    """

    seed: int
    kind: str
    inner: str
    contacts: bool
    rate: int

    @classmethod
    def draw(cls, seed):
        """Returns random settings."""
        rng = np.random.default_rng(seed)
        kind = KINDS[rng.integers(len(KINDS))]
        inners = ["vbd", "vbd", "xpbd", "style3d"] if kind in ("drape", "pile") else ["vbd", "xpbd"]
        return cls(
            seed,
            kind,
            inners[rng.integers(len(inners))],
            bool(rng.integers(2)),
            int(rng.choice([60, 120])),
        )

    def __str__(self):
        contacts = "contacts passed on" if self.contacts else "no contacts passed on"
        return f"{self.kind}, {self.inner}, {contacts}, 1/{self.rate} s"


class Scene:
    """A scene on the ground, at rest in itself: cloth and soft bodies start unstrained, all with one velocity.

    Attributes:
        model: The model.
    """

    def __init__(self, settings, device):
        self._settings = settings
        self._rng = np.random.default_rng([settings.seed, 1])
        builder = self._builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
        if settings.inner == "style3d":
            newton.solvers.SolverStyle3D.register_custom_attributes(builder)
        builder.add_ground_plane()
        self._radius = self._rng.choice([0.002, 0.005])
        getattr(self, f"_add_{settings.kind}")()
        builder.color()
        model = self.model = builder.finalize(device=device)
        model.soft_contact_ke = 10.0 ** self._rng.uniform(2.0, 4.0)
        model.soft_contact_kd = 1e-2
        model.soft_contact_mu = model.particle_mu = self._rng.uniform(0.0, 1.0)

    def _velocity(self, speed=1.0):
        return wp.vec3(*self._rng.uniform(-speed, speed, 3))

    def _add_cloth(self, at, side, n):
        """Adds cloth whose corner is at a place, of a mass of 0.2 to 1 kg a square metre."""
        rng, settings = self._rng, self._settings
        cell = side / n
        options = {"pos": wp.vec3(*at), "rot": wp.quat_identity(), "vel": self._velocity()}
        options |= grid(n, cell) | {"particle_radius": self._radius}
        options |= {"mass": rng.uniform(0.2, 1.0) * cell * cell}
        stiffness = 10.0 ** rng.uniform(2.0, 3.5)
        if settings.inner == "xpbd":  # stiffer springs than this burst in XPBD itself
            stiffness = rng.uniform(0.02, 0.1) * options["mass"] * settings.rate**2
        if settings.inner == "style3d":
            anisotropic = {"tri_aniso_ke": wp.vec3(stiffness, stiffness, 0.1 * stiffness)}
            anisotropic["edge_aniso_ke"] = wp.vec3(2e-5, 1e-5, 5e-6)
            newton.solvers.style3d.add_cloth_grid(self._builder, **options, **anisotropic)
        elif settings.inner == "xpbd":
            springs = {"edge_ke": 0.0, "edge_kd": 0.0, "add_springs": True, "spring_ke": stiffness, "spring_kd": 0.0}
            self._builder.add_cloth_grid(**options, **springs)
        else:
            material = {"tri_ke": stiffness, "tri_ka": stiffness, "tri_kd": 1e-4, "edge_ke": 1e-4, "edge_kd": 1e-6}
            self._builder.add_cloth_grid(**options, **material)

    def _add_support(self, size):
        """Adds a sphere, capsule or box that stands on the ground."""
        place = wp.transform(wp.vec3(0.0, 0.0, size), wp.quat_identity())
        match self._rng.integers(3):
            case 0:
                self._builder.add_shape_sphere(-1, xform=place, radius=size)
            case 1:
                turned = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.5 * np.pi)
                place = wp.transform(wp.vec3(0.0, 0.0, size), turned)
                self._builder.add_shape_capsule(-1, xform=place, radius=size, half_height=0.1)
            case _:
                self._builder.add_shape_box(-1, xform=place, hx=size, hy=0.7 * size, hz=size)

    def _add_drape(self):
        self._add_support(0.15)
        side = self._rng.uniform(0.5, 0.8)
        gap = self._radius + self._rng.uniform(0.002, 0.05)
        self._add_cloth((-0.5 * side, -0.5 * side, 0.3 + gap), side, int(self._rng.integers(5, 9)))

    def _add_pile(self):
        rng, height = self._rng, self._radius
        for _ in range(rng.integers(2, 5)):
            height += 0.01 + rng.uniform(0.0, 0.02)  # beyond the reach of contacts between particles
            x, y = rng.uniform(-0.05, 0.05, 2)
            self._add_cloth((x - 0.15, y - 0.15, height), 0.3, int(rng.integers(3, 7)))

    def _add_block(self):
        rng, height = self._rng, self._radius
        for _ in range(rng.integers(1, 3)):
            height += rng.uniform(0.005, 0.05)
            stiffness = 10.0 ** rng.uniform(3.5, 5.0)
            n, cell = int(rng.integers(2, 4)), 0.05
            x, y = rng.uniform(-0.03, 0.03, 2)
            self._builder.add_soft_grid(
                pos=wp.vec3(x, y, height),
                rot=wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), rng.uniform(0.0, 0.7)),
                vel=self._velocity(),
                **grid(n, cell, "xyz") | {"dim_z": 2},
                density=rng.uniform(200.0, 1000.0),
                k_mu=stiffness,
                k_lambda=stiffness,
                k_damp=0.0,
                particle_radius=self._radius,
            )
            height += 2.0 * cell + 2.0 * self._radius

    def _add_bodies(self):
        """Bodies under a cloth, or on one."""
        rng, on_top = self._rng, bool(self._rng.integers(2))
        size = rng.uniform(0.04, 0.08)
        low = 0.002 + size if not on_top else 0.03 + 2.0 * self._radius + size
        # the stage takes long to keep bodies apart by itself
        for x in (-0.15, 0.15) if self._settings.contacts else (0.0,):
            self._builder.default_shape_cfg.density = rng.uniform(100.0, 1000.0)
            body = self._builder.add_body(xform=wp.transform(wp.vec3(x, 0.0, low), wp.quat_identity()))
            self._builder.add_shape_box(body, hx=size, hy=0.7 * size, hz=size)
        height = 0.01 + self._radius if on_top else low + size + 2.0 * self._radius
        self._add_cloth((-0.3, -0.3, height), 0.6, int(rng.integers(4, 7)))

    def make_solver(self):
        """Returns the stage behind the inner solver."""
        settings, model = self._settings, self.model
        match settings.inner:
            case "vbd":
                solver = newton.solvers.SolverVBD(model, iterations=10)
            case "xpbd":
                # with the default relaxation, 0.9, XPBD bursts soft bodies by itself
                solver = newton.solvers.SolverXPBD(model, iterations=10, soft_body_relaxation=0.2)
            case _:
                solver = make_style3d(model, 5)
        # without Newton's contacts, nobody but the stage keeps bodies on the ground
        bodies = "separated" if model.body_count and not settings.contacts else "pushed"
        return bsc.SolverCCD(solver, bodies=bodies)
