"""The contacts of one kind of pair as parallel arrays on the device, and on the host."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..kernels.signs import FREE

__all__ = ["ContactBuffer", "HostContacts", "contacts_from_host", "make_contact_buffer", "read_contacts"]


@wp.struct
class ContactBuffer:
    """Pairs that the culls leave, one a row, with what is known of them; all arrays have the same length.

    Attributes:
        pairs: (vertex, face) or (edge, edge).
        status: What floating point certifies: FREE, HIT or UNSURE.
        decided: The status after the exact stage, if the method has one; UNSURE is what that leaves to the host.
        within_tolerance: Whether the time of impact is within the tolerance.
        toi: Time of impact as a share of the step.
        coordinates: Contact coordinates.
        normal: Unit contact normals.
    """

    pairs: wp.array[wp.vec2i]
    status: wp.array[wp.int8]
    decided: wp.array[wp.int8]
    within_tolerance: wp.array[wp.bool]
    toi: wp.array[wp.float64]
    coordinates: wp.array[wp.vec3d]
    normal: wp.array[wp.vec3d]


@dataclass
class HostContacts:
    """The rows of a :class:`ContactBuffer` as NumPy arrays, by the same names.

    Attributes:
        pairs: int32, shape [n, 2].
        status: int8, shape [n].
        decided: int8, shape [n].
        within_tolerance: bool, shape [n].
        toi: float64, shape [n].
        coordinates: float64, shape [n, 3].
        normal: float64, shape [n, 3].
    """

    pairs: np.ndarray
    status: np.ndarray
    decided: np.ndarray
    within_tolerance: np.ndarray
    toi: np.ndarray
    coordinates: np.ndarray
    normal: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """Whether a contact is not shown to be free, bool, shape [n]."""
        return self.decided != FREE

    def rows(self, which: np.ndarray) -> "HostContacts":
        """Returns the contacts of some rows, bool, shape [n]."""
        return HostContacts(**{name: values[which] for name, values in vars(self).items()})


def make_contact_buffer(capacity: int, device: wp.Device) -> ContactBuffer:
    """Returns a buffer with a capacity; only ``within_tolerance`` is initialized, to False."""
    buffer = ContactBuffer()
    buffer.pairs = wp.empty(capacity, dtype=wp.vec2i, device=device)
    buffer.status = wp.empty(capacity, dtype=wp.int8, device=device)
    buffer.decided = wp.empty(capacity, dtype=wp.int8, device=device)
    buffer.within_tolerance = wp.zeros(capacity, dtype=wp.bool, device=device)
    buffer.toi = wp.empty(capacity, dtype=wp.float64, device=device)
    buffer.coordinates = wp.empty(capacity, dtype=wp.vec3d, device=device)
    buffer.normal = wp.empty(capacity, dtype=wp.vec3d, device=device)
    return buffer


def read_contacts(buffer: ContactBuffer, count: int) -> HostContacts:
    """Returns copies of the first ``count`` contacts of a buffer; synchronizes with the device."""

    def read(array: wp.array) -> np.ndarray:
        return (array if count == len(array) else array[:count]).numpy().copy()

    return HostContacts(**{name: read(getattr(buffer, name)) for name in ContactBuffer.vars})


def contacts_from_host(contacts: HostContacts, device: wp.Device) -> ContactBuffer:
    """Returns contacts of the host in a buffer on a device."""
    buffer = make_contact_buffer(len(contacts.pairs), device)
    for name in ContactBuffer.vars:
        getattr(buffer, name).assign(getattr(contacts, name))
    return buffer
