"""The surfaces of a model's shapes as triangles, for a scale of 1."""

import numpy as np
from newton import GeoType, Mesh

_BARE = {"compute_normals": False, "compute_uvs": False, "compute_inertia": False}  # triangles alone are used


def tessellation_key(model, shape, shape_type, scale):
    """Returns what the triangles of a shape, for a scale of 1, depend on."""
    is_barrel = shape_type == GeoType.CYLINDER and scale[2] > 0.0
    is_sphere = shape_type == GeoType.CAPSULE and not scale[1] > 0.0
    return shape_type, id(model.shape_source[shape]), is_sphere, tuple(scale) if is_barrel else None


def tessellate(model, shape, shape_type, scale, segments):
    """Returns the surface of a shape for a scale of 1, see :mod:`.shapes`.

    That is its vertices, float64, shape [n, 4], and faces, shape [m, 3]; no two vertices are in one place. Raises
    NotImplementedError if there are no triangles for the type.
    """
    match shape_type:
        case GeoType.MESH | GeoType.CONVEX_MESH:
            return _weld(model.shape_source[shape])
        case GeoType.PLANE:
            return _weld(Mesh.create_plane(1.0, 1.0, **_BARE))
        case GeoType.BOX:
            return _weld(Mesh.create_box(1.0, 1.0, 1.0, **_BARE))
        case GeoType.SPHERE | GeoType.ELLIPSOID:
            return _revolve(_capsule_profile(segments, is_sphere=True), segments)
        case GeoType.CAPSULE:
            return _revolve(_capsule_profile(segments, is_sphere=not scale[1] > 0.0), segments)
        case GeoType.CYLINDER:
            x, y, z = scale.astype(np.float64)
            if not z > 0.0:
                return _revolve([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]], segments)
            # a barrel, whose side is an arc of radius z
            angle = np.linspace(-1.0, 1.0, segments // 2 + 1)[1:-1] * np.arcsin(y / z)
            arc = np.column_stack([x - np.sqrt(z * z - y * y) + z * np.cos(angle), z * np.sin(angle)])
            profile = np.concatenate([[[0.0, -y], [x, -y]], arc, [[x, y], [0.0, y]]])
            return _revolve(np.column_stack([profile, np.zeros(len(profile))]), segments)
        case GeoType.CONE:
            return _revolve([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]], segments)
    raise NotImplementedError(
        f"shape {shape} ({model.shape_label[shape]!r}) of type {shape_type.name} collides with particles, but has no "
        "triangles to collide with: use a mesh, or clear its flag COLLIDE_PARTICLES"
    )


def _weld(mesh):
    """Returns the vertices and triangles of a ``newton.Mesh``, with vertices that are in one place merged.

    Seams of texture or normals have several, and the triangles on both sides would always collide with each other.
    """
    positions, vertex = np.unique(mesh.vertices.astype(np.float64), axis=0, return_inverse=True)
    return np.column_stack([positions, np.zeros(len(positions))]), vertex.reshape(-1)[mesh.indices].reshape(-1, 3)


def _capsule_profile(segments, *, is_sphere):
    """Returns the profile of a capsule from pole to pole, as of :func:`_revolve`; that of a sphere has one equator."""
    angle = np.linspace(0.0, np.pi / 2.0, segments // 4 + 1)
    lower = np.column_stack([np.sin(angle), -np.cos(angle), np.full(len(angle), -1.0)])
    upper = lower[::-1] * (1.0, -1.0, -1.0)
    return np.concatenate([lower, upper[1:] if is_sphere else upper])


def _revolve(profile, segments):
    """Returns the surface that a profile makes when it turns around the z axis, as :func:`tessellate` does.

    The profile has radius and height, and the share of the half height that is added to it, from the lower pole to the
    upper, both on the axis, shape [n, 3].
    """
    from trimesh import creation  # noqa: PLC0415 (slow)

    # trimesh drops triangles and merges vertices by absolute sizes: revolve a unit profile, and scale its rings
    unit = np.column_stack([np.ones(len(profile)), np.arange(len(profile))])
    unit[[0, -1], 0] = 0.0
    surface = creation.revolve(unit, sections=segments)
    rings = np.asarray(profile)[surface.vertices[:, 2].astype(int)]
    return np.column_stack([surface.vertices[:, :2] * rings[:, :1], rings[:, 1:]]), np.array(surface.faces)
