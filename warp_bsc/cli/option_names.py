"""Names options in place of the library's arguments in messages that begin with an argument. Imports little."""

import re

_NAMES = (
    "allow_missing between clearance count exclude frames ignore ignore_initial intersections keep kind max_move "
    "max_strain method min_distance prims rigid subdivide triage validate workers"
)
_OPTIONS = {name: f"--{name.replace('_', '-')}" for name in _NAMES.split()}
_OPTIONS |= {"purposes": "--purpose", "self_collisions": "--self", "x_previous": "--previous"}
"""The option that sets each argument of the library."""

_ARGUMENT = re.compile(rf"({'|'.join(_OPTIONS)})(?=: | must |\[)")


def with_option(message: str) -> str:
    """Returns a message of the library with the option in place of the argument that the message begins with."""
    argument = _ARGUMENT.match(message)
    return _OPTIONS[argument[1]] + message[argument.end() :] if argument else message
