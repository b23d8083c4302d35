"""Writes a layer of light-emitting prims over a scene, without holding all time samples in memory."""

import contextlib
import errno
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

PrimKind = Literal["Mesh", "PointInstancer", "BasisCurves"]
"""The types of prims in a layer."""

SHAPES = {f"{name}[]": ("f4", 3) for name in ("float3", "point3f", "vector3f", "normal3f")}
SHAPES |= {"float[]": ("f4", 1), "int[]": ("i4", 1), "int2[]": ("i4", 2)}
"""Type and number of the components of a row, by the type of an attribute."""

AddSample = Callable[[str, str, float | None, np.ndarray], None]
"""Adds a sample to a layer, see :func:`new_layer`."""

_SAVED = 1 << 25  # bytes of samples that a layer holds in memory before it saves them


@dataclass(frozen=True)
class LayerScope:
    """A prim of a layer that only has other prims below it.

    Attributes:
        name: Its name.
        label: Its display name.
        strings: Its attributes, lists of texts, by name.
    """

    name: str
    label: str
    strings: dict[str, list[str]]


@dataclass(frozen=True)
class LayerPrim:
    """A prim of a layer.

    Attributes:
        name: Its name, after the name of its scope and a slash.
        kind: ``"Mesh"``, ``"PointInstancer"``, whose instances are octahedra, or ``"BasisCurves"``.
        attributes: Types of its attributes that have time samples, by their names.
        material: Name of its material, which prims of the same colour share.
        color: The colour of the light that it emits.
        width: Width of the octahedron or of the curves.
    """

    name: str
    kind: PrimKind
    attributes: dict[str, str]
    material: str
    color: tuple[float, float, float]
    width: float = 0.0


@contextlib.contextmanager
def new_layer(path: Path, file_format: str) -> Iterator[tuple[Any, AddSample]]:
    """Makes a layer in USD's binary format, in which saved samples leave the memory, and saves it after the block.

    Args:
        path: A file that does not exist, with any name. After an error it does not exist.
        file_format: ``"usdc"``, or ``"usda"`` for a text that is made of the binary layer in the end.

    Yields:
        The layer, and a function that adds a sample to it, given the path of its attribute and its type of
        :data:`SHAPES`, its time code, None for its default, and its value.

    Raises:
        OSError: If the file cannot be written.
    """
    from pxr import Sdf, Tf, Vt  # noqa: PLC0415 (slow)

    arrays = {("f4", 3): Vt.Vec3fArray, ("f4", 1): Vt.FloatArray, ("i4", 1): Vt.IntArray, ("i4", 2): Vt.Vec2iArray}
    waiting = 0

    def add(attribute: str, value_type: str, time: float | None, value: np.ndarray) -> None:
        nonlocal waiting
        shape = SHAPES[value_type]
        array = np.ascontiguousarray(value, shape[0])
        if time is None:
            layer.GetAttributeAtPath(attribute).default = arrays[shape].FromNumpy(array)
        else:
            layer.SetTimeSample(attribute, time, arrays[shape].FromNumpy(array))
        waiting += array.nbytes
        if waiting > _SAVED:
            layer.Save()
            waiting = 0

    text = path.with_suffix(".usda")
    try:
        layer = Sdf.Layer.New(Sdf.FileFormat.FindById("usdc"), str(path))
        yield layer, add
        layer.Save()
        if file_format == "usda":
            layer.Export(str(text))
            text.replace(path)
    except BaseException as error:
        path.unlink(missing_ok=True)
        text.unlink(missing_ok=True)
        if isinstance(error, Tf.ErrorException):
            raise _as_os_error(error) from error
        raise


def define_prims(
    layer: Any,
    root: str,
    asset: dict[str, Any],
    strings: dict[str, list[str]],
    scopes: Iterable[LayerScope],
    prims: Iterable[LayerPrim],
    variant_set: str,
    hidden: dict[str, list[str]],
) -> None:
    """Defines the prims of a layer, without time samples.

    Args:
        layer: The layer, without sublayers.
        root: Path of the prim above all prims, of purpose guide.
        asset: Its ``assetInfo``.
        strings: Its attributes, lists of texts, by name.
        scopes: The prims below it.
        prims: The prims below these.
        variant_set: Name of its variant set, whose first variant is selected.
        hidden: Names of the scopes and prims that each variant hides.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdShade  # noqa: PLC0415 (slow)

    stage = Usd.Stage.Open(layer)
    top = UsdGeom.Scope.Define(stage, root)
    top.CreatePurposeAttr(UsdGeom.Tokens.guide)
    top.GetPrim().SetAssetInfo(asset)
    _define_strings(top.GetPrim(), strings)
    for scope in scopes:
        prim = UsdGeom.Scope.Define(stage, f"{root}/{scope.name}").GetPrim()
        prim.SetDisplayName(scope.label)
        _define_strings(prim, scope.strings)
    UsdGeom.Scope.Define(stage, f"{root}/Materials")
    for part in prims:
        prim = stage.DefinePrim(f"{root}/{part.name}", part.kind)
        for attribute, type_name in part.attributes.items():
            value_type = Sdf.ValueTypeNames.Find(type_name)
            if attribute.startswith("primvars:"):
                interpolation = UsdGeom.Tokens.uniform if part.kind == "BasisCurves" else UsdGeom.Tokens.vertex
                UsdGeom.PrimvarsAPI(prim).CreatePrimvar(attribute, value_type, interpolation)
            else:
                prim.CreateAttribute(attribute, value_type, False)
        shown = prim
        if part.kind == "Mesh":
            UsdGeom.Mesh(prim).CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        elif part.kind == "BasisCurves":
            UsdGeom.BasisCurves(prim).CreateTypeAttr(UsdGeom.Tokens.linear)
            UsdGeom.BasisCurves(prim).CreateWidthsAttr([part.width])
            UsdGeom.BasisCurves(prim).SetWidthsInterpolation(UsdGeom.Tokens.constant)
        else:
            shown = _define_marker(stage, prim, part.width / 2)
        # The same colour for programs that show no materials.
        UsdGeom.Gprim(shown).CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([part.color])
        UsdShade.MaterialBindingAPI.Apply(shown).Bind(_define_material(stage, root, part))
    _define_variants(top.GetPrim(), variant_set, hidden)


def _define_strings(prim, strings):
    """Defines attributes of a prim that are lists of texts."""
    from pxr import Sdf  # noqa: PLC0415 (slow)

    for name, texts in strings.items():
        prim.CreateAttribute(name, Sdf.ValueTypeNames.StringArray).Set(texts)


def _define_material(stage, root, part):
    """Defines the material of a prim if it is not there, and returns it."""
    from pxr import Sdf, UsdShade  # noqa: PLC0415 (slow)

    material = UsdShade.Material.Define(stage, f"{root}/Materials/{part.material}")
    shader = UsdShade.Shader.Define(stage, f"{material.GetPath()}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set((0, 0, 0))
    shader.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(part.color)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def _define_variants(root, name, hidden):
    """Defines the variants of a prim, each of which hides some prims below it, and selects the first."""
    from pxr import Sdf, UsdGeom  # noqa: PLC0415 (slow)

    variants, layer = root.GetVariantSets().AddVariantSet(name), root.GetStage().GetRootLayer()
    with Sdf.ChangeBlock():  # one composition of the stage, not one for each prim of each variant
        for variant, prims in hidden.items():
            inside = root.GetPath().AppendVariantSelection(name, variant)
            Sdf.CreatePrimInLayer(layer, inside)
            for path in (inside.AppendPath(prim).AppendProperty("visibility") for prim in prims):
                Sdf.JustCreatePrimAttributeInLayer(layer, path, Sdf.ValueTypeNames.Token)
                layer.GetAttributeAtPath(path).default = UsdGeom.Tokens.invisible
    variants.SetVariantSelection(next(iter(hidden)))


def _define_marker(stage, instancer, radius):
    """Defines an octahedron that an instancer places, and returns its prim."""
    from pxr import UsdGeom  # noqa: PLC0415 (slow)

    marker = UsdGeom.Mesh.Define(stage, f"{instancer.GetPath()}/Marker")
    marker.CreatePointsAttr([tuple(point) for point in (radius * np.concatenate([np.eye(3), -np.eye(3)])).tolist()])
    marker.CreateExtentAttr([(-radius,) * 3, (radius,) * 3])
    marker.CreateFaceVertexCountsAttr([3] * 8)
    sides = [[(0, 1, 2), (3, 1, 2), (0, 4, 2), (0, 1, 5)], [(3, 4, 5), (0, 4, 5), (3, 1, 5), (3, 4, 2)]]
    marker.CreateFaceVertexIndicesAttr([corner for side in sides for face in side for corner in face])
    marker.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    UsdGeom.PointInstancer(instancer).CreatePrototypesRel().SetTargets([marker.GetPath()])
    return marker.GetPrim()


def _as_os_error(error) -> Exception:
    """Returns the system's error, such as a full disk, in an error of OpenUSD; the error itself without one."""
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        if os.strerror(number) in str(error):
            return OSError(number, os.strerror(number))
    return error
