# SPDX-License-Identifier: Apache-2.0
"""Whole Gaussians in a G-PCC stream: every parameter of a map as an attribute of its positions.

Ranges and bit depths are those of MPEG's exploration of Gaussian splat coding with the geometry-based codec: positions
of 18 bits at most, everything else of 12 bits within fixed ranges, four rates r01 (smallest) to r04. Quantisers are our
own: chosen so that a further byte gains as much in pictures wherever it is spent (at the bytes of MPEG's, pictures are
3 to 10 dB closer to the map's). Positions are as fine as the Gaussians are small, and SH coefficients above degree 0,
which are small numbers, have a range of their own: the transform shrinks levels by up to a thousandth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ggslam.coding.cloud import PointCloud
from ggslam.coding.least_rotations import least_rotations
from ggslam.coding.outliers import OutlierTuning, Reach, reach_of
from ggslam.coding.settings import AttributeSettings, CodecSettings
from ggslam.errors import ConfigError, FormatError
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class SplatCodingTuning(Tuning):
    """How Gaussians are rounded."""

    position_bits = 18
    """Bits of a coordinate."""
    value_bits = 12
    """Bits of all other values."""
    sh_chroma_offset = 4
    """Quantiser offset of the colour differences of spherical harmonics."""
    max_rest = 4.0
    """Largest absolute value of the higher spherical harmonics that is told apart."""


_LEVELS = (1 << SplatCodingTuning.value_bits) - 1
RANGES = {"sh": (-4.0, 4.0), "opacity": (-7.0, 18.0), "scale": (-26.0, 4.0), "rotation": (-1.0, 1.0)}
"""Of SH coefficients, opacity logits, natural logarithms of scales, and components of unit quaternions."""
BIRTH = "birth"
"""Attribute: number of the keyframe that inserted a Gaussian, plus 1; 0: unknown."""


@dataclass(frozen=True)
class SplatRate:
    """Quantiser parameters: of the SH coefficients by degree, opacity, scales and rotations. `voxel`: edge of the
    positions' voxels, in parts of a typical Gaussian's size."""

    sh: tuple[int, int, int, int]
    opacity: int
    scale: int
    rotation: int
    voxel: float


RATES = {
    "r01": SplatRate((38, 32, 32, 32), 41, 36, 46, 1 / 8),
    "r02": SplatRate((32, 28, 28, 28), 36, 30, 40, 1 / 12),
    "r03": SplatRate((26, 24, 24, 24), 31, 24, 36, 1 / 24),
    "r04": SplatRate((20, 20, 20, 20), 26, 18, 30, 1 / 64),
}


LOSSES = {"r01": (0.4, 2.6), "r02": (0.1, 1.4), "r03": (0.1, 0.8), "r04": (0.05, 0.4)}
"""dB of held-out pictures that five maps lost (docs/compress.md), the least and the most."""


def loss_words(rate: str) -> str:
    """What a rate costs in pictures, for people."""
    least, most = LOSSES[rate]
    return f"rate {rate} costs {least:g} to {most:g} dB of held-out pictures (measured; most with SH degree 3)"


def rest_range(blocks: Iterable[GaussianMap]) -> float:
    """The range of a map's SH coefficients above degree 0: the power of two, 1/8 to 4, that none exceeds."""
    most = max((float(block.sh[:, 1:].detach().abs().amax()) for block in blocks if block.sh[:, 1:].numel()), default=4)
    return float(2.0 ** np.clip(np.ceil(np.log2(max(most, 1e-9))), -3, 2)) if np.isfinite(most) else 4.0


def splat_attributes(
    gaussians: GaussianMap, with_ids: bool | None = None, births: np.ndarray | None = None, rest: float = 4.0
) -> dict[str, np.ndarray]:
    """The parameters of a map as uint16 attributes of 12 bits, values outside their ranges clipped.

    "sh_0" ... "sh_15" [N, 3] by coefficient, "opacity" [N], "scale" [N, 3], "rotation" [N, 3] (x, y, z of the
    quaternion), "rotation_w" [N] (w; axes are named so that it is most, see `least_rotations`); "object_id" [N]
    if any is set; of parts of a map as `with_ids` says; "birth" [N], one more than `births` (-1: unknown), where these
    are given. `rest`: of `rest_range`.
    """
    quaternions = torch.nn.functional.normalize(gaussians.quaternions.detach(), dim=1).cpu().numpy()
    quaternions, scales = least_rotations(quaternions, gaussians.log_scales.detach().cpu().numpy())
    sh = gaussians.sh.detach().cpu().numpy()
    stretch = SplatCodingTuning.max_rest / rest
    out = {f"sh_{k}": _levels(sh[:, k] * (stretch if k else 1), "sh") for k in range(sh.shape[1])}
    out["opacity"] = _levels(gaussians.opacity_logits.detach().cpu().numpy(), "opacity")
    out["scale"] = _levels(scales, "scale")
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


def splat_settings(
    settings: CodecSettings, rate: str, attributes: Mapping[str, np.ndarray], rest: float = 4.0
) -> CodecSettings:
    """The settings with those of a rate: grid, bit depths and quantisers. Gaussians that share a voxel stay apart.

    Args:
        settings: slices, threads and tools are kept.
        rate: one of `RATES`.
        attributes: of `splat_attributes`.
        rest: as given there.

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
            wider = round(6 * np.log2(SplatCodingTuning.max_rest / rest)) if degree else 0  # steps of the same length
            chosen[name] = AttributeSettings(
                qps.sh[degree] + wider,
                SplatCodingTuning.sh_chroma_offset,
                SplatCodingTuning.value_bits,
                color_space="none",
                label="color",
            )
        else:
            qp = {"opacity": qps.opacity, "scale": qps.scale}.get(name, qps.rotation)
            chosen[name] = AttributeSettings(qp, 0, SplatCodingTuning.value_bits, color_space="none")
    metadata = {"preset": "splat"} | ({"rest_range": rest} if rest != SplatCodingTuning.max_rest else {})
    return replace(
        settings, geometry_bits=SplatCodingTuning.position_bits, duplicates="keep", attributes=chosen, metadata=metadata
    )


def means_of(gaussians: GaussianMap) -> np.ndarray:
    """Positions float64 [N, 3] as they are coded."""
    return gaussians.means.detach().cpu().numpy().astype(np.float64)


def splat_reach(blocks: Callable[[], Iterable[GaussianMap]], count: int, settings: CodecSettings, rate: str) -> Reach:
    """What of a map to code, and on which voxels: see `reach_of`. They are as fine as its Gaussians are small, by the
    middle one of their axes, but no finer than `SplatCodingTuning.position_bits` make them.

    Args:
        blocks: gives the parts of the map, as often as it is called.
        count: of all Gaussians.
        settings: of `splat_settings`; a voxel size named there stays.
        rate: one of `RATES`.
    """
    finest = finest_voxel(blocks(), count, rate) if settings.voxel_size is None else 0.0
    return reach_of((means_of(block) for block in blocks()), settings, count, finest)


def finest_voxel(blocks: Iterable[GaussianMap], count: int, rate: str) -> float:
    """Edge of the voxels that are fine enough for `count` Gaussians, metres: a part of the middle axis of most."""
    step = max(1, count // OutlierTuning.sample)
    sizes = [np.median(block.log_scales[::step].detach().cpu().numpy(), axis=1) for block in blocks if len(block)]
    size = float(np.exp(np.median(np.concatenate(sizes).astype(np.float64)))) if sizes else 0.0
    return RATES[rate].voxel * size if np.isfinite(size) else 0.0


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
    out.sh[rows, 1:] *= _told_range(cloud) / SplatCodingTuning.max_rest
    if BIRTH in values:
        out.birth_keyframe[rows] = torch.from_numpy(values[BIRTH].astype(np.int32) - 1)
    return out


def _told_range(cloud: PointCloud) -> float:
    told = cloud.metadata.get("rest_range", SplatCodingTuning.max_rest)
    if not isinstance(told, (int, float)) or not 0 < told <= SplatCodingTuning.max_rest:
        raise FormatError("the range of the SH coefficients is damaged")
    return float(told)


def _levels(values: np.ndarray, kind: str) -> np.ndarray:
    low, high = RANGES[kind]
    return np.rint((values.astype(np.float64).clip(low, high) - low) * (_LEVELS / (high - low))).astype(np.uint16)


def _values(levels: np.ndarray, kind: str) -> torch.Tensor:
    low, high = RANGES[kind]
    return torch.from_numpy((low + levels * ((high - low) / _LEVELS)).astype(np.float32))
