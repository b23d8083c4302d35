"""The progress of a run: a bar, or lines, for people or for programs."""

import json
import sys
import time

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from .tables import Console, say

LOG_SECONDS = 10.0
"""Time between two lines on the progress, where there is no terminal."""


class RunProgress:
    """Shows the progress of a run: a bar on a terminal, else a line on standard error every ten seconds.

    Attributes:
        console: Prints on standard error, on a terminal above the bar.
    """

    def __init__(self, activity: str, *, as_json: bool = False):
        """Prepares the bar; ``as_json`` writes an object of JSON in a line each time instead, for programs."""
        self._activity, self._as_json = activity, as_json
        self.console = Console(stderr=True)
        bar, note = (BarColumn(bar_width=None), MofNCompleteColumn()), TextColumn("{task.fields[note]}")
        columns = TextColumn(activity), *bar, note, TimeRemainingColumn()
        self._bar = Progress(*columns, console=self.console, transient=True)
        self._bar.disable = as_json or not self.console.is_terminal
        self._task = self._bar.add_task("", total=None, note="")
        self._started = self._last_line = time.monotonic()
        self._first: tuple[float, float] | None = None  # what was done first, and when: before that, things load

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, done: float, total: int, note: str = "", **facts: int) -> None:
        """Shows how much of the total is done, and a note; programs get the facts by their names instead."""
        now = time.monotonic()
        if self._as_json:
            seconds = round(now - self._started, 3)
            line = {"activity": self._activity.lower(), "done": done, "of": total, "seconds": seconds}
            print(json.dumps(line | facts), file=sys.stderr, flush=True)
            return
        each, left = self._seconds_each(done, now), ""
        if each is not None:
            note += f"{', ' * bool(note)}{f'{1.0 / each:.1f}/s' if each < 1.0 else f'{each:.1f} s each'}"
            left = f", about {each * (total - done):,.0f} s left"
        self._bar.update(self._task, completed=done, total=total, note=note)
        if self._bar.disable and done and now - self._last_line > LOG_SECONDS:
            self._last_line = now
            say(self._bar.console, f"{self._activity}: {int(done)} of {total}{', ' * bool(note)}{note}{left}")

    def _seconds_each(self, done: float, now: float) -> float | None:
        """Returns the mean time of what was done after the first, without that of loading; None if there is none."""
        if self._first is None:
            if done:
                self._first = done, now
            return None
        first, since = self._first
        return max(now - since, 1e-9) / (done - first) if done > first else None
