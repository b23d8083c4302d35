"""The files that a USD stage is read from: none may be written to, and none may change meanwhile."""

import os

__all__ = ["SceneFiles"]


class SceneFiles:
    """The files of all layers that a stage has opened so far, value clips included."""

    def __init__(self, stage):
        self._stage = stage
        self._stamps = {}
        self._find()

    def __contains__(self, path) -> bool:
        """Whether a path names one of them."""
        self._find()
        files = [path, *self._stamps] if os.path.exists(path) else []
        return any(os.path.exists(file) and os.path.samefile(path, file) for file in files[1:])

    def check(self):
        """See to it that all are what they were: crate files are read bit by bit, and two versions would be mixed.

        Raises:
            ValueError: If one has changed since it was first seen here.
        """
        self._find()
        for path, stamp in self._stamps.items():
            if _stamp(path) != stamp:
                raise ValueError(f"{path}: the file has changed since it was opened")

    def _find(self):
        from pxr import Ar  # noqa: PLC0415 (slow)

        for layer in self._stage.GetUsedLayers():
            path, _ = Ar.SplitPackageRelativePathOuter(layer.realPath)
            if path not in self._stamps and (stamp := _stamp(path)):
                self._stamps[path] = stamp


def _stamp(path):
    """What tells a version of a file from another, None if there is no such file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
