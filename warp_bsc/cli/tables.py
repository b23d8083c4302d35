"""The console, lines and tables of all commands."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import rich.console
from rich import box
from rich.table import Table
from rich.text import Text

__all__ = ["LONGEST", "Column", "Console", "count", "grouped", "print_table", "say", "say_list"]

_Row = TypeVar("_Row")

LONGEST = 30
"""Largest number of rows in a table, or of lines in a list."""


class Console(rich.console.Console):
    """A terminal or a file that raises BrokenPipeError if its reader has closed it."""

    def on_broken_pipe(self) -> None:
        """Raises the error again; rich would end the program with status 1, which means a collision."""
        raise BrokenPipeError


@dataclass(frozen=True)
class Column:
    """A column of a table: what it shows of each row, and how.

    Attributes:
        header: Its header, shown as it is: markup would take "[s]" for a style.
        value: Name of the attribute of a row that it shows, with dots for one of an attribute; or a function of a row.
        format: Format specification of the value, or a function that returns its text. None is an empty cell.
        width: Least width.
        kind: Numbers are on the right and do not wrap, words are on the left and do not wrap, text may wrap.
    """

    header: str
    value: str | Callable[[Any], Any] = ""
    format: str | Callable[[Any], str] = ","
    width: int | None = None
    kind: Literal["number", "word", "text"] = "number"

    def cell(self, row: Any) -> str:
        """Returns the text of the cell in a row; empty in a row that is None."""
        if callable(self.value):
            row = None if row is None else self.value(row)
        else:
            for name in self.value.split("."):
                row = None if row is None else getattr(row, name)
        if row is None:
            return ""
        return self.format(row) if callable(self.format) else format(row, self.format)


def print_table(
    console: rich.console.Console,
    first: str | Column,
    columns: Iterable[Column],
    rows: Iterable[tuple[str, Any]],
    *,
    total: Any = None,
    caption: str | None = None,
) -> None:
    """Prints a table.

    Args:
        console: The terminal or file to print to.
        first: The column of the names of the rows, or its header.
        columns: The other columns.
        rows: The name of each row, and what the columns show of it; None leaves them empty.
        total: What the columns show of all rows together, in a last one; None without.
        caption: A sentence below the table.
    """
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, caption=caption, caption_justify="left")
    columns = list(columns)
    for column in (first if isinstance(first, Column) else Column(first, kind="text"), *columns):
        table.add_column(
            Text(column.header),
            justify="right" if column.kind == "number" else "left",
            no_wrap=column.kind != "text",
            overflow="fold" if column.kind == "text" else "ellipsis",
            min_width=column.width,
        )
    for name, row in rows:
        table.add_row(Text(name), *(Text(column.cell(row)) for column in columns))
    if total is not None:
        table.add_section()
        table.add_row("all", *(column.cell(total) for column in columns))
    console.print(table)


def say(console: rich.console.Console, line: str) -> None:
    """Prints a line without markup; on a terminal it wraps."""
    console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal)


def say_list(console: rich.console.Console, lines: Sequence[str], more: str) -> None:
    """Prints the first of some lines, indented, and how many there are more, of what ``more`` says."""
    for line in lines[:LONGEST]:
        say(console, f"  {line}")
    if len(lines) > LONGEST:
        say(console, f"  and {len(lines) - LONGEST} more{more}")


def count(number: int, one: str, many: str = "") -> str:
    """Returns a number with the noun that it counts, singular or plural."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def grouped(rows: Iterable[_Row], key: str) -> dict[str, list[_Row]]:
    """Returns rows by the value of an attribute, in the order of their first."""
    groups: dict[str, list[_Row]] = {}
    for row in rows:
        groups.setdefault(getattr(row, key), []).append(row)
    return groups
