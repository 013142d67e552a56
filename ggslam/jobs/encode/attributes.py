# SPDX-License-Identifier: Apache-2.0
"""Codes the attributes of a cloud beside its positions and restores them: colours, reflectance, ids."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from ggslam.coding import AttributeSettings, PointCloud
from ggslam.errors import FormatError
from ggslam.formats.point_cloud import ColoredCloud
from ggslam.formats.positions import left_out_words

_MOST_IDS: Final = 1 << 16
"""Ids are coded in 16 bits."""
_LEVELS: Final = (1 << 16) - 1
"""The highest value of an attribute of 16 bits."""


@dataclass
class CodedAttributes:
    """Attributes of a cloud for the encoder.

    Attributes:
        values: by name. Ids come first: a decoder that has room for one number a point keeps the last, the reflectance.
        settings: of those that need their own.
        metadata: what the stream has to tell beside.
        notes: what was left out and why.
    """

    values: dict[str, np.ndarray] = field(default_factory=dict)
    settings: dict[str, AttributeSettings] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=lambda: {"preset": "pointcloud"})
    notes: list[str] = field(default_factory=list)


def attributes_to_code(cloud: ColoredCloud, ids: bool) -> CodedAttributes:
    """Colours, reflectance and, if `ids`, whole numbers of a cloud."""
    coded = CodedAttributes()
    if cloud.colors is None:
        coded.notes.append("the cloud has no colours")
    else:
        coded.values["color"] = cloud.colors
    if ids:
        _add_ids(cloud, coded)
    if cloud.reflectance is not None:
        _add_reflectance(cloud.reflectance_name, cloud.reflectance, coded)
    _note_what_is_left_out(cloud, coded.notes)
    return coded


def _add_ids(cloud: ColoredCloud, coded: CodedAttributes) -> None:
    offsets: dict[str, int] = {}
    for name, values in cloud.labels.items():
        low, high = int(values.min()), int(values.max())
        offset = 0 if low >= 0 and high < _MOST_IDS else low
        if high - offset >= _MOST_IDS:
            coded.notes.append(f"left out '{name}': it reaches from {low} to {high}, more than 16 bits")
            continue
        offsets[name] = offset
        coded.values[name] = (values.astype(np.int64) - offset).astype(np.uint16)
        coded.settings[name] = AttributeSettings(lossless=True)
    if any(offsets.values()):
        coded.metadata["label_offsets"] = offsets


def _add_reflectance(name: str, values: np.ndarray, coded: CodedAttributes) -> None:
    """Whole numbers as they are, in 8 to 16 bits; wider ones rounded to multiples, which the stream's attribute scale
    undoes; other numbers in 16 bits between the lowest and the highest."""
    whole = bool((values == np.rint(values)).all()) and float(np.abs(values).max()) < 1 << 30
    low, high = float(values.min()), float(values.max())
    if whole:
        offset = 0 if low >= 0 and high < _MOST_IDS else int(low)
        scale = max(1, -(-(int(high) - offset) // _LEVELS))
        bits = max(8, min(16, ((int(high) - offset) // scale).bit_length()))
        coded.values[name] = values.astype(np.int64)
        coded.settings[name] = AttributeSettings(bit_depth=bits, offset=offset, scale=scale)
    else:
        step = (high - low) / _LEVELS or 1.0
        coded.values[name] = np.rint((values.astype(np.float64) - low) / step).astype(np.uint16)
        coded.settings[name] = AttributeSettings(bit_depth=16)
        coded.metadata["scales"] = {name: [low, step]}


def _note_what_is_left_out(cloud: ColoredCloud, notes: list[str]) -> None:
    if cloud.left_out:
        names = cloud.left_out if len(cloud.left_out) < 6 else (*cloud.left_out[:4], "...", cloud.left_out[-1])
        notes.append(f"left out {', '.join(names)}: neither position nor colour nor reflectance nor whole numbers")
        if {"opacity", "scale_0", "rot_0"} <= set(cloud.left_out):
            notes.append("these are Gaussians: `preset` splat codes them whole")
    if cloud.nowhere:
        notes.append(left_out_words(cloud.nowhere, cloud.nowhere + len(cloud)))


def restored_attributes(cloud: PointCloud) -> dict[str, np.ndarray]:
    """The attributes of a decoded cloud as they are written.

    Raises:
        FormatError: what the stream says of their offsets and scales is damaged.
    """
    offsets, scales = (_table(cloud, name) for name in ("label_offsets", "scales"))
    out: dict[str, np.ndarray] = {}
    for name, values in cloud.attributes.items():
        offset = offsets.get(name, 0)
        if not isinstance(offset, int) or abs(offset) >= 1 << 40:
            raise FormatError(f"the metadata's offset of '{name}' is damaged")
        if name in scales:
            low, step = _scale(name, scales[name])
            values = (low + step * values).astype(np.float32)
        elif offset:
            values = values.astype(np.int64) + offset
        elif name in cloud.ids:
            values = values.astype(np.int32)
        out[name] = values
    return out


def _table(cloud: PointCloud, name: str) -> dict[str, Any]:
    table = cloud.metadata.get(name, {})
    if not isinstance(table, dict):
        raise FormatError(f"the metadata's {name} are damaged")
    return table


def _scale(name: str, scale: Any) -> tuple[float, float]:
    try:
        low, step = (float(value) for value in scale)
    except (TypeError, ValueError, OverflowError):
        low = step = np.nan
    if not (abs(low) < 1e30 and abs(step) < 1e30):
        raise FormatError(f"the metadata's scale of '{name}' is damaged")
    return low, step
