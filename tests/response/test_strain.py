"""Strain by contacts: it is measured and warned of, and says how many substeps each world takes."""

import warnings

import newton
import numpy as np
import warp as wp
from newton_scenes import SOLVERS, Rollout, add_patch, bullet

import warp_bsc as bsc
from warp_bsc.response.substeps.strain import edges_at_rest, predict_substeps, review_substeps
from warp_bsc.response.tuning import STRAIN, SUBSTEP_STRAIN, SUBSTEPS


def test_lengths_at_rest_are_those_of_the_material(device):
    """Edges of cloth and of a soft body, apart from where they are now."""
    builder = newton.ModelBuilder()
    add_patch(builder, 2, 0.05, (0.0, 0.0, 1.0))
    sizes = {"dim_x": 1, "dim_y": 1, "dim_z": 1, "cell_x": 0.1, "cell_y": 0.2, "cell_z": 0.3}
    material = {"density": 100.0, "k_mu": 1e4, "k_lambda": 1e4, "k_damp": 0.0}
    builder.add_soft_grid(pos=wp.vec3(), rot=wp.quat_identity(), vel=wp.vec3(), **sizes, **material)
    x = np.array(builder.particle_q)
    builder.particle_q = [wp.vec3(*row) for row in 2.0 * x]
    edges, lengths, is_solid = edges_at_rest(builder.finalize(device=device))
    assert np.allclose(lengths, np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1), rtol=1e-5)
    assert is_solid.tolist() == (edges >= 9).all(axis=1).tolist()
    assert len(edges) == 16 + 18


def test_each_world_takes_the_substeps_that_it_needs(device):
    """Three worlds, of which one takes none, in one model and each in a model of its own."""
    speeds = 0.1, 8.0, 60.0
    worlds, alone = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0)), []
    for speed in speeds:
        world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        add_patch(world, 8, 0.05, (0.0, 0.0, 0.0), fixed=True)
        add_patch(world, 4, 0.03, (0.011, 0.017, 2e-4 + 0.004 * speed), velocity=(0.0, 0.0, -speed))
        worlds.add_world(world)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_world(world)
        alone.append(builder)
    rollouts = []
    for builder in (worlds, *alone):
        builder.color()
        model = builder.finalize(device=device)
        solver = bsc.SolverCCD(newton.solvers.SolverVBD(model, iterations=5), separation=2e-4, substeps="auto")
        rollouts.append(Rollout(model, solver))
    substeps = []
    for _ in range(3):
        for rollout in rollouts:
            rollout.step()
        numbers = [rollout.solver.report.substeps for rollout in rollouts]
        assert numbers[0] == max(numbers[1:])
        substeps.append(numbers[1:])
        expected = np.concatenate([rollout.positions for rollout in rollouts[1:]])
        assert rollouts[0].positions.tobytes() == expected.tobytes()
    assert any(len(set(numbers)) == 3 for numbers in substeps)
    assert all(rollout.solver.report.totals.uncertified_steps == 0 for rollout in rollouts)


def test_the_report_says_where_auto_takes_none(device):
    """The default takes substeps behind solvers that can be restored, and none elsewhere."""
    model, builder = bullet(20.0, device=device), newton.ModelBuilder()
    add_patch(builder, 2, 0.05, (0.0, 0.0, 0.0))
    differentiable = builder.finalize(device=device, requires_grad=True)

    class Outer(newton.solvers.SolverBase):
        def __init__(self, inner):
            super().__init__(inner.model)
            self.entries = [inner]

    for inner, expected in (
        (SOLVERS["vbd"](model), None),
        (SOLVERS["xpbd"](model), None),
        (SOLVERS["semi_implicit"](model), "explicit"),
        (SOLVERS["semi_implicit"](differentiable), "requires gradients"),
        (Outer(SOLVERS["vbd"](model)), "Outer steps other solvers"),
    ):
        omitted = bsc.SolverCCD(inner).report.substeps_omitted
        assert omitted is None if expected is None else expected in omitted


def test_strain_is_reported_and_warned_of_once(device):
    """A patch at 20 m/s stretches a sheet far in a step as a whole; substeps do not, and nobody warns of them."""
    for substeps in (None, "auto"):
        model = bullet(20.0, device=device)
        rollout = Rollout(model, bsc.SolverCCD(SOLVERS["vbd"](model), substeps=substeps))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            strains = []
            for _ in range(8):
                rollout.step()
                strains.append(rollout.solver.report.strain)
                assert rollout.solver.report.certified
        of_strain = [str(warning.message) for warning in caught if "strained an edge" in str(warning.message)]
        strained = rollout.solver.report.totals.strained_steps
        assert strained == np.count_nonzero(np.array(strains) > 0.2)
        assert len(of_strain) == min(strained, 1)
        if substeps is None:
            assert strained > 0 and "substeps='auto'" in of_strain[0]
        else:
            assert max(strains) < 0.2


def test_numbers_of_substeps_rise_at_once_and_fall_slowly(device):
    """Half as many after 16 calm steps; a number that soon was too small is not tried again at rest."""
    number, calm, fewest = (wp.full(1, n, dtype=int, device=device) for n in (8, 0, 0))
    choices = wp.array([2, 4, 8, 16, 32], dtype=int, device=device)
    nothing, lasting, own = (wp.zeros(1, dtype=float, device=device) for _ in range(3))

    def steps(count, needed):
        """Takes steps whose strain asks for a number of substeps, and returns those of the last."""
        for _ in range(count):
            n = max(1, int(number.numpy()[0]))
            strain = wp.full(1, needed * float(SUBSTEP_STRAIN * STRAIN) / n, dtype=float, device=device)
            arrays = [own, strain, nothing, choices, number, calm, fewest, lasting]
            wp.launch(predict_substeps, 1, inputs=arrays, device=device)
        return int(number.numpy()[0])

    assert steps(16, 1.0) == 8 and steps(1, 1.0) == 4
    assert steps(1, 7.0) == 8  # too soon
    assert steps(2000, 1.0) == 8  # 4 are not tried again
    assert steps(1, 31.0) == 32  # something new
    assert steps(100, 17.0) == 32  # more than half
    assert steps(200, 0.0) == 0
    number.fill_(8)
    own.fill_(0.05)  # of a whole step, without contacts
    assert steps(200, 0.0) == 8


class Review:
    """Reviews substeps of one world and predicts the next, as a step does with the strains that it is given."""

    def __init__(self, device):
        self.device = device
        self.number, self.calm, self.fewest = self._new(4), self._new(0), self._new(0)
        self.missed, self.lasting = self._new(0.0, float), self._new(0.0, float)
        self.choices = wp.array(SUBSTEPS, dtype=int, device=device)

    def _new(self, value, dtype=int):
        return wp.full(1, value, dtype=dtype, device=self.device)

    def step(self, *final_strains, strain=0.002):
        """Takes a step of 4 substeps after which contacts strain an element; returns how often it took them."""
        self.number.fill_(4)
        for number, final in enumerate(final_strains, 1):
            pending, strains = self._new(1), [self._new(strain, float), self._new(final, float)]
            inputs = [*strains, self.choices, self._new(number), self._new(1), self.number, self.missed, self.lasting]
            chosen = wp.zeros(len(SUBSTEPS), dtype=int, device=self.device)
            outputs = [pending, chosen, self._new(0), self._new(0), self._new(0.0, float)]
            wp.launch(review_substeps, 1, inputs, outputs, device=self.device)
            if not pending.numpy()[0]:
                break
        outputs = [self.number, self.calm, self.fewest, self.lasting]
        inputs = [self._new(0.0, float), *strains, self.choices]
        wp.launch(predict_substeps, 1, inputs, outputs, device=self.device)
        return number


def test_strain_that_repeats_do_not_lower_is_left(device):
    """Substeps are repeated for it until they have not helped, and again only once it has grown."""
    review = Review(device)
    assert review.step(0.05, 0.03, 0.01) == 3 and review.lasting.numpy()[0] == 0.0
    assert review.step(0.05, 0.045, 0.0) == 2
    assert review.step(0.05) == review.step(0.056) == 1 and review.number.numpy()[0] == 4
    assert review.step(0.06, 0.01) == 2
    for _ in range(100):  # what is past is forgotten
        assert review.step(0.0) == 1
    assert review.step(0.05, 0.01) == 2


def test_what_lasts_is_no_reason_for_substeps(device):
    """Fewer are taken once the strain in them has asked for fewer for a while."""
    review = Review(device)
    review.step(0.05, 0.05)
    numbers = []
    for _ in range(16):
        review.step(0.05)
        numbers.append(int(review.number.numpy()[0]))
    assert numbers == [4] * 15 + [2]
