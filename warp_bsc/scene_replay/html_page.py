"""Fills in the parts of a page that is one file and needs no network: its script, its style, and blocks of arrays.

The folder ``page`` contains the parts that pages share. Text from a scene's file enters a page as JSON, in which no
markup can begin, and the script inserts it as text. The page's content security policy blocks everything else: other
scripts, handlers in attributes, addresses.
"""

import base64
import hashlib
import html
import json
import zlib
from collections.abc import Iterable
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np

_SMALL_BLOCK = 4096  # bytes up to which a block is not compressed


def shared_part(name: str) -> Traversable:
    """Returns a part that pages share."""
    return resources.files("warp_bsc.scene_replay") / "page" / name


def fill_page(page: Traversable, scripts: Iterable[Traversable], title: str) -> tuple[str, str, str]:
    """Returns a page in three texts, between which its blocks and its data belong.

    Args:
        page: Its markup, with the names of fields in double braces.
        scripts: The parts of its script, in order.
        title: Its title.
    """
    style = shared_part("page.css").read_text(encoding="utf-8")
    script = "\n".join(part.read_text(encoding="utf-8") for part in scripts)
    fields = {"title": html.escape(title), "style": style, "script": script}
    fields |= {"style_hash": _policy_hash(style), "script_hash": _policy_hash(script)}
    # Text, name, text, name, ...: the filled-in texts may contain braces.
    parts = page.read_text(encoding="utf-8").replace("{{", "}}").split("}}")
    filled = [fields.get(part, part) if index % 2 else part for index, part in enumerate(parts)]
    blocks, data = filled.index("blocks"), filled.index("data")
    return "".join(filled[:blocks]), "".join(filled[blocks + 1 : data]), "".join(filled[data + 1 :])


def block(name: str, facts: dict, arrays: dict[str, np.ndarray]) -> str:
    """Returns arrays as an element that the page's script unpacks by its name.

    The content is a JSON header and the arrays in 32 bits, with the first bytes of all numbers before the second ones,
    which compress better; all of it in base64. It is compressed unless it is small, as each unpacking takes a browser
    a millisecond.
    """
    columns = {}
    for key, array in arrays.items():
        kind = np.float32 if array.dtype.kind == "f" else np.int32
        columns[key] = np.ascontiguousarray(array, dtype=np.dtype(kind).newbyteorder("<")).reshape(-1)
    header = json.dumps(facts | {"arrays": [(key, column.dtype.kind, len(column)) for key, column in columns.items()]})
    planes = [column.view(np.uint8).reshape(-1, 4).T.tobytes() for column in columns.values()]
    content, packed = b"".join([len(header).to_bytes(4, "little"), header.encode(), *planes]), ""
    if len(content) > _SMALL_BLOCK:
        content, packed = zlib.compress(content), ' data-packed="deflate"'
    return f'<script type="text/plain" id="{name}"{packed}>{base64.b64encode(content).decode()}</script>\n'


def spread(count: int, most: int) -> np.ndarray:
    """Returns the numbers below a count, or ``most`` of them, spread evenly."""
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def inert(data: Any) -> str:
    """Returns JSON in which no tag and no comment can begin or end."""
    text = json.dumps(data, allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _policy_hash(text) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
