"""Forces over elements of one kind, such as contacts, evaluated and differentiated by Warp, or by a kernel by hand.

Every kernel of them has the same form. Thread (e, row) reads the positions of the particles of element e at the end and
at the start of the step, ``x1[e, row]`` and ``x0[e, row]``, and writes ``forces[e, row]``. There is one row to compute
forces. To compute a Jacobian there is one row for each component of force: the adjoint of row i, given unit vector i,
is row i of the Jacobian. All is computed in float64 from the values in float32.
"""

import numpy as np
import warp as wp

from ..._private_names.of_warp import empty_struct, struct_fields, struct_type
from . import element_kernels
from .arrays import launch_adjoint, with_gradient


class Elements:
    """Elements of one kind, each with the same number of particles, and a kernel that computes the forces on these.

    The buffers are made once, and hold what belongs to one step at a time.

    Attributes:
        vertices: Vertices of the elements, -1 for none, int32, shape [capacity, size].
        rows: The unknown of each of these, -1 for none.
        count: Elements in use.
        parameters: What the kernel reads beside positions; arrays that require gradients get them.
        forces: Forces on the vertices, vec3d, shape [capacity, 1, size].
        jacobian: Derivatives of the forces with respect to positions at the end, float64, shape
            [capacity, 3 size, size] of vec3: row 3 i + j belongs to component j of the force on particle i.
    """

    def __init__(self, kernel: wp.Kernel, vertices: wp.array, rows: wp.array, jacobians: wp.Kernel | None = None):
        """Allocates buffers for forces on ``vertices`` by a kernel of the form above; ``rows`` are their unknowns.

        The kernel ``jacobians`` computes Jacobians from the same but the time, in place of adjoints, a corner each.
        """
        self._jacobians = jacobians
        self.kernel, self.vertices, self.rows, self.parameters = kernel, vertices, rows, []
        self.device = device = vertices.device
        self.count, self._size = vertices.shape
        shape, components = (self.count, 1, self._size), 3 * self._size

        def zeros(*dimensions):
            return wp.zeros(dimensions, dtype=wp.vec3d, device=device)

        self._x1, self._x0, self.forces = zeros(*shape), zeros(*shape), zeros(*shape)
        self._of_x1, self._of_x0, self._of_forces = zeros(*shape), zeros(*shape), zeros(*shape)
        self.jacobian = zeros(self.count, components, self._size)
        if jacobians is None:
            units = np.eye(components).reshape(1, components, self._size, 3)
            self._units = wp.array(units, dtype=wp.vec3d, device=device)

    def load(self, x1: wp.array, x0: wp.array) -> None:
        """Takes positions of vertices at the end and at the start of a step, vec3d."""
        shape = self.count, self._size
        self._launch(element_kernels.gather, shape, [self.vertices, x1], [self._x1])
        self._launch(element_kernels.gather, shape, [self.vertices, x0], [self._x0])

    def compute_forces(self, dt: float) -> None:
        """Computes the forces on the vertices of each element."""
        inputs = [wp.float64(dt), self._x1, self._x0, *self.parameters]
        self._launch(self.kernel, (self.count, 1), inputs, [self.forces])

    def differentiate(self, dt: float) -> None:
        """Computes the Jacobian."""
        if self._jacobians is not None:
            inputs = [self._x1, self._x0, *self.parameters]
            self._launch(self._jacobians, (self.count, self._size), inputs, [self.jacobian])
            return
        shape = self.count, 3 * self._size, self._size
        x1, x0, units = (_repeated(array, shape) for array in (self._x1, self._x0, self._units))
        self.jacobian.zero_()
        constants = [without_gradients(value) for value in self.parameters]
        adjoints = [None, self.jacobian, None, *(empty_struct(value) for value in constants)]
        inputs = [wp.float64(dt), x1, x0, *constants]
        options = {"adj_inputs": adjoints, "adj_outputs": [units], "adjoint": True, "device": self.device}
        wp.launch(self.kernel, shape[:2], inputs=inputs, outputs=[units], **options)

    def add_blocks(self, blocks: wp.array, *, is_fixed: wp.array, leave_out: wp.array | None = None) -> None:
        """Subtracts the blocks of the Jacobian on the diagonal from those of unknowns, mat33d.

        Elements with ``leave_out``, not 0, are left out.
        """
        inputs = [self.rows, is_fixed, leave_out, self.jacobian]
        self._launch(element_kernels.add_blocks, (self.count, self.rows.shape[1]), inputs, [blocks])

    def add_gradients(self, dt: float, of_forces: wp.array, of_x1: wp.array, of_x0: wp.array) -> None:
        """Adds gradients with respect to positions of vertices, given those with respect to forces on unknowns, vec3d.

        Parameters that require gradients get them as well.
        """
        shape = self.count, self._size
        for array in (self._of_x1, self._of_x0):
            array.zero_()
        self.gather_multipliers(of_forces, self._of_forces)
        x1, x0 = with_gradient(self._x1, self._of_x1), with_gradient(self._x0, self._of_x0)
        inputs = [wp.float64(dt), x1, x0, *self.parameters]
        launch_adjoint(self.kernel, (self.count, 1), inputs, [self._of_forces], self.device)
        self._launch(element_kernels.scatter, shape, [self.vertices, self._of_x1], [of_x1])
        self._launch(element_kernels.scatter, shape, [self.vertices, self._of_x0], [of_x0])

    def gather_multipliers(self, of_unknowns: wp.array, of_vertices: wp.array) -> None:
        """Copies gradients with respect to forces on unknowns to the vertices of each element."""
        self._launch(element_kernels.gather, (self.count, self._size), [self.rows, of_unknowns], [of_vertices])

    def _launch(self, kernel, size, inputs, outputs):
        wp.launch(kernel, size, inputs=inputs, outputs=outputs, device=self.device)


def without_gradients(value):
    """Returns an array, or a struct with arrays, of the same values without gradients; other values as they are."""
    if wp.types.is_struct(value):
        constant = struct_type(value)()
        for name in struct_fields(struct_type(value)):
            setattr(constant, name, without_gradients(getattr(value, name)))
        return constant
    if not isinstance(value, wp.array) or not value.requires_grad:
        return value
    return wp.array(ptr=value.ptr, dtype=value.dtype, shape=value.shape, strides=value.strides, device=value.device)


def _repeated(values: wp.array, shape: tuple[int, ...]) -> wp.array:
    """Returns an array that repeats values along all dimensions of length 1; it does not keep the values alive."""
    strides = [0 if n == 1 else stride for n, stride in zip(values.shape, values.strides, strict=True)]
    return wp.array(ptr=values.ptr, dtype=values.dtype, shape=shape, strides=tuple(strides), device=values.device)
