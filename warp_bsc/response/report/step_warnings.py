"""Warns of what the steps of a stage lack, of each thing once."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..._warnings import warn_caller
from ..state.motion import SET_STEPS
from ..state.structs import NOT_FINITE
from ..tuning import MAX_STRAIN
from .text import NAMED, first_of, name_particles, shape_name

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
        model, find = self._report.model, self._report.outcomes.find
        particles = np.flatnonzero(find(NOT_FINITE)[: model.particle_count])  # none if that was an earlier step
        named = f" ({', '.join(name_particles(model, particles))})" if len(particles) else ""
        return (
            f"positions or velocities of particles{named} were not finite after the inner solver in a step: the "
            "particles stayed where they were, and the step is not certified (see report.not_finite)"
        )

    def _of_revoked(self):
        coupled, labels = self._report.coupled, self._report.model.body_label
        passed = coupled.find_passed()
        named = first_of([f"body {i} ({labels[i]!r})" for i in (passed if len(passed) else coupled.bodies)])
        return (
            "in the state of the program a step is not certified, although it is as its entry of a coupled solver sees "
            f"it: {named or 'particles of another entry'} may pass through particles of this one. "
            "report.totals.revoked_steps counts such steps; to have none, put SolverCCD around the coupled solver, see "
            "Robots in the documentation"
        )

    def _of_uncertified(self):
        report, model = self._report, self._report.model
        listed, first = report.outcomes.find_uncertified(), model.particle_count
        particles, shapes = np.flatnonzero(listed[:first]), np.unique(report.shape_of_vertices[listed[first:]])
        if not len(particles) and not len(shapes):
            return (
                "a step was not certified, and a later one is: read report.certified after each step, "
                "or report.totals.uncertified_steps"
            )
        named = name_particles(model, particles) + [shape_name(model, shape) for shape in shapes[:NAMED]]
        if len(shapes) > NAMED:
            named.append(f"{len(shapes) - NAMED} more shapes")
        filtering = ""
        if len(holding := report.find_shapes_at(particles)):
            filtering = (
                f"Leave more room, or let them through {first_of([shape_name(model, shape) for shape in holding])}: "
                f"collision_filter=CollisionFilter(shape_mask=mask), with mask = np.full({model.shape_count}, -1) and "
                f"mask[{holding.tolist()}] = 0. "
            )
        or_invert = ", or invert a tetrahedron" if report.prevents_inversions else ""
        return (
            f"a step is not certified, its motion may pass through something{or_invert}: {', '.join(named)}. "
            f"{filtering}To look closer: report.uncertified_vertices and report.uncertified_bodies list all of that "
            "step, and report.draw(viewer) shows them in red"
        )

    def _of_strain(self):
        report, most = self._report, f"{float(MAX_STRAIN):.0%}"
        return f"a step strained an edge by more than {most}{report.strain_cause}: {report.strain_advice}"

    def _of_set_bodies(self):
        labels, bodies = self._report.model.body_label, np.flatnonzero(self._report.set_steps.numpy() == SET_STEPS)
        named = first_of([f"body {body} ({labels[body]!r})" for body in bodies])
        return (
            f"a program writes the pose of dynamic bodies between steps ({named}): the stage does not see their way "
            "there, on which they pass through things. Add what a program moves with is_kinematic=True"
        )
