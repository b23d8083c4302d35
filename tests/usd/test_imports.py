"""OpenUSD stays behind one package, and that package needs no Warp."""

import ast
import subprocess
import sys
from pathlib import Path

import warp_bsc

PACKAGE = Path(warp_bsc.__file__).parent


def imported_by(path):
    """Top-level names of all modules that a file imports by absolute names, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module.partition(".")[0]


def test_openusd_is_imported_in_one_package_only():
    importing = {path for path in PACKAGE.rglob("*.py") if "pxr" in imported_by(path)}
    of_programs = {PACKAGE / "scene_replay" / f"{name}.py" for name in ("usd_validation", "usdview_plugin")}
    of_programs.add(PACKAGE / "nvidia_validation.py")
    assert of_programs <= importing
    assert {path.relative_to(PACKAGE).parts[0] for path in importing - of_programs} == {"usd"}


def test_a_scene_is_read_without_warp():
    scene = PACKAGE.parent / "assets" / "cloth_twist.usd"
    script = (
        "import sys; from warp_bsc.usd.scene import Scene; "
        f"Scene({str(scene)!r}).interval(0); print({{'warp', 'rich', 'newton'}} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
