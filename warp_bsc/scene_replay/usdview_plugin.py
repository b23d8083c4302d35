"""A plugin of usdview: a menu that checks the stage between two time samples, and shows one collision after the other.

usdview finds it if the environment variable ``PXR_PLUGINPATH_NAME`` names the folder ``plugin`` beside this module, and
its Python finds warp-bsc. What it finds is what ``warp-bsc replay`` finds in the stage as it is in usdview, with edits
that are not saved.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pxr import Gf, Tf, Usd
from pxr.Usdviewq.plugin import PluginContainer

from ..usd.read.triage import select_by_triage
from ..usd.scene import Scene
from .checking import Checks, IntervalChecker
from .results import IntervalResult
from .scene_contacts import SceneContacts
from .scene_pairs import FACE

_MARGIN = 3.0  # a view of a hit is so many times as wide as its elements


class Hit(NamedTuple):
    """A collision of a checked interval.

    Attributes:
        text: The collision in words.
        time: Its time code.
        prims: Paths of the two prims.
        box: Corners of the bounding box of the two elements at that time, in world space, shape [2, 3].
    """

    text: str
    time: float
    prims: tuple[str, str]
    box: np.ndarray


class Hits:
    """The collisions of the interval that was checked last, in the order of time, and the one that is shown.

    Its methods are commands of usdview, which pass its ``UsdviewApi``. They report in its status bar, errors as well.
    """

    def __init__(self):
        self._checker: IntervalChecker | None = None
        self._triage = ""  # the triage file that was read
        self._index = -1  # of the interval
        self._contacts: SceneContacts | None = None
        self._order = np.zeros(0, dtype=np.int64)  # rows of the contacts by time
        self._shown = -1  # number in this order

    def check_interval(self, api: Any) -> None:
        """Checks the interval between two time samples that contains the current frame."""
        scene = self._scene(api)
        self._index = self._interval_at(scene, api.frame)
        self._shown = -1
        result = self._check(self._index)
        api.PrintStatus(_describe(result, self._triage))

    def show_next(self, api: Any) -> None:
        """Shows the next collision: goes to its time, selects both prims and frames it.

        After the last one of an interval, the next intervals are checked until there is one; before the first, the
        interval that contains the current frame.
        """
        scene = self._scene(api)
        if self._index < 0:
            self._index, self._shown = self._interval_at(scene, api.frame), -1
            self._check(self._index)
        self._shown += 1
        while self._shown == len(self._order):
            if self._index + 1 == len(scene):
                api.PrintStatus(f"warp-bsc: no more collisions up to the last time, {scene.times[-1]:g}.")
                self._shown -= 1
                return
            self._index, self._shown = self._index + 1, 0
            api.PrintStatus(f"warp-bsc: checking from {scene.times[self._index]:g} to {scene.times[self._index + 1]:g}")
            api.qMainWindow.repaint()  # as no event is processed meanwhile
            self._check(self._index)
        hit = self._current(api)
        api.dataModel.currentFrame = Usd.TimeCode(hit.time)
        self.select_prims(api)
        self.frame(api)
        start, end = scene.times[self._index : self._index + 2]
        api.PrintStatus(f"warp-bsc: {self._shown + 1} of {len(self._order):,} from {start:g} to {end:g}: {hit.text}")

    def select_prims(self, api: Any) -> None:
        """Selects the two prims of the collision that is shown."""
        hit = self._current(api)
        selection = api.dataModel.selection
        with selection.batchPrimChanges:  # else the root of the stage is selected in between, and stays so
            selection.clearPrims()
            for path in dict.fromkeys(hit.prims):
                selection.addPrim(api.stage.GetPrimAtPath(path))

    def frame(self, api: Any) -> None:
        """Turns the free camera to the collision that is shown."""
        hit = self._current(api)
        settings = api.dataModel.viewSettings
        if settings.freeCamera is None:
            raise ValueError("no view to frame the collision in")
        settings.cameraPrim = None  # the free camera
        middle, size = hit.box.mean(axis=0), _MARGIN * max(float(np.ptp(hit.box, axis=0).max()), 1e-6)
        box = Gf.Range3d(Gf.Vec3d(*(middle - size / 2)), Gf.Vec3d(*(middle + size / 2)))
        settings.freeCamera.frameSelection(Gf.BBox3d(box), 1.1)
        api.UpdateViewport()

    def _scene(self, api: Any) -> Scene:
        """Returns the scene of usdview's stage; a new one if the stage is another one or has changed."""
        if self._checker:
            try:
                self._checker.scene.files.check()
                if self._checker.scene.stage is api.stage:
                    return self._checker.scene
            except ValueError:  # it has changed
                pass
        self._checker, self._index, self._contacts, self._shown = None, -1, None, -1
        api.PrintStatus("warp-bsc: reading the stage")
        api.qMainWindow.repaint()
        self._triage, selection = select_by_triage(api.stage)
        scene = Scene(api.stage, selection=selection)
        checks = Checks(scene.selection, "exact", None, intersections=True, clearance=None, validate=0)
        self._checker = IntervalChecker(scene, checks)
        return scene

    def _interval_at(self, scene: Scene, frame: Usd.TimeCode) -> int:
        """Returns the number of the interval that contains a frame, or of the nearest one."""
        time = scene.times[0] if frame.IsDefault() else frame.GetValue()
        return int(np.clip(np.searchsorted(scene.times, time, side="right") - 1, 0, len(scene) - 1))

    def _check(self, index: int) -> IntervalResult:
        assert self._checker
        (result,) = self._checker.check(index, index + 1)
        self._contacts = result.contacts
        self._order = np.argsort(result.contacts.toi, kind="stable")
        return result

    def _current(self, api: Any) -> Hit:
        self._scene(api)  # forgets hits of a stage that has changed
        if self._contacts is None or self._shown < 0:
            raise ValueError("no collision is shown: choose Next Hit")
        return _to_hit(self._contacts, int(self._order[self._shown]))


class HitsContainer(PluginContainer):
    """What usdview makes when it starts: the commands, and the menu of them."""

    def registerPlugins(self, plugRegistry: Any, plugCtx: Any) -> None:
        """Registers the commands."""
        hits = Hits()
        commands: tuple[tuple[str, str, Callable[[Any], None], str | None], ...] = (
            ("check", "Check This Interval", hits.check_interval, None),
            ("next", "Next Hit", hits.show_next, "Ctrl+Alt+N"),
            ("select", "Select Both Prims", hits.select_prims, None),
            ("frame", "Frame Hit", hits.frame, None),
        )
        self._commands = [
            (plugRegistry.registerCommandPlugin(f"warp_bsc.{name}", label, _reporting(run), run.__doc__), shortcut)
            for name, label, run, shortcut in commands
        ]

    def configureView(self, plugRegistry: Any, plugUIBuilder: Any) -> None:
        """Adds the menu."""
        menu = plugUIBuilder.findOrCreateMenu("warp-bsc")
        for command, shortcut in self._commands:
            menu.addItem(command, shortcut)


def _reporting(run: Callable[[Any], None]) -> Callable[[Any], None]:
    """Returns a command that reports errors in usdview's status bar."""

    def command(api: Any) -> None:
        try:
            run(api)
        except (OSError, ValueError) as error:
            api.PrintStatus(f"warp-bsc: {error}")

    return command


def _describe(result: IntervalResult, triage: str) -> str:
    """Returns what an interval contains, and what a triage file excludes, in words."""
    summary, text = result.summary, ""
    if summary.earliest:
        text = f", the first at {summary.earliest.time:g}"
    if summary.intersections:
        at, _ = summary.intersections
        text += f"; at {at.time:g} {at.crossings:,} edges through faces, {sum(at.inside.values()):,} parts inside"
    if summary.inverted:
        text += f"; {sum(found.number for found in summary.inverted):,} inverted tetrahedra"
    text += f"; {sum(summary.ignored.values()):,} more are meant by {triage}" if triage else ""
    return f"warp-bsc: from {summary.start:g} to {summary.end:g} {summary.hits:,} collisions{text}"


def _to_hit(contacts: SceneContacts, row: int) -> Hit:
    rows = slice(row, row + 1)
    ((first, second),), ((element, other),) = contacts.mesh_names(rows), contacts.element_names(rows)
    text = f"{first}, {element}, with {'its' if first == second else f'{second},'} {other} at {contacts.time[row]:g}"
    (paths,) = contacts.mesh_paths(rows)
    faces = contacts.faces[row][contacts.elements[row] == FACE]
    vertices = contacts.vertices[row]
    vertices = np.concatenate([vertices[vertices >= 0], contacts.segment.faces[faces].reshape(-1)])
    toi, ends = contacts.toi[row], (contacts.interval.x0, contacts.interval.x1)
    start, end = (x[vertices].astype(np.float64) for x in ends)
    points = (1.0 - toi) * start + toi * end
    return Hit(text, float(contacts.time[row]), paths, np.stack([points.min(axis=0), points.max(axis=0)]))


Tf.Type.Define(HitsContainer)
