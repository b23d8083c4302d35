"""Facts of a scene for a layer over it: metadata, display colours, instances, and time codes just before others."""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

import numpy as np

from .scene import Scene

__all__ = ["display_colors", "find_instances_above", "just_before", "layer_metadata", "unused_path"]


def unused_path(scene: Scene, path: str) -> str:
    """Returns a path at which the scene has no prim: the one given, with underscores appended where it has one."""
    while scene.stage.GetPrimAtPath(path):
        path += "_"
    return path


def layer_metadata(scene: Scene) -> dict[str, str | float]:
    """Returns the scene's metadata by name. A stage takes it from its root layer alone, never from sublayers.

    If the scene has no default prim, its first prim becomes that; if it has no range of time codes, its times do.
    """
    stage = scene.stage
    start, end = scene.times[0], scene.times[-1]
    if stage.HasAuthoredTimeCodeRange():
        start, end = (float(stage.GetMetadata(name)) for name in ("startTimeCode", "endTimeCode"))
    has_default = bool(stage.GetDefaultPrim())
    return {
        "defaultPrim": (
            stage.GetRootLayer().defaultPrim if has_default else stage.GetPseudoRoot().GetChildren()[0].GetName()
        ),
        "endTimeCode": end,
        "framesPerSecond": stage.GetFramesPerSecond(),
        "metersPerUnit": scene.meters_per_unit,
        "startTimeCode": start,
        "timeCodesPerSecond": stage.GetTimeCodesPerSecond(),
        "upAxis": scene.up_axis,
    }


def display_colors(scene: Scene, path: str, time: float) -> np.ndarray | None:
    """Returns the display colours of a mesh at a time.

    Args:
        scene: The scene.
        path: The mesh's path.
        time: Time code.

    Returns:
        RGB, float64: of each polygon, shape [polygon_count, 3], if the mesh has uniform colours; otherwise their mean,
        shape [1, 3]. None if the mesh has no colour.
    """
    from pxr import UsdGeom  # noqa: PLC0415 (slow)

    primvar = UsdGeom.Gprim(scene.stage.GetPrimAtPath(path)).GetDisplayColorPrimvar()
    values = primvar.ComputeFlattened(time) if primvar and primvar.HasValue() else None
    if not values:
        return None
    colors = np.array(values, dtype=np.float64)
    return colors if primvar.GetInterpolation() == UsdGeom.Tokens.uniform else colors.mean(axis=0, keepdims=True)


def find_instances_above(scene: Scene, path: str) -> list[str]:
    """Returns the paths of the native instances that a prim is inside of: only their prototype can be edited there."""
    prim, instances = scene.stage.GetPrimAtPath(path), []
    while prim.IsInstanceProxy():
        prim = prim.GetParent()
        if prim.IsInstance():
            instances.append(str(prim.GetPath()))
    return instances


def just_before(time: float) -> float:
    """Returns the latest time code before a time that OpenUSD keeps apart from it."""
    from pxr import Usd  # noqa: PLC0415 (slow)

    return time - Usd.TimeCode.SafeStep(max(1e6, abs(time)))
