"""Makes chosen allocations of Warp fail, as Warp's own do where the memory of a device is used up."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import warp as wp

from warp_bsc.detection.run.memory import DeviceMemoryError


class FailingAllocator:
    """An allocator of which one allocation fails, and all after it if asked.

    Attributes:
        count: Number of allocations so far.
    """

    def __init__(self, allocator: Any, device: wp.Device, failing: int, *, all_after: bool):
        """Makes the allocation of a number fail, from 0; with -1 none."""
        self._allocator, self._device, self._failing, self._all_after = allocator, device, failing, all_after
        self.count = 0
        self.memory_kind = allocator.memory_kind
        self.deallocate_requires_context_guard = allocator.deallocate_requires_context_guard
        self.deallocate = allocator.deallocate  # also of arrays that outlive this one

    def allocate(self, size_in_bytes: int) -> int:
        """Returns the address of new memory."""
        number, self.count = self.count, self.count + 1
        if number == self._failing or (self._all_after and 0 <= self._failing < number):
            raise RuntimeError(f"Failed to allocate {size_in_bytes} bytes on device '{self._device}'")
        return self._allocator.allocate(size_in_bytes)


@contextlib.contextmanager
def failing_memory(device: wp.Device, failing: int = -1, *, all_after: bool = False) -> Iterator[FailingAllocator]:
    """Makes an allocation on a device fail in the context; yields the allocator, which counts them."""
    allocator = FailingAllocator(wp.get_device_allocator(device), device, failing, all_after=all_after)
    if device.is_cuda:
        wp.set_device_allocator(device, allocator)
    else:
        before, device.default_allocator = device.default_allocator, allocator
    try:
        yield allocator
    finally:
        if device.is_cuda:
            wp.set_device_allocator(device, None)
        else:
            device.default_allocator = before


def fail_each(device: wp.Device, make: Callable[[], Any], call: Callable, read: Callable = lambda _: None) -> list[str]:
    """Makes each allocation of a call fail in turn; returns the messages of the errors.

    Asserts that each error is a :class:`DeviceMemoryError`, that what is called is then as it was before, and that the
    same call then returns what it returns where nothing fails.

    Args:
        device: The device.
        make: Makes what is called anew, with all that it needs to be called the first time.
        call: Calls it, given what ``make`` returns, and returns its results.
        read: Returns what the call must not change where it fails, given the same.
    """
    messages = []
    with failing_memory(device) as memory:
        subject = make()
        before = memory.count
        expected = call(subject)
    for number in range(memory.count - before):
        subject = make()
        state = read(subject)
        with failing_memory(device, number):
            try:
                call(subject)
            except DeviceMemoryError as error:
                messages.append(str(error))
            else:
                raise AssertionError(f"allocation {number} has failed, and nothing was raised")
        assert read(subject) == state, messages[-1]
        assert call(subject) == expected, messages[-1]
    return messages
