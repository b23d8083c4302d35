"""Draws what ``report.draw`` shows: the contacts of a drape with shells, and cloth that is left no space.

    python examples/figures/contacts.py contacts.png

Needs the extra ``examples``, and OpenGL; without a display, run it by ``xvfb-run -a``.
"""

import argparse

import newton
import numpy as np
import warp as wp
from newton.viewer import ViewerGL
from PIL import Image

import warp_bsc as bsc

SIZE = (800, 660)  # pixels of each of both pictures
CLOTH = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 1e-1, "edge_ke": 1e-2, "edge_kd": 1e-3, "particle_radius": 0.002}
GREY = (0.45, 0.45, 0.5)


def add_cloth(builder, cells, side, at, angle):
    """Adds a square of cloth, centred."""
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle)
    corner = wp.vec3(*at) + wp.quat_rotate(turn, wp.vec3(-0.5 * side, -0.5 * side, 0.0))
    size = {"dim_x": cells, "dim_y": cells, "cell_x": side / cells, "cell_y": side / cells, "mass": 0.001}
    builder.add_cloth_grid(pos=corner, rot=turn, vel=wp.vec3(), **size, **CLOTH)


def drape():
    """Lets a cloth fall on a ball, from which it keeps 3 cm; returns the stage and the state."""
    builder = newton.ModelBuilder()
    builder.add_shape_sphere(-1, radius=0.2, color=GREY, label="ball")
    add_cloth(builder, 24, 0.7, (0.0, 0.0, 0.26), 0.3)
    builder.color()
    model = builder.finalize()
    inner = newton.solvers.SolverVBD(model, iterations=10)
    solver = bsc.SolverCCD(inner, min_distance=0.03, friction=0.6, report=["contacts"])
    states = [model.state(), model.state()]
    for _ in range(70):
        states[0].clear_forces()
        solver.step(*states, None, None, 1.0 / 120.0)
        states.reverse()
    return solver, states[0]


def press():
    """Presses a die into a cloth on a box, further than there is space; returns the stage and the state."""
    builder = newton.ModelBuilder()
    builder.add_shape_box(
        -1, hx=0.3, hy=0.3, hz=0.05, xform=wp.transform(wp.vec3(0.0, 0.0, -0.05), wp.quat_identity()), color=GREY
    )
    start = wp.transform(wp.vec3(0.0, 0.0, 0.08), wp.quat_identity())
    body = builder.add_body(xform=start, is_kinematic=True)
    builder.add_shape_box(body, hx=0.06, hy=0.05, hz=0.04, color=GREY, label="die", opacity=0.3)
    add_cloth(builder, 24, 0.5, (0.0, 0.0, 0.005), 0.3)
    builder.color()
    model = builder.finalize()
    solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=10), report=["contacts"])
    states = [model.state(), model.state()]
    for height in np.append(np.full(15, 0.08), np.linspace(0.08, 0.03, 25)):
        pose = np.array([[0.0, 0.0, height, 0.0, 0.0, 0.0, 1.0]])
        states[0].body_q.assign(pose)
        states[0].clear_forces()
        solver.step(*states, None, None, 1.0 / 120.0)
        states.reverse()
        if not solver.report.certified:
            break
    return solver, states[0]


def photograph(solver, state, camera, impulse_scale=None):
    """Returns a picture of a state with what the report draws, uint8, shape [height, width, 3]."""
    print(solver.report)
    print(solver.report.forces.table())
    viewer = ViewerGL(*SIZE, headless=True)
    viewer.set_model(solver.model)
    position, pitch, yaw = camera
    viewer.set_camera(pos=wp.vec3(*position), pitch=pitch, yaw=yaw)
    for _ in range(2):  # a camera moves in the next frame
        viewer.begin_frame(0.0)
        viewer.log_state(state)
        solver.report.draw(viewer, impulse_scale=impulse_scale)
        viewer.end_frame()
    picture = viewer.get_frame().numpy()
    viewer.close()
    return picture


def main():
    """Writes the picture of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", help="file to write, .png")
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    pictures = [
        photograph(*drape(), ((0.62, -0.62, 0.4), -26.0, 135.0)),
        photograph(*press(), ((0.22, -0.22, 0.2), -33.0, 135.0), impulse_scale=300.0),
    ]
    Image.fromarray(np.concatenate(pictures, axis=1)).save(options.picture, optimize=True)


if __name__ == "__main__":
    main()
