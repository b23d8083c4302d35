"""The console, lines and tables of all commands."""

import rich.console
from rich import box
from rich.table import Table
from rich.text import Text

__all__ = ["LONGEST", "Console", "count", "make_table", "say"]

LONGEST = 30
"""Largest number of rows in a table, or of lines in a list."""


class Console(rich.console.Console):
    """A terminal or a file that raises BrokenPipeError if its reader has closed it."""

    def on_broken_pipe(self) -> None:
        """Raises the error again; rich would end the program with status 1, which means a collision."""
        raise BrokenPipeError


def say(console: rich.console.Console, line: str) -> None:
    """Prints a line without markup; on a terminal it wraps."""
    console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal)


def make_table(first: str, *others: str, caption: str | None = None) -> Table:
    """Returns a table whose first column is text, which may wrap; the other columns are numbers, which may not.

    Headers are shown as they are: markup would take "[s]" for a style.
    """
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, caption=caption, caption_justify="left")
    table.add_column(Text(first), overflow="fold")
    for header in others:
        table.add_column(Text(header), justify="right", no_wrap=True)
    return table


def count(number: int, one: str, many: str = "") -> str:
    """Returns a number with the noun that it counts, singular or plural."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"
