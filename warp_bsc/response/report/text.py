"""What a report says in words: a table of impulses by shape, and which particles and shapes a certificate lacks."""

from typing import Any

import newton
import numpy as np

from ..tuning import MAX_STRAIN

_LABEL = 36  # characters
_MOST_ROWS = 40
NAMED = 3
"""Particles or shapes that a warning names."""


def shape_name(model: newton.Model, shape: int) -> str:
    """Returns number and label of a shape."""
    return f"shape {shape} ({model.shape_label[shape]!r})"


def table_by_shape(model: newton.Model, contacts: dict[str, np.ndarray], dt: float | None, *, complete: bool) -> str:
    """Returns the contacts of a step by shape: their number, and sums of normal and tangential impulses or forces.

    Contacts are as of :meth:`.forces.contact_report.Contacts.numpy`, ``complete`` if these are all. With the length of
    the step ``dt`` [s], forces are means [N]; without it, impulses [N s].
    """
    unit, share = ("N s", 1.0) if dt is None else ("N", 1.0 / dt)
    both = contacts["shapes"] + 1  # of two particles: 0
    first, second = both.T
    # contacts of a shape with itself, or of two particles, count once
    shapes = np.concatenate([first, second[first != second]])
    size = model.shape_count + 1

    def sum_up(values):
        return np.bincount(shapes, weights=np.concatenate([values, values[first != second]]), minlength=size)

    count = np.bincount(shapes, minlength=size)
    normal = share * sum_up(contacts["normal_impulse"])
    tangential = share * sum_up(np.linalg.norm(contacts["tangential_impulse"], axis=1))
    rows = np.flatnonzero(count)
    rows = rows[np.argsort(-normal[rows], kind="stable")]
    lines = [f"{'shape':<{_LABEL}} {'contacts':>8} {f'normal [{unit}]':>15} {f'tangential [{unit}]':>17}"]
    for row in rows[:_MOST_ROWS]:
        label = "particles" if row == 0 else model.shape_label[row - 1]
        if len(label) > _LABEL:
            label = "..." + label[3 - _LABEL :]
        lines.append(f"{label:<{_LABEL}} {count[row]:>8} {normal[row]:>15.4g} {tangential[row]:>17.4g}")
    if not len(rows):
        lines.append("no contact had an impulse")
    if len(rows) > _MOST_ROWS:
        lines.append(f"and {len(rows) - _MOST_ROWS} shapes with less")
    if not complete:
        lines.append('contacts are missing: allow more of them than now, report={"contacts": number}')
    return "\n".join(lines)


def name_particles(model: newton.Model, particles: np.ndarray) -> list[str]:
    """Returns number and world of the first of some particles, and how many more there are."""
    world = None if model.particle_world is None or model.world_count <= 1 else model.particle_world.numpy()
    named = [f"particle {i}" + ("" if world is None else f" of world {world[i]}") for i in particles[:NAMED]]
    if len(particles) > NAMED:
        named.append(f"{len(particles) - NAMED} more particles")
    return named


def first_of(names: list[str]) -> str:
    """Returns the first of some names, and how many more there are."""
    return ", ".join(names[:NAMED] + [f"{len(names) - NAMED} more"] * (len(names) > NAMED))


def unseen_warning(labels: list[str]) -> str:
    """Returns what to say of shapes, by their labels, that an entry of a coupled solver does not see."""
    return (
        f"the entry of a coupled solver does not see {first_of([repr(label) for label in labels])}, which collide with "
        "particles: its particles pass through them, and no certificate covers that; make proxies of their bodies"
    )


def line_of(report: Any) -> str:
    """Returns what a :class:`.report.SolverReport` says of the steps so far, in one line."""
    totals, inside = report.totals, len(np.unique(report.inside.particles))
    line = (
        f"{totals.steps} steps, {totals.truncated_steps} with truncation, {totals.frozen_steps} with frozen "
        f"vertices, {totals.uncertified_steps} not certified"
    )
    removed = "(warp_bsc.repair_state removes those of a first step, or names them)"
    contacts = f"; contacts: {totals.remaining} remained, {totals.excluded} excluded"
    more = (
        (totals.revoked_steps, " ({} only in the state of the program)"),
        (totals.unseen_steps, ", {} whose end in the state of the program was not seen"),
        (totals.strained_steps, f", {{}} that strained an edge by more than {float(MAX_STRAIN):.0%}"),
        (totals.inverting_steps, ", {} that inverted tetrahedra"),
        (report.crossings, f", {{}} crossings at the start of the step {removed}"),
        (inside, ", {} particles inside solids"),
        (totals.remaining + totals.excluded, contacts),
        (report.filtered, "; {} filtered pairs in the last step, which are not certified"),
        (totals.not_finite_steps, ", {} steps with positions that are not finite"),
    )
    return line + "".join(text.format(number) for number, text in more if number)
