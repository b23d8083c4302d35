"""Draws the pictures of the page "How it works": signs of a query, and one step of the stage.

    python examples/figures/how_it_works.py assets

Writes ``bernstein_signs.png`` and ``one_step.png`` to the folder. All numbers are computed from the positions below:
the status by ``bsc.query_vertex_face``, the coefficients as the page defines them. Needs matplotlib
(``pip install matplotlib``).
"""

import argparse
import itertools
from pathlib import Path

import matplotlib.pyplot as plt
import newton
import numpy as np
import warp as wp

import warp_bsc as bsc

_STATUS = {0: "FREE", 1: "HIT", 2: "UNSURE"}
_CURVE, _POLYGON, _INSIDE = "#1f77b4", "#d62728", ["#2ca02c", "#9467bd", "#ff7f0e"]
_TIMES = np.linspace(0.0, 1.0, 201)
_TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_TILTED = np.array([[0.1, 0.0, 0.1], [1.0, 0.1, -0.5], [0.0, 1.0, 0.45]])
_TURNED = np.array([[1.0, -0.4, 0.5], [0.1, -0.8, -0.4], [-0.6, 1.3, -0.5]])
QUERIES = {
    "stays above": (_TILTED, [0.3, 0.3, 0.5], [0.4, 0.3, 0.3]),
    "passes beside": (_TILTED, [0.9, 0.5, 0.4], [1.0, 0.6, -0.8]),
    "passes beside, then through": (_TURNED, [0.0, -0.1, 0.7], [0.3, -0.5, -0.5]),
}
"""Triangle at the end, and vertex at the start and at the end, by what happens. The triangle starts as _TRIANGLE."""


def coefficients(moved, start, end):
    """Returns the Bernstein coefficients of the coplanarity Y, shape [4], and of the inside tests, shape [3, 3].

    The inside tests are the components along z of w x v, u x w and n - w x v - u x w.
    """
    u, v = ([points[i] - points[0] for points in (_TRIANGLE, moved)] for i in (1, 2))
    w = [np.array(point) - points[0] for point, points in ((start, _TRIANGLE), (end, moved))]

    def product(x, y):
        return np.array(
            [np.cross(x[0], y[0]), (np.cross(x[0], y[1]) + np.cross(x[1], y[0])) / 2.0, np.cross(x[1], y[1])]
        )

    n = product(u, v)
    cubic = [w[0] @ n[0], (2.0 * w[0] @ n[1] + w[1] @ n[0]) / 3.0, (2.0 * w[1] @ n[1] + w[0] @ n[2]) / 3.0, w[1] @ n[2]]
    first, second = product(w, v)[:, 2], product(u, w)[:, 2]
    return np.array(cubic), np.array([first, second, n[:, 2] - first - second])


def bernstein(values, times):
    """Returns a polynomial of Bernstein coefficients at times, by de Casteljau's algorithm."""
    values = [np.full_like(times, value) for value in values]
    while len(values) > 1:
        values = [(1.0 - times) * a + times * b for a, b in itertools.pairwise(values)]
    return values[0]


def roots_of(cubic):
    """Returns the times at which a cubic changes its sign, within 1e-4 of the step."""
    times = np.linspace(0.0, 1.0, 10001)
    signs = bernstein(cubic, times) > 0.0
    return times[1:][signs[1:] != signs[:-1]]


def draw_signs(path):
    """Draws, for each query, its motion, the coplanarity with its control polygon, and the inside tests."""
    heights = {"height_ratios": [1.25, 1.0, 1.0]}
    figure, axes = plt.subplots(3, len(QUERIES), figsize=(10.0, 4.3), constrained_layout=True, gridspec_kw=heights)
    for column, (title, (moved, start, end)) in enumerate(QUERIES.items()):
        points = np.array([[start, *_TRIANGLE, end, *moved]])
        status = _STATUS[int(bsc.query_vertex_face(points, device="cpu").status[0])]
        cubic, inside = coefficients(moved, start, end)
        roots = roots_of(cubic)
        axes[0, column].remove()
        scene = figure.add_subplot(3, len(QUERIES), 1 + column, projection="3d")
        draw_motion(scene, moved, start, end)
        scene.set_title(f"{title}: {status}")
        plane, tests = axes[1, column], axes[2, column]
        plane.plot(_TIMES, bernstein(cubic, _TIMES), color=_CURVE, label="Y(t)")
        plane.plot(np.arange(4) / 3.0, cubic, "o--", color=_POLYGON, lw=1.0, label="$k_0 \\ldots k_3$")
        for i, values in enumerate(inside):
            tests.plot(_TIMES, bernstein(values, _TIMES), color=_INSIDE[i], label=f"$q_{i}(t)$")
        for axis in (plane, tests):
            axis.axhline(0.0, color="black", lw=0.8)
            for root in roots:
                axis.axvline(root, color="grey", lw=1.0, ls=":")
        for root in roots:
            values = [bernstein(test, np.array([root]))[0] for test in inside]
            tests.plot([root] * 3, values, "k.")
            text = " ".join("+" if value > 0.0 else "\N{MINUS SIGN}" for value in values)
            tests.annotate(text, (root, -1.75), ha="center", weight="bold")
        number = f"{len(roots)} root" + "s" * (len(roots) > 1)
        plane.set_title("coplanarity: " + ("all $k_i$ > 0, no root" if cubic.min() > 0.0 else number))
        tests.set_title("inside tests" + (", signs at the roots" if len(roots) else ""))
        tests.set(xlabel="t", ylim=(-1.9, 1.9))
        plane.set(ylim=(-1.5, 0.9), xticklabels=[])
        if column == 0:
            for axis in (plane, tests):
                axis.legend(loc="lower left", fontsize=8, ncols=3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_motion(scene, moved, start, end):
    """Draws the triangle at both ends of the step, and the path of the vertex."""
    for corners, alpha in ((_TRIANGLE, 0.25), (moved, 0.6)):
        scene.plot_trisurf(*corners.T, triangles=[[0, 1, 2]], color=_CURVE, alpha=alpha)
    for a, b in zip(_TRIANGLE, moved, strict=True):
        scene.plot(*np.array([a, b]).T, color=_CURVE, lw=0.8, ls=":")
    scene.plot(*np.array([start, end]).T, color=_POLYGON)
    scene.scatter(*np.array(end)[:, None], color=_POLYGON, s=25)
    scene.view_init(25.0, -60.0)
    scene.set_box_aspect((1.0, 1.0, 0.7), zoom=1.4)
    scene.set_axis_off()


def draw_step(path):
    """Draws a cut through a cloth over a sphere: at the start of a step, as VBD predicts it, as the stage leaves it."""
    radius, dt = 0.2, 1.0 / 60.0
    cells = 32
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(body=-1, radius=radius)
    size = {"dim_x": cells, "dim_y": cells, "cell_x": 0.6 / cells, "cell_y": 0.6 / cells, "mass": 1e-4}
    place = {"pos": wp.vec3(-0.3, -0.3, radius + 0.01), "rot": wp.quat_identity(), "vel": wp.vec3(0.0, 0.0, -6.0)}
    builder.add_cloth_grid(**place, **size)
    builder.color()
    model = builder.finalize(device="cpu")
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10))
    plain = newton.solvers.SolverVBD(model, iterations=10)
    cuts = []
    for each in (plain, solver):
        state, end = model.state(), model.state()
        cuts.append(state.particle_q.numpy().copy())  # VBD writes to it
        each.step(state, end, model.control(), None, dt)
        cuts.append(end.particle_q.numpy().copy())
    start, predicted, _, result = (cut.reshape(cells + 1, cells + 1, 3)[cells // 2][:, [0, 2]] for cut in cuts)
    report = solver.report
    figure, axis = plt.subplots(figsize=(10.0, 2.7), constrained_layout=True)
    axis.add_patch(plt.Circle((0.0, 0.0), radius, color="#cccccc"))
    for a, b in zip(start, predicted, strict=True):
        axis.plot(*np.array([a, b]).T, color=_POLYGON, lw=0.5, alpha=0.6)
    axis.plot(*start.T, ".-", color="grey", label="start of the step")
    axis.plot(*predicted.T, ".-", color=_POLYGON, label="predicted by VBD")
    axis.plot(*result.T, ".-", color=_CURVE, label="moved by the stage")
    text = f"{report.predicted_contacts} contacts, {report.iterations} iterations, certified: {report.certified}"
    axis.set(aspect="equal", xlim=(-0.32, 0.32), ylim=(0.07, 0.22), xlabel="x [m]", ylabel="z [m]", title=text)
    axis.legend(loc="lower center", ncols=3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    """Parses the options and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the pictures are written")
    folder = parser.parse_args().folder
    draw_signs(folder / "bernstein_signs.png")
    draw_step(folder / "one_step.png")


if __name__ == "__main__":
    main()
