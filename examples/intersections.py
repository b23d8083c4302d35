"""Asks this package and other tools whether small meshes intersect themselves, and compares with exact arithmetic.

    python examples/intersections.py                            # the answers of all tools that are installed
    python examples/intersections.py --triangles 10240 40960    # also times, of two spheres of so many triangles

Every mesh is made in ``intersection_cases.py``, with the right answer, which ``warp_bsc.checker`` confirms in rational
arithmetic. It is asked six times, as it is and with axes, vertices and faces in another order; all answers should be
the same. Tools that are not installed are left out: ``pip install cgal ipctk libigl meshlib open3d pymeshfix pymeshlab
pyvista python-fcl scipy trimesh trueform`` brings them. Each runs in a process of its own, on positions in double
precision if it takes these, and is called as its function below says.
"""

import argparse
import importlib
import json
import math
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp
from intersection_cases import (
    Case,
    cases_by_definition,
    definite_cases,
    parts_of,
    sphere,
    together,
    true_pairs,
    variants,
)
from rich.console import Console
from rich.table import Table

import warp_bsc as bsc
from warp_bsc._atomic_file import OutputFile
from warp_bsc.bench.record import version_of, with_record

Query = Callable[[], bool]
"""Returns whether a mesh intersects itself."""
REPEATS, LONG = 3, 20.0
"""How often a time is measured, the least counts; and after how many seconds a tool is asked about no larger mesh."""

# Tools: each function makes a mesh of positions and faces, and returns the query, None if it cannot hold that mesh. ---


def ask_warp_bsc(x: np.ndarray, faces: np.ndarray) -> Query:
    """``CollisionDetector.has_intersections``."""
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, len(x)))
    return lambda: detector.has_intersections(x)


def ask_cgal(x: np.ndarray, faces: np.ndarray) -> Query | None:
    """``Polygon_mesh_processing::does_self_intersect`` of a polyhedron, which must be a manifold."""
    processing = importlib.import_module("CGAL.CGAL_Polygon_mesh_processing")
    make_point = importlib.import_module("CGAL.CGAL_Kernel").Point_3
    points, polygons = processing.Point_3_Vector(), processing.Polygon_Vector()
    for point in x.tolist():
        points.append(make_point(*point))
    for face in faces.tolist():
        corners = processing.Int_Vector()
        for corner in face:
            corners.append(corner)
        polygons.append(corners)
    processing.orient_polygon_soup(points, polygons)
    if len(points) != len(x):  # it duplicates vertices of what is no manifold
        return None
    mesh = importlib.import_module("CGAL.CGAL_Polyhedron_3").Polyhedron_3()
    processing.polygon_soup_to_polygon_mesh(points, polygons, mesh)
    return lambda: processing.does_self_intersect(mesh)


def ask_ipc_toolkit(x: np.ndarray, faces: np.ndarray) -> Query:
    """``has_intersections`` with its default broad phase."""
    ipctk = importlib.import_module("ipctk")
    positions, corners = np.asfortranarray(x), np.asfortranarray(faces, dtype=np.int32)
    mesh = ipctk.CollisionMesh(positions, ipctk.edges(corners), corners)
    return lambda: ipctk.has_intersections(mesh, positions)


def ask_libigl(x: np.ndarray, faces: np.ndarray) -> Query:
    """``igl::copyleft::cgal::remesh_self_intersections`` that only detects, to the first pair."""
    cgal, corners = importlib.import_module("igl.copyleft.cgal"), faces.astype(np.int64)
    options = {"detect_only": True, "first_only": True}
    return lambda: len(cgal.remesh_self_intersections(x, corners, **options)[2]) > 0


def ask_meshfix(x: np.ndarray, faces: np.ndarray) -> Query | None:
    """``select_intersecting_triangles``, if it has loaded all triangles without a change."""
    mesh = importlib.import_module("pymeshfix").PyTMesh()
    mesh.set_quiet(True)
    mesh.load_array(x, faces.astype(np.int32))
    is_whole = mesh.n_faces == len(faces) and mesh.n_points == len(np.unique(faces))
    return (lambda: len(mesh.select_intersecting_triangles()) > 0) if is_whole else None


def ask_meshlib(x: np.ndarray, faces: np.ndarray) -> Query | None:
    """``findSelfCollidingTriangles`` with touching as an intersection, if it has loaded all triangles."""
    meshlib = importlib.import_module("meshlib.mrmeshpy")
    make = importlib.import_module("meshlib.mrmeshnumpy").meshFromFacesVerts
    mesh = make(faces.astype(np.int32), x.astype(np.float32))
    counts = mesh.topology.numValidFaces(), mesh.topology.numValidVerts()
    if counts != (len(faces), len(np.unique(faces))):
        return None
    return lambda: len(meshlib.findSelfCollidingTriangles(meshlib.MeshPart(mesh), touchIsIntersection=True)) > 0


def ask_open3d(x: np.ndarray, faces: np.ndarray) -> Query:
    """``TriangleMesh.is_self_intersecting``."""
    open3d = importlib.import_module("open3d")
    arrays = open3d.utility.Vector3dVector(x), open3d.utility.Vector3iVector(faces.astype(np.int32))
    return open3d.geometry.TriangleMesh(*arrays).is_self_intersecting


def ask_pymeshlab(x: np.ndarray, faces: np.ndarray) -> Query:
    """``compute_selection_by_self_intersections_per_face``: whether it selects a face."""
    pymeshlab = importlib.import_module("pymeshlab")
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(x, faces.astype(np.int32)))

    def query() -> bool:
        meshes.compute_selection_by_self_intersections_per_face()
        return meshes.current_mesh().selected_face_number() > 0

    return query


def ask_trimesh(x: np.ndarray, faces: np.ndarray) -> Query | None:
    """``CollisionManager.in_collision_internal`` of the parts of the mesh, as FCL compares objects."""
    trimesh = importlib.import_module("trimesh")
    parts = [trimesh.Trimesh(x, part, process=False) for part in parts_of(faces)]

    def query() -> bool:
        manager = trimesh.collision.CollisionManager()
        for number, part in enumerate(parts):
            manager.add_object(str(number), part)
        return manager.in_collision_internal()

    return query if len(parts) > 1 else None


def ask_trueform(x: np.ndarray, faces: np.ndarray) -> Query:
    """``has_self_intersections``."""
    trueform = importlib.import_module("trueform")
    mesh = trueform.Mesh(faces.astype(np.int32), np.ascontiguousarray(x))
    return lambda: trueform.has_self_intersections(mesh)


def ask_vtk(x: np.ndarray, faces: np.ndarray) -> Query | None:
    """``vtkCollisionDetectionFilter`` by PyVista's ``collision``, of a mesh of two parts, as it compares two."""
    pyvista, parts = importlib.import_module("pyvista"), parts_of(faces)
    if len(parts) != 2:
        return None
    first, second = (pyvista.PolyData.from_regular_faces(x, part) for part in parts)
    return lambda: first.collision(second)[1] > 0


@dataclass(frozen=True)
class Tool:
    """A tool that says whether a mesh intersects itself.

    Attributes:
        title: Its name in the table.
        distributions: Its names on PyPI, the first of which that is installed counts.
        ask: Its function above.
        dtype: Type of its positions.
        beside: A distribution that it calls for this.
    """

    title: str
    distributions: tuple[str, ...]
    ask: Callable[[np.ndarray, np.ndarray], Query | None]
    dtype: type = np.float64
    beside: str | None = None

    @property
    def version(self) -> str | None:
        """Its version, None if it is not installed."""
        found = next(filter(None, map(version_of, self.distributions)), None)
        return f"{found} with {self.beside} {version_of(self.beside)}" if found and self.beside else found


TOOLS = {
    tool.title: tool
    for tool in (
        Tool("warp-bsc", ("warp-bsc",), ask_warp_bsc),
        Tool("CGAL", ("cgal",), ask_cgal),
        Tool("IPC Toolkit", ("ipctk",), ask_ipc_toolkit),
        Tool("libigl", ("libigl",), ask_libigl),
        Tool("MeshFix", ("pymeshfix",), ask_meshfix),
        Tool("MeshLib", ("meshlib",), ask_meshlib, np.float32),
        Tool("Open3D", ("open3d", "open3d-cpu"), ask_open3d),
        Tool("PyMeshLab", ("pymeshlab",), ask_pymeshlab),
        Tool("trimesh", ("trimesh",), ask_trimesh, beside="python-fcl"),
        Tool("trueform", ("trueform",), ask_trueform),
        Tool("VTK", ("vtk",), ask_vtk),
    )
}

# Questions ---------------------------------------------------------------------------------------------------------


def all_cases() -> list[Case]:
    """Returns all cases."""
    return [*definite_cases(), *cases_by_definition()]


def answers_of(title: str) -> list[list[bool] | None]:
    """Returns the answers of a tool to each case, as it is and in five other orders; None where it cannot be asked."""
    wp.config.log_level = wp.LOG_WARNING
    found = []
    for case in all_cases():
        queries = [TOOLS[title].ask(*variant) for variant in variants(case.x, case.faces)]
        found.append([bool(query()) for query in queries] if None not in queries else None)
    return found


def spheres(triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns a sphere, and a copy 0.99 times as large in it, of so many triangles together or somewhat more."""
    x, faces = sphere(math.ceil(math.log(triangles / 40, 4) - 1e-9))
    return together((x, faces), (0.99 * x, faces))


def time_of(title: str, triangles: int) -> dict[str, float] | None:
    """Returns how long a tool takes to say that spheres do not intersect [s], None if it says that they do.

    "total" is from the arrays to the answer, "query" without making the mesh of the tool, which is new each time.
    """
    wp.config.log_level = wp.LOG_WARNING
    x, faces = spheres(triangles)
    TOOLS[title].ask(*spheres(40))()  # loads kernels and libraries
    totals, queries = [], []
    while len(totals) < REPEATS and sum(totals) < LONG:
        start = time.perf_counter()
        query = TOOLS[title].ask(x, faces)
        made = time.perf_counter()
        if query():
            return None
        end = time.perf_counter()
        totals.append(end - start)
        queries.append(end - made)
    return {"total": min(totals), "query": min(queries)}


def run_apart(function: Callable, *arguments: object) -> object:
    """Returns what a function returns in a process of its own, None with a line if that ends."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except Exception as error:  # of any library
            print(f"{arguments[0]}: {type(error).__name__}: {error}")
            return None


def measure(sizes: list[int]) -> dict:
    """Returns the answers and times of all tools that are installed, as plain data; prints a line for each other."""
    tools, answers, times = {}, {}, {triangles: {} for triangles in sizes}
    for title, tool in TOOLS.items():
        found = run_apart(answers_of, title) if tool.version else None
        if found is None:
            print(f"{title} is left out: {'it failed' if tool.version else 'it is not installed'}")
            continue
        tools[title], answers[title] = tool.version, found
        for triangles in sizes:
            seconds = times[triangles][title] = run_apart(time_of, title, triangles)
            if seconds is None or seconds["total"] > LONG:
                break
    names = {case.name for case in definite_cases()}
    cases = []
    for i, case in enumerate(all_cases()):
        right = {dtype: len(true_pairs(case.x.astype(dtype), case.faces)) for dtype in (np.float64, np.float32)}
        assert all(case.pairs_of(dtype) == pairs for dtype, pairs in right.items()), case.name
        given = {title: found[i] for title, found in answers.items()}
        wrong = [title for title, found in given.items() if found and set(found) != {right[TOOLS[title].dtype] > 0}]
        case_found = {"name": case.name, "triangles": len(case.faces), "intersects": right[np.float64] > 0}
        cases.append(case_found | {"by_definition": case.name not in names, "answers": given, "wrong": wrong})
    rows = [{"triangles": len(spheres(size)[1]), "seconds": times[size]} for size in sizes]
    found = with_record({"benchmark": "intersections", "cases": cases, "times": rows}, sys.argv, [wp.get_device()])
    found["record"]["versions"] |= tools
    return found


# Tables ------------------------------------------------------------------------------------------------------------


def cell(answers: list[bool] | None) -> str:
    """Returns the answers to a case in a word; nothing if there are none."""
    if answers is None:
        return ""
    yes = sum(answers)
    return ("no", "yes")[answers[0]] if yes in (0, len(answers)) else f"yes {yes} of {len(answers)}"


def print_answers(found: dict, by_definition: bool, title: str) -> None:
    """Prints the answers to some cases, those that are wrong in red."""
    tools = found["cases"][0]["answers"]
    table = Table("", "right", *tools, title=title, title_justify="left", box=None, pad_edge=False)
    for case in found["cases"]:
        if case["by_definition"] == by_definition:
            wrong = () if by_definition else case["wrong"]
            words = [f"[bold red]{cell(a)}[/]" if t in wrong else cell(a) for t, a in case["answers"].items()]
            table.add_row(case["name"], ("no", "yes")[case["intersects"]], *words)
    Console(width=None if sys.stdout.isatty() else 160).print(table, "")


def main() -> int:
    """Asks all tools, and prints their answers; returns 1 if one of this package is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, nargs="+", default=[], help="sizes of the meshes that are timed")
    parser.add_argument("--json", metavar="FILE", help="file to which all answers are written as well")
    arguments = parser.parse_args()
    found = measure(arguments.triangles)
    print_answers(found, False, "Does it intersect itself? Wrong answers are red.")
    print_answers(found, True, "Touching, shared vertices, no area: definitions differ, the right answer is by ours.")
    if found["times"]:
        tools = found["cases"][0]["answers"]
        table = Table(
            "triangles",
            *tools,
            title="Seconds from arrays to the answer",
            title_justify="left",
            box=None,
            pad_edge=False,
        )
        for row in found["times"]:
            seconds = map(row["seconds"].get, tools)
            table.add_row(
                f"{row['triangles']:,}", *("" if time is None else f"{time['total']:.3g}" for time in seconds)
            )
        Console(width=None if sys.stdout.isatty() else 160).print(table)
    if arguments.json:
        file = OutputFile(arguments.json)
        try:
            file.write(json.dumps(found))
            file.commit()
        finally:
            file.discard()
    return int(any("warp-bsc" in case["wrong"] for case in found["cases"]))


if __name__ == "__main__":
    sys.exit(main())
