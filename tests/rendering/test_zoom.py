# SPDX-License-Identifier: Apache-2.0
"""Gaussians that are fitted to renderers with smaller or larger pixels than the map was trained with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import LARGEST_ZOOM, LOW_PASS, low_pass_at, low_pass_for
from ggslam.rendering.zoom import ZoomFit
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def wall(spacing: float, depth: float = 2.0) -> GaussianMap:
    """A wall of small splats, a grid with alternating grey values."""
    x, y = np.meshgrid(np.arange(-2, 2, spacing), np.arange(-1.6, 1.6, spacing))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], 1).astype(np.float32)
    grey = np.where((np.arange(x.size) // 7) % 2, 0.8, 0.3).astype(np.float32)
    gaussians = GaussianMap(0, 0)
    gaussians.insert(
        torch.from_numpy(means), torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1),
        torch.full((len(means), 3), float(np.log(0.2 * spacing))), torch.full((len(means),), 2.0),
        torch.from_numpy(np.repeat(grey[:, None], 3, 1)),
    )  # fmt: skip
    return gaussians


def drawn(gaussians: GaussianMap, size: int) -> np.ndarray:
    """Rendered at `size` times the size, averaged down to the size of CAMERA."""
    c = CAMERA
    camera = Camera(
        size * c.width, size * c.height, size * c.fx, size * c.fy, size * (c.cx + 0.5) - 0.5, size * (c.cy + 0.5) - 0.5
    )
    image = CpuRasterizer(1).forward(gaussians, camera, np.eye(4), features=False, as_3dgs=True).image.numpy()
    return image.reshape(3, c.height, size, c.width, size).mean((2, 4))


@pytest.mark.parametrize("zoom", [2, 4])
def test_widened_gaussians_look_in_large_as_they_did_in_small(zoom: int) -> None:
    gaussians = wall(spacing=2.0 / 60)  # a splat a pixel, as maps have them
    small = drawn(gaussians, 1)
    before = np.abs(drawn(gaussians, zoom) - small).mean()
    ZoomFit(CAMERA, [np.eye(4)], zoom)(gaussians)
    after = np.abs(drawn(gaussians, zoom) - small).mean()
    assert after < 0.25 * before and before > 0.05


def test_what_is_added_is_the_low_pass_that_a_larger_image_lacks() -> None:
    gaussians = wall(0.2, depth=3.0)
    before = torch.exp(2 * gaussians.log_scales).clone()
    nearer = np.eye(4)
    nearer[2, 3] = 1.0
    away = np.diag([-1.0, 1.0, -1.0, 1.0])  # looks the other way: nothing in its image
    widening = ZoomFit(CAMERA, [np.eye(4), nearer, away], 2)
    widening(gaussians)
    added = (torch.exp(2 * gaussians.log_scales) - before).numpy()
    seen = np.abs(gaussians.means.numpy()[:, 0]) < 0.9  # in the image of the nearer view
    assert seen.any()
    middle = added[seen & (np.abs(gaussians.means.numpy()[:, 1]) < 0.7)]
    np.testing.assert_allclose(middle, 0.75 * LOW_PASS * (2.0 / 60) ** 2, rtol=1e-3)


def test_points_in_no_image_take_the_distance_of_the_nearest_camera() -> None:
    widening = ZoomFit(CAMERA, [np.eye(4)], 2)
    np.testing.assert_allclose(widening.depths(np.array([[0, 0, -3.0], [0, 0, 5.0]])), [[3, 5], [3, 5]])


def test_zoom_one_adds_nothing_and_others_are_refused() -> None:
    gaussians = wall(0.2)
    before = gaussians.log_scales.clone()
    ZoomFit(CAMERA, [np.eye(4)], 1)(gaussians)
    torch.testing.assert_close(gaussians.log_scales, before)
    for zoom in (0.04, -1.0, float("nan"), 1e6):
        with pytest.raises(ConfigError, match="zoom"):
            ZoomFit(CAMERA, [np.eye(4)], zoom)
    with pytest.raises(ConfigError, match="keyframes"):
        ZoomFit(CAMERA, [], 2)


def test_the_usual_depth_is_the_geometric_mean_over_the_views_that_see_a_point() -> None:
    nearer, away = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    nearer[2, 3] = 1.0
    closest, usual = ZoomFit(CAMERA, [np.eye(4), nearer, away], 0.5).depths(np.array([[0, 0, 5.0], [1.9, 0, 4.0]]))
    np.testing.assert_allclose(closest, [4, 4])
    np.testing.assert_allclose(usual, [np.sqrt(20), 4])


def smaller(size: int) -> Camera:
    """CAMERA at 1 / `size` of its size."""
    c = CAMERA
    return Camera(
        c.width // size,
        c.height // size,
        c.fx / size,
        c.fy / size,
        (c.cx + 0.5) / size - 0.5,
        (c.cy + 0.5) / size - 0.5,
    )


@pytest.mark.parametrize("size", [2, 4])
def test_fitted_gaussians_look_in_small_as_they_did_in_large(size: int) -> None:
    """Specks on a wall: what is smaller than the filter is not to grow with it."""
    gaussians, specks = wall(spacing=5.0 / 60), wall(spacing=13.0 / 60, depth=1.99)
    for part, log_scale in ((gaussians, np.log(3.0 / 60)), (specks, np.log(0.01 / 60))):
        part.log_scales[:] = float(log_scale)
    specks.sh[:] = (1 - 0.5) / 0.28209479
    gaussians.insert(
        specks.means, specks.quaternions, specks.log_scales, specks.opacity_logits, torch.ones(len(specks), 3)
    )
    large = CpuRasterizer(1).forward(gaussians, CAMERA, np.eye(4), features=False).image.numpy()
    c = smaller(size)
    wanted = large.reshape(3, c.height, size, c.width, size).mean((2, 4))

    def error() -> float:
        shown = CpuRasterizer(1).forward(gaussians, c, np.eye(4), features=False, as_3dgs=True).image.numpy()
        return float(np.abs(shown - wanted).mean())

    before = error()
    ZoomFit(CAMERA, [np.eye(4)], 1 / size)(gaussians)
    assert error() < 0.4 * before and before > 0.02


def test_the_filter_of_other_sizes() -> None:
    """Four pixels of twice the size spread by 1/16 px^2 of the own size, four of the own size by 1/4."""
    assert low_pass_at(1) == LOW_PASS == low_pass_for(CAMERA, []) == low_pass_for(CAMERA, [CAMERA])
    assert low_pass_at(2) / 4 + 1 / 16 == pytest.approx(LOW_PASS)
    assert low_pass_at(0.5) == pytest.approx((LOW_PASS + 1 / 4) / 4) == pytest.approx(0.1375)
    assert low_pass_for(CAMERA.scale(2), [CAMERA]) == pytest.approx(0.95)
    assert low_pass_at(1e6) == low_pass_at(LARGEST_ZOOM) < 1e3
    assert low_pass_at(1e-6) > 0


def test_the_filter_of_maps_that_several_cameras_taught() -> None:
    """Each camera's own size is drawn as trained, other sizes as against the nearest, the finer one of two as near."""
    rig = [CAMERA.scale(0.5), CAMERA.scale(2), CAMERA.scale(0.5)]
    assert [low_pass_for(camera, rig) for camera in rig] == [LOW_PASS] * 3
    for focal, zoom in ((0.25, 0.5), (0.8, 1.6), (1.0, 0.5), (1.25, 0.625), (8.0, 4.0)):
        camera = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
        assert low_pass_for(camera, rig) == pytest.approx(low_pass_at(zoom))


@pytest.mark.parametrize("zoom", [0.5, 2.0])
def test_pictures_of_other_sizes_show_the_map_as_trained(zoom: float) -> None:
    """Where little hides, so that what is averaged adds up: means of four pixels of the larger picture are the smaller
    one."""
    gaussians, rasterizer, images = wall(0.03), CpuRasterizer(1), {}
    gaussians.opacity_logits[:] = -4.0
    for size in (1.0, zoom):
        for low_pass in (LOW_PASS, low_pass_at(size)):
            camera = CAMERA.scale(size)
            view = rasterizer.forward(gaussians, camera, np.eye(4), features=False, low_pass=low_pass)
            image = view.image.numpy().copy()  # the next picture goes to the same place
            if size == max(1.0, zoom):
                image = image.reshape(3, camera.height // 2, 2, camera.width // 2, 2).mean((2, 4))
            images[size, low_pass] = image
    own = images[1.0, LOW_PASS]
    fitted, as_3dgs = (np.abs(images[zoom, f] - own).mean() for f in (low_pass_at(zoom), LOW_PASS))
    assert fitted < 0.3 * as_3dgs
