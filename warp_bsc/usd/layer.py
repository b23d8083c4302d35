"""Facts of a scene for a layer over it: metadata, unused paths, and time codes just before others."""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

from .scene import Scene

__all__ = ["just_before", "layer_metadata", "unused_path"]


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


def just_before(time: float) -> float:
    """Returns the latest time code before a time that OpenUSD keeps apart from it."""
    from pxr import Usd  # noqa: PLC0415 (slow)

    return time - Usd.TimeCode.SafeStep(max(1e6, abs(time)))
