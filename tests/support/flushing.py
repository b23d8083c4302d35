"""A processor that takes subnormal numbers for zero, as some libraries tell it to."""

import contextlib

import numpy as np
import pytest
import warp as wp


@wp.func_native(
    snippet="""
#if defined(__x86_64__) && !defined(__CUDA_ARCH__)
    const unsigned state = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(flush ? state | 0x8040u : state & ~0x8040u);
#endif
"""
)
def _flush_subnormals(flush: bool): ...


@wp.kernel(enable_backward=False, module="unique")
def _tell_processor(flush: bool):
    _flush_subnormals(flush)


@contextlib.contextmanager
def subnormals_flushed():
    """Has this thread take subnormal numbers for zero, and write zero in place of them, within the block."""
    wp.launch(_tell_processor, 1, inputs=[True], device="cpu")
    try:
        if np.array([2.0**-1074]).sum() > 0.0:
            pytest.skip("not known for this processor")
        yield
    finally:
        wp.launch(_tell_processor, 1, inputs=[False], device="cpu")
