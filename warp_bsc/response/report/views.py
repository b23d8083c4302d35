"""The part of a report for the eye: drawings of a step, a table of its contacts, and what a warning names."""

import functools

import numpy as np
from newton.viewer import ViewerBase

from ..._arguments import check_instance, checked_number
from ..state.mesh import ModelMesh
from ..state.structs import FROZEN, NOT_FINITE, TRUNCATED
from .drawing import Drawing
from .forces.contact_report import ContactReport
from .text import not_finite_warning, table_by_shape, uncertified_warning

_NOT_DRAWN = "report.draw draws contacts only if a stage keeps them: SolverCCD(solver, report_contacts=True)"
_INCOMPLETE = "report.draw lacks contacts: raise the number that report_contacts= allows"


class ReportViews(ContactReport):
    """Shows the last step of a stage."""

    _responds: bool

    def table(self, dt: float | None = None) -> str:
        """Returns a table of the contacts of the last step by shape: their number, normal and tangential impulses.

        Tangential impulses are added up without their directions. Lines have at most 80 characters; shapes without
        contacts are left out, and only the 40 with the largest normal impulses are in it.

        Args:
            dt: Length of the step [s], for mean forces in place of impulses.

        Raises:
            RuntimeError: If the stage was not asked to keep contacts, see :attr:`contacts`.
            ValueError: If ``dt`` is not more than 0.
        """
        dt = None if dt is None else checked_number(dt, "dt", 0.0, above=True)
        return table_by_shape(self._mesh.model, self.contacts.numpy(), dt, complete=self.contacts.complete)

    def draw(self, viewer: ViewerBase, *, impulse_scale: float | None = None) -> None:
        """Draws the last step in a frame of a viewer: call it between ``begin_frame`` and ``end_frame``.

        It draws normals of contacts as green lines, their impulses on the first of both elements as magenta arrows,
        truncated vertices in orange, frozen ones in blue, and those that the certificate lacks in red. Minimum
        distances are transparent shells around all surfaces, which touch where two are as near as they may come. All is
        where the step ended, under ``/ccd``, and without the offsets of worlds and layers of a viewer, as Newton draws
        cloth. Synchronizes with the device.

        Args:
            viewer: Any viewer of Newton.
            impulse_scale: Length of an arrow by its impulse [m/(N s)]; None for one by which nine of ten arrows are at
                most two median edges long, in the steps that were drawn so far.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If ``impulse_scale`` is not more than 0.
        """
        check_instance(viewer, "viewer", ViewerBase, "a viewer of Newton")
        if impulse_scale is not None:
            impulse_scale = checked_number(impulse_scale, "impulse_scale", 0.0, above=True)
        contacts = None
        if self._rows is not None:
            contacts = self.contacts.numpy()
            if not self.contacts.complete:
                self._warn_once("undrawn", lambda: _INCOMPLETE)
        elif self._responds:
            self._warn_once("undrawn", lambda: _NOT_DRAWN)
        vertices = {"truncated": self._find_vertices(TRUNCATED), "frozen": self._find_vertices(FROZEN)}
        vertices["uncertified"] = self._find_uncertified()
        self._drawing.draw(viewer, self._find_positions(), contacts, vertices, impulse_scale)

    @functools.cached_property
    def _drawing(self):
        return Drawing(self._mesh)

    def _uncertified_warning(self):
        mesh, listed = self._mesh, self._find_uncertified()
        first = mesh.model.particle_count
        particles, shapes = np.flatnonzero(listed[:first]), np.unique(mesh.shape_vertices.shape[listed[first:]])
        return uncertified_warning(mesh.model, particles, shapes, may_invert=self._prevents_inversions)

    def _not_finite_warning(self):
        model = self._mesh.model
        return not_finite_warning(model, np.flatnonzero(self._find_vertices(NOT_FINITE)[: model.particle_count]))

    @property
    def _mesh(self) -> ModelMesh:
        raise NotImplementedError

    @property
    def _prevents_inversions(self) -> bool:
        """Whether the stage keeps tetrahedra from inverting, so that its certificate covers that."""
        raise NotImplementedError

    def _find_positions(self) -> np.ndarray:
        """Returns the positions of all vertices at the end of the last step [m], shape [vertex_count, 3]."""
        raise NotImplementedError

    def _find_vertices(self, bit) -> np.ndarray:
        """Returns which vertices have a bit of the outcome, themselves or their body, bool, shape [vertex_count]."""
        raise NotImplementedError

    def _find_uncertified(self) -> np.ndarray:
        """Returns which vertices of the mesh the certificate of the last step lacks, bool, shape [vertex_count]."""
        raise NotImplementedError

    def _warn_once(self, subject, message):
        """Warns, once for each subject, of what a function returns."""
        raise NotImplementedError
