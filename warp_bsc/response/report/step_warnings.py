"""Warns of what the steps of a stage lack, of each thing once."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..._warnings import warn_caller
from ..state.motion import SET_STEPS
from ..state.structs import NOT_FINITE
from ..tuning import MAX_STRAIN
from .text import not_finite_warning, revoked_warning, set_bodies_warning, shape_name, uncertified_warning

_CROSSINGS = (
    "edges pass through faces at the start of a step, and their contacts are delegated to the solver: "
    "warp_bsc.repair_state(model, state) moves them apart before the first step; where it has not, its result names in "
    "unresolved what remains and why, and its arguments order and max_strain let it move more"
)
_INVERSIONS = (
    "a step inverted tetrahedra, report.inverting counts those of the last one: take shorter steps, or pass "
    "inversions='prevented'"
)
_NOT_FOLLOWED = (
    "has changed in what the stage does not follow at run time, such as type, source, body, margin or flags of "
    "collision: it collides as it was, at its new pose; put a new stage behind the solver"
)


class StepWarnings:
    """Warnings of a report."""

    def __init__(self, report: Any):
        """Warns of what a :class:`.report.SolverReport` says."""
        self._report = report
        self._given: set[str] = set()

    def leave_out(self, subject: str) -> None:
        """Makes a warning be given never."""
        self._given.add(subject)

    def once(self, subject: str, message: Callable[[], str]) -> None:
        """Warns, once for each subject, of what a function returns."""
        if subject not in self._given:
            self._given.add(subject)
            warn_caller(message())

    def warn(self, known: dict[str, int]) -> None:
        """Warns of what totals, by name, say."""
        report, model = self._report, self._report.model
        if known["not_finite_steps"] and report.responds:
            self.once("not_finite", self._of_not_finite)
        if known["revoked_steps"]:
            self.once("revoked", self._of_revoked)
        named = known["not_finite_steps"] + known["revoked_steps"]
        if (known["uncertified_steps"] > named or known["remaining"]) and report.responds:
            self.once("uncertified", self._of_uncertified)
        if known["strained_steps"]:
            self.once("strain", self._of_strain)
        if known["crossing_steps"] and report.responds:
            self.once("crossings", lambda: _CROSSINGS)
        if known["inverting_steps"] and not report.prevents_inversions:
            self.once("inversions", lambda: _INVERSIONS)
        if known["shape_not_followed"]:
            shape = shape_name(model, known["shape_not_followed"] - 1)
            self.once("shapes", lambda: f"{shape} {_NOT_FOLLOWED}")
        if known["set_bodies"]:
            self.once("set_bodies", self._of_set_bodies)

    def _of_not_finite(self):
        model = self._report.model
        found = self._report.outcomes.find(NOT_FINITE)[: model.particle_count]
        return not_finite_warning(model, np.flatnonzero(found))

    def _of_revoked(self):
        coupled = self._report.coupled
        passed = coupled.find_passed()
        return revoked_warning(self._report.model, passed if len(passed) else coupled.bodies)

    def _of_uncertified(self):
        report, model = self._report, self._report.model
        listed, first = report.outcomes.find_uncertified(), model.particle_count
        particles, shapes = np.flatnonzero(listed[:first]), np.unique(report.shape_of_vertices[listed[first:]])
        return uncertified_warning(model, particles, shapes, may_invert=report.prevents_inversions)

    def _of_strain(self):
        report = self._report
        return (
            f"a step strained an edge by more than {float(MAX_STRAIN):.0%}{report.strain_cause}: {report.strain_advice}"
        )

    def _of_set_bodies(self):
        labels, bodies = self._report.model.body_label, np.flatnonzero(self._report.set_steps.numpy() == SET_STEPS)
        return set_bodies_warning([f"body {body} ({labels[body]!r})" for body in bodies])
