"""What simulators of ``warp-bsc bench penetration`` return, and what they read of a scene: meshes and stiffness."""

from dataclasses import dataclass
from itertools import combinations

import newton
import numpy as np

from ...detection.at_rest.body_parts import connect_cells
from ...response.state.mesh import elements_of, host_array
from ..scenes.contact import Motion


class NotInstalled(Exception):
    """A simulator is not installed or cannot run on this machine; the message says what it needs."""


@dataclass(frozen=True)
class Trajectory:
    """What a simulator made of a scene."""

    # positions of the particles at the start and after each step [m], each of shape [particle_count, 3]
    states: list[np.ndarray]
    milliseconds: list[float]  # time of each step [ms]
    uncertified_steps: int | None = None  # steps that the stage did not certify; None without a stage


@dataclass(frozen=True)
class Body:
    """A connected cloth or soft body of a model.

    Attributes:
        particles: Its particles, ascending, int, shape [n].
        elements: Its triangles, or tetrahedra of a soft body, as rows in ``particles``, int, shape [m, 3] or [m, 4].
        faces: Its triangles, or the surface of a soft body, as rows in ``particles``, int, shape [k, 3].
        mu, lam: Lamé parameters, of cloth those of the membrane [N/m], of a soft body [Pa].
        area: Area of cloth at rest [m^2], 0 for a soft body.
        volume: Volume of a soft body at rest [m^3], 0 for cloth.
    """

    particles: np.ndarray
    elements: np.ndarray
    faces: np.ndarray
    mu: float
    lam: float
    area: float
    volume: float

    @property
    def is_soft(self) -> bool:
        """Whether this is a soft body."""
        return self.elements.shape[1] == 4

    @property
    def young(self) -> float:
        """Young's modulus, of cloth times its thickness [N/m], of a soft body [Pa]."""
        if self.is_soft:
            return self.mu * (3.0 * self.lam + 2.0 * self.mu) / (self.lam + self.mu)
        return 4.0 * self.mu * (self.lam + self.mu) / (self.lam + 2.0 * self.mu)  # plane stress

    @property
    def poisson(self) -> float:
        """Poisson's ratio."""
        return self.lam / (self.lam + self.mu) / 2.0 if self.is_soft else self.lam / (self.lam + 2.0 * self.mu)


def find_bodies(model: newton.Model) -> list[Body]:
    """Returns the connected bodies of a model, each of one material, in the order of their first particles."""
    triangles, tets = elements_of(model.tri_indices, 3), elements_of(model.tet_indices, 4)
    pairs = np.concatenate(
        [elements[:, [i, j]] for elements in (triangles, tets) for i, j in combinations(range(elements.shape[1]), 2)]
    )
    label = connect_cells(pairs, model.particle_count)
    bodies = []
    for first in np.unique(label[pairs]):
        particles = np.flatnonzero(label == first)
        of_triangles, of_tets = label[triangles[:, 0]] == first, label[tets[:, 0]] == first
        faces = np.searchsorted(particles, triangles[of_triangles])
        if of_tets.any():
            mu, lam = host_array(model.tet_materials)[of_tets, :2].mean(axis=0)
            volume = float((1.0 / np.linalg.det(host_array(model.tet_poses)[of_tets].astype(float)) / 6.0).sum())
            elements, area = np.searchsorted(particles, tets[of_tets]), 0.0
        else:
            mu, lam = host_array(model.tri_materials)[of_triangles, :2].mean(axis=0)
            elements, area, volume = faces, float(host_array(model.tri_areas)[of_triangles].sum()), 0.0
        bodies.append(Body(particles, elements, faces, float(mu), float(lam), area, volume))
    return bodies


def held_positions(motion: Motion | None, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the particles that a program moves, and where they are at a time [m]; none without a motion."""
    if motion is None or motion.positions is None:
        return np.zeros(0, dtype=int), np.zeros((0, 3))
    return np.array(motion.held, dtype=int), np.asarray(motion.positions(t), dtype=np.float64)
