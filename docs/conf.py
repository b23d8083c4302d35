"""Settings of the documentation site: ``python -m sphinx -W docs build/site`` builds it, offline.

The theme, that of Newton's and NumPy's pages, has a switcher of versions. Guides are Markdown, which GitHub shows too.
The site has each guide as Markdown beside its page, and ``llms.txt``, a list of all pages for programs that read it.
"""

import functools
import gc
import importlib
import os
import re
import subprocess
import sys
import tomllib
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace

from docutils import nodes
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective
from sphinx.util.nodes import make_refnode

import warp_bsc
from warp_bsc.cli.main import build_parser

gc.disable()  # a build makes trees that stay, and takes a quarter longer if they are looked at again and again

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
REPOSITORY = "https://github.com/warp-bsc/warp-bsc"
VERSION = os.environ.get("WARP_BSC_DOCS_VERSION", "main")
"""Branch or tag that is built: the folder of the site, and where links to the sources point."""

project = "warp-bsc"
author = "The warp-bsc contributors"
copyright = author
release = version = warp_bsc.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["upstream"]  # drafts of what to ask Warp and Newton for

myst_heading_anchors = 4  # as GitHub makes them

napoleon_numpy_docstring = False
autoclass_content = "both"
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
add_module_names = False
nitpicky = True
nitpick_ignore_regex = [
    # of other projects, whose inventories would be downloaded
    (r"py:.*", r"(warp|wp|newton|numpy|np|trimesh|torch|jax|copy|multiprocessing|collections|os|Usd|Sdf)\b.*"),
    # types of annotations, and words that stand where a type may
    (r"py:class", r"(warp_bsc\..*|[^.]*|(state\.structs|contacts\.rules|inside)\.\w+)"),
    # modules behind those that the reference cites
    (r"py:mod", r"(contacts\.search|adjoint\.(restore|kernels)|polish|polynomials)"),
    (r"py:(func|meth)", r"(decide|face_order\.order_faces|.*\.ProximityFinder\.find)"),
]
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = f"warp-bsc {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/logo.svg"
html_baseurl = f"https://warp-bsc.github.io/warp-bsc/{VERSION}/"
html_show_sourcelink = False
html_copy_source = False
_WITHOUT_SUBPAGES = ["index", "install", "detector", "kernels", "measurements", "notebooks", "gallery", "play"]
_WITHOUT_SUBPAGES += ["changelog", "contributing"]
html_sidebars = {name: [] for name in _WITHOUT_SUBPAGES}
html_theme_options = {
    "logo": {"text": "warp-bsc", "image_light": "_static/logo.svg", "image_dark": "_static/logo.svg"},
    "github_url": REPOSITORY,
    "navbar_persistent": ["search-button"],
    "navbar_end": ["version-switcher", "theme-switcher", "navbar-icon-links"],
    "switcher": {"json_url": "https://warp-bsc.github.io/warp-bsc/versions.json", "version_match": VERSION},
    "check_switcher": False,  # a build reads nothing from the network
    "show_toc_level": 2,
    "show_prev_next": False,
    "header_links_before_dropdown": 5,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}


def stand_in_for_frameworks():
    """Puts classes in place of PyTorch's and JAX's, so that the bridges are imported without them."""
    tensor, array = type("Tensor", (), {"__module__": "torch"}), type("Array", (), {"__module__": "jax"})
    autograd = SimpleNamespace(Function=object, function=SimpleNamespace(once_differentiable=lambda function: function))
    sys.modules["torch"] = SimpleNamespace(Tensor=tensor, autograd=autograd)
    sys.modules["jax"] = SimpleNamespace(Array=array, __version__="0")


def unwrap_device_code():
    """Puts Python functions and classes in place of those of Warp, whose docstrings and signatures autodoc reads."""
    kernels = importlib.import_module("warp_bsc.kernels")
    for name in kernels.__all__:
        value = getattr(kernels, name)
        setattr(kernels, name, getattr(value, "func", getattr(value, "cls", value)))


def shorten_types(app, what, name, obj, options, signature, returns):
    """Shortens the types of signatures: those of arrays are written as in a program."""
    shorten = functools.partial(re.sub, r"~?warp\._src\.types\.array", "wp.array")
    union = r"~numpy\._typing\.[^=]*?_NestedSequence\[complex \| bytes \| str\]"
    return tuple(text and re.sub(union, "ArrayLike", shorten(text)) for text in (signature, returns))


def escape_bars(app, what, name, obj, options, lines):
    """Escapes the bars of absolute values, which are substitutions of reStructuredText."""
    for i, line in enumerate(lines):
        parts = line.split("``")
        lines[i] = "``".join(part if inside else part.replace("|", r"\|") for inside, part in zip(cycle((0, 1)), parts))


def find_by_name(app, env, node, contnode):
    """Finds what a docstring names by the module that defines it, under its public name."""
    python, parts = env.get_domain("py"), node.get("reftarget", "").split(".")
    for name in (".".join(parts[-2:]), parts[-1]):
        found = [key for key in python.objects if key.endswith(f".{name}")] if node.get("refdomain") == "py" else []
        if found and (name[0].isupper() or "." in name):
            target = python.objects[found[0]]
            return make_refnode(app.builder, node["refdoc"], target.docname, target.node_id, contnode, found[0])
    return None


def link_sources(app, name, content):
    """Replaces relative links that leave this folder by links to the repository; GitHub follows them as they are."""
    content[0] = with_links(content[0], Path(app.srcdir, name).parent, r"(?<!!)\[[^\]]*\]")


def with_links(text, folder, label):
    """Returns a text with its relative links that leave this folder as links to the repository.

    Args:
        text: The text.
        folder: The folder at which its links begin.
        label: Pattern of what stands before an address.

    Raises:
        ValueError: If a link leads to no file.
    """

    def replaced(match):
        path = (folder / match[2]).resolve()
        if path.is_relative_to(DOCS) and folder.is_relative_to(DOCS):
            return match[0]
        if not path.exists():
            raise ValueError(f"{folder}: {match[2]} does not exist")
        if path.is_relative_to(DOCS):
            return f"{match[1]}({path.relative_to(DOCS).as_posix()}{match[3]})"
        kind = "raw" if match[1].startswith("!") else "tree" if path.is_dir() else "blob"
        return f"{match[1]}({REPOSITORY}/{kind}/{VERSION}/{path.relative_to(ROOT).as_posix()}{match[3]})"

    return re.sub(rf"({label})\(([\w./-]+)((?:#[\w-]*)?)\)", replaced, text)


def markdown_of(name):
    """Returns the Markdown of a guide for readers of the site: without lists of pages, with links that lead there."""
    path = DOCS / f"{name}.md"
    text = path.read_text(encoding="utf-8")
    included = re.match(r"```\{include\} (\S+)", text)
    if included:
        path = (DOCS / included[1]).resolve()
        text = path.read_text(encoding="utf-8")
    text = re.sub(r"```\{toctree\}\n.*?```\n", "", text, flags=re.DOTALL).rstrip() + "\n"
    text = with_links(text, path.parent, r"!?\[[^\]]*\]")
    return re.sub(r"\]\(([\w./-]+)\.rst\b", r"](\1.html", text)  # the reference has no Markdown


def first_sentence(page):
    """Returns the first sentence of a page, of its own text alone: not of tables."""
    section = next(page.findall(nodes.section))
    text = next((" ".join(part.astext().split()) for part in section if isinstance(part, nodes.paragraph)), "")
    return re.split(r"(?<=\w\w\.) ", text)[0]


def write_for_programs(app, exception):
    """Writes the Markdown of each guide beside its page, and ``llms.txt``, which names all pages with a sentence."""
    if exception or app.builder.format != "html":
        return
    sections = {"Guides": [], "Reference": []}
    for name in pages_in_order(app.env, app.config.root_doc):
        is_guide = (DOCS / f"{name}.md").exists()
        if is_guide:
            Path(app.outdir, f"{name}.md").write_text(markdown_of(name), encoding="utf-8")
        address = f"{html_baseurl}{name}.{'md' if is_guide else 'html'}"
        title, text = app.env.titles[name].astext(), first_sentence(app.env.get_doctree(name))
        sections["Guides" if is_guide else "Reference"].append(
            f"- [{title}]({address})" + (f": {text}" if text else "")
        )
    lists = "".join("\n## {}\n\n{}\n".format(title, "\n".join(lines)) for title, lines in sections.items())
    summary = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["description"]
    Path(app.outdir, "llms.txt").write_text(f"# {project}\n\n> {summary}\n{lists}", encoding="utf-8")


def pages_in_order(env, name):
    """Yields the names of a page and all below it, as the lists of pages have them."""
    yield name
    for below in env.toctree_includes.get(name, ()):
        yield from pages_in_order(env, below)


SHOTS = "cloth_twist", "funnel", "dancer"
"""Scenes of ``assets/`` whose replays the site has."""
_REPLAY = """
import sys
from warp_bsc.cli.main import main
for shot in sys.argv[2:]:
    command = ["replay", f"assets/{shot}.usd", "--device", "cpu", "--report", f"{sys.argv[1]}/{shot}.html"]
    if main(command):
        sys.exit(1)
"""


def start_replays(app):
    """Starts a process that replays the shots, while the pages are read."""
    folder = Path(app.outdir) / "shots"
    missing = [shot for shot in SHOTS if not (folder / f"{shot}.html").exists()]
    if missing and app.builder.format == "html":
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-c", _REPLAY, str(folder.resolve()), *missing]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        app.replays = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, **pipes)


def finish_replays(app, exception):
    """Waits for the replays.

    Raises:
        ExtensionError: If one failed, with what it said.
    """
    replays = getattr(app, "replays", None)
    if replays is None:
        return
    if exception:
        replays.terminate()
    said = replays.communicate()[1]
    if replays.returncode and not exception:
        raise ExtensionError(f"the replays of the page play failed: {said}")


class Shot(SphinxDirective):
    """The replay of a shot of :data:`SHOTS`, in the page, with a link to it alone."""

    required_arguments = 1

    def run(self):
        """Returns a frame with the replay."""
        name = self.arguments[0]
        if name not in SHOTS:
            raise self.error(f"no replay is named {name}, only {', '.join(SHOTS)}")
        address = f"shots/{name}.html"
        html = f'<iframe class="shot" src="{address}" loading="lazy" title="Replay of {name}"></iframe>'
        return [nodes.raw("", f'{html}<p><a href="{address}">This replay alone</a></p>', format="html")]


class CommandHelp(SphinxDirective):
    """The help text of a command of ``warp-bsc``, such as ``bench detector``, or of all."""

    optional_arguments, final_argument_whitespace = 1, True

    def run(self):
        """Returns the text as a block of code."""
        os.environ["COLUMNS"] = "80"
        parser = build_parser()
        for name in " ".join(self.arguments).split():
            parser = parser._subparsers._group_actions[0].choices[name]
        text = parser.format_help()
        return [nodes.literal_block(text, text, language="none")]


def setup(app):
    """Connects the functions above."""
    stand_in_for_frameworks()
    unwrap_device_code()
    app.add_directive("command-help", CommandHelp)
    app.add_directive("shot", Shot)
    app.connect("autodoc-process-signature", shorten_types)
    app.connect("autodoc-process-docstring", escape_bars)
    app.connect("missing-reference", find_by_name)
    app.connect("source-read", link_sources)
    app.connect("builder-inited", start_replays)
    app.connect("build-finished", write_for_programs)
    app.connect("build-finished", finish_replays)
