# SPDX-License-Identifier: Apache-2.0
"""Where the camera of a film is, and when, on ways that are known exactly."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ggslam.errors import ConfigError
from ggslam.jobs.render.film import shots_along
from ggslam.jobs.render.key_path import key_shots, page_camera, page_fov, read_camera_keys, view_at
from ggslam.jobs.render.orbit_path import find_swing, orbit_shots
from ggslam.jobs.render.recorded_path import recorded_shots, smooth_poses
from ggslam.jobs.render.shots import fill_size, film_times, look_at_pose, parse_size
from ggslam.jobs.render.single_views import parse_pose
from ggslam.runs.folder import RunFolder
from ggslam.runs.records.annotations import CameraKeysRecord
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import turning_angle

UP = np.array([0.0, -1.0, 0.0])


def helix(times: np.ndarray) -> np.ndarray:
    """T_world_camera of a camera that turns at 0.5 rad/s and climbs at 0.2 m/s, [n, 4, 4]."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(0.5 * times, UP)).as_matrix()
    poses[:, :3, 3] = np.stack([np.sin(0.5 * times), -0.2 * times, np.cos(0.5 * times)], 1)
    return poses


def test_the_recorded_way_passes_through_its_poses(room_run: RunFolder) -> None:
    record, poses = room_run.keyframes(), room_run.keyframes().poses()
    first = record.frames[0].timestamp or 0.0
    shots = recorded_shots(room_run, fps=30.0, smoothing=0)
    assert len(shots) == len(poses)
    for shot, frame in zip(shots, record.frames, strict=True):
        assert shot.frame == frame.frame
        assert shot.time == pytest.approx((frame.timestamp or 0.0) - first, abs=1e-9)
        np.testing.assert_allclose(shot.T_world_camera, poses[frame.frame], atol=1e-9)
    for keyframe in record.keyframes:
        np.testing.assert_allclose(shots[keyframe.frame].T_world_camera, keyframe.T_world_camera, atol=1e-9)


def test_twice_as_slow_shows_each_frame_twice(room_run: RunFolder) -> None:
    shots = recorded_shots(room_run, fps=30.0, seconds=4.0, at_frames=True)
    poses = room_run.keyframes().poses()
    assert len(shots) == 120
    assert shots[-1].time == pytest.approx(119 / 30)
    assert [s.frame for s in shots] == sorted(s.frame for s in shots if s.frame is not None)
    assert {s.frame for s in shots} == set(poses)
    for shot in shots:
        np.testing.assert_array_equal(shot.T_world_camera, poses[shot.frame or 0])


def test_smoothing_calms_and_keeps_the_way() -> None:
    random = np.random.default_rng(0)
    times = np.arange(0, 6, 1 / 30)
    true = helix(times)
    shaken = true.copy()
    shaken[:, :3, 3] += 0.01 * random.standard_normal((len(times), 3))
    shaken[:, :3, :3] = (
        Rotation.from_rotvec(0.02 * random.standard_normal((len(times), 3))) * Rotation.from_matrix(true[:, :3, :3])
    ).as_matrix()
    inner = slice(30, -30)
    calm = smooth_poses(times, shaken, times, 0.25)
    far = np.linalg.norm(calm[inner, :3, 3] - true[inner, :3, 3], axis=1)
    turned = [turning_angle(a, b) for a, b in zip(calm[inner], true[inner], strict=True)]
    assert far.mean() < 0.012  # of 1.7 cm of trembling, 0.8 cm are the bend that is cut
    before = [turning_angle(a, b) for a, b in zip(shaken[inner], true[inner], strict=True)]
    assert np.mean(turned) < 0.3 * np.mean(before)
    np.testing.assert_allclose(smooth_poses(times, shaken, times, 0), shaken, atol=1e-9)
    steps = np.linalg.norm(np.diff(calm[inner, :3, 3], n=2, axis=0), axis=1)
    assert steps.mean() < 0.05 * np.linalg.norm(np.diff(shaken[inner, :3, 3], n=2, axis=0), axis=1).mean()


def test_between_poses_the_way_is_even() -> None:
    times = np.array([0.0, 1.0, 3.0])
    at = np.array([0.5, 2.0])
    found = smooth_poses(times, helix(times), at, 0)
    np.testing.assert_allclose(found[:, 1, 3], -0.2 * at)
    assert [turning_angle(T, np.eye(4)) for T in found] == pytest.approx(0.5 * at)


def test_times_of_a_film() -> None:
    shown, taken = film_times(2.0, 10.0, None)
    np.testing.assert_allclose(shown, np.arange(21) / 10)
    np.testing.assert_allclose(taken, shown)
    shown, taken = film_times(2.0, 10.0, 4.0)
    assert len(shown) == 40
    assert (shown[-1], taken[-1]) == (3.9, 2.0)
    for fps, seconds in ((0, 1), (10, 0), (10, float("nan")), (240, 1e6)):
        with pytest.raises(ConfigError):
            film_times(1.0, fps, seconds)


KEYS = CameraKeysRecord.model_validate({"fps": 10, "keys": [
    {"time": 1, "position": [0, 0, 0], "look_at": [0, 0, 2], "up": [0, -1, 0], "fov": 1.0},
    {"time": 2, "position": [1, 0, 0], "look_at": [0, 0, 2], "up": [0, -1, 0], "fov": 0.8},
    {"time": 4, "position": [1, 1, 0], "look_at": [0, 1, 3], "up": [1, -1, 0], "fov": 0.6},
    {"time": 5, "position": [3, 1, 0], "look_at": [2, 1, 3], "up": [0, -1, 0], "fov": 0.6}]})  # fmt: skip


def test_keys_are_met_at_their_times() -> None:
    shots = key_shots(KEYS, size=(320, 200))
    assert [shot.time for shot in shots] == pytest.approx([k / 10 for k in range(41)])
    for key in KEYS.keys:
        shot = shots[round(10 * (key.time - 1))]
        np.testing.assert_allclose(shot.T_world_camera, look_at_pose(key.position, key.look_at, key.up), atol=1e-9)
        assert key.fov is not None
        assert shot.camera == page_camera((320, 200), key.fov)
        assert page_fov(shot.camera) == pytest.approx(key.fov)
        half = np.arctan2(99.5 + 0.5, shot.camera.fy)
        assert 2 * half == pytest.approx(key.fov)


def test_between_keys_runs_a_centripetal_catmull_rom_curve() -> None:
    """Against the cubic Hermite form of the same curve (Yuksel, Schaefer and Keyser 2011)."""
    p = np.array([key.position for key in KEYS.keys], float)
    d = np.sqrt(np.linalg.norm(np.diff(p, axis=0), axis=1))
    start = d[1] * ((p[1] - p[0]) / d[0] - (p[2] - p[0]) / (d[0] + d[1]) + (p[2] - p[1]) / d[1])
    end = d[1] * ((p[2] - p[1]) / d[1] - (p[3] - p[1]) / (d[1] + d[2]) + (p[3] - p[2]) / d[2])
    for s in np.linspace(0, 1, 9):
        expected = ((2 * s**3 - 3 * s**2 + 1) * p[1] + (s**3 - 2 * s**2 + s) * start
                    + (-2 * s**3 + 3 * s**2) * p[2] + (s**3 - s**2) * end)  # fmt: skip
        found = view_at(KEYS, 2 + 2 * s, (320, 200))[0]
        np.testing.assert_allclose(found[:3, 3], expected, atol=1e-9)
    middle = view_at(KEYS, 3.0, (320, 200))
    up = np.array([np.sin(np.pi / 8), -np.cos(np.pi / 8), 0])  # half of the 45 degrees
    assert middle[0][:3, 0] @ up == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{}", "keys"), ("no", "invalid JSON"), ('{"keys": []}', "keys"), ('{"keys": [{"time": 0}]}', r"keys\[0\]"),
        ('{"keys": [{"time": 0, "position": [0, 0], "look_at": [0, 0, 1], "up": [0, 1, 0]}]}', r"keys\[0\]\.position"),
        ('{"keys": [{"time": NaN, "position": [0, 0, 0], "look_at": [0, 0, 1], "up": [0, 1, 0]}]}', "time"),
    ],
)  # fmt: skip
def test_damaged_keys_are_told(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "keys.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"keys\.json: no camera keys: .*{problem}") as told:
        read_camera_keys(tmp_path / "keys.json")
    assert "pydantic" not in str(told.value)


def test_keys_of_the_page_and_without_angles(room_run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no file"):
        shots_along(room_run, "keys", None, None, None)
    (tmp_path / "camera_keys.json").write_text(
        json.dumps({"keys": [{**key.model_dump(), "fov": None} for key in KEYS.keys]})
    )
    shots = shots_along(room_run, tmp_path / "camera_keys.json", None, None, (320, 240))
    assert len(shots) == 121  # 4 s at 30 pictures a second, the page's
    camera = room_run.sequence().camera
    assert shots[0].camera.fy / 240 == pytest.approx(camera.fy / camera.height, rel=1e-6)


def test_keys_in_a_list_and_in_disorder(tmp_path: Path) -> None:
    rows = [key.model_dump() for key in KEYS.keys]
    (tmp_path / "keys.json").write_text(json.dumps(rows))
    assert read_camera_keys(tmp_path / "keys.json").keys == KEYS.keys
    (tmp_path / "keys.json").write_text(json.dumps(rows[::-1]))
    with pytest.raises(ConfigError, match="must rise"):
        read_camera_keys(tmp_path / "keys.json")


def test_poses_in_words() -> None:
    T = look_at_pose(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 7.0]), UP)
    np.testing.assert_allclose(parse_pose("1 2 3 0 0 0 1"), T, atol=1e-12)
    np.testing.assert_allclose(parse_pose("from 1,2,3 at 1,2,7"), T, atol=1e-12)
    turned = parse_pose("0 0 0 0 0.70710678 0 0.70710678")  # a quarter turn about y
    np.testing.assert_allclose(turned[:3, 2], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(parse_pose("from 0 0 0 at 0 5 0 up 0 0 1")[:3, :3].T @ [0, 0, 1], [0, -1, 0], atol=1e-9)
    for text in ("", "1 2 3", "1 2 3 0 0 0 9", "from 0 0 0 at 0 0 0", "from 0 0 0 at 1 0 nan", "from 0 0 0 to 1 2 3"):
        with pytest.raises(ConfigError):
            parse_pose(text)


@pytest.mark.parametrize("size", [(1280, 720), (300, 400), (64, 48)])
def test_another_shape_shows_nothing_new(size: tuple[int, int]) -> None:
    camera = Camera(640, 480, 500.0, 510.0, 310.0, 245.0)
    other = fill_size(camera, size)
    assert (other.width, other.height) == size
    assert other.fy / other.fx == pytest.approx(510 / 500, rel=0.02)
    u, v = (
        f * (np.array([-0.5, side - 0.5]) - c) / own + middle  # the outer edges of the picture
        for f, side, c, own, middle in (
            (500, size[0], other.cx, other.fx, 310), (510, size[1], other.cy, other.fy, 245),
        )  # fmt: skip
    )
    assert u.min() > -0.501
    assert u.max() < 639.501
    assert v.min() > -0.501
    assert v.max() < 479.501
    assert (u.max() - u.min() > 635) or (v.max() - v.min() > 475)


def test_sizes() -> None:
    assert parse_size("1280x720") == (1280, 720)
    for text in ("1280", "0x5", "axb", "20x90000", "1280x720x3"):
        with pytest.raises(ConfigError, match="WIDTHxHEIGHT"):
            parse_size(text)


def ring(radius: float, inward: bool, degrees: float = 360.0) -> np.ndarray:
    """Cameras 1.5 m over the floor y = 0 on an arc about (2, 0, 1), which look at its middle or away from it."""
    poses = []
    for angle in np.radians(np.linspace(0, degrees, 60)):
        place = np.array([2 + radius * np.sin(angle), -1.5, 1 + radius * np.cos(angle)])
        middle = np.array([2.0, -1.0, 1.0])
        target = middle if inward else 2 * place - middle
        poses.append(look_at_pose(place, target, UP))
    return np.stack(poses)


@pytest.mark.parametrize(("inward", "degrees"), [(True, 360.0), (False, 360.0), (True, 120.0), (False, 100.0)])
def test_an_orbit_stays_where_the_cameras_were(inward: bool, degrees: float) -> None:
    poses = ring(1.2, inward, degrees)
    swing = find_swing(GaussianMap(0, 0), poses)
    seen = [swing.pose(k / 90) for k in range(90)]
    assert swing.inward is inward
    for T in seen:
        assert abs(T[1, 3] + 1.5) < 0.15  # their height
        assert np.linalg.norm(poses[:, :3, 3] - T[:3, 3], axis=1).min() < (0.13 if inward else 1.3)
        # Some camera looked nearly that way.
        assert (poses[:, :3, 2] @ T[:3, 2]).max() > np.cos(np.radians(12))
    steps = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(seen, [*seen[1:], seen[0]], strict=True)]
    assert max(steps) < 0.2
    turned = np.degrees(np.ptp(np.unwrap([np.arctan2(T[0, 2], T[2, 2]) for T in seen])))
    assert turned == pytest.approx(356 if degrees == 360 else 0.9 * degrees, abs=3)


def test_orbits_of_a_run_begin_where_they_end(room_run: RunFolder) -> None:
    shots = orbit_shots(room_run, 10.0, 3.0, (160, 90))
    assert len(shots) == 30
    assert shots[0].camera.width == 160
    first, last = shots[0].T_world_camera, shots[-1].T_world_camera
    assert np.linalg.norm(first[:3, 3] - last[:3, 3]) < 0.05
