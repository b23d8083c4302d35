"""How the launches on a tape access an array, which a tape of Warp does not say."""

import ast
from collections.abc import Iterable
from enum import IntEnum
from typing import Any

import warp as wp

from .of_warp import struct_fields, struct_type


class Access(IntEnum):
    """What launches do to an array at most."""

    READ = 0
    UNKNOWN = 1
    WRITTEN = 2


def arrays_of_launch(launch: Any) -> Iterable[tuple[int | None, wp.array]]:
    """Yields the arrays that an entry of ``warp.Tape.launches`` names, each with its place in the kernel.

    The place is None in a struct and in a copy, of which only the array that it writes is known.

    Contract: A kernel is a list that begins with the kernel, and has inputs and outputs as items 3 and 4. A copy is a
    function that holds the array that it writes as ``dest``. Other functions say nothing.
    """
    if callable(launch):
        names = getattr(getattr(launch, "__code__", None), "co_freevars", ())
        for name, cell in zip(names, getattr(launch, "__closure__", None) or (), strict=True):
            if name == "dest" and isinstance(cell.cell_contents, wp.array):
                yield None, cell.cell_contents
        return
    for place, value in enumerate((*launch[3], *launch[4])):
        if isinstance(value, wp.array):
            yield place, value
        elif wp.types.is_struct(value):
            fields = (getattr(value, name) for name in struct_fields(struct_type(value)))
            yield from ((None, field) for field in fields if isinstance(field, wp.array))


def access_to(array: wp.array, launches: Iterable[Any]) -> Access:
    """Returns how entries of ``warp.Tape.launches`` access an array, also by slices of it."""
    found = Access.READ
    for launch in launches:
        for place, other in arrays_of_launch(launch):
            if not overlap(array, other):
                continue
            if callable(launch):
                found = Access.WRITTEN
            elif place is None:
                found = max(found, Access.UNKNOWN)
            else:
                found = max(found, _access_of_kernel(launch[0], place))
    return found


def overlap(array: wp.array, other: wp.array) -> bool:
    """Returns whether arrays share memory."""
    if not array.ptr or not other.ptr:
        return False
    return array.ptr < other.ptr + other.capacity and other.ptr < array.ptr + array.capacity


def _access_of_kernel(kernel, place):
    """Returns how a kernel accesses its parameter of a number, by its source.

    Contract: ``kernel.adj`` has the names of parameters in ``args`` as ``label``, and its syntax as ``tree``. Without
    them nothing is known.
    """
    try:
        name, tree = kernel.adj.args[place].label, kernel.adj.tree
    except (AttributeError, IndexError):
        return Access.UNKNOWN
    reads = 0
    for node in ast.walk(tree):
        is_store = isinstance(getattr(node, "ctx", None), ast.Store)
        if isinstance(node, ast.Subscript | ast.Attribute) and is_store and _root(node) == name:
            return Access.WRITTEN
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "").startswith("atomic_"):
            if node.args and _root(node.args[0]) == name:
                return Access.WRITTEN
        if isinstance(node, ast.Subscript | ast.Attribute):
            reads += isinstance(node.value, ast.Name) and node.value.id == name
        elif isinstance(node, ast.If | ast.IfExp):
            reads += isinstance(node.test, ast.Name) and node.test.id == name
    uses = sum(isinstance(node, ast.Name) and node.id == name for node in ast.walk(tree))
    return Access.READ if uses == reads else Access.UNKNOWN


def _root(node):
    """Returns the name of what an expression like ``x[i].y`` is a part of; None for others."""
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else None
