"""The tutorial as a notebook, made of its pages; running this file writes it."""

import re
from itertools import count
from pathlib import Path, PurePosixPath
from posixpath import normpath

import nbformat
from clean_notebooks import METADATA, NOTEBOOKS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NOTEBOOK = ROOT / "examples" / "notebooks" / "tutorial.ipynb"
PAGES = sorted((DOCS / "tutorial").glob("*.md"))
SITE = "https://warp-bsc.github.io/warp-bsc/main/"
RAW = "https://raw.githubusercontent.com/warp-bsc/warp-bsc/main/"
COLAB = "https://colab.research.google.com/github/warp-bsc/warp-bsc/blob/main/"
BADGE = "https://colab.research.google.com/assets/colab-badge.svg"
TITLE = f"""# Tutorial

[![Open in Colab]({BADGE})]({COLAB}{NOTEBOOK.relative_to(ROOT).as_posix()})

These are the pages of the [tutorial]({SITE}tutorial.html), of which `python tests/support/tutorial_notebook.py` makes
this notebook. Each page runs alone. The next cell installs warp-bsc where it is missing, as on Colab."""
DEVICE = 'DEVICE = None  # "cpu" or "cuda:0"; None: a GPU, if there is one'
SETTINGS = """import warp as wp

wp.config.log_level = wp.LOG_WARNING  # no line for each module of kernels
wp.set_device(DEVICE or wp.get_preferred_device())"""
PYTHON = re.compile(r"```python\n(.*?)\n```", re.DOTALL)
LINK = re.compile(r"(!?\[[^\]]*\]\()(?!\w+:)([^)#]+)(#[^)]*)?\)")
NEXT = re.compile(r"\n\nNext: .*", re.DOTALL)


def absolute_link(match):
    """A link of a page as one to the site, to a picture, or to the repository."""
    path = normpath(PurePosixPath("docs/tutorial") / match[2])
    if path.startswith("docs/"):
        return f"{match[1]}{SITE}{path.removeprefix('docs/').replace('.md', '.html')}{match[3] or ''})"
    start = RAW if match[1].startswith("!") else "../../"
    return f"{match[1]}{start}{path})"


def cells():
    """The cells of the notebook: title, installation, device, and those of each page."""
    first = nbformat.read(next(path for path in NOTEBOOKS if path != NOTEBOOK), nbformat.NO_CONVERT)
    yield "title", TITLE
    yield "install", first.cells[1].source
    yield "size", DEVICE
    yield "settings", SETTINGS
    for page in PAGES:
        number = count()
        for part in re.split(r"(```python\n.*?```)", NEXT.sub("", page.read_text().strip()), flags=re.DOTALL):
            name = f"{page.stem.partition('_')[2]}_{chr(ord('a') + next(number))}"
            code = PYTHON.fullmatch(part)
            if code:
                yield f"{name}_code", code[1]
            elif part.strip():
                yield name, LINK.sub(absolute_link, part.strip())


def notebook_text():
    """The notebook in its committed form."""
    notebook = nbformat.v4.new_notebook(metadata=METADATA)
    for name, source in cells():
        is_code = name.endswith("_code") or name in {"install", "size", "settings"}
        new_cell = nbformat.v4.new_code_cell if is_code else nbformat.v4.new_markdown_cell
        notebook.cells.append(new_cell(source, id=name, metadata={"tags": ["parameters"]} if name == "size" else {}))
    nbformat.validate(notebook)
    return nbformat.writes(notebook) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(notebook_text(), encoding="utf-8")
