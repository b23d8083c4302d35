"""Draws a loss over the velocity of a throw, and its derivative, with a contact layer and without it.

    python examples/figures/continuity.py continuity.png

A patch of cloth is thrown on a box that is fixed; the loss is the squared distance of its last centre from a mark.
Needs matplotlib (``pip install matplotlib``).
"""

import argparse
import itertools
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import newton
import numpy as np
import warp as wp
from rich.progress import track

import warp_bsc as bsc

sys.path.append(str(Path(__file__).parents[1]))  # for the examples
from diffsim import add_cloth, add_to_centre, build_worlds

_DT, _STEPS = 1.0 / 600.0, 40
_LAYER = 0.012  # thickness [m]
_MARK = wp.vec3(0.03, 0.05, 0.06)  # [m]
_THROW = np.array([0.7, 0.3, -2.0])  # [m/s]
_VELOCITIES = np.linspace(-0.05, 0.05, 201)  # added to its last component, each in a world of its own


@wp.kernel
def _throw(throws: wp.array[wp.vec3], patch: int, particle_qd: wp.array[wp.vec3]):
    particle = wp.tid()
    particle_qd[particle] = throws[particle / patch]


@wp.kernel
def _judge(centres: wp.array[wp.vec3], losses: wp.array[float]):
    world = wp.tid()
    losses[world] = wp.length_sq(centres[world] - _MARK)


def losses_and_gradients(layer):
    """Returns the loss of each throw [m^2] and its derivative by the last component of the velocity [m s]."""
    world = newton.ModelBuilder()
    add_cloth(world, 5, 0.03, wp.vec3(0.02, 0.015, 0.115), wp.vec3(0.62, -0.78, 0.13), 0.35, tri_kd=1e-2)
    tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.7, 0.2)), 0.3)
    config = newton.ModelBuilder.ShapeConfig(mu=0.3, density=0.0)
    world.add_shape_box(-1, xform=wp.transform(wp.vec3(), tilt), hx=0.05, hy=0.06, hz=0.05, cfg=config)
    model = build_worlds(world, len(_VELOCITIES))
    inner = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    options = {"friction": 0.3, "restitution": 0.2}
    if layer is not None:
        inner = bsc.ContactLayer(inner, thickness=layer, **options)
    solver = bsc.SolverCCD(inner, contact_layer=False, **options)
    states = [model.state() for _ in range(_STEPS + 1)]
    throws = np.tile(_THROW, (len(_VELOCITIES), 1))
    throws[:, 2] += _VELOCITIES
    velocities = wp.array(throws, dtype=wp.vec3, requires_grad=True)
    centres = wp.zeros(len(throws), dtype=wp.vec3, requires_grad=True)
    losses = wp.zeros(len(throws), dtype=float, requires_grad=True)
    tape = wp.Tape()
    with tape:
        inputs = [velocities, world.particle_count]
        wp.launch(_throw, model.particle_count, inputs=inputs, outputs=[states[0].particle_qd])
        pairs = list(itertools.pairwise(states))
        for start, end in track(pairs, "without" if layer is None else "with a contact layer"):
            start.clear_forces()
            solver.step(start, end, None, None, _DT)
        shares = wp.full(model.particle_count, 1.0 / world.particle_count, dtype=float)
        inputs = [states[-1].particle_q, shares, model.particle_world]
        wp.launch(add_to_centre, model.particle_count, inputs=inputs, outputs=[centres])
        wp.launch(_judge, len(throws), inputs=[centres], outputs=[losses])
    tape.backward(grads={losses: wp.full(len(throws), 1.0, dtype=float)})
    return losses.numpy().astype(float), velocities.grad.numpy()[:, 2]


def main():
    """Reads the command line, and draws the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", help="File to write, .png or another format of matplotlib.")
    picture = parser.parse_args().picture
    figure, axes = plt.subplots(2, 2, figsize=(10.0, 6.0), dpi=110, sharex=True)
    speeds = _THROW[2] + _VELOCITIES
    for column, layer in enumerate((None, _LAYER)):
        losses, gradients = losses_and_gradients(layer)
        differences = (losses[2:] - losses[:-2]) / (speeds[2:] - speeds[:-2])
        axes[0, column].plot(speeds, 1e4 * losses, color="#2f6fb3")
        axes[0, column].set_title("contacts act where they hit" if layer is None else "contact layer of 12 mm")
        axes[1, column].plot(speeds[1:-1], differences, color="#2f6fb3", label="central differences of 5e-4 m/s")
        axes[1, column].plot(speeds, gradients, ".", color="#e07a2f", markersize=4, label="tape")
        axes[1, column].set(xlabel="downward velocity of the throw [m/s]")
        axes[1, column].legend(fontsize=8, frameon=False)
    axes[0, 0].set_ylabel("loss [cm^2]")
    axes[1, 0].set_ylabel("derivative of the loss [m s]")
    figure.tight_layout()
    figure.savefig(picture)


if __name__ == "__main__":
    main()
