"""Opens a USD file with everything that it refers to. Imports pxr: to be imported where it is used."""

import contextlib
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from pxr import Ar, Gf, Tf, Ts, Usd, UsdUtils

__all__ = ["LeftOut", "UnreadableError", "as_time_code", "collecting", "open_stage", "reading", "sample_times"]

_DAMAGE = (RuntimeError, TypeError, OverflowError, UnicodeError)  # Tf.ErrorException is a RuntimeError
_STILL = (Ts.ExtrapHeld, Ts.ExtrapValueBlock)
_PROBES = 8  # parts of a piece of a spline at whose ends it is held against the straight line
_BEND = 0.01  # most that a piece may leave the straight line, as a share of all that the spline goes through
_MOST_HALVINGS = 10


class UnreadableError(ValueError):
    """Something in a scene that cannot be read.

    Attributes:
        mesh: The :class:`~warp_bsc.usd.meshes.UsdMesh` that it is about, None if that is not read at all.
        time: The scene's time code at which it cannot be read, None if at none.
    """

    def __init__(self, message, mesh=None, time=None):
        super().__init__(message)
        self.mesh = mesh
        self.time = time


class LeftOut:
    """What of a scene cannot be read, and is left out.

    Attributes:
        is_strict: Whether nothing may be.
        reasons: What is left out and why, a sentence each.
    """

    def __init__(self, file, is_strict: bool):
        self._prefix = f"{file}: "
        self.is_strict = is_strict
        self.reasons = []

    def add(self, error: UnreadableError, since: str = "") -> None:
        """Leave out what an error is about.

        Args:
            error: The error.
            since: From when on, in words; empty for all of the time.

        Raises:
            UnreadableError: If nothing may be left out.
        """
        if self.is_strict:
            raise error
        self.reasons.append(since + str(error).removeprefix(self._prefix))


@contextlib.contextmanager
def reading(where: str, mesh=None, time: float | None = None, errors=(ValueError, *_DAMAGE)):
    """Say of errors in damaged data, which OpenUSD raises in many types, where they are.

    Args:
        where: File and prim.
        mesh: The mesh that is read.
        time: The time code.
        errors: Types of what is raised.

    Raises:
        UnreadableError: If any of the errors is raised within.
    """
    try:
        with np.errstate(all="ignore"):  # what is not finite is found where positions are read
            yield
    except errors as error:
        what = str(error) if isinstance(error, UnreadableError) else f"{where}: {_describe(error)}"
        raise UnreadableError(what, mesh, time) from error


@contextlib.contextmanager
def collecting(messages: list[str], file):
    """Add to messages what OpenUSD would print on standard error, each once and in one line.

    Raises:
        UnreadableError: If OpenUSD raises anything.
    """
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        with reading(str(file), errors=_DAMAGE):
            yield
    finally:
        texts = map(_commentary, delegate.TakeUncoalescedDiagnostics())
        messages += dict.fromkeys(text for text in texts if text not in messages)


def open_stage(path, left_out: LeftOut) -> Usd.Stage:
    """Open a USD file with everything that it refers to, found as OpenUSD's asset resolver finds files.

    Args:
        path: Its name, which may be of a file inside a package, such as ``"model.usdz[model.usda]"``, or on the
            resolver's search path.
        left_out: What cannot be opened is left out.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not USD, or has no clock.
        UnreadableError: If it refers to something that cannot be opened, which may not be left out.
    """
    resolved = str(Ar.GetResolver().Resolve(str(path)))
    if not resolved:
        raise FileNotFoundError(f"{path}: no such file")
    if Path(resolved).is_dir():
        raise ValueError(f"{path}: a folder, not a USD file")

    with collecting([], path):  # what is printed here is among the errors below
        try:
            stage = Usd.Stage.Open(str(path))
        except RuntimeError as error:
            raise ValueError(f"{path}: not a readable USD file: {_describe(error)}") from None
        for layer in stage.GetUsedLayers():
            if not (0 < layer.timeCodesPerSecond < math.inf):  # OpenUSD does not come back from asking for samples
                raise ValueError(f"{path}: timeCodesPerSecond of {layer.identifier} is {layer.timeCodesPerSecond:g}")
    for error in stage.GetCompositionErrors():
        left_out.add(UnreadableError(f"{path}: {_one_line(str(error))}"))
    return stage


def sample_times(*attributes) -> set[float]:
    """Time codes at which attributes have a sample; of those only that have two or more.

    A spline is sampled at its knots, and between them so that it is straight from one to the next but for a hundredth
    of all that it goes through; beyond them, if it goes on there, as long as the stage lasts.
    """
    times = set()
    for attribute in attributes:
        if not attribute:
            continue
        own = _spline_times(attribute) if attribute.HasSpline() else attribute.GetTimeSamples()
        if len(own) > 1:
            times.update(own)
    return times


def as_time_code(time: float, *, before: bool) -> Usd.TimeCode:
    """A time, or the moment before it: where a value jumps at that time, it still is what it was."""
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
        return np.array([attribute.Get(code) for code in codes], dtype=float)  # not a number where there is no value

    pieces = [(first, last, probe(first, last), 0) for first, last in pairwise(sorted(times))]
    values = np.array([values for *_, values, _ in pieces])
    values = values[np.isfinite(values)]
    most = _BEND * np.ptp(values) if len(values) else 0.0
    while pieces:
        first, last, values, halvings = pieces.pop()
        bend = np.abs(values - np.linspace(values[0], values[-1], _PROBES + 1)).max()
        if bend > most and halvings < _MOST_HALVINGS:
            # At a whole time code, if there is one, where others are sampled as well.
            middle = round((first + last) / 2)
            middle = float(middle) if first < middle < last else (first + last) / 2
            times.add(middle)
            pieces += [(*ends, probe(*ends), halvings + 1) for ends in ((first, middle), (middle, last))]
    return times


def _describe(error) -> str:
    """What an exception says, in one line."""
    if isinstance(error, Tf.ErrorException) and error.args:
        return _commentary(error.args[0])
    return _one_line(str(error)) or type(error).__name__


def _commentary(diagnostic) -> str:
    """What OpenUSD says of something, in one line."""
    try:
        return _one_line(diagnostic.commentary)
    except UnicodeError:  # it quotes what is no text
        return "there are bytes that are no text"


def _one_line(text: str) -> str:
    return " ".join(text.split())
