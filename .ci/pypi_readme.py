"""Makes the links of README.md absolute, for PyPI, which has no files: ``python .ci/pypi_readme.py README.md TAG``."""

import re
import sys
from pathlib import Path

REPOSITORY = "https://github.com/warp-bsc/warp-bsc"
FILES = "https://raw.githubusercontent.com/warp-bsc/warp-bsc"


def with_absolute_links(text: str, tag: str) -> str:
    """Returns a page whose relative links and pictures are those of a tag in the repository."""
    text = re.sub(r"(!\[[^\]]*\])\((?![\w+.-]+:)([^)\s]+)\)", rf"\1({FILES}/{tag}/\2)", text)
    return re.sub(r"((?<!!)\[[^\]]*\])\((?![\w+.-]+:|#)([^)\s]+)\)", rf"\1({REPOSITORY}/blob/{tag}/\2)", text)


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(with_absolute_links(page.read_text(), sys.argv[2]))
