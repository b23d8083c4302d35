"""A scene for rollouts that other libraries differentiate: a patch of cloth that falls on the ground."""

import newton
import numpy as np
import warp as wp

import warp_bsc as bsc

DT = 1.0 / 60.0
STEPS = 12


def bouncing_patch(device, *, requires_grad=True):
    """A solver with contact inside; the patch hits the ground in the second step."""
    builder = newton.ModelBuilder()
    cloth = {"dim_x": 2, "dim_y": 2, "cell_x": 0.04, "cell_y": 0.04, "mass": 0.001, "tri_ke": 50.0, "tri_ka": 50.0}
    cloth |= {"tri_kd": 0.02, "edge_ke": 0.01, "edge_kd": 0.001, "vel": wp.vec3(0.6, 0.1, -1.2)}
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.4, 0.0)), 0.1)
    builder.add_cloth_grid(pos=wp.vec3(0.0, 0.0, 0.02), rot=rotation, **cloth)
    builder.add_ground_plane()
    model = builder.finalize(device=device, requires_grad=requires_grad)
    return bsc.SolverImplicit(model, friction=0.5)


def arguments(model, seed=0):
    """A state, forces that two rows hold and velocities that are added before each, as float64 by name."""
    rng = np.random.default_rng(seed)
    n = model.particle_count
    state = {name: getattr(model, name).numpy().astype(float) for name in ("particle_q", "particle_qd")}
    controls = {
        "particle_f": 2e-3 * rng.normal(size=(2, n, 3)),
        "particle_qd": 0.1 * rng.normal(size=(2, n, 3)),
    }
    return state, controls


def expected_states(solver, state, controls):
    """The positions and velocities after each step, by a plain loop."""
    model = solver.model
    start, states = model.state(), []
    for name, values in state.items():
        getattr(start, name).assign(values.astype(np.float32))
    for step in range(STEPS):
        row, begins = divmod(step, STEPS // 2)
        start.clear_forces()
        start.particle_f.assign(controls["particle_f"][row].astype(np.float32))
        if begins == 0:
            start.particle_qd.assign(start.particle_qd.numpy() + controls["particle_qd"][row].astype(np.float32))
        end = model.state()
        solver.step(start, end, None, None, DT)
        states.append((end.particle_q.numpy().copy(), end.particle_qd.numpy().copy()))
        start = end
    return [np.stack(arrays) for arrays in zip(*states, strict=True)]
