"""Mesh files: what is read of each format, and that nothing but coordinates of moved vertices changes in a file."""

import re

import numpy as np
import pytest
import trimesh

from warp_bsc.mesh_files.mesh_file import MeshFile, MeshScene

OBJ = b"""# a comment\r
mtllib garment.mtl\r
o first object
v 0 0.10 0 1 0.5 0.25
v  1.000\t0 0 1 1 1 # after
\tv 1 1 1e-1
vt 0 0
vn 0 0 1
usemtl cloth
f 1/1/1 2/1/1 3/1/1
v NaN 7 7
o second
v 0 1 0
v 0 2 0 \\
 0 0 0
s off
f -2//1 2// 3 \\
  -5
l 1 2
f 1 2 3 5 6
"""
SPHERE = trimesh.creation.icosphere(2)


def write(folder, name, data):
    (folder / name).write_bytes(data)
    return str(folder / name)


def moved(x, seed=0):
    """Other positions for a few vertices, in the type of the given ones, with all bits in use."""
    random = np.random.default_rng(seed)
    x = x.copy()
    rows = random.integers(0, len(x), 20)
    x[rows] += random.normal(size=(20, 3)).astype(x.dtype)
    return x


def test_obj_is_read_as_it_is(tmp_path):
    """Colours, negative indices, joined lines, both line ends, several objects, polygons, an unused vertex."""
    mesh = MeshFile(write(tmp_path, "a.obj", OBJ))
    assert mesh.x.dtype == np.float64 and mesh.x.shape == (6, 3)
    np.testing.assert_array_equal(mesh.x[[0, 1, 2, 4, 5]], [[0, 0.1, 0], [1, 0, 0], [1, 1, 0.1], [0, 1, 0], [0, 2, 0]])
    assert mesh.faces.tolist() == [[0, 1, 2], [4, 1, 2], [4, 2, 1], [0, 1, 2], [0, 2, 4], [0, 4, 5]]
    assert mesh.polygons.tolist() == [0, 1, 1, 2, 2, 2]
    assert len(mesh.notes) == 3 and "normals" in mesh.notes[0] and mesh.notes[1].endswith("not checked: 1")
    assert "fan" in mesh.notes[2]


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_obj_with_a_byte_order_mark_and_any_line_ends(tmp_path, end):
    data = b"\xef\xbb\xbfv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".replace(b"\n", end)
    mesh = MeshFile(write(tmp_path, "a.obj", data))
    assert mesh.x.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and mesh.faces.tolist() == [[0, 1, 2]]
    expected = b"\xef\xbb\xbfv 0 0 0\nv 1.5 0 0\nv 0 1.5 0\nf 1 2 3\n".replace(b"\n", end)
    assert mesh.with_positions(1.5 * mesh.x) == expected


def test_only_coordinates_that_change_are_replaced(tmp_path):
    mesh = MeshFile(write(tmp_path, "a.obj", OBJ))
    assert mesh.with_positions(mesh.x) == OBJ
    x = mesh.x.copy()
    x[1, 0], x[5] = 1.0 / 3.0, [-1e-300, 2.0, 5e22]
    written = mesh.with_positions(x)
    expected = OBJ.replace(b"1.000\t", b"0.3333333333333333\t").replace(b"v 0 2 0 ", b"v -1e-300 2 5e+22 ")
    assert written == expected
    assert MeshFile(write(tmp_path, "b.obj", written)).x[[1, 5]].tobytes() == x[[1, 5]].tobytes()


def exported(name, mesh=SPHERE):
    """A file as trimesh writes it."""
    options = {"text.ply": {"encoding": "ascii"}, "text.stl": {"file_type": "stl_ascii"}}.get(name, {})
    options = options or {"file_type": name.partition(".")[2]}
    data = mesh.export(**({"file_type": "ply"} | options))
    return data.encode() if isinstance(data, str) else data


NAMES = ["a.obj", "a.off", "a.ply", "text.ply", "a.stl", "text.stl"]


@pytest.mark.parametrize("name", NAMES)
def test_another_reader_gets_the_same_bits(tmp_path, name):
    data = exported(name)
    mesh = MeshFile(write(tmp_path, name, data))
    assert mesh.x.shape == (162, 3) and mesh.faces.shape == (320, 3)
    assert mesh.with_positions(mesh.x) == data
    x = moved(mesh.x)
    assert mesh.x.dtype == (np.float32 if name in ("a.ply", "text.ply", "a.stl") else np.float64)
    path = write(tmp_path, f"new_{name}", mesh.with_positions(x))
    other = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(np.asarray(other.vertices)[other.faces], x[mesh.faces])
    again = MeshFile(path)
    np.testing.assert_array_equal(again.x[again.faces], x[mesh.faces])


def ply(order, *, vertex="float", extra=True):
    """A binary PLY file of a triangle, a quad and a pentagon, with other elements and properties."""
    code = {"float": "f4", "double": "f8"}[vertex]
    names = [("nx", "f4"), *((axis, code) for axis in "zxy"), ("red", "u1")]
    points = np.zeros(6, [(name, order + type) for name, type in names])
    for axis, values in zip("xyz", np.random.default_rng(1).normal(size=(3, 6)), strict=True):
        points[axis] = values
    words = {"f4": "float", "f8": "double", "u1": "uchar"}
    header = [f"property {words[type]} {name}" for name, type in names]
    form = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", "comment end_header is not here", f"format {form} 1.0", "element camera 2", "property double f"]
    lines += ["element vertex 6", *header, "element face 3", "property uchar flags"]
    lines += ["property list uchar int vertex_index", "property list uchar float uv", "end_header"]
    body = np.zeros(2, order + "f8").tobytes() + points.tobytes()
    for face in ([0, 1, 2], [0, 1, 2, 3], [5, 4, 3, 2, 1]):
        body += b"\x07" + bytes([len(face)]) + np.array(face, order + "i4").tobytes()
        body += bytes([2]) + np.zeros(2, order + "f4").tobytes()
    return "\n".join([*lines, ""]).encode() + body, points


@pytest.mark.parametrize("vertex", ["float", "double"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply(tmp_path, order, vertex):
    data, points = ply(order, vertex=vertex)
    mesh = MeshFile(write(tmp_path, "a.ply", data))
    expected = np.stack([points[axis] for axis in "xyz"], axis=1)
    assert mesh.x.dtype == {"float": np.float32, "double": np.float64}[vertex] and mesh.x.dtype.isnative
    np.testing.assert_array_equal(mesh.x, expected)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [5, 4, 3], [5, 3, 2], [5, 2, 1]]
    assert mesh.polygons.tolist() == [0, 1, 1, 2, 2, 2] and "normals" in mesh.notes[0]
    x = moved(mesh.x)
    points = points.copy()
    for axis in range(3):
        points["xyz"[axis]] = x[:, axis]
    start = data.index(b"end_header\n") + len(b"end_header\n") + 16
    assert mesh.with_positions(x) == data[:start] + points.tobytes() + data[start + points.nbytes :]


def test_text_ply_of_single_precision_has_the_same_bits_for_readers_of_either_precision(tmp_path):
    mesh = MeshFile(write(tmp_path, "a.ply", exported("text.ply")))
    x = moved(mesh.x)
    words = mesh.with_positions(x).split(b"end_header\n")[1].split(b"\n")
    read = np.array([line.split()[:3] for line in words[: len(x)]], dtype=np.float64)
    changed = x != mesh.x
    assert (read[changed] == x[changed]).all() and (read.astype(np.float32) == x).all()


def test_text_ply_with_coordinates_in_another_order(tmp_path):
    lines = ["ply", "format ascii 1.0", "element vertex 3", "property double z", "property uchar red"]
    lines += ["property double x", "property double y", "element face 1", "property float weight"]
    lines += ["property list uchar int vertex_indices", "element edge 1", "property int a", "end_header"]
    data = "\n".join([*lines, "3 9 1 2", "6 9 4 5", "9 9 7 8", "0.5 3 0 1 2 ", "7", ""]).encode()
    mesh = MeshFile(write(tmp_path, "a.ply", data))
    assert mesh.x.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]] and mesh.faces.tolist() == [[0, 1, 2]]
    x = mesh.x + np.array([0.25, 0.0, 0.5])
    assert mesh.with_positions(x) == data.replace(b"3 9 1 2", b"3.5 9 1.25 2").replace(
        b"6 9 4 5", b"6.5 9 4.25 5"
    ).replace(b"9 9 7 8", b"9.5 9 7.25 8")


def test_equal_corners_of_a_soup_are_one_vertex_and_stay_one(tmp_path):
    mesh = MeshFile(write(tmp_path, "a.stl", exported("a.stl")))
    x = mesh.x.copy()
    x[5] += np.float32(0.1)
    again = MeshFile(write(tmp_path, "b.stl", mesh.with_positions(x)))
    assert len(again.x) == len(mesh.x)
    data, new = exported("a.stl"), mesh.with_positions(x)
    assert data[:84] == new[:84]  # the header and the count
    changed = np.frombuffer(data, np.uint8)[84:].reshape(-1, 50) != np.frombuffer(new, np.uint8)[84:].reshape(-1, 50)
    assert not changed[:, :12].any() and not changed[:, 48:].any()  # normals and attributes
    assert changed.any(axis=1).sum() in (5, 6)


def test_off_with_colours_and_comments(tmp_path):
    data = b"COFF # of colours\n# counts\n4 2 0\n\n0 0 0 255 0 0\n1 0 0 0 0 0 # second\n1 1 0\n0 1 .5 1 1 1\n"
    data += b"4 0 1 2 3 0.5 0.5 1\r\n3 0 1 2\n"
    mesh = MeshFile(write(tmp_path, "a.off", data))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]] and mesh.polygons.tolist() == [0, 0, 1]
    x = mesh.x.copy()
    x[3, 2] = 0.1
    assert mesh.with_positions(x) == data.replace(b"0 1 .5 1", b"0 1 0.1 1")


def test_several_files_are_one_scene(tmp_path):
    paths = [write(tmp_path, "a.obj", OBJ), write(tmp_path, "b.ply", ply("<")[0])]
    scene = MeshScene(paths)
    assert scene.x.dtype == np.float64 and scene.file_of.tolist() == [0] * 6 + [1] * 6
    assert scene.faces[6:].min() == 6 and [len(x) for x in scene.of_files(scene.x)] == [6, 6]
    assert scene.element("edge", np.array([8, 11])) == {"edge": [2, 5], "of": paths[1], "at": scene.x[8].tolist()}
    assert scene.element("face", 5) == {"face": 2, "of": paths[0], "at": [0.0, 0.1, 0.0]}


TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
HEADER = b"ply\nformat ascii 1.0\nelement vertex 1\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("name", "data", "error"),
    [
        ("a.obj", b"", "it has no faces"),
        ("a.obj", TETRAHEDRON, "it has no faces"),
        ("a.obj", TETRAHEDRON + b"f 1 2 4\n", "face 0, counted from 0, has .* no vertex"),
        ("a.obj", TETRAHEDRON + b"f 1 2 3\nf 1 2 0\n", "face 1, counted from 0, has .* no vertex"),
        ("a.obj", TETRAHEDRON + b"f -1 -2 -4\n", "face 0, counted from 0, has .* no vertex"),
        ("a.obj", TETRAHEDRON + b"f 1 2 99999999999999999999\n", "too large"),
        ("a.obj", TETRAHEDRON + b"f 1 2\n", "face 0, counted from 0, has less than three corners"),
        ("a.obj", TETRAHEDRON + b"f 1 2 x\n", "line 4: a count or a corner"),
        ("a.obj", b"\r\n# x\r\nv 0 0\r\n", "line 3: a vertex must have three coordinates"),
        ("a.obj", b"v 0 0 zero\n", "line 1: a vertex must have three coordinates"),
        (
            "a.obj",
            b"v 0 0 1e999\n" + TETRAHEDRON + b"f 1 2 3\n",
            r"vertex 0, counted from 0, .* not finite: \[ 0. *0. inf\]",
        ),
        ("a.obj", TETRAHEDRON + b"v 0 nan 0\nf 1 2 4\n", "vertex 3, counted from 0, .* not finite"),
        ("a.off", b"", "it does not begin with OFF"),
        ("a.off", b"4OFF\n1 1 1\n", "it does not begin with OFF"),
        ("a.off", b"OFF BINARY\n1 1 1\n", "line 1: a count"),
        ("a.off", b"OFF\n2 1 0\n0 0 0\n", "it ends before its last vertex or face"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n0 1 0\n1 0 0\n3 0 1\n", "line 6: a count or a corner"),
        ("a.stl", b"", "neither a text STL nor a binary one"),
        ("a.stl", b"x" * 200, "neither a text STL nor a binary one"),
        ("a.stl", b"solid\nendsolid", "it has no faces"),
        (
            "a.stl",
            b"solid\nouter loop\nvertex 0 0 0\nvertex 0 0 1\nendloop",
            "face 0, counted from 0, has less than three",
        ),
        ("a.stl", b"solid\nouter loop\nvertex 0 0 0\n", "it ends within a facet"),
        ("a.stl", b"solid\nouter loop\nvertex 0 0\n", "line 3: a vertex must have three"),
        ("a.ply", b"", "it has no header of a PLY file"),
        ("a.ply", b"ply\nelement vertex 1\nend_header\n", "it has no header of a PLY file"),
        ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "it has no vertices"),
        ("a.ply", HEADER + b"property float x\nend_header\n1\n", "must have x, y and z"),
        ("a.ply", HEADER + XYZ.replace(b"float z", b"double z") + b"end_header\n1 1 1\n", "must have x, y and z"),
        ("a.ply", HEADER + XYZ.replace(b"float", b"int") + b"end_header\n1 1 1\n", "must have x, y and z"),
        (
            "a.ply",
            HEADER + XYZ.replace(b"float z", b"real z") + b"end_header\n1 1 1\n",
            "line 6: .* no element or property",
        ),
        ("a.ply", HEADER + XYZ + b"end_header\n0 0\n", "line 8: a vertex must have three"),
        ("a.ply", HEADER + XYZ + b"end_header\n0 0 0\n", "it has no faces"),
        ("a.ply", ply("<")[0][:-1], "it ends before its last vertex or face"),
        ("a.ply", ply(">")[0][:-90], "it ends before its last vertex or face"),
    ],
)
def test_errors_name_the_file_and_the_place(tmp_path, name, data, error):
    path = write(tmp_path, name, data)
    with pytest.raises(ValueError, match=f"^{re.escape(path)}: .*{error}"):
        MeshFile(path)


def test_errors_of_the_name(tmp_path):
    with pytest.raises(
        ValueError, match=r"a\.gltf: the name of a mesh file must end in \.glb, \.obj, \.off, \.ply, \.stl"
    ):
        MeshFile(str(tmp_path / "a.gltf"))
    with pytest.raises(FileNotFoundError, match=r"a\.obj: No such file"):
        MeshFile(str(tmp_path / "a.obj"))


@pytest.mark.parametrize("name", NAMES)
def test_files_cut_off_or_with_other_bytes_are_read_or_refused(tmp_path, name):
    """Never another error than those that are announced."""
    data, random = exported(name), np.random.default_rng(2)
    path = tmp_path / name
    for trial in range(150):
        if trial % 3:
            broken = bytearray(data)
            for place in random.integers(0, len(data) if trial % 2 else 400, 3):
                broken[place] = random.integers(0, 256)
        else:
            broken = data[: random.integers(0, len(data))]
        path.write_bytes(broken)
        try:
            mesh = MeshFile(str(path))
        except ValueError:
            continue
        assert np.isfinite(mesh.x[mesh.faces]).all() and mesh.with_positions(mesh.x) == bytes(broken)
