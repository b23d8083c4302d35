"""Warns of transforms that straight paths hide: large turns between two times, and scales of 0. Imports pxr."""

import math

import numpy as np
from pxr import Sdf, UsdGeom

from .interval import times_in_words
from .read.instancers import Instancer
from .read.meshes import UsdMesh
from .turns import Turn, find_turns

_LARGE_TURN = 180.0  # degrees; from there on a straight path goes through the axis, or the other way round
_FINE_TURN = 45.0
_ROUNDING = 1e-6  # of angles, which USD interpolates in single precision
_NAMED = 5
_AXES = ("X", "Y", "Z", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")
_ROTATIONS = tuple(getattr(UsdGeom.XformOp, f"TypeRotate{axes}") for axes in _AXES)
"""Only by angles a prim can turn by more than half a turn from one sample to the next: USD interpolates quaternions the
shorter way, and matrices number by number."""


def transform_warnings(meshes: list[UsdMesh], times: list[float]) -> list[str]:
    """Returns sentences on prims that turn by half a turn or more between two times, and one on scales of 0.

    Turns about one axis at a constant rate, of meshes that nothing else moves, are not named: they are checked on their
    arcs, see :mod:`.turns`.

    Args:
        meshes: The meshes of a scene.
        times: Its times, ascending.
    """
    ops_of: dict[tuple | str, list[UsdGeom.XformOp]] = {}  # all instances of a mesh share theirs
    placed: dict[Sdf.Path, tuple[UsdGeom.XformOp, list[UsdMesh]]] = {}  # an operation and its meshes by its attribute
    zero_scales: dict[Instancer, dict[int, float]] = {}
    hidden: dict[str, float] = {}  # first time by mesh
    for mesh in meshes:
        key = mesh.instanced_prim or mesh.name
        if key not in ops_of:
            ops_of[key] = list(mesh.transforms.ops(mesh.instance))
        for op in ops_of[key]:
            placed.setdefault(op.GetAttr().GetPath(), (op, []))[1].append(mesh)
        if instance := mesh.instance:
            if instance.instancer not in zero_scales:
                zero_scales[instance.instancer] = instance.instancer.zero_scales(times)
            if instance.index in zero_scales[instance.instancer]:
                hidden[mesh.name] = zero_scales[instance.instancer][instance.index]
    turns = []
    for op, moved in placed.values():
        if op.GetOpType() in _ROTATIONS:
            turns += _turn_warning(op, moved, times)
        elif op.GetOpType() in (UsdGeom.XformOp.TypeScale, UsdGeom.XformOp.TypeTransform):
            time = _first_zero(op, times)
            if time is not None:
                hidden |= {mesh.name: min(time, hidden.get(mesh.name, time)) for mesh in moved}
    if len(turns) > _NAMED:
        turns[_NAMED:] = [f"subdivide: {len(turns) - _NAMED} more prims turn by half a turn or more between two times"]
    if not hidden:
        return turns
    first = min(hidden, key=lambda name: hidden[name])
    if len(hidden) == 1:
        return [*turns, f"{first} is hidden by a scale of 0 at time {hidden[first]:g}: all of it is at one point there"]
    return [
        *turns,
        f"{len(hidden)} meshes are hidden by a scale of 0, all of each is at one point there; the first is {first} at "
        f"time {hidden[first]:g}",
    ]


def _moments(own_times: list[float], times: list[float]) -> list[float]:
    """Returns the first time of a scene, and the samples of an attribute up to the last, ascending."""
    return [times[0], *(time for time in own_times if times[0] < time <= times[-1])]


def _turn_warning(op: UsdGeom.XformOp, meshes: list[UsdMesh], times: list[float]) -> list[str]:
    """Returns a sentence on the large turns of an operation between two times, if there are any."""
    if not op.MightBeTimeVarying():
        return []
    attribute = op.GetAttr()
    within = sorted({*_moments(op.GetTimeSamples(), times), *times})
    values = [attribute.Get(time) for time in within]
    if None in values:  # reading positions reports it
        return []
    angles = np.array(values, dtype=np.float64).reshape(len(within), -1)
    with np.errstate(invalid="ignore"):  # angles that are not finite are found where positions are read
        turned = np.cumsum(np.abs(np.diff(angles, axis=0, prepend=angles[:1])), axis=0)[np.searchsorted(within, times)]
        degrees = np.diff(turned, axis=0).max(axis=1)
        (large,) = np.nonzero((degrees >= _LARGE_TURN * (1.0 - _ROUNDING)) & np.isfinite(degrees))
    if not any(mesh.deforms for mesh in meshes):
        # what does not vary below a turn makes no difference to it
        ops = {mesh: mesh.transforms.ops(None) for mesh in meshes if not mesh.instance}
        varying = {mesh: tuple(op.GetAttr().GetPath() for op in ops[mesh] if op.MightBeTimeVarying()) for mesh in ops}
        alike = {varying.get(mesh, mesh.name): mesh for mesh in meshes}
        on_arcs = [_on_arcs(mesh, large.tolist(), times) for mesh in alike.values()]
        large = large[[any(index not in turns for turns in on_arcs) for index in large.tolist()]]
    if not len(large):
        return []
    most = degrees[large].max()
    moved = meshes[0].name if len(meshes) == 1 else f"{attribute.GetPrimPath()} with {len(meshes)} meshes"
    when = times_in_words([times[index] for index in large])
    parts = math.ceil(most / _FINE_TURN * (1.0 - _ROUNDING))
    return [
        f"subdivide: {moved} turns by up to {most:.4g} degrees to the next time, {when}: its vertices move straight, "
        f"and what it turns through is not checked; in {parts} parts it turns by {_FINE_TURN:g} degrees or less"
    ]


def _on_arcs(mesh: UsdMesh, intervals: list[int], times: list[float]) -> dict[int, Turn]:
    """Returns the turns of a mesh in intervals in which it turns about one axis at a constant rate."""

    def transform(index: int, share: float) -> np.ndarray | None:
        return mesh.read_transform(times[index] + share * (times[index + 1] - times[index]), before=share == 1.0)

    return find_turns(transform, intervals)[0]


def _first_zero(op: UsdGeom.XformOp, times: list[float]) -> float | None:
    """Returns the first time at which a scale or the linear part of a matrix is 0."""
    for time in _moments(op.GetTimeSamples(), times):
        value = op.GetAttr().Get(time)
        if value is None:
            continue
        linear = np.array(value, dtype=np.float64)
        if not linear[..., :3][:3].any():
            return time
    return None
