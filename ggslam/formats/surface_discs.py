# SPDX-License-Identifier: Apache-2.0
"""Gaussians as pieces of surface: the discs through their means along their two longest axes, and samples of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.system.tuning import Tuning


class DiscTuning(Tuning):
    """How Gaussians are sampled."""

    section_m = 0.5
    """Length along the map that is sampled together where memory is scarce, in metres."""
    spacing = 0.7
    """Distance of samples, in voxels; below 1/sqrt(2) a lattice turned in its plane meets every voxel of it."""
    max_steps = 40
    """Most samples from the centre outwards along an axis; larger Gaussians are sampled more thinly."""


@dataclass(frozen=True)
class SurfaceDiscs:
    """What of a map is sampled: rows [N] that are opaque enough, float64 opacity [N], means [N, 3], the two longest
    axes [N, 3, 2] with their scales [N, 2], and how far samples go along them [N, 2], metres."""

    minimum_opacity: float
    used: np.ndarray
    opacity: np.ndarray
    means: np.ndarray
    scales: np.ndarray
    axes: np.ndarray
    reach: np.ndarray

    @staticmethod
    def of(gaussians: GaussianMap, minimum_opacity: float) -> SurfaceDiscs:
        """Of a map."""
        opacity = gaussians.opacities.detach().cpu().numpy().astype(np.float64)
        used = np.nonzero(opacity >= minimum_opacity)[0]
        opacity = opacity[used]
        means = gaussians.means.detach().cpu().numpy().astype(np.float64)[used]
        scales = gaussians.scales.detach().cpu().numpy().astype(np.float64)[used]
        axes = quaternion_to_matrix(gaussians.quaternions.detach().cpu().numpy().astype(np.float64)[used])
        longest = np.argsort(-scales, axis=1, kind="stable")[:, :2]
        scales = np.take_along_axis(scales, longest, 1)
        axes = np.take_along_axis(axes, longest[:, None, :], 2)
        reach = scales * np.sqrt(2 * np.log(opacity / minimum_opacity))[:, None]
        return SurfaceDiscs(minimum_opacity, used, opacity, means, scales, axes, reach)

    def steps(self, voxel_size: float) -> tuple[np.ndarray, np.ndarray]:
        """Of each, how many samples go outwards along either axis, int64 [N, 2], and how far apart, metres [N, 2]."""
        step = np.maximum(DiscTuning.spacing * voxel_size, self.reach / DiscTuning.max_steps)
        return np.floor(self.reach / step).astype(np.int64), step

    def counts(self, voxel_size: float) -> np.ndarray:
        """Samples of each, visible or not, int64 [N]."""
        return np.prod(2 * self.steps(voxel_size)[0] + 1, axis=1)

    def cut(self, axis: int) -> list[SurfaceDiscs]:
        """Their sections along an axis of the world, in its direction; at least one, perhaps empty."""
        section = np.floor(self.means[:, axis] / DiscTuning.section_m)
        cut = []
        for chosen in (section == number for number in np.unique(section)):
            arrays = (self.used, self.opacity, self.means, self.scales, self.axes, self.reach)
            cut.append(SurfaceDiscs(self.minimum_opacity, *(array[chosen] for array in arrays)))
        return cut or [self]


def disc_samples(
    gaussians: GaussianMap, discs: SurfaceDiscs, voxel_size: float, chunk: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Chunks of (position [M, 3], weight [M], colour [M, 3] in [0, 1], object id [M]), float64 and int32."""
    used, opacity, means, scales, axes = discs.used, discs.opacity, discs.means, discs.scales, discs.axes
    color = gaussians.rgb.detach().cpu().numpy().astype(np.float64)[used].clip(0, 1)
    object_id = gaussians.object_id.cpu().numpy()[used]
    steps, step = discs.steps(voxel_size)
    per_gaussian = np.prod(2 * steps + 1, axis=1)
    bounds = np.concatenate([[0], np.cumsum(per_gaussian)])
    start = 0
    while start < len(used):
        stop = max(start + 1, int(np.searchsorted(bounds, bounds[start] + chunk, side="right")) - 1)
        owner = np.repeat(np.arange(start, stop), per_gaussian[start:stop])
        number = np.arange(bounds[start], bounds[stop]) - bounds[owner]
        offset = _lattice_point(number, steps[owner]) * step[owner]
        a, b = ((offset / scales[owner]) ** 2).T
        alpha = opacity[owner] * np.exp(-0.5 * (a + b))
        visible = alpha >= discs.minimum_opacity * (1 - 1e-9)
        owner, offset = owner[visible], offset[visible]
        first, second = np.moveaxis(axes[owner] * offset[:, None, :], 2, 0)
        position = means[owner] + (first + second)
        yield position, alpha[visible], color[owner], object_id[owner]
        start = stop


def _lattice_point(number: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Whole coordinates [N, 2], each in -steps..steps, of the number-th point of a rectangle."""
    return np.stack(np.divmod(number, 2 * steps[:, 1] + 1), 1) - steps
