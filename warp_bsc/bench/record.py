"""The JSON of measurements: runs as plain data, where they come from, and the file that has it."""

import contextlib
import datetime
import importlib.metadata
import io
import os
import platform
import shlex
import subprocess
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

from .._version import __version__
from ..detection.run.launch import count_cores
from .tables import count

COMMIT = "WARP_BSC_COMMIT"
"""Environment variable that names the commit of a copy of the project without git, as on another machine."""

LIBRARIES = ("warp-lang", "newton", "numpy", "usd-core", "trimesh", "ipctk", "mujoco", "pyuipc")
"""Distributions whose versions are recorded if they are installed."""

_LOAD = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
"""Processes that were running on average over the minute before this one measures anything."""
_ROOT = Path(__file__).resolve().parents[2]
_NO_CAUSE = ":!warp_bsc/bench/measurements"
"""Files whose change is no change of what is measured: results, which one measurement after another replaces."""
_OUTPUTS = ("--json", "--figure")
"""Options that name output files, which the recorded command omits with their files."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run of which there may be no measurement; other fields say which one it is."""

    measured: Any = None  # the measurement; None if there is none
    problem: str | None = None  # why there is no measurement; None if there is one


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Omits prints, which would be part of a JSON output (Style3D has some), and warnings: large strain is measured."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore", UserWarning)
        yield


def describe_run(command: Sequence[str], devices: Iterable[wp.Device] = ()) -> dict[str, Any]:
    """Returns where a measurement of this process comes from, as plain data for JSON.

    Args:
        command: The program and its arguments.
        devices: The Warp devices that are measured.

    Returns:
        ``command``: the command line, without output files; ``commit``: that of the checkout, and ``changed``: whether
        tracked files differ from it, both None where there is no checkout; in a copy without git, the commit that the
        environment names by :data:`COMMIT`, and that it is not changed; ``date``: now in UTC; ``cpu`` and ``cores``:
        the processor, and the number of cores that this process may use; ``load``: how many processes were running in
        the minute before this one began, None where the system does not say; ``gpus``: names of the devices that are
        GPUs; ``python`` and ``versions``: those of this package and of the installed :data:`LIBRARIES`.
    """
    commit, changed = _find_commit()
    return {
        "command": shlex.join(_without_outputs(command)),
        "commit": commit,
        "changed": changed,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": _name_cpu(),
        "cores": count_cores(),
        "load": _LOAD,
        "gpus": [device.name for device in devices if device.is_cuda],
        "python": platform.python_version(),
        "versions": {"warp-bsc": __version__} | {name: found for name in LIBRARIES if (found := version_of(name))},
    }


def with_record(found: dict[str, Any], command: Sequence[str], devices: Iterable[wp.Device] = ()) -> dict[str, Any]:
    """Returns a measurement with ``record``, where it comes from. Arguments: as of :func:`describe_run`."""
    return found | {"record": describe_run(command, devices)}


def name_place(found: dict[str, Any]) -> str:
    """Returns the device of the JSON of a measurement with its name, of the CPU the number of cores."""
    device = found["device"]
    return f"{device}, {count(found['threads'], 'core') if device == 'cpu' else found['device_name']}"


def version_of(name: str) -> str | None:
    """Returns the version of a distribution; None if it is not installed, or was built without metadata."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def shorten_path(path: str) -> str:
    """Returns a path below the checkout as one from its root, without the folders of this machine; others unchanged."""
    return str(Path(path).relative_to(_ROOT)) if Path(path).is_relative_to(_ROOT) else path


def _without_outputs(command: Sequence[str]) -> list[str]:
    """Returns a command without the options that name output files, the program without its folder."""
    program, *arguments = command
    is_script = program.endswith(".py")
    kept = ["python", shorten_path(str(Path(program).resolve()))] if is_script else [Path(program).name]
    skips = False
    for argument in arguments:
        if skips and not argument.startswith("-"):
            skips = False
            continue
        skips = argument in _OUTPUTS
        if not skips and not argument.startswith(tuple(f"{option}=" for option in _OUTPUTS)):
            kept.append(shorten_path(argument))
    return kept


def _find_commit() -> tuple[str | None, bool | None]:
    """Returns the commit of the checkout that this module is in, and whether tracked files differ from it."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(_ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        if Path(git("rev-parse", "--show-toplevel")).resolve() == _ROOT:  # not a checkout of something else around it
            status = git("status", "--porcelain", "--untracked-files=no", "--", ".", _NO_CAUSE)
            return git("rev-parse", "HEAD"), bool(status)
    named = os.environ.get(COMMIT)
    return (named, False) if named else (None, None)


def _name_cpu() -> str:
    """Returns the name of the processor, else of its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next((name for name in [*names, platform.processor()] if name), platform.machine())
