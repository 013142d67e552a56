# SPDX-License-Identifier: Apache-2.0
"""Short steps of the final refinement, measured on views of an exact scene that were not trained on."""

from __future__ import annotations

import numpy as np

from ggslam.evaluation.images import psnr
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.mapper import MapperTuning
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.system.tuning import overridden

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
FINER = 4
"""Samples of a pixel along each side."""


def pose(x: float, y: float) -> np.ndarray:
    """A camera that looks along z from (x, y, 0)."""
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def picture(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour uint8 [H, W, 3] and depth [H, W], metres, of a board, 1.4 m away, before a tiled wall 2 m away."""
    c, n = CAMERA, FINER
    v, u = (np.indices((n * c.height, n * c.width)) + 0.5) / n - 0.5
    rays = np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy], -1)
    near, far = (T[:2, 3] + z * rays for z in (1.4, 2.0))
    is_near = (np.abs(near) < (0.3, 0.2)).all(-1)
    points = np.where(is_near[..., None], near, far)
    tile = np.floor(points / np.where(is_near, 0.05, 0.11)[..., None]).astype(int)
    shade = 50 + (tile[..., 0] * 37 + tile[..., 1] * 61) % 160
    color = np.stack([shade, 255 - shade, np.where(is_near, 200, 90)], -1).astype(float)
    mean = color.reshape(c.height, n, c.width, n, 3).mean((1, 3))
    middle = is_near[n // 2 :: n, n // 2 :: n]
    return np.rint(mean).astype(np.uint8), np.where(middle, 1.4, 2.0).astype(np.float32)


def scores() -> tuple[float, float]:
    """PSNR, dB, and mean error of depth, metres, of views between those that were trained on."""
    mapper = CpuMapper(GaussianMap(), MapperSettings(), NativeContext(2))
    mapper.pixel_m = 2.0 / CAMERA.fx
    for k, (x, y) in enumerate([(-0.15, -0.1), (0.15, -0.1), (0.0, 0.0), (-0.15, 0.1), (0.15, 0.1)]):
        color, depth = picture(pose(x, y))
        mapper.add_keyframe(Frame(k, k, k / 30, color, depth, CAMERA), pose(x, y))
        mapper.run(20)
    mapper.refine(200)
    found = []
    for x, y in [(-0.08, 0.03), (0.07, -0.06), (0.11, 0.02)]:
        color, depth = picture(pose(x, y))
        view = mapper.render_view(CAMERA, inverse(pose(x, y)))
        image = view.image.numpy().transpose(1, 2, 0).clip(0, 1)
        found.append((psnr(image, color / 255), np.abs(view.expected_depth.numpy() - depth).mean()))
    decibels, metres = np.mean(found, 0)
    return float(decibels), float(metres)


def test_short_steps_draw_unseen_views_better() -> None:
    psnr_settled, depth_settled = scores()
    with overridden(MapperTuning, settling_means=1.0, settling_scales=1.0):
        psnr_shaken, depth_shaken = scores()
    assert psnr_settled > psnr_shaken + 0.8
    assert depth_settled < depth_shaken
