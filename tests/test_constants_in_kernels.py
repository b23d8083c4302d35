"""Constants in kernels: Warp reads one before it is set if a function converts it and also uses it as it is."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TYPES = {f"{kind}{bits}" for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)}


def own_nodes(function):
    """What stands in a function, but not in functions within it."""
    for child in ast.iter_child_nodes(function):
        if not isinstance(child, ast.FunctionDef):
            yield child
            yield from own_nodes(child)


def converted_and_used(source):
    """Names of constants, by function, that are converted to another type and used as they are."""
    found = []
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        converted = [
            call.args[0]
            for call in own_nodes(function)
            if isinstance(call, ast.Call)
            and isinstance(call.func, ast.Attribute)
            and call.func.attr in TYPES
            and len(call.args) == 1
            and isinstance(call.args[0], ast.Name)
            and call.args[0].id.isupper()
        ]
        names = [node for node in own_nodes(function) if isinstance(node, ast.Name)]
        for name in {node.id for node in converted}:
            uses = sum(node.id == name for node in names)
            if uses > sum(node.id == name for node in converted):
                found.append((function.name, name))
    return found


def test_the_pattern_is_seen():
    assert converted_and_used("def f():\n    g(N)\n    return wp.int64(N)\n") == [("f", "N")]
    assert converted_and_used("def f():\n    return wp.int64(N) + wp.int64(N)\n") == []


@pytest.mark.parametrize("folder", ["kernels", "warp_bsc"])
def test_no_constant_is_converted_and_used_as_it_is(folder):
    files = list((ROOT / folder).rglob("*.py"))
    assert files
    assert {str(file): found for file in files if (found := converted_and_used(file.read_text()))} == {}
