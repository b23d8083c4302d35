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

from pxr import Plug, Tf, Usd, UsdValidation

from ..usd.frames import FrameRange
from .stage_check import check_stage

__all__ = ["NAME", "PLUGIN_FOLDER", "find_errors"]

NAME = f"{__name__}:Collisions"
"""Name of the rule. Its errors are ``Collision``, ``Intersection``, ``Inversion`` (of tetrahedra), ``Unreadable`` for
parts that are not checked; its warnings are ``Inside``, for a mesh that is wholly inside another, perhaps
intentionally, and ``Duplicates``; ``Meant`` says which triage file was read, and what it says is meant."""

PLUGIN_FOLDER = os.path.join(os.path.dirname(__file__), "plugin", "")
"""Folder of the plugin, for ``PXR_PLUGINPATH_NAME``."""


_KINDS: dict[str, UsdValidation.ValidationErrorType] = {"Meant": UsdValidation.ValidationErrorType.Info}
_KINDS |= dict.fromkeys(("Inside", "Duplicates"), UsdValidation.ValidationErrorType.Warn)


def find_errors(stage: Usd.Stage, time_range: UsdValidation.ValidationTimeRange) -> list[UsdValidation.ValidationError]:
    """Returns an error for each span of time in which two meshes collide or cross, a warning if one is inside another.

    The stage is replayed as it is, see :func:`.stage_check.check_stage`.

    Args:
        stage: The stage.
        time_range: The times to check.
    """
    times = time_range.GetInterval()
    if times.IsEmpty():  # the default time alone, at which nothing moves
        return []
    bounds = (None if math.isinf(time) else time for time in (times.GetMin(), times.GetMax()))
    errors = []
    for issue in check_stage(stage, frames=FrameRange(*bounds)):
        kind = _KINDS.get(issue.kind, UsdValidation.ValidationErrorType.Error)
        sites = [UsdValidation.ValidationErrorSite(stage, path) for path in issue.prims]
        errors.append(UsdValidation.ValidationError(issue.kind, kind, sites, issue.text))
    return errors


Plug.Registry().RegisterPlugins(PLUGIN_FOLDER)
try:
    UsdValidation.ValidationRegistry().RegisterPluginStageValidator(NAME, find_errors)
except Tf.ErrorException as error:
    raise ImportError(
        f"{__name__}: import it before the program first uses UsdValidation.ValidationRegistry, which reads the "
        f"plugins once; or start the program with PXR_PLUGINPATH_NAME={PLUGIN_FOLDER}"
    ) from error
