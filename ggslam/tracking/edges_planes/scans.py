# SPDX-License-Identifier: Apache-2.0
"""Edges and planes of depth images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.tracking.edges_planes.extraction import LineScanner, ScanFeatures, ScanLines
from ggslam.tracking.edges_planes.segments import RangeSegments
from ggslam.tracking.edges_planes.settings import ExtractionSettings
from ggslam.tracking.points import check_depth
from ggslam.tracking.settings import DepthNoise


class ScanPatchTuning(Tuning):
    """Windows in depth images."""

    half_patch = 2
    """A patch has (2 `half_patch` + 1)^2 pixels."""


@dataclass(frozen=True)
class LineLayout:
    """Which rows and columns of an image are scanned, and which pixels of them. Rows come first; all lines have one
    length, and short ones end in missing points.

    Attributes:
        pitch: distance of the pixels of a line.
        row_step, column_step: distance of the rows, and of the columns; the first one is half of that from the border.
            0: no columns.
        rows, lines: numbers of rows, and of rows and columns.
        length: points of a line.
    """

    pitch: int
    row_step: int
    column_step: int
    rows: int
    lines: int
    length: int

    @classmethod
    def of(cls, camera: Camera, settings: ExtractionSettings) -> LineLayout:
        """For images of a camera."""
        pitch, scale = max(1, round(camera.width / 320)), camera.width / 320
        row = max(1, round(settings.row_step * scale))
        column = max(1, round(settings.column_step * scale)) if settings.column_step else 0
        rows, columns = len(range(row // 2, camera.height, row)), 0
        length = math.ceil(camera.width / pitch)
        if column:
            columns = len(range(column // 2, camera.width, column))
            length = max(length, math.ceil(camera.height / pitch))
        return cls(pitch, row, column, rows, rows + columns, length)

    def views(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Scanned rows and columns [L, C] of an image."""
        row, column = self.row_step, self.column_step
        rows = image[row // 2 :: row, :: self.pitch]
        return rows, image[:: self.pitch, column // 2 :: column].T if column else rows[:0]


class DepthImageFeatures:
    """Edges and planes of depth images of one camera.

    Rows give both, columns edges only. A plane's position and normal come from a patch of 25 pixels about it, to
    which a plane is fitted: in a pinhole image 1/z of a plane is linear in column and row.

    Args:
        camera: of the images.
        settings: limits.
        device: where the work is done.
    """

    def __init__(self, camera: Camera, settings: ExtractionSettings, device: torch.device | str = "cpu") -> None:
        self.camera, self.settings = camera, settings
        self._device = torch.device(device)
        layout = LineLayout.of(camera, settings)
        self._pitch = layout.pitch
        self._lines = _PixelLines(camera, settings, layout, self._device)
        self._depth = torch.zeros(camera.height, camera.width, device=self._device)
        half = ScanPatchTuning.half_patch
        offsets = torch.arange(-half, half + 1, device=self._device) * (settings.patch_step * self._pitch)
        dv, du = torch.meshgrid(offsets, offsets, indexing="ij")
        self._offsets = (dv * camera.width + du).reshape(-1)
        du, dv = du.reshape(-1).float(), dv.reshape(-1).float()
        ones = torch.ones_like(du)
        self._design = torch.stack([du, dv, ones], 1)
        self._solve = self._design / self._design.square().sum(0)  # the three columns are orthogonal
        self._margin = int(offsets[-1])
        self._segments = DepthSegments(camera, settings, self._pitch) if settings.segment_angle_deg else None

    @torch.inference_mode()
    def extract(self, depth: np.ndarray, noise: DepthNoise) -> ScanFeatures:
        """Features of a depth image.

        Args:
            depth: float32 [H, W], metres, 0 where unknown.
            noise: of the depth camera.

        Raises:
            ValueError: another size than the camera's.
        """
        check_depth(depth, self.camera)
        if self._segments is not None:
            depth = self._segments.without_small(depth, noise)
        image = self._depth.copy_(torch.tensor(np.ascontiguousarray(depth, np.float32)))
        edges, planes = self._lines.pick(image, noise)
        planes, normals, z = self._patches(planes, noise)
        edge_z = torch.take(image, edges)
        return ScanFeatures(
            planes, normals, self._disc(z), noise.constant + noise.square * z * z,
            self._rays(edges) * edge_z[:, None], noise.constant + noise.square * edge_z * edge_z,
        )  # fmt: skip

    def _disc(self, z: Tensor) -> Tensor:
        return z * disc_per_depth(self.camera, self.settings, self._pitch)

    def _rays(self, pixels: Tensor) -> Tensor:
        """Viewing rays with z = 1 of positions in the flat image, [n, 3]."""
        c = self.camera
        v = torch.div(pixels, c.width, rounding_mode="floor")
        u = pixels - v * c.width
        x, y = (u - c.cx) / c.fx, (v - c.cy) / c.fy
        return torch.stack([x, y, torch.ones_like(x)], 1).float()

    def _patches(self, pixels: Tensor, noise: DepthNoise) -> tuple[Tensor, Tensor, Tensor]:
        """Points [n, 3], normals [n, 3] and depths [n] of planes fitted about those pixels that lie on one."""
        c, margin = self.camera, self._margin
        v = torch.div(pixels, c.width, rounding_mode="floor")
        u = pixels - v * c.width
        inside = (u >= margin) & (u < c.width - margin) & (v >= margin) & (v < c.height - margin)
        pixels = torch.masked_select(pixels, inside)
        inverse_depth = 1.0 / torch.take(self._depth, pixels[:, None] + self._offsets)  # infinite where unknown
        fit = inverse_depth @ self._solve
        residual = (inverse_depth - fit @ self._design.T).square_().sum(1).mul_(1.0 / (len(self._offsets) - 3)).sqrt_()
        z = 1.0 / fit[:, 2]
        rays = self._rays(pixels)
        a, b = fit[:, 0] * c.fx, fit[:, 1] * c.fy
        plane = torch.stack([a, b, fit[:, 2] - a * rays[:, 0] - b * rays[:, 1]], 1)  # normal over its distance
        length = torch.linalg.vector_norm(plane, dim=1)
        normals = plane / -length[:, None]
        cosine = fit[:, 2] / (length * torch.linalg.vector_norm(rays, dim=1))
        s = self.settings
        limit = s.plane_sigmas * (noise.constant + noise.square * z * z) + s.roughness * z
        good = (residual * z * z < limit) & (cosine > s.min_cosine)  # false for what is not a number
        kept = good.nonzero()[:, 0]
        return (rays * z[:, None]).index_select(0, kept), normals.index_select(0, kept), z.index_select(0, kept)


def disc_per_depth(camera: Camera, settings: ExtractionSettings, pitch: int) -> float:
    """Standard deviation of a patch along the surface, per metre of depth."""
    half = ScanPatchTuning.half_patch
    spread = math.sqrt(half * (half + 1) / 3) * settings.patch_step * pitch  # of -half..half
    return spread / camera.fx


class DepthSegments:
    """Leaves small segments out of depth images of one camera. Of each square of `pitch` x `pitch` pixels the first one
    speaks for all.

    Args:
        camera: of the images.
        settings: limits.
        pitch: see above.
    """

    def __init__(self, camera: Camera, settings: ExtractionSettings, pitch: int) -> None:
        self._pitch, self._least, self._sigmas = pitch, settings.segment_pixels, settings.segment_sigmas
        rays = camera.rays()[::pitch, ::pitch].astype(np.float64)
        lengths = np.linalg.norm(rays, axis=2)
        rays /= lengths[..., None]
        self.lengths = lengths.astype(np.float32)
        """Of the viewing rays with z = 1, float32 [H, W] of the squares."""
        across, down = (
            np.arcsin(np.linalg.norm(np.cross(one, other), axis=2).clip(max=1))
            for one, other in ((rays[:, :-1], rays[:, 1:]), (rays[:-1], rays[1:]))
        )
        self.segments = RangeSegments(across, down, settings.segment_angle_deg)
        """Of the squares."""

    def without_small(self, depth: np.ndarray, noise: DepthNoise) -> np.ndarray:
        """Depth [H, W], metres, 0 where it is unknown or in a small segment. Noise does not part a surface."""
        coarse = depth[:: self._pitch, :: self._pitch]
        z = np.where(np.isfinite(coarse), coarse, 0).astype(np.float32)
        apart = np.float32(self._sigmas) * (noise.constant + noise.square * z * z)
        kept = self.segments.without_small(z * self.lengths, self._least, apart)
        if self._pitch > 1:
            height, width = depth.shape
            kept = kept.repeat(self._pitch, 0).repeat(self._pitch, 1)[:height, :width]
        return np.where(kept, depth, 0)


def plain_features(planes: Tensor, edges: Tensor, plane_sigmas: Tensor, edge_sigmas: Tensor) -> ScanFeatures:
    """Features of points alone, without patches; [P, 3], [E, 3], [P], [E]."""
    planes = planes.contiguous()
    return ScanFeatures(
        planes, torch.zeros_like(planes), torch.zeros_like(plane_sigmas), plane_sigmas, edges.contiguous(), edge_sigmas
    )


class _PixelLines:
    """Rows and, after them, columns of an image as scan lines of one length; short ones end in missing points."""

    def __init__(
        self, camera: Camera, settings: ExtractionSettings, layout: LineLayout, device: torch.device
    ) -> None:  # fmt: skip
        flat = torch.arange(camera.height * camera.width, device=device).view(camera.height, camera.width)
        self._settings, self._layout, self._rows = settings, layout, layout.rows
        shape = (layout.lines, layout.length)
        self._pixels = torch.zeros(shape, dtype=torch.int64, device=device)
        self._rays = torch.zeros(3, *shape, device=device)
        self._points, self._z, self._sigma = torch.zeros_like(self._rays), *torch.zeros(2, *shape, device=device)
        self._fill(self._pixels, flat)
        v = torch.div(self._pixels, camera.width, rounding_mode="floor")
        x, y = ((self._pixels - v * camera.width) - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        self._rays = torch.stack([x, y, torch.ones_like(x)]).float()
        self._scanner = LineScanner(*shape, settings, device)

    def _fill(self, out: Tensor, image: Tensor) -> None:
        rows, columns = self._layout.views(image)
        out[: self._rows, : rows.shape[1]] = rows
        out[self._rows :, : columns.shape[1]] = columns

    def pick(self, depth: Tensor, noise: DepthNoise) -> tuple[Tensor, Tensor]:
        """Positions in the flat image of edges [E] and planes [P]."""
        z, s = self._z, self._settings
        self._fill(z, depth)
        z.mul_((z >= s.min_depth) & (z <= s.max_depth))
        torch.mul(self._rays, z, out=self._points)
        sigma = torch.mul(z, z, out=self._sigma).mul_(noise.square).add_(noise.constant)
        edges, planes = self._scanner.scan(ScanLines(self._points, z, sigma, self._rows))
        return torch.take(self._pixels, edges), torch.take(self._pixels, planes)
