"""What all tables and lines on the terminal have in common."""

import rich.console
from rich import box
from rich.table import Table

__all__ = ["LONGEST", "Console", "count", "make_table", "say"]

LONGEST = 30
"""Rows in a table, or lines in a list."""


class Console(rich.console.Console):
    """A terminal or a file, where that nobody reads it is an error like any other."""

    def on_broken_pipe(self):
        """Raises the error again; rich would end the program, with the status 1 of a collision."""
        raise BrokenPipeError


def say(console: Console, line: str) -> None:
    """Print a line as it is."""
    console.print(line, markup=False, highlight=False, soft_wrap=not console.is_terminal)


def make_table(first: str, *others: str, caption: str | None = None) -> Table:
    """A table whose first column is text and may wrap, the others numbers that may not."""
    table = Table(box=box.SIMPLE_HEAD, padding=0, show_edge=False, caption=caption, caption_justify="left")
    table.add_column(first, overflow="fold")
    for header in others:
        table.add_column(header, justify="right", no_wrap=True)
    return table


def count(number: int, one: str, many: str = "") -> str:
    """A number and what it counts."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"
