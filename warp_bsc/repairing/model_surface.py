"""The surface of a Newton model in a state, with infinite planes as squares, and what of it is inside solids."""

import newton
import numpy as np
import warp as wp

from .._arguments import check_finite
from ..detection.at_rest.body_parts import connect_cells
from ..detection.mesh import CollisionMesh
from ..detection.run.launch import launch
from ..response.report.inside import Inside, InsideFinder
from ..response.state.mesh import ModelMesh, Placement, elements_of
from ..response.state.motion import plane_in
from .contours import connected_components
from .solids import leave_solid, leave_solid_whole, spread_exits
from .surface import Surface, differ, weld_borders, welded

_ESCAPES = 4
"""Times that particles are put outside: the way out of a solid may lead into another one."""
_MARGIN = 2.0
"""Half the side of the square in place of a plane, as a multiple of the size of all else."""


class ModelSurface:
    """The particles and shapes of a model in a state. Vertices are particles, then those of shapes and of planes.

    Attributes:
        surface: The surface, without doubled vertices. Pairs that cannot move do not count as crossing.
        mesh: The mesh before vertices were welded.
        weld: The vertex that each vertex is welded to, int, shape [n].
        sheet: Sheet of each vertex, -1 for none, int, shape [n].
        tetrahedra: Vertices of the tetrahedra, int, shape [m, 4].
    """

    def __init__(self, model: newton.Model, state: newton.State, sheet: np.ndarray, min_distance: float):
        """Places the mesh of a model.

        Args:
            model: The model.
            state: The state.
            sheet: Sheet of each particle, -1 for none, int, shape [particle_count].
            min_distance: Distance that pairs keep [m].

        Raises:
            ValueError: If a position is not finite.
        """
        self._of_model = of_model = ModelMesh(model, strands=min_distance > 0.0)
        self._finder = InsideFinder(of_model)
        placed = wp.empty(of_model.vertex_count, dtype=wp.vec3, device=model.device)
        of_model.positions(state.particle_q, state.body_q, placed)
        x = placed.numpy()
        self.tetrahedra = elements_of(model.tet_indices, 4)
        check_finite(x, "positions of the state", np.union1d(of_model.vertices, self.tetrahedra))
        self._planes = _planes_in(of_model, state)
        self.mesh, self._x, self._shape, self._world = _with_planes(of_model, x, self._planes)
        more = len(self._x) - model.particle_count
        self.sheet = np.append(sheet, np.full(more, -1))
        self.weld = weld_borders(self.mesh, self._x, self.sheet, self._world, self._shape)
        self._soft_body = np.full(len(self._x), -1)
        self._soft_body[self.tetrahedra] = connect_cells(self.tetrahedra, model.particle_count)[self.tetrahedra]
        movable = np.append(of_model.inverse_masses.numpy() > 0.0, np.zeros(len(self._x) - len(x), dtype=bool))
        fixed = np.bincount(self.weld, ~movable, len(self._x)) > 0
        self.surface = Surface(
            welded(self.mesh, self.weld),
            self._x,
            fixed,
            min_distance,
            tetrahedra=self.weld[self.tetrahedra],
            counts_fixed=False,
        )

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Returns the positions of all vertices [m] at positions in units; what has not moved has its bits, float32."""
        moved = differ(x, self.surface.home)[self.weld]
        return np.where(moved[:, None], self.surface.positions(x)[self.weld], self._x)

    def crossings(self, x: np.ndarray) -> np.ndarray:
        """Returns the edges that meet faces at positions in units, (edge, face); planes have no faces."""
        mesh, count = self.surface.mesh, self._of_model.vertex_count
        pairs = self.surface.crossings(x)
        of_planes = (mesh.edges[pairs[:, 0]] >= count).any(axis=1) | (mesh.faces[pairs[:, 1]] >= count).any(axis=1)
        return pairs[~of_planes]

    def inside(self, x: np.ndarray) -> Inside:
        """Returns the particles inside shapes, soft bodies and solids of planes at positions in units."""
        return self._finder.find(self.positions(x)[: self._of_model.vertex_count], self._planes)

    def leave_solids(self, x: np.ndarray, *, whole: bool) -> tuple[np.ndarray, np.ndarray]:
        """Puts particles that are inside solids outside.

        Args:
            x: Positions, in units, shape [n, 3].
            whole: Whether what is connected moves as a whole, if it is free to; otherwise those around the particles
                follow.

        Returns:
            Positions in units, and which vertices may have moved, bool, shape [n].
        """
        surface, movable = self.surface, np.zeros(len(x), dtype=bool)
        corners = self.mesh.faces[:, 0]
        body = connected_components(len(x), surface.edges)
        is_held = np.isin(body, body[surface.fixed])
        for _ in range(_ESCAPES):
            inside = self.inside(x)
            vertices = self.weld[inside.particles]
            leaves = ~(is_held if whole else surface.fixed)[vertices]
            if not leaves.any():
                break
            solids = np.column_stack([inside.shapes, inside.soft_bodies, self._world[inside.particles]])[leaves]
            moves, moved = np.zeros_like(x), np.zeros(len(x), dtype=bool)
            for shape, soft_body, world in np.unique(solids, axis=0):
                of_solid = np.unique(vertices[leaves][(solids == (shape, soft_body, world)).all(axis=1)])
                is_face = (self._shape[corners] == shape) & (self._world[corners] == world)
                (faces,) = np.nonzero(is_face & (self._soft_body[corners] == soft_body))
                if whole:
                    of_bodies = leave_solid_whole(surface, x, faces, of_solid, body)
                    moves = np.where(differ(of_bodies, np.zeros_like(x))[:, None], of_bodies, moves)
                else:
                    moves[of_solid] = leave_solid(surface, x, faces, of_solid)
                    moved[of_solid] = True
            if whole:
                movable |= differ(moves, np.zeros_like(x))
                x = surface.rounded(x + moves)
            else:
                x, reach = spread_exits(surface, x, moves, moved)
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

    Returns:
        The mesh, its positions [m], float32, and the shape, -1 for particles, and the world of each vertex, int.
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
    whole = CollisionMesh(
        np.concatenate(faces),
        count,
        edges=mesh.edges[mesh.free_edges],
        points=mesh.points,
        world=None if mesh.world is None else world,
        device=mesh.device,
    )
    return whole, np.concatenate(positions), np.concatenate(shapes), world
