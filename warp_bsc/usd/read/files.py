"""Tracks the files of a USD stage, which must not be overwritten or change during a replay."""

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pxr import Usd


class SceneFiles:
    """The files of all layers that a USD stage has opened so far, value clips included; and whether it was changed."""

    def __init__(self, stage: "Usd.Stage"):
        """Records the versions of all files that a USD stage has opened so far, and listens to changes of the stage."""
        from pxr import Tf, Usd  # noqa: PLC0415 (slow)

        self._stage = stage
        self._stamps, changes = {}, []
        self._changes = changes  # not this object, which the listener would keep
        self._listener = Tf.Notice.Register(Usd.Notice.ObjectsChanged, lambda *_: changes.append(True), stage)
        self._find()

    def __contains__(self, path: str | os.PathLike) -> bool:
        """Returns whether a path names one of the files."""
        self._find()
        files = [path, *self._stamps] if os.path.exists(path) else []
        return any(os.path.exists(file) and os.path.samefile(path, file) for file in files[1:])

    def check(self) -> None:
        """Checks that nothing has changed, as what is read in parts would be of two versions.

        Raises:
            ValueError: If a file has changed since this object first saw it, or a program has changed the stage.
        """
        self.check_stage()
        self._find()
        for path, stamp in self._stamps.items():
            if file_stamp(path) != stamp:
                raise ValueError(f"{path}: the file has changed since it was opened")

    def check_stage(self) -> None:
        """Checks that no program has changed the stage, with errors as of :meth:`check`; takes no time."""
        if self._changes:
            raise ValueError(f"{self._stage.GetRootLayer().identifier}: the stage has changed since the scene was made")

    def versions(self) -> dict[str, tuple[int, int]]:
        """Returns the size [bytes] and the time of the last change [ns] of each file, by its path."""
        self._find()
        return {path: (size, changed) for path, (_, size, changed) in self._stamps.items()}

    def differing(self, versions: dict[str, tuple[int, int]]) -> str | None:
        """Returns the path of a file whose version differs from the given one, None if there is none."""
        own = self.versions()
        return next((path for path in own if versions.get(path, own[path]) != own[path]), None)

    def _find(self):
        from pxr import Ar  # noqa: PLC0415 (slow)

        for layer in self._stage.GetUsedLayers():
            path, _ = Ar.SplitPackageRelativePathOuter(layer.realPath)
            if path not in self._stamps and (stamp := file_stamp(path)):
                self._stamps[path] = stamp


def file_stamp(path: str | os.PathLike) -> tuple[int, int, int] | None:
    """Returns a value that differs between versions of a file, None if the file does not exist."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
