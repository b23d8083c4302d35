"""Scales of a model: its edges, the unit of its lengths, and measures of what is in each of its worlds."""

import numpy as np

from ...response.state.mesh import ModelMesh, grouped_by_world, host_array

_GRAVITY, _EDGE, _OTHER_UNIT = 9.81, 0.05, 10.0
"""Usual gravity [m/s^2] and edges [m]; what is that many times as much in a model tells that its unit is no metre."""


def edges_of_particles(mesh: ModelMesh) -> tuple[np.ndarray, np.ndarray]:
    """Returns the edges between particles, shape [n, 2], and their lengths in the model, shape [n]."""
    edges = mesh.edges[(mesh.edges < mesh.model.particle_count).all(axis=1)]
    ends = host_array(mesh.model.particle_q)[edges] if len(edges) else np.zeros((0, 2, 3))
    return edges, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def metre_of(mesh: ModelMesh) -> float:
    """Returns how many units of length of a model are a metre: as its gravity tells, or its edges if it has none."""
    gravity = np.linalg.norm(host_array(mesh.model.gravity), axis=1).max()
    lengths = edges_of_particles(mesh)[1]
    metre = gravity / _GRAVITY if gravity > 0.0 or not len(lengths) else np.median(lengths) / _EDGE
    return float(metre) if metre > _OTHER_UNIT else 1.0


def in_each_world(function, values: np.ndarray, world: np.ndarray, worlds: int, default: float) -> np.ndarray:
    """Returns a function of the values of each world, which is as if the world were alone; the default of none."""
    order, first = grouped_by_world(world, worlds)
    parts = np.split(values[order], first[1:-1])
    return np.array([function(part) if len(part) else default for part in parts], dtype=float)
