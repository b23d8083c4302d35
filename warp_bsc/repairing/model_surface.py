"""The surface of a Newton model in a state, with infinite planes as squares, and what of it is inside solids."""

from collections.abc import Iterator

import newton
import numpy as np
import warp as wp

from .._arguments import check_finite
from ..detection.at_rest.body_parts import connect_cells
from ..detection.mesh import CollisionMesh, changed_mesh
from ..detection.run.launch import launch
from ..response.report.inside import Inside, InsideFinder
from ..response.state.mesh import ModelMesh, Placement, elements_of
from ..response.state.motion import plane_in
from .solids import leave_solid, leave_solid_whole, spread_exits
from .surface import Surface, weld_borders

_ESCAPES = 4
"""Times that particles are put outside: the way out of a solid may lead into another one."""
_MARGIN = 2.0
"""Half the side of the square in place of a plane, as a multiple of the size of all else."""


class ModelSurface(Surface):
    """The particles and shapes of a model in a state. Vertices are particles, then those of shapes and of planes.

    Pairs that cannot move do not cross.
    """

    def __init__(self, model: newton.Model, state: newton.State, min_distance: float):
        """Places the mesh of a model, of which pairs keep a minimum distance [m].

        Raises:
            ValueError: If a position is not finite.
        """
        self._of_model = of_model = ModelMesh(model, strands=min_distance > 0.0)
        self._inside_finder = InsideFinder(of_model)
        placed = wp.empty(of_model.vertex_count, dtype=wp.vec3, device=model.device)
        of_model.positions(state.particle_q, state.body_q, placed)
        x = placed.numpy()
        tetrahedra = elements_of(model.tet_indices, 4)
        check_finite(x, "positions of the state", np.union1d(of_model.vertices, tetrahedra))
        self._planes = _planes_in(of_model, state)
        mesh, x, self._shape, self._world = _with_planes(of_model, x, self._planes)
        self._soft_body = np.full(len(x), -1)
        self._soft_body[tetrahedra] = connect_cells(tetrahedra, model.particle_count)[tetrahedra]
        masses = of_model.inverse_masses.numpy()
        fixed = np.append(masses <= 0.0, np.ones(len(x) - len(masses), dtype=bool))
        weld = weld_borders(mesh, x, self._world, self._shape)
        super().__init__(mesh, x, fixed, min_distance, weld=weld, tetrahedra=tetrahedra)

    def crossings(self, x: np.ndarray) -> np.ndarray:
        """Returns the edges that meet faces at rounded positions in units, not all of whose vertices are fixed."""
        pairs = super().crossings(x)
        return pairs[~self.are_fixed(pairs)]

    def counted(self, crossings: np.ndarray) -> np.ndarray:
        """Returns the crossings that count as faults: planes have no faces."""
        mesh, count = self.mesh, self._of_model.vertex_count
        ends, corners = mesh.edges[crossings[:, 0]], mesh.faces[crossings[:, 1]]
        return crossings[~((ends >= count).any(axis=1) | (corners >= count).any(axis=1))]

    def inside(self, x: np.ndarray) -> np.ndarray:
        """Returns the vertices inside solids at positions in units, one for each solid that it is in, int."""
        return self.weld[self.particles_inside(x).particles]

    def particles_inside(self, x: np.ndarray) -> Inside:
        """Returns the particles inside shapes, soft bodies and solids of planes at positions in units."""
        return self._inside_finder.find(self.positions(x)[: self._of_model.vertex_count], self._planes)

    def starts(self, x: np.ndarray, movable: np.ndarray | None) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
        """Yields positions in units with particles outside of solids, and vertices that may move in each.

        What is deep inside a solid may leave it only as a whole.
        """
        for whole in (False, True) if len(self.inside(x)) else (False,):
            outside, moved = self._leave_solids(x, whole=whole)
            yield outside, moved if movable is None else movable

    def _leave_solids(self, x: np.ndarray, *, whole: bool) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions in units with particles outside that are inside solids, and which vertices may have moved.

        What is connected moves as a whole, if ``whole`` and it is free to; otherwise those around the particles follow.
        """
        movable, corners = np.zeros(len(x), dtype=bool), self.given.faces[:, 0]
        body = connect_cells(self.edges, len(x))
        is_held = np.isin(body, body[self.fixed])
        for _ in range(_ESCAPES):
            inside = self.particles_inside(x)
            vertices = self.weld[inside.particles]
            leaves = ~(is_held if whole else self.fixed)[vertices]
            if not leaves.any():
                break
            solids = np.column_stack([inside.shapes, inside.soft_bodies, self._world[inside.particles]])[leaves]
            moves, moved = np.zeros_like(x), np.zeros(len(x), dtype=bool)
            for shape, soft_body, world in np.unique(solids, axis=0):
                of_solid = np.unique(vertices[leaves][(solids == (shape, soft_body, world)).all(axis=1)])
                is_face = (self._shape[corners] == shape) & (self._world[corners] == world)
                (faces,) = np.nonzero(is_face & (self._soft_body[corners] == soft_body))
                if whole:
                    leave_solid_whole(self, x, faces, of_solid, body, moves)
                else:
                    moves[of_solid] = leave_solid(self, x, faces, of_solid)
                    moved[of_solid] = True
            if whole:
                movable |= moves.any(axis=1)
                x = self.rounded(x + moves)
            else:
                x, reach = spread_exits(self, x, moves, moved)
                movable |= reach
        return x, movable


@wp.kernel(enable_backward=False, module="unique")
def _place_planes(place: Placement, planes: wp.array[wp.vec4d]):
    """Writes the infinite planes of a model where its bodies are."""
    planes[wp.tid()] = plane_in(place, wp.tid())


def _planes_in(mesh: ModelMesh, state: newton.State) -> np.ndarray:
    """Returns the infinite planes in a state: unit normal out of the solid, and offset [m], float64, shape [n, 4]."""
    planes = wp.zeros(len(mesh.planes.shape), dtype=wp.vec4d, device=mesh.device)
    place = mesh.place(state.particle_q, state.body_q)
    launch(_place_planes, len(planes), inputs=[place], outputs=[planes], device=mesh.device)
    return planes.numpy().reshape(-1, 4)


def _with_planes(
    mesh: ModelMesh, x: np.ndarray, planes: np.ndarray
) -> tuple[CollisionMesh, np.ndarray, np.ndarray, np.ndarray]:
    """Returns a mesh with a large square in place of each infinite plane, in each of its worlds.

    Also returns its positions [m], float32, and the shape, -1 for particles, and the world of each vertex, int.
    """
    world = mesh.device_world.numpy()
    shape = np.append(np.full(mesh.model.particle_count, -1), mesh.shape_vertices.shape)
    faces, positions, shapes, worlds = [mesh.faces], [x], [shape], [world]
    used = x[mesh.vertices].astype(np.float64)
    count = len(x)
    for number, (*normal, offset) in enumerate(planes):
        middle = used.mean(axis=0)
        middle -= (middle @ normal - offset) * np.array(normal)
        size = _MARGIN * np.linalg.norm(used - middle, axis=1).max()
        across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        across *= size / np.linalg.norm(across)
        along = np.cross(normal, across)
        corners = [middle + across, middle + along, middle - across, middle - along]
        of_plane = mesh.planes.world[number]
        for w in np.unique(world) if of_plane < 0 else [of_plane]:
            positions.append(np.array(corners, dtype=np.float32))
            faces.append(count + np.array([[0, 1, 2], [0, 2, 3]]))
            shapes.append(np.full(4, mesh.planes.shape[number]))
            worlds.append(np.full(4, w))
            count += 4
    world = np.concatenate(worlds)
    of_mesh = None if mesh.world is None else world
    whole = changed_mesh(mesh, faces=np.concatenate(faces), vertex_count=count, world=of_mesh)
    return whole, np.concatenate(positions), np.concatenate(shapes), world
