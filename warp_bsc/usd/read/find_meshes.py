"""Reads the selected meshes, curves and points of a USD stage. Imports pxr, which is slow: import this where used."""

import os
from collections import Counter
from collections.abc import Mapping

from pxr import Usd, UsdSkel

from ..selection import Selection
from .mesh_prims import MeshPrimFinder
from .meshes import UsdMesh
from .unreadable import LeftOut, UnreadableError, reading


def find_meshes(
    stage: Usd.Stage, file: str | os.PathLike, selection: Selection, left_out: LeftOut
) -> tuple[list[UsdMesh], list[str]]:
    """Returns the selected meshes that are visible at some time, and sentences on the contents that are not checked.

    Args:
        stage: The stage.
        file: Its file, for messages.
        selection: Selects the meshes.
        left_out: Records broken meshes and instances.

    Raises:
        UnreadableError: If a mesh or a point instancer is broken and may not be left out.
        ValueError: If a pattern of the selection matches nothing.
    """
    finder = MeshPrimFinder(file, left_out)
    finder.walk(iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())))
    selection.check_patterns(finder.found)

    meshes, invisible, empty, unselected = [], [], [], Counter()
    warnings = selection.unmatched(finder.found)
    first_instances: dict[tuple, UsdMesh] = {}
    for found in finder.found:
        if not selection.includes(found):
            continue
        try:
            with reading(f"{file}: {found.name}"):
                if found.purpose not in selection.purposes:
                    unselected[found.purpose] += 1
                    continue
                if found.instance is None:
                    mesh = UsdMesh(found, file)
                elif first := first_instances.get(found.instanced_prim):
                    mesh = first.again(found)
                else:
                    mesh = first_instances[found.instanced_prim] = UsdMesh(found, file)
        except UnreadableError as error:
            left_out.add(error)
            continue
        if mesh.is_empty and finder.has_clips(found.prim):
            left_out.add(UnreadableError(f"{file}: {mesh.name}: its value clips have no faces, edges or points"))
        elif mesh.is_empty:
            empty.append(mesh.name)
        elif not any(mesh.states.values()):
            invisible.append(mesh.name)
        elif mesh.is_nowhere:  # checked here, for each instance
            left_out.add(UnreadableError(f"{file}: {mesh.name}: its transform is not finite"))
            continue
        else:
            meshes.append(mesh)
        if found.binding is None and UsdSkel.BindingAPI(found.prim).GetInheritedSkeleton():
            warnings.append(f"{mesh.path} is bound to a skeleton in a way that USD does not evaluate")
    if invisible:
        warnings.append(f"invisible prims are not checked: {len(invisible)}, the first is {invisible[0]}")
    if empty:
        warnings.append(
            f"prims without faces, edges or points hold nothing to check: {len(empty)}, the first is {empty[0]}"
        )
    for purpose, number in sorted(unselected.items()):
        warnings.append(f"purposes: meshes of purpose {purpose} are not checked: {number}")
    if finder.other:
        warnings.append(f"shapes without polygons are not checked: {_listed(finder.other)}")
    if strands := Counter(mesh.type_name for mesh in meshes if mesh.is_strands):
        how = "with half their widths as radii between the times; at the times, curves as lines, points not at all"
        warnings.append(f"curves and points are checked {how}: {_listed(strands)}")
    if varying := [mesh for mesh in meshes if mesh.may_thicken]:
        warnings.append(
            f"widths or scales that change count as the largest: {len(varying)}, the first {varying[0].name}"
        )
    if shapes := Counter(mesh.type_name for mesh in meshes if mesh.is_shape):
        warnings.append(f"shapes are checked as polyhedra, round ones as inscribed ones: {_listed(shapes)}")
    return meshes, warnings


def _listed(counts: Mapping[str, int]) -> str:
    """Returns numbers with the names that they count, such as "2 Cube, 1 Sphere"."""
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
