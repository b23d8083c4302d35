"""Lets processes that need the same kernels at the same time compile them once: one compiles, the others wait."""

import functools
import os
import zlib

import warp as wp

try:
    import fcntl
except ImportError:  # Windows, where each process compiles for itself
    fcntl = None

__all__ = ["compile_kernels_once"]


def compile_kernels_once() -> None:
    """Has this process wait for others that are compiling a module of kernels, and take it from the cache.

    Processes lock one byte of a file beside the kernels, which byte depends on the module and its options.
    """
    if fcntl is None:
        return
    file = open(os.path.join(wp.config.kernel_cache_dir, "compiling.lock"), "w")  # noqa: SIM115 (until the process ends)
    module = wp._src.context.Module
    compile_module = module._compile

    @functools.wraps(compile_module)
    def compile_locked(self, device=None, output_dir=None, *arguments, **options):
        byte = zlib.crc32(os.fsencode(output_dir or self.name))
        fcntl.lockf(file, fcntl.LOCK_EX, 1, byte)
        try:
            return compile_module(self, device, output_dir, *arguments, **options)
        finally:
            fcntl.lockf(file, fcntl.LOCK_UN, 1, byte)

    module._compile = compile_locked
