"""Whether OpenUSD can be imported, and is new enough."""

OLDEST = 25, 8
"""The oldest version of OpenUSD that the tests of this package have passed with."""


def check_openusd() -> None:
    """Checks that OpenUSD's package ``pxr`` is there, whichever package has brought it.

    Raises:
        ImportError: If it is missing or too old. The message says what to install.
    """
    try:
        from pxr import Usd  # noqa: PLC0415 (slow)
    except ImportError as error:
        raise ImportError(
            "USD scenes need OpenUSD, whose Python package pxr cannot be imported: pip install 'warp-bsc[usd]'"
        ) from error
    _, year, month = Usd.GetVersion()
    if (year, month) < OLDEST:
        raise ImportError(
            f"USD scenes need OpenUSD {OLDEST[0]}.{OLDEST[1]:02} or later, and {Usd.__file__} is of {year}.{month:02}: "
            "update the package that it belongs to, such as usd-core or usd-exchange"
        )
