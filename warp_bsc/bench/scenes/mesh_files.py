"""Reads triangle meshes from files, as they are."""

from pathlib import Path


def read_mesh(path: str):
    """Returns the mesh of a file as ``trimesh.Trimesh``, whose vertices and faces are those of the file.

    Args:
        path: A file of any format that trimesh reads.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a readable triangle mesh, or has no triangles.
    """
    import trimesh  # noqa: PLC0415 (slow)

    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        faces = mesh.faces
    except Exception as error:  # its readers raise errors of any kind
        raise ValueError(f"{path}: not a readable triangle mesh: {error}") from error
    if not len(faces):
        raise ValueError(f"{path}: it has no triangles")
    return mesh
