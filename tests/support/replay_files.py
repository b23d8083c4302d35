"""Stages whose replays find something for each kind of file, and readers of the files of a replay."""

import base64
import contextlib
import json
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from usd_stages import FALLING, FLOOR, add_floor, add_mesh, animate, moved, new_stage, save

from warp_bsc.cli.main import main

OUTPUTS = ("hits.json", "hits.csv", "overlay.usda", "page.html", "hits.npz")
OPTIONS = ("--json", "--csv", "--overlay", "--report", "--npz")


@contextlib.contextmanager
def largest_file(size):
    """Lets no file become larger: as on a full disk, writing more is an error."""
    resource = pytest.importorskip("resource")  # of POSIX
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def replay(stage, *options, status=0):
    """Writes all files beside the scene, and returns their paths."""
    path = Path(save(stage)) if isinstance(stage, Usd.Stage) else Path(stage)
    files = [path.parent / name for name in OUTPUTS]
    named = zip(OPTIONS, map(str, files), strict=True)
    arguments = [argument for pair in named for argument in pair]
    assert main(["replay", str(path), "--device", "cpu", *arguments, *options]) == status
    return files


def falling_through_quads(folder):
    """A triangle that falls through a floor of two quads from time 2 to 3, through the second of them."""
    stage = new_stage(folder / "scene.usda")
    (a, b, c, d), (e, f) = FLOOR, [(6, -2, 0), (6, 2, 0)]
    add_mesh(stage, "/World/Floor", [a, b, c, d, e, f], [4, 4], [1, 4, 5, 2, 0, 1, 2, 3])
    heights = {0: 2, 1: 1, 2: 0.25, 3: -0.25, 4: -0.3}
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, z)) for time, z in heights.items()})
    return stage


def near_and_inside_stage(folder):
    """A triangle comes near a floor, in two intervals; a small cube is in a large one all the time."""
    stage = new_stage(folder / "scene.usda")
    add_floor(stage)
    heights = enumerate([1, 0.25, 0.125])
    add_mesh(stage, "/World/Falling", {time: moved(FALLING, (0, 0, height)) for time, height in heights})
    for name, size in (("Case", 1.0), ("Inside", 0.25)):
        cube = UsdGeom.Cube.Define(stage, f"/World/{name}")
        cube.CreateSizeAttr(size)
        animate(cube, (0, 0, 3))
    return stage


def many_hits(path, columns=40, samples=4):
    """Strips that swing through a floor of quads, to and fro: many collisions of three pairs of meshes."""
    stage = new_stage(path)
    x = np.arange(columns, dtype=float)
    add_mesh(stage, "/World/Floor", [(a, b, 0) for b in (-1, 1) for a in [*x, columns]], [4] * columns,
             [i for a in range(columns) for i in (a, a + 1, a + columns + 2, a + columns + 1)])  # fmt: skip
    for number in range(3):
        triangles = [
            (a + 0.2 * number + 0.1 + dx, dy, dz)
            for a in x
            for dx, dy, dz in ((0, 0, 0), (0.1, 0.1, 9), (0.1, -0.1, 9))
        ]
        points = {time: moved(triangles, (0, 0, -0.5 if time % 2 else 0.5)) for time in range(samples)}
        add_mesh(stage, f"/World/Strip{number}", points, [3] * columns, list(range(3 * columns)))
    return stage


def left_behind(folder):
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


class Page(HTMLParser):
    """Tags, handlers, addresses, scripts, data and blocks of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.scripts, self.data, self._packed = set(), [], [], None, {}
        self._inside = None
        self.policy = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += attrs
        attributes = dict(attrs)
        if attributes.get("http-equiv") == "Content-Security-Policy":
            self.policy = attributes["content"]
        self._inside = (tag, attributes.get("type"), attributes.get("id"), attributes.get("data-packed"))

    def handle_data(self, data):
        if self._inside and self._inside[:2] == ("script", "application/json"):
            self.data = json.loads(data)
        elif self._inside and self._inside[:2] == ("script", "text/plain"):
            self._packed[self._inside[2]] = data, self._inside[3]
        elif self._inside and self._inside[:2] == ("script", None):
            self.scripts.append(data)
        self._inside = None

    @property
    def blocks(self):
        """Names of all blocks."""
        return self._packed.keys()

    def block(self, name):
        """The facts and the arrays of a block."""
        text, packed = self._packed[name]
        content = base64.b64decode(text)
        content = zlib.decompress(content) if packed else content
        at = 4 + int.from_bytes(content[:4], "little")
        found = json.loads(content[4:at])
        for key, kind, length in found.pop("arrays"):
            planes = np.frombuffer(content[at : at + 4 * length], np.uint8).reshape(4, length)
            found[key] = np.ascontiguousarray(planes.T).view(f"<{kind}4").reshape(-1)
            at += 4 * length
        assert at == len(content)
        return found


def add_up(block, prefix=""):
    """The points of a block at the start and at the end, shape [n, 3] each, from columns of differences."""
    starts, ends = (block[f"{prefix}{name}"].reshape(3, -1).T for name in ("start", "end"))
    starts, ends = (np.where(part % 2, -(part + 1) // 2, part // 2) for part in (starts, ends))
    start = np.cumsum(starts, axis=0)
    return block[f"{prefix}step"] * start, block[f"{prefix}step"] * (start + ends)


def errors_of(stage):
    """What usdchecker finds wrong."""
    validation = pytest.importorskip("pxr.UsdValidation")
    validators = [
        validator
        for validator in validation.ValidationRegistry().GetOrLoadAllValidators()
        if not validator.GetMetadata().name.startswith("warp_bsc.")  # our own rule finds the collisions
    ]
    return [error.GetMessage() for error in validation.ValidationContext(validators).Validate(stage)]


def prims_of_pairs(overlay, name, root="/Collisions"):
    """The prims with a name below each pair of meshes."""
    pairs = [child for child in overlay.GetPrimAtPath(root).GetChildren() if child.GetName() != "Materials"]
    return [prim for pair in pairs if (prim := pair.GetChild(name))]


def read_contacts(overlay, time, kinds=("VertexFace", "EdgeEdge"), root="/Collisions"):
    """Points of contact, and the values of each primvar, meshes by their names."""
    prims, points, primvars = overlay.GetPrimAtPath(root).GetAttribute("prims").Get(), [], {}
    for instancer in (UsdGeom.PointInstancer(prim) for kind in kinds for prim in prims_of_pairs(overlay, kind, root)):
        api = UsdGeom.PrimvarsAPI(instancer)
        points.extend(instancer.GetPositionsAttr().Get(time))
        assert len(instancer.GetProtoIndicesAttr().Get(time)) == len(instancer.GetPositionsAttr().Get(time))
        for name in ("toi", "elementA", "elementB", "primA", "primB"):
            primvar = api.GetPrimvar(name)
            assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
            values = [tuple(value) if name.startswith("element") else value for value in primvar.Get(time)]
            primvars.setdefault(name, []).extend(
                [prims[value] for value in values] if name.startswith("prim") else values
            )
    return np.array(points).reshape(-1, 3), primvars


def read_polygons(overlay, time, root="/Collisions"):
    """The triangles of the polygons that collide, as points: of one side, then of the other."""
    triangles = [np.zeros((0, 3, 3))]
    for mesh in map(UsdGeom.Mesh, prims_of_pairs(overlay, "Polygons", root)):
        points = np.array(mesh.GetPointsAttr().Get(time)).reshape(-1, 3)
        counts, corners = mesh.GetFaceVertexCountsAttr().Get(time), mesh.GetFaceVertexIndicesAttr().Get(time)
        assert list(counts) == [3] * (len(corners) // 3)
        triangles.append(points[np.array(corners, dtype=int)].reshape(-1, 3, 3))
    return np.concatenate(triangles)
