"""GLB files: what is read, that nothing but positions and their bounds changes, and what is refused."""

import copy
import json
import re

import numpy as np
import pytest
import trimesh

from warp_bsc.mesh_files.mesh_file import MeshFile

SPHERE = trimesh.creation.icosphere(2)
X = np.random.default_rng(3).normal(size=(9, 3)).astype(np.float32)
IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def chunks(*parts):
    """A file of chunks, pairs of a name and bytes."""
    body = b"".join(len(data).to_bytes(4, "little") + name + data for name, data in parts)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def glb(gltf, binary, *others, indent=3):
    text = gltf if isinstance(gltf, bytes) else json.dumps(gltf, indent=indent, ensure_ascii=False).encode()
    return chunks((b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", binary), *others)


def parts_of(data):
    """The JSON and what follows it."""
    end = 20 + int.from_bytes(data[12:16], "little")
    assert int.from_bytes(data[8:12], "little") == len(data) and end % 4 == 0
    return data[20:end].decode(), data[end:]


def bounds(x):
    return {"min": x.min(axis=0).tolist(), "max": x.max(axis=0).tolist()}


def example():
    """Nine points beside normals in one view, in primitives with and without indices, in strips and in fans."""
    vertices = np.zeros(9, [("x", "<f4", 3), ("normal", "<f4", 3), ("uv", "<f4", 2)])
    vertices["x"], vertices["normal"] = X, 0.5
    indices = np.array([0, 1, 2, 3, 4], "<u2").tobytes() + b"\0\0"
    delta = np.ones((1, 3), "<f4").tobytes() + np.array([4], "<u4").tobytes()
    view = {"buffer": 0, "byteOffset": 0, "byteLength": 288, "byteStride": 32, "target": 34962}
    float3 = {"bufferView": 0, "componentType": 5126, "type": "VEC3"}
    sparse = {"count": 1, "indices": {"bufferView": 2, "byteOffset": 12, "componentType": 5125}}
    sparse["values"] = {"bufferView": 2}
    both = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    gltf = {
        "asset": {"version": "2.0", "generator": "ü ✓", "extras": {"accessors": [{"min": [7]}]}},
        "extensionsUsed": ["VENDOR_unknown"],
        "meshes": [
            {"name": "Mäntel", "primitives": [{"attributes": both, "indices": 4, "material": 0}]},
            {"primitives": [{"attributes": both, "indices": 3, "mode": 5, "targets": [{"POSITION": 6}]}]},
            {"primitives": [{"attributes": {"POSITION": 5}, "mode": 6}, {"attributes": both, "mode": 1}]},
        ],
        "accessors": [
            {**float3, "count": 9, **bounds(X)},
            {**float3, "byteOffset": 12, "count": 9},
            {"bufferView": 0, "byteOffset": 24, "componentType": 5126, "type": "VEC2", "count": 9},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 5},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 3},
            {**float3, "byteOffset": 160, "count": 4, **bounds(X[5:])},
            {"componentType": 5126, "type": "VEC3", "count": 9, "sparse": sparse},
        ],
        "bufferViews": [
            view,
            {"buffer": 0, "byteOffset": 288, "byteLength": 12},
            {"buffer": 0, "byteOffset": 300, "byteLength": 16},
        ],
        "buffers": [{"byteLength": 316}],
        "materials": [{"name": "cloth", "extensions": {"VENDOR_unknown": {"min": [1.0]}}}],
        "nodes": [{"name": "all", "children": [1, 2]}, {"mesh": 0}, {"mesh": 1, "matrix": IDENTITY}, {"mesh": 2}],
        "scenes": [{"nodes": [0, 3]}],
    }
    return gltf, vertices.tobytes() + indices + delta


def read(tmp_path, data, name="a.glb"):
    (tmp_path / name).write_bytes(data)
    return MeshFile(str(tmp_path / name))


def test_all_primitives_are_read_and_share_points(tmp_path):
    gltf, binary = example()
    mesh = read(tmp_path, glb(gltf, binary))
    assert mesh.x.dtype == np.float32 and mesh.x.tobytes() == X.tobytes()
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [1, 3, 2], [2, 3, 4], [6, 7, 5], [7, 8, 5]]
    assert mesh.polygons.tolist() == list(range(6))
    assert [note.split(",")[0] for note in mesh.notes] == [
        "its normals are kept",
        "primitives that are no triangles are not checked: 1",
        "skins",
    ]


@pytest.mark.parametrize("indent", [None, 3, "\t"])
def test_positions_and_their_bounds_change_and_nothing_else(tmp_path, indent):
    gltf, binary = example()
    data = glb(gltf, binary, (b"XTRA", b"12345678"), indent=indent)
    mesh = read(tmp_path, data)
    assert mesh.with_positions(mesh.x) == data
    x = mesh.x.copy()
    x[[2, 7]] = [[0.1, -7.5, 1e-8], [3.3, 9.25, -1e10]]
    new = mesh.with_positions(x)
    assert read(tmp_path, new, "b.glb").x.tobytes() == x.tobytes()
    vertices = np.frombuffer(binary[:288], np.uint8).reshape(9, 32).copy()
    vertices[:, :12] = x.view(np.uint8).reshape(9, 12)
    assert parts_of(new)[1] == parts_of(data)[1].replace(binary[:288], vertices.tobytes())
    expected = copy.deepcopy(gltf)
    expected["accessors"][0] |= bounds(x)
    expected["accessors"][5] |= bounds(x[5:])
    assert json.loads(parts_of(new)[0]) == expected
    words = [re.findall(r"[^\s,\]]+", parts_of(each)[0]) for each in (data, new)]
    changed_bounds = [bounds(rows)[key] for rows in (X, X[5:], x, x[5:]) for key in ("min", "max")]
    assert (
        sum(a != b for a, b in zip(*words, strict=True)) == (np.array(changed_bounds[:4]) != changed_bounds[4:]).sum()
    )
    for number in (0, 5):
        rows = x if not number else x[5:]
        accessor = json.loads(parts_of(new)[0])["accessors"][number]
        assert (np.float32(accessor["min"]) == rows.min(axis=0)).all()
        assert (np.float32(accessor["max"]) == rows.max(axis=0)).all()


def test_vertices_are_numbered_in_the_order_of_primitives(tmp_path):
    """Not in that of the binary data: the second mesh is of accessor 5, whose points come later."""
    gltf, binary = example()
    del gltf["meshes"][0]
    gltf["meshes"].reverse()
    gltf["nodes"][1:] = [{"mesh": 0}, {"mesh": 1}, {}]
    mesh = read(tmp_path, glb(gltf, binary))
    assert mesh.x.tobytes() == X[[5, 6, 7, 8, 0, 1, 2, 3, 4]].tobytes()
    assert mesh.faces.tolist() == [[1, 2, 0], [2, 3, 0], [4, 5, 6], [5, 7, 6], [6, 7, 8]]


def test_a_file_of_another_writer_has_the_same_bits_for_it(tmp_path):
    scene = trimesh.Scene([SPHERE, SPHERE.copy().apply_translation([3.0, 0, 0])])
    mesh = read(tmp_path, scene.export(file_type="glb"))
    assert len(mesh.x) == 2 * len(SPHERE.vertices) and len(mesh.faces) == 2 * len(SPHERE.faces)
    x = mesh.x + np.float32(0.1)
    read(tmp_path, mesh.with_positions(x), "b.glb")
    other = trimesh.load_scene(tmp_path / "b.glb", process=False)
    np.testing.assert_array_equal(np.concatenate([part.vertices for part in other.geometry.values()]), x)


def test_a_transform_of_all_is_said(tmp_path):
    gltf, binary = example()
    gltf["nodes"][0]["scale"] = [2, 2, 2]
    gltf["nodes"][3]["matrix"] = [2 * value if number < 15 else 1 for number, value in enumerate(IDENTITY)]
    assert "before the transform of its nodes" in read(tmp_path, glb(gltf, binary)).notes[-1]


def changed(change):
    gltf, binary = example()
    change(gltf)
    return glb(gltf, binary)


ERRORS = {
    "mesh 0, primitive 0: it is compressed by Draco": lambda g: g["meshes"][0]["primitives"][0].update(
        extensions={"KHR_draco_mesh_compression": {}}
    ),
    "its positions are compressed by meshopt": lambda g: g["bufferViews"][0].update(
        extensions={"EXT_meshopt_compression": {}}
    ),
    "its positions are quantised": lambda g: g["accessors"][0].update(componentType=5122, normalized=True),
    "its positions are in a sparse accessor": lambda g: g["accessors"][0].update(sparse={}),
    "mesh 0, primitive 0: its positions are in another file": lambda g: g["buffers"][0].update(uri="a.bin"),
    "its indices \\(accessor 4\\) are not within": lambda g: g["accessors"][4].update(count=7),
    "its positions \\(accessor 0\\) are not within": lambda g: g["accessors"][0].update(count=1 << 70),
    "accessor 0 has positions, and something else": lambda g: g["meshes"][0]["primitives"][0]["attributes"].update(
        NORMAL=0
    ),
    "accessor 1 has bytes of positions": lambda g: g["accessors"][1].update(byteOffset=8),
    "positions of its primitives overlap": lambda g: g["accessors"][5].update(byteOffset=164),
    "node 2 \\(without a name\\) has another transform than node 1": lambda g: g["nodes"][2].update(
        matrix=[2, *IDENTITY[1:]]
    ),
    "node 3 .* has another transform": lambda g: g["nodes"][0].update(rotation=[0, 0, 1, 0]),
    "node 1 .* draws instances": lambda g: g["nodes"][1].update(extensions={"EXT_mesh_gpu_instancing": {}}),
    "not divisible by three": lambda g: g["accessors"][4].update(count=4),
    "face 0, counted from 0, has less": lambda g: g["accessors"][0].update(count=2),
    "it has no faces": lambda g: g.pop("meshes"),
    "its JSON is not as glTF 2.0 says: KeyError: 'bufferViews'": lambda g: g.pop("bufferViews"),
}


@pytest.mark.parametrize("error", ERRORS)
def test_what_cannot_be_kept_is_an_error_that_names_it(tmp_path, error):
    with pytest.raises(ValueError, match=f"a\\.glb: .*{error}"):
        read(tmp_path, changed(ERRORS[error]))


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b"", "no header of a GLB file"),
        (glb(*example()).replace(b"glTF\2", b"glTF\1"), "no header of a GLB file"),
        (glb(*example())[:-4], "shorter than its header says"),
        (glb(*example()).replace(b"\x3c\1\0\0BIN\0", b"\x40\1\0\0BIN\0"), "shorter than its header says"),
        (chunks((b"JSON", b"{}  ")), "it has no faces"),
        (chunks((b"JSON", b"[]  ")), "its JSON is not as glTF 2.0 says"),
        (chunks((b"JSON", b"{,  ")), "Expecting property name"),
        (chunks((b"JSON", json.dumps(example()[0]).encode())), "are not within the file's binary data"),
    ],
)
def test_broken_files(tmp_path, data, error):
    with pytest.raises(ValueError, match=f"a\\.glb: .*{error}"):
        read(tmp_path, data)


def test_files_cut_off_or_with_other_bytes_are_read_or_refused(tmp_path):
    """Never another error than those that are announced."""
    data, random = glb(*example(), indent=None), np.random.default_rng(2)
    for trial in range(400):
        broken = bytearray(data)
        for place in random.integers(0, len(data) if trial % 2 else 1800, 1 + trial % 3):
            broken[place] = random.choice(list(b'0123456789-e.,:[]{}" ntx') if trial % 4 else range(256))
        (tmp_path / "a.glb").write_bytes(broken)
        try:
            mesh = MeshFile(str(tmp_path / "a.glb"))
        except ValueError:
            continue
        assert np.isfinite(mesh.x[mesh.faces]).all() and mesh.with_positions(mesh.x) == bytes(broken)
        x = mesh.x + np.float32(1.0)
        moved = read(tmp_path, mesh.with_positions(x), "b.glb").x
        np.testing.assert_array_equal(moved, x)
