"""What a replay of a USD stage finds, in words, for rules of validation frameworks."""

from dataclasses import dataclass
from typing import Any, Literal

from ..usd.frames import FrameRange
from ..usd.read.triage import select_by_triage
from ..usd.scene import Scene
from .intervals import replay
from .summary import Summary

_MOST_NAMES = 10  # of duplicates, in words


@dataclass(frozen=True)
class StageIssue:
    """Something that is found in a stage.

    Attributes:
        kind: What it is: ``"Inside"``, a mesh wholly inside another, and ``"Duplicates"`` may be meant.
            ``"Unreadable"`` is a part that is not checked, or the whole stage. ``"Meant"`` is no issue: it says which
            triage file was read, and what is not counted because of it.
        text: What is found between which prims, and when.
        prims: Paths of the prims.
    """

    kind: Literal["Collision", "Intersection", "Inversion", "Inside", "Duplicates", "Unreadable", "Meant"]
    text: str
    prims: tuple[str, ...] = ()


def check_stage(stage: Any, *, frames: FrameRange | None = None) -> list[StageIssue]:
    """Returns an issue for each span of time in which two meshes collide, cross, coincide or one is inside another.

    The stage is replayed as it is composed, with edits that are not saved, by method ``"exact"`` on Warp's default
    device, without what its triage says is meant, see :func:`~warp_bsc.usd.read.triage.select_by_triage`.

    Args:
        stage: The stage, a ``Usd.Stage``.
        frames: The times to check; default: all.
    """
    paths: dict[str, str] = {}  # by name
    intervals = []
    try:
        triage, selection = select_by_triage(stage)
        scene = Scene(stage, selection=selection, frames=frames)
        for result in replay(scene):
            paths |= {mesh.name: mesh.path for mesh in result.contacts.segment.meshes}
            intervals.append(result.summary)
    except (OSError, ValueError) as error:
        return [StageIssue("Unreadable", str(error))]
    summary = Summary(scene, method="exact", device="", intervals=intervals)
    issues = [StageIssue("Unreadable", reason) for reason in scene.left_out]

    def add(kind, span, text):
        issues.append(StageIssue(kind, text, tuple(dict.fromkeys(paths[name] for name in span.meshes))))

    for span in summary.collision_spans:
        text = f"collide from time {span.since:g} to {span.until:g}: {span.hits:,} pairs"
        add("Collision", span, f"{_pair(span.meshes)} {text}")
    for span in summary.intersection_spans:
        when = f"from time {span.since:g} to {span.until:g}"
        if span.inside:
            add("Inside", span, f"{span.meshes[0]} is inside {span.meshes[1]} {when}")
        elif span.crossings:
            add("Intersection", span, f"{_pair(span.meshes)} cross {when}: at most {span.most:,} edges")
    for span in summary.inversion_spans:
        add("Inversion", span, span.describe())
    for span in summary.duplicate_spans:
        add("Duplicates", span, span.describe(_MOST_NAMES))
    if triage:
        notes = [warning for warning in scene.warnings if warning.startswith("triage: ")]
        issues.append(StageIssue("Meant", " ".join([f"{triage} was read.", summary.not_counted, *notes]).rstrip()))
    return issues


def _pair(meshes: tuple[str, str]) -> str:
    first, second = meshes
    return f"{first} and {'itself' if first == second else second}"
