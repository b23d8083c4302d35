"""The C++ of native functions, from headers in the folder ``native`` beside the modules that use it.

A header holds statements of a function: all of its body, or the definitions at its beginning that several functions
share. Its text becomes a part of the snippet, so that Warp compiles a module anew where a header has changed.
"""

from collections.abc import Mapping
from pathlib import Path


def header(module: str, *names: str) -> str:
    """Returns the text of headers, one after the other, by the file of a module beside them and their names."""
    return "".join((Path(module).parent / "native" / name).read_text(encoding="utf-8") for name in names)


def definitions(types: Mapping[str, str], **constants: bool | int | float) -> str:
    """Returns the C++ that defines types and constants, by their names, as headers use them."""
    lines = [f"using {name} = {type_};\n" for name, type_ in types.items()]
    for name, value in constants.items():
        lines.append(f"constexpr auto {name} = {str(value).lower() if isinstance(value, bool) else repr(value)};\n")
    return "".join(lines)
