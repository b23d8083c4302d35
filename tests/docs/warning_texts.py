"""The texts of warnings and notes in the sources of the package: what a call to warn, or a list of notes, is given."""

import ast
import functools
import re
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "warp_bsc"
REMARKS = {"scene_replay/html_report.py", "repairing/shot/report.py"}
"""Modules whose notes are remarks on a page that they write, beside the views concerned."""
LISTS = {"warnings", "_warnings", "notes", "sentences", "turns"}
"""Names of lists of sentences that a scene, a file or a command says."""


@functools.cache
def sources():
    """The sources of all modules, by path relative to the package."""
    return {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}


@functools.cache
def tree(path):
    """The syntax tree of a module."""
    return ast.parse(sources()[path])


@functools.cache
def definitions(path):
    """Values of constants, and what functions return, by name, in a module, with what it imports from the package."""
    found = {}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef):
            found[node.name] = [part.value for part in ast.walk(node) if isinstance(part, ast.Return) and part.value]
        elif isinstance(node, ast.ImportFrom) and node.level:
            folder = Path(path).parents[node.level - 1] / (node.module or "").replace(".", "/")
            source = f"{folder.as_posix()}.py"
            found |= {name.name: (source, name.name) for name in node.names if source in sources()}
    for node in tree(path).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = [node.value]
    return found


def name_of(node):
    """The last name of an expression such as ``self._warnings``."""
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)


def template(node):
    """The text of a string, with dots in place of what is put into it; None for another expression."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return " ".join(node.value.split())
    if isinstance(node, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.Constant) else "..." for part in node.values]
        return " ".join("".join(parts).split())
    return None


def texts(path, node, seen=()):
    """All texts of an expression, as far as literals, and constants and functions of the package, give them."""
    text = template(node)
    if text is not None:
        return {text}.union(*(texts(path, p, seen) for p in getattr(node, "values", []) if not template(p)))
    name = name_of(node)
    if name is None:
        parts = [node.func, *node.args] if isinstance(node, ast.Call) else ast.iter_child_nodes(node)
        return set().union(*(texts(path, part, seen) for part in parts))
    values = definitions(path).get(name, [])
    if isinstance(values, tuple):  # imported
        path, name = values
        values = definitions(path).get(name, [])
    if (path, name) in seen or isinstance(values, tuple):
        return set()
    return set().union(*(texts(path, value, (*seen, (path, name))) for value in values))


def given_texts(node):
    """The expressions that a node of a syntax tree gives to what warns or notes."""
    if isinstance(node, ast.Call):
        name = name_of(node.func)
        if name == "warn_caller" or (name == "append" and name_of(getattr(node.func, "value", None)) in LISTS):
            return node.args[:1]
        return node.args[1:] if name in {"once", "SceneTimes"} else []
    if isinstance(node, ast.Assign | ast.AugAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = {name_of(target.value if isinstance(target, ast.Subscript) else target) for target in targets}
        return [node.value] if LISTS & names else []
    if isinstance(node, ast.FunctionDef) and node.name.endswith("warnings"):
        values = [part.value for part in ast.walk(node) if isinstance(part, ast.Assign | ast.Return)]
        return [value for value in values if value is not None]
    return []


@functools.cache
def warning_texts():
    """The texts of all warnings and notes, of three words or more, with the module of each."""
    found = set()
    says = re.compile(rf"warn_caller|\bonce\(|SceneTimes|\b({'|'.join(LISTS)})\b")
    for path in (path for path, source in sources().items() if path not in REMARKS and says.search(source)):
        for value in (value for node in ast.walk(tree(path)) for value in given_texts(node)):
            found |= {(path, text) for text in texts(path, value) if len(text.replace("...", " ").split()) > 2}
    return sorted(found)


def all_texts():
    """All strings of the package but docstrings."""
    return {text for path in sources() for node in ast.walk(tree(path)) if (text := template(node))}
