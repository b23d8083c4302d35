"""The site builds without a warning, and its links and anchors lead somewhere, as those of all pages do on GitHub."""

import importlib.util
import itertools
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import warp_bsc as bsc
from warp_bsc import checker, kernels

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
EXTRA = ("sphinx", "myst_parser", "pydata_sphinx_theme", "sphinx_copybutton")
needs_extra = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, EXTRA)), reason="needs the extra docs: pip install -e '.[docs]'"
)
LINK = re.compile(r"(?:\]\(|^\[[\w-]+\]: )([^)\s]+)", re.MULTILINE)  # in the text, or defined at the end
OURS = re.compile(r"https://(?:github\.com/warp-bsc/warp-bsc/blob|raw\.githubusercontent\.com/warp-bsc/warp-bsc)/main/")
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


class Page(HTMLParser):
    """The anchors of a page, and the links of its elements a, img, link and script."""

    def __init__(self, path):
        super().__init__()
        self.anchors, self.links = set(), set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.anchors |= {attributes[name] for name in ("id", "name") if attributes.get(name)}
        self.links |= {attributes[name] for name in ("href", "src") if attributes.get(name)}


def wrong_links(site):
    """The links of the site that lead to no file, or to no anchor, of those in all pages."""
    pages = {path: Page(path) for path in site.rglob("*.html") if "_static" not in path.parts}
    wrong, checked = [], 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            checked += 1
            if not target.exists():
                wrong.append(f"{path.relative_to(site)}: {link}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                wrong.append(f"{path.relative_to(site)}: {link} has no anchor")
    assert len(pages) > 25 and checked > 1000
    return wrong


def missing_names(site):
    """The public names that the reference of the site has not."""
    anchors = set().union(*(Page(path).anchors for path in (site / "api").glob("*.html")))
    public = [f"warp_bsc.{name}" for name in bsc.__all__ if name != "checker"]
    public += [f"warp_bsc.kernels.{name}" for name in kernels.__all__]
    public += [f"warp_bsc.checker.{name}" for name in checker.__all__]
    public += ["warp_bsc.torch.rollout", "warp_bsc.jax.rollout"]
    return sorted(set(public) - anchors)


def missing_for_programs(site):
    """The pages of the site that llms.txt does not name, guides without Markdown, and replays without data."""
    text = (site / "llms.txt").read_text()
    names = {
        str(path.relative_to(DOCS).with_suffix("")) for path in DOCS.rglob("*.*") if path.suffix in (".md", ".rst")
    }
    names = {name for name in names if not name.startswith("upstream/")}
    listed = re.findall(r"^- \[.+\]\(https://\S+?/main/(\S+)\)", text, re.MULTILINE)
    missing = sorted(names ^ {name.rpartition(".")[0] for name in listed})
    missing += [name for name in listed if not (site / name).is_file()]
    for path in site.rglob("*.md"):
        for link in LINK.findall(FENCE.sub("", path.read_text())):
            if not re.match(r"\w+:|#", link) and not (path.parent / link.partition("#")[0]).exists():
                missing.append(f"{path.relative_to(site)}: {link}")
    shots = sorted((site / "shots").glob("*.html"))
    return missing + [path.name for path in shots if "Broken: " not in path.read_text()] + ["shots"] * (len(shots) != 3)


@pytest.mark.slow
@needs_extra
def test_the_site_builds_without_a_warning_and_is_whole(tmp_path):
    """One test, as processes that share out tests would each build the site."""
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(ROOT / "docs"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert not wrong_links(tmp_path)
    assert not missing_names(tmp_path)
    assert not missing_for_programs(tmp_path)
    assert (ROOT / "docs" / "upstream").is_dir() and not (tmp_path / "upstream").exists()  # drafts


def anchors_of(path):
    """The anchors that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", path.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def markdown_pages():
    """All pages of the repository."""
    pages = [*ROOT.glob("*.md"), *(ROOT / ".github").rglob("*.md")]
    return pages + [path for folder in ("assets", "docs", "warp_bsc") for path in (ROOT / folder).rglob("*.md")]


def test_links_between_pages_and_files_resolve():
    wrong, checked = [], 0
    for page in markdown_pages():
        for link in LINK.findall(FENCE.sub("", page.read_text())):
            is_ours = OURS.match(link)  # as in the README, which PyPI shows without files
            if re.match(r"\w+:", link) and not is_ours:
                continue
            name, _, anchor = OURS.sub("", link).partition("#")
            target = ((ROOT if is_ours else page.parent) / name).resolve() if name else page
            checked += 1
            if not target.exists() or (anchor and anchor not in anchors_of(target)):
                wrong.append(f"{page.relative_to(ROOT)}: {link}")
    assert checked > 100 and not wrong, "\n".join(wrong)


def test_rows_of_tables_have_as_many_cells_as_their_heads():
    wrong, checked = [], 0
    for page in markdown_pages():
        lines = FENCE.sub("", page.read_text()).split("\n")
        rows = [re.split(r"(?<!\\)\|", line.strip())[1:-1] if line.startswith("|") else [] for line in lines]
        for head, rule, first in zip(rows, rows[1:], range(2, len(rows)), strict=False):
            if not rule or not all(re.fullmatch(r" ?:?-+:? ?", cell) for cell in rule):
                continue
            for row in itertools.takewhile(bool, rows[first:]):
                checked += 1
                if len(row) != len(head):
                    wrong.append(f"{page.relative_to(ROOT)}: {'|'.join(row)}")
    assert checked > 300 and not wrong, "\n".join(wrong)


LONGEST = 132
"""Characters of a line, so that differences between versions show sentences."""


def lines_that_can_be_broken(text):
    """Yields the lines of a page and their numbers, without tables, headings, pictures, links and what is generated."""
    text = re.sub(r"<!-- table: .*?<!-- end -->", lambda made: "\n" * made[0].count("\n"), text, flags=re.DOTALL)
    for number, line in enumerate(text.split("\n"), 1):
        words = re.sub(r"\[[^\]]*\]\(\S+\)", "", line.strip(" -*")).strip()
        if not re.match(r"\s*\||#|!\[|\[[\w-]+\]: ", line) and " " in words:
            yield number, line


def test_lines_are_short():
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    long = [
        f"{page.relative_to(ROOT)}:{number}: {len(line)} characters"
        for page in pages
        for number, line in lines_that_can_be_broken(page.read_text())
        if len(line) > LONGEST
    ]
    assert len(pages) > 30 and not long, "\n".join(long)
