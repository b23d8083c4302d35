"""The package: what of a checkout can be imported as a part of it."""

import ast
import functools
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import warp_bsc

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", ["tests", "examples", "assets", "docs", "conda", "warp_bsc"])
def test_what_stands_beside_the_package_is_no_part_of_it(name):
    assert (ROOT / name).is_dir()
    assert importlib.util.find_spec(f"warp_bsc.{name}") is None


def test_all_packages_are_installed():
    """An editable installation finds folders that pyproject.toml does not name, a wheel does not have them."""
    folders = [path.parent.relative_to(ROOT / "warp_bsc") for path in (ROOT / "warp_bsc").rglob("__init__.py")]
    kernels = [path.parent.relative_to(ROOT) for path in (ROOT / "kernels").rglob("__init__.py")]
    found = {".".join(("warp_bsc", *folder.parts)) for folder in folders + kernels}
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert found <= set(settings["packages"])


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
    "_garbage": set(),
    "_one_thread": set(),
    "_profiling": set(),
    "_sorted_keys": set(),
    "_version": set(),
    "_warnings": set(),
    "_private_names": {"_warnings"},
    "checker": {"_arguments"},
    "detection": {"kernels", "checker", "_arguments", "_one_thread", "_private_names", "_sorted_keys"},
    "response": {"detection", "kernels", "_arguments", "_one_thread", "_private_names", "_profiling", "_warnings"},
    "_rollout": {"_arguments", "_private_names"},
    "torch": {"_rollout", "_arguments"},
    "jax": {"_rollout", "_arguments"},
    "implicit": {
        "detection",
        "kernels",
        "response",
        "_arguments",
        "_one_thread",
        "_private_names",
        "_profiling",
        "_warnings",
    },
    "repairing": {"detection", "response", "kernels", "usd", "scene_replay", "_arguments", "_atomic_file"},
    "nvidia_validation": {"repairing", "scene_replay", "usd"},
    "mesh_files": {"detection", "repairing", "usd", "_atomic_file"},
    "usd": {"_arguments", "_atomic_file", "_one_thread", "_sorted_keys", "_warnings"},
    "scene_replay": {"usd", "detection", "checker", "_arguments", "_atomic_file", "_sorted_keys", "_version"},
    "bench": {
        "detection",
        "kernels",
        "usd",
        "checker",
        "response",
        "implicit",
        "repairing",
        "_arguments",
        "_atomic_file",
        "_garbage",
        "_private_names",
        "_version",
    },
    "cli": {
        "scene_replay",
        "repairing",
        "bench",
        "detection",
        "mesh_files",
        "usd",
        "_arguments",
        "_atomic_file",
        "_version",
    },
    "__main__": {"cli", "_garbage"},
    "__init__": {
        "_garbage",
        "_version",
        "checker",
        "detection",
        "implicit",
        "mesh_files",
        "repairing",
        "scene_replay",
        "response",
        "usd",
    },  # most for type checkers alone
}
"""Whom a package of ours, or a module beside them, may import; the names that it exports import what they need."""

LIBRARIES = {
    "newton": {
        "implicit",
        "response",
        "warp_bsc/repairing/shot/playback.py",  # plays positions back as a solver
        "warp_bsc/repairing/state.py",  # repairs a state of a model
        "warp_bsc/repairing/model_surface.py",  # takes the surface from it
        "warp_bsc/_private_names/of_newton.py",
        "warp_bsc/bench/scenes/newton_examples.py",  # lists the examples of Newton
        "warp_bsc/bench/measure/newton_process.py",  # runs them
        "warp_bsc/bench/crossings.py",  # of a model
        "warp_bsc/bench/elastic_energy.py",  # of a model
        "warp_bsc/bench/scenes/simulation.py",  # steps its solvers
        "warp_bsc/bench/scenes/contact.py",  # makes models
        "warp_bsc/bench/scenes/penetration.py",
        "warp_bsc/bench/peers/newton_solvers.py",  # steps its solvers
        "warp_bsc/bench/peers/mujoco_flex.py",  # reads its models
        "warp_bsc/bench/peers/states.py",
        "warp_bsc/bench/measure/judge.py",
        "_rollout",  # takes its solvers
        "torch",
        "jax",
    },
    "pxr": {
        "usd",
        "warp_bsc/nvidia_validation.py",  # rules of NVIDIA's validation
        "warp_bsc/scene_replay/usd_validation.py",  # a rule of its validation framework
        "warp_bsc/scene_replay/usdview_plugin.py",  # a plugin of its viewer
    },
    "rich": {"cli"},
    "argparse": {"cli"},
    "matplotlib": {"bench"},
    "ipctk": {"bench"},
    "mujoco": {"bench"},
    "uipc": {"bench"},
    "trimesh": {
        "bench",
        "response",
        "usd",
        "warp_bsc/repairing/repair.py",
        "warp_bsc/mesh_files/check.py",
        "warp_bsc/mesh_files/glb.py",  # matrices of nodes; the others for type checkers alone
    },
    "warp": {
        "kernels",
        "detection",
        "implicit",
        "response",
        "repairing",
        "warp_bsc/mesh_files/check.py",
        "bench",
        "cli",
        "_private_names",
        "_profiling",
        "_rollout",
        "torch",
        "jax",
    },
    "torch": {"torch"},
    "jax": {"jax"},
}
"""Who may import a library: packages, or single files."""


def statements(node):
    """All statements within a node, and what has statements of its own, but no expressions."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, part, []):
            yield child
            yield from statements(child)


@functools.cache
def imports(root=ROOT):
    """Every import of our sources: file, package, names of the imported module (ours begin with "warp_bsc")."""
    found = []
    for folder in (root / "warp_bsc", root / "kernels"):
        for path in sorted(folder.rglob("*.py")):
            relative = path.relative_to(folder)
            inside = ["warp_bsc", *(["kernels"] if folder.name == "kernels" else []), *relative.with_suffix("").parts]
            package = inside[1]
            for node in statements(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    modules = [alias.name.split(".") for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    base = [*inside[: -node.level], *(node.module or "").split(".")] if node.level else []
                    base = [name for name in base or node.module.split(".") if name]
                    modules = [[*base, alias.name] for alias in node.names]
                else:
                    continue
                found += [(path.relative_to(root).as_posix(), package, module) for module in modules]
    return found


def test_packages_import_only_what_the_layout_allows():
    found = {(package, module[1]) for _, package, module in imports() if module[0] == "warp_bsc" and module[1:]}
    names = {package for package, _ in found} | {imported for _, imported in found}
    assert names == PACKAGES.keys()
    wrong = [
        f"{path}: {'.'.join(module)}"
        for path, package, module in imports()
        if module[0] == "warp_bsc" and module[1:]
        if package != module[1] and module[1] not in PACKAGES.get(package, ())
    ]
    assert not wrong, "\n".join(wrong)


def test_the_table_of_folders_says_who_imports_whom():
    rows = re.findall(
        r"^\| `warp_bsc/(\w+)/` \|.*\| (.*) \|$",
        (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    assert len(rows) > 8
    for package, allowed in rows:
        expected = {name for name in PACKAGES[package] if not name.startswith("_")}
        assert set(re.findall(r"`(\w+)`", allowed)) == expected, package


def circles(importers):
    """The circles of a graph: sets of two or more nodes that all reach each other, or of one that reaches itself.

    Args:
        importers: For each node, the nodes that it leads to.
    """
    reached = {}
    for node in importers:
        reached[node], waiting = set(), [node]
        while waiting:
            new = importers.get(waiting.pop(), set()) - reached[node]
            reached[node] |= new
            waiting += new
    return {
        frozenset(other for other in reached[node] if node in reached.get(other, ()))
        for node in reached
        if node in reached[node]
    }


def modules_of_a_package(package):
    """For each module of a package, the modules of it that it imports, in functions and for type checkers as well."""
    found = {}
    for path, imported_by, module in imports():
        if imported_by == package:
            own = ["warp_bsc", *Path(path).with_suffix("").parts[path.startswith("warp_bsc") :]]
            found.setdefault(tuple(part for part in own if part != "__init__"), []).append(module)
    return {
        own: {
            # The longest beginning of a name that is a module: the rest is a name in that module.
            max((name for name in found if name == tuple(module)[: len(name)]), key=len, default=())
            for module in modules
        }
        - {own, ()}
        for own, modules in found.items()
    }


def test_circles_are_found():
    chain = {"a": {"b"}, "b": {"c"}, "c": set()}
    assert circles(chain) == set()
    assert circles(chain | {"c": {"a"}, "d": {"a"}}) == {frozenset("abc")}
    assert circles({"a": {"b"}, "b": {"a"}, "c": {"d"}, "d": {"c", "a"}}) == {frozenset("ab"), frozenset("cd")}
    assert circles({"a": {"a"}, "b": {"a"}}) == {frozenset("a")}


@pytest.mark.parametrize(
    "package", [name for name in PACKAGES if (ROOT / name).is_dir() or (ROOT / "warp_bsc" / name).is_dir()]
)
def test_no_package_has_a_circle_inside(package):
    modules = modules_of_a_package(package)
    assert any(modules.values())
    found = [", ".join(sorted(".".join(module) for module in circle)) for circle in circles(modules)]
    assert not found, "\n".join(sorted(found))


def test_no_chain_in_the_response_is_longer_than_nine():
    modules = modules_of_a_package("response")

    @functools.cache
    def depth(module):
        return 1 + max((depth(imported) for imported in modules.get(module, ())), default=0)

    assert 5 < max(map(depth, modules)) <= 9


def test_no_chain_of_packages_is_longer_than_eight():
    def depth(package):
        return 1 + max((depth(imported) for imported in PACKAGES[package]), default=0)

    assert max(map(depth, PACKAGES)) <= 8  # an endless chain ends in a RecursionError


@pytest.mark.parametrize("library", LIBRARIES)
def test_libraries_are_imported_only_where_the_layout_allows(library):
    users = {(path, package) for path, package, module in imports() if module[0] == library}
    assert users
    wrong = [path for path, package in users if not {path, package} & LIBRARIES[library]]
    assert not wrong, "\n".join(sorted(wrong))


@pytest.mark.parametrize("library", ["torch", "jax"])
def test_a_bridge_whose_library_is_missing_says_what_to_install(library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"warp_bsc.{library}", raising=False)
    monkeypatch.delitem(vars(warp_bsc), library, raising=False)
    with pytest.raises(ImportError, match=rf"warp_bsc\.{library} needs .*: pip install 'warp-bsc\[{library}\]'"):
        getattr(warp_bsc, library)
