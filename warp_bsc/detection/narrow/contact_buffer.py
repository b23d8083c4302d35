"""The contacts of one kind of pair as parallel arrays on the device, and on the host."""

import weakref
from collections import deque
from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from ...kernels.signs import FREE
from ..run.settings import capacity_for

_MAX_FREE = 4
"""Free buffers that a pool keeps: those of two results."""


@wp.struct
class ContactBuffer:
    """Pairs that no cull decides, one a row, and their contacts; all arrays have the same length."""

    pairs: wp.array[wp.vec2i]  # (vertex, face) or (edge, edge)
    status: wp.array[wp.int8]  # what floating point certifies: FREE, HIT or UNSURE
    # the status after the exact phase, or HIT where features certainly touch; UNSURE if left to the host
    decided: wp.array[wp.int8]
    within_tolerance: wp.array[wp.bool]  # whether the time of impact is within the tolerance
    toi: wp.array[wp.float64]  # time of impact as a share of the step
    coordinates: wp.array[wp.vec3d]  # contact coordinates
    normal: wp.array[wp.vec3d]  # unit contact normals


@dataclass
class HostContacts:
    """The rows of a :class:`ContactBuffer` as NumPy arrays, by the same names."""

    pairs: np.ndarray  # int32, shape [n, 2]
    status: np.ndarray  # int8, shape [n]
    decided: np.ndarray  # int8, shape [n]
    within_tolerance: np.ndarray  # bool, shape [n]
    toi: np.ndarray  # float64, shape [n]
    coordinates: np.ndarray  # float64, shape [n, 3]
    normal: np.ndarray  # float64, shape [n, 3]

    @property
    def hit(self) -> np.ndarray:
        """Whether a contact is not decided to be free, bool, shape [n]."""
        return self.decided != FREE

    def rows(self, which: np.ndarray) -> "HostContacts":
        """Returns the contacts of some rows, bool, shape [n]."""
        return HostContacts(**{name: values[which] for name, values in vars(self).items()})


def empty_contacts() -> HostContacts:
    """Returns no contacts."""
    return read_contacts(make_contact_buffer(0, wp.get_device("cpu")), 0)


def make_contact_buffer(capacity: int, device: wp.Device) -> ContactBuffer:
    """Returns a buffer with a capacity; only ``within_tolerance`` is initialized, to False."""
    buffer = ContactBuffer()
    for name, var in ContactBuffer.vars.items():
        setattr(buffer, name, wp.empty(capacity, dtype=var.type.dtype, device=device))
    buffer.within_tolerance.zero_()
    return buffer


def read_contacts(buffer: ContactBuffer, count: int) -> HostContacts:
    """Returns copies of the first ``count`` contacts of a buffer; synchronizes with the device."""

    def read(array: wp.array) -> np.ndarray:
        if array.device.is_cpu:
            return array.numpy()[:count].copy()
        host = wp.empty(count, dtype=array.dtype, device="cpu")
        if count:  # 0 stands for the whole array
            with wp.ScopedStream(array.device.null_stream):  # waits for all streams, as wp.array.numpy does
                wp.copy(host, array, count=count)
        return host.numpy()

    return HostContacts(**{field.name: read(getattr(buffer, field.name)) for field in fields(HostContacts)})


def contacts_from_host(contacts: HostContacts, device: wp.Device) -> ContactBuffer:
    """Returns contacts of the host in a buffer on a device."""
    buffer = make_contact_buffer(len(contacts.pairs), device)
    for field in fields(HostContacts):
        getattr(buffer, field.name).assign(getattr(contacts, field.name))
    return buffer


@dataclass(frozen=True, eq=False)
class ContactRows:
    """The first rows of a buffer: the contacts of one kind of pair in a result."""

    buffer: ContactBuffer
    count: int  # of rows

    def read(self) -> HostContacts:
        """Returns copies of the contacts; synchronizes with the device."""
        return read_contacts(self.buffer, self.count)


class ContactBufferPool:
    """Contact buffers of results, used again once the rows that were taken from the pool are garbage.

    Rows that are still referenced keep their buffer. The pool itself keeps a few free buffers at most. It does not see
    references to the arrays of a buffer: a caller that passes these on must not take the buffer from a pool.
    """

    def __init__(self, device: wp.Device):
        """Makes an empty pool.

        Args:
            device: Device of the buffers.
        """
        self._device = device
        self._free: list[tuple[wp.Stream | None, ContactBuffer]] = []
        self._returned: deque[tuple[wp.Stream | None, ContactBuffer]] = deque(maxlen=_MAX_FREE)
        """Appended to by finalizers, which may run at any time."""

    def acquire(self, count: int) -> ContactRows:
        """Returns ``count`` rows of a buffer, whose values are undefined.

        The buffer is a free one that the device's current stream has used last, the smallest that suffices, so that
        work still queued on that stream ends before any of the new owner's; or it is a new one.

        Raises:
            ValueError: If no buffer can be large enough.
        """
        while self._returned:
            self._free.append(self._returned.popleft())
        del self._free[:-_MAX_FREE]
        stream = self._device.stream if self._device.is_cuda else None
        fitting = [entry for entry in self._free if entry[0] is stream and len(entry[1].pairs) >= count]
        if fitting:
            entry = min(fitting, key=lambda entry: len(entry[1].pairs))
            self._free = [other for other in self._free if other is not entry]
        else:
            entry = stream, make_contact_buffer(capacity_for(max(count, 64), "collisions"), self._device)
        rows = ContactRows(entry[1], count)
        weakref.finalize(rows, self._returned.append, entry).atexit = False
        return rows
