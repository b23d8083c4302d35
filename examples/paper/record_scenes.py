"""Records the scenes of the paper as USD, as in assets/ or of any size.

    python examples/paper/record_scenes.py                              # all, as in assets/, into this folder
    python examples/paper/record_scenes.py twisting --triangles 50000   # one of them, larger

The beginning of each scene is simulated, but not recorded.
"""

import argparse
import importlib
from pathlib import Path
from typing import NamedTuple

import newton.viewer
import warp as wp


class Recording(NamedTuple):
    """The part of a scene that is recorded.

    Attributes:
        first: Number of the first recorded frame.
        count: Number of recorded frames.
        every: Distance from one recorded frame to the next.
    """

    first: int
    count: int
    every: int


RECORDINGS = {
    "twisting": Recording(first=76, count=26, every=2),
    "funnel": Recording(first=22, count=28, every=1),
    "dancer": Recording(first=50, count=36, every=1),
    "flamenco": Recording(first=46, count=36, every=1),
    "crashing": Recording(first=8, count=26, every=2),
}


def record(name, folder, triangles):
    """Simulates a scene and writes the recorded part to a USD file named after it.

    Args:
        name: Name of the scene.
        folder: Folder to write to.
        triangles: Approximate number of triangles, or None for the scene's default.

    Returns:
        The example after its last frame, and the file.
    """
    example_class = importlib.import_module(f"example_{name}").Example
    options = ["--viewer", "usd"] if triangles is None else ["--viewer", "usd", "--triangles", str(triangles)]
    path = Path(folder) / f"{name}.usd"
    unfinished = path.with_name(f"{name}_unfinished.usd")
    unfinished.unlink(missing_ok=True)
    first, count, every = RECORDINGS[name]
    viewer = newton.viewer.ViewerUSD(str(unfinished), num_frames=count)
    example = example_class(viewer, example_class.create_parser().parse_args(options))
    while viewer.is_running():
        if example.frame >= first and (example.frame - first) % every == 0:
            example.render()
        example.step()
    shorten(viewer.stage)
    viewer.close()
    unfinished.replace(path)
    return example, path


def shorten(stage):
    """Removes normals and invisible prims, most of the file, and lets the time begin at the first sample."""
    layer = stage.GetRootLayer()
    for name in ("particles", "joints", "com", "inertia_boxes"):
        stage.RemovePrim(f"/root/model/{name}")
    normals = []
    layer.Traverse("/", lambda path: normals.append(path) if path.name == "normals" else None)
    for path in normals:
        prim = layer.GetPrimAtPath(path.GetPrimPath())
        prim.RemoveProperty(prim.properties[path.name])
    stage.SetStartTimeCode(layer.ListTimeSamplesForPath("/root/model/triangles.points")[0])


def main():
    """Records the scenes that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="which scenes (default: all)")
    parser.add_argument("--triangles", type=int, help="approximate number of triangles (default: that of each scene)")
    parser.add_argument("--folder", default=".", help="where to write (default: the current folder)")
    parser.add_argument("--device", help="Warp device, such as cuda:0 (default: Warp's)")
    arguments = parser.parse_args()
    for name in arguments.scenes:
        if name not in RECORDINGS:
            parser.error(f"there is no scene {name}, only {', '.join(RECORDINGS)}")
    if arguments.device:
        wp.set_device(arguments.device)
    for name in arguments.scenes or RECORDINGS:
        example, path = record(name, arguments.folder, arguments.triangles)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        example.print_report()


if __name__ == "__main__":
    main()
