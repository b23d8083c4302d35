"""What a release names more than once: versions, dependencies and addresses."""

import re
import tomllib
from pathlib import Path

import pytest

import warp_bsc
from warp_bsc._private_names.versions import TESTED_VERSIONS

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "conda" / "recipe" / "recipe.yaml"
URL = "https://github.com/warp-bsc/warp-bsc"
ON_CONDA_FORGE = {"usd-core": "openusd"}
"""Packages with another name there than on PyPI."""


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_recipe_has_the_version_and_the_dependencies_of_the_package(project):
    """And OpenUSD, as packages have no extras there."""
    recipe = RECIPE.read_text()
    assert f'version: "{warp_bsc.__version__}"' in recipe
    listed = re.search(r"  run:\n(.*?)\n\n", recipe, re.DOTALL)[1]
    found = [line.strip().removeprefix("- ").replace(" ", "", 1) for line in listed.split("\n")]
    wanted = []
    for requirement in [*project["dependencies"], *project["optional-dependencies"]["usd"]]:
        name, bound = re.match(r"([\w-]+)(.*)", requirement).groups()
        wanted.append(ON_CONDA_FORGE.get(name, name) + bound)
    least, most = project["requires-python"].split(",")
    assert f'python_min: "{least.removeprefix(">=")}"' in recipe
    assert found == [f"python>=${{{{ python_min }}}},{most}", *wanted]
    assert project["description"] in recipe


def test_the_extra_dev_has_those_of_docs_and_usd_and_not_the_package_itself(project):
    """A package that requires itself is a circle for programs that sort packages by their requirements."""
    extras = project["optional-dependencies"]
    assert {*extras["docs"], *extras["usd"]} < {*extras["dev"]}
    assert not any(name.startswith(project["name"]) for names in extras.values() for name in names)


def test_the_lowest_versions_of_warp_and_newton_are_tested_ones(project):
    """The jobs named lowest-versions install them."""
    bounds = dict(requirement.split(">=") for requirement in project["dependencies"])
    for module, package in {"warp": "warp-lang", "newton": "newton"}.items():
        assert ".".join(bounds[package].split(".")[:2]) == TESTED_VERSIONS[module][0]


def test_all_files_name_one_repository(project):
    assert project["urls"]["Repository"] == URL
    files = [
        *ROOT.glob("*.md"),
        *ROOT.glob("*.cff"),
        *(ROOT / ".github").rglob("*.*"),
        RECIPE,
        ROOT / "docs" / "conf.py",
    ]
    found = {
        match for path in files for match in re.findall(r"https://github\.com/[\w-]*/warp-bsc\b", path.read_text())
    }
    assert found == {URL}


@pytest.mark.parametrize("name", ["ci", "release"])
def test_python_versions_are_those_that_workflows_test(project, name):
    workflow = ROOT / ".github" / "workflows" / f"{name}.yml"
    if not workflow.exists():
        pytest.skip("not a checkout")
    tested = re.search(r"python: \[(.*?)\]", workflow.read_text())[1].replace('"', "").split(", ")
    named = [c.rpartition(" ")[2] for c in project["classifiers"] if re.search(r"Python :: 3\.\d+$", c)]
    assert named == tested


def test_the_wheel_has_the_data_that_it_names():
    """And no other: setuptools takes what MANIFEST.in names for packages that are not listed, with long warnings."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert options["include-package-data"] is False
    found = set()
    for package, patterns in options["package-data"].items():
        assert package in options["packages"]
        folder = ROOT / options["package-dir"].get(
            package, package.replace("warp_bsc.kernels", "kernels").replace(".", "/")
        )
        for pattern in patterns:
            files = [path for path in folder.glob(pattern) if path.is_file()]
            assert files or any(folder.glob(pattern + "/*")), (package, pattern)
            found.update(files)
    folders = (ROOT / "warp_bsc", ROOT / "kernels")
    package = {path for folder in folders for path in folder.rglob("*.*") if path.suffix not in (".py", ".pyc")}
    measurements = {path for path in package if path.parent.name == "measurements"}  # for the tables of the guides
    demo = ROOT / "assets" / "cloth_twist.usd"
    assert found - {demo} == {path for path in package - measurements if path.is_file()} and demo in found
    assert max(path.stat().st_size for path in found) < 2**21


def test_the_sdist_has_what_tests_and_the_site_need():
    lines = (ROOT / "MANIFEST.in").read_text().split("\n")
    assert {f"graft {name}" for name in ("assets", "conda", "docs", "examples", "tests")} <= set(lines)
    assert "include .clang-format AGENTS.md CHANGELOG.md CITATION.cff" in lines
