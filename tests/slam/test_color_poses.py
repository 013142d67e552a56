# SPDX-License-Identifier: Apache-2.0
"""Frames are aligned to the map by colour where depth errs more than its images show, and nowhere else."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.evaluation.trajectory import score_trajectory
from ggslam.mapping.settings import ViewAlignmentSettings
from ggslam.mapping.view_alignment import PosePrior, align_view, grey_of, misfit
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, se3_log
from ggslam.sequences import open_sequence
from ggslam.slam import color_poses
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.synthetic import write_synthetic_sequence
from ggslam.system.tuning import overridden
from ggslam.tracking.points import FramePoints
from ggslam.tracking.residual_noise import ResidualNoise, ResidualNoiseTuning
from ggslam.tracking.settings import DepthNoise

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
SETTINGS = ViewAlignmentSettings()
MOTION = se3_exp(np.array([0.012, -0.008, 0.01, 0.006, -0.004, 0.008]))


def corner(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey values and depth of two painted walls that meet 2.5 m in front of the first camera."""
    rays = CAMERA.rays().astype(float) @ T_world_camera[:3, :3].T
    origin, depth = T_world_camera[:3, 3], np.full((120, 160), np.inf)
    for normal in (np.array([0.6, 0.1, 0.8]), np.array([-0.6, 0.0, 0.8])):
        depth = np.minimum(depth, (2 - normal @ origin) / (rays @ normal))
    x, y, z = np.moveaxis(origin + rays * depth[..., None], -1, 0)
    grey = 0.5 + 0.2 * np.sin(9 * x + 5 * z) * np.cos(7 * y) + 0.2 * np.sin(4 * y + 3 * x)
    return grey.astype(np.float32), depth.astype(np.float32)


def error(T: np.ndarray | None) -> np.ndarray:
    """Of what `align_view` says of a camera that has moved by `MOTION`."""
    assert T is not None
    return np.abs(se3_log(T @ MOTION))


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 0.1)])
def test_a_view_is_laid_onto_the_map(gain: float, offset: float) -> None:
    rendered, depth = corner(np.eye(4))
    seen = gain * corner(MOTION)[0] + np.float32(offset)
    found = error(align_view(seen, rendered, depth, np.ones_like(depth), CAMERA, SETTINGS))
    assert found[:3].max() < 1e-3 and found[3:].max() < 5e-4  # of 12 mm and 8 mrad; a pixel is 8 mrad


def test_what_the_picture_leaves_open_the_depth_sensor_says() -> None:
    """A map drawn wrongly in patches pulls a camera aside that turns back: its image hardly changes."""
    rendered, depth = corner(np.eye(4))
    random, rows = np.random.default_rng(0), []
    for _ in range(16):
        moved = se3_exp(random.standard_normal(6) * np.repeat([2e-3, 1e-3], 3))
        patches = cv2.GaussianBlur(random.standard_normal(depth.shape).astype(np.float32), (0, 0), 1.5)
        seen = corner(moved)[0] + patches * np.float32(0.02 / patches.std())
        found = [
            align_view(seen, rendered, depth, np.ones_like(depth), CAMERA, SETTINGS, prior=prior)
            for prior in (PosePrior(2e-3, 1e-3), None)
        ]
        rows.append([float("nan") if T is None else np.linalg.norm((T @ moved)[:3, 3]) for T in (*found, np.eye(4))])
    both, picture, depth_sensor = np.sqrt(np.mean(np.square(rows), axis=0))
    assert both < 0.85 * depth_sensor and both < 0.3 * picture


def test_a_pose_that_is_right_fits_better() -> None:
    rendered, depth = corner(np.eye(4))
    seen, full = 0.7 * corner(MOTION)[0] + np.float32(0.1), np.ones_like(depth)
    at_start, at_truth = (
        misfit(seen, rendered, depth, full, CAMERA, SETTINGS, T) for T in (np.eye(4), inverse(MOTION))
    )
    assert at_truth < 0.2 * at_start
    assert np.isnan(misfit(seen, rendered, 0 * depth, full, CAMERA, SETTINGS, np.eye(4)))


def test_without_texture_or_map_there_is_no_pose() -> None:
    rendered, depth = corner(np.eye(4))
    full, blank = np.ones_like(depth), np.full_like(rendered, 0.5)
    assert align_view(rendered, blank, depth, full, CAMERA, SETTINGS) is None
    assert align_view(rendered, rendered, depth, 0 * full, CAMERA, SETTINGS) is None
    assert align_view(rendered, rendered, 0 * depth, full, CAMERA, SETTINGS) is None


def test_grey_values() -> None:
    color = np.random.default_rng(0).integers(0, 256, (5, 4, 3), dtype=np.uint8)
    expected = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY) / 255
    assert np.abs(grey_of(color) - expected).max() < 0.003
    assert np.allclose(grey_of(color.astype(np.float32) / 255), grey_of(color))


def test_hidden_noise_is_what_residuals_say_of_it() -> None:
    rng, noise, residuals = np.random.default_rng(0), DepthNoise(2.5e-4, 0.0), ResidualNoise()
    points = np.zeros((2000, 3), np.float32)
    points[:, 2] = 2
    frame = FramePoints(
        points, points, np.zeros((2000, 6), np.float32), np.zeros((2000, 2), np.int32), np.ones(2000, np.float32)
    )
    for _ in range(ResidualNoiseTuning.min_measurements):
        noise = residuals.observe(frame, (0.008 * rng.standard_normal(2000)) ** 2, noise)
    assert 28 < residuals.hidden < 36 and abs(noise.sigma(2) - 0.008) < 1e-3
    exact = ResidualNoise()
    for _ in range(ResidualNoiseTuning.min_measurements):
        exact.observe(frame, (0.0005 * rng.standard_normal(2000)) ** 2, DepthNoise(2.5e-4, 0.0))
    assert exact.hidden == 1


class Drift:
    """Depth times an error of 1 % that neighbours share, in the image and from frame to frame."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(1)
        self._knots = self._random.standard_normal((6, 8))

    def spoil(self, frame: Frame) -> Frame:
        """The frame with such depth."""
        field = cv2.resize(self._knots, frame.depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
        self._knots = 0.88 * self._knots + 0.47 * self._random.standard_normal(self._knots.shape)
        return dataclasses.replace(frame, depth=(frame.depth * (1 + 0.01 * field)).astype(np.float32))


def tracked(room: Path, *settings: str, drift: bool) -> tuple[Slam, float]:
    """A run over the room, and the root mean square of its trajectory's error, metres."""
    sequence, spoiled = open_sequence(room), Drift()
    slam = Slam(sequence.camera, load_config(None, ["masks.source=none", "refine_iterations=0", *settings]))
    truth = []
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        slam.step(spoiled.spoil(frame) if drift else frame)
        truth.append(sequence.ground_truth[index])  # type: ignore[index]
    slam.finish()
    scores = score_trajectory([slam.pose_of(f) for f in slam.frames], np.array(truth))
    assert scores is not None
    return slam, scores.ate_rmse_m


@pytest.mark.long("three runs over a small room")
def test_it_pays_where_depth_drifts(tmp_path: Path) -> None:
    room = write_synthetic_sequence(tmp_path / "exact", frames=24, width=160, height=120, noise=False)
    slam, error = tracked(room, drift=True)
    _, without = tracked(room, "mapping.view_alignment.enabled=false", drift=True)
    assert slam.tracker.state.residuals.hidden > 8
    assert error < 0.7 * without
    exact, _ = tracked(room, drift=False)
    assert not exact.color_poses._is_due
    assert len(exact.color_poses.images) <= color_poses.ColorPoseTuning.undecided_frames


@pytest.mark.long("two runs over a small room")
def test_keyframes_are_aligned_before_the_last_steps_where_depth_drifts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = write_synthetic_sequence(tmp_path / "exact", frames=24, width=160, height=120, noise=False)

    def error_of_keyframes(slam: Slam) -> float:
        truth = open_sequence(room).ground_truth
        assert truth is not None
        keyframes = slam.mapper.keyframes
        scores = score_trajectory(
            [k.T_world_camera for k in keyframes], np.array([truth[k.frame_index] for k in keyframes])
        )
        assert scores is not None
        return scores.ate_rmse_m

    aligned, _ = tracked(room, "refine_iterations=20", drift=True)
    monkeypatch.setattr(color_poses.ColorPoses, "align_keyframes", lambda self: None)
    without, _ = tracked(room, "refine_iterations=20", drift=True)
    assert error_of_keyframes(aligned) < 0.9 * error_of_keyframes(without)


@pytest.mark.long("three runs over a small room")
def test_at_the_end_frames_are_laid_onto_the_map_where_depth_is_noisy(tmp_path: Path) -> None:
    room = write_synthetic_sequence(tmp_path / "noisy", frames=24, width=160, height=120)
    slam, error = tracked(room, drift=False)
    tracked_only, without = tracked(room, "mapping.view_alignment.enabled=false", drift=False)
    assert not slam.color_poses._is_due
    assert error < 0.85 * without
    keyframes = {keyframe.frame_index for keyframe in slam.mapper.keyframes}
    assert [number for number, *_ in slam.color_poses.images] == [n for n in range(24) if n not in keyframes]
    with overridden(color_poses.ColorPoseTuning, kept_bytes=0):  # no memory for images: frames keep the tracker's poses
        stayed, error = tracked(room, drift=False)
    assert not stayed.color_poses.images and error == without
    for a, b in zip(stayed.frames, tracked_only.frames, strict=True):
        assert np.array_equal(a.T_keyframe_camera, b.T_keyframe_camera)


def test_what_hides_the_map_is_not_compared(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence, seen = open_sequence(room), []
    slam = Slam(sequence.camera, load_config(None, ["masks.source=none", "refine_iterations=0"]))
    slam.step(sequence.frame(0))
    frame = sequence.frame(1)
    moving = np.zeros(frame.depth.shape, bool)
    moving[40:60, 50:90] = True
    tracking = slam.track([slam.clean(frame)]).joint
    slam.poses.add(frame, tracking)
    slam.color_poses.note(dataclasses.replace(frame, moving=moving), tracking)
    monkeypatch.setattr(color_poses, "align_view", lambda _grey, _rendered, _depth, alpha, *_: seen.append(alpha))
    slam.tracker.state.residuals.hidden = 100
    slam.color_poses.align_last()
    margin = color_poses.ColorPoseTuning.hidden_margin_pixels // 2
    assert len(seen) == 1 and not seen[0][40 - margin : 60 + margin, 50 - margin : 90 + margin].any()
    assert (seen[0][: 40 - margin] > 0.5).mean() > 0.5


def test_the_end_may_be_interrupted_between_frames(room: Path) -> None:
    """What was aligned by then is forgotten: a run that goes on later aligns all of them from where they were."""
    sequence = open_sequence(room)
    slam = Slam(sequence.camera, load_config(None, ["masks.source=none", "refine_iterations=0"]))
    for index in range(8):
        slam.step(sequence.frame(index))
    before = list(slam.frames)

    def stop() -> None:
        raise KeyboardInterrupt

    with overridden(color_poses.ColorPoseTuning, report_every=2), pytest.raises(KeyboardInterrupt):
        slam.color_poses.align_last(stop)
    assert slam.frames == before
    slam.color_poses.align_last()
    moved = [a.T_keyframe_camera is not b.T_keyframe_camera for a, b in zip(slam.frames, before, strict=True)]
    assert any(moved)


def test_a_pose_that_contradicts_the_tracker_is_not_believed(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = open_sequence(room)
    slam = Slam(sequence.camera, load_config(None, ["masks.source=none", "refine_iterations=0"]))
    slam.step(sequence.frame(0))
    slam.tracker.state.residuals.hidden = 100
    for shift, believed in ((1e-3, True), (0.5, False)):
        moved = se3_exp(np.array([shift, 0, 0, 0, 0, 0]))
        monkeypatch.setattr(color_poses, "align_view", lambda *_, moved=moved: moved)
        frame = slam.clean(sequence.frame(1))
        before, align = [], slam.color_poses.align
        monkeypatch.setattr(slam.color_poses, "align", lambda f, r, a=align, b=before: (b.append(r), a(f, r))[1])
        found = slam.track([frame]).joint
        assert np.allclose(found.T_world_camera, before[-1].T_world_camera @ inverse(moved if believed else np.eye(4)))
        slam.tracker.state.motion.velocity = np.eye(4)


def test_a_pose_far_from_the_tracked_one_is_believed_if_it_fits_clearly_better(room: Path) -> None:
    sequence = open_sequence(room)
    slam = Slam(sequence.camera, load_config(None, ["masks.source=none", "refine_iterations=0"]))
    slam.step(sequence.frame(0))
    frame, truth = sequence.frame(0), slam.mapper.keyframes[0].T_world_camera
    depth = float(np.median(frame.depth[frame.depth > 0]))
    assert slam.tracker.state.noise is not None
    limit = SETTINGS.farthest_sigmas * slam.tracker.state.noise.sigma(depth)
    tracked = truth @ se3_exp(np.array([3 * limit, 0, 0, 0, 0, 0]))

    def found() -> np.ndarray | None:
        return slam.color_poses._pose(grey_of(frame.color), tracked, depth, None, SETTINGS)

    believed = found()
    assert believed is not None and np.linalg.norm((believed - truth)[:3, 3]) < 0.5 * limit
    with overridden(color_poses.ColorPoseTuning, convincing=0.0):
        assert found() is None
    with overridden(color_poses.ColorPoseTuning, farthest=1.5):
        assert found() is None


@pytest.mark.parametrize("trained", [False, True])
def test_a_map_trained_little_moves_keyframes_only_if_they_fit_better(
    room: Path, monkeypatch: pytest.MonkeyPatch, trained: bool
) -> None:
    sequence = open_sequence(room)
    few = ["masks.source=none", "identity.enabled=false", "mapping.first_frame_iterations=4", "keyframes.max_gap=1"]
    slam = Slam(sequence.camera, load_config(None, few))
    for index in range(3):
        slam.step(sequence.frame(index))
    keyframes, asked = slam.mapper.keyframes, []
    for keyframe in keyframes:
        keyframe.iterations = 20 if trained else 5
    slam.tracker.state.residuals.hidden = 1
    monkeypatch.setattr(slam.color_poses, "_pose", lambda *given: asked.append(given[-1]))
    slam.color_poses.align_keyframes()
    best = float("inf") if trained else color_poses.ColorPoseTuning.keyframe_better
    assert len(keyframes) > 1 and asked == [best] * (len(keyframes) - 1)  # the first one is the world


def test_a_pose_that_hardly_fits_better_may_be_refused(room: Path) -> None:
    sequence = open_sequence(room)
    slam = Slam(sequence.camera, load_config(None, ["masks.source=none", "refine_iterations=0"]))
    slam.step(sequence.frame(0))
    frame, truth = sequence.frame(0), slam.mapper.keyframes[0].T_world_camera
    depth, grey = float(np.median(frame.depth[frame.depth > 0])), grey_of(frame.color)
    aside = truth @ se3_exp(np.array([0.02, 0, 0, 0, 0, 0]))
    found = [slam.color_poses._pose(grey, T, depth, None, SETTINGS, better=0.97) for T in (truth, aside)]
    assert found[0] is None and found[1] is not None
    assert np.linalg.norm((found[1] - truth)[:3, 3]) < 0.01
    assert slam.color_poses._pose(grey, truth, depth, None, SETTINGS) is not None
