"""The cameras of a USD stage at some times. Imports pxr, which is slow: import this where used."""

from dataclasses import dataclass, field

import numpy as np
from pxr import Usd, UsdGeom


@dataclass(frozen=True)
class StageCamera:
    """A camera at some times; arrays have one row if nothing of it changes, else a row for each time.

    Attributes:
        path: The prim's path.
        is_perspective: Whether it is a perspective camera; otherwise it is an orthographic one.
        axes: Its right, up and backward directions in world space, orthonormal, and its position, in the scene's unit
            of length, shape [n, 4, 3].
        window: What it sees: lowest and highest x, lowest and highest y, as tangents of angles, or for an orthographic
            camera in the scene's unit of length, shape [n, 4].
    """

    path: str
    is_perspective: bool
    axes: np.ndarray = field(repr=False)
    window: np.ndarray = field(repr=False)


def find_cameras(stage: Usd.Stage) -> list[UsdGeom.Camera]:
    """Returns the cameras of a stage, those of instances included, in the order of its prims."""
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return [UsdGeom.Camera(prim) for prim in prims if prim.IsA(UsdGeom.Camera)]


def read_camera(camera: UsdGeom.Camera, times: list[float]) -> StageCamera | None:
    """Returns a camera at some times; None if it looks nowhere at one of them, as its transform or lens is not valid.

    Args:
        camera: The camera.
        times: Time codes, at least one.
    """
    axes, windows = np.zeros((len(times), 4, 3)), np.zeros((len(times), 4))
    is_perspective = True
    for row, time in enumerate(times):
        lens = camera.GetCamera(time)
        is_perspective = lens.projection == lens.Perspective
        matrix = np.array(lens.transform)[:, :3]
        # Cameras see nothing of scales and shears: the direction of view and the one up count.
        backward = matrix[2]
        right = np.cross(matrix[1], backward)
        axes[row] = right, np.cross(backward, right), backward, matrix[3]
        with np.errstate(divide="ignore", invalid="ignore"):
            axes[row, :3] /= np.linalg.norm(axes[row, :3], axis=1)[:, None]
        window = lens.frustum.GetWindow()
        low, high = window.GetMin(), window.GetMax()
        windows[row] = low[0], high[0], low[1], high[1]
    if not (np.isfinite(axes).all() and np.isfinite(windows).all() and (windows[:, 1::2] > windows[:, ::2]).all()):
        return None
    if (axes == axes[0]).all() and (windows == windows[0]).all():
        axes, windows = axes[:1], windows[:1]
    return StageCamera(str(camera.GetPath()), is_perspective, axes, windows)
