"""Reads triage files: which meshes of a scene are meant to meet, why, and who has said so.

A triage file is JSON in UTF-8, with an entry a line::

    {"version": 1, "meant": [
    {"meshes": ["/World/Shin", "/World/Thigh"], "reason": "overlap at the knee", "who": "ada", "date": "2026-11-29"},
    {"meshes": ["/World/Sky"], "reason": "all is inside", "who": "ada", "date": "2026-11-29"}
    ]}

``meshes`` are two patterns as of :class:`warp_bsc.Selection`, twice the same for a mesh with itself, or one for a mesh
with all others. Patterns begin with ``/`` or ``*``; of mesh files they are the names that a command is given, such as
``coat_####.ply``.
"""

import datetime
import json
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..._arguments import checked_flag, given
from ..._atomic_file import naming
from ..selection import Meant, Selection

if TYPE_CHECKING:
    from pxr import Usd

KEY = "warp_bsc:triage"
"""The key in the ``customLayerData`` of a root layer that names a triage file, relative to that layer."""

_PATTERN = re.compile(r"(/[\w*?!\[\]-]+)+|\*[\w/*?!\[\]-]*")
"""A path of a prim, or a pattern of one."""


def select_by_triage(stage: "Usd.Stage") -> tuple[str, Selection | None]:
    """Returns the path of the triage file of a stage, and a selection with its entries; "" and None if it has none.

    It is the file that :data:`KEY` names in the root layer, or else, if it exists, the one beside that layer with its
    name and the ending ``.triage.json``.

    Raises:
        OSError: If the file that is named cannot be read.
        ValueError: If the key has another value than a path, or the file is not a triage file.
    """
    layer = stage.GetRootLayer()
    named = layer.customLayerData.get(KEY)
    if named is not None:
        named = getattr(named, "path", named)  # of an asset
        if not isinstance(named, str) or not named:
            raise ValueError(f"{layer.identifier}: {KEY} must be the path of a triage file, not {named!r}")
        path = layer.ComputeAbsolutePath(named)
    else:
        path = str(Path(layer.realPath).with_suffix(".triage.json")) if layer.realPath else ""
    if not path or (named is None and not Path(path).exists()):
        return "", None
    return path, Selection(triage=read_triage(path))


def read_triage(path: str | os.PathLike, *, of_files: bool = False) -> tuple[Meant, ...]:
    """Returns the entries of a triage file, for the attribute ``triage`` of :class:`warp_bsc.Selection`.

    Args:
        path: The file, as the page on replays describes it.
        of_files: Whether its meshes are names of mesh files, of any form, in place of paths of prims.

    Raises:
        OSError: If it cannot be read.
        TypeError: If an argument has another type.
        ValueError: If it is not a triage file; the message names the entry.
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"path must be the path of a triage file, not {given(path)}")
    is_name = checked_flag(of_files, "of_files")
    with naming(path):
        content = Path(path).read_bytes()
    try:
        found = json.loads(content.decode("utf-8-sig"))
        _check_keys(found, "the file", {"version": int, "meant": list})
        if found["version"] != 1:
            raise ValueError(f"version is {found['version']}, and this version of warp-bsc reads version 1")
        return tuple(_read_entry(entry, f"meant[{number}]", is_name) for number, entry in enumerate(found["meant"]))
    except ValueError as error:  # of its encoding, too
        raise ValueError(f"{path}: not a triage file: {error}") from None


def _read_entry(entry: Any, name: str, of_files: bool) -> Meant:
    _check_keys(entry, name, {"meshes": list, "reason": str, "who": str, "date": str})
    meshes = entry["meshes"]
    if len(meshes) not in (1, 2):
        raise ValueError(f"{name}: meshes must be one or two, not {len(meshes)}")
    for mesh in meshes:
        if not isinstance(mesh, str) or not (of_files or _PATTERN.fullmatch(mesh)):
            raise ValueError(f"{name}: meshes: {mesh!r} is not the path of a prim, and no pattern of one")
    try:
        datetime.date.fromisoformat(entry["date"])
    except ValueError:
        raise ValueError(f"{name}: date must be such as 2026-11-29, not {entry['date']!r}") from None
    return Meant(tuple(meshes), entry["reason"], entry["who"], entry["date"])


def _check_keys(found: Any, name: str, types: dict[str, type]) -> None:
    """Checks that something read from JSON is an object with some keys, of some types."""
    if not isinstance(found, dict):
        raise ValueError(f"{name} must be an object, not {found!r}")
    for key, value in found.items():
        if key not in types:
            raise ValueError(f"{name}: unknown key {key!r}; the keys are {', '.join(types)}")
        if not isinstance(value, types[key]) or isinstance(value, bool):
            raise ValueError(f"{name}: {key} must be of type {types[key].__name__}, not {value!r}")
    for key in types:
        if found.get(key) in (None, ""):
            raise ValueError(f"{name}: {key} is missing")
