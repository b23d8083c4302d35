"""Draws what a stage found and did in its last step, in any viewer of Newton."""

import newton
import numpy as np
import warp as wp
from newton.viewer import ViewerBase, ViewerViser

from ..state.mesh import ModelMesh

_NORMAL, _IMPULSE = (0.0, 0.8, 0.2), (1.0, 0.0, 1.0)
"""Colours as Newton draws normals and forces of its own contacts."""
_SHELL = (0.3, 0.7, 1.0)
VERTEX_COLOURS = {"truncated": (1.0, 0.6, 0.0), "frozen": (0.1, 0.3, 1.0), "uncertified": (1.0, 0.0, 0.0)}
"""Colours of vertices by what became of them; the later hides the earlier where a vertex is several."""
_NORMAL_LENGTH, _IMPULSE_LENGTH, _POINT_RADIUS = 0.5, 2.0, 0.12
"""Lengths in median edges: of normals, of a large impulse, and radius of the points of vertices."""
_LARGE = 0.9
"""Share of the impulses of a step that a large one is not less than: single ones are far larger than all others."""
_LINE_RADIUS, _PIXELS = 0.02, 0.02
"""Half the width of lines: in median edges; and for ViewerViser, which draws a hundred pixels for each unit of it."""
_OPACITY = 0.25


class Drawing:
    """Draws steps of a stage in viewers.

    Attributes:
        edge: Median length of the edges between particles of the model [m], by which sizes are chosen.
    """

    def __init__(self, mesh: ModelMesh):
        """Measures the model."""
        lengths = mesh.particle_edge_lengths()
        self.edge = float(np.median(lengths)) if len(lengths) else 0.05
        self._large = 0.0  # impulse, the largest of all steps so far [N s]
        radius = np.zeros(mesh.vertex_count) if mesh.distances is None else mesh.distances.radius.numpy()
        has_shell = radius > 0.0
        self._radius, self._faces = radius, mesh.faces[has_shell[mesh.faces].all(axis=1)]
        self._lone = has_shell.copy()  # vertices whose shell is a sphere, as they are on no face
        self._lone[mesh.faces] = False
        self._lone[mesh.tets] = False

    def draw(
        self,
        viewer: ViewerBase,
        x: np.ndarray,
        contacts: dict[str, np.ndarray] | None,
        vertices: dict[str, np.ndarray],
        impulse_scale: float | None,
    ) -> None:
        """Draws a step that ends at positions ``x`` of all vertices of the mesh [m], in a frame of the viewer.

        Contacts are as of :meth:`.forces.contact_report.Contacts.numpy`, None to draw none; vertices by what they are:
        truncated, frozen or uncertified. The scale of impulses is the length of an arrow by its impulse [m/(N s)]; None
        for two median edges for a large impulse.
        """
        self._draw_contacts(viewer, contacts, impulse_scale)
        for name, colour in VERTEX_COLOURS.items():
            points = x[vertices[name] & np.isfinite(x).all(axis=1)]
            # each is a little larger than the one before, which it hides
            radius = self.edge * _POINT_RADIUS * {"truncated": 1.0, "frozen": 1.1, "uncertified": 1.2}[name]
            _log_points(viewer, f"/ccd/{name}", points, radius, colour)
        if self._radius.any():
            self._draw_shells(viewer, x)

    def _draw_contacts(self, viewer, contacts, impulse_scale):
        if contacts is None or not len(contacts["point"]):
            for name in ("/ccd/normals", "/ccd/impulses"):
                viewer.log_arrows(name, None, None, None, hidden=True)
            return
        points, normals = contacts["point"], contacts["normal"]
        impulses = contacts["normal_impulse"][:, None] * normals + contacts["tangential_impulse"]
        self._large = max(self._large, float(np.quantile(np.linalg.norm(impulses, axis=1), _LARGE)))
        if impulse_scale is None:
            impulse_scale = _IMPULSE_LENGTH * self.edge / self._large
        width = _PIXELS if isinstance(viewer, ViewerViser) else _LINE_RADIUS * self.edge
        for name, vectors, colour, log in (
            ("/ccd/normals", _NORMAL_LENGTH * self.edge * normals, _NORMAL, viewer.log_lines),
            ("/ccd/impulses", impulse_scale * impulses, _IMPULSE, viewer.log_arrows),
        ):
            log(name, _on_device(viewer, points), _on_device(viewer, points + vectors), colour, width=width)

    def _draw_shells(self, viewer, x):
        """Draws the surfaces at the radius of each vertex from the faces, and spheres around vertices without faces."""
        if len(self._faces):
            a, b, c = (x[self._faces[:, i]] for i in range(3))
            normals = np.zeros_like(x)
            of_faces = np.cross(b - a, c - a)
            for i in range(3):
                np.add.at(normals, self._faces[:, i], of_faces)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            offsets = self._radius[:, None] * normals / np.where(lengths > 0.0, lengths, 1.0)
            faces = np.concatenate([self._faces, len(x) + self._faces[:, ::-1]])
            indices = wp.array(faces.ravel(), dtype=int, device=viewer.device)
            points = _on_device(viewer, np.concatenate([x + offsets, x - offsets]))
            options = {"color": _SHELL, "opacity": _OPACITY, "backface_culling": False}
            viewer.log_mesh("/ccd/shells", points, indices, **options)
        if self._lone.any():
            viewer.log_geo("/ccd/sphere", int(newton.GeoType.SPHERE), (1.0,), 0.0, True, hidden=True)
            places = np.zeros((np.count_nonzero(self._lone), 7))
            places[:, :3], places[:, 6] = x[self._lone], 1.0
            arrays = [wp.array(places, dtype=wp.transform, device=viewer.device)]
            arrays.append(_on_device(viewer, np.repeat(self._radius[self._lone, None], 3, axis=1)))
            arrays.append(_on_device(viewer, np.tile(_SHELL, (len(places), 1))))
            arrays.append(wp.full(len(places), wp.vec4(0.5, 0.0, 0.0, 0.0), dtype=wp.vec4, device=viewer.device))
            opacities = wp.full(len(places), _OPACITY, dtype=float, device=viewer.device)
            viewer.log_instances("/ccd/shells_of_points", "/ccd/sphere", *arrays, opacities=opacities)


def _log_points(viewer, name, points, radius, colour):
    """Draws points, or hides those of former steps if there are none."""
    if len(points):
        colours = wp.full(len(points), wp.vec3(*colour), dtype=wp.vec3, device=viewer.device)
        radii = wp.full(len(points), radius, dtype=float, device=viewer.device)
        viewer.log_points(name, _on_device(viewer, points), radii, colours)
    else:
        viewer.log_points(name, None, hidden=True)


def _on_device(viewer, vectors):
    """Returns vectors as an array on the viewer's device."""
    return wp.array(vectors, dtype=wp.vec3, device=viewer.device)
