# SPDX-License-Identifier: Apache-2.0
"""Whole Gaussians in a G-PCC stream: every parameter of a map as an attribute of its positions.

Ranges, bit depths and quantisers are those of MPEG's exploration of Gaussian splat coding with the geometry-based
codec: positions of 18 bits, everything else of 12 bits within fixed ranges, four rates r01 (smallest) to r04.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ggslam.coding.cloud import PointCloud
from ggslam.coding.settings import AttributeSettings, CodecSettings
from ggslam.errors import ConfigError, FormatError
from ggslam.scene.gaussian_map import GaussianMap

POSITION_BITS = 18
VALUE_BITS = 12
_LEVELS = (1 << VALUE_BITS) - 1
RANGES = {"sh": (-4.0, 4.0), "opacity": (-7.0, 18.0), "scale": (-26.0, 4.0), "rotation": (-1.0, 1.0)}
"""Of SH coefficients, opacity logits, natural logarithms of scales, and components of unit quaternions."""
_SH_CHROMA_OFFSET = 4
BIRTH = "birth"
"""Attribute: number of the keyframe that inserted a Gaussian, plus 1; 0: unknown."""


@dataclass(frozen=True)
class SplatRate:
    """Quantiser parameters: of the SH coefficients by degree, opacity, scales and rotations."""

    sh: tuple[int, int, int, int]
    opacity: int
    scale: int
    rotation: int


RATES = {
    "r01": SplatRate((42, 54, 62, 65), 57, 42, 62),
    "r02": SplatRate((34, 46, 54, 57), 49, 34, 54),
    "r03": SplatRate((26, 38, 46, 49), 41, 26, 46),
    "r04": SplatRate((18, 30, 38, 41), 33, 18, 38),
}


def splat_attributes(
    gaussians: GaussianMap, with_ids: bool | None = None, births: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """The parameters of a map as uint16 attributes of 12 bits, values outside their ranges clipped.

    "sh_0" ... "sh_15" [N, 3] by coefficient, "opacity" [N], "scale" [N, 3], "rotation" [N, 3] (x, y, z of the
    quaternion, whose sign is chosen so that w is not negative), "rotation_w" [N]; "object_id" [N] if any is set; of
    parts of a map as `with_ids` says; "birth" [N], one more than `births` (-1: unknown), where these are given.
    """
    quaternions = torch.nn.functional.normalize(gaussians.quaternions.detach(), dim=1).cpu().numpy()
    quaternions = np.where(quaternions[:, :1] < 0, -quaternions, quaternions)
    sh = gaussians.sh.detach().cpu().numpy()
    out = {f"sh_{k}": _levels(sh[:, k], "sh") for k in range(sh.shape[1])}
    out["opacity"] = _levels(gaussians.opacity_logits.detach().cpu().numpy(), "opacity")
    out["scale"] = _levels(gaussians.log_scales.detach().cpu().numpy(), "scale")
    out["rotation"] = _levels(quaternions[:, 1:], "rotation")
    out["rotation_w"] = _levels(quaternions[:, 0], "rotation")
    object_id = gaussians.object_id.cpu().numpy()
    if object_id.any() if with_ids is None else with_ids:
        if object_id.min(initial=0) < 0 or object_id.max(initial=0) > 65535:
            raise ConfigError(f"object ids from {object_id.min()} to {object_id.max()}: expected 0 to 65535")
        out["object_id"] = object_id.astype(np.uint16)
    if births is not None:
        out[BIRTH] = (births.astype(np.int64) + 1).astype(np.uint16)
    return out


def splat_settings(settings: CodecSettings, rate: str, attributes: Mapping[str, np.ndarray]) -> CodecSettings:
    """The settings with those of a rate: grid, bit depths and quantisers. Gaussians that share a voxel stay apart.

    Args:
        settings: slices, threads and tools are kept.
        rate: one of `RATES`.
        attributes: of `splat_attributes`.

    Raises:
        ConfigError: an unknown rate.
    """
    if rate not in RATES:
        raise ConfigError(f"rate: expected one of {', '.join(RATES)}, found '{rate}'")
    qps = RATES[rate]
    chosen = {}
    for name in attributes:
        if name in ("object_id", BIRTH):
            chosen[name] = AttributeSettings(lossless=True)
        elif name.startswith("sh_"):
            degree = int(np.sqrt(int(name[3:])))
            chosen[name] = AttributeSettings(
                qps.sh[degree], _SH_CHROMA_OFFSET, VALUE_BITS, color_space="none", label="color"
            )
        else:
            qp = {"opacity": qps.opacity, "scale": qps.scale}.get(name, qps.rotation)
            chosen[name] = AttributeSettings(qp, 0, VALUE_BITS, color_space="none")
    return replace(
        settings, geometry_bits=POSITION_BITS, duplicates="keep", attributes=chosen, metadata={"preset": "splat"}
    )


def means_of(gaussians: GaussianMap) -> np.ndarray:
    """Positions float64 [N, 3] as they are coded."""
    return gaussians.means.detach().cpu().numpy().astype(np.float64)


def is_splat_cloud(cloud: PointCloud) -> bool:
    """Whether a decoded cloud is a Gaussian map."""
    return cloud.metadata.get("preset") == "splat"


def gaussians_of(cloud: PointCloud) -> GaussianMap:
    """The map that a decoded cloud holds, on the CPU, without room for optimizer moments.

    Raises:
        FormatError: the attributes of a map are not there.
    """
    values: dict[str, Any] = cloud.attributes
    names = [name for name in values if name.startswith("sh_")]
    degree = {1: 0, 4: 1, 9: 2, 16: 3}.get(len(names))
    coefficients = [f"sh_{k}" for k in range(len(names))]
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys([*coefficients, "scale", "rotation"], (len(cloud), 3))
    shapes |= {"opacity": (len(cloud),), "rotation_w": (len(cloud),)}
    wrong = [name for name, shape in shapes.items() if name not in values or values[name].shape != shape]
    if degree is None or wrong:
        raise FormatError(f"the stream holds no whole Gaussians: {', '.join(wrong) or 'sh_*'}: missing or misshapen")
    out = GaussianMap(degree, with_moments=False)
    quaternions = np.column_stack([values["rotation_w"], values["rotation"]])
    rows = out.insert(
        torch.from_numpy(cloud.points.astype(np.float32)),
        torch.nn.functional.normalize(_values(quaternions, "rotation"), dim=1), _values(values["scale"], "scale"),
        _values(values["opacity"], "opacity"), torch.zeros(len(cloud), 3),
        object_id=torch.from_numpy(values["object_id"].astype(np.int32)) if "object_id" in values else None,
    )  # fmt: skip
    out.sh[rows] = torch.stack([_values(values[name], "sh") for name in coefficients], 1)
    if BIRTH in values:
        out.birth_keyframe[rows] = torch.from_numpy(values[BIRTH].astype(np.int32) - 1)
    return out


def _levels(values: np.ndarray, kind: str) -> np.ndarray:
    low, high = RANGES[kind]
    return np.rint((values.astype(np.float64).clip(low, high) - low) * (_LEVELS / (high - low))).astype(np.uint16)


def _values(levels: np.ndarray, kind: str) -> torch.Tensor:
    low, high = RANGES[kind]
    return torch.from_numpy((low + levels * ((high - low) / _LEVELS)).astype(np.float32))
