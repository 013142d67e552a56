# SPDX-License-Identifier: Apache-2.0
"""Finds a few points far outside a cloud, which would cost the others their precision.

Without a voxel size the encoder divides a cloud's longest side into 2^bits voxels; a single point at 5 km would make
those of a room 5 m wide. So the side of the cloud's bulk counts, which hardly any point lies outside of. Points beyond
are coded on the same grid, as far as it can reach (`MAX_DEPTH`), and left out where it cannot.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from ggslam.coding.geometry_syntax import MAX_DEPTH
from ggslam.coding.settings import CodecSettings
from ggslam.system.plurals import plural, quantity
from ggslam.system.tuning import Tuning


class OutlierTuning(Tuning):
    """When points are far from all others."""

    sample = 1 << 18
    """Points that tell where most of them lie."""
    share = 1e-3
    """Share of the points that is passed over at each end of an axis."""
    min_points = 4
    """Fewest points that are passed over."""
    max_share = 0.04
    """Largest share of the points that is passed over."""
    far = 2.0
    """A cloud has outliers if it is so many times as long as its bulk."""
    fine_bits = 16
    """Bits of the bulk's side beyond which voxels are made larger before points are left out."""


@dataclass
class Reach:
    """What of a cloud is coded, and on which voxels.

    Attributes:
        settings: as asked for, with the voxel size that suits the bulk.
        box: float64 [2, 3], outside of which points are left out; None: none are.
        bulk: float64 [2, 3], what most points lie within; None: the cloud has no outliers.
        far, left_out, farthest: points that `keep` saw outside the bulk and its surroundings, those left out of them,
            and how far from the bulk's middle they lie along an axis.
    """

    settings: CodecSettings
    box: np.ndarray | None = None
    bulk: np.ndarray | None = None
    far: int = field(default=0, init=False)
    left_out: int = field(default=0, init=False)
    farthest: float = field(default=0.0, init=False)

    def keep(self, points: np.ndarray) -> np.ndarray | slice:
        """Index of the points [N, 3] that are coded; the others are counted."""
        if self.bulk is None:
            return slice(None)
        side = float(np.ptp(self.bulk, axis=0).max())
        far = ((points < self.bulk[0] - side) | (points > self.bulk[1] + side)).any(1)
        self.far += int(far.sum())
        if far.any():
            self.farthest = max(self.farthest, float(np.abs(points[far] - self.bulk.mean(0)).max()))
        if self.box is None:
            return slice(None)
        inside = ((points >= self.box[0]) & (points <= self.box[1])).all(1)
        self.left_out += int((~inside).sum())
        return np.asarray(inside)

    def notes(self, what: str) -> list[str]:
        """What the reader should know of the outliers among the `what` ("point")."""
        if self.bulk is None or not max(self.far, self.left_out):
            return []
        side, at = float(np.ptp(self.bulk, axis=0).max()), f"up to {self.farthest:.6g} away"
        notes = []
        if self.left_out:
            notes.append(
                f"left out {quantity(self.left_out, what)} far outside the others ({at}; the others span {side:.4g}): "
                "the grid does not reach so far"
            )
        if self.far > self.left_out:
            lie = plural(self.far - self.left_out, "lies", "lie")
            few = quantity(self.far - self.left_out, what)
            notes.append(f"{few} {lie} far outside the others ({at}); the voxels are those that suit the others")
        return notes


def reach_of(
    parts: Iterable[np.ndarray], settings: CodecSettings, count: int | None = None, finest: float = 0.0
) -> Reach:
    """What of a cloud to code, and on which voxels.

    Args:
        parts: its points [N, 3], some at a time.
        settings: as asked for. A box says what to code; then all stays as it is.
        count: of all points; None: of the only part.
        finest: voxels that the settings do not name are no smaller than this, metres.
    """
    if settings.box is not None:
        return Reach(settings)
    samples, corners = [], []
    for part in parts:
        if len(part):
            samples.append(part[:: max(1, (len(part) if count is None else count) // OutlierTuning.sample)])
            corners += [part.min(0), part.max(0)]
    if not samples:
        return Reach(settings)
    sample = np.concatenate(samples)
    if not np.isfinite(sample).all():  # the encoder says so
        return Reach(settings)
    return _choose(bulk_of(sample), np.ptp(np.stack(corners).astype(np.float64), axis=0).max(), settings,
                   np.issubdtype(sample.dtype, np.integer), finest)  # fmt: skip


def _choose(bulk: np.ndarray, whole: float, settings: CodecSettings, integers: bool, finest: float) -> Reach:
    """For a cloud whose longest side is `whole`."""
    side = float(np.ptp(bulk, axis=0).max())
    if side <= 0 or whole <= OutlierTuning.far * side:
        named = integers or settings.voxel_size is not None
        fine = finest > whole / ((1 << settings.geometry_bits) - 1)
        return Reach(replace(settings, voxel_size=finest) if fine and not named else settings)
    voxel, most = settings.voxel_size or (1.0 if integers else None), (1 << MAX_DEPTH) - 2
    if voxel is None:
        voxel, finer = (
            side / ((1 << settings.geometry_bits) - 1),
            max(0, settings.geometry_bits - OutlierTuning.fine_bits),
        )
        needed = whole * settings.geometry_scale / most
        voxel = max(needed if voxel < needed <= voxel * (1 << finer) else voxel, finest)
        settings = replace(settings, voxel_size=voxel)
    reach = most * voxel / settings.geometry_scale
    if whole <= reach * (1 + 1e-9):
        return Reach(settings, None, bulk)
    if side > reach:  # not even the bulk fits: the encoder says so
        return Reach(settings)
    middle = bulk.mean(0)
    return Reach(settings, np.stack([middle - reach / 2, middle + reach / 2]), bulk)


def bulk_of(sample: np.ndarray) -> np.ndarray:
    """Lowest and highest coordinates float64 [2, 3] of points [N, 3] but the outermost few along each axis."""
    count = len(sample)
    passed = min(max(OutlierTuning.min_points, int(OutlierTuning.share * count)), int(OutlierTuning.max_share * count))
    ordered = np.partition(sample, (passed, count - 1 - passed), axis=0)
    return np.stack([ordered[passed], ordered[count - 1 - passed]]).astype(np.float64)
