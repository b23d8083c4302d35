"""A solver around another one, which has all attributes of the inner solver."""

from typing import NamedTuple

import newton
import warp as wp
from newton.solvers import SolverBase

from ..._arguments import check_instance
from ..._one_thread import Occupied


class StateArrays(NamedTuple):
    """The arrays of a state, which an attribute of the state may replace later."""

    particle_q: wp.array | None
    particle_qd: wp.array | None
    body_q: wp.array | None
    body_qd: wp.array | None

    @classmethod
    def of(cls, state: newton.State) -> "StateArrays":
        """Returns the arrays of a state as they are now."""
        return cls(*(getattr(state, name) for name in cls._fields))


class WrappedSolver(SolverBase):
    """Wraps a solver; attributes that it does not have are those of the inner solver.

    Attributes:
        solver: The inner solver.
    """

    solver: SolverBase

    def __init__(self, solver: SolverBase):
        """Wraps a solver.

        Args:
            solver: Any Newton solver.

        Raises:
            TypeError: If it is no solver of Newton.
        """
        check_instance(solver, "solver", SolverBase, "a solver of Newton")
        self._lock = Occupied(type(self).__name__)
        self.solver = solver
        super().__init__(solver.model)
        self.collision_pipeline = solver.collision_pipeline
        self.supports_collision_pipeline = solver.supports_collision_pipeline
        self.supports_body_pair_reduced_contacts = solver.supports_body_pair_reduced_contacts

    @property
    def contacts(self):
        """Delegates to the inner solver."""
        return self.solver.contacts

    @contacts.setter
    def contacts(self, value):
        self.solver.contacts = value

    @property
    def collision_frequency(self):
        """Delegates to the inner solver."""
        return self.solver.collision_frequency

    @property
    def collision_frequency_type(self):
        """Delegates to the inner solver."""
        return self.solver.collision_frequency_type

    @property
    def supported_observables(self):
        """Delegates to the inner solver."""
        return self.solver.supported_observables

    def set_collision_frequency(self, **options):
        """Delegates to the inner solver."""
        self.solver.set_collision_frequency(**options)

    def observables(self, *arguments, **options):
        """Delegates to the inner solver."""
        return self.solver.observables(*arguments, **options)

    def validate_observables(self, *arguments, **options):
        """Delegates to the inner solver."""
        return self.solver.validate_observables(*arguments, **options)

    def notify_model_changed(self, flags: int) -> None:
        """Delegates to the inner solver."""
        self.solver.notify_model_changed(flags)

    def reset(self, state, world_mask=None, flags=None):
        """Delegates to the inner solver."""
        self.solver.reset(state, world_mask, flags)

    def update_contacts(self, contacts, state=None):
        """Delegates to the inner solver."""
        self.solver.update_contacts(contacts, state)

    def __deepcopy__(self, memo):
        """Raises a TypeError: buffers on the device, and graphs that write to them, cannot be copied."""
        raise TypeError(f"a {type(self).__name__} cannot be copied: put a new one behind a solver of the same model")

    def __getattr__(self, name):
        """Delegates other attributes to the inner solver."""
        if name == "solver":
            raise AttributeError(name)
        return getattr(self.solver, name)
