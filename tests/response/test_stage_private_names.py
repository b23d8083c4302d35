"""What the stage uses of Warp and Newton beyond their public interfaces, in installed versions and without it."""

import types
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD, SolverXPBD
from newton_scenes import DT, SOLVERS

import warp_bsc as bsc
from warp_bsc._private_names import of_newton, of_warp, versions


@wp.struct
class Pair:
    """A struct with two fields."""

    first: wp.array[float]
    second: int


@wp.kernel
def double(x: wp.array[float], y: wp.array[float]):
    """Writes twice the values."""
    i = wp.tid()
    y[i] = 2.0 * x[i]


def sheet_above_sphere(device, *, body=False, speed=-1.0):
    """A model of cloth that falls onto a sphere, which is a dynamic body or stands still."""
    builder = newton.ModelBuilder()
    SolverStyle3D.register_custom_attributes(builder)
    builder.add_shape_sphere(builder.add_body() if body else -1, radius=0.1)
    newton.solvers.style3d.add_cloth_grid(
        builder,
        pos=wp.vec3(-0.1, -0.1, 0.105),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, speed),
        **{"dim_x": 4, "dim_y": 4, "cell_x": 0.05, "cell_y": 0.05, "mass": 5e-4, "particle_radius": 0.002},
        tri_aniso_ke=wp.vec3(1e2, 1e2, 1e1),
        edge_aniso_ke=wp.vec3(2e-5, 1e-5, 5e-6),
    )
    builder.color()
    return builder.finalize(device=device)


def vbd_with_self_contact(model):
    margins = {"particle_self_contact_margin": 0.002, "particle_self_contact_gap": 0.0015}
    return SolverVBD(model, iterations=3, particle_enable_self_contact=True, **margins)


def step(solver, model, contacts=None, dt=DT):
    """The state after a step."""
    start, end = model.state(), model.state()
    solver.step(start, end, model.control(), contacts, dt)
    return end


@pytest.mark.parametrize("package", [wp, newton])
def test_a_stage_warns_once_of_a_version_that_was_not_tested(package, monkeypatch):
    monkeypatch.setattr(package, "__version__", "99.1.0")
    versions.warn_if_untested.cache_clear()
    model = sheet_above_sphere("cpu")
    with pytest.warns(UserWarning, match=rf"{package.__name__}, and was tested with its versions .*, not with 99.1.0"):
        bsc.SolverCCD(SOLVERS["vbd"](model))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bsc.SolverCCD(SOLVERS["vbd"](model))
    versions.warn_if_untested.cache_clear()


def test_a_paused_tape_records_nothing_and_continues_afterwards(device):
    x = wp.ones(2, dtype=float, device=device, requires_grad=True)
    y, z, w = (wp.zeros_like(x) for _ in range(3))
    with wp.Tape() as tape:
        wp.launch(double, 2, inputs=[x], outputs=[y], device=device)
        with of_warp.paused_tape() as paused:
            wp.launch(double, 2, inputs=[y], outputs=[z], device=device)
        wp.launch(double, 2, inputs=[y], outputs=[w], device=device)
    assert paused is tape and len(tape.launches) == 2
    tape.backward(grads={w: wp.ones_like(w)})
    np.testing.assert_array_equal(x.grad.numpy(), 4.0)
    with of_warp.paused_tape() as paused:
        assert paused is None


def test_without_the_name_of_the_tape_a_step_is_refused(device, monkeypatch):
    model = sheet_above_sphere(device)
    solver = bsc.SolverCCD(SOLVERS["vbd"](model))
    monkeypatch.delattr(wp._src.context.runtime, "tape")
    with pytest.raises(RuntimeError, match=r"warp .* has no context.runtime.tape.*the active tape"):
        step(solver, model)


def test_structs_have_their_type_and_their_fields(monkeypatch):
    value = Pair()
    value.first = wp.zeros(3, dtype=float, device="cpu")
    empty = of_warp.empty_struct(value)
    assert type(empty) is type(value) and not len(empty.first or ())
    assert of_warp.empty_struct(value.first) is of_warp.empty_struct(1.0) is None
    assert of_warp.struct_fields(Pair) == ["first", "second"]
    monkeypatch.delattr(type(value), "_cls")
    with pytest.raises(RuntimeError, match=r"warp .* has no attribute _cls of structs.*no gradients"):
        of_warp.empty_struct(value)
    monkeypatch.delattr(Pair, "vars")
    with pytest.raises(RuntimeError, match=r"warp .* has no attribute vars of structs"):
        of_warp.struct_fields(Pair)


def test_vbd_says_whether_it_moves_bodies(device, monkeypatch):
    model = sheet_above_sphere(device, body=True)
    kinds = {external: SolverVBD(model, integrate_with_external_rigid_solver=external) for external in (True, False)}
    for external, solver in kinds.items():
        assert of_newton.has_external_rigid_solver(solver) is external
    assert not of_newton.has_external_rigid_solver(SolverXPBD(model))
    monkeypatch.delattr(kinds[True], "integrate_with_external_rigid_solver")
    with pytest.raises(RuntimeError, match=r"no SolverVBD.integrate_with_external_rigid_solver.*moves bodies"):
        bsc.SolverCCD(kinds[True])


def test_vbd_has_the_poses_from_which_velocities_follow(device, monkeypatch):
    model = sheet_above_sphere(device, body=True)
    solver = SOLVERS["vbd"](model)
    end = step(solver, model)  # the first step sets the poses to those of the state
    moved = end.body_q.numpy().copy()
    moved[:, 0] -= 0.01
    of_newton.body_q_prev(solver).assign(moved)
    again = model.state()
    solver.step(end, again, model.control(), None, DT)
    assert again.body_qd.numpy()[0, 0] == pytest.approx(0.01 / DT, rel=0.1)
    external = SolverVBD(model, integrate_with_external_rigid_solver=True)
    assert of_newton.body_q_prev(SolverXPBD(model)) is of_newton.body_q_prev(external) is None
    monkeypatch.delattr(solver, "body_q_prev")
    with pytest.raises(RuntimeError, match=r"no SolverVBD.body_q_prev.*cannot push bodies"):
        of_newton.body_q_prev(solver)


def test_style3d_has_contacts_of_its_own(device, monkeypatch):
    model = sheet_above_sphere(device)
    solver = SolverStyle3D(model)
    own = solver.collision
    assert own is not None
    with of_newton.with_contacts(solver, None):
        assert solver.collision is None
        step(solver, model)
    assert solver.collision is own
    with of_newton.with_contacts(SolverXPBD(model), None):
        pass
    monkeypatch.delattr(solver, "collision")
    with pytest.raises(RuntimeError, match=r"no SolverStyle3D.collision.*rest in two places"):
        of_newton.with_contacts(solver, None).__enter__()


class TestNewton16:
    """What stands in for what Newton 1.6 lacks."""

    def test_models_without_attachments(self):
        assert of_newton.attachment_arrays(types.SimpleNamespace()) is None
        names = of_newton.AttachmentArrays._fields
        arrays = {f"attachment_particle_body_{name}": name for name in names}
        assert of_newton.attachment_arrays(types.SimpleNamespace(attachment_particle_body_count=0, **arrays)) is None
        found = of_newton.attachment_arrays(types.SimpleNamespace(attachment_particle_body_count=1, **arrays))
        assert found == names

    def test_observables_are_refused(self, monkeypatch):
        monkeypatch.delattr(SolverBase, "validate_observables", raising=False)
        of_newton.check_observables(None, None, None)
        with pytest.raises(TypeError, match=r"observables: Newton .* has none"):
            of_newton.check_observables(None, {"contact_f"}, None)
