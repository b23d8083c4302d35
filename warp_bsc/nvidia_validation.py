"""Rules of NVIDIA's USD validation (``usd-validation-nvidia``): meshes neither overlap nor collide between samples.

``nvidia_usd_validate`` and ``ValidationEngine`` find them where warp-bsc is installed, in the category Geometry.
"""

import os
import tempfile
from threading import Lock

from pxr import Sdf, Usd
from usd_validation_nvidia import (
    BaseRuleChecker,
    Suggestion,
    register_requirements,
    register_rule,
    unregister_requirements,
    unregister_rule,
)
from usd_validation_nvidia.capabilities import Requirements

from .repairing.shot.findings import find_collisions
from .repairing.shot.repair_shot import repair_shot
from .scene_replay.intervals import replay
from .scene_replay.stage_check import check_stage
from .usd.read.triage import select_by_triage
from .usd.scene import Scene
from .usd.write.points_layer import PointsLayer

__all__ = ["MeshCollisionChecker", "MeshOverlapChecker", "Plugin"]


FIXED = "Collision", "Intersection"
"""Kinds of what fails a check, and a fix mends."""

_ONE_AT_A_TIME = Lock()
"""Rules run in threads at once, and Warp starts and compiles once for all."""


class _Checker(BaseRuleChecker):
    """Reports some kinds of what :func:`.scene_replay.stage_check.check_stage` finds."""

    _kinds: tuple[str, ...]
    _requirement = None

    def CheckStage(self, usdStage: Usd.Stage) -> None:
        """Checks a stage as it is composed, with edits that are not saved."""
        fix = Suggestion(repair_stage, "Move deforming meshes apart, as warp-bsc repair does")
        with _ONE_AT_A_TIME:
            issues = check_stage(usdStage)
        for issue in issues:
            prims = tuple(usdStage.GetPrimAtPath(path) for path in issue.prims)
            if issue.kind == "Unreadable":
                self._AddError(f"Not checked: {issue.text}", requirement=self._requirement)
            elif issue.kind == "Meant":
                self._AddInfo(issue.text, requirement=self._requirement)
            elif issue.kind in self._kinds:
                add = self._AddWarning if issue.kind in ("Inside", "Duplicates") else self._AddFailedCheck
                add(issue.text, prims, fix if issue.kind in FIXED else None, requirement=self._requirement)


class MeshOverlapChecker(_Checker):
    """Requirement VG.006, usdgeom-mesh-overlap: no edge passes through a face at a time sample.

    Meshes that are wholly inside others, and duplicates, are warnings.
    """

    _kinds = "Intersection", "Inside", "Duplicates"
    _requirement = Requirements.VG_006


class MeshCollisionChecker(_Checker):
    """No vertex meets a face, no two edges meet, and no tetrahedron inverts, at time samples or between them."""

    _kinds = "Collision", "Inversion"


class Plugin:
    """Registers the rules; the entry point of ``usd_validation_nvidia``."""

    def on_startup(self) -> None:
        """Registers the rules."""
        register_requirements(Requirements.VG_006)(MeshOverlapChecker)
        for rule in (MeshOverlapChecker, MeshCollisionChecker):
            register_rule("Geometry")(rule)

    def on_shutdown(self) -> None:
        """Takes the rules away."""
        for rule in (MeshCollisionChecker, MeshOverlapChecker):
            unregister_rule(rule)
        unregister_requirements(MeshOverlapChecker)


def repair_stage(stage: Usd.Stage, _at: object = None) -> None:
    """Writes points at which deforming meshes neither cross nor collide to the edit target of a stage.

    The stage is checked again then; if something still crosses or collides, the layer is as it was.

    Args:
        stage: The stage, whose root layer has a file.

    Raises:
        OSError: If a temporary layer cannot be written.
        ValueError: If the stage has no file, cannot be read, or its edit target has other times.
        RuntimeError: If something still crosses or collides.
    """
    target = stage.GetEditTarget()
    if not target.GetMapFunction().timeOffset.IsIdentity():
        raise ValueError(f"{target.GetLayer().identifier}: its times are shifted or scaled in the stage")
    _, selection = select_by_triage(stage)
    scene, before = Scene(stage, selection=selection), Sdf.Layer.CreateAnonymous()
    findings = list(find_collisions(scene, replay(scene), unrepaired_pairs=()))
    before.TransferContent(target.GetLayer())
    with tempfile.TemporaryDirectory() as folder:
        points = PointsLayer(os.path.join(folder, "points.usdc"), scene=scene)
        try:
            for stretch in repair_shot(scene, findings):
                for frame in stretch.frames:
                    points.add(frame)
            points.finish({})
        finally:
            points.discard()
        _copy_properties(Sdf.Layer.OpenAsAnonymous(str(points.file.path)), target)
    rest = [issue.text for issue in check_stage(stage) if issue.kind in FIXED]
    if rest:
        target.GetLayer().TransferContent(before)
        raise RuntimeError(f"of {len(rest)} issues that remain, the first is that {rest[0]}")


def _copy_properties(layer: Sdf.Layer, target: Usd.EditTarget) -> None:
    """Copies the properties of all prims of a layer to an edit target."""

    def copy(path):
        if path.IsPropertyPath():
            place = target.MapToSpecPath(path)
            Sdf.CreatePrimInLayer(target.GetLayer(), place.GetPrimPath())
            Sdf.CopySpec(layer, path, target.GetLayer(), place)

    layer.Traverse(Sdf.Path.absoluteRootPath, copy)
