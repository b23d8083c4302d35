"""The package: what of a checkout can be imported as a part of it."""

import ast
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import warp_bsc

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", ["tests", "examples", "assets", "warp_bsc"])
def test_what_stands_beside_the_package_is_no_part_of_it(name):
    assert (ROOT / name).is_dir()
    assert importlib.util.find_spec(f"warp_bsc.{name}") is None


def test_a_checkout_that_is_not_installed_has_its_own_kernels(tmp_path):
    """Whatever is installed."""
    package = Path(warp_bsc.__file__).parent
    kernels = Path(importlib.util.find_spec("warp_bsc.kernels").origin).parent
    shutil.copytree(package, tmp_path / "warp_bsc", ignore=shutil.ignore_patterns("kernels"))
    shutil.copytree(kernels, tmp_path / "kernels")
    script = "import importlib.util as u; print(u.find_spec('warp_bsc').origin, u.find_spec('warp_bsc.kernels').origin)"
    command, environment = [sys.executable, "-c", script], os.environ | {"PYTHONPATH": str(tmp_path)}
    found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.split() == [str(tmp_path / name / "__init__.py") for name in ("warp_bsc", "kernels")]


PACKAGES = {
    "kernels": set(),
    "_arguments": set(),
    "_atomic_file": set(),
    "_one_thread": set(),
    "_private_names": set(),
    "checker": {"_arguments"},
    "detection": {"kernels", "checker", "_arguments", "_one_thread", "_private_names"},
    "response": {"detection", "kernels", "_arguments", "_one_thread", "_private_names"},
    "usd": {"_arguments", "_one_thread"},
    "replay": {"usd", "detection", "checker", "_arguments", "_atomic_file"},
    "bench": {"detection", "kernels", "usd", "checker", "response", "_arguments", "_private_names"},
    "cli": {"replay", "bench", "detection", "usd", "_arguments", "_atomic_file"},
    "__main__": {"cli"},
    "__init__": {"checker", "detection", "replay", "response", "usd"},  # for type checkers alone
}
"""Whom a package of ours, or a module beside them, may import; the names that it exports import what they need."""

LIBRARIES = {
    "newton": {
        "response",
        "warp_bsc/bench/newton_examples.py",  # lists the examples of Newton
        "warp_bsc/bench/newton_process.py",  # runs them
    },
    "pxr": {"usd", "warp_bsc/replay/usd_validation.py"},  # a rule of its validation framework
    "rich": {"cli"},
    "argparse": {"cli"},
    "matplotlib": {"bench"},
    "ipctk": {"bench"},
    "trimesh": {"bench", "usd"},
    "warp": {"kernels", "detection", "response", "bench", "cli", "_private_names"},
}
"""Who may import a library: packages, or single files."""


def imports():
    """Every import of our sources: file, package, names of the imported module (ours begin with "warp_bsc")."""
    for folder in (ROOT / "warp_bsc", ROOT / "kernels"):
        for path in sorted(folder.rglob("*.py")):
            relative = path.relative_to(folder)
            inside = ["warp_bsc", *(["kernels"] if folder.name == "kernels" else []), *relative.with_suffix("").parts]
            package = inside[1]
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    modules = [alias.name.split(".") for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    base = [*inside[: -node.level], *(node.module or "").split(".")] if node.level else []
                    base = [name for name in base or node.module.split(".") if name]
                    modules = [[*base, alias.name] for alias in node.names]
                else:
                    continue
                for module in modules:
                    yield str(path.relative_to(ROOT)), package, module


def test_packages_import_only_what_the_layout_allows():
    found = {(package, module[1]) for _, package, module in imports() if module[0] == "warp_bsc" and module[1:]}
    names = {package for package, _ in found} | {imported for _, imported in found if imported != "__version__"}
    assert names == PACKAGES.keys()
    wrong = [
        f"{path}: {'.'.join(module)}"
        for path, package, module in imports()
        if module[0] == "warp_bsc" and module[1:] not in (["__version__"], [])
        if package != module[1] and module[1] not in PACKAGES.get(package, ())
    ]
    assert not wrong, "\n".join(wrong)


def test_no_chain_of_packages_is_longer_than_seven():
    def depth(package):
        return 1 + max((depth(imported) for imported in PACKAGES[package]), default=0)

    assert max(map(depth, PACKAGES)) <= 7  # an endless chain ends in a RecursionError


@pytest.mark.parametrize("library", LIBRARIES)
def test_libraries_are_imported_only_where_the_layout_allows(library):
    users = {(path, package) for path, package, module in imports() if module[0] == library}
    assert users
    wrong = [path for path, package in users if not {path, package} & LIBRARIES[library]]
    assert not wrong, "\n".join(sorted(wrong))
