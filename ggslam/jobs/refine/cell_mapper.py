# SPDX-License-Identifier: Apache-2.0
"""Trains the Gaussians of one cell while those around it stay as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.mapping.cpu.losses import CpuLossResult
from ggslam.mapping.finished import StillMapper
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.types import RenderBuffers
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.cell_keys import CellKey, Grid

_TRAINED = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


@dataclass(frozen=True)
class CellView:
    """What pixels show, as to a box: something in it, something before it, or what is behind or beside it.

    Attributes:
        shown: in it, bool [H, W].
        hidden: something before it, or the image shows nothing, bool [H, W].
    """

    shown: np.ndarray
    hidden: np.ndarray


@dataclass(frozen=True)
class CellBox:
    """A box along the world's axes, metres; infinite along axes that the grid does not span.

    Attributes:
        low, high: corners, three numbers each; what lies at `high` is outside.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @staticmethod
    def of(grid: Grid, key: CellKey) -> CellBox:
        """Of a cell."""
        ends = [((k - 0.5) * grid.spacing, (k + 0.5) * grid.spacing) for k in key]
        ends = [end if spans else (-np.inf, np.inf) for end, spans in zip(ends, grid.spans.tolist(), strict=True)]
        (a, d), (b, e), (c, f) = ends
        return CellBox((a, b, c), (d, e, f))

    def grow(self, margin: float) -> CellBox:
        """The box with a margin on all sides, metres."""
        (a, b, c), (d, e, f) = self.low, self.high
        return CellBox((a - margin, b - margin, c - margin), (d + margin, e + margin, f + margin))

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which points [..., 3] lie in it, bool [...]."""
        return np.asarray(((points >= np.array(self.low)) & (points < np.array(self.high))).all(-1))

    def view(self, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray) -> CellView:
        """Where the measurements of a depth image [H, W] (metres, 0: none) lie as to the box."""
        height, width = depth.shape
        x, y = (np.arange(width) - camera.cx) / camera.fx, (np.arange(height) - camera.cy) / camera.fy
        rays = np.stack([*np.broadcast_arrays(x, y[:, None]), np.ones((height, width))], -1) @ T_world_camera[:3, :3].T
        eye = T_world_camera[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.sort([(np.array(corner) - eye) / rays for corner in (self.low, self.high)], axis=0)
        enters, leaves = np.nanmax(ends[0], -1), np.nanmin(ends[1], -1)
        measured, crosses = depth > 0, (enters < leaves) & (leaves > 0)
        hidden = measured & crosses & (depth < enters)
        return CellView(measured & self.holds(rays * depth[..., None] + eye), hidden)

    def clamp(self, points: torch.Tensor) -> None:
        """Brings points float32 [N, 3] that have left it back to its border, in place."""
        low, high = np.array(self.low, np.float32), np.array(self.high, np.float32)
        low = np.where(low < np.array(self.low), np.nextafter(low, np.float32(np.inf)), low)
        high = np.where(high >= np.array(self.high), np.nextafter(high, np.float32(-np.inf)), high)
        points.clamp_(torch.from_numpy(low), torch.from_numpy(high))


class CellMapper(StillMapper):
    """Trains the Gaussians of a cell among some of those around it, which stay as they are.

    What lies behind is not there to be rendered. It is taken to be as the keyframe measured it, so that Gaussians of
    the cell that reach before it are drawn to what they cover, or thinned: image' = image + (1 - alpha) measured, and
    so depth. Where something nearer hides the cell, nothing counts.

    Args:
        gaussians: the map; its first `own` rows are trained.
        own: their number.
        box: which they do not leave.
        settings: of the run that it is from.
        context: threads.
        keyframes: numbered from 0.
        views: what the pixels of each show.
        fits_view_colors: whether colours that depend on the view stay as they were fitted, and are not trained.
    """

    def __init__(
        self, gaussians: GaussianMap, own: int, box: CellBox, settings: MapperSettings, context: NativeContext,
        keyframes: list[Keyframe], views: Sequence[CellView], fits_view_colors: bool = False,
    ) -> None:  # fmt: skip
        counted = [~view.hidden for view in views]
        super().__init__(gaussians, settings, context, keyframes, counted, fits_view_colors)
        self._own, self._box, self._views = own, box, views
        self._others = {name: getattr(gaussians, name)[own:].clone() for name in _TRAINED}
        self._own_psnr = float("nan")

    @property
    def last_psnr(self) -> float:
        """Of the pixels that show the cell."""
        return self._own_psnr

    def _psnr_of(self, keyframe: Keyframe) -> float:
        super()._psnr_of(keyframe)
        return self._own_psnr

    def iterate(self, keyframe: Keyframe, rate_factor: float = 1.0, settles: bool = False) -> None:
        """One step; see `Mapper.iterate`."""
        super().iterate(keyframe, rate_factor, settles)
        for name, values in self._others.items():
            getattr(self.map, name)[self._own :] = values
        self._box.clamp(self.map.means[: self._own])

    def _fit_view_colors(self) -> None:
        """Nothing: views show what is behind the cell, too."""

    def _evaluate_loss(self, keyframe: Keyframe, view: RenderBuffers, grid: PixelGrid = ALL_PIXELS) -> CpuLossResult:
        shown = torch.from_numpy(self._views[keyframe.index].shown)
        gain, offset = torch.from_numpy(keyframe.exposure.astype(np.float32)).T[:, :, None, None]
        measured = torch.tensor(keyframe.color).permute(2, 0, 1) / 255.0
        self._own_psnr = _psnr((view.image * gain + offset)[:, shown], measured[:, shown])
        behind = (~shown).float()
        color = (measured - offset) / gain * behind
        depth = torch.from_numpy(keyframe.depth_m()) * behind
        rest = 1 - view.alpha
        whole = RenderBuffers(view.image + rest * color, view.depth + rest * depth, view.alpha + rest * behind)
        loss = super()._evaluate_loss(keyframe, whole)
        loss.d_alpha.mul_(1 - behind).sub_((loss.d_image * color).sum(0)).sub_(loss.d_depth * depth)
        return loss


def _psnr(image: torch.Tensor, measured: torch.Tensor) -> float:
    """Of pixels [3, n], dB."""
    return float(-10 * torch.log10(((image.clamp(0, 1) - measured) ** 2).mean().clamp_min(1e-10)))
