# SPDX-License-Identifier: Apache-2.0
"""Depth on the slopes of a camera that smooths its images is not used; sharp outlines are left alone."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from ggslam.geometry.soft_edges import edge_sharpness, soft_edges
from ggslam.mapping.comparing_mapper import SoftOutlineTuning
from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.config import load_config
from ggslam.slam.filters.depth_edges import DepthEdges
from ggslam.slam.slam import Slam

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
REACH = 4


def wall_and_box(noise: float = 0.0) -> np.ndarray:
    """A slanted wall, 2 to 3 m away, and a box 1 m in front of it."""
    depth = np.tile(1 / np.linspace(1 / 2, 1 / 3, 320), (240, 1))
    depth[80:160, 100:200] = 1.3
    depth += noise * np.random.default_rng(0).standard_normal(depth.shape)
    return depth.astype(np.float32)


def smooth(depth: np.ndarray) -> np.ndarray:
    """As from a camera of half the size, smoothed."""
    small = cv2.GaussianBlur(cv2.resize(depth, (160, 120), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    return cv2.resize(small, (320, 240), interpolation=cv2.INTER_LINEAR)


def frame(depth: np.ndarray, index: int = 0) -> Frame:
    return Frame(index, index, 0.1 * index, np.zeros((240, 320, 3), np.uint8), depth, CAMERA)


def test_slopes_are_found_where_the_outline_is_and_nowhere_else() -> None:
    found, true = soft_edges(smooth(wall_and_box()), REACH), wall_and_box()
    outline = cv2.dilate((true < 1.5).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    outline &= cv2.erode((true < 1.5).astype(np.uint8), np.ones((11, 11), np.uint8)) == 0
    assert found.sum() > 1200 and not found[~outline].any()
    between = np.abs(smooth(true) - true) > 0.15
    assert found[between].mean() > 0.8  # what is left there is less than that off


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_sharp_outlines_walls_and_noise_are_none(noise: float) -> None:
    assert soft_edges(wall_and_box(noise), REACH).mean() < 0.002
    assert not soft_edges(np.zeros((240, 320), np.float32), REACH).any()


def test_outlines_tell_how_sharp_they_are() -> None:
    sharp, count = edge_sharpness(wall_and_box(), REACH)
    soft, _ = edge_sharpness(smooth(wall_and_box()), REACH)
    assert sharp > 0.95 and 0.1 < soft < 0.35 and count > 1000
    assert edge_sharpness(np.full((240, 320), 2.0, np.float32), REACH) == (1.0, 0)
    assert edge_sharpness(np.ones((4, 4), np.float32), REACH) == (1.0, 0)


def test_only_cameras_that_smooth_lose_depth() -> None:
    sharp, soft = DepthEdges(), DepthEdges()
    given = frame(wall_and_box(0.005))
    assert sharp.clean(given) is given and sharp.soft is False
    cleaned = soft.clean(frame(smooth(wall_and_box())))
    lost = (cleaned.depth == 0).mean()
    assert soft.soft is True and 0.01 < lost < 0.06 and cleaned.depth.dtype == np.float32
    again = frame(wall_and_box(), 1)
    assert sharp.clean(again) is again  # once known it is known


def test_where_no_outline_is_seen_depth_is_left_alone() -> None:
    edges, blank = DepthEdges(), np.full((240, 320), 2.0, np.float32)
    for index in range(40):
        given = frame(blank, index)
        assert edges.clean(given) is given
    assert edges.soft is False and edges.frames == 30


def test_a_run_uses_what_is_left() -> None:
    slam = Slam(CAMERA, load_config(None, ["mapping.first_frame_iterations=0", "identity.enabled=false"]), False)
    color = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    slam.step(dataclasses.replace(frame(smooth(wall_and_box())), color=color))
    kept = slam.mapper.keyframes[0].depth_m()
    assert 0.01 < (kept == 0).mean() < 0.06
    assert np.abs(kept - smooth(wall_and_box()))[kept > 0].max() < 1e-3


@pytest.mark.parametrize("soft", [False, True])
def test_beside_soft_outlines_every_pixel_becomes_a_gaussian(soft: bool) -> None:
    """There depth is missing, and what is left says less."""
    few = ["mapping.first_frame_iterations=0", "identity.enabled=false"]
    slam = Slam(CAMERA, load_config(None, few), False)
    color = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    depth = smooth(wall_and_box()) if soft else wall_and_box()
    slam.step(dataclasses.replace(frame(depth), color=color))
    mapper = slam.mapper
    assert isinstance(mapper, CpuMapper) and mapper.has_soft_outlines == soft
    assert mapper._insertion_settings.fill_stride == (1 if soft else mapper.settings.insertion.fill_stride)
    share = mapper._loss_settings(mapper.keyframes[0]).depth_weight / mapper.settings.loss.depth_weight
    assert share == pytest.approx(SoftOutlineTuning.depth_weight_share if soft else 1)
    missing = (mapper.keyframes[0].depth_m() == 0).sum()
    assert not soft or len(mapper.map) > 0.98 * 240 * 320 > 240 * 320 - missing
