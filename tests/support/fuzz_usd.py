"""Replays files of USD that are broken at random, in their structure or in their bytes, and looks for what must not be.

``python tests/support/fuzz_usd.py --count 10000 --seed 1`` makes files one after the other from small scenes (a falling
triangle, a skinned mesh, instances, curves, points, shapes, tetrahedra): values, types, names, paths, times, arrays,
references and nesting of the text change, or bytes of the crate. ``warp-bsc replay`` reads each with ``--report``,
``--overlay`` and ``--json``. The program prints what it finds, with the number that makes the file again (``--first
NUMBER --count 1``), and ends with status 1 if there is something:

- an error that nobody foresaw (it names a line of the package), a traceback, or an exit status that is not documented,
- a process that dies, or takes more than ``--limit`` seconds for one file,
- a page with a name of the file as markup, or a file outside of the output folder.

OpenUSD itself dies of some crates, or reads them forever: each file is first read by OpenUSD alone, and one at which
the process ends there, or that takes a tenth of the limit, is only counted.
"""

import argparse
import collections
import contextlib
import faulthandler
import io
import random
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pxr import Sdf, Usd

from warp_bsc.cli.main import main as replay

MARKUP = "</script><b id=fuzzed>"
NAMES = (MARKUP, "]]>", "../../outside", "a\\u0007b", "é\\n", '\\"', "x" * 3000, "${HOME}", "%s%n", "")
NUMBERS = 'nan|inf|-inf|1e39|-1e308|1e-45|-1|0|2147483648|1e15||None|"x"|(1, 2)'.split("|")  # noqa: SIM905
TYPES = "point3f[] point3d[] float[] int[] int3[] int4[] int string token double3 matrix4d rel half3[]".split()  # noqa: SIM905
SCHEMAS = "Mesh Xform Cube Sphere Capsule Points BasisCurves PointInstancer Skeleton SkelRoot TetMesh".split()  # noqa: SIM905
ARCS = (
    "references = @{file}@</World>",
    "references = </World>",
    "payload = @./missing.usda@",
    "inherits = </World>",
    "specializes = </Missing>",
    "references = [@{file}@</World/A>, </World/B>, @@]",
    "instanceable = true",
    "active = false",
    'kind = "{name}"',
    'doc = """{name}"""',
    'displayName = "{name}"',
    'customData = {{ string a = "{name}" }}',
)
LAYERS = (
    "subLayers = [@{file}@]",
    "timeCodesPerSecond = 0",
    "timeCodesPerSecond = nan",
    "subLayers = [@./no.usd@ (scale = 0)]",
)
HEADER = """#usda 1.0
(
    defaultPrim = "World"
    startTimeCode = 0
    endTimeCode = 2
    metersPerUnit = 1
    upAxis = "Z"
)
"""
SCENES = (
    """def Xform "World" {
    def Mesh "A" (
        kind = "component"
    ) {
        point3f[] points.timeSamples = {
            0: [(0, 0, 1), (1, 0, 1), (0, 1, 1)],
            1: [(0, 0, -1), (1, 0, -1), (0, 1, -1)],
            2: [(0, 0, 1), (1, 0, 1), (0, 1, 1)],
        }
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        normal3f[] normals = [(0, 0, 1)] (
            interpolation = "constant"
        )
    }
    def Mesh "B" {
        point3f[] points = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 2: (0, 0, 0.5) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
""",
    """def Xform "World" {
    def Xform "A" {
        def Cube "C" {
            double size = 1
        }
        float xformOp:rotateX.timeSamples = { 0: 0, 2: 170 }
        uniform token[] xformOpOrder = ["xformOp:rotateX"]
    }
    def PointInstancer "B" {
        point3f[] positions.timeSamples = { 0: [(0, 0, 1), (2, 0, 0)], 2: [(0, 0, -1), (2, 0, 0)] }
        int[] protoIndices = [0, 0]
        int64[] invisibleIds = []
        rel prototypes = [</World/A>]
    }
    def BasisCurves "D" {
        point3f[] points.timeSamples = { 0: [(0, 0, 2), (0, 0, -2)], 2: [(1, 0, 2), (1, 0, -2)] }
        int[] curveVertexCounts = [2]
        uniform token type = "linear"
        float[] widths = [0.1, 0.1]
    }
    def Points "E" {
        point3f[] points.timeSamples = { 0: [(0, 0, 2)], 2: [(0, 0, -2)] }
        float[] widths = [0.1]
    }
}
""",
    """def SkelRoot "World" {
    def Skeleton "A" (
        prepend apiSchemas = ["SkelBindingAPI"]
    ) {
        uniform token[] joints = ["a", "a/b"]
        uniform matrix4d[] bindTransforms = [
            ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
            ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 1, 1)),
        ]
        uniform matrix4d[] restTransforms = [
            ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
            ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 1, 1)),
        ]
        rel skel:animationSource = </World/A/C>
        def SkelAnimation "C" {
            uniform token[] joints = ["a", "a/b"]
            quatf[] rotations.timeSamples = { 0: [(1, 0, 0, 0), (1, 0, 0, 0)], 2: [(1, 0, 0, 0), (0, 1, 0, 0)] }
            float3[] translations = [(0, 0, 0), (0, 0, 1)]
            half3[] scales = [(1, 1, 1), (1, 1, 1)]
        }
    }
    def Mesh "B" (
        prepend apiSchemas = ["SkelBindingAPI"]
    ) {
        point3f[] points = [(0, 0, 0), (1, 0, 1), (0, 1, 2), (1, 1, 2)]
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 1, 3, 2]
        int[] primvars:skel:jointIndices = [0, 1, 1, 1] (
            elementSize = 1
            interpolation = "vertex"
        )
        float[] primvars:skel:jointWeights = [1, 1, 1, 1] (
            elementSize = 1
            interpolation = "vertex"
        )
        rel skel:skeleton = </World/A>
    }
}
""",
    """def Xform "World" {
    def TetMesh "A" {
        int4[] tetVertexIndices = [(0, 1, 2, 3)]
        int3[] surfaceFaceVertexIndices = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
        uniform token orientation = "rightHanded"
        point3f[] points.timeSamples = {
            0: [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
            2: [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, -1)],
        }
    }
    def TetMesh "B" {
        int4[] tetVertexIndices = [(0, 1, 2, 3), (1, 2, 3, 4)]
        point3f[] points = [(0, 0, 0.5), (1, 0, 0.5), (0, 1, 0.5), (0, 0, 2), (1, 1, 2)]
    }
}
""",
)


def mutated_text(rng, path):
    """Returns the text of a scene with some changes of its structure."""
    lines = (HEADER + rng.choice(SCENES)).splitlines()
    for _ in range(rng.choice((1, 1, 2, 3, 6))):
        number = rng.randrange(1, len(lines))
        line, kind, name = lines[number], rng.randrange(11), rng.choice(NAMES)
        if kind <= 2:  # numbers
            if places := list(re.finditer(r"-?\d+(\.\d+)?", line)):
                at = rng.choice(places)
                lines[number] = line[: at.start()] + rng.choice(NUMBERS) + line[at.end() :]
        elif kind == 3:  # arrays: an element less, an array many times over, or empty
            once, copies = re.search(r"\[(.*)\]", line), rng.choice((2, 400))
            if once:
                inner = rng.choice((once[1].partition(",")[2], ", ".join(copies * [once[1]]), ""))
                lines[number] = f"{line[: once.start()]}[{inner}]{line[once.end() :]}"
        elif kind == 4:  # lines
            lines[number : number + 1] = rng.choice(([], 2 * [line], [rng.choice(lines), line]))
        elif kind == 5:  # types
            lines[number] = re.sub(r"\b\w+(\[\])? (?=[\w:.]+ =)", f"{rng.choice(TYPES)} ", line, count=1)
        elif kind == 6:  # schemas and names of prims
            lines[number] = re.sub(r"def \w+", f"{rng.choice(('def', 'over', 'class'))} {rng.choice(SCHEMAS)}", line)
            if rng.random() < 0.3:
                lines[number] = re.sub(r'"\w+"', lambda _, name=name: f'"{name}"', lines[number])
        elif kind == 7:  # metadata and arcs of prims
            arc = rng.choice(ARCS).format(file=path.name, name=name)
            if head := re.match(r'\s*def \w+ "\w+"', line):
                lines[number] = f"{head[0]} (\n{arc}\n) {{" if line.endswith("{") else f"{line}\n{arc}"
        elif kind == 8:  # tokens and targets
            if place := re.search(r'"[\w:]+"|</[\w/]+>', line):
                new = rng.choice((f'"{name}"', "</World/B>", "</World>", "</Nothing>"))
                lines[number] = line[: place.start()] + new + line[place.end() :]
        elif kind == 9:  # nesting
            depth = rng.choice((3, 60))
            lines[number:number] = ["}" * (number > 9)] + ['def Xform "N" {'] * depth + ["}"] * depth
        else:
            lines[1:2] = ["(", rng.choice(LAYERS).format(file=path.name)]
    return "\n".join(lines)


def write_text(rng, path):
    """Writes a text file, and returns its path."""
    path.write_text(mutated_text(rng, path), encoding="utf-8")
    return path


def write_crate(rng, path):
    """Writes a crate with some bytes that are others, more or fewer, and returns its path."""
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    with contextlib.suppress(Exception):
        layer.ImportFromString(HEADER + rng.choice(SCENES))
    layer.Export(str(path))
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 2, 5, 20))):
        at, kind = rng.randrange(len(data)), rng.randrange(4)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at : at + 8] = rng.choice((bytes(8), bytes(8 * [255]), rng.randbytes(8)))
        elif kind == 2 and len(data) > 200:
            del data[at : at + rng.choice((1, 8, 64))]
        else:
            data[at:at] = data[: rng.choice((1, 8, 64))]
    path.write_bytes(data[: rng.randrange(len(data))] if rng.random() < 0.1 else data)
    return path


def check(path, output):
    """Replays a file, and returns the exit status, and what must not be, in words; empty if all is well."""
    page, overlay = output / "page.html", output / "overlay.usda"
    command = ["replay", str(path), "--report", str(page), "--overlay", str(overlay), "--json", "--device", "cpu"]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = replay(command)
    printed, problems = err.getvalue(), []
    if status not in (0, 2, 4, 5):
        problems.append(f"exit status {status}")
    found = re.search(r"\(\w+\.py:\d+\)|Traceback.*", printed + out.getvalue())
    if found and "No to_python (by-value) converter found" not in printed:  # OpenUSD prints that one itself
        problems.append(f"unforeseen: {printed.strip()[-300:] or found[0]}")
    if status == 2 and not printed.strip():
        problems.append("status 2 without a word")
    if page.exists() and MARKUP in page.read_text():
        problems.append("the page has markup of the file")
    if strange := {*path.parent.rglob("*")} - {path, output, page, overlay}:
        problems.append(f"other files: {sorted(map(str, strange))}")
    for file in output.iterdir():
        file.unlink()
    return status, "; ".join(problems)


def read_alone(path):
    """Reads all values of a file by OpenUSD alone."""
    with contextlib.suppress(Exception):
        for prim in Usd.Stage.Open(str(path)).TraverseAll():
            for attribute in prim.GetAttributes():
                attribute.Get(attribute.GetTimeSamples()[-1] if attribute.GetTimeSamples() else Usd.TimeCode.Default())


def work(options):
    """Makes and checks files, with a line in the log for each."""
    with tempfile.TemporaryDirectory() as folder, open(options.log, "ab", buffering=0) as log:
        output = Path(folder, "out")
        output.mkdir()
        faulthandler.enable()
        for number in range(options.first, options.first + options.count):
            rng = random.Random(f"{options.seed} {number}")
            write, ending = (write_crate, "usdc") if rng.random() < 0.35 else (write_text, "usda")
            path = write(rng, Path(folder, f"f{number}.{ending}"))
            # the first file may compile kernels
            faulthandler.dump_traceback_later(options.limit if number > options.first else 600.0, exit=True)
            log.write(b"%d OpenUSD " % number)
            started = time.perf_counter()
            read_alone(path)
            if time.perf_counter() - started < 0.1 * options.limit:
                log.write(b"dies ")
                status, problem = check(path, output)
                log.write(b"%d %s" % (status, b"bad" if problem else b"good"))
                if problem:
                    print(f"{number}: {problem}", flush=True)
            faulthandler.cancel_dump_traceback_later()
            log.write(b"\n")
            path.unlink()


def main():
    """Checks all files in a process, and in another one behind each number that ends it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=20.0, help="seconds for a file")
    parser.add_argument("--log", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.log:
        work(options)
        return 0
    first, stop = options.first, options.first + options.count
    statuses, bad = collections.Counter(), 0
    while first < stop:
        with tempfile.NamedTemporaryFile("r") as log:
            command = [sys.executable, __file__, "--log", log.name, "--seed", str(options.seed)]
            command += ["--limit", str(options.limit), "--first", str(first), "--count", str(stop - first)]
            process = subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True)
            lines = [line.split() for line in log]
        for number, *words in lines:
            first = int(number) + 1
            statuses[" ".join(words[2:3] or words[-1:])] += 1
            bad += words[-1] == "bad"
        if process.returncode and (not lines or lines[-1][-1] == "dies"):
            print(f"{first - 1}: ends with {process.returncode}: {process.stderr[-2000:]}", flush=True)
            bad += 1
            first += not lines
    counts = ", ".join(f"{count:,} with {status}" for status, count in sorted(statuses.items()))
    print(f"{options.count:,} files, by exit status: {counts}; {bad} with a problem")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
