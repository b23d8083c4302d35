"""Opens a USD file with everything that it refers to. Imports pxr, which is slow: import this where it is used."""

# pyright: reportAttributeAccessIssue=false
# (OpenUSD's stubs leave out the classes of its modules.)

import contextlib
import math
import os
import re
from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Ar, Gf, Tf, Ts, Usd, UsdShade, UsdUtils

if TYPE_CHECKING:
    from .meshes import UsdMesh

__all__ = [
    "LeftOut",
    "UnreadableError",
    "as_time_code",
    "collecting",
    "may_jump",
    "open_stage",
    "reading",
    "sample_times",
]

_DAMAGE = (RuntimeError, TypeError, OverflowError, UnicodeError)  # Tf.ErrorException is a RuntimeError
# What OpenUSD says of a missing file or prim; its classes do not tell Python.
_MISSING = re.compile(
    r"(Could not open asset|Could not load sublayer|Unresolved \w+ prim path) @(?P<asset>.+?)@"
    r"(.* introduced by @.*@<(?P<prim>.+?)>)?",
    re.DOTALL,
)
_NO_GEOMETRY = frozenset(
    f".{extension}"
    for kinds in (
        "mtlx osl oso glsl glslfx hlsl mdl sl args",  # materials
        "png jpg jpeg tif tiff exr hdr tga bmp gif tx tex rat dds ktx ktx2 webp avif heic psd pic rgb svg",
        "ies ocio cube lut icc spi1d spi3d",  # lights and colours
        "wav mp3 m4a aac aif aiff ogg flac mp4 mov avi",
        "txt md json html pdf",
    )
    for extension in kinds.split()
)
_STILL = (Ts.ExtrapHeld, Ts.ExtrapValueBlock)
_PROBES = 8  # parts of a piece of a spline; at their ends the spline is compared with the straight line
_BEND = 0.01  # largest distance of a piece from the straight line, as a share of the spline's range of values
_MOST_HALVINGS = 10


class UnreadableError(ValueError):
    """A part of a scene cannot be read.

    Attributes:
        mesh: The :class:`~warp_bsc.usd.meshes.UsdMesh` that cannot be read, None before it is constructed.
        time: The scene's time code at which it cannot be read, None if it cannot at any time.
    """

    def __init__(self, message: str, mesh: "UsdMesh | None" = None, time: float | None = None):
        """Says what cannot be read, and where."""
        super().__init__(message)
        self.mesh = mesh
        self.time = time


class LeftOut:
    """The parts of a scene that cannot be read and are left out.

    Attributes:
        is_strict: Whether leaving out is forbidden.
        reasons: The parts left out and why, a sentence each.
        notes: What is missing and need not be there, a sentence each.
    """

    def __init__(self, file: str | os.PathLike, is_strict: bool, allow_missing: tuple[str, ...] = ()):
        """Starts with nothing left out; sentences do not repeat the file's name.

        Args:
            file: The file.
            is_strict: Whether leaving out is forbidden.
            allow_missing: As of :class:`~warp_bsc.usd.scene.Scene`.
        """
        self._prefix = f"{file}: "
        self._allow_missing = allow_missing
        self.is_strict = is_strict
        self.reasons: list[str] = []
        self.notes: list[str] = []

    def add(self, error: UnreadableError, since: str = "") -> None:
        """Leaves out the part that an error is about.

        Args:
            error: The error.
            since: From when on, in words; empty for the whole time.

        Raises:
            UnreadableError: If nothing may be left out.
        """
        if self.is_strict:
            raise error
        self.reasons.append(since + str(error).removeprefix(self._prefix))

    def add_missing(self, error: UnreadableError, prim: Usd.Prim, asset: str = "") -> None:
        """Leaves out what a missing file or prim would hold; only notes it where that is no geometry, or is allowed.

        Args:
            error: The error.
            prim: The prim that refers to it; it may be invalid.
            asset: The path of the file, empty if a prim is missing.

        Raises:
            UnreadableError: As of :meth:`add`.
        """
        names = [asset, str(prim.GetPath())] if prim else [asset]
        if _is_no_geometry(asset, prim) or any(_may_be_missing(name, self._allow_missing) for name in names if name):
            self.notes.append(f"missing: {str(error).removeprefix(self._prefix)}")
        else:
            self.add(error)


@contextlib.contextmanager
def reading(
    where: str,
    mesh: "UsdMesh | None" = None,
    time: float | None = None,
    errors: tuple[type[Exception], ...] = (ValueError, *_DAMAGE),
) -> Iterator[None]:
    """Turns errors in damaged data, for which OpenUSD raises many types, into one that says where the damage is.

    Args:
        where: File and prim.
        mesh: The mesh that is read.
        time: The time code.
        errors: Types of the errors that are turned into :class:`UnreadableError`.

    Raises:
        UnreadableError: If any of the errors is raised within.
    """
    try:
        with np.errstate(all="ignore"):  # positions that are not finite are found where they are read
            yield
    except errors as error:
        what = str(error) if isinstance(error, UnreadableError) else f"{where}: {_describe(error)}"
        raise UnreadableError(what, mesh, time) from error


@contextlib.contextmanager
def collecting(messages: list[str], file: str | os.PathLike) -> Iterator[None]:
    """Appends the messages that OpenUSD would print on standard error, each once and in one line.

    Raises:
        UnreadableError: If OpenUSD raises an error.
    """
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        with reading(str(file), errors=_DAMAGE):
            yield
    finally:
        texts = map(_commentary, delegate.TakeUncoalescedDiagnostics())
        messages += dict.fromkeys(text for text in texts if text not in messages)


def open_stage(path: str | os.PathLike, left_out: LeftOut) -> Usd.Stage:
    """Opens a USD file with everything that it refers to, found by OpenUSD's asset resolver.

    Args:
        path: Name of the file. It may be inside a package, such as ``"model.usdz[model.usda]"``, or on the resolver's
            search path.
        left_out: Takes the references that cannot be opened.

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

    with collecting([], path):  # OpenUSD prints messages here that are among the errors below
        try:
            stage = Usd.Stage.Open(str(path))
        except RuntimeError as error:
            raise ValueError(f"{path}: not a readable USD file: {_describe(error)}") from None
        for layer in stage.GetUsedLayers():
            if not (0 < layer.timeCodesPerSecond < math.inf):  # OpenUSD would search for samples for ever
                raise ValueError(f"{path}: timeCodesPerSecond of {layer.identifier} is {layer.timeCodesPerSecond:g}")
    for error in stage.GetCompositionErrors():
        unreadable = UnreadableError(f"{path}: {_one_line(str(error))}")
        if missing := _MISSING.search(str(error)):
            prim = stage.GetPrimAtPath(missing["prim"]) if missing["prim"] else Usd.Prim()
            left_out.add_missing(unreadable, prim, missing["asset"].split(":SDF_FORMAT_ARGS:")[0])
        else:
            left_out.add(unreadable)
    return stage


def _is_no_geometry(asset: str, prim: Usd.Prim) -> bool:
    """Returns whether a missing file cannot hold geometry: by its name, or as a prim of a material refers to it."""
    inner = asset.rstrip("]").rpartition("[")[2]  # of a package
    if os.path.splitext(inner)[1].lower() in _NO_GEOMETRY:
        return True
    while prim:
        if prim.IsA(UsdShade.NodeGraph) or prim.IsA(UsdShade.Shader):  # materials are node graphs
            return True
        prim = prim.GetParent()
    return False


def _may_be_missing(name: str, patterns: tuple[str, ...]) -> bool:
    """Returns whether the name of a file, its end from a folder on, the path of a prim, or of one above it, matches."""
    forms = (
        form for pattern in patterns for form in (pattern, f"{pattern.rstrip('/')}/*", f"*/{pattern.lstrip('./')}")
    )
    return any(fnmatchcase(name, form) for form in forms)


def sample_times(*attributes: Usd.Attribute) -> set[float]:
    """Returns the time codes at which attributes have a sample, for attributes that have two or more.

    A spline is sampled at its knots, and between them until it is straight from one time to the next within a hundredth
    of its range of values. A spline that moves beyond its knots is sampled there until the stage ends.
    """
    times: set[float] = set()
    for attribute in attributes:
        if not attribute:
            continue
        own = _spline_times(attribute) if attribute.HasSpline() else attribute.GetTimeSamples()
        if len(own) > 1:
            times.update(own)
    return times


def may_jump(attributes: Iterable[Usd.Attribute]) -> bool:
    """Returns whether attributes may have another value just before a time than at that time.

    Between samples USD interpolates numbers and vectors, which joins the two. It does not interpolate splines that say
    so, values from one clip to the next, and lists of which the lengths differ.
    """
    for attribute in attributes:
        if not attribute or not attribute.ValueMightBeTimeVarying():
            continue
        if attribute.HasSpline() or attribute.GetResolveInfo().GetSource() == Usd.ResolveInfoSourceValueClips:
            return True
        if attribute.GetTypeName().isArray:
            values = (attribute.Get(time) for time in attribute.GetTimeSamples())
            if len({None if value is None else len(value) for value in values}) > 1:
                return True
    return False


def as_time_code(time: float, *, before: bool) -> Usd.TimeCode:
    """Returns a time, or the moment just before it, at which a value that jumps at the time still is the old one."""
    return Usd.TimeCode.PreTime(time) if before else Usd.TimeCode(time)


def _spline_times(attribute) -> set[float]:
    spline, stage = attribute.GetSpline(), attribute.GetStage()
    knots = list(spline.GetKnots().keys())
    if not knots:
        return set()
    start, end = knots[0], knots[-1]
    if spline.GetPreExtrapolation().mode not in _STILL:
        start = min(start, stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else start
    if spline.GetPostExtrapolation().mode not in _STILL:
        end = max(end, stage.GetEndTimeCode()) if stage.HasAuthoredTimeCodeRange() else max(end, start + 1.0)
    if spline.HasLoops():
        knots = spline.GetKnotsWithLoopsBaked(Gf.Interval(start, end)).keys()
    times = {start, end, *(knot for knot in knots if start < knot < end)}

    def probe(first, last):
        inner = (first + (last - first) * part / _PROBES for part in range(1, _PROBES))
        codes = [Usd.TimeCode(first), *map(Usd.TimeCode, inner), Usd.TimeCode.PreTime(last)]
        return np.array([attribute.Get(code) for code in codes], dtype=float)  # NaN where there is no value

    pieces = [(first, last, probe(first, last), 0) for first, last in pairwise(sorted(times))]
    values = np.array([values for *_, values, _ in pieces])
    values = values[np.isfinite(values)]
    most = _BEND * np.ptp(values) if len(values) else 0.0
    while pieces:
        first, last, values, halvings = pieces.pop()
        bend = np.abs(values - np.linspace(values[0], values[-1], _PROBES + 1)).max()
        if bend > most and halvings < _MOST_HALVINGS:
            # Split at a whole time code if there is one: other attributes are sampled there as well.
            middle = round((first + last) / 2)
            middle = float(middle) if first < middle < last else (first + last) / 2
            times.add(middle)
            pieces += [(*ends, probe(*ends), halvings + 1) for ends in ((first, middle), (middle, last))]
    return times


def _describe(error) -> str:
    """Returns the message of an exception in one line."""
    if isinstance(error, Tf.ErrorException) and error.args:
        return _commentary(error.args[0])
    return _one_line(str(error)) or type(error).__name__


def _commentary(diagnostic) -> str:
    """Returns the text of a diagnostic of OpenUSD in one line."""
    try:
        return _one_line(diagnostic.commentary)
    except UnicodeError:  # it quotes bytes that are no text
        return "there are bytes that are no text"


def _one_line(text: str) -> str:
    return " ".join(text.split())
