# SPDX-License-Identifier: Apache-2.0
"""A map changes its exposure: every picture does by the same gain, and training goes on as it would have."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.mapping.color_changes import scale_colors, take_colors
from ggslam.mapping.keyframe import make_keyframe
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.exposure import (
    ExposureTuning,
    SeenAgain,
    frame_weights,
    identity_exposure,
    is_lit,
    relative_sharpness,
    shows_otherwise,
    typical_gain,
)
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
GAIN = np.array([3.0, 2.0, 0.5])


def wall(degree: int = 0) -> GaussianMap:
    """One Gaussian for each pixel, 2 m away, of random colours; with moments."""
    random = np.random.default_rng(3)
    gaussians = GaussianMap(degree)
    points = torch.from_numpy(CAMERA.rays().reshape(-1, 3).astype(np.float32) * 2)
    count = len(points)
    turned = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    sizes = torch.full((count, 3), float(np.log(0.02)))
    colors = torch.from_numpy(random.random((count, 3), np.float32) * 0.3)
    gaussians.insert(points, turned, sizes, 3.0, colors, birth_keyframe=0)
    if degree:
        rest = gaussians.sh[:, 1:]
        rest.copy_(torch.from_numpy(random.normal(0, 0.02, tuple(rest.shape))))
    for moments in gaussians.moments["sh"]:
        moments.copy_(torch.from_numpy(random.random(tuple(moments.shape), np.float32)))
    return gaussians


def frame_of(color: np.ndarray) -> Frame:
    return Frame(0, 0, 0.0, color, np.full((48, 64), 2, np.float32), CAMERA)


@pytest.mark.parametrize("degree", [0, 2])
def test_pictures_become_brighter_by_the_gain(degree: int) -> None:
    gaussians = wall(degree)
    before = CpuRasterizer().forward(gaussians, CAMERA, np.eye(4), features=False).image.numpy().copy()
    first, second = (moments.clone() for moments in gaussians.moments["sh"])
    scale_colors(gaussians, GAIN)
    after = CpuRasterizer().forward(gaussians, CAMERA, np.eye(4), features=False).image.numpy()
    assert np.abs(after - before * GAIN[:, None, None]).max() < 2e-5
    gain = torch.from_numpy(GAIN.astype(np.float32))
    torch.testing.assert_close(gaussians.moments["sh"][0], first / gain)
    torch.testing.assert_close(gaussians.moments["sh"][1], second / gain**2)


def test_gaussians_take_the_colours_of_a_keyframe_that_sees_them() -> None:
    gaussians = wall()
    hidden = gaussians.rgb[:100].clone()
    gaussians.means[:100] *= 1.5  # behind what was measured
    color = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    take_colors(gaussians, make_keyframe(0, frame_of(color), np.eye(4)))
    expected = color.reshape(-1, 3)[100:] / np.float32(255)
    assert np.abs(gaussians.rgb[100:].numpy() - expected).max() < 1e-6
    assert torch.equal(gaussians.rgb[:100], hidden)
    assert not gaussians.moments["sh"][0][100:].any() and gaussians.moments["sh"][0][:100].all()


@pytest.mark.parametrize(
    ("gains", "typical"),
    [((1, 4, 4), 4), ((1, 1, 4), 1), ((0.5, 1, 1.0, 4), 1), ((0.5, 1.0, 4, 4), 1), ((2, 3, 4, 5), 3), ((1.0, 0.2), 1)],
)
def test_the_typical_gain_is_one_that_keyframes_have(gains: tuple[float, ...], typical: float) -> None:
    found = typical_gain([np.full(3, gain) for gain in gains], np.ones(len(gains)))
    assert found == pytest.approx(np.full(3, typical))


def test_a_gain_counts_for_the_frames_that_have_it() -> None:
    assert frame_weights([0, 1, 2, 3, 9, 15]).tolist() == [1, 1, 1, 6, 6, 6]
    gains = [np.full(3, gain) for gain in (0.1, 0.2, 0.3, 4, 5)]
    assert typical_gain(gains, frame_weights([0, 2, 4, 6, 16])) == pytest.approx(np.full(3, 4))


def seen(image: np.ndarray) -> SeenAgain:
    """What a map shows that has this grey image [H, W]."""
    depth = np.full(image.shape, 2, np.float32)
    return SeenAgain(np.stack([image] * 3).astype(np.float32), np.ones_like(depth), depth, depth)


def test_what_is_black_in_the_scene_is_no_dark_frame() -> None:
    texture = np.random.default_rng(1).random((48, 64))
    black, bright = np.zeros((48, 64, 3), np.uint8), np.full((48, 64, 3), 255, np.uint8)
    assert is_lit((texture[..., None] * [255, 255, 255]).astype(np.uint8))
    assert not is_lit(black) and not is_lit(bright)
    for image in (black, bright):
        assert shows_otherwise(image, seen(texture))
    assert not shows_otherwise(black, seen(0.05 * texture))
    assert not shows_otherwise(bright, seen(0.95 + 0.05 * texture))


def test_images_are_lit_from_the_same_grey_value_on() -> None:
    colors = np.array([(min(s, 255), min(max(s - 255, 0), 255), max(s - 510, 0)) for s in range(766)], np.uint8)
    grey = colors.astype(np.float32).mean(1) / 255
    expected = (grey > ExposureTuning.dark) & (grey < ExposureTuning.bright)
    found = [is_lit(np.full((4, 6, 3), color, np.uint8)) for color in colors]
    assert found == expected.tolist() and 0 < expected.sum() < 766


def test_sharpness_is_that_of_the_map_whatever_the_exposure() -> None:
    texture = np.random.default_rng(1).random((48, 64))
    color = np.repeat(np.rint(255 * 0.5 * texture)[..., None], 3, 2).astype(np.uint8)
    exposure = identity_exposure() * [0.5, 1]
    assert relative_sharpness(color, seen(texture), exposure) == pytest.approx(1, abs=0.01)
    flat = np.full((48, 64, 3), 60, np.uint8)
    assert relative_sharpness(flat, seen(texture), exposure) == 0
    assert relative_sharpness(flat, seen(np.full((48, 64), 0.5)), exposure) == 1
