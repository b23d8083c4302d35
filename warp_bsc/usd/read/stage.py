"""Opens a USD file with everything that it refers to. Imports pxr, which is slow: import this where it is used."""

import math
import os
import re
import shutil
import tempfile
import weakref
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Usd

from ..._arguments import given
from ..._warnings import warn_caller
from .unreadable import LeftOut, UnreadableError, collecting, describe_error, in_one_line

# OpenUSD's messages on a missing file or prim; its error classes do not reach Python.
_MISSING = re.compile(
    r"(Could not open asset|Could not load sublayer|Unresolved \w+ prim path) @(?P<asset>.+?)@"
    r"(.* introduced by @.*@<(?P<prim>.+?)>)?",
    re.DOTALL,
)


def given_stage(source: Any) -> Usd.Stage:
    """Returns the stage that a program has opened, or one of its layer.

    Raises:
        TypeError: If it has given neither.
        ValueError: If it has closed the stage.
    """
    if isinstance(source, Sdf.Layer):
        return Usd.Stage.Open(source)
    if not isinstance(source, Usd.Stage):
        raise TypeError(f"source must be the path of a file, a Usd.Stage or an Sdf.Layer, not {given(source)}")
    if not source:
        raise ValueError("source: the USD stage has been closed")
    return source


def name_of(stage: Usd.Stage) -> str:
    """Returns the path of the file of a stage, or the identifier of its root layer if it has none."""
    root = stage.GetRootLayer()
    return root.realPath or root.identifier


def write_for_others(stage: Usd.Stage, owner: Any) -> str:
    """Flattens a stage into a temporary file, which stays as long as its owner, warns of it, and returns its path."""
    folder = tempfile.mkdtemp(prefix="warp_bsc_")
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    path = os.path.join(folder, "stage.usdc")
    stage.Flatten().Export(path)
    warn_caller(f"{name_of(stage)}: flattened into {path}, for other processes")
    return path


def open_stage(path: str | os.PathLike, left_out: LeftOut) -> Usd.Stage:
    """Opens a USD file with everything that it refers to, found by OpenUSD's asset resolver.

    Args:
        path: Name of the file. It may be inside a package, such as ``"model.usdz[model.usda]"``, or on the resolver's
            search path.
        left_out: Records the references that cannot be opened.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not USD, or its time codes per second are not a positive number.
        UnreadableError: If a reference cannot be opened and may not be left out.
    """
    resolved = str(Ar.GetResolver().Resolve(str(path)))
    if not resolved:
        raise FileNotFoundError(f"{path}: no such file")
    if Path(resolved).is_dir():
        raise ValueError(f"{path}: a folder, not a USD file")

    with collecting([], path):  # its messages here are among the composition errors below
        try:
            stage = Usd.Stage.Open(str(path))
        except RuntimeError as error:
            reason = _why_no_alembic(resolved) or f"not a readable USD file: {describe_error(error)}"
            raise ValueError(f"{path}: {reason}") from None
    check_stage(stage, path, left_out)
    return stage


def _why_no_alembic(path: str) -> str:
    """Returns why OpenUSD cannot open an Alembic file, and what to do; empty for other files, and where it can."""
    if not path.lower().endswith(".abc") or Sdf.FileFormat.FindByExtension("abc"):
        return ""
    return (
        "Alembic, for which this OpenUSD has no plugin, as usd-core has none: convert it where there is one, as in "
        f"Houdini or Maya, by usdcat {Path(path).name} --out {Path(path).stem}.usdc"
    )


def check_stage(stage: Usd.Stage, path: str | os.PathLike, left_out: LeftOut) -> None:
    """Checks a stage before it is read, with the arguments and errors of :func:`open_stage`."""
    with collecting([], path):
        for layer in stage.GetUsedLayers():
            if not (0 < layer.timeCodesPerSecond < math.inf):  # OpenUSD would search for samples without end
                raise ValueError(f"{path}: timeCodesPerSecond of {layer.identifier} is {layer.timeCodesPerSecond:g}")
    for error in stage.GetCompositionErrors():
        text = f"{path}: {in_one_line(str(error))}"
        if missing := _MISSING.search(str(error)):
            prim = stage.GetPrimAtPath(missing["prim"]) if missing["prim"] else Usd.Prim()
            asset = missing["asset"].split(":SDF_FORMAT_ARGS:")[0]
            text += (why := _why_no_alembic(asset)) and f" ({why})"
            left_out.add_missing(UnreadableError(text), prim, asset)
        else:
            left_out.add(UnreadableError(text))
