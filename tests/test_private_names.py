"""What the package uses of Warp and Newton without a public interface, with the installed versions and without it."""

import importlib
import types
import warnings

import pytest
import warp as wp

from warp_bsc._private_names import of_newton, of_warp, versions
from warp_bsc._private_names.tape_access import Access, access_to
from warp_bsc.detection.run.host_function import run_on_host


@pytest.fixture
def installed(monkeypatch):
    """Sets the version of a package that seems to be installed."""

    def set_version(package, version):
        monkeypatch.setattr(importlib.import_module(package), "__version__", version)

    for cached in (versions.warn_if_untested, of_warp.warn_of_one_thread):
        cached.cache_clear()
    yield set_version
    for cached in (versions.warn_if_untested, of_warp.warn_of_one_thread):
        cached.cache_clear()


@wp.kernel(module="unique", enable_backward=False)
def increment(values: wp.array[int]):
    values[wp.tid()] += 1


@pytest.mark.parametrize("package", versions.TESTED_VERSIONS)
def test_installed_versions_are_tested_ones(installed, package):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        versions.warn_if_untested(package)


@pytest.mark.parametrize("package", versions.TESTED_VERSIONS)
def test_an_untested_version_warns_once(installed, package):
    installed(package, "99.1.0")
    with pytest.warns(UserWarning, match=rf"{package}, and was tested with its versions .*, not with 99.1.0"):
        versions.warn_if_untested(package)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        versions.warn_if_untested(package)


def test_the_graph_that_the_cpu_captures():
    with wp.ScopedCapture("cpu") as capture:
        graph = of_warp.cpu_graph()
    assert graph is capture.graph
    assert graph.apic is False


def test_without_the_graph_of_the_cpu_a_capture_is_refused(monkeypatch):
    monkeypatch.setattr(wp._src.context.runtime, "_apic_graph", object())
    with pytest.raises(RuntimeError, match="does not say which graph the CPU captures: run this outside graphs"):
        of_warp.cpu_graph()


def test_functions_on_the_host_need_the_graph(monkeypatch):
    with wp.ScopedCapture("cpu"), monkeypatch.context() as patch:
        patch.setattr(wp._src.context, "runtime", types.SimpleNamespace())
        with pytest.raises(RuntimeError, match="run this outside graphs"):
            run_on_host(lambda: None, types.SimpleNamespace(is_cpu=True, is_capturing=True))


def test_optimized_kernels_may_run_in_threads(monkeypatch):
    assert of_warp.may_run_in_threads(increment)
    monkeypatch.setitem(increment.module.options, "mode", "debug")
    assert not of_warp.may_run_in_threads(increment)
    monkeypatch.setitem(increment.module.options, "mode", "release")
    monkeypatch.setitem(increment.module.options, "optimization_level", 0)
    assert not of_warp.may_run_in_threads(increment)


def test_without_the_options_of_a_kernel_it_runs_in_one_thread_and_a_warning_says_so(installed):
    kernel = types.SimpleNamespace(module=types.SimpleNamespace(options={}))
    with pytest.warns(UserWarning, match="one core of the CPU"):
        assert not of_warp.may_run_in_threads(kernel)


def test_names_are_replaced_and_one_that_is_gone_is_an_error():
    module = types.ModuleType("newton.examples")
    module.run = None
    of_newton.replace_name(module, "run", print)
    assert module.run is print
    with pytest.raises(RuntimeError, match=r"has no newton.examples.main, which warp-bsc replaces"):
        of_newton.replace_name(module, "main", print)


@wp.struct
class Values:
    x: wp.array[wp.vec3]


@wp.func
def first_of(x: wp.array[wp.vec3]):
    return x[0]


@wp.kernel(module="unique")
def access_in_many_ways(
    read: wp.array[wp.vec3],
    passed_on: wp.array[wp.vec3],
    set_part: wp.array[wp.vec3],
    added: wp.array[wp.vec3],
    added_atomically: wp.array[wp.vec3],
    values: Values,
):
    i = wp.tid()
    x = wp.vec3()
    if read:
        x = read[i] + first_of(passed_on) + values.x[i]
    set_part[i][0] = x[0]
    added[i] += x
    wp.atomic_add(added_atomically, i, x)


def test_a_tape_says_how_an_array_is_accessed():
    arrays = [wp.zeros(2, dtype=wp.vec3, device="cpu", requires_grad=True) for _ in range(8)]
    values = Values()
    values.x = arrays[5]
    with wp.Tape() as tape:
        inputs = [arrays[0][:1], *arrays[1:5], values]
        wp.launch(access_in_many_ways, 1, inputs=inputs, device="cpu")
        wp.copy(arrays[6], arrays[7])
    found = [access_to(array, tape.launches) for array in arrays]
    assert found[:6] == [Access.READ, Access.UNKNOWN, *[Access.WRITTEN] * 3, Access.UNKNOWN]
    assert found[6:] == [Access.WRITTEN, Access.READ]
    kernel = types.SimpleNamespace(adj=None)  # of another version of Warp
    assert access_to(arrays[0], [[kernel, 1, 0, [arrays[0]], []]]) is Access.UNKNOWN
