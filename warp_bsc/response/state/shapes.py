"""Where the vertices of shapes and infinite planes are on their bodies, also after a program changes the shapes.

The vertices of a shape are stored for a scale of 1; kernels write where its scale and pose put them, so that a graph
holds that as well. Types, sources, bodies, flags and margins of shapes stay as a mesh took them.
"""

import newton
import warp as wp
from newton import GeoType

wp.set_module_options({"enable_backward": False})


@wp.struct
class Shapes:
    """Properties of the shapes of a model, as in ``newton.Model``."""

    type: wp.array[int]
    body: wp.array[int]
    source: wp.array[wp.uint64]
    flags: wp.array[int]
    transform: wp.array[wp.transform]
    scale: wp.array[wp.vec3]
    margin: wp.array[float]  # [m]; empty where a mesh does not use it


@wp.struct
class PlacedShapes:
    """What follows from poses and scales of shapes: their vertices and planes, in the frames of their bodies."""

    unit: wp.array[wp.vec4d]  # vertices for a scale of 1, see _local_position
    unit_of_vertex: wp.array[int]
    shape: wp.array[int]  # of a vertex
    body: wp.array[int]
    position: wp.array[wp.vec3]  # of a vertex [m]
    plane_shape: wp.array[int]
    plane_body: wp.array[int]
    plane_point: wp.array[wp.vec3]  # [m]
    plane_normal: wp.array[wp.vec3]
    jumped: wp.array[int]  # of a shape, 1 if its pose or scale has changed


def shapes_of(model: newton.Model, *, with_margins: bool, copies: bool = False) -> Shapes:
    """Returns the arrays that a model has now, or copies of them."""
    shapes = Shapes()
    for name in Shapes.vars:
        array = getattr(model, "shape_source_ptr" if name == "source" else f"shape_{name}")
        if array is not None and (with_margins or name != "margin"):
            setattr(shapes, name, wp.clone(array) if copies else array)
    return shapes


@wp.func
def _is_same_pose(a: wp.transform, b: wp.transform) -> bool:
    for i in range(7):
        if a[i] != b[i]:
            return False
    return True


@wp.func
def _is_infinite(kind: int, scale: wp.vec3) -> bool:
    """Returns whether a shape is an infinite plane, which has no vertices."""
    return kind == int(GeoType.PLANE) and (scale[0] <= 0.0 or scale[1] <= 0.0)


@wp.func
def _takes_scale(kind: int, before: wp.vec3, now: wp.vec3) -> bool:
    """Returns whether the triangles of a shape can take another scale; others would need other triangles."""
    if before == now:
        return True
    if kind == int(GeoType.CYLINDER):  # a third scale makes it a barrel, whose vertices are stored for its own scale
        return before[2] <= 0.0 and now[2] <= 0.0
    if kind == int(GeoType.CAPSULE):
        return (before[1] > 0.0) == (now[1] > 0.0)
    return _is_infinite(kind, before) == _is_infinite(kind, now)


@wp.func
def _rotated(q: wp.quat, v: wp.vec3d) -> wp.vec3d:
    axis = wp.vec3d(wp.vec3(q[0], q[1], q[2]))
    twist = wp.float64(2.0) * wp.cross(axis, v)
    return v + wp.float64(q[3]) * twist + wp.cross(axis, twist)


@wp.func
def _local_position(kind: int, unit: wp.vec4d, scale: wp.vec3) -> wp.vec3d:
    """Returns a vertex of a shape in the frame of the shape [m].

    Round shapes have a radius, which the first three components of ``unit`` take, and a half height, which the last
    takes along the axis. Others are scaled by axis.
    """
    x, y, z = wp.float64(scale[0]), wp.float64(scale[1]), wp.float64(scale[2])
    u, v, w = unit[0], unit[1], unit[2]
    if kind == int(GeoType.CYLINDER) and scale[2] > 0.0:
        return wp.vec3d(u, v, w)
    if kind == int(GeoType.SPHERE):
        return wp.vec3d(u * x, v * x, w * x)
    if kind == int(GeoType.CAPSULE) or kind == int(GeoType.CYLINDER) or kind == int(GeoType.CONE):
        return wp.vec3d(u * x, v * x, w * x + unit[3] * y)
    return wp.vec3d(u * x, v * y, w * z)


@wp.kernel
def take_shapes(
    # in
    now: Shapes,
    colliding: int,
    # in and out
    taken: Shapes,
    jumped: wp.array[int],
    not_followed: wp.array[wp.int64],
):
    """Takes over poses and scales, and writes which shapes have another, and the last one that is not followed, from 1.

    Shapes that collide with nothing, then and now, may change as they like. ``colliding`` are the flags that count.
    """
    shape = wp.tid()
    jumped[shape] = 0
    if (taken.flags[shape] | now.flags[shape]) & colliding == 0:
        return
    scale = now.scale[shape]
    takes_scale = _takes_scale(taken.type[shape], taken.scale[shape], scale)
    is_same = taken.type[shape] == now.type[shape] and taken.body[shape] == now.body[shape]
    is_same = is_same and taken.source[shape] == now.source[shape]
    is_same = is_same and (taken.flags[shape] ^ now.flags[shape]) & colliding == 0
    if taken.margin:
        is_same = is_same and taken.margin[shape] == now.margin[shape]
    if not (is_same and takes_scale):
        wp.atomic_max(not_followed, 0, wp.int64(shape + 1))
    if not takes_scale:
        scale = taken.scale[shape]
    stays = taken.scale[shape] == scale and _is_same_pose(taken.transform[shape], now.transform[shape])
    if not stays:
        jumped[shape] = 1
        taken.transform[shape] = now.transform[shape]
        taken.scale[shape] = scale


@wp.kernel
def place_shapes(shapes: Shapes, placed: PlacedShapes):
    """Writes vertices and planes of the shapes that jumped."""
    i = wp.tid()
    if i < placed.plane_shape.shape[0]:
        plane = placed.plane_shape[i]
        if placed.jumped[plane] == 1:
            q = wp.transform_get_rotation(shapes.transform[plane])
            placed.plane_point[i] = wp.transform_get_translation(shapes.transform[plane])
            placed.plane_normal[i] = wp.vec3(_rotated(q, wp.vec3d(wp.vec3(0.0, 0.0, 1.0))))
    if i < placed.position.shape[0]:
        shape = placed.shape[i]
        if placed.jumped[shape] == 1:
            pose = shapes.transform[shape]
            unit = placed.unit[placed.unit_of_vertex[i]]
            local = _rotated(
                wp.transform_get_rotation(pose), _local_position(shapes.type[shape], unit, shapes.scale[shape])
            )
            placed.position[i] = wp.vec3(wp.vec3d(wp.transform_get_translation(pose)) + local)
