"""Holds certified answers against exact arithmetic on queries that aim at trouble.

    python tests/support/certify.py --count 4000                              # contacts, the default
    python tests/support/certify.py --method exact --count 4000
    python tests/support/certify.py --method user --count 400
    python tests/support/certify.py --device cuda:0 --count 100000000         # contacts, on a device
    python tests/support/certify.py arcs --count 100000 --detector 1000
    python tests/support/certify.py distances --count 200000                  # or --public
    python tests/support/certify.py inversions --count 1000000

Each prints tables, and exits with status 1 if a certified answer or a time of impact is wrong. The modules certify_*.py
say what each holds against what.
"""

import argparse
import importlib
import sys

import warp as wp

COUNTS = {"contacts": 1000, "device": 1000, "arcs": 8000, "distances": 10_000, "inversions": 100_000}
"""Default number of queries: of contacts for each generator, kind and type, of the others in all."""


HINTS = {
    "contacts": {"--lattice": "--lattice needs --device", "--json": "--json needs --device"},
    "device": {"--method": "--device runs every method: omit --method"},
}
"""What to say of an option of the other of the two kinds."""


def main():
    """Certifies queries of a kind."""
    kind, options = "contacts", sys.argv[1:]
    if options and options[0] in COUNTS:
        kind, *options = options
    if kind == "contacts" and any(option.split("=")[0] == "--device" for option in options):
        kind = "device"
    module = importlib.import_module(f"certify_{kind}")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=COUNTS[kind], help="queries (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    for name, option in module.OPTIONS.items():
        parser.add_argument(name, **option)
    arguments, others = parser.parse_known_args(options)
    if others:
        parser.error(HINTS.get(kind, {}).get(others[0], f"unrecognized arguments: {' '.join(others)}"))
    if arguments.count < 1:
        parser.error(f"--count must be at least 1, not {arguments.count}")
    wp.config.log_level = wp.LOG_WARNING
    return 1 if module.run(arguments) else 0


if __name__ == "__main__":
    sys.exit(main())
