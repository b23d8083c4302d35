"""How many random cases tests take: all of them, or a part of them in a run without slow tests."""

_PART = 4
"""A run with ``-m "not slow"`` takes one case in this many."""
_takes_all = True


def choose(markers: str) -> None:
    """Chooses the numbers of cases for a run of tests, given the expression that selects tests by their markers."""
    global _takes_all  # noqa: PLW0603 (one for the run)
    _takes_all = "not slow" not in markers


def cases(number: int) -> int:
    """Returns a number of random cases for a test that takes this many in a full run."""
    return number if _takes_all else -(-number // _PART)
