"""The form of the sources: rooms, floors, lines, parameters, each at most the number of ``form.toml``.

The rooms of a package are the files and folders at its top, arrows are imports between them. ``python
tests/test_form.py`` prints all numbers beside their limits.
"""

import ast
import collections
import functools
import itertools
import re
import tomllib
from pathlib import Path

import pytest
from test_package import circles, imports, statements

ROOT = Path(__file__).parents[1]
LIMITS = Path(__file__).with_name("form.toml")
PRIVATE = re.compile(r"[\s.(,]_(?!_)\w")
"""What a text has that takes a private name."""
OWN = "self", "cls", "wp", "os"
"""Objects whose private names a test may take."""


def sources(root, *folders, ending="py"):
    """The files of folders with an ending, in order."""
    return [path for folder in folders for path in sorted((root / folder).rglob(f"*.{ending}"))]


def lines_of(paths):
    """How many lines files have together."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def rooms_of(root, package):
    """The rooms of a package, such as "kernels": for each, the rooms that it imports."""
    folder = root / ("kernels" if package == "kernels" else f"warp_bsc/{package}")
    rooms = {path.relative_to(folder).with_suffix("").parts[0]: set() for path in folder.rglob("*.py")}
    rooms.pop("__init__", None)
    for path, importer, module in imports(root):
        own = (root / path).relative_to(folder).with_suffix("").parts[0] if importer == package else None
        if own in rooms and module[:2] == ["warp_bsc", package] and module[2:]:
            rooms[own] |= {module[2]} & rooms.keys() - {own}
    return rooms


def upward(rooms, circle):
    """The fewest arrows that lead up in any order of a circle's rooms; all arrows in it if it has more than eight."""
    arrows = [(room, imported) for room in circle for imported in rooms[room] & circle]
    if len(circle) > 8:
        return len(arrows)
    return min(sum(order.index(a) < order.index(b) for a, b in arrows) for order in itertools.permutations(circle))


def house(root, package):
    """The numbers of a package's rooms; on a chain, the rooms of a circle count as one floor."""
    rooms = rooms_of(root, package)
    found = circles(rooms)
    one = {room: circle for circle in found for room in circle}

    @functools.cache
    def floor(part):
        below = {one.get(imported, frozenset({imported})) for room in part for imported in rooms[room]}
        return 1 + max((floor(other) for other in below - {part}), default=0)

    folder = root / ("kernels" if package == "kernels" else f"warp_bsc/{package}")
    return {
        "rooms": len(rooms),
        "arrows": sum(map(len, rooms.values())),
        "floors": max((floor(one.get(room, frozenset({room}))) for room in rooms), default=0),
        "upward": sum(upward(rooms, circle) for circle in found),
        "circles": len(found),
        "lines": lines_of(folder.rglob("*.py")),
    }


def functions_of(root):
    """For each function its file and name, how many parameters it has, and whether it is a kernel without groups.

    A comment on a line of its own, between the parameters, begins a group.
    """
    for path in sources(root, "kernels", "warp_bsc"):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        for node in statements(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                count = sum(isinstance(child, ast.arg) for child in ast.walk(node.args))
                is_kernel = any(ast.unparse(each).split("(")[0].endswith("kernel") for each in node.decorator_list)
                signature = lines[node.lineno : node.body[0].lineno - 1]
                grouped = any(line.strip().startswith("#") for line in signature)
                yield f"{path.relative_to(root).as_posix()}:{node.name}", count, is_kernel and not grouped


def private_accesses(root):
    """For each test file how often it takes a private name of our objects or modules."""
    found = collections.Counter()
    for path in sources(root, "tests"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if PRIVATE.search(text) else ():
            if isinstance(node, ast.Attribute):
                private = node.attr.startswith("_")  # else spared the cost of its text
                names = [node.attr] if private and ast.unparse(node.value).split(".")[0] not in OWN else []
            else:
                ours = isinstance(node, ast.ImportFrom) and (node.module or "").startswith("warp_bsc")
                names = [alias.name for alias in node.names] if ours else []
            private = [name for name in names if name.startswith("_") and not name.startswith("__")]
            found.update({path.relative_to(root).as_posix(): len(private)} if private else {})
    return found


def measure(root, limits):
    """All numbers of a tree, in the tables of ``form.toml``."""
    files = sources(root, "kernels", "warp_bsc")
    packages = ["kernels", *(path.parent.name for path in sorted((root / "warp_bsc").glob("*/__init__.py")))]
    largest, functions = limits["largest"], sorted(functions_of(root))
    lengths = {path.relative_to(root).as_posix(): lines_of([path]) for path in files}
    return {
        "total": {
            "lines": sum(lengths.values()),
            "lines_of_headers": lines_of(sources(root, "kernels", "warp_bsc", ending="h")),
            "private_accesses_of_tests": private_accesses(root).total(),
        },
        "packages": {package: house(root, package) for package in packages},
        "long_files": {name: lines for name, lines in lengths.items() if lines > largest["lines"]},
        "many_parameters": {name: count for name, count, _ in functions if count > largest["parameters"]},
        "ungrouped_kernels": {name: n for name, n, ungrouped in functions if ungrouped and n > largest["ungrouped"]},
    }


def flat(tables, prefix=""):
    """The numbers of nested tables, by their names with spaces between."""
    for name, value in tables.items():
        yield from flat(value, f"{prefix}{name} ") if isinstance(value, dict) else [(prefix + name, value)]


def exceeded(measured, limits):
    """What is more than its limit, or has none, as lines that say what and where."""
    limits = dict(flat(limits))
    return [
        f"{name}: {number}, limit {limits.get(name, 'none')}"
        for name, number in flat(measured)
        if number > limits.get(name, 0)
    ]


@functools.cache
def checkout():
    limits = tomllib.loads(LIMITS.read_text(encoding="utf-8"))
    return measure(ROOT, limits), limits


@pytest.mark.parametrize("table", ["total", "packages", "long_files", "many_parameters", "ungrouped_kernels"])
def test_no_number_is_more_than_its_limit(table):
    measured, limits = checkout()
    found = exceeded({table: measured[table]}, limits)
    if any("private" in line for line in found):
        found += [f"  {name}: {count}" for name, count in private_accesses(ROOT).most_common()]
    for package in sorted({line.split()[1] for line in found if " circles: " in line}):
        found += [f"  {package}: {', '.join(sorted(circle))}" for circle in circles(rooms_of(ROOT, package))]
    assert not found, "\n".join([*found, "shorten or simplify it; only a person raises a number of tests/form.toml"])


def test_all_that_is_too_much_is_found(tmp_path):
    files = {
        "warp_bsc/__init__.py": "",
        "warp_bsc/shop/__init__.py": "",
        "warp_bsc/shop/door.py": "from .shelf import apples\n",
        "warp_bsc/shop/shelf/apples.py": "from ..till import pay\n",
        "warp_bsc/shop/till.py": "from warp_bsc.shop import door, cellar\n",
        "warp_bsc/shop/cellar.py": "def dig(a, b, *, c, **d): ...\n",
        "kernels/__init__.py": "",
        "kernels/long.py": "import warp as wp\n@wp.kernel\ndef add(a, b):  # sums\n    ...\n",
        "kernels/good.py": "@wp.kernel\ndef add(\n    # in\n    a,\n    # out\n    b,\n): ...\n",
        "kernels/native/sum.h": "a + b\n",
        "tests/test_shop.py": "from warp_bsc.shop import _key\nself._a + shop._b + wp._c + d.__e__\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    measured = measure(tmp_path, {"largest": {"lines": 3, "parameters": 3, "ungrouped": 1}})
    assert measured["packages"]["shop"] == dict(rooms=4, arrows=4, floors=2, upward=1, circles=1, lines=4)
    assert measured["packages"]["kernels"] == dict(rooms=2, arrows=0, floors=1, upward=0, circles=0, lines=11)
    assert measured["long_files"] == {"kernels/good.py": 7, "kernels/long.py": 4}
    assert measured["many_parameters"] == {"warp_bsc/shop/cellar.py:dig": 4}
    assert measured["ungrouped_kernels"] == {"kernels/long.py:add": 2}
    assert measured["total"] == {"lines": 15, "lines_of_headers": 1, "private_accesses_of_tests": 2}
    assert exceeded(measured, measured) == []
    assert exceeded({"a": {"b": 2, "c": 1}}, {"a": {"b": 1}}) == ["a b: 2, limit 1", "a c: 1, limit none"]


def report(measured, limits):
    """All numbers beside their limits as lines: one for each package, and one for each other number."""
    allowed = dict(flat(limits))
    for package, numbers in measured["packages"].items():
        shown = (f"{name} {n}/{allowed.get(f'packages {package} {name}', 0)}" for name, n in numbers.items())
        yield f"{package:<18}" + "".join(f"{text:<16}" for text in shown)
    numbers = dict(flat(measured))
    kept = {name: 0 for name in allowed if not name.startswith("largest ")}
    for name, number in (kept | numbers).items():
        limit = allowed.get(name, 0)
        note = "too much" if number > limit else "lower the limit" if number < 0.97 * limit else ""
        if note or not name.startswith("packages "):
            yield f"{name}: {number}/{limit} {note}"


if __name__ == "__main__":
    print("\n".join(report(*checkout())))
