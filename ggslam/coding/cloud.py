# SPDX-License-Identifier: Apache-2.0
"""Point clouds as they come out of the decoder, and streams with what is known about them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ggslam.coding.quantization import Quantization


@dataclass(frozen=True)
class PointCloud:
    """A decoded cloud: slices in the order of the stream, points of a slice in Morton order (x most significant).

    grid_points: int32 [N, 3], positions as coded.
    attributes: by name; uint8 (uint16 above 8 bits), [N, 3], or [N] for attributes of one component.
    metadata: what the encoder's caller put into the stream.
    ids: names of the attributes that were coded losslessly.
    """

    grid_points: np.ndarray
    attributes: dict[str, np.ndarray]
    quantization: Quantization
    metadata: dict[str, Any] = field(default_factory=dict)
    ids: frozenset[str] = frozenset()

    @property
    def points(self) -> np.ndarray:
        """Positions float64 [N, 3] in metres; of integers that nothing is said about, in their unit."""
        return self.quantization.restore(self.grid_points)

    @property
    def colors(self) -> np.ndarray | None:
        """uint8 [N, 3], the attribute `color`, as a cloud that `read_point_cloud` gives has it; None without."""
        return self.attributes.get("color")

    def __len__(self) -> int:
        return len(self.grid_points)


@dataclass(frozen=True)
class SliceReport:
    """One coded slice: sizes in bytes, unit headers included, and the time its thread took in seconds."""

    slice_id: int
    points: int
    geometry_bytes: int
    attribute_bytes: dict[str, int]
    user_data_bytes: int
    seconds: float


@dataclass(frozen=True)
class CodingReport:
    """Sizes of a coded cloud: `input_points` were given, `points` were coded (fewer if duplicates were merged)."""

    input_points: int
    points: int
    total_bytes: int
    slices: tuple[SliceReport, ...]
    seconds: float

    @property
    def geometry_bytes(self) -> int:
        return sum(s.geometry_bytes for s in self.slices)

    @property
    def attribute_bytes(self) -> dict[str, int]:
        """Bytes of each attribute, all slices together."""
        names = self.slices[0].attribute_bytes
        return {name: sum(s.attribute_bytes[name] for s in self.slices) for name in names}

    @property
    def bits_per_point(self) -> float:
        """Of the whole stream, per point that came in."""
        return 8 * self.total_bytes / self.input_points


@dataclass(frozen=True)
class EncodedCloud:
    """A stream; `reconstruction`, if requested, is the cloud that every decoder gets from it."""

    data: bytes
    report: CodingReport
    reconstruction: PointCloud | None = None
