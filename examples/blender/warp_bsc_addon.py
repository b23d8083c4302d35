"""A Blender add-on that checks meshes, goes from finding to finding, and moves vertices until nothing crosses.

Blender's Python must have warp-bsc: docs/blender.md says how.
"""

from types import SimpleNamespace
from typing import ClassVar

import bmesh
import bpy
import numpy as np

bl_info = {
    "name": "warp-bsc",
    "description": "Exact check of meshes for intersections, and their repair",
    "author": "the authors of warp-bsc",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "3D Viewport > Sidebar > warp-bsc",
    "category": "Mesh",
    "doc_url": "https://warp-bsc.github.io/warp-bsc/blender.html",
}

_last = SimpleNamespace(
    findings=[],  # of the last check: a kind, and the vertices of each object by its name
    counts={},  # numbers of vertices of the objects then
    shown=-1,  # number of the finding that was shown last
    said=("", ""),  # kind and text of the last message
)

_PAIRS = {"crossings": "edge through a face", "touching": "edge that only touches a face"}
_FACES = {"degenerate_faces": "face without area", "doubled_faces": "doubled face"}
_EDGES = {
    "nonmanifold_edges": "edge of more than two faces",
    "misoriented_edges": "edge of two faces with different orientations",
}


def _library():
    """Returns warp_bsc; raises a ValueError if Blender's Python does not have it."""
    try:
        import warp_bsc  # noqa: PLC0415 (Blender starts without it)
    except ImportError as error:
        raise ValueError(f"warp-bsc is missing in Blender's Python, see {bl_info['doc_url']}: {error}") from None
    return warp_bsc


class Surface:
    """The meshes of objects as one, as they are modelled: without modifiers, and of shape keys the active one.

    Attributes:
        objects: The objects.
        x: Positions of all vertices: those of the meshes, float32, if all objects are in the same place, else in the
            world, float64; shape [n, 3].
        faces: Vertices of the triangles that Blender divides faces into, shape [m, 3].
        owner: Number of the object of each vertex, shape [n].
        selected: Whether each vertex is selected, shape [n].
        notes: What is not checked, in words.
    """

    def __init__(self, objects):
        """Reads the meshes; raises a ValueError if they have no faces."""
        self.objects, self.notes = list(objects), []
        xs, faces, selected = [], [], []
        for obj in self.objects:
            if obj.mode == "EDIT":
                obj.update_from_editmode()
            mesh, key = obj.data, obj.active_shape_key
            mesh.calc_loop_triangles()
            xs.append(_get(key.data if key else mesh.vertices, "co", np.float32, 3))
            faces.append(_get(mesh.loop_triangles, "vertices", np.int32, 3) + sum(map(len, xs[:-1])))
            selected.append(_get(mesh.vertices, "select", bool, 1)[:, 0])
            if obj.modifiers:
                self.notes.append(f"modifiers of {obj.name} are not applied")
            if key:
                self.notes.append(f"of {obj.name}, shape key {key.name} alone")
        self._starts = np.cumsum([0, *map(len, xs)])
        self.faces, self.selected = np.concatenate(faces), np.concatenate(selected)
        self.owner = np.repeat(np.arange(len(xs)), [len(x) for x in xs])
        if not len(self.faces):
            raise ValueError("the selected meshes have no faces")
        self._places = [np.array(obj.matrix_world, float) for obj in self.objects]
        # one transform of all changes nothing of what crosses, and single precision stays as it is
        self.is_local = all(np.array_equal(place, self._places[0]) for place in self._places)
        self.x = self.placed(xs)

    def placed(self, xs):
        """Returns positions of the objects' meshes, in their own space, as those of the surface."""
        if self.is_local:
            return np.concatenate(xs)
        return np.concatenate([x @ place[:3, :3].T + place[:3, 3] for x, place in zip(xs, self._places, strict=True)])

    def own(self, x):
        """Returns positions of the surface as those of each object's mesh, float32."""
        parts = [x[self.owner == number] for number in range(len(self.objects))]
        if self.is_local:
            return parts
        return [
            np.linalg.solve(place[:3, :3], (part - place[:3, 3]).T).T.astype(np.float32)
            for part, place in zip(parts, self._places, strict=True)
        ]

    def vertices(self, numbers):
        """Returns vertices of the surface as those of the objects, by name."""
        found = {}
        for vertex in np.unique(numbers).tolist():
            owner = int(self.owner[vertex])
            found.setdefault(self.objects[owner].name, []).append(vertex - int(self._starts[owner]))
        return found


def _get(elements, name, dtype, width):
    values = np.empty(len(elements) * width, dtype)
    elements.foreach_get(name, values)
    return values.reshape(-1, width)


def _chosen(context):
    """Returns the mesh objects that are selected or in edit mode; raises a ValueError if there are none."""
    objects = {obj.name: obj for obj in [*context.selected_objects, *context.objects_in_mode] if obj.type == "MESH"}
    if not objects:
        raise ValueError("select a mesh")
    return list(objects.values())


def _write(obj, x, moved):
    """Gives vertices of an object's mesh other positions, also in edit mode; of shape keys, the active one."""
    mesh, key = obj.data, obj.active_shape_key
    if obj.mode == "EDIT":
        edited = bmesh.from_edit_mesh(mesh)
        edited.verts.ensure_lookup_table()
        for vertex in moved.tolist():
            edited.verts[vertex].co = x[vertex]
        edited.normal_update()
        bmesh.update_edit_mesh(mesh, loop_triangles=True, destructive=False)
        return
    targets = [mesh.vertices]
    if key:
        is_base = key == mesh.shape_keys.reference_key
        targets = [key.data, *([mesh.vertices] if is_base else [])]
        before = _get(key.data, "co", np.float32, 3)
        for other in mesh.shape_keys.key_blocks:
            if is_base and other != key and other.relative_key == key:  # keeps what it adds to the base
                values = _get(other.data, "co", np.float32, 3)
                values[moved] += x[moved] - before[moved]
                other.data.foreach_set("co", values.ravel())
    for target in targets:
        values = _get(target, "co", np.float32, 3)
        values[moved] = x[moved]
        target.foreach_set("co", values.ravel())
    mesh.update()


class _Operator(bpy.types.Operator):
    """An operator whose ValueErrors are shown as errors."""

    def execute(self, context):
        try:
            return self._run(context)
        except (ValueError, np.linalg.LinAlgError) as error:
            self.say("ERROR", str(error))
            return {"CANCELLED"}

    def say(self, kind, text):
        """Shows a message in the status bar, and in the panel until the next one."""
        _last.said = kind, text
        self.report({kind}, text)


class WARP_BSC_OT_check(_Operator):
    """Finds what crosses, touches or lies inside in the selected meshes, and faces and edges that are not sound."""

    bl_idname, bl_label = "warp_bsc.check", "Check"

    def _run(self, context):
        surface = Surface(_chosen(context))
        found = _library().check(surface.faces, surface.x)
        kinds = {}
        _last.shown, _last.findings = -1, []
        _last.counts = dict((obj.name, len(obj.data.vertices)) for obj in surface.objects)

        def add(kind, vertices):
            kinds[kind] = kinds.get(kind, 0) + 1
            _last.findings.append((kind, surface.vertices(vertices)))

        for name, kind in _PAIRS.items():
            for edge, face in getattr(found, name):
                add(kind, [*found.edges[edge], *surface.faces[face]])
        for inner, _ in found.inside:
            add("part inside another one", surface.faces[found.component == inner])
        for name, kind in _FACES.items():
            for face in getattr(found, name):
                add(kind, surface.faces[face])
        for name, kind in _EDGES.items():
            for edge in getattr(found, name):
                add(kind, found.edges[edge])
        said = [f"{kind}: {count:,}" for kind, count in kinds.items()] or ["nothing crosses, all faces are sound"]
        self.say("WARNING" if kinds else "INFO", "; ".join([*said, *surface.notes]))
        return {"FINISHED"}


class WARP_BSC_OT_next(_Operator):
    """Selects the vertices of the next finding in edit mode, and shows them."""

    bl_idname, bl_label = "warp_bsc.next", "Next Finding"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def _run(self, context):
        if not _last.findings:
            raise ValueError("there is no finding; check first")
        number = (_last.shown + 1) % len(_last.findings)
        kind, places = _last.findings[number]
        if context.view_layer.objects.active and context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        objects = [context.view_layer.objects.get(name) for name in places]
        for obj, name in zip(objects, places, strict=True):
            if obj is None or obj.type != "MESH" or len(obj.data.vertices) != _last.counts[name] or obj.hide_get():
                raise ValueError(f"{name} has changed since the check, or is hidden; check again")
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj, vertices in zip(objects, places.values(), strict=True):
            obj.select_set(True)
            mesh = obj.data
            for elements in (mesh.vertices, mesh.edges, mesh.polygons):
                elements.foreach_set("select", np.zeros(len(elements), bool))
            mesh.vertices.foreach_set("select", np.isin(np.arange(len(mesh.vertices)), vertices))
        context.view_layer.objects.active = objects[0]
        context.tool_settings.mesh_select_mode = (True, False, False)
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.reveal(select=False)
        for area in [] if bpy.app.background else context.screen.areas:
            if area.type == "VIEW_3D":
                region = next(region for region in area.regions if region.type == "WINDOW")
                with context.temp_override(area=area, region=region):
                    bpy.ops.view3d.view_selected()
        _last.shown = number
        self.say("INFO", f"{number + 1} of {len(_last.findings):,}: {kind}, of {' and '.join(places)}")
        return {"FINISHED"}


class WARP_BSC_OT_repair(_Operator):
    """Moves vertices until no edge meets a face: selected ones in edit mode, else all of the active object."""

    bl_idname, bl_label = "warp_bsc.repair", "Repair"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    time_limit: bpy.props.FloatProperty(
        name="Time Limit", description="Time after which the search ends [s]", default=60.0, min=1.0
    )

    def _run(self, context):
        if context.mode not in ("OBJECT", "EDIT_MESH"):
            raise ValueError("repair works in object mode and in edit mode")
        bsc = _library()
        surface = Surface(_chosen(context))
        if context.mode == "EDIT_MESH":
            in_mode = [obj.mode == "EDIT" for obj in surface.objects]
            movable = surface.selected & np.array(in_mode)[surface.owner]
        else:
            movable = np.array([obj == context.view_layer.objects.active for obj in surface.objects])[surface.owner]
        if not movable.any():
            raise ValueError("select the vertices that may move, or make a mesh active")
        moving = np.unique(surface.owner[movable]).tolist()
        for number in moving:
            obj = surface.objects[number]
            if not obj.data.is_editable:
                raise ValueError(f"{obj.name} is linked from another file, and cannot be edited")
            if sum(other.data == obj.data for other in surface.objects) > 1:
                raise ValueError(f"{obj.name} shares its mesh with another selected object; make it a single user")
        stays = ~np.isin(surface.owner, moving)  # obstacles may cross each other
        mesh = bsc.CollisionMesh(surface.faces, len(surface.x), group=1 + stays, mask=3 - 2 * stays)
        result = bsc.repair(mesh, surface.x, fixed=~movable, time_limit=self.time_limit)
        if not result.crossings_before:
            self.say("INFO", "; ".join(["nothing crosses", *surface.notes]))
            return {"CANCELLED"}
        moved = result.moved > 0.0
        new, old = surface.own(result.x), surface.own(surface.x)
        for number in moving:
            own = moved[surface.owner == number]
            new[number] = np.where(own[:, None], new[number], old[number])
            _write(surface.objects[number], new[number], np.flatnonzero(own))
        found = bsc.check(mesh, Surface(surface.objects).x)  # of what Blender has now, in single precision
        left = len(found.crossings) + len(found.touching)
        said = [
            f"edges that meet faces: {result.crossings_before:,} before, {left:,} remain",
            f"{moved.sum():,} vertices moved, at most by {result.moved.max():.3g}",
            *dict.fromkeys(contour.reason for contour in result.unresolved),
            *surface.notes,
        ]
        self.say("WARNING" if left else "INFO", "; ".join(said))
        return {"FINISHED"}


class WARP_BSC_PT_panel(bpy.types.Panel):
    """The commands."""

    bl_idname, bl_label = "WARP_BSC_PT_panel", "warp-bsc"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "warp-bsc"

    def draw(self, context):
        """Draws the commands and the last message."""
        for operator in (WARP_BSC_OT_check, WARP_BSC_OT_next, WARP_BSC_OT_repair):
            self.layout.operator(operator.bl_idname)
        for line in _last.said[1].split("; "):
            self.layout.label(text=line)


_CLASSES = (WARP_BSC_OT_check, WARP_BSC_OT_next, WARP_BSC_OT_repair, WARP_BSC_PT_panel)


def register():
    """Adds the commands and the panel."""
    for each in _CLASSES:
        bpy.utils.register_class(each)


def unregister():
    """Removes them."""
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)


if __name__ == "__main__":
    register()
