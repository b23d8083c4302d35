"""Warp arrays on the CPU between pages that nobody may touch, so that access out of bounds or after release crashes."""

import ctypes
import mmap

import warp as wp

_FILLING = 0xA5
"""Fills new memory, so that what is read before it is written shows."""

_MAP_NORESERVE = 0x4000
_NO_ACCESS = 0


def _load_libc() -> ctypes.CDLL:
    """Returns the C library, which has these functions on Linux, with the types of their arguments."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
    libc.mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    return libc


class _Allocator:
    """Ends every allocation at a page without access, and takes access to what is released away for good."""

    def __init__(self, allocator):
        self._libc = _load_libc()
        self.deallocate_requires_context_guard = allocator.deallocate_requires_context_guard
        self.memory_kind = allocator.memory_kind

    def allocate(self, size_in_bytes):
        length = self._length(size_in_bytes)
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE
        start = self._libc.mmap(None, length, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0)
        if start is None or start == ctypes.c_void_p(-1).value:
            raise MemoryError(f"mmap: errno {ctypes.get_errno()}")
        end = start + length - mmap.PAGESIZE
        self._libc.mprotect(end, mmap.PAGESIZE, _NO_ACCESS)
        ctypes.memset(end - size_in_bytes, _FILLING, size_in_bytes)
        return end - size_in_bytes

    def deallocate(self, ptr, size_in_bytes):
        length = self._length(size_in_bytes)
        start = ptr + size_in_bytes + mmap.PAGESIZE - length
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_NORESERVE | 0x10  # MAP_FIXED: gives the pages back
        self._libc.mmap(start, length, _NO_ACCESS, flags, -1, 0)

    @staticmethod
    def _length(size_in_bytes):
        return (-(-size_in_bytes // mmap.PAGESIZE) + 1) * mmap.PAGESIZE


def guard_memory() -> None:
    """Guards all arrays that Warp allocates on the CPU from now on. Linux only."""
    device = wp.get_device("cpu")
    device.default_allocator = _Allocator(device.default_allocator)
