"""Replays files of USD that are broken at random, in their structure or in their bytes, and looks for what must not be.

``python tests/support/fuzz_usd.py --count 10000 --seed 1`` makes files one after the other from small scenes (a falling
triangle, a skinned mesh, instances, curves, points, shapes): values, types, names, paths, times, arrays, references and
nesting of the text change, or bytes of the crate. ``warp-bsc replay`` reads each with ``--report``, ``--overlay`` and
``--json``, in processes of its own. The program prints what it finds, with the seed that makes the file, and ends with
status 1 if there is something:

- an error that nobody foresaw (it names a line of the package), a traceback, or an exit status that is not documented,
- a process that dies, or takes more than ``--limit`` seconds for one file; where that is while OpenUSD alone opens the
  file, it is only counted,
- a page with a name or text of the file as markup, or a file outside of the output folder.

``--keep FOLDER`` keeps the files of what is found, ``--only NUMBER`` makes one file again.
"""

import argparse
import collections
import contextlib
import io
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

MARKUP = "</script><b id=fuzzed>"
NAMES = (MARKUP, "]]>", "../../outside", "a\\u0007b", "é\\n", '\\"', "x" * 3000, "${HOME}", "%s%n", "")
NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e39",
    "-1e308",
    "1e-45",
    "-1",
    "0",
    "2147483648",
    "1e15",
    "",
    "None",
    '"x"',
    "(1, 2)",
)
TYPES = (
    "point3f[]",
    "point3d[]",
    "float[]",
    "int[]",
    "int",
    "string",
    "token",
    "double3",
    "matrix4d",
    "rel",
    "half3[]",
)
SCHEMAS = (
    "Mesh",
    "Xform",
    "Cube",
    "Sphere",
    "Capsule",
    "Points",
    "BasisCurves",
    "PointInstancer",
    "Skeleton",
    "SkelRoot",
    "TetMesh",
)
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
HEADER = '#usda 1.0\n(\n    defaultPrim = "World"\n    startTimeCode = 0\n    endTimeCode = 2\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n'
SCENES = (
    """def Xform "World" {
    def Mesh "A" (
        kind = "component"
    ) {
        point3f[] points.timeSamples = { 0: [(0, 0, 1), (1, 0, 1), (0, 1, 1)], 1: [(0, 0, -1), (1, 0, -1), (0, 1, -1)], 2: [(0, 0, 1), (1, 0, 1), (0, 1, 1)] }
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
        uniform matrix4d[] bindTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 1, 1))]
        uniform matrix4d[] restTransforms = [((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 1, 1))]
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
)


def mutated_text(rng, path):
    """Returns the text of a scene with some changes of its structure."""
    lines = (HEADER + rng.choice(SCENES)).splitlines()
    for _ in range(rng.choice((1, 1, 2, 3, 6))):
        number = rng.randrange(1, len(lines))
        line, kind = lines[number], rng.randrange(11)
        name = rng.choice(NAMES)
        if kind <= 2:  # numbers
            places = list(re.finditer(r"-?\d+(\.\d+)?", line))
            if places:
                at = rng.choice(places)
                lines[number] = line[: at.start()] + rng.choice(NUMBERS) + line[at.end() :]
        elif kind == 3:  # arrays: an element less, an array many times over, or empty
            once, copies = re.search(r"\[(.*)\]", line), rng.choice((2, 400))
            if once:
                inner = rng.choice((once[1].partition(",")[2], ", ".join(copies * [once[1]]), ""))
                lines[number] = f"{line[: once.start()]}[{inner}]{line[once.end() :]}"
        elif kind == 4:  # lines
            lines[number : number + 1] = rng.choice(([], 2 * [line], [lines[rng.randrange(1, len(lines))], line]))
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
        else:  # layers
            lines[1:2] = [
                "(",
                rng.choice(
                    (
                        f"subLayers = [@{path.name}@]",
                        "timeCodesPerSecond = 0",
                        "timeCodesPerSecond = nan",
                        "subLayers = [@./no.usd@ (scale = 0)]",
                    )
                ),
            ]
    return "\n".join(lines)


def write_file(number, seed, folder):
    """Writes the file of a number, and returns its path."""
    from pxr import Sdf

    rng = random.Random(f"{seed} {number}")
    path = folder / f"f{number}.usda"
    path.write_text(mutated_text(rng, path), encoding="utf-8", errors="surrogateescape")
    if rng.random() < 0.35:
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        with contextlib.suppress(Exception):
            if rng.random() < 0.7:
                layer.ImportFromString(HEADER + rng.choice(SCENES))
            else:
                layer.Import(str(path))
        crate = path.with_suffix(".usdc")
        layer.Export(str(crate))
        data = bytearray(crate.read_bytes())
        for _ in range(rng.choice((1, 2, 5, 20))):
            at = rng.randrange(len(data))
            kind = rng.randrange(4)
            if kind == 0:
                data[at] ^= 1 << rng.randrange(8)
            elif kind == 1:
                data[at : at + 8] = rng.choice((bytes(8), bytes(8 * [255]), rng.randbytes(8)))
            elif kind == 2 and len(data) > 200:
                del data[at : at + rng.choice((1, 8, 64))]
            else:
                data[at:at] = data[: rng.choice((1, 8, 64))]
        if rng.random() < 0.1:
            del data[rng.randrange(len(data)) :]
        crate.write_bytes(data)
        path.unlink()
        return crate
    return path


def check(path, output):
    """Replays a file, and returns the exit status, and what must not be, in words; empty if all is well."""
    from warp_bsc.cli.main import main

    page, overlay = output / "page.html", output / "overlay.usda"
    command = ["replay", str(path), "--report", str(page), "--overlay", str(overlay), "--json", "--device", "cpu"]
    before = {item for item in path.parents[1].rglob("*") if output not in item.parents}
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = main(command)
    printed = err.getvalue()
    problems = []
    if status not in (0, 2, 4):
        problems.append(f"exit status {status}")
    if found := re.search(r"\(\w+\.py:\d+\)|Traceback.*", printed + out.getvalue()):
        problems.append(f"unforeseen: {printed.strip()[-300:] or found[0]}")
    if status == 2 and not printed.strip():
        problems.append("status 2 without a word")
    if page.exists() and MARKUP in page.read_text():
        problems.append("the page has markup of the file")
    if strange := {item for item in path.parents[1].rglob("*") if output not in item.parents} - before:
        problems.append(f"files outside of the output folder: {sorted(map(str, strange))}")
    for file in output.iterdir():
        file.unlink()
    return status, "; ".join(problems)


def work(options):
    """Makes and checks files, and prints a line before and after each."""
    import warp as wp
    from pxr import Usd

    wp.config.log_level = wp.LOG_WARNING
    with tempfile.TemporaryDirectory() as temporary:
        folder, output = Path(temporary, "in"), Path(temporary, "out")
        folder.mkdir()
        output.mkdir()
        for number in range(options.first, options.first + options.count):
            print(f"begin {number}", flush=True)
            path = write_file(number, options.seed, folder)
            with contextlib.suppress(Exception):
                Usd.Stage.Open(str(path))
            print(f"opened {number}", flush=True)
            status, problem = check(path, output)
            if problem and options.keep:
                Path(options.keep).mkdir(parents=True, exist_ok=True)
                Path(options.keep, path.name).write_bytes(path.read_bytes())
            print(f"end {number} {status} {problem}", flush=True)
            path.unlink()


def watch(first, stop, options, found, statuses):
    """Runs a process on some numbers, and another one behind each number that ends it."""
    while first < stop:
        command = [sys.executable, __file__, "--worker", "--first", str(first), "--count", str(stop - first)]
        command += ["--seed", str(options.seed), *(["--keep", options.keep] if options.keep else [])]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None and process.stderr is not None
        since, stuck = [time.monotonic(), True], []

        def guard(process=process, since=since, stuck=stuck):
            while process.poll() is None:
                if time.monotonic() - since[0] > (options.limit if not since[1] else 300.0):
                    stuck.append(True)
                    process.kill()
                time.sleep(0.2)

        threading.Thread(target=guard, daemon=True).start()
        errors = []
        reader = threading.Thread(target=lambda p=process, e=errors: e.append(p.stderr.read()), daemon=True)
        reader.start()
        running, is_open = None, True
        for line in process.stdout:
            word, number, *rest = line.rstrip("\n").split(" ", 3)
            if word in ("begin", "opened"):
                running, is_open = int(number), word == "opened"
                since[0] = time.monotonic()
            elif word == "end":
                since[0], since[1], running, first = time.monotonic(), False, None, int(number) + 1
                statuses[rest[0]] += 1
                if rest[1]:
                    found.append((int(number), rest[1]))
                    print(f"{number}: {rest[1]}", flush=True)
        process.wait()
        reader.join()
        if first < stop:
            number = first if running is None else running
            first = number + 1
            if not is_open:
                statuses["OpenUSD"] += 1
                continue
            text = (
                f"takes more than {options.limit:g} s"
                if stuck
                else f"dies with {process.returncode}: {errors[0][-300:]}"
            )
            found.append((number, text))
            print(f"{number}: {text}", flush=True)


def main():
    """Checks all files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=20.0, help="seconds for a file")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--keep")
    parser.add_argument("--only", type=int)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only is not None:
        options.first, options.count, options.jobs = options.only, 1, 1
    if options.worker:
        work(options)
        return 0
    found: list[tuple[int, str]] = []
    statuses: collections.Counter[str] = collections.Counter()
    stop = options.first + options.count
    bounds = [options.first + options.count * i // options.jobs for i in range(options.jobs)] + [stop]
    threads = [
        threading.Thread(target=watch, args=(*pair, options, found, statuses)) for pair in zip(bounds, bounds[1:])
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    counts = ", ".join(f"{count:,} with {status}" for status, count in sorted(statuses.items()))
    print(f"{options.count:,} files, by exit status: {counts}; {len(found)} with a problem")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
