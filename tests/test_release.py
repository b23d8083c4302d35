"""What a release names more than once: versions, dependencies and addresses."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

import warp_bsc

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "conda" / "recipe" / "recipe.yaml"
URL = "https://github.com/warp-bsc/warp-bsc"
ON_CONDA_FORGE = {"usd-core": "openusd"}
"""Packages with another name there than on PyPI."""


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_recipe_has_the_version_and_the_dependencies_of_the_package(project):
    recipe = RECIPE.read_text()
    assert f'version: "{warp_bsc.__version__}"' in recipe
    listed = re.search(r"  run:\n(.*?)\n\n", recipe, re.DOTALL)[1]
    found = [line.strip().removeprefix("- ").replace(" ", "", 1) for line in listed.split("\n")]
    wanted = []
    for requirement in project["dependencies"]:
        name, bound = re.match(r"([\w-]+)(.*)", requirement).groups()
        wanted.append(ON_CONDA_FORGE.get(name, name) + bound)
    least, most = project["requires-python"].split(",")
    assert f'python_min: "{least.removeprefix(">=")}"' in recipe
    assert found == [f"python>=${{{{ python_min }}}},{most}", *wanted]
    assert project["description"] in recipe


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


def test_python_versions_are_those_that_continuous_integration_tests(project):
    workflow = ROOT / ".github" / "workflows" / "ci.yml"
    if not workflow.exists():
        pytest.skip("not a checkout")
    tested = re.search(r"python: \[(.*?)\]", workflow.read_text())[1].replace('"', "").split(", ")
    named = [c.rpartition(" ")[2] for c in project["classifiers"] if re.search(r"Python :: 3\.\d+$", c)]
    assert named == tested


def test_the_page_on_pypi_has_no_relative_link():
    script = ROOT / ".ci" / "pypi_readme.py"
    if not script.exists():
        pytest.skip("not a checkout")
    spec = importlib.util.spec_from_file_location("pypi_readme", script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = "[page](docs/x.md#y) ![picture](assets/p.png) [there](#limits) [doi](https://doi.org/1)"
    changed = module.with_absolute_links(text, "v1.2.3")
    assert changed == (
        f"[page]({URL}/blob/v1.2.3/docs/x.md#y) "
        "![picture](https://raw.githubusercontent.com/warp-bsc/warp-bsc/v1.2.3/assets/p.png) "
        "[there](#limits) [doi](https://doi.org/1)"
    )
    readme = module.with_absolute_links((ROOT / "README.md").read_text(), "v1.2.3")
    links = re.findall(r"\]\(([^)\s]+)\)", readme)
    assert len(links) > 5 and all(link.startswith(("https://", "#")) for link in links)
