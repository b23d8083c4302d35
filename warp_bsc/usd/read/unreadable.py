"""Errors in damaged USD data, and the parts of a scene that are left out for them. Imports pxr, which is slow."""

import contextlib
import os
from collections.abc import Iterator
from fnmatch import fnmatchcase

import numpy as np
from pxr import Tf, Usd, UsdShade, UsdUtils

_DAMAGE = (RuntimeError, TypeError, OverflowError, UnicodeError)  # Tf.ErrorException is a RuntimeError
_NO_GEOMETRY = frozenset(
    f".{extension}"
    for kinds in (
        "mtlx osl oso glsl glslfx hlsl mdl sl args",  # materials
        "png jpg jpeg tif tiff exr hdr tga bmp gif tx tex rat dds ktx ktx2 webp avif heic psd pic rgb svg",
        "ies ocio cube lut icc spi1d spi3d",  # lights and colours
        "wav mp3 m4a aac aif aiff ogg flac mp4 mov avi",
        "txt md json html pdf",
    )
    for extension in kinds.split()
)


class UnreadableError(ValueError):
    """An error that says which part of a scene cannot be read, and why.

    Attributes:
        mesh: Name of the mesh that cannot be read, None if the error is not about a mesh that has been found.
        time: The scene's time code at which it cannot be read, None if it cannot at any time.
    """

    def __init__(self, message: str, mesh: str | None = None, time: float | None = None):
        super().__init__(message)
        self.mesh = mesh
        self.time = time


class LeftOut:
    """The parts of a scene that are left out because they cannot be read.

    Attributes:
        is_strict: Whether leaving out a part is an error.
        reasons: The parts left out and why, a sentence each.
        notes: The parts that are missing and allowed to be, a sentence each.
    """

    def __init__(self, file: str | os.PathLike, is_strict: bool, allow_missing: tuple[str, ...] = ()):
        """Makes an empty record, whose sentences do not repeat the file's name; arguments are those of a scene."""
        self._prefix = f"{file}: "
        self._allow_missing = allow_missing
        self.is_strict = is_strict
        self.reasons: list[str] = []
        self.notes: list[str] = []

    def add(self, error: UnreadableError, since: str = "") -> None:
        """Leaves out the part that an error is about.

        Args:
            error: The error.
            since: The time from which on it is left out, in words; empty for the whole time.

        Raises:
            UnreadableError: The error given, if :attr:`is_strict`.
        """
        if self.is_strict:
            raise error
        self.reasons.append(since + str(error).removeprefix(self._prefix))

    def add_missing(self, error: UnreadableError, prim: Usd.Prim, asset: str = "") -> None:
        """Leaves out the content of a missing file or prim; only notes it if that is no geometry, or may be missing.

        Args:
            error: The error.
            prim: The prim that refers to it; it may be invalid.
            asset: The path of the file, empty if a prim is missing.

        Raises:
            UnreadableError: As of :meth:`add`.
        """
        names = [asset, str(prim.GetPath())] if prim else [asset]
        if _is_no_geometry(asset, prim) or any(_may_be_missing(name, self._allow_missing) for name in names if name):
            self.notes.append(f"missing: {str(error).removeprefix(self._prefix)}")
        else:
            self.add(error)


@contextlib.contextmanager
def reading(
    where: str,
    mesh: str | None = None,
    time: float | None = None,
    errors: tuple[type[Exception], ...] = (ValueError, *_DAMAGE),
) -> Iterator[None]:
    """Turns the errors of many types that damaged data raise in OpenUSD into one that names the file and the prim.

    Args:
        where: File and prim.
        mesh: Name of the mesh that is read.
        time: The time code.
        errors: Types of the errors that are turned into :class:`UnreadableError`.

    Raises:
        UnreadableError: If one of ``errors`` is raised in the block.
    """
    try:
        with np.errstate(all="ignore"):  # positions that are not finite are found where they are read
            yield
    except errors as error:
        message = str(error) if isinstance(error, UnreadableError) else f"{where}: {describe_error(error)}"
        raise UnreadableError(message, mesh, time) from error


@contextlib.contextmanager
def collecting(messages: list[str], file: str | os.PathLike) -> Iterator[None]:
    """Appends the messages that OpenUSD would print on standard error in the block, each once and in one line.

    Raises:
        UnreadableError: If the block raises an error of OpenUSD.
    """
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        with reading(str(file), errors=_DAMAGE):
            yield
    finally:
        texts = (f"message of OpenUSD: {_commentary(text)}" for text in delegate.TakeUncoalescedDiagnostics())
        messages += dict.fromkeys(text for text in texts if text not in messages)


def _is_no_geometry(asset: str, prim: Usd.Prim) -> bool:
    """Returns whether a missing file cannot hold geometry, by its name or because a prim of a material refers to it."""
    inner = asset.rstrip("]").rpartition("[")[2]  # of a package
    if os.path.splitext(inner)[1].lower() in _NO_GEOMETRY:
        return True
    while prim:
        if prim.IsA(UsdShade.NodeGraph) or prim.IsA(UsdShade.Shader):  # materials are node graphs
            return True
        prim = prim.GetParent()
    return False


def _may_be_missing(name: str, patterns: tuple[str, ...]) -> bool:
    """Returns whether a pattern matches a file's path or its end from a folder on, or a prim's path or one above it."""
    forms = (
        form for pattern in patterns for form in (pattern, f"{pattern.rstrip('/')}/*", f"*/{pattern.lstrip('./')}")
    )
    return any(fnmatchcase(name, form) for form in forms)


def describe_error(error: Exception) -> str:
    """Returns the message of an exception in one line."""
    if isinstance(error, Tf.ErrorException) and error.args:
        return _commentary(error.args[0])
    return in_one_line(str(error)) or type(error).__name__


def _commentary(diagnostic) -> str:
    """Returns the text of a diagnostic of OpenUSD in one line."""
    try:
        return in_one_line(diagnostic.commentary)
    except UnicodeError:  # it quotes bytes that are not UTF-8
        return "it contains bytes that are not UTF-8"


def in_one_line(text: str) -> str:
    """Returns a text with single blanks for its line breaks and other white space."""
    return " ".join(text.split())
