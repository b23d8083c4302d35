"""Steps of the stage on a tape: they carry no gradients, and say so before anything happens."""

import itertools

import newton
import pytest
import warp as wp
from newton_scenes import SOLVERS, Still, add_patch

import warp_bsc as bsc

DT = 1.0 / 4000.0
ARRAYS = "particle_q", "particle_qd", "particle_f", "body_q", "body_qd", "body_f"


@pytest.fixture(params=["vbd", "semi_implicit"])
def inner(request, device):
    """The name of an inner solver; XPBD makes NaN of models that require gradients."""
    if request.param == "semi_implicit" and device.is_cuda:
        pytest.skip("on a GPU it adds up forces in any order")
    return request.param


def box_on_sheet(device, *, requires_grad):
    """A box that hits a sheet, which its border holds."""
    builder = newton.ModelBuilder()
    add_patch(builder, 8, 0.04, (0.0, 0.0, 0.0), fixed=True)
    body = builder.add_body(xform=wp.transform(wp.vec3(0.01, 0.02, 0.052), wp.quat_identity()))
    builder.add_shape_box(body, hx=0.05, hy=0.05, hz=0.05)
    builder.body_qd[body] = (0.0, 0.0, -12.0, 0.0, 0.0, 0.0)
    builder.color()
    return builder.finalize(device=device, requires_grad=requires_grad)


def bits_of(states):
    """All bits of some states."""
    arrays = (getattr(state, name) for state in states for name in ARRAYS)
    return [array.numpy().tobytes() for array in arrays if array is not None]


def ends_of(solver, model, steps=4):
    """The bits of the states after each of some steps, and the contacts of all."""
    states, bits, contacts = [model.state(), model.state()], [], 0
    for _ in range(steps):
        states[0].clear_forces()
        solver.step(*states, None, None, DT)
        contacts += solver.report.predicted_contacts
        states.reverse()
        bits.append(bits_of(states[:1]))
    return bits, contacts


@pytest.mark.parametrize("substeps", [1, 3])
def test_a_step_on_a_tape_is_refused_and_changes_nothing(inner, substeps, device, monkeypatch):
    """Neither the states nor the stage: its next step is that of one which was never on a tape."""
    model, called = box_on_sheet(device, requires_grad=True), []
    solvers = [SOLVERS[inner](model) for _ in range(2)]
    step = solvers[0].step
    monkeypatch.setattr(solvers[0], "step", lambda *given, **options: (called.append(given), step(*given, **options)))
    refused, other = (bsc.SolverCCD(solver, substeps=substeps) for solver in solvers)
    states = [model.state(), model.state()]
    states[1].particle_q.fill_(wp.vec3(1.0, 2.0, 3.0))
    before = bits_of(states)
    with wp.Tape() as tape, pytest.raises(NotImplementedError, match=r"SolverCCD carry no gradients.*SolverImplicit"):
        refused.step(*states, None, None, DT)
    assert called == tape.launches == [] and refused.report.totals.steps == 0
    assert bits_of(states) == before
    (ends, contacts), expected = ends_of(refused, model), ends_of(other, model)
    assert (ends, contacts) == expected and contacts > 0 and called


def test_a_model_that_requires_gradients_is_stepped_as_any_other(inner, device):
    """Without a tape, bit for bit."""
    results = []
    for requires_grad in (False, True):
        model = box_on_sheet(device, requires_grad=requires_grad)
        solver = SOLVERS[inner](model)
        results.append(ends_of(bsc.SolverCCD(solver, friction=0.3, restitution=0.2), model))
    assert results[0] == results[1] and results[0][1] > 0


def test_without_requires_grad_a_tape_stays_empty_of_the_stage(device):
    model = box_on_sheet(device, requires_grad=False)
    states, launches = [model.state() for _ in range(4)], []
    for make in (lambda solver: solver, bsc.SolverCCD):
        solver = make(Still(model))
        with wp.Tape() as tape:
            for start, end in itertools.pairwise(states):
                solver.step(start, end, None, None, DT)
        launches.append(len(tape.launches))
    assert launches[0] == launches[1]
