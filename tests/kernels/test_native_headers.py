"""The C++ headers of native functions: formatted, used, and compiled by Warp's own compiler with its warnings."""

import re
import subprocess
from pathlib import Path

import pytest
import warp as wp

from warp_bsc.kernels import native_text
from warp_bsc.kernels.exact.filters import near_signs_at_roots
from warp_bsc.kernels.exact.polygon import make_narrow_polygon
from warp_bsc.kernels.exact.wide_integers import minor, scaled_like
from warp_bsc.kernels.pipeline.batch_arc_culling import cull_arc_batch_of
from warp_bsc.kernels.pipeline.batch_classification import classify_batch_of
from warp_bsc.kernels.pipeline.batch_culling import cull_batch_of
from warp_bsc.kernels.pipeline.batch_impacts import impact_batch_of
from warp_bsc.kernels.pipeline.wide_bvh import fit_packet_of, pair_packet_of

ROOT = Path(__file__).parents[2]
HEADERS = {path.relative_to(ROOT).as_posix(): path.read_text() for path in sorted((ROOT / "kernels").rglob("*.h"))}
OTHERS = [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "warp_bsc").rglob("*.h"))]  # need our structs
OF_PAIRS = (cull_batch_of, cull_arc_batch_of, classify_batch_of, impact_batch_of)
WARNINGS = """
#pragma clang diagnostic error "-Wall"
#pragma clang diagnostic ignored "-Wunused-variable"
#pragma clang diagnostic ignored "-Wunused-local-typedef"
"""  # not every function uses all that a header defines


def native_functions():
    """All native functions that headers make, with every type and number of limbs."""
    types = (wp.vec3, wp.vec3d)
    functions = [make(dtype, is_face) for make in OF_PAIRS for dtype in types for is_face in (False, True)]
    options = [{"symmetric": flag, "ordered": flag, "at_end": not flag} for flag in (False, True)]
    corners = {"corners": 2, "other_corners": 3, "queued": 0, "filtered": 1}
    functions += [pair_packet_of(**corners, **flags) for flags in options]
    functions += [*map(fit_packet_of, types), make_narrow_polygon, near_signs_at_roots, minor, scaled_like]
    return [overload for function in functions for overload in function.user_overloads.values()]


def compile_functions(functions, path):
    """Compiles native functions as Warp does, but that each header is named in errors; raises an error if it fails."""
    codegen = wp._src.codegen
    source = codegen.cpu_module_header.format(block_dim=1)
    arguments = [argument.type for function in functions for argument in function.adj.args]
    structs = dict.fromkeys(each for each in arguments if hasattr(each, "native_name"))
    source += "".join(map(codegen.codegen_struct, structs)) + WARNINGS
    for number, function in enumerate(functions):
        snippet = function.native_snippet
        for name, text in HEADERS.items():
            snippet = snippet.replace(text, f'#line 1 "{name}"\n{text}')
        function.build(None)
        text = codegen.codegen_snippet(function.adj, f"native_{number}", snippet, None, None, forward_only=True)
        source += text.replace("static", "", 1)  # used by nobody here
    path.write_text(source)
    wp._src.build.build_cpu(str(path.with_suffix(".o")), str(path), optimization_level=0)


def test_each_header_is_compiled_without_a_warning(tmp_path):
    functions = native_functions()
    unused = [name for name, text in HEADERS.items() if not any(text in each.native_snippet for each in functions)]
    assert HEADERS and not unused
    compile_functions(functions, tmp_path / "functions.cpp")


def test_a_warning_of_the_compiler_is_an_error(tmp_path, capfd):
    @wp.func_native(HEADERS["kernels/pipeline/native/fit_packet.h"] + "if (count = 1) return;")
    def doubtful(packet: int, count: int): ...

    with pytest.raises(Exception, match="build failed"):
        compile_functions([doubtful], tmp_path / "doubtful.cpp")
    assert "kernels/pipeline/native/fit_packet.h:" in capfd.readouterr().err


@pytest.mark.parametrize("path", [*HEADERS, *OTHERS])
def test_headers_are_formatted(path):
    clang_format = pytest.importorskip("clang_format")
    command = [clang_format.get_executable("clang-format"), "--dry-run", "--Werror", path]
    run = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert run.returncode == 0, run.stderr


def test_definitions_are_what_cpp_reads():
    text = native_text.definitions({"Scalar": "float"}, vertex_face=True, rounds=4, tiny=2.0**-1074, small=0.1)
    lines = re.findall(r"(?:using|constexpr auto) (\w+) = (\S+);\n", text)
    assert lines[0] == ("Scalar", "float")
    assert lines[1:3] == [("vertex_face", "true"), ("rounds", "4")]
    assert [float(value) for _, value in lines[3:]] == [2.0**-1074, 0.1]
