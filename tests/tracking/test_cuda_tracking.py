# SPDX-License-Identifier: Apache-2.0
"""Points and alignments by the CUDA kernels, held against those of the compiled core."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.features.orb import FeatureView
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.tracking.cuda.engine import CudaTrackingEngine
from ggslam.tracking.engine import CpuTrackingEngine
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, PhotometricPart
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.photometric import GreyDepth, PhotometricReference, textured_points
from ggslam.tracking.points import PointSource
from ggslam.tracking.settings import (
    AlignSettings,
    DepthNoise,
    PhotometricMode,
    PhotometricSettings,
    PointSettings,
    TrackerSettings,
)
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

NOISE = DepthNoise()
POINTS = PointSettings(count=1500)
SETTINGS = AlignSettings(coarse_points=500)
GUESSES = [
    np.zeros(6),
    np.array([0.02, -0.01, 0.015, 0.01, -0.02, 0.005]),
    np.array([-0.05, 0.04, 0.03, -0.03, 0.02, 0.06]),
]


def truth_of(frame: Frame) -> np.ndarray:
    assert frame.T_world_camera is not None
    return frame.T_world_camera


def check_points(source: PointSource, expected_source: PointSource) -> None:
    """The same points in the same order, but for a few on the edge of having enough neighbours."""
    found, expected = source.read(), expected_source.read()
    pixels, other = ([tuple(p) for p in points.pixels.tolist()] for points in (found, expected))
    assert pixels == sorted(pixels, key=lambda p: (p[1], p[0]))
    both = set(pixels) & set(other)
    assert len(both) >= 0.998 * max(len(pixels), len(other))
    mine, theirs = ([p in both for p in points] for points in (pixels, other))
    for name in ("points", "normals", "covariances", "weights"):
        one, two = getattr(found, name)[mine], getattr(expected, name)[theirs]
        assert one.dtype == np.float32 and one.shape == two.shape
        # Where two variances of a neighbourhood are nearly the same, rounding turns its axes.
        assert (~np.isclose(one, two, rtol=1e-5, atol=1e-5)).sum() <= 0.005 * one.size, name
        assert np.allclose(one, two, atol=1e-3), name


@pytest.mark.parametrize("settings", [POINTS, PointSettings(), PointSettings(count=300, window=1, max_depth=2.5)])
def test_points_are_those_of_the_core(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], settings: PointSettings
) -> None:
    for frame in frames[:2]:
        found, expected = (e.points(frame.depth, settings, NOISE) for e in (engine, native))
        assert len(found) == pytest.approx(len(expected), abs=2)
        assert found.median_depth == pytest.approx(expected.median_depth, rel=1e-5)
        check_points(found, expected)


@pytest.mark.parametrize("kept", [0, 1, 2, 7])
def test_few_points_and_none(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, target: GicpTarget, kept: int
) -> None:
    depth = np.zeros((120, 160), np.float32)
    depth[40:47, 40 : 40 + 7 * kept] = np.linspace(1.0, 1.2, 7 * kept, dtype=np.float32)
    settings = PointSettings(count=50)
    found, expected = (e.points(depth, settings, NOISE) for e in (engine, native))
    aligned, other = (e.align(p, target, np.eye(4), SETTINGS, NOISE) for e, p in ((engine, found), (native, expected)))
    assert len(found) == len(expected) and found.median_depth == pytest.approx(expected.median_depth)
    check_points(found, expected)
    assert aligned.status is other.status is AlignmentStatus.LOST
    assert np.isfinite(aligned.T_world_camera).all() and np.isfinite(aligned.information).all()
    assert aligned.matches.read().voxels.shape == (len(expected),)


def test_a_depth_image_of_another_camera_is_refused(engine: CudaTrackingEngine) -> None:
    with pytest.raises(ValueError, match="expected"):
        engine.points(np.ones((10, 10), np.float32), POINTS, NOISE)


def check_alignment(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, depth: np.ndarray, target: GicpTarget, guess: np.ndarray,
    settings: AlignSettings = SETTINGS, photometric: PhotometricPart | None = None,
) -> AlignmentStatus:  # fmt: skip
    found, expected = (
        e.align(e.points(depth, POINTS, NOISE), target, guess, settings, NOISE, photometric) for e in (engine, native)
    )
    assert np.abs(se3_log(inverse(expected.T_world_camera) @ found.T_world_camera)).max() < 1e-5
    assert found.status is expected.status and found.converged == expected.converged
    assert abs(found.iterations - expected.iterations) <= 1
    assert found.overlap == pytest.approx(expected.overlap, abs=2e-3)
    for name in ("rmse", "cost", "photometric_residual", "photometric_share"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-3), name
    for name in ("information", "camera_information", "visibility"):
        one, two = getattr(found, name), getattr(expected, name)
        assert np.allclose(one, two, rtol=2e-3, atol=2e-3 * np.abs(two).max()), name
    assert len(found.weak_directions) == len(expected.weak_directions)
    mine, theirs = found.matches.read(), expected.matches.read()
    assert mine.voxels.dtype == np.int32
    same = mine.voxels == theirs.voxels
    assert same.mean() > 0.99
    assert np.allclose(mine.squared_distances[same], theirs.squared_distances[same], rtol=1e-2, atol=1e-8)
    return found.status


@pytest.mark.parametrize("number", range(len(GUESSES)))
def test_alignments_are_those_of_the_core(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget, number: int
) -> None:
    guess = truth_of(frames[2]) @ se3_exp(GUESSES[number])
    status = check_alignment(engine, native, frames[2].depth, target, guess)
    assert status is AlignmentStatus.OK


@pytest.mark.parametrize(
    "change", [{"coarse_iterations": 0}, {"fine_iterations": 1}, {"coarse_points": 100}, {"min_normal_dot": -1.0}]
)
def test_every_setting_means_the_same(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget,
    change: dict[str, float],
) -> None:  # fmt: skip
    guess = truth_of(frames[2]) @ se3_exp(GUESSES[1])
    check_alignment(engine, native, frames[2].depth, target, guess, replace(SETTINGS, **change))


def test_a_wall_leaves_directions_open(engine: CudaTrackingEngine, native: CpuTrackingEngine) -> None:
    wall = np.full((120, 160), 2.0, np.float32)
    surface = MeasuredSurface(TrackerSettings().target, native.context)
    target = surface.add(native.points(wall, PointSettings(), NOISE), np.eye(4))
    guess = se3_exp(np.array([0.0, 0.0, 0.03, 0.01, 0.02, 0.0]))
    found, expected = (e.align(e.points(wall, POINTS, NOISE), target, guess, SETTINGS, NOISE) for e in (engine, native))
    assert found.status is expected.status is AlignmentStatus.DEGENERATE
    assert found.weak_directions.shape == expected.weak_directions.shape == (3, 6)
    spanned = [result.weak_directions.T @ result.weak_directions for result in (found, expected)]
    assert np.allclose(*spanned, atol=1e-2)  # the space that they span; which axes it has is left to rounding


def test_far_away_the_frame_is_lost(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget
) -> None:
    away = se3_exp(np.array([20.0, 0, 0, 0, 0, 0]))
    assert check_alignment(engine, native, frames[2].depth, target, away) is AlignmentStatus.LOST


def test_an_empty_target_matches_nothing(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame]
) -> None:
    nothing = tuple(np.zeros((0, width), np.float32) for width in (3, 4, 3)) + (np.zeros(0, np.float32),)
    target = GicpTarget.from_arrays(*nothing, TrackerSettings().target, native.context)
    found = engine.align(engine.points(frames[0].depth, POINTS, NOISE), target, np.eye(4), SETTINGS, NOISE)
    assert found.status is AlignmentStatus.LOST and found.overlap == 0
    assert (found.matches.read().voxels == -1).all() and np.isinf(found.matches.read().squared_distances).all()
    assert np.array_equal(found.T_world_camera, np.eye(4))


def test_threads_wait_for_one_another(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget, other_order: None
) -> None:
    part = grey_part(frames[2], frames[0], PhotometricSettings(points=800))
    check_points(*(e.points(frames[2].depth, POINTS, NOISE) for e in (engine, native)))
    check_alignment(engine, native, frames[2].depth, target, truth_of(frames[2]), photometric=part)


def test_results_repeat_bit_for_bit(engine: CudaTrackingEngine, frames: list[Frame], target: GicpTarget) -> None:
    guess = truth_of(frames[2]) @ se3_exp(GUESSES[1])
    results = [
        engine.align(engine.points(frames[2].depth, POINTS, NOISE), target, guess, SETTINGS, NOISE) for _ in range(2)
    ]
    one, two = results
    assert np.array_equal(one.T_world_camera, two.T_world_camera)
    assert np.array_equal(one.information, two.information)
    assert np.array_equal(one.matches.read().voxels, two.matches.read().voxels)


def test_targets_take_turns(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget
) -> None:
    surface = MeasuredSurface(replace(TrackerSettings().target, voxel=0.05), native.context)
    other = surface.add(native.points(frames[3].depth, PointSettings(), NOISE), truth_of(frames[3]))
    for aim in (target, other, target):
        check_alignment(engine, native, frames[2].depth, aim, truth_of(frames[2]))


@pytest.mark.parametrize("change", [{}, {"neighbour_weight": 0.0}, {"scatter_weight": 0.0, "max_elongation": 2.0}])
def test_voxels_take_shape_on_the_device_as_in_the_core(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], change: dict[str, float]
) -> None:
    settings = replace(TrackerSettings().target, **change)
    targets = []
    for finish in (False, True):
        surface = MeasuredSurface(settings, native.context)
        surface.finish = finish
        for frame in (frames[0], frames[4]):
            aim = surface.add(native.points(frame.depth, PointSettings(), NOISE), truth_of(frame))
        targets.append(aim)
    raw, ready = targets
    assert len(raw) == len(ready)
    points, guess = engine.points(frames[2].depth, POINTS, NOISE), truth_of(frames[2]) @ se3_exp(GUESSES[1])
    found, expected = (engine.align(points, aim, guess, SETTINGS, NOISE) for aim in targets)
    assert raw.settings_to_finish is not None  # the core was not asked
    assert np.abs(se3_log(inverse(expected.T_world_camera) @ found.T_world_camera)).max() < 1e-5
    assert found.cost == pytest.approx(expected.cost, rel=1e-3) and found.status is expected.status
    assert (found.matches.read().voxels == expected.matches.read().voxels).mean() > 0.99
    one, two = raw.voxels(), ready.voxels()  # now it is
    assert raw.settings_to_finish is None and all(np.array_equal(one[name], two[name]) for name in two)


def grey_part(view: Frame, reference: Frame, settings: PhotometricSettings) -> PhotometricPart:
    small, earlier = (GreyDepth.from_images(f.color, f.depth, f.camera, 2) for f in (view, reference))
    return PhotometricPart(
        textured_points(small, settings), PhotometricReference.from_view(earlier, truth_of(reference)), settings
    )


@pytest.mark.parametrize("number", range(len(GUESSES)))
def test_grey_values_pull_as_they_do_in_the_core(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget, number: int
) -> None:
    part = grey_part(frames[2], frames[0], PhotometricSettings(points=800))
    assert len(part.points) > 200
    guess = truth_of(frames[2]) @ se3_exp(GUESSES[number])
    check_alignment(engine, native, frames[2].depth, target, guess, photometric=part)
    weighty = replace(part, settings=replace(part.settings, weight=5.0))
    check_alignment(engine, native, frames[2].depth, target, guess, photometric=weighty)


def test_what_hides_a_point_in_the_reference_counts_as_in_the_core(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget
) -> None:
    part = grey_part(frames[2], frames[0], PhotometricSettings(points=800))
    pixels = part.reference.pixels.copy()
    pixels[:, :40, 3] *= 0.5
    hidden = replace(part, reference=replace(part.reference, pixels=pixels))
    points, guess = engine.points(frames[2].depth, POINTS, NOISE), truth_of(frames[2])
    shares = [engine.align(points, target, guess, SETTINGS, NOISE, p).photometric_share for p in (part, hidden)]
    assert shares[1] < 0.8 * shares[0]
    check_alignment(engine, native, frames[2].depth, target, guess, photometric=hidden)


def track(tracker: GicpTracker, frames: list[Frame]) -> list[TrackingResult]:
    """Tracks the frames; each is a keyframe."""
    surface, results = MeasuredSurface(tracker.settings.target, tracker.context), []
    for frame in frames:
        results.append(tracker.track(frame))
        tracker.set_target(surface.add(results[-1].points, results[-1].T_world_camera))
    return results


def tracker_settings(mode: PhotometricMode) -> TrackerSettings:
    return TrackerSettings(points=POINTS, align=SETTINGS, photometric=PhotometricSettings(mode=mode, points=800))


@pytest.mark.skipif("GGSLAM_SANITIZER" in os.environ, reason="a sanitizer's compiler changes the order of sums")
@pytest.mark.parametrize("mode", ["never", "auto", "always"])
def test_a_tracker_goes_the_same_way_with_either_engine(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], mode: PhotometricMode
) -> None:
    found, expected = (
        track(GicpTracker(frames[0].camera, tracker_settings(mode), native.context, truth_of(frames[0]), e), frames)
        for e in (engine, None)
    )
    for one, two in zip(found, expected, strict=True):
        assert one.status is two.status and one.reason == two.reason
        assert np.abs(se3_log(inverse(two.T_world_camera) @ one.T_world_camera)).max() < 1e-4
        assert one.overlap == pytest.approx(two.overlap, abs=2e-3)
    assert {result.status for result in found[2:]} == {TrackingStatus.OK}


@pytest.mark.parametrize("mode", ["never", "always"])
def test_the_host_waits_once_for_a_frame(
    engine: CudaTrackingEngine, frames: list[Frame], mode: PhotometricMode, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = []

    def call(library: CudaLibrary, name: str, *arguments: object, call: Any = CudaLibrary.call) -> None:
        waits.extend(["result"] if name.endswith("_wait") else [])
        call(library, name, *arguments)

    monkeypatch.setattr(CudaLibrary, "call", call)
    cpu = torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: waits.append("tensor") or cpu(self))
    settings = tracker_settings(mode)
    tracker = GicpTracker(frames[0].camera, settings, NativeContext(1), truth_of(frames[0]), engine)
    surface, expected = MeasuredSurface(settings.target, tracker.context), []
    for frame in frames[:5]:
        result = tracker.track(frame)
        expected.append(len(waits))
        tracker.set_target(surface.add(result.points, result.T_world_camera))  # a keyframe's points are fetched
        waits.clear()
    assert expected[2:] == [1, 1, 1]


def test_the_mode_goes_with_the_median_depth_of_the_frame_itself(
    engine: CudaTrackingEngine, native: CpuTrackingEngine
) -> None:
    """Although the device tells it only with the alignment."""

    class Watching(GicpTracker):
        def _locate_by(
            self, mode: PhotometricMode, view: FeatureView, points: PointSource, target: GicpTarget
        ) -> tuple[AlignmentResult, str]:
            modes.append((len(depths), mode))
            return super()._locate_by(mode, view, points, target)

    camera, color = Camera(160, 120, 120.0, 120.0, 79.5, 59.5), np.zeros((120, 160, 3), np.uint8)
    for given in (engine, None):
        modes: list[tuple[int, str]] = []
        depths: list[float] = []
        settings = TrackerSettings(noise=DepthNoise(0.0001, 0.0004), points=POINTS)  # 1 mm at 1.5 m
        tracker = Watching(camera, settings, native.context, None, given)
        for z in (1.0, 1.0, 2.0, 2.0, 1.0):
            depth = np.full((120, 160), z, np.float32)
            tracker.track(Frame(0, 0, 0.0, color, depth, camera))
            wall = native.points(depth, POINTS, NOISE)
            tracker.set_target(MeasuredSurface(settings.target, native.context).add(wall, np.eye(4)))
            depths.append(z)
        decided = dict(modes)
        assert decided == {1: "degenerate", 2: "always", 3: "always", 4: "degenerate"}
        assert len(modes) == (6 if given is engine else 4)


def test_what_is_not_asked_for_is_not_fetched(
    engine: CudaTrackingEngine, frames: list[Frame], target: GicpTarget, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched: list[int] = []
    monkeypatch.setattr(torch.Tensor, "cpu", lambda tensor: fetched.append(tensor.numel()) or tensor.to("cpu"))
    points = engine.points(frames[2].depth, POINTS, NOISE)
    found = engine.align(points, target, truth_of(frames[2]), SETTINGS, NOISE)
    assert len(points) > 1000 and 0.5 < points.median_depth < 5 and found.overlap > 0.5
    assert not fetched
    read = points.read()
    assert len(read.normals) == len(points.read().weights) == len(points) and len(fetched) == 1
    matches = found.matches.read()
    assert len(matches.voxels) == len(matches.squared_distances) == len(points) and len(fetched) == 2
    moved = replace(found, T_world_camera=np.eye(4))
    assert np.array_equal(moved.matches.read().voxels, matches.voxels) and len(fetched) == 2


def test_points_that_were_not_asked_for_outlive_the_next_depth_image(
    engine: CudaTrackingEngine, native: CpuTrackingEngine, frames: list[Frame], target: GicpTarget
) -> None:
    first, second = (engine.points(frames[k].depth, POINTS, NOISE) for k in (2, 3))
    one, two = (native.points(frames[k].depth, POINTS, NOISE) for k in (2, 3))
    check_points(first, one)
    check_points(second, two)
    found, expected = (
        e.align(p, target, truth_of(frames[2]), SETTINGS, NOISE) for e, p in ((engine, first), (native, one))
    )
    assert np.abs(se3_log(inverse(expected.T_world_camera) @ found.T_world_camera)).max() < 1e-5
    with pytest.raises(TypeError, match="on the device"):
        engine.align(one, target, np.eye(4), SETTINGS, NOISE)
