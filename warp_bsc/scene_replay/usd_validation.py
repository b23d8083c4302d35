"""A rule of OpenUSD's validation framework: meshes neither collide between time samples nor intersect at them.

Programs that run the framework find the rule if the environment variable ``PXR_PLUGINPATH_NAME`` names the folder
``plugin`` beside this module. In Python, importing this module registers it::

    from pxr import Usd, UsdValidation
    import warp_bsc.scene_replay.usd_validation as rules

    validator = UsdValidation.ValidationRegistry().GetOrLoadValidatorByName(rules.NAME)
    for error in validator.Validate(Usd.Stage.Open("scene.usd")):
        print(error.GetName(), error.GetMessage())
"""

import math
import os
import sys

from pxr import Plug, Usd, UsdValidation

from ..usd.frames import FrameRange
from ..usd.scene import Scene
from .intervals import replay
from .summary import Summary

__all__ = ["NAME", "PLUGIN_FOLDER", "find_errors"]

_MOST_NAMES = 10  # of duplicates, in words

NAME = f"{__name__}:Collisions"
"""Name of the rule. Its errors are ``Collision``, ``Intersection``, and ``Unreadable`` for parts that are not checked;
its warnings are ``Inside``, for a mesh that is wholly inside another, perhaps intentionally, and ``Duplicates``."""

PLUGIN_FOLDER = os.path.join(os.path.dirname(__file__), "plugin", "")
"""Folder of the plugin, for ``PXR_PLUGINPATH_NAME``."""


def find_errors(stage: Usd.Stage, time_range: UsdValidation.ValidationTimeRange) -> list[UsdValidation.ValidationError]:
    """Returns an error for each span of time in which two meshes collide or cross, a warning if one is inside another.

    The file of the stage's root layer is replayed by method ``"exact"`` on Warp's default device. Unsaved changes, as
    in the session layer, are not checked.

    Args:
        stage: The stage.
        time_range: The times to check.
    """
    times = time_range.GetInterval()
    if times.IsEmpty():  # the default time alone, at which nothing moves
        return []
    bounds = (None if math.isinf(time) else time for time in (times.GetMin(), times.GetMax()))
    paths: dict[str, str] = {}  # by name
    intervals = []
    try:
        scene = Scene(stage.GetRootLayer().realPath or stage.GetRootLayer().identifier, frames=FrameRange(*bounds))
        for result in replay(scene):
            paths |= {mesh.name: mesh.path for mesh in result.contacts.segment.meshes}
            intervals.append(result.summary)
    except (OSError, ValueError) as error:
        return [_error("Unreadable", str(error), stage, [])]
    summary = Summary(scene, method="exact", device="", intervals=intervals)
    errors = [_error("Unreadable", reason, stage, []) for reason in scene.left_out]
    for span in summary.collision_spans:
        prims = [paths[name] for name in span.meshes]
        text = f"{_pair(span.meshes)} collide from time {span.since:g} to {span.until:g}: {span.hits:,} pairs"
        errors.append(_error("Collision", text, stage, prims))
    for span in summary.intersection_spans:
        prims = [paths[name] for name in span.meshes]
        if span.inside:
            text = f"{span.meshes[0]} is inside {span.meshes[1]} from time {span.since:g} to {span.until:g}"
            errors.append(_error("Inside", text, stage, prims, UsdValidation.ValidationErrorType.Warn))
        elif span.crossings:
            text = f"{_pair(span.meshes)} cross from time {span.since:g} to {span.until:g}: at most {span.most:,} edges"
            errors.append(_error("Intersection", text, stage, prims))
    for span in summary.duplicate_spans:
        prims, text = [paths[name] for name in span.meshes], span.describe(_MOST_NAMES)
        errors.append(_error("Duplicates", text, stage, prims, UsdValidation.ValidationErrorType.Warn))
    return errors


def _pair(meshes: tuple[str, str]) -> str:
    first, second = meshes
    return f"{first} and {'itself' if first == second else second}"


def _error(
    name: str,
    text: str,
    stage: Usd.Stage,
    paths: list[str],
    kind: UsdValidation.ValidationErrorType = UsdValidation.ValidationErrorType.Error,
) -> UsdValidation.ValidationError:
    sites = [UsdValidation.ValidationErrorSite(stage, path) for path in dict.fromkeys(paths)]
    return UsdValidation.ValidationError(name, kind, sites, text)


Plug.Registry().RegisterPlugins(PLUGIN_FOLDER)
UsdValidation.ValidationRegistry().RegisterPluginStageValidator(NAME, find_errors)
# "import warp_bsc.scene_replay.usd_validation as rules" looks this module up in the function that hides the package
vars(replay)["usd_validation"] = sys.modules[__name__]
