"""Prints whether libuipc's sanity check accepts meshes before and after their repair; the check needs no GPU.

    pip install pyuipc
    python tests/support/libuipc.py body.obj

The meshes are those of ``warp-bsc bench repair``: two known ones, and files. Each is a shell of a thickness, by default
none: then libuipc accepts every surface whose elements neither cross nor touch.
"""

import argparse
import tempfile

import uipc
from uipc import constitution, geometry

import warp_bsc as bsc
from warp_bsc.bench.scenes.repair import KNOWN, load_tangled


def complaints(faces, x, radius, folder):
    """Returns the errors of libuipc's checks of a shell with half a thickness: none if it starts from there."""
    mesh = geometry.trimesh(x, faces)
    geometry.label_surface(mesh)
    constitution.NeoHookeanShell().apply_to(mesh, thickness=radius)
    scene = uipc.Scene(uipc.Scene.default_config())
    scene.contact_tabular().default_element().apply_to(mesh)
    scene.objects().create("mesh").geometries().create(mesh)
    engine = uipc.Engine("none", folder)  # a world does not keep it
    world = uipc.World(engine)
    world.init(scene)
    errors = [error.name().rpartition("::")[2] for error in world.sanity_checker().errors().values()]
    assert world.is_valid() == (not errors)
    return errors


def main():
    """Reads the command line, and prints for each mesh that it is accepted, or the checks that fail."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", metavar="MESH", nargs="*", help="Mesh files.")
    parser.add_argument("--radius", type=float, default=0.0, help="Half the thickness of the shells.")
    arguments = parser.parse_args()
    uipc.Logger.set_level(uipc.Logger.Level.Critical)
    tangled = {name: KNOWN[name]() for name in ("sheets", "folded")}
    tangled |= {path: load_tangled(path) for path in arguments.meshes}
    with tempfile.TemporaryDirectory() as folder:
        for name, mesh in tangled.items():
            # a little more, so that rounding does not make it less
            result = bsc.repair(mesh.faces, mesh.x, min_distance=2.1 * arguments.radius, device="cpu")
            for when, x in (("before", mesh.x), ("after", result.x)):
                print(f"{name}, {when}: {', '.join(complaints(mesh.faces, x, arguments.radius, folder)) or 'accepted'}")


if __name__ == "__main__":
    main()
