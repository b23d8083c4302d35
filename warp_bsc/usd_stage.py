"""Opens a USD file with everything that it refers to. Imports pxr: to be imported where it is used."""

from pathlib import Path

from pxr import Tf, Usd, UsdUtils

__all__ = ["as_time_code", "open_stage", "sample_times"]


def open_stage(path) -> Usd.Stage:
    """Open a USD file with everything that it refers to.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not USD, or refers to something that cannot be opened.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: no such file")
    if Path(path).is_dir():
        raise ValueError(f"{path}: a folder, not a USD file")

    # While it lives, the delegate keeps USD from printing what is raised here.
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError(f"{path}: not a readable USD file: {_one_line(error.args[0].commentary)}") from None
    finally:
        delegate.TakeUncoalescedDiagnostics()
    if errors := stage.GetCompositionErrors():
        more = f" (and {len(errors) - 1} more errors)" if len(errors) > 1 else ""
        raise ValueError(f"{path}: {_one_line(str(errors[0]))}{more}")
    return stage


def sample_times(*attributes) -> set[float]:
    """Time codes at which attributes have a sample, or a spline a knot; of those only that have two or more."""
    times = set()
    for attribute in attributes:
        if not attribute:
            continue
        own = attribute.GetSpline().GetKnots().keys() if attribute.HasSpline() else attribute.GetTimeSamples()
        if len(own) > 1:
            times.update(own)
    return times


def as_time_code(time: float, *, before: bool) -> Usd.TimeCode:
    """A time, or the moment before it: where a value jumps at that time, it still is what it was."""
    return Usd.TimeCode.PreTime(time) if before else Usd.TimeCode(time)


def _one_line(text: str) -> str:
    return " ".join(text.split())
