"""Layers over a scene: their metadata, unused paths and time codes."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..._atomic_file import OutputFile
from ..scene import Scene
from .layer_writer import AddSample, new_layer


class SceneLayer:
    """A layer over a scene, whose sublayer is the scene."""

    def __init__(self, path: str | os.PathLike, scene: Scene, what: str):
        """Checks the name of its file, and reads the scene's metadata; ``what`` errors call it.

        Raises:
            ValueError: If the name has another suffix, or the scene has no file.
        """
        suffix = Path(path).suffix
        if suffix not in (".usda", ".usdc", ".usd"):
            raise ValueError(f"{path}: the name of {what} must end in .usda, .usdc or .usd")
        self._format = "usda" if suffix == ".usda" else "usdc"
        self._scene, self._metadata = scene, _metadata_of(scene)

    @contextlib.contextmanager
    def writing(
        self, file: OutputFile, documentation: str, custom: dict[str, dict[str, Any]], end: float | None = None
    ) -> Iterator[tuple[Any, AddSample]]:
        """Makes the layer, which the block fills, with results and errors of :func:`new_layer`; then commits the file.

        Args:
            file: The file.
            documentation: Text for people.
            custom: Values for programs, by the name of a dictionary and their own; lists are of texts.
            end: Last time code of a partial layer; None for the scene's.
        """
        from pxr import Vt  # noqa: PLC0415 (slow)

        path = Path(file.folder, f".warp-bsc-{secrets.token_hex(8)}.tmp")
        with new_layer(path, self._format) as (layer, add):
            yield layer, add
            last = float(self._metadata["endTimeCode"])
            for name, value in (self._metadata | {"endTimeCode": last if end is None else min(end, last)}).items():
                layer.pseudoRoot.SetInfo(name, value)
            layer.customLayerData = {
                name: {
                    key: Vt.StringArray(value) if isinstance(value, list) else value for key, value in values.items()
                }
                for name, values in custom.items()
            }
            layer.documentation = documentation
            source = os.path.relpath(Path(self._scene.path).resolve(), file.path.parent.resolve())
            source = Path(source).as_posix()  # not before: opening the layer would read the scene
            layer.subLayerPaths.append(source if source.startswith("../") else f"./{source}")
        file.adopt(path)
        file.commit()


def just_before(time: float) -> float:
    """Returns the latest time code before a time that OpenUSD distinguishes from it."""
    from pxr import Usd  # noqa: PLC0415 (slow)

    return time - Usd.TimeCode.SafeStep(max(1e6, abs(time)))


def _metadata_of(scene: Scene) -> dict[str, str | float]:
    """Returns the scene's metadata by name, for a layer over it, as a stage reads metadata only from its root layer.

    A missing default prim is replaced by the scene's first prim, a missing range of time codes by that of its times.
    """
    if not scene.has_file:
        raise ValueError(f"{scene.path}: a USD stage in memory has no file for a layer to be over: export it")
    stage = scene.stage
    start, end = scene.times[0], scene.times[-1]
    if stage.HasAuthoredTimeCodeRange():
        start, end = (float(stage.GetMetadata(name)) for name in ("startTimeCode", "endTimeCode"))
    default = stage.GetRootLayer().defaultPrim if stage.GetDefaultPrim() else ""
    return {
        "defaultPrim": default or stage.GetPseudoRoot().GetChildren()[0].GetName(),
        "endTimeCode": end,
        "framesPerSecond": stage.GetFramesPerSecond(),
        "metersPerUnit": scene.meters_per_unit,
        "startTimeCode": start,
        "timeCodesPerSecond": stage.GetTimeCodesPerSecond(),
        "upAxis": scene.up_axis,
    }
