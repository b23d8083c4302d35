"""The exit statuses of all commands, and their explanation for help texts. Imports little."""

import textwrap
from enum import IntEnum


class ExitStatus(IntEnum):
    """An exit status. After a signal it is 128 plus the number of the signal."""

    DONE = 0
    FOUND = 1
    ERROR = 2
    DISAGREES = 3
    LEFT_OUT = 4
    EMPTY = 5
    BROKEN_PIPE = 141


_TEXTS = {
    ExitStatus.DONE: "done",
    ExitStatus.FOUND: "done, and found what --fail-on names",
    ExitStatus.ERROR: "wrong usage, bad input or another error; a line on standard error names it and its place",
    ExitStatus.DISAGREES: "replay --validate found a wrong decision",
    ExitStatus.LEFT_OUT: "done, but parts of the scene that may hold geometry could not be read and were left out; "
    "--strict ends with 2 instead; or repair moves tetrahedra less than contacts need, as they would invert",
    ExitStatus.EMPTY: "a scene can be read, and has no visible mesh, or none that is selected",
    ExitStatus.BROKEN_PIPE: "the reader of the output, such as head -1, has closed it",
}
_SIGNALS = "  129, 130, 143  interrupted by SIGHUP, by Ctrl-C, by SIGTERM"


def explain_statuses(*statuses: ExitStatus) -> str:
    """Returns the explanation of some exit statuses, and of those that every command has, for a help text."""
    lines = ["exit status:"]
    for status in sorted({ExitStatus.DONE, ExitStatus.ERROR, *statuses} - {ExitStatus.BROKEN_PIPE}):
        lines += _wrap(status)
    lines += [_SIGNALS, *_wrap(ExitStatus.BROKEN_PIPE)]
    if ExitStatus.LEFT_OUT in statuses:
        lines.append("If several apply, a signal comes before 2, then 3, 1 and 4.")
    return "\n".join(lines)


def _wrap(status: ExitStatus) -> list[str]:
    return textwrap.wrap(f"{status:d}  {_TEXTS[status]}", 80, initial_indent="  ", subsequent_indent="     ")
