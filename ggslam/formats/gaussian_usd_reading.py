# SPDX-License-Identifier: Apache-2.0
"""Reads Gaussians of OpenUSD, prims of the schema ParticleField3DGaussianSplat, by the package usd-core; `gaussian_usd`
writes them. Every such prim is taken, moved as those above it say, with the stage's up axis and metres per unit."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.gaussian_usd import USD_ENDINGS, usd_package
from ggslam.formats.splat_columns import UPRIGHT, SplatColumns
from ggslam.formats.splat_reader import read_whole
from ggslam.formats.splat_repair import columns_of, logarithms_of, logits_of
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import member, open_untrusted


class UsdLimitTuning(Tuning):
    """A limit on damaged files."""

    max_layers = 1000
    """Most layers of a stage."""


_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from x right, z up, y forward to x right, y down, z forward."""


def read_gaussian_usd(path: Path) -> tuple[SplatColumns, dict[int, str] | None]:
    """The Gaussians of a file, y down and z forward, and the names of objects by id (None: there are no ids).

    Raises:
        FormatError: it is damaged, or holds no Gaussians.
        MissingDependency: usd-core is not installed or too old.
    """
    open_untrusted(path).close()
    pxr = usd_package(path, "read")
    try:
        _check_layers(pxr, path)
        stage = pxr.Usd.Stage.Open(str(path))
        if any(prim.HasMetadata("clips") for prim in stage.TraverseAll()):
            raise ValueError("value clips, which name further files, are not read")
        prims = [p for p in stage.Traverse() if p.IsA(pxr.UsdVol.ParticleField3DGaussianSplat)]
        R = _Z_UP if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.z else UPRIGHT
        metres, parts, names = float(pxr.UsdGeom.GetStageMetersPerUnit(stage)), [], dict[int, str]()
        with_ids = False
        for prim in prims:
            columns, own = _columns(pxr, prim)
            _place(pxr, prim, columns)
            columns.move(R, np.zeros(3), metres)
            parts.append(columns)
            names |= {int(k): str(v) for k, v in (prim.GetCustomDataByKey("objects") or {}).items()}
            with_ids |= own
        if not parts:
            raise ValueError("it holds no prim ParticleField3DGaussianSplat")
        return SplatColumns.join(parts), names if with_ids else None
    except (ValueError, TypeError, RuntimeError, KeyError, pxr.Tf.ErrorException) as error:
        reason = str(error).strip().splitlines()
        raise FormatError(f"{path}: not an OpenUSD file that can be read: {reason[-1] if reason else error}") from None


def _check_layers(pxr: ModuleType, path: Path) -> None:
    """Looks at all layers that a stage would open before it does.

    Raises:
        FormatError: a layer lies outside the file's folder, is missing, or is no regular file.
        ValueError: there are too many.
    """
    waiting, seen = [str(path.resolve())], set[str]()
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        if len(seen) > UsdLimitTuning.max_layers:
            raise ValueError(f"it has more than {UsdLimitTuning.max_layers} layers")
        if not pxr.Ar.IsPackageRelativePath(name):  # a layer inside a .usdz is in a file that was looked at
            open_untrusted(member(path.parent, name)).close()
        layer = pxr.Sdf.Layer.FindOrOpen(name)
        if layer is None:
            raise ValueError(f"no layer of OpenUSD: {name}")
        waiting += [layer.ComputeAbsolutePath(other) for other in layer.GetCompositionAssetDependencies()]


def _columns(pxr: ModuleType, prim: Any) -> tuple[SplatColumns, bool]:
    """The Gaussians of a prim in its own axes, and whether they have object ids."""

    def of(*names: str) -> np.ndarray | None:
        for name in names:
            value = prim.GetAttribute(name).Get(pxr.Usd.TimeCode.EarliestTime()) if prim.HasAttribute(name) else None
            if value is not None and len(value):
                return np.array(value, np.float64)
        return None

    def require(*names: str) -> np.ndarray:
        value = of(*names)
        if value is None:
            raise ValueError(f"{prim.GetPath()} has no {names[0]}")
        return value

    means = require("positions", "positionsh")
    count = len(means)
    turns = [prim.GetAttribute(name).Get(pxr.Usd.TimeCode.EarliestTime()) for name in ("orientations", "orientationsh")]
    found = next((value for value in turns if value is not None and len(value)), None)
    quaternions = np.tile([1.0, 0, 0, 0], (count, 1))
    if found is not None:  # in memory the real part comes last
        quaternions = np.roll(np.array(found, np.float64).reshape(-1, 4), 1, axis=1)
    scales, opacities = require("scales", "scalesh"), require("opacities", "opacitiesh")
    radiance = of("radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsCoefficientsh")
    sh = np.zeros((count, 1, 3)) if radiance is None else radiance.reshape(count, -1, 3)
    coefficients = {k: k for k in (1, 4, 9, 16)}.get(sh.shape[1], 16 if sh.shape[1] > 16 else 0)
    ids = of("primvars:object_id")
    lengths = {len(scales), len(quaternions), len(opacities), count, *([] if ids is None else [len(ids)])}
    if not coefficients or len(lengths) != 1:
        raise ValueError(f"{prim.GetPath()}: its attributes are not all of the same Gaussians")
    columns = columns_of(
        means, logarithms_of(scales), quaternions, logits_of(opacities), sh[:, :coefficients], ids
    )
    return columns, ids is not None


def _place(pxr: ModuleType, prim: Any, columns: SplatColumns) -> None:
    """Moves Gaussians as the prims above them say; ValueError for what mirrors or stretches them."""
    matrix = pxr.UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(pxr.Usd.TimeCode.EarliestTime())
    columns.move_by(np.array(matrix, np.float64).T)


READER = read_whole(
    "OpenUSD",
    lambda path, head: path.suffix.lower() in USD_ENDINGS or head.startswith((b"#usda ", b"PXR-USDC")),
    read_gaussian_usd,
)
