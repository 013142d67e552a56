# SPDX-License-Identifier: Apache-2.0
"""The insertion kernels give the Gaussians that the CPU's insertion gives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.cpu.insertion import fill_gaussians, find_unexplained, new_gaussians
from ggslam.mapping.cuda.insertion import CudaInsertion
from ggslam.mapping.keyframe import DEPTH_UNIT
from ggslam.mapping.new_gaussians import NewGaussians
from ggslam.mapping.settings import InsertionSettings
from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp

POSE = se3_exp(np.array([0.3, -0.2, 0.5, 0.2, 0.4, -0.3]))
SIZES = [(37, 53), (48, 64), (1, 20), (20, 1), (2, 2), (1, 1), (3, 70)]


@dataclass
class Images:
    """What is measured and rendered; `depth` in units of a keyframe."""

    camera: Camera
    color: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    rendered: np.ndarray

    @property
    def depth_m(self) -> np.ndarray:
        return self.depth.astype(np.float32) / np.float32(1 / DEPTH_UNIT)


def make_images(height: int, width: int, seed: int = 0, holes: float = 0.02) -> Images:
    """A sloped floor with a box in front of it, texture on half of it, holes large and small, half of it rendered."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    depth = 1.5 + 0.01 * u + 0.6 * v / height + 0.002 * np.sin(u) + rng.normal(0, 5e-4, (height, width))
    depth[height // 3 : height // 2, width // 4 : width // 2] = 0.9
    depth[rng.random((height, width)) < holes] = 0
    depth[2 * height // 3 : 2 * height // 3 + 9, width // 2 : width // 2 + 14] = 0
    color = np.full((height, width, 3), 120, np.uint8)
    color[:, width // 2 :] = rng.integers(0, 256, (height, width - width // 2, 3))
    color = cv2.blur(color, (3, 3))
    alpha = np.where(u + 3 * np.sin(v) > 0.7 * width, 0.95, rng.random((height, width))).astype(np.float32)
    rendered = (depth * np.where(rng.random((height, width)) < 0.1, 1.2, 1.001)).astype(np.float32)
    camera = Camera(width, height, 60.0, 61.5, 0.5 * width - 0.3, 0.5 * height + 0.2)
    return Images(camera, color, (depth / DEPTH_UNIT + 0.5).astype(np.uint16), alpha, rendered)


def on_device(library: CudaLibrary, images: Images, s: InsertionSettings, empty: bool = False) -> NewGaussians:
    device = library.whole_device(None)
    color, depth, alpha, rendered = (
        torch.from_numpy(a).to(device) for a in (images.color, images.depth, images.alpha, images.rendered)
    )
    insertion = CudaInsertion(device, library)
    known = (None, None) if empty else (alpha, rendered)
    return insertion.new_gaussians(color, depth, DEPTH_UNIT, *known, images.camera, POSE, s)


def on_host(images: Images, s: InsertionSettings, empty: bool = False) -> list[NewGaussians]:
    depth, alpha = images.depth_m, np.zeros_like(images.alpha) if empty else images.alpha
    where = np.ones(depth.shape, bool) if empty else find_unexplained(depth, alpha, images.rendered, s)
    parts = [new_gaussians(images.color, depth, images.camera, POSE, where, s)]
    if s.fill_stride:
        parts.append(fill_gaussians(images.color, depth, alpha, images.camera, POSE, s))
    return parts


def check_same(found: NewGaussians, expected: list[NewGaussians], images: Images, levels: int = 0) -> None:
    """The discs agree; of the fillings all but the depth does, which must be that of a nearest pixel, and the colour
    to so many `levels` of 255."""
    pixels = found.pixels.cpu().numpy()
    np.testing.assert_array_equal(pixels, np.concatenate([part.pixels for part in expected]))
    assert len(found) == len(pixels) and found.pixels.dtype == torch.int32
    discs = len(expected[0].pixels)
    means, quaternions, log_scales, rgb = (
        getattr(found, name).cpu().numpy() for name in ("means", "quaternions", "log_scales", "rgb")
    )
    np.testing.assert_allclose(means[:discs], expected[0].means, atol=2e-6)
    np.testing.assert_allclose(np.abs((quaternions[:discs] * expected[0].quaternions).sum(1)), 1, atol=1e-5)
    np.testing.assert_allclose(log_scales[:discs], expected[0].log_scales, atol=2e-4)
    np.testing.assert_allclose(rgb[:discs], expected[0].rgb, atol=1e-6)
    if len(expected) > 1 and len(pixels) > discs:
        np.testing.assert_allclose(rgb[discs:], expected[1].rgb, atol=levels / 255 + 1e-6)
        check_filling(means[discs:], log_scales[discs:], expected[1], images)
        np.testing.assert_array_equal(quaternions[discs:], expected[1].quaternions)


def check_filling(means: np.ndarray, log_scales: np.ndarray, expected: NewGaussians, images: Images) -> None:
    z = ((means - POSE[:3, 3]) @ POSE[:3, :3])[:, 2]
    sigma_of_z = np.exp(expected.log_scales[:, 0]) / ((expected.means - POSE[:3, 3]) @ POSE[:3, :3])[:, 2]
    np.testing.assert_allclose(np.exp(log_scales), (sigma_of_z * z)[:, None].repeat(3, 1), rtol=1e-5)
    depth = images.depth_m
    distance = distance_transform_edt(depth == 0)
    rows, columns = np.nonzero(depth)
    for pixel, depth_found in zip(expected.pixels, z, strict=True):
        row, column = divmod(int(pixel), depth.shape[1])
        squared = (rows - row) ** 2 + (columns - column) ** 2
        nearest = squared <= distance[row, column] ** 2 + 1e-6
        assert np.abs(depth[rows[nearest], columns[nearest]] - depth_found).min() < 1e-5


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("empty", [False, True], ids=["map", "empty map"])
def test_same_gaussians_as_on_the_cpu(cuda_library: CudaLibrary, size: tuple[int, int], empty: bool) -> None:
    images, s = make_images(*size), InsertionSettings()
    expected = on_host(images, s, empty)
    check_same(on_device(cuda_library, images, s, empty), expected, images)
    if size == (48, 64):
        assert len(expected[0].pixels) > 300 and len(expected[1].pixels) > 5


@pytest.mark.parametrize(
    "changed",
    [{"adaptive_stride": False}, {"flatness": 0.2}, {"fill_stride": 0}, {"fill_stride": 1}, {"fill_stride": 7},
     {"fill_stride": 200}, {"scale_pixels": 1.5, "max_slope": 1.2}, {"texture_threshold": 20.0}, {"max_depth_m": 1.9},
     {"alpha_threshold": 0.0, "depth_tolerance_m": 0.0, "depth_tolerance_relative": 0.0}],
    ids=str,
)  # fmt: skip
def test_settings_are_obeyed(cuda_library: CudaLibrary, changed: dict) -> None:
    images, s = make_images(37, 53), replace(InsertionSettings(), **changed)
    expected = on_host(images, s)
    assert len(expected[0].pixels) > 50
    check_same(on_device(cuda_library, images, s), expected, images, levels=1 - s.fill_stride % 2)


def test_without_any_depth_nothing_is_inserted(cuda_library: CudaLibrary) -> None:
    images = make_images(37, 53)
    images.depth[:] = 0
    for empty in (False, True):
        assert len(on_device(cuda_library, images, InsertionSettings(), empty)) == 0


def test_without_holes_nothing_is_filled(cuda_library: CudaLibrary) -> None:
    images = make_images(37, 53)
    images.depth[:] = np.maximum(images.depth, 5000)
    found = on_device(cuda_library, images, InsertionSettings(), empty=True)
    check_same(found, on_host(images, InsertionSettings(), empty=True), images)
    assert (images.depth.reshape(-1)[found.pixels.cpu().numpy()] > 0).all()


def test_a_single_known_pixel_fills_the_image(cuda_library: CudaLibrary) -> None:
    images, s = make_images(37, 53), InsertionSettings(fill_stride=2)
    images.depth[:] = 0
    images.depth[30, 7] = 9000
    expected = on_host(images, s, empty=True)
    assert len(expected[1].pixels) == 18 * 26
    check_same(on_device(cuda_library, images, s, empty=True), expected, images, levels=1)


def test_a_surface_that_the_map_explains_gets_nothing(cuda_library: CudaLibrary) -> None:
    images = make_images(37, 53)
    images.alpha[:], images.rendered[:] = 1.0, images.depth_m
    assert len(on_device(cuda_library, images, InsertionSettings())) == 0


def test_depth_of_another_scale(cuda_library: CudaLibrary) -> None:
    images, s = make_images(37, 53), InsertionSettings()
    expected = on_host(images, s, empty=True)
    device = cuda_library.whole_device(None)
    halved = torch.from_numpy(images.depth // 2 * 2).to(device), torch.from_numpy(images.depth // 2).to(device)
    insertion, color = CudaInsertion(device, cuda_library), torch.from_numpy(images.color).to(device)
    both = [
        insertion.new_gaussians(color, depth, scale, None, None, images.camera, POSE, s)
        for depth, scale in zip(halved, (1 / 5000, 1 / 2500), strict=True)
    ]
    assert len(both[0]) == len(both[1]) > 0.9 * len(expected[0].pixels)
    torch.testing.assert_close(both[0].means, both[1].means, atol=1e-6, rtol=0)


def test_an_instance_serves_images_of_any_size_and_repeats_itself(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    insertion, s = CudaInsertion(device, cuda_library), InsertionSettings()
    results = []
    for size in ((37, 53), (48, 64), (20, 1), (37, 53)):
        images = make_images(*size)
        color, depth = torch.from_numpy(images.color).to(device), torch.from_numpy(images.depth).to(device)
        results.append(insertion.new_gaussians(color, depth, 1 / 5000, None, None, images.camera, POSE, s))
    for name in ("means", "quaternions", "log_scales", "rgb", "pixels"):
        assert torch.equal(getattr(results[0], name), getattr(results[3], name))


@pytest.mark.usefixtures("other_order")
@pytest.mark.parametrize("cuda_library", ["emulated"], indirect=True)
def test_the_order_of_threads_does_not_matter(cuda_library: CudaLibrary) -> None:
    images, s = make_images(37, 53), InsertionSettings()
    check_same(on_device(cuda_library, images, s), on_host(images, s), images)


def test_wrong_arrays_are_refused(cuda_library: CudaLibrary) -> None:
    images = make_images(37, 53)
    device = cuda_library.whole_device(None)
    insertion, s = CudaInsertion(device, cuda_library), InsertionSettings()
    color, depth, alpha = (torch.from_numpy(a).to(device) for a in (images.color, images.depth, images.alpha))
    camera = images.camera
    with pytest.raises(RenderError, match="color: .*torch.uint8"):
        insertion.new_gaussians(color.float(), depth, 2e-4, None, None, camera, POSE, s)
    with pytest.raises(RenderError, match="depth: .*torch.uint16"):
        insertion.new_gaussians(color, depth[:-1], 2e-4, None, None, camera, POSE, s)
    with pytest.raises(RenderError, match="both or neither"):
        insertion.new_gaussians(color, depth, 2e-4, alpha, None, camera, POSE, s)
    with pytest.raises(RenderError, match="depth_scale"):
        insertion.new_gaussians(color, depth, float("nan"), None, None, camera, POSE, s)
    with pytest.raises(RenderError, match="contiguous"):
        insertion.new_gaussians(color, depth, 2e-4, alpha.T.contiguous().T, alpha, camera, POSE, s)
    with pytest.raises(RenderError, match="T_world_camera"):
        insertion.new_gaussians(color, depth, 2e-4, None, None, camera, POSE * np.nan, s)
