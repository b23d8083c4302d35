"""Compilation of the tests' kernels: options that make it quick, and no module compiled by two processes at once."""

import contextlib
import functools
import importlib
import os
import zlib

import warp as wp

try:
    import fcntl
except ImportError:  # Windows, where each process compiles for itself
    fcntl = None

__all__ = ["FOLDER", "QUICK", "compile_kernels_once", "omit_gradients_of_newton"]

FOLDER = os.path.dirname(__file__)
"""Folder from which a program that a test starts can import this module."""

QUICK = {"cpu_compiler_flags": "-march=native"}
"""Options of modules with large device functions: LLVM inlines by its own rules, not by Warp's, which take twice as
long to compile. Such kernels are slower, which does not matter in tests."""


WITHOUT_GRADIENTS = [
    "newton._src.geometry.inertia",
    "newton._src.geometry.kernels",
    "newton._src.sim.articulation",
    "newton._src.sim.collide",
    "newton._src.solvers.featherstone.kernels",
    "newton._src.solvers.style3d.builder",
    "newton._src.solvers.style3d.collision.bvh.kernels",
    "newton._src.solvers.style3d.collision.kernels",
    "newton._src.solvers.style3d.kernels",
    "newton._src.solvers.style3d.linear_solver",
    "newton._src.solvers.xpbd.kernels",
    "newton._src.viewer.kernels",
]
"""Modules of Newton's kernels through which no test takes a gradient. Their adjoints take a minute to compile."""


def omit_gradients_of_newton() -> None:
    """Leaves the adjoints out of :data:`WITHOUT_GRADIENTS`, in this process."""
    for name in WITHOUT_GRADIENTS:
        with contextlib.suppress(ImportError):  # in another version of Newton
            wp.set_module_options({"enable_backward": False}, module=importlib.import_module(name))


def compile_kernels_once() -> None:
    """Has this process wait for others that are compiling a module of kernels, and take it from the cache.

    Processes lock one byte of a file beside the kernels, which byte depends on the module and its options.
    """
    compile_module = getattr(wp._src.context.Module, "_compile", None)
    if fcntl is None or compile_module is None:  # in another version of Warp, each process compiles for itself, too
        return
    file = open(os.path.join(wp.config.kernel_cache_dir, "compiling.lock"), "w")  # noqa: SIM115 (until the process ends)

    @functools.wraps(compile_module)
    def compile_locked(self, device=None, output_dir=None, *arguments, **options):
        byte = zlib.crc32(os.fsencode(output_dir or self.name))
        fcntl.lockf(file, fcntl.LOCK_EX, 1, byte)
        try:
            return compile_module(self, device, output_dir, *arguments, **options)
        finally:
            fcntl.lockf(file, fcntl.LOCK_UN, 1, byte)

    wp._src.context.Module._compile = compile_locked
