"""Lists the versions of the site for its switcher: ``python .ci/site_versions.py FOLDER``.

FOLDER holds a folder for each version, ``main`` or a tag such as ``v0.1.0``. Writes ``versions.json``, newest first,
and an ``index.html`` that leads to the newest tag, or to ``main`` if there is none.
"""

import json
import re
import sys
from pathlib import Path

URL = "https://warp-bsc.github.io/warp-bsc"
PAGE = '<!doctype html><meta charset="utf-8"><title>warp-bsc</title><meta http-equiv="refresh" content="0; url={}/">\n'


def write_versions(folder: Path) -> list[str]:
    """Writes both files, and returns the names of the versions, those of tags first, newest first, then ``main``.

    Raises:
        ValueError: If the folder has no version.
    """
    tags = [path.name for path in folder.iterdir() if re.fullmatch(r"v\d+\.\d+\.\d+", path.name)]
    tags.sort(key=lambda tag: tuple(map(int, tag[1:].split("."))), reverse=True)
    names = tags + ["main"] * (folder / "main").is_dir()
    if not names:
        raise ValueError(f"{folder} has no folder main, nor one of a version such as v0.1.0")
    entries = [{"version": name, "name": name.removeprefix("v"), "url": f"{URL}/{name}/"} for name in names]
    if tags:
        entries[0] |= {"name": f"{tags[0][1:]} (newest)", "preferred": True}
    (folder / "versions.json").write_text(json.dumps(entries, indent=1) + "\n")
    (folder / "index.html").write_text(PAGE.format(names[0]))
    return names


if __name__ == "__main__":
    print(*write_versions(Path(sys.argv[1])))
