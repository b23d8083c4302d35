"""The progress of a run: a bar, or lines."""

import time

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .tables import Console, say

__all__ = ["RunProgress"]

_LOG_SECONDS = 10.0
"""Time between two lines on the progress, where there is no terminal."""


class RunProgress:
    """Shows the progress of a run: a bar on a terminal, else a line on standard error every ten seconds."""

    def __init__(self, activity: str):
        self._activity = activity
        self._bar = Progress(
            TextColumn(activity),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._bar.disable = not self._bar.console.is_terminal
        self._task = self._bar.add_task("", total=None, note="")
        self._started = self._last_line = time.monotonic()

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, done: int, total: int, note: str = "") -> None:
        """Shows how much of the total is done, and a note."""
        now = time.monotonic()
        if done:
            note += f"{', ' * bool(note)}{done / max(now - self._started, 1e-9):.1f}/s"
        self._bar.update(self._task, completed=done, total=total, note=note)
        if self._bar.disable and done and now - self._last_line > _LOG_SECONDS:
            self._last_line = now
            left = (now - self._started) / done * (total - done)
            say(self._bar.console, f"{self._activity}: {done} of {total}, {note}, about {left:,.0f} s left")
