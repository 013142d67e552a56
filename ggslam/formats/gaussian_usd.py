# SPDX-License-Identifier: Apache-2.0
"""Gaussian maps as OpenUSD, prims of the schema ParticleField3DGaussianSplat (OpenUSD 26.03), by the package usd-core.

Positions, standard deviations (metres), quaternions, opacities from 0 to 1 and spherical harmonics as in 3DGS, all
float32. The stage takes y for upwards, so the map (y down, z forward at the first camera) is turned by 180 degrees
about x on the way, spherical harmonics included, as in glTF. `primvars:displayColor` is what renderers show that draw
points. Object ids are `primvars:object_id`, 0 for none; their names are custom data of the prim.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ggslam.errors import FormatError, MissingDependency, RunFolderError
from ggslam.formats.optional_package import package_for
from ggslam.formats.splat_columns import SplatColumns
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.scene.gaussian_map import SH_C0, GaussianMap
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.atomic import atomic_write, make_folder
from ggslam.system.hidden_folder import hidden_beside
from ggslam.system.tuning import Tuning

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
PRIM = "/map/gaussians"
COLOR_SPACE = "srgb_rec709_display"


class UsdTuning(Tuning):
    """How large the prim is said to be."""

    sigmas = 3.0
    """Standard deviations of each Gaussian that the extent of the prim includes."""


def usd_package(path: str | Path, verb: str = "write") -> ModuleType:
    """The module pxr of usd-core, to read or write a file; raises MissingDependency if it is not installed, or too old
    to know the schema."""
    pxr = package_for(path, "pxr", "usd", "usd-core", verb=verb)
    schemas = package_for(path, "pxr.UsdVol", "usd", "usd-core", verb=verb)
    if not hasattr(schemas, "ParticleField3DGaussianSplat"):
        raise MissingDependency(f"to {verb} {path} usd-core 26.3 or later is needed: `pip install -U 'ggslam[usd]'`")
    for name in ("Ar", "Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdUtils", "Vt"):
        package_for(path, f"pxr.{name}", "usd", "usd-core", verb=verb)
    return pxr


def write_gaussian_usd(path: str | Path, gaussians: GaussianMap, objects: Mapping[int, str] | None = None) -> None:
    """Writes a map as a stage of its own, whole or not at all.

    Args:
        path: the file to write; the ending says text (.usda), binary (.usd, .usdc) or a package (.usdz).
        gaussians: at least one.
        objects: names by object id, empty where an object has none; None: no object ids are written.

    Raises:
        FormatError: there is no Gaussian, or a number is not finite.
        MissingDependency: usd-core is not installed or too old.
        RunFolderError: the file cannot be written.
    """
    path, pxr = Path(path), usd_package(path)
    if not len(gaussians):
        raise FormatError(f"{path}: a splat in OpenUSD needs at least one Gaussian")
    columns = SplatColumns.of(path, gaussians)
    columns.turn_upright()
    if columns.log_scales.max() > np.log(np.finfo(np.float32).max):
        raise FormatError(f"{path}: a Gaussian is too large for float32")
    stage = _stage(pxr, columns, gaussians.sh_degree, objects)
    with atomic_write(path) as temporary:
        if path.suffix.lower() == ".usdz":
            _package(pxr, stage, path, temporary)
        elif not stage.GetRootLayer().Export(str(temporary)):
            raise RunFolderError(f"cannot write {path}: usd-core gave no reason")


def _package(pxr: ModuleType, stage: Any, path: Path, temporary: Path) -> None:
    """Writes a stage as a package with one binary layer."""
    with hidden_beside(path) as folder:
        make_folder(folder)
        layer = str(folder / f"{path.stem}.usdc")
        done = stage.GetRootLayer().Export(layer)
        if not done or not pxr.UsdUtils.CreateNewUsdzPackage(pxr.Sdf.AssetPath(layer), str(temporary)):
            raise RunFolderError(f"cannot write {path}: usd-core gave no reason")


def _stage(pxr: ModuleType, columns: SplatColumns, sh_degree: int, objects: Mapping[int, str] | None) -> Any:
    """A stage in memory with one splat."""
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = pxr.UsdGeom.Xform.Define(stage, PRIM.rpartition("/")[0])
    stage.SetDefaultPrim(root.GetPrim())
    splat = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    vectors, scales = pxr.Vt.Vec3fArray.FromNumpy, np.exp(columns.log_scales)
    opacity = 0.5 + 0.5 * np.tanh(0.5 * columns.logits.astype(np.float64))
    splat.CreatePositionsAttr(vectors(columns.means))
    splat.CreateScalesAttr(vectors(scales))
    xyzw = np.roll(columns.quaternions, -1, axis=1)  # as it is in memory; in files w comes first
    splat.CreateOrientationsAttr(pxr.Vt.QuatfArray.FromNumpy(xyzw))
    splat.CreateOpacitiesAttr(pxr.Vt.FloatArray.FromNumpy(opacity.astype(np.float32)))
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(sh_degree)
    radiance = splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(columns.sh.reshape(-1, 3)))
    radiance.SetMetadata("elementSize", columns.sh.shape[1])  # not of the schema; some readers ask for it
    radiance.SetMetadata("interpolation", pxr.UsdGeom.Tokens.vertex)
    splat.CreateProjectionModeHintAttr("perspective")
    splat.CreateSortingModeHintAttr("zDepth")
    pxr.Usd.ColorSpaceAPI.Apply(splat.GetPrim()).CreateColorSpaceNameAttr(COLOR_SPACE)
    splat.CreateExtentAttr(vectors(_extent(columns, scales)))
    shown = splat.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
    shown.Set(vectors((0.5 + SH_C0 * columns.sh[:, 0]).clip(0, 1)))
    if objects is not None:
        primvars = pxr.UsdGeom.PrimvarsAPI(splat)
        ids = primvars.CreatePrimvar("object_id", pxr.Sdf.ValueTypeNames.IntArray, pxr.UsdGeom.Tokens.vertex)
        ids.Set(pxr.Vt.IntArray.FromNumpy(columns.object_id))
        names = {str(number): name for number, name in objects.items()}
        splat.GetPrim().SetCustomDataByKey("objects", names)
    return stage


def _extent(columns: SplatColumns, scales: np.ndarray) -> np.ndarray:
    """Corners float32 [2, 3] of the box that the Gaussians reach to."""
    R = quaternion_to_matrix(columns.quaternions.astype(np.float64))
    reach = UsdTuning.sigmas * np.sqrt((R**2 @ (scales.astype(np.float64) ** 2)[:, :, None])[:, :, 0])
    return np.stack([(columns.means - reach).min(0), (columns.means + reach).max(0)]).astype(np.float32)


def _write(path: Path, splats: Splats) -> str:
    write_gaussian_usd(path, splats.whole(), splats.names)
    return splats.text(path, with_ids=True)


WRITER = Writer(
    "usd", USD_ENDINGS, Takes.GAUSSIANS, "the same as OpenUSD", _write, by_object=True, y_up=True, check=usd_package
)  # fmt: skip
