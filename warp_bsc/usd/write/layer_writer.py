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

SHAPES = {"float3[]": ("f4", 3), "point3f[]": ("f4", 3), "float[]": ("f4", 1), "int[]": ("i4", 1), "int2[]": ("i4", 2)}
"""Type and number of the components of a row, by the type of an attribute."""

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


@dataclass(frozen=True)
class LayerContent:
    """The content of a layer.

    Attributes:
        metadata: Metadata of the layer, by name.
        documentation: Text for people.
        custom: Name of a dictionary of values for programs, and these by name; lists are of texts.
        asset: The ``assetInfo`` of the root prim.
        sublayer: Path of its sublayer, relative to its own folder. It is not read.
        root: Path of the prim above all prims, of purpose guide.
        strings: Attributes of that prim, lists of texts, by name.
        scopes: The prims below it.
        prims: The prims below these.
        variant_set: Name of its variant set, whose first variant is selected.
        hidden: Names of the scopes and prims that each variant hides.
        samples: Yields the time samples of an attribute in order, given its prim and its name: time codes and arrays of
            :data:`SHAPES`.
    """

    metadata: dict[str, Any]
    documentation: str
    custom: tuple[str, dict[str, Any]]
    asset: dict[str, Any]
    sublayer: str
    root: str
    strings: dict[str, list[str]]
    scopes: list[LayerScope]
    prims: list[LayerPrim]
    variant_set: str
    hidden: dict[str, list[str]]
    samples: Callable[[str, str], Iterable[tuple[float, np.ndarray]]]


def write_layer(content: LayerContent, path: Path, file_format: str) -> None:
    """Writes a layer, with arguments and errors as of :func:`new_layer`."""
    with new_layer(path, file_format) as (layer, add):
        _define_prims(layer, content)
        _describe(layer, content)
        for prim, attribute, value_type in _attributes(content):
            for time, value in content.samples(prim, attribute):
                add(f"{content.root}/{prim}.{attribute}", time, _to_vt(value_type, value), value.nbytes)


@contextlib.contextmanager
def new_layer(path: Path, file_format: str) -> Iterator[tuple[Any, Callable[[str, float, Any, int], None]]]:
    """Makes a layer in USD's binary format, in which saved samples leave the memory, and saves it after the block.

    Args:
        path: A file that does not exist, with any name. After an error it does not exist.
        file_format: ``"usdc"``, or ``"usda"`` for a text that is made of the binary layer in the end.

    Yields:
        The layer, and a function that adds a sample to it, given the path of its attribute, its time code, its value
        and its size [bytes].

    Raises:
        OSError: If the file cannot be written.
    """
    from pxr import Sdf, Tf  # noqa: PLC0415 (slow)

    waiting = 0

    def add(attribute: str, time: float, value: Any, size: int) -> None:
        nonlocal waiting
        layer.SetTimeSample(attribute, time, value)
        waiting += size
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


def _describe(layer, content):
    """Sets the metadata of a layer."""
    from pxr import Vt  # noqa: PLC0415 (slow)

    name, values = content.custom
    values = {name: Vt.StringArray(value) if isinstance(value, list) else value for name, value in values.items()}
    layer.customLayerData = {name: values}
    layer.documentation = content.documentation
    for name, value in content.metadata.items():
        layer.pseudoRoot.SetInfo(name, value)
    layer.subLayerPaths.append(content.sublayer)


def _define_prims(layer, content):
    """Defines the prims of a layer, without time samples."""
    from pxr import Sdf, Usd, UsdGeom, UsdShade  # noqa: PLC0415 (slow)

    stage = Usd.Stage.Open(layer)
    root = UsdGeom.Scope.Define(stage, content.root)
    root.CreatePurposeAttr(UsdGeom.Tokens.guide)
    root.GetPrim().SetAssetInfo(content.asset)
    _define_strings(root.GetPrim(), content.strings)
    for scope in content.scopes:
        prim = UsdGeom.Scope.Define(stage, f"{content.root}/{scope.name}").GetPrim()
        prim.SetDisplayName(scope.label)
        _define_strings(prim, scope.strings)
    UsdGeom.Scope.Define(stage, f"{content.root}/Materials")
    for part in content.prims:
        prim = stage.DefinePrim(f"{content.root}/{part.name}", part.kind)
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
        UsdShade.MaterialBindingAPI.Apply(shown).Bind(_define_material(stage, content.root, part))
    _define_variants(root.GetPrim(), content.variant_set, content.hidden)


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
    from pxr import UsdGeom  # noqa: PLC0415 (slow)

    variants = root.GetVariantSets().AddVariantSet(name)
    for variant, prims in hidden.items():
        variants.AddVariant(variant)
        variants.SetVariantSelection(variant)
        with variants.GetVariantEditContext():
            for prim in prims:
                path = root.GetPath().AppendPath(prim)
                UsdGeom.Imageable(root.GetStage().OverridePrim(path)).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
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


def _attributes(content) -> Iterator[tuple[str, str, str]]:
    """Yields the attributes with time samples: names of their prims, their names, and their types."""
    return ((prim.name, name, value_type) for prim in content.prims for name, value_type in prim.attributes.items())


def _to_vt(value_type, array):
    """Returns an array as a value of USD."""
    from pxr import Vt  # noqa: PLC0415 (slow)

    types = {"float3[]": Vt.Vec3fArray, "point3f[]": Vt.Vec3fArray, "float[]": Vt.FloatArray}
    types |= {"int[]": Vt.IntArray, "int2[]": Vt.Vec2iArray}
    return types[value_type].FromNumpy(array)


def _as_os_error(error) -> Exception:
    """Returns the system's error, such as a full disk, in an error of OpenUSD; the error itself without one."""
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        if os.strerror(number) in str(error):
            return OSError(number, os.strerror(number))
    return error
