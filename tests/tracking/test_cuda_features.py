# SPDX-License-Identifier: Apache-2.0
"""Edges and planes that the CUDA kernels extract, held against those of the CPU and against exact geometry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from device_features import NO_LIMIT, Sides, check_same, on_device
from feature_scenes import CAMERA, room_view

from ggslam.cuda.library import CudaLibrary
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.tracking.edges_planes.settings import LIDAR, ExtractionSettings
from ggslam.tracking.settings import DepthNoise

NOISE = DepthNoise(0.002, 0.001)
CAMERAS = {
    "small": Camera(160, 120, 130.0, 130.0, 79.5, 59.5), "usual": CAMERA,
    "large": Camera(640, 480, 520.0, 520.0, 319.5, 239.5), "upright": Camera(240, 320, 260.0, 260.0, 119.5, 159.5),
    "odd": Camera(333, 201, 260.0, 255.0, 160.0, 99.0),
}  # fmt: skip
TURNED = se3_exp(np.array([0.02, -0.01, 0.03, 0.03, -0.02, 0.1]))


def check(library: CudaLibrary, extraction: ExtractionSettings, depth: np.ndarray, camera: Camera = CAMERA) -> int:
    """Extracts on both sides, compares, and says how many features there are."""
    sides = Sides.of(library, replace(NO_LIMIT, extraction=extraction), camera)
    scan, expected = sides.scans(depth, NOISE)
    check_same(scan.read(), expected)
    assert (scan.plane_count, scan.edge_count) == (len(expected.planes), len(expected.edges))
    assert scan.median_depth == pytest.approx(expected.median_depth, rel=1e-6)
    assert scan.median_distance == pytest.approx(expected.median_distance, rel=1e-6)
    return len(expected)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("angle", [0.0, 10.0], ids=["whole", "segments"])
def test_features_are_those_of_the_cpu(cuda_library: CudaLibrary, name: str, angle: float) -> None:
    camera = CAMERAS[name]
    depth = room_view(TURNED, sigma=0.003, seed=3, camera=camera).depth
    assert check(cuda_library, ExtractionSettings(segment_angle_deg=angle), depth, camera) > 300


def test_features_of_a_recording_are_those_of_the_cpu(cuda_library: CudaLibrary, frames: list[Frame]) -> None:
    for frame in frames[:8]:
        for angle in (0.0, 10.0):
            assert check(cuda_library, ExtractionSettings(segment_angle_deg=angle), frame.depth, frame.camera) > 100


@pytest.mark.parametrize("change", [
    {"edges_per_segment": 0}, {"edges_per_segment": 5}, {"planes_per_segment": 2}, {"column_step": 0}, {"segments": 1},
    {"occluding_edges": False}, {"segments": 40}, {"max_depth": 1.7}, {"patch_step": 4}, {"edge_angle_deg": 80.0},
    {"plane_sigmas": 1.0}, {"edge_sigmas": 12.0}, {"gap": 0.0}, {"roughness": 0.01}, {"min_cosine": 0.8},
    {"row_step": 3}, {"segment_angle_deg": 25.0, "segment_pixels": 900, "segment_sigmas": 0.5},
])  # fmt: skip
def test_every_setting_means_the_same(cuda_library: CudaLibrary, change: dict[str, Any]) -> None:
    depth = room_view(TURNED, sigma=0.002, seed=1).depth
    assert check(cuda_library, replace(ExtractionSettings(), **change), depth) > 30


def test_settings_of_a_lidar_mean_the_same(cuda_library: CudaLibrary) -> None:
    assert check(cuda_library, LIDAR.extraction, room_view(TURNED, sigma=0.002).depth) > 100


def hostile(kind: str) -> np.ndarray:
    depth, rng = room_view(TURNED, sigma=0.002, seed=2).depth, np.random.default_rng(0)
    few = rng.random(depth.shape) < 0.002
    made = {
        "empty": np.zeros_like(depth), "not a number": np.full_like(depth, np.nan), "one value": np.full_like(depth, 2),
        "holes": np.where(few, 0, depth), "some not a number": np.where(few, np.nan, depth),
        "some infinite": np.where(few, np.inf, depth), "some negative": np.where(few, -1, depth),
        "nothing but noise": rng.uniform(0.2, 9, depth.shape), "too far": depth + 20, "too near": 0.01 * depth,
        "one pixel": np.where(np.arange(depth.size).reshape(depth.shape) == 5000, depth, 0),
        "a strip": np.where(np.arange(320) < 12, depth, 0),
    }  # fmt: skip
    return made[kind].astype(np.float32)


@pytest.mark.filterwarnings("ignore:.*invalid value")
@pytest.mark.parametrize("angle", [0.0, 10.0], ids=["whole", "segments"])
@pytest.mark.parametrize("kind", [
    "empty", "not a number", "one value", "holes", "some not a number", "some infinite", "some negative",
    "nothing but noise", "too far", "too near", "one pixel", "a strip",
])  # fmt: skip
def test_hostile_depth_gives_what_it_gives_on_the_cpu(cuda_library: CudaLibrary, kind: str, angle: float) -> None:
    depth = hostile(kind)
    found = check(cuda_library, ExtractionSettings(segment_angle_deg=angle), depth)
    assert (found > 200) == (kind in ("one value", "holes", "some not a number", "some infinite", "some negative"))


def test_values_that_are_no_numbers_take_the_places_of_the_best(cuda_library: CudaLibrary) -> None:
    """As on the CPU, where they rank first: a segment with one of them gives one edge less."""
    depth = room_view(TURNED, sigma=0.002, seed=2).depth.copy()
    depth[20::40, 10::30] = np.nan
    extraction = ExtractionSettings(edges_per_segment=3, planes_per_segment=2)
    assert check(cuda_library, extraction, depth) > 30


def test_planes_of_exact_depth_lie_on_the_walls(cuda_library: CudaLibrary) -> None:
    depth = room_view(np.eye(4), corner=False).depth
    features = on_device(cuda_library).extract(depth, NOISE).read()
    assert len(features.planes) > 500 and len(features.edges) == 0
    assert np.abs(features.planes[:, 2].numpy() - 2).max() < 1e-6
    assert np.abs(features.normals.numpy() - [0, 0, -1]).max() < 2e-5
    corner = on_device(cuda_library).extract(room_view(np.eye(4)).depth, NOISE).read()
    off = np.abs(np.array([0.6, 0.5, 2.0]) - corner.planes.numpy())
    assert np.median(off.min(1)) < 1e-6


@pytest.mark.parametrize("angle", [10.0])  # segments, and all that follows
def test_features_repeat_bit_for_bit_in_any_order_of_threads(angle: float, other_order: None) -> None:
    from cuda_emulation import emulated_library

    library, depth = emulated_library(), room_view(TURNED, sigma=0.002, seed=4).depth
    settings = replace(NO_LIMIT, extraction=ExtractionSettings(segment_angle_deg=angle))
    other = on_device(library, settings).extract(depth, NOISE).read()
    library.functions.ggslam_emulation_order(0)
    usual = on_device(library, settings).extract(depth, NOISE).read()
    for name in usual.__dataclass_fields__:
        assert getattr(usual, name).numpy().tobytes() == getattr(other, name).numpy().tobytes()


def test_images_of_another_size_and_lines_that_are_too_short_are_refused(cuda_library: CudaLibrary) -> None:
    with pytest.raises(ValueError, match="expected"):
        on_device(cuda_library).extract(np.zeros((10, 10), np.float32), NOISE)
    with pytest.raises(ValueError, match=r"\b11\b"):
        on_device(cuda_library, camera=Camera(10, 10, 8.0, 8.0, 4.5, 4.5))


def test_scans_keep_their_own_depth(cuda_library: CudaLibrary) -> None:
    """Features are extracted when someone asks, which may be after the next image was sent."""
    features = on_device(cuda_library)
    depths = [room_view(TURNED, sigma=0.002, seed=seed).depth for seed in range(3)]
    scans = [features.extract(depth, NOISE) for depth in depths]
    for scan, depth in zip(scans, depths, strict=True):
        again = on_device(cuda_library).extract(depth, NOISE).read()
        assert scan.read().planes.numpy().tobytes() == again.planes.numpy().tobytes()
