"""The notebooks run at small sizes and find what their text says; they are committed without outputs, in one form."""

import ast
import base64
import json
import os
import re
import sysconfig
from pathlib import Path

import compilation
import pytest
import warp as wp

nbformat = pytest.importorskip("nbformat", reason="needs the extra dev: pip install -e '.[dev]'")
nbclient = pytest.importorskip("nbclient", reason="needs the extra dev: pip install -e '.[dev]'")
import tutorial_notebook  # noqa: E402 (needs nbformat)
from clean_notebooks import NOTEBOOKS, committed_form  # noqa: E402

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "notebooks"
COLAB = "https://colab.research.google.com/github/warp-bsc/warp-bsc/blob/main/"
BADGE = "https://colab.research.google.com/assets/colab-badge.svg"
OTHERS = {BADGE, "https://github.com/newton-physics/newton", "https://github.com/NVIDIA/warp"}
RAW = "https://raw.githubusercontent.com/warp-bsc/warp-bsc/main/"
SITE = "https://warp-bsc.github.io/warp-bsc/main/"
SETUP = f"""
import sys
sys.path.append({compilation.FOLDER!r})
import compilation, warp
warp.config.log_level = warp.LOG_WARNING
warp.set_device({{device!r}})
warp.config.cpu_compiler_flags = compilation.QUICK["cpu_compiler_flags"]
compilation.compile_kernels_once()
"""
"""Runs before the first cell, so that notebooks take the kernels of the other tests."""
SETUP_OF_NEWTON = """
import newton.solvers
compilation.compile_quickly()
"""
"""The same for kernels of Newton's solvers, whose import takes seconds."""

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])


def read(path):
    """The notebook, checked against the schema of its version."""
    notebook = nbformat.read(path, nbformat.NO_CONVERT)
    nbformat.validate(notebook)
    return notebook


def execute(name, size, values, monkeypatch):
    """Runs a notebook as it is, but for its size.

    Args:
        name: Its name.
        size: The value of its size.
        values: Expressions, evaluated after the last cell.

    Returns:
        The values, the text of all outputs, the number of pictures, and the pages that it shows.
    """
    notebook = read(FOLDER / f"{name}.ipynb")
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    cell.source = f"{cell.source.partition(' = ')[0]} = {size}"
    setup = SETUP.format(device=str(wp.get_device())) + SETUP_OF_NEWTON * ("newton" in name)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(setup))
    notebook.cells.append(nbformat.v4.new_code_cell(f"import json; print(json.dumps([{', '.join(values)}]))"))
    monkeypatch.setenv("PATH", sysconfig.get_path("scripts"), prepend=os.pathsep)  # of the command
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(FOLDER)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(output.text for output in outputs if output.output_type == "stream")
    shown = [output.data for output in outputs if output.output_type != "stream"]
    frames = "".join(data.get("text/html", "") for data in shown)
    pages = [base64.b64decode(page).decode() for page in re.findall(r'src="data:text/html;base64,([^"]+)"', frames)]
    found = json.loads(notebook.cells[-1].outputs[0].text)
    return found, text, sum("image/png" in data for data in shown), pages


def test_first_steps(monkeypatch):
    values = ["found.certified", "[truth.tolist() for truth in confirmed]", "missed.tolist()", "result.hit.tolist()"]
    (certified, confirmed, missed, hit), text, pictures, _ = execute("first_steps", 8, values, monkeypatch)
    assert certified and all(len(truth) > 20 and all(truth) for truth in confirmed)
    assert len(missed) > 1000 and not any(missed)
    assert hit == [True, False]
    assert "edges through faces at the start and at the end: [0, 0]" in text
    assert pictures == 1


@pytest.mark.slow
def test_behind_newton(monkeypatch):
    values = ["passed(x_without[-1])", "passed(x_with[-1])", "float(on_sheet)", "float(on_patch)", "float(gained)"]
    values += [f"{stage}.report.totals.uncertified_steps" for stage in ("monitor", "solver")]
    found, text, pictures, _ = execute("behind_newton", 12, values, monkeypatch)
    without, behind_stage, on_sheet, on_patch, gained, *steps = found
    assert (without, behind_stage) == (49, 0)
    assert steps == [1, 0]
    assert on_patch == pytest.approx(-on_sheet, rel=1e-3) and on_patch == pytest.approx(gained, rel=0.03)
    assert "UserWarning" not in text
    assert pictures == 2


@pytest.mark.slow
def test_repair_and_replay(monkeypatch):
    counts = ["hits", "intersections[0].crossings", "intersections[1].crossings"]
    values = [f"[[s.{count} for s in summaries[name]] for name in summaries]" for count in counts]
    values += ["result.crossings_before", "result.crossings", "result.certified"]
    (hits, starts, ends, *positions), text, pictures, pages = execute("repair_and_replay", 247, values, monkeypatch)
    assert (hits, starts, ends) == ([[1], [0]], [[33], [0]], [[30], [0]])
    assert positions[0] > 100 and positions[1:] == [0, True]
    assert "Collisions: 1 before, 0 remain." in text and "\x1b" not in text
    assert pictures == 2
    assert ["Collisions in cloth_twist.usd" in page for page in pages] == [True, False]
    assert ["Repair of cloth_twist.usd" in page for page in pages] == [False, True]


@pytest.mark.slow
def test_tutorial(monkeypatch):
    """Its code is that of pages, whose outputs tests/docs/test_code.py compares."""
    _, text, _, _ = execute("tutorial", repr(str(wp.get_device())), ["solver.report.certified"], monkeypatch)
    assert "30 0\n" in text and "72 0 True\n" in text


def test_the_notebook_of_the_tutorial_is_made_of_its_pages():
    is_same = tutorial_notebook.NOTEBOOK.read_text(encoding="utf-8") == tutorial_notebook.notebook_text()
    assert is_same, "python tests/support/tutorial_notebook.py writes it"


def test_each_notebook_has_a_test():
    assert {f"test_{path.stem}" for path in NOTEBOOKS} <= globals().keys() and len(NOTEBOOKS) == 4


@each_notebook
def test_committed_form(path):
    """Without outputs, and with names for ids, so that differences are short."""
    is_clean = path.read_text(encoding="utf-8") == committed_form(path)
    assert is_clean, "python tests/support/clean_notebooks.py removes outputs and what an editor adds"
    notebook = read(path)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    ids = [cell.id for cell in notebook.cells]
    assert len(set(ids)) == len(ids) and all(re.fullmatch(r"[a-z_]+", name) for name in ids)


@each_notebook
def test_beginning(path):
    """A badge that opens this notebook, a cell that installs what is missing, and one that sets the size."""
    title, install, size, *_ = read(path).cells
    assert f"]({COLAB}{path.relative_to(ROOT).as_posix()})" in title.source
    assert install.source == read(NOTEBOOKS[0]).cells[1].source
    assert 'find_spec("warp_bsc") is None' in install.source
    assert "git+https://github.com/warp-bsc/warp-bsc" in install.source
    assert size.metadata["tags"] == ["parameters"]
    (assignment,) = ast.parse(size.source).body
    assert isinstance(assignment, ast.Assign) and isinstance(assignment.value, ast.Constant)


@each_notebook
def test_links(path):
    """Lead to pages of the site, to other notebooks, to Colab, and to files of the repository."""
    text = "\n".join(cell.source for cell in read(path).cells)
    wrong, links = [], re.findall(r"\]\(([^)]+)\)", text)
    for link in links:
        if link.startswith(SITE):
            target = ROOT / "docs" / link.removeprefix(SITE).partition("#")[0].replace(".html", ".md")
        else:
            start = next((start for start in (COLAB, RAW) if link.startswith(start)), None)
            target = FOLDER / link if start is None else ROOT / link.removeprefix(start)
        if not (target.exists() or link in OTHERS):
            wrong.append(link)
    assert len(links) > 3 and not wrong
    assert all((ROOT / name).exists() for name in re.findall(rf"{RAW}([\w./]+)", text))


def test_pages_link_to_the_notebooks():
    page = (ROOT / "docs" / "notebooks.md").read_text()
    for path in NOTEBOOKS:
        name = path.relative_to(ROOT).as_posix()
        assert f"(../{name})" in page and f"]({COLAB}{name})" in page
    assert all("(notebooks.md)" in (ROOT / "docs" / other).read_text() for other in ("index.md", "install.md"))
