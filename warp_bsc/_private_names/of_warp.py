"""Names and contracts of Warp."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any

import warp as wp

from .._warnings import warn_caller
from .versions import missing, warn_if_untested


def cpu_graph() -> Any:
    """Returns the :class:`warp.Graph` that the CPU captures.

    Contract: ``warp._src.context.runtime._apic_graph`` is the graph from ``capture_begin`` to ``capture_end``. Python
    functions in a graph on the CPU, see :mod:`.run.host_function`, live as long as it. Its attribute ``apic``
    says whether the graph is to be saved.

    Raises:
        RuntimeError: If this version of Warp has no graph of that name: operations that read results on the host then
            cannot be captured on the CPU. Graphs on CUDA do not need it.
    """
    warn_if_untested("warp")
    graph = getattr(wp._src.context.runtime, "_apic_graph", None)
    if not isinstance(getattr(graph, "apic", None), bool):
        raise RuntimeError(f"Warp {wp.__version__} does not say which graph the CPU captures: run this outside graphs")
    return graph


def may_run_in_threads(kernel: wp.Kernel) -> bool:
    """Returns whether several threads may run a kernel on the CPU at once.

    Contract: Warp releases Python's lock while a kernel runs on the CPU. Its kernels share a pointer to the stack of
    the thread that set it last, for their tiles, which a kernel without tiles does not follow once it is optimized.
    ``kernel.module.options`` holds ``mode`` and ``optimization_level``, which decide whether it is, as far as they are
    not None; :mod:`warp.config` holds the defaults.

    Where the options are gone, the answer is False, with a warning: detection on the CPU then takes one core.
    """
    warn_if_untested("warp")
    try:
        options = kernel.module.options
        mode, level = options["mode"] or wp.config.mode, options["optimization_level"]
        level = wp.config.optimization_level if level is None else level
    except (AttributeError, KeyError):
        warn_of_one_thread()
        return False
    return mode == "release" and level != 0


def on_compilation(report: Callable[[bool], None]) -> None:
    """Has a function called before each compilation of a module of this package: with whether it is for the CPU.

    Contract: ``warp._src.context.Module._run_codegen(options, is_cpu)`` is called once for each module that is
    compiled, and for none that is in the cache. The kernels of a module are the values of ``kernels``; ``func`` is the
    Python function of each. Where that name is gone, nothing is reported.
    """
    generate: Any = getattr(wp._src.context.Module, "_run_codegen", None)

    def reported(self: Any, options: dict[str, Any], is_cpu: bool) -> Any:
        if any((kernel.func.__module__ or "").startswith("warp_bsc.") for kernel in self.kernels.values()):
            report(is_cpu)
        return generate(self, options, is_cpu)

    if generate is not None:
        wp._src.context.Module._run_codegen = functools.wraps(generate)(reported)


def replace_allocation(replace: Callable[[Callable[..., None]], Callable[..., None]]) -> None:
    """Replaces Warp's function that allocates arrays, and fails without memory; nothing where its name is gone.

    Contract: ``warp.array._init_new(self, dtype, shape, strides, device, pinned)`` raises "Failed to allocate ...".
    """
    arrays: Any = wp.array
    if hasattr(arrays, "_init_new"):
        arrays._init_new = replace(arrays._init_new)


@functools.cache
def warn_of_one_thread() -> None:
    warn_caller(
        f"Warp {wp.__version__} does not say how kernels were compiled: warp-bsc runs them on one core of the CPU"
    )


@contextlib.contextmanager
def paused_tape() -> Iterator[wp.Tape | None]:
    """Pauses the active tape, if any, so that it records no launches, and yields it; None if there is none.

    Contract: ``warp._src.context.runtime.tape`` is the active :class:`warp.Tape`, or None. A tape that is exited and
    entered again continues its record.

    Raises:
        RuntimeError: If this version of Warp has no such name: a tape would record kernels of the stage, and gradients
            would be wrong.
    """
    runtime = wp._src.context.runtime
    if not hasattr(runtime, "tape"):
        raise missing("warp", "context.runtime.tape", "a step cannot pause the active tape")
    tape = runtime.tape
    if tape is None:
        yield None
        return
    tape.__exit__(None, None, None)
    try:
        yield tape
    finally:
        tape.__enter__()


_make_empty = functools.cache(lambda struct: struct())


def struct_type(struct: Any) -> Any:
    """Returns the type of a Warp struct.

    Contract: Instances of a :class:`warp.struct` have their type as ``_cls``.

    Raises:
        RuntimeError: If they do not: steps cannot be recorded, and adjoints not be launched then.
    """
    if not hasattr(struct, "_cls"):
        raise missing("warp", "attribute _cls of structs", "steps carry no gradients")
    return struct._cls


def empty_struct(value: Any) -> Any:
    """Returns a struct without arrays, of the type of a value that is a Warp struct; None for other values.

    It takes the place of the gradient of a struct whose arrays have gradients of their own. Errors are those of
    :func:`struct_type`.
    """
    return _make_empty(struct_type(value)) if wp.types.is_struct(value) else None


def struct_fields(struct: Any) -> list[str]:
    """Returns the names of the fields of a Warp struct, in their order.

    Contract: A :class:`warp.struct` has its fields by name as ``vars``.

    Raises:
        RuntimeError: If it does not.
    """
    if not hasattr(struct, "vars"):
        raise missing("warp", "attribute vars of structs", "the stage cannot be constructed")
    return list(struct.vars)
