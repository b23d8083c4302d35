"""The part of a report that says what contacts did to momentum, as arrays on the device: ``report.forces``."""

from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

from ...._arguments import checked_number
from ..text import table_by_shape
from .structs import ContactRows, PublishedImpulses

_COLUMNS = "kind", "vertices", "weights", "shapes", "bodies", "world", "toi", "point", "normal", "velocity"
_COLUMNS += "normal_impulse", "tangential_impulse"


@dataclass(frozen=True, eq=False)
class Contacts:
    """The contacts of the last step that had an impulse, unsorted, as Warp arrays of which the first ``count`` count.

    A contact is of two elements: of a vertex and a face, or a point and an edge or a point; of two edges; or of a
    vertex and an infinite plane. Impulses and the normal act on the first; on the second they are the opposite. Divide
    by the length of the step to get the mean force. A pair may have several rows, if it was in contact along several
    normals, or in several substeps.

    Attributes:
        count: Number of contacts, int, shape [1]; more than the capacity if not all fit.
        kind: A :class:`.state.structs.ContactKind`: VERTEX_FACE, EDGE_EDGE or PLANE; int.
        vertices: The vertices of both elements in ``solver.mesh``, vec4i: a vertex, then those of its face; both ends
            of one edge, then of the other; the vertex at a plane, then -1. An edge or a point that a vertex meets is
            listed with repeated vertices.
        weights: Share of the impulse that each vertex bears, negative for the second element, vec4.
        shapes: The shapes of both, vec2i, -1 for particles.
        bodies: The bodies of both, vec2i, -1 for none.
        world: Their world, int.
        toi: Lower bound of the time of impact of the predicted motion, in [0, 1] of the step; 0 if the pair was near at
            the start, and was held apart before it met; float.
        point: The contact point on the first at the end of the step [m], vec3.
        normal: The unit normal, from the second to the first, vec3.
        velocity: Velocity of the first relative to the second before the contact, as the inner solver predicted it
            [m/s], vec3.
        normal_impulse: Impulse along the normal [N s], float.
        tangential_impulse: Impulse of friction [N s], vec3.
    """

    count: wp.array[int]
    kind: wp.array[int]
    vertices: wp.array[wp.vec4i]
    weights: wp.array[wp.vec4]
    shapes: wp.array[wp.vec2i]
    bodies: wp.array[wp.vec2i]
    world: wp.array[int]
    toi: wp.array[float]
    point: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    normal_impulse: wp.array[float]
    tangential_impulse: wp.array[wp.vec3]
    _lost: wp.array[int]

    @property
    def capacity(self) -> int:
        """The number of contacts that fit."""
        return len(self.kind)

    @property
    def complete(self) -> bool:
        """Whether all contacts of the last step are listed. Synchronizes with the device.

        If there are more than fit, sums have the others too. If an impulse or a sum is too large to be held, sums lack
        it; :attr:`ContactReport.complete` is false then.
        """
        return int(self.count.numpy()[0]) <= self.capacity and int(self._lost.numpy()[0]) == 0

    def numpy(self) -> dict[str, np.ndarray]:
        """Returns the contacts on the host, sorted by kind and vertices. Synchronizes with the device."""
        count = min(int(self.count.numpy()[0]), self.capacity)
        found = {name: getattr(self, name).numpy()[:count] for name in _COLUMNS}
        # rows of a pair with one normal differ in other columns
        rest = [found[name] for name in ("toi", "normal_impulse")] + [*found["point"].T, *found["weights"].T]
        keys = [*rest, *found["normal"].T, *found["shapes"].T, *found["vertices"].T[::-1], found["kind"]]
        order = np.lexsort(keys)
        return {name: values[order] for name, values in found.items()}


class ContactReport:
    """What contacts did to momentum in the last step, with ``report=["contacts"]``.

    All arrays are on the device, are written anew in each step, and stay where they are, so that a program may read
    them in a CUDA graph. They hold impulses of the stage [N s]; those of a step in substeps are sums over these. What
    the inner solver itself pushes, such as the penalties of VBD, is no part of them: it is in the observables of that
    solver, if it has some.

    :attr:`.report.SolverReport.impulses_elsewhere` says where that solver takes over contacts that the stage resolves
    behind others.

    Sums reach 130,000 N s, of impulses of up to 65,000 N s each, in units of 1.5e-14 N s, and are the same in any order
    of threads; :attr:`complete` is false where that is not enough.

    Attributes:
        particle_impulse: Change of momentum of each particle by the response [N s], vec3, shape [particle_count]. It is
            the mass by the change of velocity that the stage made, up to rounding. Of a particle that nothing can move,
            it is the impulse on what holds it.
        unpaired_particle_impulse: The part of :attr:`particle_impulse` that no contact has, likewise. Velocities that
            follow from a path that was cut, those of frozen particles, and the turn that restores the angular momentum
            of a world are of no pair. The turn has no linear momentum; paths that are cut do not conserve it.
        body_impulse: Impulse on each body [N s], and about its centre of mass [N m s], spatial_vector, shape
            [body_count], linear first. Of a body that the response moves, it is its change of momentum. On others, such
            as kinematic fingers, contacts act all the same.
        unpaired_body_impulse: The part of :attr:`body_impulse` that no contact has, likewise.
        shape_impulse: Impulse of contacts on each shape [N s], vec3, shape [shape_count].
    """

    def __init__(
        self, model: newton.Model, rows: ContactRows, published: PublishedImpulses, shapes_of_worlds: np.ndarray
    ):
        """Takes the contacts and the sums that each step writes.

        Shapes of worlds are those of each world, those in all worlds first, then -1, int32, shape [world_count, n].
        """
        self._model, self._rows, self._of_pairs, self.shapes_of_worlds = model, rows, published.pair, shapes_of_worlds
        self.particle_impulse, self.unpaired_particle_impulse = published.particle, published.unpaired_particle
        self.body_impulse, self.unpaired_body_impulse = published.body, published.unpaired_body
        self.shape_impulse = published.shape

    @property
    def contacts(self) -> Contacts:
        """The contacts of the last step that had an impulse."""
        return Contacts(*(getattr(self._rows, name) for name in ["count", *_COLUMNS, "lost"]))

    @property
    def shape_pair_impulse(self) -> wp.array:
        """Impulse of contacts on one shape by another, in each world [N s], vec3, shape [world_count, n + 1, n + 1].

        Rows have the shapes that the impulse acts on, columns those that it is of. Shapes are numbered as in
        ``shapes_of_worlds``; the last row and column are of all particles of the world.

        Raises:
            RuntimeError: If there are more than 2^20 entries: sum up :attr:`contacts` instead.
        """
        pairs, (worlds, local) = self._of_pairs, self.shapes_of_worlds.shape
        if not len(pairs):
            entries = worlds * (local + 1) ** 2
            raise RuntimeError(f"shape_pair_impulse would have {entries} entries: sum up contacts by shapes instead")
        return pairs.reshape((worlds, local + 1, local + 1))

    @property
    def complete(self) -> bool:
        """Whether sums have the impulses of all contacts of the last step, see :attr:`Contacts.complete`."""
        return int(self._rows.lost.numpy()[0]) == 0

    def table(self, dt: float | None = None) -> str:
        """Returns a table of the contacts of the last step by shape: their number, normal and tangential impulses.

        Tangential impulses are added up without their directions. Lines have at most 80 characters; shapes without
        contacts are left out, and only the 40 with the largest normal impulses are in it.

        Args:
            dt: Length of the step [s], for mean forces in place of impulses.

        Raises:
            ValueError: If ``dt`` is not more than 0.
        """
        dt = None if dt is None else checked_number(dt, "dt", 0.0, above=True)
        contacts = self.contacts
        return table_by_shape(self._model, contacts.numpy(), dt, complete=contacts.complete)
