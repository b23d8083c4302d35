"""What programs that measure share: options, a table of their rows, and the file that has them."""

import argparse
import json
import sys

from warp_bsc._atomic_file import OutputFile
from warp_bsc.bench.record import with_record
from warp_bsc.cli.tables import Console, print_table


def options_of(doc, *, device=None):
    """Returns a parser with the text of a program, ``--json``, and ``--device`` if that has a default."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="file to which the rows are written as well")
    if device is not None:
        parser.add_argument("--device", default=device)
    return parser


def print_rows(first, columns, rows, **more):
    """Prints a table, 120 columns wide where there is no terminal; arguments as of ``print_table``."""
    print_table(Console(width=None if sys.stdout.isatty() else 120), first, columns, rows, **more)


def report(arguments, benchmark, first, columns, rows, devices, *, name="scene", **settings):
    """Prints the rows of a measurement, plain data, and writes them with its settings where ``--json`` says.

    ``name`` is the key of the name of a row, or a function that returns it.
    """
    print_rows(first, columns, [(name(row) if callable(name) else row[name], row) for row in rows])
    if arguments.json:
        write_measurement(arguments.json, {"benchmark": benchmark, **settings, "rows": rows}, devices)


def write_measurement(path, found, devices=()):
    """Writes a measurement of devices with its record to a file, which appears complete or not at all.

    ``found`` is plain data, with the name of the measurement as ``benchmark``.
    """
    file = OutputFile(path)
    try:
        file.write(json.dumps(with_record(found, sys.argv, devices)))
        file.commit()
    finally:
        file.discard()
