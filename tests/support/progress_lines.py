"""Standard error of the program without its lines on progress, which only slow machines and cold caches print."""

_PROGRESS = ("Compiling kernels",)


def without_progress(text: str) -> str:
    """Returns the lines of a text that are not on progress."""
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith(_PROGRESS))
