"""A rollout of a solver as a differentiable function of arrays: a state and controls to the states that follow.

:mod:`warp_bsc.torch` and :mod:`warp_bsc.jax` make it a function of these libraries.
"""

from typing import Any

import newton
import warp as wp
from newton.solvers import SolverBase

from ._arguments import check_instance, checked_choice, checked_integer, checked_number
from ._private_names.of_warp import paused_tape

STATE = {"particle_q": wp.vec3, "particle_qd": wp.vec3, "body_q": wp.transform, "body_qd": wp.spatial_vector}
"""Arrays of a state, with the types of their elements."""
ADDED = {"particle_f": wp.vec3, "body_f": wp.spatial_vector, "particle_qd": wp.vec3, "body_qd": wp.spatial_vector}
"""Controls that are added to an array of the state: forces in each step, velocities in the first step of a row."""

Arrays = dict[str, wp.array]


@wp.kernel
def _copy(values: wp.array[Any], copies: wp.array[Any]):
    copies[wp.tid()] = values[wp.tid()]


@wp.kernel
def _add_row(rows: wp.array2d[Any], row: int, sums: wp.array[Any]):
    wp.atomic_add(sums, wp.tid(), rows[row, wp.tid()])


@wp.kernel
def _write_row(values: wp.array[Any], row: int, rows: wp.array2d[Any]):
    rows[row, wp.tid()] = values[wp.tid()]


class RolloutOptions:
    """The arguments of a rollout but for its arrays, checked.

    Attributes:
        solver: The solver.
        dt: Length of a step [s].
        all_states: Whether all states are results, and not the last alone.
        every: Steps between two states that a tape keeps, None to keep all.
        rows: Rows of each control; 0 if there are no controls.
        steps: Steps.
    """

    def __init__(
        self,
        solver: SolverBase,
        dt: float,
        steps: int | None,
        states: str,
        state_shapes: dict[str, tuple[int, ...]],
        control_shapes: dict[str, tuple[int, ...]],
        every: int | None = None,
    ):
        """Checks the arguments.

        Args:
            solver: A solver whose model was finalized with ``requires_grad=True``.
            dt: Length of a step [s].
            steps: Steps, a multiple of the rows of the controls, each of which is then held; None for one a row.
            states: ``"last"`` or ``"all"``.
            state_shapes: Shapes of the arrays of the state by name, as of a library without types of vectors.
            control_shapes: The same of the controls.
            every: Steps between two states that a tape keeps, None to keep all.

        Raises:
            TypeError: If an argument has another type.
            ValueError: If a number is out of range, a name is unknown, or a shape does not fit the model.
        """
        check_instance(solver, "solver", SolverBase, "a solver of Newton")
        model = solver.model
        if not model.requires_grad:
            raise ValueError("solver: its model has no gradients; finalize it with requires_grad=True")
        self.solver, self.dt = solver, checked_number(dt, "dt", 0.0, above=True)
        self.all_states = checked_choice(states, "states", ("last", "all")) == "all"
        self.every = None if every is None else checked_integer(every, "every", 1)
        if every is not None and not hasattr(solver, "_take_checkpointed"):
            raise TypeError(f"solver must be a SolverImplicit with every={every}, not a {type(solver).__name__}")
        self._control = model.control()
        for name, shape in state_shapes.items():
            if name not in STATE:
                raise ValueError(f"state has no {name!r}; it may have {', '.join(STATE)}")
            self._check_shape(f"state[{name!r}]", shape, self.shape_of(name))
        rows = {shape[0] if shape else 0 for shape in control_shapes.values()}
        if len(rows) > 1 or 0 in rows:
            raise ValueError(f"controls must all have the same number of rows, at least 1, not {sorted(rows)}")
        self.rows = rows.pop() if rows else 0
        for name, shape in control_shapes.items():
            self._check_shape(f"controls[{name!r}]", shape, (self.rows, *self.shape_of(name, "controls")))
        if steps is None and not self.rows:
            raise ValueError("steps must be given if there are no controls")
        self.steps = self.rows if steps is None else checked_integer(steps, "steps", 1)
        if self.rows and self.steps % self.rows:
            raise ValueError(f"steps must be a multiple of the {self.rows} rows of controls, not {self.steps}")

    def shape_of(self, name: str, argument: str = "state") -> tuple[int, ...]:
        """Returns the shape of an array of the state, or of one row of a control."""
        array = self._template(name)
        if array is None or not len(array):
            raise ValueError(f"{argument}[{name!r}]: the model has no such array")
        return (*array.shape, *getattr(array.dtype, "_shape_", ()))

    def dtype_of(self, name: str) -> Any:
        """Returns the type of the elements of an array by name."""
        template = self._template(name)
        assert template is not None
        return template.dtype

    def result_names(self) -> list[str]:
        """Returns the names of the arrays of the states that are results: those that the model has."""
        return [name for name in STATE if getattr(self.solver.model, name) is not None and len(self._template(name))]

    def _template(self, name):
        if name in STATE:
            return getattr(self.solver.model, name)
        if name in ADDED:
            return getattr(self.solver.model, "particle_qd" if name == "particle_f" else "body_qd")
        array = getattr(self._control, name, None)
        if not isinstance(array, wp.array) or array.dtype is not wp.float32:
            names = ", ".join([*ADDED, *(n for n, a in vars(self._control).items() if isinstance(a, wp.array))])
            raise ValueError(f"controls has no {name!r}; it may have {names}")
        return array

    @staticmethod
    def _check_shape(name, shape, expected):
        if tuple(shape) != tuple(expected):
            raise ValueError(f"{name} must have shape {tuple(expected)}, not {tuple(shape)}")


class Rollout:
    """Steps of a solver, on a tape.

    Attributes:
        results: Arrays of the states by name, shape [1 or steps, count].
    """

    def __init__(self, options: RolloutOptions, state: Arrays, controls: Arrays, *, recorded: bool = True):
        """Takes the steps.

        Args:
            options: The other arguments.
            state: Arrays of the first state by name; those of the model are used for others. They are copied.
            controls: Controls by name, shape [rows, count]. They are copied.
            recorded: Whether :meth:`backward` can be called.
        """
        self._options, self._recorded, model = options, recorded, options.solver.model
        with paused_tape():
            self._inputs = {name: wp.clone(array, requires_grad=recorded) for name, array in state.items()}
            self._controls = {name: wp.clone(array, requires_grad=recorded) for name, array in controls.items()}
            self.results: Arrays = {}
            for name in options.result_names():
                shape = (options.steps if options.all_states else 1, len(getattr(model, name)))
                dtype = options.dtype_of(name)
                self.results[name] = wp.zeros(shape, dtype=dtype, device=model.device, requires_grad=recorded)
            self._tape, self._control = wp.Tape(), model.control()
            if recorded:
                with self._tape:
                    self._run()
            else:
                self._run()

    def _run(self):
        options = self._options
        start = self._new_state()
        for name, array in self._inputs.items():
            self._launch(_copy, len(array), [array], [getattr(start, name)])
        if options.every is not None and self._recorded:
            solver: Any = options.solver
            of_steps = options.steps, options.every, list(self.results.values())
            solver._take_checkpointed(self._take, start, self._new_state(), *of_steps)
            return
        for step in range(options.steps):
            end = self._new_state()
            self._take(step, start, end)
            start = end

    def _take(self, step, start, end):
        """Takes a step between two states, by its number."""
        options, control = self._options, self._control
        held = options.steps // options.rows if options.rows else options.steps
        row = step // held
        for name, array in self._controls.items():
            if name not in ADDED:
                control = self._with_row(control, name, array, row)
            elif name not in STATE or step % held == 0:
                self._launch(_add_row, array.shape[1], [array, row], [getattr(start, name)])
        options.solver.step(start, end, control, None, options.dt)
        if options.all_states or step + 1 == options.steps:
            for name, array in self.results.items():
                row = step if options.all_states else 0
                self._launch(_write_row, array.shape[1], [getattr(end, name), row], [array])

    def _new_state(self):
        with paused_tape():  # which would record that it begins as a copy of the model
            state = self._options.solver.model.state(requires_grad=self._recorded)
            state.clear_forces()
        return state

    def _with_row(self, control, name, array, row):
        """Returns a control with a row of an array, which it does not copy: nothing writes to a control."""
        into = newton.Control()
        vars(into).update(vars(control))
        setattr(into, name, array[row])
        return into

    def _launch(self, kernel, dim, inputs, outputs):
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self._options.solver.model.device)

    def backward(self, of_results: Arrays) -> tuple[Arrays, Arrays]:
        """Returns the gradients with respect to the state and to the controls, given those of results by name.

        Clears the gradients of all arrays of the model first. May be called again.
        """
        with paused_tape():
            self._tape.zero()
            for name, gradient in of_results.items():
                wp.copy(self.results[name].grad, gradient)
            self._tape.backward()
            of_inputs = {name: wp.clone(array.grad) for name, array in self._inputs.items()}
            of_controls = {name: wp.clone(array.grad) for name, array in self._controls.items()}
        return of_inputs, of_controls
