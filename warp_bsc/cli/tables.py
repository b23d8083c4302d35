"""The console, lines and tables of all commands."""

from collections.abc import Iterable, Sequence
from typing import Any

import rich.console
from rich import box
from rich.table import Table
from rich.text import Text

from ..bench.tables import LONGEST, Column


class Console(rich.console.Console):
    """A terminal or a file that raises BrokenPipeError if its reader has closed it."""

    def on_broken_pipe(self) -> None:
        """Raises the error again; rich would end the program with status 1, which means a collision."""
        raise BrokenPipeError


def print_table(
    console: rich.console.Console,
    first: str | Column,
    columns: Iterable[Column],
    rows: Iterable[tuple[str, Any]],
    *,
    total: Any = None,
    caption: str | None = None,
) -> None:
    """Prints a table, with a caption below it.

    ``first`` is the column of the names of the rows, or its header. A row is its name, and what the other columns show
    of it, None for nothing; ``total`` is what they show of all rows together, in a last one.
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


def say(console: rich.console.Console, line: str, style: str | None = None) -> None:
    """Prints a line without markup, in a style; on a terminal it wraps."""
    console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal, style=style)


def say_list(console: rich.console.Console, lines: Sequence[str], more: str) -> None:
    """Prints the first of some lines, indented, and how many there are more, of what ``more`` says."""
    for line in lines[:LONGEST]:
        say(console, f"  {line}")
    if len(lines) > LONGEST:
        say(console, f"  and {len(lines) - LONGEST} more{more}")
