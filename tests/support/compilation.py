"""Compilation of the tests' kernels: quick options, no module compiled by two processes at once, for absent GPUs."""

import contextlib
import functools
import importlib
import os
import tempfile
import zlib

import warp as wp

try:
    import fcntl
except ImportError:  # Windows, where each process compiles for itself
    fcntl = None

FOLDER = os.path.dirname(__file__)
"""Folder from which a program that a test starts can import this module."""

_IS_OLD = wp.__version__.startswith(("1.17.", "1.18."))  # which do not take the arguments below

QUICK = {"cpu_compiler_flags": "-march=native" + " -fno-vectorize -fno-slp-vectorize" * (not _IS_OLD)}
"""Options of all kernels that the processes of the tests run: LLVM inlines by its own rules, not by Warp's, and does
not look for loops to vectorize. Compilation takes six tenths of the time. Such kernels are slower, which does not
matter in tests. Programs that tests start as users do compile as users do."""

WITHOUT_GRADIENTS = [
    "newton._src.geometry.inertia",
    "newton._src.geometry.kernels",
    "newton._src.sim.articulation",
    "newton._src.sim.collide",
    "newton._src.solvers.coupled.admm_utils",
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


FOR_CPUS = {"warp_bsc.detection.narrow.batch_kernels", "warp_bsc.detection.broad.wide_tree"}
"""Modules of Python whose kernels run on CPUs alone."""


def compile_for_gpus(arch: int) -> dict[str, str]:
    """Compiles the kernels of warp-bsc that this process has loaded for GPUs of a compute capability, such as 75.

    It needs NVRTC, which is part of Warp for Linux and Windows, but no GPU. Returns problems by module.
    """
    problems, compiled = {}, 0
    for name, module in sorted(wp._src.context.user_modules.items()):
        kernels = list(module.kernels.values())
        places = {kernel.func.__module__ or "" for kernel in kernels}  # "": made of text
        is_ours = any(place.startswith("warp_bsc.") for place in places)
        if not module.execs or not is_ours or places <= FOR_CPUS:
            continue
        for kernel in kernels:
            kernel.options.pop("cluster_dim", None)  # GPUs without clusters ignore it, compiling ahead of time does not
        try:
            compiled += 1
            with tempfile.TemporaryDirectory() as folder:
                wp.compile_aot_module(module, device=None, arch=arch, module_dir=folder, use_ptx=True)
        except Exception as problem:
            problems[name] = str(problem)
    return problems if compiled else {"warp_bsc": "no kernel of it was loaded"}


def compile_quickly() -> None:
    """Gives the CPU's kernels :data:`QUICK` options, and leaves out the adjoints of :data:`WITHOUT_GRADIENTS`.

    It is for this process; a program that shares its kernels has to call it too.
    """
    wp.config.cpu_compiler_flags = QUICK["cpu_compiler_flags"]
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
