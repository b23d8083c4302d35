"""Finds value clips that OpenUSD passes over, most without a word. Imports pxr, which is slow: import where used."""

import os
from collections.abc import Iterator
from typing import Any

from pxr import Sdf, Tf, Usd, Vt

from .topology import is_empty
from .unreadable import LeftOut, UnreadableError, reading

_NEEDED = {"assetPaths": Sdf.AssetPathArray, "active": Vt.Vec2dArray}
_NEEDED_OF_TEMPLATE = {"templateStartTime": float, "templateEndTime": float, "templateStride": float}
_READ = frozenset(
    name
    for names in (
        "points faceVertexCounts faceVertexIndices holeIndices curveVertexCounts widths primvars:widths ids visibility",
        "positions orientations orientationsf scales protoIndices invisibleIds",  # of instancers
        "translations rotations blendShapeWeights size radius height width length",  # of skeletons and shapes
    )
    for name in names.split()
)
"""The attributes that the position of a mesh depends on, and those of transforms."""


def has_clips(prim: Usd.Prim) -> bool:
    """Returns whether a prim has value clips, for itself and the prims below it."""
    return prim.HasAuthoredMetadata("clips")


def leave_out_clips(prim: Usd.Prim, file: str | os.PathLike, left_out: LeftOut) -> bool:
    """Records value clips of a prim whose values are lost: of each set of clips the first fault.

    Of the clips, the first is opened.

    Args:
        prim: A prim with value clips.
        file: The stage's file, for messages.
        left_out: Records them.

    Returns:
        Whether there are any.

    Raises:
        UnreadableError: If they may not be left out.
    """
    api, is_faulty = Usd.ClipsAPI(prim), False
    sets = prim.GetMetadata("clipSets")  # the function of the interface crashes on prims of instances
    chosen = sets.GetAddedOrExplicitItems() if sets else []
    for name, values in sorted(prim.GetMetadata("clips").items()):
        if chosen and name not in chosen:
            continue
        where = f"{file}: {prim.GetPath()}: value clips {name}"
        try:
            with reading(where):
                fault = next(_faults(api, name, values), None)
        except UnreadableError as error:
            fault = str(error).removeprefix(f"{where}: "), ""
        if fault:
            text, asset = fault
            left_out.add_missing(UnreadableError(f"{where}: {text}"), prim, asset)
            is_faulty = True
    return is_faulty


def _faults(api: Usd.ClipsAPI, name: str, values: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yields faults of a set of clips, in words, each with the path of the file that is missing, if one is."""
    is_template = "templateAssetPath" in values and "assetPaths" not in values  # paths come first
    needed = _NEEDED_OF_TEMPLATE if is_template else _NEEDED
    for key, kind in {"primPath": str, **needed}.items():
        if is_empty(value := values.get(key)):
            yield f"they have no {key}", ""
        elif not isinstance(value, kind):
            yield f"their {key} is of another type, {type(value).__name__}", ""
    path = values["primPath"]
    if not (Sdf.Path.IsValidPathString(path) and path.startswith("/") and Sdf.Path(path).IsPrimPath()):
        yield f"{path} is not the path of a prim", ""
    clips = list(api.ComputeClipAssetPaths(name))
    if not clips:
        yield f"no file matches {values['templateAssetPath']}", ""
    for _, number in () if is_template else values["active"]:
        if not 0 <= number < len(clips):
            yield f"clip {number:g} is active, but there are {len(clips)}", ""
    if gone := [clip.path for clip in clips if not (clip.resolvedPath or _is_in_memory(clip))]:
        yield f"{len(gone)} of {len(clips)} files cannot be opened; the first is {gone[0]}", gone[0]
    manifest = values.get("manifestAssetPath")
    declared = _open(manifest) if manifest else None
    if manifest and not declared:
        yield f"their manifest {manifest.path} cannot be opened", manifest.path
    opened = _open(clips[0])
    if not opened:
        return  # reading what is below raises the error
    if not opened.GetPrimAtPath(path):
        yield f"{clips[0].path} has no prim {path}", ""
    if manifest and declared:
        for sampled in _sampled(opened, path):
            if not declared.GetAttributeAtPath(sampled):
                yield f"their manifest {manifest.path} has no {sampled}, of which {clips[0].path} has samples", ""


def _open(asset: Sdf.AssetPath) -> Sdf.Layer | None:
    """Returns the layer of a file, None if it cannot be opened."""
    if _is_in_memory(asset):
        return Sdf.Layer.Find(asset.path)
    try:
        return Sdf.Layer.FindOrOpen(asset.resolvedPath) if asset.resolvedPath else None
    except Tf.ErrorException:
        return None


def _is_in_memory(asset: Sdf.AssetPath) -> bool:
    return Sdf.Layer.IsAnonymousLayerIdentifier(asset.path)


def _sampled(layer: Sdf.Layer, path: str) -> list[Sdf.Path]:
    """Returns the attributes at and below a prim that have samples and are read."""
    found: list[Sdf.Path] = []
    layer.Traverse(path, found.append)
    return [
        one
        for one in found
        if one.IsPrimPropertyPath()
        and (one.name in _READ or one.name.startswith("xformOp:"))
        and layer.GetNumTimeSamplesForPath(one)
    ]
