# SPDX-License-Identifier: Apache-2.0
"""Grey values, textured points and residuals made by the CUDA kernels: those of the host, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.cuda.library import CudaLibrary
from ggslam.features.orb import FeatureView
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.cuda.greys import CudaPhotometricPart
from ggslam.tracking.engine import CpuTrackingEngine
from ggslam.tracking.gicp import GicpTarget, PhotometricPart
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.photometric import GreyDepth, PhotometricReference, textured_points
from ggslam.tracking.settings import (
    AlignSettings,
    DepthNoise,
    PhotometricMode,
    PhotometricSettings,
    PointSettings,
    TrackerSettings,
)
from ggslam.tracking.surface import MeasuredSurface

NOISE, POINTS, ALIGN = DepthNoise(), PointSettings(count=1500), AlignSettings(coarse_points=500)
CLOSE = se3_exp(np.array([0.02, -0.01, 0.015, 0.01, -0.02, 0.005]))


def truth_of(frame: Frame) -> np.ndarray:
    assert frame.T_world_camera is not None
    return frame.T_world_camera


def view_of(frame: Frame) -> FeatureView:
    return FeatureView(frame.color, frame.depth, truth_of(frame))


def host_part(
    view: FeatureView, other: FeatureView, camera: Camera, settings: PhotometricSettings, shrink: int
) -> PhotometricPart:
    small, earlier = (GreyDepth.from_images(v.color, v.depth, camera, shrink) for v in (view, other))
    reference = PhotometricReference.from_view(earlier, other.T_world_camera)
    return PhotometricPart(textured_points(small, settings), reference, settings)


def floats(engine: CudaTrackingEngine, address: int, count: int) -> np.ndarray:
    """What is at an address of the memory that grey values are made in."""
    tensors = [image.memory for image in engine.greys._images] + list(engine.greys._memory._blocks.values())
    for tensor in tensors:
        begin = address - tensor.data_ptr()
        if 0 <= begin < tensor.numel() * tensor.element_size():
            return tensor.cpu().numpy().view(np.uint8)[begin : begin + 4 * count].view(np.float32)
    raise AssertionError("no such memory")


@pytest.mark.parametrize(
    ("size", "shrink"),
    [((160, 120), 1), ((160, 120), 2), ((160, 120), 4), ((66, 45), 3), ((36, 33), 1), ((36, 33), 2), ((16, 9), 4),
     ((67, 45), 2)],
)  # fmt: skip
def test_images_and_points_are_those_of_opencv(
    cuda_library: CudaLibrary, native_target: GicpTarget, size: tuple[int, int], shrink: int
) -> None:
    """Where reduced images have an odd number of columns, OpenCV rounds the last one in another way."""
    random, (width, height) = np.random.default_rng(0), size
    camera = Camera(width, height, 1.1 * width, 1.2 * width, 0.49 * width, 0.51 * height)
    engine = CudaTrackingEngine(camera, library=cuda_library)
    views = []
    for _ in range(2):
        coarse = random.integers(0, 256, (height // 3 + 1, width // 3 + 1, 3), dtype=np.uint8)
        color = np.ascontiguousarray(np.kron(coarse, np.ones((3, 3, 1), np.uint8))[:height, :width])
        depth = random.uniform(1, 1.02, (height, width)).astype(np.float32)
        depth[random.random((height, width)) < 0.01] = 0
        depth[:, : width // 3] *= 2
        views.append(FeatureView(color, depth, np.eye(4)))
    for most in (7, 5000):
        settings = PhotometricSettings(points=most)
        expected = host_part(views[0], views[1], camera, settings, shrink)
        part = CudaPhotometricPart(views[0], views[1], settings, shrink, 1)
        engine.align(engine.points(views[0].depth, POINTS, NOISE), native_target, np.eye(4), ALIGN, NOISE, part)
        assert part.textured == len(expected.points) and (most > 7 or part.textured == 7 or width < 36)
        reference = engine.greys.reference
        pixels = floats(engine, reference.pixels, expected.reference.pixels.size)
        if width // shrink % 2:
            assert np.abs(pixels - expected.reference.pixels.ravel()).max() < 1.2e-7
            continue
        assert np.array_equal(pixels, expected.reference.pixels.ravel())
        found = engine.greys.points
        assert np.array_equal(floats(engine, found.points, 3 * part.textured), expected.points.points.ravel())
        assert np.array_equal(floats(engine, found.intensity, part.textured), expected.points.intensity)


@pytest.fixture(scope="module")
def native_target(frames: list[Frame], native: CpuTrackingEngine) -> GicpTarget:
    context = NativeContext(1)
    surface = MeasuredSurface(TrackerSettings().target, context)
    return surface.add(native.points(frames[0].depth, PointSettings(), NOISE), truth_of(frames[0]))


@pytest.mark.parametrize("points", [300, 800, 5000])
def test_alignments_are_those_with_grey_values_of_the_host(
    engine: CudaTrackingEngine, frames: list[Frame], native_target: GicpTarget, points: int
) -> None:
    settings, guess = PhotometricSettings(points=points), truth_of(frames[2]) @ CLOSE
    view, earlier = view_of(frames[2]), view_of(frames[0])
    host = host_part(view, earlier, frames[0].camera, settings, 2)
    device = engine.greys.part(view, earlier, settings, 2, 200)
    assert device is not None
    one, two = (
        engine.align(engine.points(view.depth, POINTS, NOISE), native_target, guess, ALIGN, NOISE, part)
        for part in (host, device)
    )
    assert one.photometric_share > 0.3 and device.textured == len(host.points)
    for name in ("T_world_camera", "information", "cost", "photometric_residual", "photometric_share", "iterations"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name


def test_too_little_texture_is_none(
    engine: CudaTrackingEngine, frames: list[Frame], native_target: GicpTarget
) -> None:
    settings, guess = PhotometricSettings(points=800), truth_of(frames[2]) @ CLOSE
    view, earlier = view_of(frames[2]), view_of(frames[0])
    part = engine.greys.part(view, earlier, settings, 2, 801)
    assert part is not None and part.has_texture
    points = engine.points(view.depth, POINTS, NOISE)
    one, two = (engine.align(points, native_target, guess, ALIGN, NOISE, given) for given in (part, None))
    assert np.array_equal(one.T_world_camera, two.T_world_camera) and one.cost == two.cost
    assert one.photometric_share == two.photometric_share == 0
    assert not part.has_texture and engine.greys.part(view, earlier, settings, 2, 801) is None


def test_medians_are_those_of_what_is_read(
    engine: CudaTrackingEngine, frames: list[Frame], native_target: GicpTarget
) -> None:
    for count in (1500, 1100):
        points = engine.points(frames[2].depth, replace(POINTS, count=count), NOISE)
        points.expect_look()
        found = engine.align(points, native_target, truth_of(frames[2]), ALIGN, NOISE)
        told = found.matches.medians(points)
        assert told.count > 500 and told == found.matches.read().medians(points)


@pytest.mark.parametrize("mode", ["auto", "always"])
def test_a_tracker_goes_exactly_the_same_way(
    engine: CudaTrackingEngine, frames: list[Frame], cuda_library: CudaLibrary, mode: PhotometricMode
) -> None:
    """With grey values made on the device, or as before on the host."""

    class HostGreyEngine(CudaTrackingEngine):
        greys = None  # type: ignore[assignment]

        def __setattr__(self, name: str, value: object) -> None:
            if name != "greys":
                super().__setattr__(name, value)

    paths = []
    for chosen in (engine, HostGreyEngine(frames[0].camera, library=cuda_library)):
        settings = TrackerSettings(points=POINTS, align=ALIGN, photometric=PhotometricSettings(mode=mode, points=800))
        tracker = GicpTracker(frames[0].camera, settings, NativeContext(1), truth_of(frames[0]), chosen)
        surface = MeasuredSurface(settings.target, tracker.context)
        results = []
        for number, frame in enumerate(frames):
            results.append(tracker.track(frame))
            if number % 2 == 0:
                tracker.set_target(surface.add(results[-1].points, results[-1].T_world_camera))
        paths.append((results, tracker.noise))
    (found, noise), (expected, other_noise) = paths
    assert noise == other_noise
    assert all(np.array_equal(a.T_world_camera, b.T_world_camera) for a, b in zip(found, expected, strict=True))
    assert [result.status for result in found] == [result.status for result in expected]
