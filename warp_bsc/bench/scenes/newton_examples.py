"""Newton's own examples: which there are, and what they need, read from their sources."""

import ast
import difflib
import importlib
import importlib.util
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..tables import Column, Table

FOLDERS = ("cloth", "softbody", "multiphysics")
"""The folders of Newton's examples that are measured by default."""

_BUILDERS = ("add_cloth", "add_soft", "add_triangle", "add_tetrahedr")
"""How the names of the functions begin that add cloth and soft bodies to a model."""

_DOWNLOADS = ("download_asset", "download_external_git_folder")
"""Functions of Newton that download files of examples."""

_NEEDS = (
    Column("Folder", lambda example: example.module.split(".")[2], kind="text"),
    Column("Needs", lambda example: "; ".join(describe_needs(example)), kind="text"),
)


@dataclass(frozen=True)
class NewtonExample:
    """An example of Newton."""

    name: str  # its name, as ``python -m newton.examples`` takes it
    module: str  # the module, which runs the example if it is the main one
    options: tuple[str, ...] = ()  # options of the example itself
    deformable: bool = True  # whether its source adds cloth or soft bodies to a model
    downloads: tuple[str, ...] = ()  # names of the assets that it downloads, "" for one that the source does not name
    missing: tuple[str, ...] = ()  # packages that it imports and that are not installed

    @property
    def title(self) -> str:
        """The name and the options."""
        return shlex.join([self.name, *self.options])


def find_examples(requests: Sequence[str] = ()) -> list[NewtonExample]:
    """Returns examples of Newton by name; without one, those with cloth or soft bodies in :data:`FOLDERS`.

    The sources are read, and no example is imported.

    Args:
        requests: Names of examples, each followed by options of the example itself, as in a shell:
            ``"cloth_hanging --solver xpbd"``.

    Raises:
        ValueError: If Newton has no example of a name, or quotes in a request have no end.
    """
    from newton.examples import get_examples  # noqa: PLC0415 (slow)

    modules = get_examples()
    if not requests:
        found = [_read_example(name, module) for name, module in modules.items() if module.split(".")[2] in FOLDERS]
        return [example for example in found if example.deformable]
    examples = []
    for request in requests:
        try:
            name, *options = shlex.split(request) or [""]
        except ValueError as error:
            raise ValueError(f"{request!r}: {error}") from None
        if name not in modules:
            close = difflib.get_close_matches(name, modules, n=3)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise ValueError(f"{name!r}: Newton has no example of this name{hint}")
        examples.append(_read_example(name, modules[name], tuple(options)))
    return examples


def _read_example(name: str, module: str, options: tuple[str, ...] = ()) -> NewtonExample:
    """Reads an example's source for its packages and downloads."""
    specification = importlib.util.find_spec(module)
    assert specification is not None and specification.origin is not None
    tree = ast.parse(Path(specification.origin).read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    calls = [(getattr(call.func, "attr", getattr(call.func, "id", "")), call) for call in calls]
    deformable = any(called.startswith(_BUILDERS) for called, _ in calls)
    downloads = dict.fromkeys(_first_string(node) for called, node in calls if called in _DOWNLOADS)
    imported = []
    for node in tree.body:  # an import within a function or a "try" may have a substitute
        if isinstance(node, ast.Import):
            imported += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            imported.append(node.module)
    packages = dict.fromkeys(name.split(".")[0] for name in imported)
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    return NewtonExample(name, module, options, deformable, tuple(downloads), tuple(missing))


def _first_string(call: ast.Call) -> str:
    strings = [argument.value for argument in call.args if isinstance(argument, ast.Constant)]
    return next((string for string in strings if isinstance(string, str)), "")


def describe_needs(example: NewtonExample, *, download: bool = False) -> list[str]:
    """Returns the packages and downloads that an example lacks by its source, a line each.

    Args:
        example: The example.
        download: Whether it may download assets.
    """
    needs = [f"needs the package {package}" for package in example.missing]
    if example.downloads and not download:
        needs.append(describe_download(", ".join(filter(None, example.downloads))))
    return needs


def describe_download(asset: str) -> str:
    """Returns the line about an asset that may not be downloaded."""
    return f"needs a download: {asset or 'an asset'}"


def list_examples(examples: Sequence[NewtonExample]) -> Table:
    """Returns the table of examples and what they need."""
    return Table("Example", _NEEDS, [(example.title, example) for example in examples])
