"""What a report says in words: a table of impulses by shape, and which particles and shapes a certificate lacks."""

from typing import Any

import newton
import numpy as np

from ..tuning import MAX_STRAIN

_LABEL = 36  # characters
_MOST_ROWS = 40
_NAMED = 3  # particles or shapes that a warning names


def shape_name(model: newton.Model, shape: int) -> str:
    """Returns number and label of a shape."""
    return f"shape {shape} ({model.shape_label[shape]!r})"


def table_by_shape(model: newton.Model, contacts: dict[str, np.ndarray], dt: float | None, *, complete: bool) -> str:
    """Returns the contacts of a step by shape: their number, and sums of normal and tangential impulses or forces.

    Args:
        model: The model.
        contacts: The contacts, see :meth:`.forces.contact_report.Contacts.numpy`.
        dt: Length of the step [s], for mean forces [N]; None for impulses [N s].
        complete: Whether these are all contacts.
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


def _name_particles(model, particles):
    """Returns number and world of the first of some particles, and how many more there are."""
    world = None if model.particle_world is None or model.world_count <= 1 else model.particle_world.numpy()
    named = [f"particle {i}" + ("" if world is None else f" of world {world[i]}") for i in particles[:_NAMED]]
    if len(particles) > _NAMED:
        named.append(f"{len(particles) - _NAMED} more particles")
    return named


def _first(names: list[str]) -> str:
    """Returns the first of some names, and how many more there are."""
    return ", ".join(names[:_NAMED] + [f"{len(names) - _NAMED} more"] * (len(names) > _NAMED))


def set_bodies_warning(bodies: list[str]) -> str:
    """Returns what to say of dynamic bodies, by name, whose pose a program writes between steps."""
    return (
        f"a program writes the pose of dynamic bodies between steps ({_first(bodies)}): the stage does not see their "
        "way there, on which they pass through things. Add what a program moves with is_kinematic=True"
    )


def not_finite_warning(model: newton.Model, particles: np.ndarray) -> str:
    """Returns what to say of a step in which particles had no finite prediction, empty if that was an earlier step."""
    named = f" ({', '.join(_name_particles(model, particles))})" if len(particles) else ""
    return (
        f"positions or velocities of particles{named} were not finite after the inner solver in a step: the particles "
        "stayed where they were, and the step is not certified (see report.not_finite)"
    )


def unseen_warning(labels: list[str]) -> str:
    """Returns what to say of shapes, by their labels, that an entry of a coupled solver does not see."""
    return (
        f"the entry of a coupled solver does not see {_first([repr(label) for label in labels])}, which collide with "
        "particles: its particles pass through them, and no certificate covers that; make proxies of their bodies"
    )


def revoked_warning(model: newton.Model, bodies: np.ndarray) -> str:
    """Returns what to say of a step that is certified as an entry of a coupled solver sees it, but not in the end."""
    named = _first([f"body {i} ({model.body_label[i]!r})" for i in bodies])
    return (
        "in the state of the program a step is not certified, although it is as its entry of a coupled solver sees it: "
        f"{named or 'particles of another entry'} may pass through particles of this one. "
        "report.totals.revoked_steps counts such steps; to have none, put SolverCCD around the coupled solver, see "
        "Robots in the documentation"
    )


def uncertified_warning(
    model: newton.Model, particles: np.ndarray, shapes: np.ndarray, *, may_invert: bool = False
) -> str:
    """Returns what to say of a step that is not certified, given the particles and shapes concerned.

    With ``may_invert`` it may also lack the certificate because a tetrahedron inverts.
    """
    if not len(particles) and not len(shapes):
        return (
            "a step was not certified, and a later one is: read report.certified after each step, "
            "or report.totals.uncertified_steps"
        )
    named = _name_particles(model, particles)
    named += [shape_name(model, shape) for shape in shapes[:_NAMED]]
    if len(shapes) > _NAMED:
        named.append(f"{len(shapes) - _NAMED} more shapes")
    or_invert = ", or invert a tetrahedron" if may_invert else ""
    return (
        f"a step is not certified, its motion may pass through something{or_invert}: {', '.join(named)}. "
        "To look closer: report.uncertified_vertices and report.uncertified_bodies list all of that step, and "
        "report.draw(viewer) shows them in red"
    )


def line_of(report: Any) -> str:
    """Returns what a :class:`.report.SolverReport` says of the steps so far, in one line."""
    totals, inside = report.totals, len(np.unique(report.inside.particles))
    line = (
        f"{totals.steps} steps, {totals.truncated_steps} with truncation, {totals.frozen_steps} with frozen "
        f"vertices, {totals.uncertified_steps} not certified"
    )
    if totals.revoked_steps:
        line += f" ({totals.revoked_steps} only in the state of the program)"
    if totals.unseen_steps:
        line += f", {totals.unseen_steps} whose end in the state of the program was not seen"
    if totals.strained_steps:
        line += f", {totals.strained_steps} that strained an edge by more than {float(MAX_STRAIN):.0%}"
    if totals.inverting_steps:
        line += f", {totals.inverting_steps} that inverted tetrahedra"
    if report.crossings:
        line += f", {report.crossings} crossings at the start of the step"
        line += " (warp_bsc.repair_state removes those of a first step, or names them)"
    if inside:
        line += f", {inside} particles inside solids"
    if totals.remaining or totals.excluded:
        line += f"; contacts: {totals.remaining} remained, {totals.excluded} excluded"
    if report.filtered:
        line += f"; {report.filtered} filtered pairs in the last step, which are not certified"
    if totals.not_finite_steps:
        line += f", {totals.not_finite_steps} steps with positions that are not finite"
    return line
