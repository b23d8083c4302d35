"""A solver around another one, which has all attributes of the inner solver."""

import functools

from newton.solvers import SolverBase
from newton.solvers.experimental.coupled import CouplingInterface

from .._arguments import check_instance
from .._one_thread import Occupied
from .._private_names.versions import warn_if_untested


class WrappedSolver(SolverBase, CouplingInterface):
    """Wraps a solver; attributes that it does not have are those of the inner solver, and so are hooks of couplers.

    Attributes:
        solver: The inner solver.
    """

    solver: SolverBase

    def __init__(self, solver: SolverBase):
        """Wraps any solver of Newton.

        Raises:
            TypeError: If it is no solver of Newton.
        """
        check_instance(solver, "solver", SolverBase, "a solver of Newton")
        warn_if_untested("warp")
        warn_if_untested("newton")
        self._lock = Occupied(type(self).__name__)
        self.solver = solver
        super().__init__(solver.model)
        self.collision_pipeline = solver.collision_pipeline
        self.supports_collision_pipeline = solver.supports_collision_pipeline
        self.supports_body_pair_reduced_contacts = getattr(solver, "supports_body_pair_reduced_contacts", False)

    @property
    def contacts(self):
        """The contacts of the inner solver."""
        return self.solver.contacts

    @contacts.setter
    def contacts(self, value):
        self.solver.contacts = value

    def _hook(self, name):
        """Returns a hook of the inner solver, or the default of the interface."""
        return getattr(self.solver if isinstance(self.solver, CouplingInterface) else super(), name)

    def __deepcopy__(self, memo):
        """Raises a TypeError: buffers on the device, and graphs that write to them, cannot be copied."""
        raise TypeError(f"a {type(self).__name__} cannot be copied: put a new one behind a solver of the same model")

    def __getattr__(self, name):
        """Delegates other attributes to the inner solver."""
        if name == "solver":
            raise AttributeError(name)
        return getattr(self.solver, name)


def innermost(solver: SolverBase) -> SolverBase:
    """Returns the solver inside all wrappers of this package: the one that integrates."""
    while isinstance(solver, WrappedSolver):
        solver = solver.solver
    return solver


def _delegated_method(name, owner):
    """Returns a method that is that of the inner solver; hooks of the coupling interface have a default."""

    @functools.wraps(getattr(owner, name))
    def method(self, *arguments, **options):
        inner = self._hook(name) if owner is CouplingInterface else getattr(self.solver, name)
        return inner(*arguments, **options)

    return method


def _delegated_property(name):
    """Returns a property that is that of the inner solver."""
    return property(lambda self: getattr(self.solver, name), doc=getattr(SolverBase, name).__doc__)


for _name in (
    "notify_model_changed",
    "observables",  # Newton 1.6 has none
    "reset",
    "set_collision_frequency",
    "update_contacts",
    "validate_observables",
):
    if hasattr(SolverBase, _name):
        setattr(WrappedSolver, _name, _delegated_method(_name, SolverBase))
for _name in ("collision_frequency", "collision_frequency_type", "supported_observables"):
    if hasattr(SolverBase, _name):
        setattr(WrappedSolver, _name, _delegated_property(_name))
for _name in dir(CouplingInterface):
    if _name.startswith("coupling_"):
        setattr(WrappedSolver, _name, _delegated_method(_name, CouplingInterface))
