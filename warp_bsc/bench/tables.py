"""Tables as data: columns, whose cells a terminal draws and a page has as Markdown."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

_Row = TypeVar("_Row")

LONGEST = 30
"""Largest number of rows in a table, or of lines in a list."""


@dataclass(frozen=True)
class Column:
    """A column of a table: the value that it shows of each row, and how."""

    header: str  # its header, shown as it is: markup would take "[s]" for a style
    # key, number or attribute of a row, with dots for one of that; or a function of a row
    value: str | Callable[[Any], Any] = ""
    # format specification of the value, or a function that returns its text; not of texts and None
    format: str | Callable[[Any], str] = ","
    width: int | None = None  # least width on a terminal
    # numbers are on the right and do not wrap, words are on the left and do not wrap, text may wrap
    kind: Literal["number", "word", "text"] = "number"
    title: str | None = None  # its header in pages, if that is another one
    page_format: str | Callable[[Any], str] | None = None  # its format in pages, if that is another one

    def cell(self, row: Any, *, page: bool = False) -> str:
        """Returns the text of the cell in a row, in a page or on a terminal; empty in a row that is None."""
        value = row
        for part in [self.value] if callable(self.value) else self.value.split("."):
            if value is None:
                return ""
            value = part(value) if callable(part) else _part(value, part)
        written = self.page_format if page and self.page_format is not None else self.format
        if value is None or isinstance(value, str):
            return value or ""
        return written(value) if callable(written) else format(value, written)


@dataclass(frozen=True)
class Table:
    """A table with its rows."""

    first: str | Column  # the column of the names of the rows, or its header
    columns: Sequence[Column]  # the other columns
    # the name of each row, and a value of which the columns show parts; None leaves them empty
    rows: Iterable[tuple[str, Any]]
    caption: str | None = None  # a sentence below the table


def _part(row: Any, name: str) -> Any:
    if isinstance(row, dict):
        return row[name]
    return row[int(name)] if name.isdigit() else getattr(row, name)


def count(number: int, one: str, many: str = "") -> str:
    """Returns a number with the noun that it counts, singular or plural."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def grouped(rows: Iterable[_Row], key: str) -> dict[str, list[_Row]]:
    """Returns rows by the value of a key or an attribute, in the order of their first."""
    groups: dict[str, list[_Row]] = {}
    for row in rows:
        groups.setdefault(row[key] if isinstance(row, dict) else getattr(row, key), []).append(row)
    return groups


def list_titles(titles: Sequence[str]) -> str:
    """Returns the number of titles, with the first of them."""
    return f"{len(titles):,}" + (f" ({', '.join(titles[:LONGEST])})" if titles else "")


def two(value: float) -> str:
    """Returns a number with two digits, more if it is large."""
    return f"{value:#.2g}".rstrip(".") if abs(value) < 99.5 else f"{value:,.0f}"


def in_thousands(decimals: int) -> Callable[[float], str]:
    """Returns a format with some decimals, without decimals from 1,000 on."""
    return lambda value: f"{value:,.{decimals if value < 1000.0 else 0}f}"
