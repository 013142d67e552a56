# SPDX-License-Identifier: Apache-2.0
"""Steps on pictures of half and twice the size."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.cpu.mapper import CpuMapper
from ggslam.mapping.other_sizes import HalfSize, OtherSizeTuning, TwiceTheSize, picture_of_turn
from ggslam.mapping.pixel_grid import ALL_PIXELS
from ggslam.mapping.settings import MapperSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import LOW_PASS
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import overridden

CAMERA = Camera(96, 72, 80.0, 82.0, 47.2, 35.9)


def wall(camera: Camera = CAMERA) -> Frame:
    """A wall of dots, some of them smaller than a pixel of half the size."""
    v, u = np.indices((camera.height, camera.width))
    dots = ((u // 1) % 5 == 0) & (v % 4 == 0)
    grey = np.where(dots, 230, 90 + 40 * np.sin(u / 9)).astype(np.uint8)
    depth = np.full((camera.height, camera.width), 2.0, np.float32)
    return Frame(0, 0, 0.0, np.repeat(grey[..., None], 3, 2), depth, camera)


def make_mapper() -> CpuMapper:
    """A map of one keyframe."""
    mapper = CpuMapper(GaussianMap(feature_channels=0), MapperSettings(), NativeContext(2), 0)
    mapper.depth_noise_px = 0.1
    mapper.add_keyframe(wall(), np.eye(4), lambda keyframe, show: None)  # type: ignore[arg-type,return-value]
    return mapper


def twice(camera: Camera) -> Camera:
    return Camera(
        2 * camera.width, 2 * camera.height, 2 * camera.fx, 2 * camera.fy, 2 * camera.cx + 0.5, 2 * camera.cy + 0.5
    )


def test_half_the_size_is_the_mean_of_four_pixels_through_their_middle() -> None:
    half, rays = HalfSize(), CAMERA.rays()
    camera = half.camera(CAMERA)
    four = np.stack([rays[row::2, column::2] for row in (0, 1) for column in (0, 1)])
    np.testing.assert_allclose(camera.rays(), four.mean(0), atol=1e-6)
    color = np.random.default_rng(0).integers(0, 256, (73, 97, 3), dtype=np.uint8)
    expected = color[:72, :96].reshape(36, 2, 48, 2, 3).mean((1, 3))
    assert np.abs(half.color_of(color) - expected).max() <= 0.5
    assert half.of(color).shape == half.color_of(color).shape == (36, 48, 3)


def test_depths_of_different_surfaces_are_not_averaged() -> None:
    depth = np.full((4, 6), 2000, np.uint16)
    depth[0, 0], depth[0, 2], depth[2, 5] = 2010, 3000, 0
    assert HalfSize().depth_of(depth).tolist() == [[2002, 0, 2000], [2000, 2000, 0]]
    assert HalfSize().depth_of(depth / np.float32(1000))[0, 0] == pytest.approx(2.0025)
    shown = np.ones((4, 6), bool)
    shown[3, 1] = False
    assert HalfSize().valid_of(shown).tolist() == [[True, True, True], [False, True, True]]


def test_a_step_on_twice_the_size_sees_what_four_pixels_of_it_show_on_average() -> None:
    gaussians, rasterizer = make_mapper().map, CpuRasterizer(1)
    gaussians.opacity_logits[:] = -3.0  # where little hides, what is averaged adds up
    large = rasterizer.forward(gaussians, twice(CAMERA), np.eye(4), features=False).image.numpy()
    wanted = large.reshape(3, CAMERA.height, 2, CAMERA.width, 2).mean((2, 4))
    ours, theirs = (
        np.abs(rasterizer.forward(gaussians, CAMERA, np.eye(4), low_pass=f).image.numpy() - wanted).mean()
        for f in (TwiceTheSize().low_pass(LOW_PASS), LOW_PASS)
    )
    assert ours < 0.3 * theirs


def test_most_of_the_last_steps_and_small_pictures_are_of_the_own_size() -> None:
    share = OtherSizeTuning.share
    kinds = [type(picture_of_turn(turn, 0.9 * share, CAMERA)) for turn in range(8)]
    assert kinds.count(HalfSize) == kinds.count(TwiceTheSize) == 2
    later = [picture_of_turn(turn, share, CAMERA) for turn in range(40)]
    assert later.count(HalfSize()) == later.count(TwiceTheSize()) == 2
    assert sum(picture is ALL_PIXELS for picture in later) == 36
    small = Camera(97, 63, 80.0, 80.0, 48.0, 31.0)
    assert all(picture_of_turn(turn, 0, small) is ALL_PIXELS for turn in range(8))


def psnr_at_sizes(mapper: CpuMapper) -> tuple[float, float, float]:
    """At half, once and twice the size, dB; twice the size against the picture it was made of, enlarged by its dots."""
    rasterizer, color = CpuRasterizer(1), wall().color / 255.0

    def db(camera: Camera, expected: np.ndarray, size: int = 1) -> float:
        image = rasterizer.forward(mapper.map, camera, np.eye(4), features=False).image.numpy().clip(0, 1)
        image = image.reshape(3, camera.height // size, size, camera.width // size, size).mean((2, 4))
        return float(-10 * np.log10(((image.transpose(1, 2, 0) - expected) ** 2).mean()))

    half = color.reshape(CAMERA.height // 2, 2, CAMERA.width // 2, 2, 3).mean((1, 3))
    return db(HalfSize().camera(CAMERA), half), db(CAMERA, color), db(twice(CAMERA), color, 2)


def test_a_map_trained_at_three_sizes_is_right_at_all() -> None:
    one, three = make_mapper(), make_mapper()
    for mapper in (one, three):
        mapper.run(40)
    with overridden(OtherSizeTuning, share=0.0, later_every=10**6):
        one.refine(200)
    three.refine(200)
    (half, own, large), (half_3, own_3, large_3) = psnr_at_sizes(one), psnr_at_sizes(three)
    assert half_3 > half + 0.5 and large_3 > large + 0.2 and own_3 > own - 1.0
