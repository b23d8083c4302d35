"""Python functions as nodes of a graph on the CPU: they run at each replay, as cudaLaunchHostFunc has it on CUDA.

Warp captures a graph on the CPU as the list of the kernels that are launched, with their dimensions, and runs none of
them meanwhile. A function that reads numbers between launches (how full a queue is, whether to go on) cannot be
captured like this: its branches and dimensions would be fixed at the first capture.
"""

import ctypes
import functools
import itertools
import threading
import traceback
import weakref

import warp as wp

__all__ = ["run_on_host"]

_functions = {}
"""The functions in all graphs that exist, by their numbers, each with what says that its graph has failed."""

_numbers = itertools.count()

_failures = weakref.WeakKeyDictionary()
"""By graph whether a function of it has failed in the present replay, array of one int."""


@ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int64)
def _call(number):
    """Calls a function; returns None or the address of a function without arguments that raises its error.

    Raised here an error would only be printed: it is raised when the graph has returned to Python.
    """
    function, failed = _functions[number]
    try:
        function()
    except BaseException as error:  # Ctrl-C as well
        traceback.print_exc()
        failed.fill_(1)
        kind, text = type(error), str(error)
        members = {"__init__": lambda self: kind.__init__(self, text), "__module__": kind.__module__}
        set_error = functools.partial(
            ctypes.pythonapi.PyThreadState_SetAsyncExc,
            ctypes.c_ulong(threading.get_ident()),
            ctypes.py_object(type(kind.__name__, (kind,), members)),
        )
        failed.raise_error = ctypes.CFUNCTYPE(ctypes.c_int)(set_error)  # kept, as only its address goes on from here
        return ctypes.cast(failed.raise_error, ctypes.c_void_p).value
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
def _call_native(call: wp.uint64, number: wp.int64, failed: wp.array[int]): ...


@wp.kernel(enable_backward=False, module="unique")
def _call_kernel(call: wp.uint64, number: wp.int64, failed: wp.array[int]):
    _call_native(call, number, failed)


def run_on_host(function, device) -> None:
    """Calls a function or, while the CPU captures a graph, makes it a node of that: called at each replay.

    An error of the function at a replay is raised where the graph is launched, and its traceback printed; the graph's
    other functions do not run any more in that replay.

    Args:
        function: Takes nothing, and refers to all arrays that it uses.
        device: Device that the function launches kernels on.

    Raises:
        RuntimeError: If the graph is to be saved to a file, which cannot hold a function.
    """
    if not (device.is_cpu and device.is_capturing):
        function()
        return
    graph = wp._src.context.runtime._apic_graph  # there is no public way to ask
    if graph.apic:
        raise RuntimeError("a graph that is to be saved cannot hold this: it runs Python at each replay")
    if graph not in _failures:
        _failures[graph] = wp.empty(1, dtype=int, device=device)
        _failures[graph].zero_()  # at the start of each replay
    number = next(_numbers)
    _functions[number] = function, _failures[graph]
    weakref.finalize(graph, _functions.pop, number)
    call = ctypes.cast(_call, ctypes.c_void_p).value
    wp.launch(_call_kernel, 1, inputs=[call, number, _failures[graph]], device=device, record_tape=False)
