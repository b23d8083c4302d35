"""The time codes at which attributes of a USD stage are sampled. Imports pxr, which is slow: import this where used."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from pxr import Gf, Ts, Usd

_STILL = (Ts.ExtrapHeld, Ts.ExtrapValueBlock)
_PROBES = 8  # parts of a piece of a spline; at their ends the spline is compared with the straight line
_BEND = 0.01  # largest distance of a piece from the straight line, as a share of the spline's range of values
_MOST_HALVINGS = 10


def sample_times(*attributes: Usd.Attribute) -> set[float]:
    """Returns the time codes at which attributes have a sample, for attributes that have two or more.

    A spline is sampled at its knots, and between them until a straight line from one time to the next differs from it
    by at most a hundredth of its range of values. One that extrapolates is sampled beyond its knots to the stage's end.
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

    Between samples USD interpolates numbers and vectors, so that these do not jump. It does not interpolate held
    splines, values from one clip to the next, and lists whose lengths differ.
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


def _spline_times(attribute) -> set[float]:
    """Returns the times at which a spline is sampled."""
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
