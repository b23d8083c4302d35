"""What the stage uses of Warp and Newton beyond their public interfaces, in installed versions and without it."""

import contextlib
import re
import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton.solvers import SolverBase, SolverStyle3D, SolverVBD, SolverXPBD
from newton_scenes import DT, SOLVERS

import warp_bsc as bsc
from warp_bsc._private_names import of_newton, of_warp, versions
from warp_bsc.response.substeps.inner_contacts import _SoftContacts


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


def contacts_of(model):
    """Contacts of particles with the shapes of a model."""
    contacts = (pipeline := newton.CollisionPipeline(model)).contacts()
    pipeline.collide(model.state(), contacts)
    return contacts


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


def test_self_contact_cuts_in_the_method_of_its_name(device):
    """Without self-contact, the method cuts nothing; in a solver, another one takes its place."""
    solver = vbd_with_self_contact(sheet_above_sphere(device, speed=60.0))
    lengths, truncate = [], of_newton.vbd_truncation(solver)
    for cuts in (True, False):
        solver.particle_enable_self_contact = cuts
        solver.particle_displacements.fill_(wp.vec3(0.0, 0.0, 1.0))
        truncate(solver.model.state(), None)
        lengths.append(solver.particle_displacements.numpy()[:, 2].max())
    assert lengths[0] < 0.01 and lengths[1] == 1.0
    solver.particle_enable_self_contact, calls = True, []
    for _ in range(2):
        with of_newton.vbd_truncation_replaced(solver, lambda *given: calls.append(given)):
            step(solver, solver.model)
        assert of_newton.vbd_truncation(solver) == truncate and "_penetration_free_truncation" not in vars(solver)
    assert len(calls) >= 2 * 3


def test_without_that_method_the_speed_limit_stays_and_a_warning_says_so(device, monkeypatch):
    model = sheet_above_sphere(device)
    monkeypatch.delattr(SolverVBD, "_penetration_free_truncation")
    inner = vbd_with_self_contact(model)
    with pytest.warns(UserWarning, match=r"no SolverVBD._penetration_free_truncation.*limits the speed"):
        solver = bsc.SolverCCD(inner)
    assert not solver.report.speed_limit_lifted
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bsc.SolverCCD(inner, lift_speed_limit=False)


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


@pytest.mark.parametrize("kind", [SolverVBD, SolverStyle3D])
def test_which_steps_allocate(kind, device):
    model = sheet_above_sphere(device)
    solver = kind(model)
    allocates = kind is SolverStyle3D and device.is_cuda
    assert of_newton.may_allocate(solver) is allocates
    if kind is SolverStyle3D:
        solver.collision = None  # as in steps with substeps
    states, control = [model.state(), model.state()], model.control()
    for _ in range(2):  # the first steps may
        solver.step(*states, control, None, DT)
    totals = []
    for run in (lambda: None, lambda: solver.step(*states, control, None, DT), lambda: wp.zeros(1, device=device)):
        with wp.ScopedMemoryTracker(report_func=(reports := []).append):  # which counts on from the last report
            run()
        totals.append(re.findall(r"Total allocations:\s*([^P]*)", "".join(reports)))
    assert totals[0] != totals[2]
    assert (totals[0] != totals[1]) is allocates


@pytest.mark.parametrize("kind", ["rigid", "soft"])
def test_which_contacts_have_room(kind, device, monkeypatch):
    model = sheet_above_sphere(device, body=True)
    solver, smaller = SolverVBD(model), newton.CollisionPipeline(model).contacts()
    larger = newton.CollisionPipeline(model, **{f"{kind}_contact_max": 5000}).contacts()
    states, control = [model.state(), model.state()], model.control()
    assert of_newton.has_room(solver, None)
    solver.step(*states, control, smaller, DT)
    assert of_newton.has_room(solver, smaller)
    assert not of_newton.has_room(solver, larger)
    solver.step(*states, control, larger, DT)
    assert of_newton.has_room(solver, smaller) and of_newton.has_room(solver, larger)
    monkeypatch.delattr(solver, "body_body_contact_penalty_k" if kind == "rigid" else "body_particle_contact_penalty_k")
    assert not of_newton.has_room(solver, smaller)


def test_style3d_takes_substeps_in_a_graph(device):
    """Also on a GPU, where its steps allocate memory, a graph takes a given number of substeps."""
    model, ends = sheet_above_sphere(device), []
    for in_graph in (False, True):
        solver = bsc.SolverCCD(SolverStyle3D(model), substeps=2)
        start, end = model.state(), model.state()
        solver.step(start, end, model.control(), None, DT)
        solver.reset(start)
        with wp.ScopedCapture(device) if in_graph else contextlib.nullcontext() as capture:
            solver.step(start, end, model.control(), None, DT)
        if in_graph:
            wp.capture_launch(capture.graph)
        assert solver.report.certified
        assert solver.report.hits > 0
        ends.append(end.particle_q.numpy())
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-7 if device.is_cuda else 0.0)  # its sums are atomic on a GPU


def test_steps_of_other_solvers_may_allocate(device):
    class Derived(SolverVBD):
        pass

    model = sheet_above_sphere(device)
    with_pipeline = SolverVBD(model, collision_pipeline=newton.CollisionPipeline(model))
    assert all(map(of_newton.may_allocate, (SolverXPBD(model), Derived(model), with_pipeline)))


@pytest.mark.parametrize("kind", [SolverVBD, SolverStyle3D, SolverXPBD])
def test_attributes_hold_all_that_a_step_changes(kind, device):
    """A step after which arrays and attributes of the solver are restored can be repeated, bit by bit on a CPU."""
    model = sheet_above_sphere(device, body=kind is SolverVBD)
    solver = kind(model)
    if kind is SolverStyle3D:
        solver.collision = None  # as in steps with substeps
    attributes = of_newton.attributes_of(solver)
    kept = dict(attributes)
    arrays = {name: wp.clone(value) for name, value in kept.items() if isinstance(value, wp.array) and value.size}
    ends = []
    for _ in range(2):
        ends.append(step(solver, model))
        attributes.update(kept)
        for name, array in arrays.items():
            wp.copy(kept[name], array)
    for name in ("particle_q", "particle_qd", *(["body_q", "body_qd"] if model.body_count else [])):
        first, second = (getattr(end, name).numpy() for end in ends)
        assert np.isfinite(first).all()
        in_any_order = device.is_cuda and kind is not SolverVBD  # the others add up floats by atomic operations
        np.testing.assert_allclose(first, second, rtol=1e-5 if in_any_order else 0.0, atol=1e-9 * in_any_order)


def test_a_solver_with_slots_takes_no_substeps(device):
    class Slotted(SolverBase):
        __slots__ = ("clock",)

    model = sheet_above_sphere(device)
    with pytest.raises(RuntimeError, match="Slotted has slots, clock, which substeps cannot restore"):
        of_newton.attributes_of(Slotted(model))


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
    with pytest.raises(RuntimeError, match=r"no SolverStyle3D.collision.*omit substeps"):
        of_newton.with_contacts(solver, None).__enter__()


def test_soft_contacts_have_arrays_and_counters(device):
    contacts = contacts_of(sheet_above_sphere(device))
    names = of_warp.struct_fields(_SoftContacts)
    arrays = of_newton.soft_contact_arrays(contacts, names)
    assert set(names) - arrays.keys() == {"features"} and contacts._soft_contact_mesh_features is None
    assert {name for name in vars(contacts) if name.startswith("soft_contact_")} == {
        *(f"soft_contact_{name}" for name in arrays),
        *("soft_contact_count", "soft_contact_max", "soft_contact_tids"),  # the last is not of contacts but of threads
    }
    counters = wp.clone(contacts.contact_counters)
    count, overflow = of_newton.soft_contact_counters(contacts, counters)
    assert count.numpy()[0] == contacts.soft_contact_count.numpy()[0] > 0 and overflow.numpy()[0] == 0
    others = {name: wp.zeros_like(array) for name, array in arrays.items()}
    packed = of_newton.contacts_with(contacts, counters, others)
    assert packed.soft_contact_normal is others["normal"] is not contacts.soft_contact_normal
    assert packed.soft_contact_count.ptr == counters[1:2].ptr != contacts.soft_contact_count.ptr
    assert packed._soft_contact_source_overflow.ptr == counters[3:4].ptr
    assert packed.rigid_contact_shape0 is contacts.rigid_contact_shape0


@pytest.mark.parametrize(
    "name", ["_soft_contact_mesh_features", "_soft_contact_source_overflow", "soft_contact_normal"]
)
def test_without_them_contacts_are_refused_in_steps_with_substeps(name, device, monkeypatch):
    model = sheet_above_sphere(device)
    contacts, solver = contacts_of(model), bsc.SolverCCD(SOLVERS["vbd"](model), substeps=2)
    monkeypatch.delattr(contacts, name)
    with pytest.raises(RuntimeError, match=rf"newton .* has no Contacts.{name}.*cannot be left out"):
        step(solver, model, contacts, 1.0 / 60.0)


def test_counters_in_another_order_are_refused(device):
    contacts = contacts_of(sheet_above_sphere(device))
    contacts.soft_contact_count = contacts.contact_counters[2:3]
    with pytest.raises(RuntimeError, match=r"no Contacts.soft_contact_count as number 1 of Contacts.contact_counters"):
        of_newton.soft_contact_counters(contacts, contacts.contact_counters)
