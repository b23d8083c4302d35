"""Runs the scenes of ``warp-bsc bench penetration`` with MuJoCo's flexes and their IPC contact.

The flag ``ipc`` is in MuJoCo from version 3.14 on, and is experimental. Its documentation (XMLreference,
option/flag/ipc) says that flex contact cannot tunnel, for 2D flexes with each other, with themselves and with static
shapes, without friction. Of soft bodies (3D flexes), and of what moves otherwise, it does not say so.
"""

import time
from collections.abc import Callable
from typing import Any, cast

import newton
import numpy as np

from ...response.state.mesh import host_array
from ..scenes.contact import NotRunnable
from ..scenes.penetration import PenetrationScene
from ..scenes.simulation import NotFinite
from .states import Body, NotInstalled, Trajectory, find_bodies, held_positions

try:
    import mujoco
except ModuleNotFoundError:
    mujoco = cast(Any, None)

_THICKNESS = 1e-3
"""Of cloth [m]: "the mode assumes metre-scale models with millimetre-thick flexes" (XMLreference, option/flag/ipc)."""
_DAMPING = 2e-3
"""Rayleigh damping [s], the least of what the documentation recommends (modeling, Deformables: 0.002 to 0.05)."""
_OPTIONS = 'integrator="discrete" solver="CG" tolerance="1e-6"'
"""As the documentation recommends for IPC contact (modeling, Deformables), which goes with steps of 1 to 4 ms."""
_HELD_MASS = 10.0
"""Mass of a particle that a program moves [kg]: it is so heavy that a step hardly changes the velocity it is given."""
_INERTIA = 'diaginertia="1e-6 1e-6 1e-6"'  # of bodies that do not turn


def simulate_mujoco(
    built: PenetrationScene, rate: int, seconds: float, progress: Callable[[int, int], None]
) -> Trajectory:
    """Runs a scene, as it is built for VBD, on the CPU, with arguments as of :func:`.libuipc.simulate_libuipc`.

    Raises:
        NotInstalled: If MuJoCo is not installed, or too old.
        NotRunnable: If it cannot run the scene.
        NotFinite: If it says that positions, velocities or accelerations are not finite or too large.
    """
    if mujoco is None:
        raise NotInstalled("MuJoCo is not installed: pip install mujoco")
    if not hasattr(mujoco.mjtEnableBit, "mjENBL_IPC"):
        raise NotInstalled(f"MuJoCo {mujoco.__version__} has no ipc contact: it needs 3.14 or later")
    scene, start = built.scene, host_array(built.scene.model.particle_q).astype(np.float64)
    held, _ = held_positions(scene.motion, 0.0)
    model = mujoco.MjModel.from_xml_string(make_mujoco_xml(scene.model, set(held.tolist()), rate))
    data = mujoco.MjData(model)
    addresses = {
        int(name[1:]): int(model.jnt_qposadr[model.body_jntadr[body]])
        for body in range(1, model.nbody)
        if (name := model.body(body).name).startswith("p")
    }
    moving = np.array(list(addresses))
    rows = np.array(list(addresses.values()))[:, None] + np.arange(3)
    data.qvel[rows] = host_array(scene.model.particle_qd)[moving]
    held_rows = np.array([addresses[particle] for particle in held], dtype=int)[:, None] + np.arange(3)
    steps = round(seconds * rate)
    states, milliseconds = [start], []
    for step in range(steps):
        progress(step, steps)
        (_, now), (_, then) = (held_positions(scene.motion, at / rate) for at in (step, step + 1))
        data.qpos[held_rows], data.qvel[held_rows] = now - start[held], rate * (then - now)
        begin = time.perf_counter()
        mujoco.mj_step(model, data)
        milliseconds.append(1e3 * (time.perf_counter() - begin))
        _check(data, step, steps)
        state = start.copy()
        state[moving] += data.qpos[rows]
        states.append(state)
    progress(steps, steps)
    return Trajectory(states, milliseconds)


def make_mujoco_xml(model: newton.Model, held: set[int], rate: int) -> str:
    """Returns a model of MuJoCo with the cloth, the soft bodies and the shapes of a model of Newton.

    Each particle is a body with three slide joints, as ``flexcomp`` makes them; those with mass 0 that no program moves
    are fixed in the world.

    Args:
        model: The model, without bodies.
        held: Particles that a program moves.
        rate: Steps a second.

    Raises:
        NotRunnable: If a shape is neither a sphere nor a box.
    """
    mass, x = host_array(model.particle_mass), host_array(model.particle_q).astype(np.float64)
    bodies = find_bodies(model)
    flexes = "".join(_flex_xml(number, body, x, mass, held) for number, body in enumerate(bodies))
    points = "".join(
        _point_xml(i, x[i], _HELD_MASS if i in held else mass[i]) for i in range(len(x)) if i in held or mass[i] > 0.0
    )
    gravity = " ".join(map(str, host_array(model.gravity).reshape(-1, 3)[0]))
    return (
        f'<mujoco><compiler autolimits="true"/><option timestep="{1.0 / rate!r}" gravity="{gravity}" {_OPTIONS}>'
        '<flag ipc="enable" autoreset="disable"/></option><size memory="1G"/>'
        f"<worldbody>{_shapes_xml(model)}{points}</worldbody><deformable>{flexes}</deformable></mujoco>"
    )


def _point_xml(number: int, at: np.ndarray, mass: float) -> str:
    joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    place = " ".join(f"{value!r}" for value in at.tolist())
    inertial = f'<inertial pos="0 0 0" mass="{float(mass)!r}" {_INERTIA}/>'
    return f'<body name="p{number}" pos="{place}">{inertial}{joints}</body>'


def _flex_xml(number: int, body: Body, x: np.ndarray, mass: np.ndarray, held: set[int]) -> str:
    """Returns a flex; its stiffness is that of Newton's material for small strains."""
    fixed = [mass[i] == 0.0 and i not in held for i in body.particles]
    names = " ".join("world" if is_fixed else f"p{i}" for i, is_fixed in zip(body.particles, fixed, strict=True))
    places = np.where(np.array(fixed)[:, None], x[body.particles], 0.0)
    vertex = " ".join(f"{value!r}" for value in places.ravel().tolist())
    element = " ".join(map(str, body.elements.ravel().tolist()))
    if body.is_soft:
        dim, elastic = 3, f'young="{body.young!r}"'
    else:
        dim, elastic = 2, f'young="{body.young / _THICKNESS!r}" thickness="{_THICKNESS}" elastic2d="both"'
    return (
        f'<flex name="f{number}" dim="{dim}" radius="{0.5 * _THICKNESS}" body="{names}" vertex="{vertex}" '
        f'element="{element}"><elasticity {elastic} poisson="{body.poisson!r}" damping="{_DAMPING}"/></flex>'
    )


def _shapes_xml(model: newton.Model) -> str:
    """Returns the fixed shapes."""
    text = ""
    kinds = {int(newton.GeoType.SPHERE): ("sphere", 1), int(newton.GeoType.BOX): ("box", 3)}
    types, scales, transforms = (
        host_array(values) for values in (model.shape_type, model.shape_scale, model.shape_transform)
    )
    for kind, scale, transform in zip(types.tolist(), scales, transforms, strict=True):
        if kind not in kinds:
            raise NotRunnable(f"shapes of type {newton.GeoType(kind).name} are not given to MuJoCo")
        name, sizes = kinds[kind]
        place, (qx, qy, qz, qw) = transform[:3].tolist(), transform[3:].tolist()
        numbers = (" ".join(map(str, values)) for values in (scale[:sizes].tolist(), place, (qw, qx, qy, qz)))
        text += '<geom type="{}" size="{}" pos="{}" quat="{}"/>'.format(name, *numbers)
    return text


def _check(data, step: int, steps: int) -> None:
    """Raises NotFinite if MuJoCo has found bad numbers, which it would else reset or ignore."""
    for kind in (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC):
        if data.warning[int(kind)].number:
            raise NotFinite(f"{kind.name} in step {step + 1} of {steps}")
