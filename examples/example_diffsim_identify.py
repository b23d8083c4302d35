"""Example Diffsim Identify: finds how stiff a cloth is from 120 noisy frames of its drape.

    python examples/example_diffsim_identify.py
    python examples/example_diffsim_identify.py --triangles 512 --starts 1  # a finer cloth, one guess

A cloth is held by one edge, level at first, and drops. The positions of its particles in 120 frames of 1/60 s, with
noise, are what is known. Three guesses of its stiffness against stretching, ``tri_ke``, and against bending,
``edge_ke``, are improved at once, each in a world of its own, until both are within two percent of the truth. The loss
is the mean squared distance from the frames; its gradient goes back through all steps of ``SolverImplicit``.
"""

import newton
import numpy as np
import warp as wp
from common import main
from diffsim import build_worlds
from diffsim_targets import TargetExample

SIDE = 0.5  # [m]
DENSITY = 0.2  # [kg/m^2]
TRUTH = 60.0, 2.0e-2  # tri_ke [N/m], edge_ke [N]
STARTS = [(30.0, 4.0e-2), (150.0, 5.0e-3), (25.0, 6.0e-3)]
NOISE = 2.0e-3  # standard deviation of each coordinate [m]
STEPS = 120


@wp.kernel
def set_stiffness(
    # in
    logarithms: wp.array[wp.vec2],
    triangles: int,
    edges: int,
    # out
    tri_materials: wp.array2d[float],
    edge_bending_properties: wp.array2d[float],
):
    """Sets the stiffness of each triangle and edge by the logarithms of its world, which has this many of them."""
    element = wp.tid()
    if element < tri_materials.shape[0]:
        tri_materials[element, 0] = wp.exp(logarithms[element // triangles][0])
    if element < edge_bending_properties.shape[0]:
        edge_bending_properties[element, 0] = wp.exp(logarithms[element // edges][1])


class Example(TargetExample):
    """The scene, in the format of Newton's examples; a frame is an evaluation of the loss and its gradient.

    Attributes:
        truth: tri_ke [N/m] and edge_ke [N] of the cloth that is known.
        starts: The guesses.
        found: The best stiffness in each world so far, tri_ke [N/m] and edge_ke [N], shape [worlds, 2].
        errors: Relative errors of these after each evaluation, shape [worlds, 2] each.
    """

    num_frames = 9
    truth = TRUTH

    def __init__(self, viewer, args):
        super().__init__(viewer, args)
        world = newton.ModelBuilder()
        cells = max(round((args.triangles / 2) ** 0.5), 2)
        cell = SIDE / cells
        cloth = {"dim_x": cells, "dim_y": cells, "cell_x": cell, "cell_y": cell, "mass": DENSITY * cell * cell}
        cloth |= {"tri_ke": TRUTH[0], "tri_ka": TRUTH[0], "tri_kd": 1.0e-2, "edge_ke": TRUTH[1], "edge_kd": 1.0e-4}
        cloth |= {"pos": wp.vec3(), "rot": wp.quat_identity(), "vel": wp.vec3(), "fix_left": True}
        world.add_cloth_grid(**cloth)
        model = build_worlds(world, args.starts)
        model.tri_materials.requires_grad = model.edge_bending_properties.requires_grad = True
        self.per_world = world.tri_count, world.edge_count
        self.start_solver(model, (wp.vec3(0.0, -1.6, 0.0), -10.0, 90.0))
        truth, starts = (np.log(np.float32(values)) for values in ([TRUTH] * args.starts, STARTS[: args.starts]))
        self.logarithms = wp.array(truth, dtype=wp.vec2, device=model.device, requires_grad=True)
        self.prepare_descent([self.logarithms], STEPS, targets=np.zeros((STEPS, world.particle_count, 3)))
        self.forward()
        frames = self.positions()[1:, 0]
        self.targets.assign(frames + np.random.default_rng(7).normal(scale=NOISE, size=frames.shape))
        self.starts, self.errors = STARTS[: args.starts], []
        self.search_from([starts], first=0.5, longest=0.5)

    def forward(self):
        """Simulates the drapes, and computes their losses."""
        model = self.model
        inputs = [self.logarithms, *self.per_world]
        outputs = [model.tri_materials, model.edge_bending_properties]
        wp.launch(set_stiffness, max(model.tri_count, model.edge_count), inputs=inputs, outputs=outputs)
        super().forward()

    def take_recording(self, example, world):
        """Takes the frames of another example, which are those of all worlds."""
        self.targets.assign(example.targets)

    def improve(self):
        """Chooses the next stiffness, and notes the errors of the best one."""
        super().improve()
        self.found = np.exp([search.x for search in self.searches])
        self.errors.append(self.found / TRUTH - 1.0)

    def test_final(self):
        """Checks that all worlds have found both within two percent."""
        super().test_final()
        assert np.abs(self.errors[-1]).max() < 0.02, self.errors[-1]

    def print_report(self):
        """Prints what the solver did, and what was found."""
        super().print_report()
        for start, found, error in zip(STARTS, self.found, self.errors[-1], strict=False):
            errors = " and ".join(f"{value:+.2%}" for value in error)
            print(f"from {start} to tri_ke = {found[0]:.2f} N/m, edge_ke = {found[1]:.5f} N: off by {errors}")

    @classmethod
    def create_parser(cls):
        """Returns the options."""
        parser = super().create_parser()
        parser.add_argument("--triangles", type=int, default=128, help="Triangles of the cloth, about.")
        parser.add_argument("--starts", type=int, default=len(STARTS), help="How many of the guesses, the first ones.")
        return parser


if __name__ == "__main__":
    main(Example)
