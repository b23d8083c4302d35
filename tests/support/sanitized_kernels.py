"""Warp kernels on the CPU under AddressSanitizer and UndefinedBehaviorSanitizer, compiled by the system's clang.

Warp writes a module of kernels as C++, with our native snippets in it, and compiles that with a clang of its own that
has no sanitizers. Here the same C++ goes to the system's clang and becomes a shared object, so that the first access
out of bounds, of an array of Warp or of a local one, or the first undefined operation ends the process with a report.
"""

import ctypes
import os
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import warp as wp

_FLAGS = [
    *("-std=c++17", "-O1", "-g", "-fPIC", "-shared", "-march=native", "-fms-extensions", "-fdeclspec", "-w"),
    *("-fsanitize=address,undefined", "-fno-sanitize=vptr,function", "-fno-sanitize-recover=all", "-shared-libasan"),
    *("-DWP_ENABLE_TILES_IN_STACK_MEMORY", "-DNDEBUG"),
]
_NATIVE = Path(wp.__file__).parent / "native"
_MARK = "WARP_BSC_SANITIZED"

SANITIZED = _MARK in os.environ
"""Whether this process has been started by :func:`restart_with_sanitizers`."""


def _find_clang() -> tuple[str, str] | None:
    """Returns the paths of a clang and of its sanitizers' shared runtime; None if there is none."""
    for name in ("clang++", *(f"clang++-{version}" for version in range(30, 15, -1))):
        clang = shutil.which(name)
        if clang:
            query = f"-print-file-name=libclang_rt.asan-{os.uname().machine}.so"
            runtime = subprocess.check_output([clang, query], text=True).strip()
            if Path(runtime).exists():
                return clang, runtime
    return None


def sanitizers_available() -> bool:
    """Returns whether kernels can be compiled with sanitizers here."""
    return sys.platform == "linux" and _find_clang() is not None


def restart_with_sanitizers() -> None:
    """Starts this run of pytest anew with the sanitizers' runtime, which must come before all other libraries."""
    clang, runtime = _find_clang()
    # Warp's own keys for kernels do not have this compiler
    key = zlib.crc32(" ".join([os.path.realpath(clang), *_FLAGS]).encode())
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / f"warp-bsc-sanitized-{key:08x}"
    environment = {
        "LD_PRELOAD": f"{runtime}:libstdc++.so.6",
        # Python keeps memory until its end, on purpose
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "WARP_CACHE_PATH": str(cache),
        _MARK: "1",
    }
    # pytest would keep the report of a sanitizer if it captured the file
    os.execve(sys.executable, [*sys.orig_argv, "--capture=sys"], {**os.environ, **environment})


def sanitize_kernels() -> None:
    """Compiles kernels for the CPU with sanitizers from now on, in a process of :func:`restart_with_sanitizers`."""
    wp.init()
    wp.config.optimization_level = 0  # says that threads must not share kernels: these follow Warp's shared pointer
    llvm, build = wp._src.context.runtime.llvm, wp._src.build
    clang, _ = _find_clang()
    libraries: dict[bytes, ctypes.CDLL] = {}

    def build_cpu(output, source, *, fuse_fp=True, **_options):
        command = [clang, *_FLAGS, f"-ffp-contract={'on' if fuse_fp else 'off'}", f"-I{_NATIVE}"]
        subprocess.run([*command, "-o", output, source, str(_NATIVE / "crt.cpp")], check=True)

    def load(path, handle, _linker):
        libraries[handle] = ctypes.CDLL(path.decode())
        return 0

    def lookup(handle, name):
        return ctypes.cast(getattr(libraries[handle], name.decode()), ctypes.c_void_p).value

    build.build_cpu = build_cpu
    llvm.wp_load_obj, llvm.wp_lookup, llvm.wp_unload_obj = load, lookup, lambda handle: libraries.pop(handle, None)
