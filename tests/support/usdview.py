"""Stand-ins for the parts of usdview that plugins use: OpenUSD's packages for Python have no usdview.

Names and behaviour are those of ``pxr/usdImaging/usdviewq`` in OpenUSD 24.08: ``plugin.py``, ``usdviewApi.py``,
``rootDataModel.py``, ``selectionDataModel.py`` and ``freeCamera.py``.
"""

import contextlib
import sys
import types

from pxr import Plug, Sdf, Tf, Usd


def define_usdview():
    """Makes ``pxr.Usdviewq.plugin`` importable, with the class of which containers of plugins are derived."""
    if "pxr.Usdviewq.plugin" in sys.modules:
        return sys.modules["pxr.Usdviewq.plugin"]
    container = type("PluginContainer", (), {"__module__": "pxr.Usdviewq.plugin"})
    package, module = types.ModuleType("pxr.Usdviewq"), types.ModuleType("pxr.Usdviewq.plugin")
    package.__path__ = []
    module.PluginContainer, module.type = container, Tf.Type.Define(container)
    sys.modules |= {"pxr.Usdviewq": package, "pxr.Usdviewq.plugin": module}
    return module


def load_plugins(api):
    """Finds and loads all containers as usdview does, and returns the menus: callables by their labels, by menu."""
    containers = []
    for found in Plug.Registry.GetAllDerivedTypes(define_usdview().type):
        Plug.Registry().GetPluginForType(found).Load()
        containers.append(found.pythonClass())
    registry, menus = Registry(api), {}
    for container in containers:
        container.registerPlugins(registry, api)
    for container in containers:
        container.configureView(registry, types.SimpleNamespace(findOrCreateMenu=lambda name: Menu(menus, name)))
    return menus


class Registry:
    """Commands by their names, which must be unique."""

    def __init__(self, api):
        self._api, self._commands = api, {}

    def registerCommandPlugin(self, name, display_name, callback, description=""):
        assert name not in self._commands
        self._commands[name] = types.SimpleNamespace(
            displayName=display_name, description=description, run=lambda: callback(self._api)
        )
        return self._commands[name]


class Menu:
    def __init__(self, menus, name):
        self._items = menus.setdefault(name, {})

    def addItem(self, command, shortcut=None):
        self._items[command.displayName] = command.run


class Selection:
    """The selected prims. Without any, the root of the stage is selected, and stays so if a prim is added."""

    def __init__(self):
        self.paths, self._blocked = [Sdf.Path.absoluteRootPath], False

    @property
    @contextlib.contextmanager
    def batchPrimChanges(self):
        self._blocked = True
        yield
        self._blocked = False
        self._changed()

    def clearPrims(self):
        self.paths.clear()
        self._changed()

    def addPrim(self, prim):
        self.paths.append(prim.GetPath())
        self._changed()

    def _changed(self):
        if not self._blocked and not self.paths:
            self.paths.append(Sdf.Path.absoluteRootPath)


class DataModel:
    def __init__(self, stage, time):
        self.stage, self._frame, self.selection = stage, Usd.TimeCode(time), Selection()
        self.viewSettings = types.SimpleNamespace(freeCamera=FreeCamera(), cameraPrim=None)

    @property
    def currentFrame(self):
        return self._frame

    @currentFrame.setter
    def currentFrame(self, value):
        if not isinstance(value, Usd.TimeCode):
            raise ValueError(f"Expected Usd.TimeCode, got: {value}")
        self._frame = value


class FreeCamera:
    center, size = None, None

    def frameSelection(self, bounds, fit):
        self.center, self.size = bounds.ComputeCentroid(), max(*bounds.ComputeAlignedRange().GetSize()) * fit


class UsdviewApi:
    """What usdview passes to commands; ``said`` has what its status bar showed, ``drawn`` counts views."""

    def __init__(self, stage, time):
        self.dataModel, self.said, self.drawn = DataModel(stage, time), [], 0
        self.qMainWindow = types.SimpleNamespace(repaint=lambda: None)

    @property
    def stage(self):
        return self.dataModel.stage

    @property
    def frame(self):
        return self.dataModel.currentFrame

    def PrintStatus(self, text):
        self.said.append(text)

    def UpdateViewport(self):
        self.drawn += 1
