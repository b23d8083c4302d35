"""Runs the scenes of ``warp-bsc bench penetration`` with libuipc, a library of Incremental Potential Contact on CUDA.

Its configuration is the default one but for the step, gravity and the distance at which contact begins: by default
1 cm, as wide as the thickness of ten sheets of cloth here.
"""

import tempfile
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from ...response.state.mesh import ModelMesh, host_array
from ..scenes.contact import NotRunnable
from ..scenes.penetration import PenetrationScene
from ..scenes.simulation import NotFinite
from .states import Body, NotInstalled, Trajectory, find_bodies, held_positions

try:
    import uipc
    from uipc import builtin, constitution, geometry
except ImportError:  # also where a library that it needs is missing
    uipc = cast(Any, None)

_THICKNESS = 1e-3
"""Of cloth [m], as in its default configuration of shells and as MuJoCo has it here."""
_CONTACT_DISTANCE = 1e-3
"""Distance at which contact begins to push [m]; by default 0.01 m."""
_STRENGTH = 1e6
"""Strength of the constraints that move held particles, relative to masses; by default 100. Those of ``twist`` lag by
0.03 mm at most; at 1e4 by 2.3 mm, and the cloth stretches by 2.7 percentage points less."""
_RIGID = 1e8
"""Stiffness of fixed shapes [Pa], which do not move anyway."""


class LibuipcScene:
    """A scene of libuipc with the cloth, the soft bodies and the shapes of a scene.

    Attributes:
        scene: The scene of libuipc.
    """

    def __init__(self, built: PenetrationScene, rate: int):
        """Makes it of a scene, as it is built for VBD, for a rate of steps a second."""
        self._model, self._motion, self._rate = built.scene.model, built.scene.motion, rate
        model = self._model
        self._start = host_array(model.particle_q).astype(np.float64)
        self._mass, self._velocity = host_array(model.particle_mass), host_array(model.particle_qd).astype(np.float64)
        config = uipc.Scene.default_config()
        config["dt"] = 1.0 / rate
        config["gravity"] = [[float(value)] for value in host_array(model.gravity).reshape(-1, 3)[0]]
        config["contact"]["d_hat"] = _CONTACT_DISTANCE
        config["sanity_check"]["enable"] = 1
        self.scene = uipc.Scene(config)
        self.step = 0
        self._held, _ = held_positions(self._motion, 0.0)
        self._slots = [(body, self._add(number, body)) for number, body in enumerate(find_bodies(model))]
        self._add_shapes()

    def positions(self) -> np.ndarray:
        """Returns the positions of the particles [m]."""
        x = self._start.copy()
        for body, slot in self._slots:
            x[body.particles] = slot.geometry().positions().view().reshape(-1, 3)
        return x

    def _add(self, number: int, body: Body):
        """Adds a cloth or a soft body; returns its slot."""
        x = self._start[body.particles]
        mesh = (geometry.tetmesh if body.is_soft else geometry.trimesh)(x, body.elements)
        geometry.label_surface(mesh)
        mass = float(self._mass[body.particles].sum())
        if body.is_soft:
            geometry.label_triangle_orient(mesh)
            moduli = constitution.ElasticModuli.lame(body.lam, body.mu)
            constitution.StableNeoHookean().apply_to(mesh, moduli, mass / body.volume)
        else:
            moduli = constitution.ElasticModuli2D.lame(body.lam / _THICKNESS, body.mu / _THICKNESS)
            # its thickness is that of one side
            density = mass / (body.area * _THICKNESS)
            constitution.NeoHookeanShell().apply_to(mesh, moduli, density, 0.5 * _THICKNESS)
            bending = constitution.DiscreteShellBending
            young = body.young / _THICKNESS
            bending().apply_to(mesh, bending.bending_stiffness(young, body.poisson, 0.5 * _THICKNESS))
        self.scene.contact_tabular().default_element().apply_to(mesh)
        vertices = mesh.vertices()
        moved = np.isin(body.particles, self._held)
        fixed = (self._mass[body.particles] == 0.0) & ~moved
        uipc.view(vertices.find(builtin.is_fixed))[:] = fixed
        velocity = vertices.find(builtin.velocity) or vertices.create(builtin.velocity, np.zeros(3))
        uipc.view(velocity)[:] = self._velocity[body.particles].reshape(-1, 3, 1)
        if moved.any():
            constitution.SoftPositionConstraint().apply_to(mesh, _STRENGTH)
        body_object = self.scene.objects().create(f"body {number}")
        slot, _ = body_object.geometries().create(mesh)
        if moved.any():
            self.scene.animator().insert(body_object, lambda info, body=body, moved=moved: self._aim(info, body, moved))
        return slot

    def _aim(self, info, body: Body, moved: np.ndarray) -> None:
        """Sets where held particles are to be at the end of the step."""
        held, places = held_positions(self._motion, info.frame() / self._rate)
        mesh = info.geo_slots()[0].geometry()
        uipc.view(mesh.vertices().find(builtin.is_constrained))[:] = moved
        aims = self._start[body.particles]
        aims[np.searchsorted(body.particles, held)] = places
        uipc.view(mesh.vertices().find(builtin.aim_position))[:] = aims.reshape(-1, 3, 1)

    def _add_shapes(self) -> None:
        """Adds the fixed shapes, as the triangles that detection judges."""
        mesh, particles = ModelMesh(self._model), self._model.particle_count
        x, shape = mesh.shape_vertices.position.astype(np.float64), mesh.shape_vertices.shape
        faces = mesh.faces[(mesh.faces >= particles).all(axis=1)] - particles
        for number in np.unique(shape):
            vertices = np.flatnonzero(shape == number)
            of_shape = np.searchsorted(vertices, faces[shape[faces[:, 0]] == number])
            solid = geometry.trimesh(x[vertices], of_shape)
            geometry.label_surface(solid)
            constitution.AffineBodyConstitution().apply_to(solid, _RIGID)
            self.scene.contact_tabular().default_element().apply_to(solid)
            uipc.view(solid.instances().find(builtin.is_fixed))[:] = 1
            self.scene.objects().create(f"shape {number}").geometries().create(solid)


def simulate_libuipc(
    built: PenetrationScene, rate: int, seconds: float, progress: Callable[[int, int], None]
) -> Trajectory:
    """Runs a scene, as it is built for VBD, on the first GPU.

    Args:
        built: The scene.
        rate: Steps a second.
        seconds: Simulated time [s].
        progress: Called with the number of steps done and the number of all.

    Raises:
        NotInstalled: If libuipc is not installed, or finds no GPU.
        NotRunnable: If libuipc refuses the scene.
        NotFinite: If positions are not finite, or libuipc gives up.
    """
    if uipc is None:
        raise NotInstalled("libuipc is not installed: pip install pyuipc")
    uipc.Logger.set_level(uipc.Logger.Level.Critical)
    with tempfile.TemporaryDirectory() as folder:
        try:
            engine = uipc.Engine("cuda", folder)
        except Exception as error:
            reason = str(error).rpartition("] ")[2]  # without the place in its sources
            raise NotInstalled(f"libuipc needs a GPU with CUDA: {reason}") from error
        world, scene = uipc.World(engine), LibuipcScene(built, rate)
        world.init(scene.scene)
        if not world.is_valid():
            errors = [error.name().rpartition("::")[2] for error in world.sanity_checker().errors().values()]
            raise NotRunnable(f"libuipc refuses the scene: {', '.join(errors) or 'it gives no reason'}")
        world.retrieve()
        steps = round(seconds * rate)
        states, milliseconds = [scene.positions()], []
        for step in range(steps):
            progress(step, steps)
            begin = time.perf_counter()
            world.advance()
            world.retrieve()
            milliseconds.append(1e3 * (time.perf_counter() - begin))
            states.append(scene.positions())
            if not world.is_valid() or not np.isfinite(states[-1]).all():
                raise NotFinite(f"libuipc gave up in step {step + 1} of {steps}")
        progress(steps, steps)
        return Trajectory(states, milliseconds)
