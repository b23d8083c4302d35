"""The summary of an interval in the JSON file of a replay: neighbouring functions write and read each of its parts.

The file names meshes and prims once, in its first line. Everywhere else ``mesh`` holds the numbers of two meshes in
these lists, where the results have their names, and so do ``duplicates``.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from ..detection.results.collisions import DetectionStats, PhaseCounts
from ..detection.run.settings import PairKind
from ..usd.interval import Interval
from .results import Contact, IntersectionSummary, IntervalSummary, InvertedTetrahedra, Nearest, ProximitySummary
from .scene_pairs import PHASES
from .validation import Validation


def with_numbers(found: Any, numbers: Mapping[str, int]) -> dict[str, Any]:
    """Returns the fields of a finding on meshes, a dataclass, with ``mesh``, their numbers, instead of ``meshes``.

    Args:
        found: The finding.
        numbers: Numbers of meshes in the file, by name.
    """
    fields = asdict(found)
    return {"mesh": [numbers[name] for name in fields.pop("meshes")]} | fields


def _with_names(fields: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Returns the arguments of a finding, given its fields of :func:`with_numbers` and the names in the file."""
    arguments = {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
    return {"meshes": tuple(names[number] for number in arguments.pop("mesh"))} | arguments


def mesh_pairs_to_list(
    mesh_pairs: Iterable[tuple[tuple[str, str], int]], numbers: Mapping[str, int], what: str = "hits"
) -> list[dict[str, Any]]:
    """Returns counts by two meshes as a list of objects.

    Args:
        mesh_pairs: The names of the two, and the count.
        numbers: Numbers of meshes in the file, by name.
        what: Name of the counts.
    """
    return [{"mesh": [numbers[name] for name in meshes], what: count} for meshes, count in mesh_pairs]


def _mesh_pairs_from_list(
    mesh_pairs: list[dict[str, Any]], names: list[str], what: str = "hits"
) -> dict[tuple[str, str], int]:
    return {(names[pair["mesh"][0]], names[pair["mesh"][1]]): pair[what] for pair in mesh_pairs}


def summary_fields(summary: IntervalSummary, kinds: Sequence[str], numbers: Mapping[str, int]) -> dict[str, Any]:
    """Returns the fields of an interval.

    Args:
        summary: The interval.
        kinds: Labels of the kinds of pair whose numbers are written.
        numbers: Numbers of meshes in the file, by name.
    """
    fields = {
        "index": summary.index,
        "start": summary.start,
        "end": summary.end,
        "pairs_tested": summary.pairs_tested,
        "hits": summary.hits,
        **{f"{kind}_hits": getattr(summary, f"{kind}_hits") for kind in kinds},
        "toi_counts": summary.toi_counts,
        "earliest": with_numbers(summary.earliest, numbers) if summary.earliest else None,
        "mesh_pairs": mesh_pairs_to_list(summary.mesh_pairs.items(), numbers),
        "ignored": mesh_pairs_to_list(summary.ignored.items(), numbers),
        "certified": summary.certified,
        "stages": {kind: asdict(getattr(summary.stats, kind)) for kind in kinds},
        "validation": asdict(summary.validation) if summary.validation else None,
    }
    if summary.inverted:
        fields["inverted"] = [with_numbers(found, numbers) for found in summary.inverted]
    if summary.intersections:
        fields["separate_hits"] = summary.separate_hits
        fields["phases"] = dict(zip(PHASES, summary.phases or (), strict=True))
        found = (_intersection_fields(at, numbers) for at in summary.intersections)
        fields["intersections"] = dict(zip(("start", "end"), found, strict=True))
        fields["duplicates"] = [[numbers[name] for name in same] for same in summary.duplicates]
    if summary.proximities:
        found = (_proximity_fields(at, numbers) for at in summary.proximities)
        fields["proximities"] = dict(zip(("start", "end"), found, strict=True))
    return fields


def read_summary(fields: dict[str, Any], interval: Interval, names: list[str]) -> IntervalSummary:
    """Returns the summary of an interval, without the times of its phases.

    Args:
        fields: The fields of :func:`summary_fields`.
        interval: The interval, as the scene yields it.
        names: Names of the meshes in the file.
    """
    # a scene without curves and points has no counts of their pairs
    labels = [kind.label for kind in PairKind]
    counts = {label: PhaseCounts(**fields["stages"].get(label, {})) for label in labels}
    validation = fields["validation"]
    if validation:
        validation = Validation(**validation | {"disagreements": tuple(validation["disagreements"])})
    intersections, proximities = fields.get("intersections"), fields.get("proximities")
    return IntervalSummary(
        index=interval.index,
        start=interval.start,
        end=interval.end,
        **{f"{label}_hits": fields.get(f"{label}_hits", 0) for label in labels},
        toi_counts=tuple(fields["toi_counts"]),
        mesh_pairs=_mesh_pairs_from_list(fields["mesh_pairs"], names),
        earliest=Contact(**_with_names(fields["earliest"], names)) if fields["earliest"] else None,
        certified=fields["certified"],
        stats=DetectionStats(**counts, milliseconds={}),
        validation=validation,
        intersections=_both_times(intersections, _read_intersections, names),
        ignored=_mesh_pairs_from_list(fields["ignored"], names),
        separate_hits=fields["separate_hits"] if intersections else None,
        phases=tuple(fields["phases"].values()) if intersections else None,
        proximities=_both_times(proximities, _read_proximities, names),
        duplicates=tuple(tuple(names[number] for number in same) for same in fields.get("duplicates", ())),
        inverted=tuple(InvertedTetrahedra(**_with_names(found, names)) for found in fields.get("inverted", ())),
    )


def _both_times(at: dict[str, Any] | None, read: Any, names: list[str]) -> tuple[Any, Any] | None:
    """Returns what is read at the start and at the end of an interval; None if nothing was looked for."""
    return (read(at["start"], names), read(at["end"], names)) if at else None


def _intersection_fields(found: IntersectionSummary, numbers: Mapping[str, int]) -> dict[str, Any]:
    pairs = [
        {"mesh": [numbers[name] for name in meshes], "crossings": crossings, "touches": touches}
        for meshes, (crossings, touches) in found.mesh_pairs.items()
    ]
    lists = {"mesh_pairs": pairs, "inside": mesh_pairs_to_list(found.inside.items(), numbers, "parts")}
    lists["ignored"] = mesh_pairs_to_list(found.ignored.items(), numbers, "edges")
    return {"time": found.time, "crossings": found.crossings, "touches": found.touches} | lists


def _read_intersections(fields: dict[str, Any], names: list[str]) -> IntersectionSummary:
    pairs = {
        (names[pair["mesh"][0]], names[pair["mesh"][1]]): (pair["crossings"], pair["touches"])
        for pair in fields["mesh_pairs"]
    }
    inside = _mesh_pairs_from_list(fields["inside"], names, "parts")
    ignored = _mesh_pairs_from_list(fields["ignored"], names, "edges")
    return IntersectionSummary(fields["time"], fields["crossings"], fields["touches"], pairs, inside, ignored)


def _proximity_fields(found: ProximitySummary, numbers: Mapping[str, int]) -> dict[str, Any]:
    nearest = [with_numbers(one, numbers) for one in found.nearest]
    return {"time": found.time, "pairs": found.pairs, "nearest": nearest}


def _read_proximities(fields: dict[str, Any], names: list[str]) -> ProximitySummary:
    nearest = tuple(Nearest(**_with_names(one, names)) for one in fields["nearest"])
    return ProximitySummary(fields["time"], fields["pairs"], nearest)
