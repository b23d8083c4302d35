"""Finds the prims of a USD stage that are read as meshes. Imports pxr, which is slow: import this where it is used."""

import os
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from typing import Any

from pxr import Sdf, Usd, UsdGeom, UsdSkel

from .clips import has_clips, leave_out_clips
from .instancers import Instance, find_instances, is_ever_shown
from .shapes import is_shape
from .skinning import find_bindings
from .strands import is_strands
from .unreadable import LeftOut, UnreadableError, reading


class MeshPrim:
    """A prim that is read as a mesh, or one instance of it, before it is read.

    Attributes:
        prim: The prim.
        path: Its path.
        name: The path, with the number of the instance if a point instancer places it.
        instance: That instance, None if no point instancer places it.
        binding: Its binding, see :func:`~warp_bsc.usd.read.skinning.find_bindings`, None if nothing deforms it.
        instanced_prim: The same for all instances of a prim that one instancer places; empty without an instancer.
    """

    def __init__(self, prim: Usd.Prim, instance: Instance | None, binding: tuple | None):
        self.prim = prim
        self.path = str(prim.GetPath())
        self.name = instance.name_of(prim.GetPath()) if instance else self.path
        self.instance = instance
        self.binding = binding
        self.instanced_prim = (id(instance.instancer), self.path) if instance else ()

    @cached_property
    def purpose(self) -> str:
        """Purpose of the prim."""
        return str(UsdGeom.Imageable(self.prim).ComputePurpose())


class MeshPrimFinder:
    """Walks a stage, and the prototypes of point instancers once for each instance.

    Attributes:
        found: The prims that are read as meshes, in the order of the walk.
        other: Number of the other visible prims with a shape, by their type.
    """

    def __init__(self, file: str | os.PathLike, left_out: LeftOut):
        """Makes a finder for a stage of a file that has found nothing; broken skeletons and instancers are left out."""
        self._file, self._left_out = file, left_out
        self._bindings: dict[Sdf.Path, Any] = {}  # by path; of a root, the error or None
        self._clips: dict[Sdf.Path, bool] = {}  # whether the value clips of a prim are left out
        self._with_clips: list[Sdf.Path] = []  # prims with others
        self._prototypes: dict[Sdf.Path, list[tuple[Usd.Prim, str]]] = {}  # what was found in each, by its root
        self.found: list[MeshPrim] = []
        self.other: Counter[str] = Counter()

    def walk(self, prims: Any, instance: Instance | None = None) -> None:
        """Adds what is found among prims.

        Args:
            prims: Iterator over a ``Usd.PrimRange``.
            instance: The instance whose prototype the prims are, None in the scene itself.

        Raises:
            UnreadableError: If a skeleton or an instancer is broken and may not be left out.
        """
        found = self._sorted(prims, instance.root if instance else None)
        if instance:  # all instances of a prototype have the same prims, and there may be many
            path = instance.root.GetPath()
            found = self._prototypes[path] = self._prototypes.get(path) or list(found)
        for prim, other in found:
            if prim.IsA(UsdGeom.PointInstancer):
                for inner in find_instances(prim, instance, self._file, self._left_out):
                    self.walk(inner.prims(), inner)
            elif other:
                self.other[other] += 1
            else:
                self.found.append(MeshPrim(prim, instance, self._bindings.get(prim.GetPath())))

    def _sorted(self, prims, root) -> Iterator[tuple[Usd.Prim, str]]:
        """Yields the instancers and the prims with a shape, and what those are called that are not read as meshes."""
        for prim in prims:
            if has_clips(prim):
                # The prims of instances have other paths, and the clips of their prototype.
                source = prim.GetPrimInPrototype().GetPath() if prim.IsInstanceProxy() else prim.GetPath()
                if source not in self._clips:
                    self._clips[source] = leave_out_clips(prim, self._file, self._left_out)
                if not self._clips[source]:
                    self._with_clips.append(prim.GetPath())
            if prim.IsA(UsdGeom.PointInstancer):
                # Meshes below it are prototypes, which are not shown where they stand in the hierarchy.
                prims.PruneChildren()
                yield prim, ""
            elif prim.IsA(UsdSkel.Root):
                if not self._find_bindings(prim):
                    prims.PruneChildren()
            elif prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.TetMesh) or is_shape(prim) or is_strands(prim):
                yield prim, ""
            elif prim.IsA(UsdGeom.Gprim) and is_ever_shown(prim, root):
                yield prim, f"{prim.GetTypeName()}{' that are not linear' * prim.IsA(UsdGeom.BasisCurves)}"

    def has_clips(self, prim: Usd.Prim) -> bool:
        """Returns whether values of a prim may come from value clips that are not left out."""
        return any(prim.GetPath().HasPrefix(path) for path in self._with_clips)

    def _find_bindings(self, root) -> bool:
        """Returns whether the bindings below a ``SkelRoot`` can be read."""
        path = root.GetPath()
        if path not in self._bindings:
            self._bindings[path] = None
            try:
                with reading(f"{self._file}: {path}"):
                    self._bindings.update(find_bindings(root))
            except UnreadableError as error:
                self._left_out.add(error)
                self._bindings[path] = error
        return self._bindings[path] is None
