"""Metadata, unused paths and time codes of a scene, for a layer over it."""

from ..scene import Scene


def unused_path(scene: Scene, path: str) -> str:
    """Returns a path at which the scene has no prim: a given one, with underscores appended if necessary."""
    while scene.stage.GetPrimAtPath(path):
        path += "_"
    return path


def layer_metadata(scene: Scene) -> dict[str, str | float]:
    """Returns the scene's metadata by name, for a layer over it, as a stage reads metadata only from its root layer.

    A missing default prim is replaced by the scene's first prim, a missing range of time codes by that of its times.

    Raises:
        ValueError: If the scene has no file.
    """
    if not scene.has_file:
        raise ValueError(f"{scene.path}: a USD stage in memory has no file for a layer to be over: export it")
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
    """Returns the latest time code before a time that OpenUSD distinguishes from it."""
    from pxr import Usd  # noqa: PLC0415 (slow)

    return time - Usd.TimeCode.SafeStep(max(1e6, abs(time)))
