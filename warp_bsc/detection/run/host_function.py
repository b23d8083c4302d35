"""Python functions as nodes of a graph on the CPU, which run at each replay, like cudaLaunchHostFunc on CUDA.

Warp captures a graph on the CPU as a list of kernel launches with their dimensions, and runs no kernel while it
captures. A function that reads numbers between launches (the length of a queue, whether to go on) cannot be captured as
this list: its branches and dimensions would stay those of the capture. Here the list holds one kernel, which calls the
function.
"""

import ctypes
import functools
import itertools
import threading
import traceback
import weakref
from collections.abc import Callable
from dataclasses import dataclass

import warp as wp

from ..._private_names.of_warp import cpu_graph
from .launch import launch


@dataclass(eq=False)
class _Failure:
    """Failure of a graph in its current replay.

    Attributes:
        flag: Whether one of its functions has failed, array of one int.
        raise_error: The C function that raises the error, which must live until the kernel has called it.
    """

    flag: wp.array
    raise_error: object = None


functions_of_graphs: dict[int, tuple[Callable[[], object], _Failure]] = {}
"""By number, each function in a graph that exists, with the failure of its graph."""

_numbers = itertools.count()

_failures: weakref.WeakKeyDictionary[object, _Failure] = weakref.WeakKeyDictionary()


@ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int64)
def _call(number: int) -> int | None:
    """Calls a function, and returns None or the address of a C function that raises its error in this thread.

    ctypes would print an error that is raised here, and go on. The C function, which the kernel calls, sets an
    exception that Python raises once the launch of the graph has returned to it.
    """
    function, failure = functions_of_graphs[number]
    try:
        function()
    except BaseException as error:  # Ctrl-C as well
        traceback.print_exc()
        failure.flag.fill_(1)
        kind, text = type(error), str(error)
        # Python makes the exception from a class alone, so that the class must hold the message
        members = {"__init__": lambda self: kind.__init__(self, text), "__module__": kind.__module__}
        set_error = functools.partial(
            ctypes.pythonapi.PyThreadState_SetAsyncExc,
            ctypes.c_ulong(threading.get_ident()),
            ctypes.py_object(type(kind.__name__, (kind,), members)),
        )
        failure.raise_error = raise_error = ctypes.CFUNCTYPE(ctypes.c_int)(set_error)
        return ctypes.cast(raise_error, ctypes.c_void_p).value
    return None


@wp.func_native(
    """
    if (failed.data[0])
        return;
    const wp::uint64 raise_error = ((wp::uint64 (*)(wp::int64))call)(number);
    if (raise_error)
        ((wp::int32 (*)())raise_error)();
    """
)
def _call_native(call: wp.uint64, number: wp.int64, failed: wp.array[int]):
    """Calls :func:`_call`, whose address is given, unless a function has failed in this replay; raises its error."""
    ...


@wp.kernel(enable_backward=False, module="unique")
def _call_kernel(
    # in
    call: wp.uint64,
    number: wp.int64,
    # in and out
    failed: wp.array[int],
):
    _call_native(call, number, failed)


def run_on_host(function: Callable[[], object], device: wp.Device) -> None:
    """Calls a function now or, while the CPU captures a graph, at each replay of that graph.

    If the function fails at a replay, its traceback is printed, the remaining functions of the graph are skipped in
    that replay, and the error is raised where the graph is launched.

    Args:
        function: Function without arguments. It must hold references to all arrays that it uses.
        device: Device on which the function launches kernels.

    Raises:
        RuntimeError: If the graph is to be saved to a file, which cannot hold a function.
    """
    if not (device.is_cpu and device.is_capturing):
        function()
        return
    graph = cpu_graph()
    if graph.apic:
        raise RuntimeError("a graph that is to be saved cannot hold this: it runs Python at each replay")
    if graph not in _failures:
        _failures[graph] = _Failure(wp.empty(1, dtype=int, device=device))
        _failures[graph].flag.zero_()  # at the start of each replay
    failure = _failures[graph]
    number = next(_numbers)
    functions_of_graphs[number] = function, failure
    weakref.finalize(graph, functions_of_graphs.pop, number)
    call = ctypes.cast(_call, ctypes.c_void_p).value
    launch(_call_kernel, 1, inputs=[call, number, failure.flag], device=device, record_tape=False)
