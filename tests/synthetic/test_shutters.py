# SPDX-License-Identifier: Apache-2.0
"""Blur, rolling shutters and late depth of generated recordings, against views cast on their own."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp, separation
from ggslam.synthetic import RayCaster, Shutter, camera_path, furnished_room, write_synthetic_sequence
from ggslam.synthetic.exposure import ExposureTuning, poses_at

CAMERA = Camera(96, 72, 72.0, 72.0, 47.5, 35.5)


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(furnished_room(0), 0)


def path() -> np.ndarray:
    return camera_path(furnished_room(0), 30, "turns")


def test_poses_between_frames() -> None:
    step = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.2, 0.0]))
    poses = np.stack([np.eye(4), step, step @ step])
    found = poses_at(poses, 1, np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))
    np.testing.assert_allclose(found[[0, 2, 4]], poses, atol=1e-12)
    np.testing.assert_allclose(found[3, :3, 3], (poses[1, :3, 3] + poses[2, :3, 3]) / 2, atol=1e-12)
    assert abs(separation(poses[1], found[3])[1] - np.degrees(0.1)) < 1e-9
    np.testing.assert_allclose(poses_at(poses, 0, np.array([-0.5]))[0], poses[0], atol=1e-12)


def test_a_camera_that_stands_still_sees_the_same_through_every_shutter(caster: RayCaster) -> None:
    """The bands of a rolling shutter fit together."""
    poses = np.repeat(path()[:1], 3, 0)
    plain, shutter = caster.render(CAMERA, poses[1]), Shutter(0.5, 0.5, 0.2)
    color = shutter.color(lambda camera, T: caster.render(camera, T).color, CAMERA, poses, 1)
    depth = shutter.depth(lambda camera, T: caster.measure(camera, T)[0], CAMERA, poses, 1)
    np.testing.assert_allclose(depth, plain.depth, atol=1e-4)
    assert np.abs(color.astype(int) - plain.color).mean() < 0.2


def test_depth_is_late_and_rows_are_of_their_own_time(caster: RayCaster) -> None:
    poses, frame = path(), 12

    def seen(camera: Camera, T: np.ndarray) -> np.ndarray:
        return caster.measure(camera, T)[0]

    late = Shutter(depth_delay=0.3).depth(seen, CAMERA, poses, frame)
    np.testing.assert_allclose(late, seen(CAMERA, poses_at(poses, frame, np.array([0.3]))[0]), atol=1e-5)
    rolled = Shutter(rolling=0.6).depth(seen, CAMERA, poses, frame)
    first = seen(CAMERA, poses_at(poses, frame, np.array([0.6 * (0.5 / ExposureTuning.bands - 0.5)]))[0])
    np.testing.assert_allclose(rolled[: 72 // ExposureTuning.bands], first[: 72 // ExposureTuning.bands], atol=1e-4)


def test_blur_is_the_mean_of_the_exposure(caster: RayCaster) -> None:
    poses, frame = path(), 12
    blurred = Shutter(blur=0.8).color(lambda camera, T: caster.render(camera, T).color, CAMERA, poses, frame)
    sharp = caster.render(CAMERA, poses[frame]).color

    def sharpness(image: np.ndarray) -> float:
        return float(cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).var())

    assert sharpness(blurred) < 0.6 * sharpness(sharp)
    assert abs(blurred.mean() - sharp.mean()) < 2


def test_turns_are_as_fast_as_they_say_and_speed_multiplies_them() -> None:
    poses = camera_path(furnished_room(0), 180, "turns")
    turns = np.array([separation(a, b)[1] for a, b in zip(poses[:-1], poses[1:], strict=True)])
    assert 4.0 < turns.max() < 5.2 and turns.mean() < 2.6
    still = camera_path(furnished_room(0), 5, "still")
    assert (still == still[0]).all()


def test_a_recording_says_its_shutter_and_is_that_of_its_speed(tmp_path: Path) -> None:
    folder = write_synthetic_sequence(
        tmp_path / "fast", frames=4, width=64, height=48, speed=3, trajectory="turns", shutter=Shutter(0.4, 0.2, 0.1)
    )
    said = yaml.safe_load((folder / "camera.yaml").read_text())
    assert said["shutter"] == {"blur": 0.4, "rolling": 0.2, "depth_delay": 0.1}
    lines = [line.split() for line in (folder / "poses.txt").read_text().splitlines()[1:]]
    expected = camera_path(furnished_room(0), 12, "turns")[::3, :3, 3]
    np.testing.assert_allclose([[float(v) for v in line[1:4]] for line in lines], expected, atol=1e-8)


@pytest.mark.parametrize("numbers", [(1.5, 0, 0), (0, -0.1, 0), (0, 0, 0.5)])
def test_impossible_shutters(numbers: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="shutter: expected a blur"):
        Shutter(*numbers)
