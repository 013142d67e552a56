# SPDX-License-Identifier: Apache-2.0
"""Films, single views and plans of a run, against the renderer's own pictures."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import ggslam
from ggslam.errors import ConfigError
from ggslam.jobs.render.film import as_seen_by, render_film
from ggslam.jobs.render.plan import find_plan, render_plan
from ggslam.jobs.render.recorded_path import recorded_shots
from ggslam.jobs.render.single_views import render_poses
from ggslam.reporting.pictures import color_to_uint8
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh


def frames_of(path: Path) -> list[np.ndarray]:
    video, found = cv2.VideoCapture(str(path)), []
    while True:
        there, picture = video.read()
        if not there:
            return found
        found.append(picture[..., ::-1])


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_a_film_shows_what_the_renderer_draws(room_run: RunFolder, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    render_film(room_run, tmp_path / "film.mp4", fps=30, size=(160, 120), smoothing=0,
                progress=lambda done, count: calls.append((done, count)))  # fmt: skip
    found, shots = frames_of(tmp_path / "film.mp4"), recorded_shots(room_run, 30, None, (160, 120), 0)
    assert len(found) == len(shots) == calls[-1][0] == calls[-1][1]
    gaussians, poses = room_run.gaussians(), room_run.keyframes().poses()
    for k in (0, 4, len(shots) - 1):
        with torch.no_grad():
            view = ggslam.render(gaussians, shots[k].camera, T_world_camera=poses[shots[k].frame or 0])
        drawn = color_to_uint8(view.image.numpy())
        assert decibels(found[k], drawn) > 30
        assert decibels(found[k], drawn) > decibels(found[k - 3], drawn) + 3


def test_side_by_side_shows_the_recorded_frame_of_the_moment(room_run: RunFolder, tmp_path: Path) -> None:
    render_film(room_run, tmp_path / "film.mp4", what=["color", "depth", "side-by-side"], size=(160, 120))
    found, recording = frames_of(tmp_path / "film.mp4"), open_recording_of(room_run)
    source, target = recording.camera, recorded_shots(room_run, 30, None, (160, 120))[0].camera
    assert found[0].shape == (120 * 2 + 4, 160 * 2 + 4, 3)
    for k in (0, 4, len(found) - 1):
        truth = as_seen_by(recording.frame(k).color, source, target)
        assert decibels(found[k][:120, :160], truth) > 28
        assert decibels(found[k][:120, 164:], truth) > 15  # the map, beside it


def test_what_does_not_go_together_is_told(room_run: RunFolder, tmp_path: Path) -> None:
    for options, problem in (
        ({"what": ["side-by-side"], "path": "orbit"}, "goes with `path` recorded"),
        ({"what": ["side-by-side", "alpha"]}, "goes with color and depth"),
        ({"what": ["colour"]}, "found 'colour'"), ({"path": "somewhere"}, "found no file 'somewhere'"),
        ({"fps": 1000}, "`fps`"), ({"seconds": -1}, "`seconds`"), ({"smoothing": -1}, "`smoothing`"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=problem):
            render_film(room_run, tmp_path / "film.mp4", **options)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_picture_from_another_camera_in_the_same_place() -> None:
    source, target = Camera(200, 150, 180.0, 180.0, 99.5, 74.5), Camera(90, 80, 120.0, 110.0, 40.0, 44.0)
    row, column = np.mgrid[:150, :200].astype(float)
    picture = np.stack([column, row, 0 * row], -1).astype(np.uint8)
    u, v = np.meshgrid((np.arange(90) - 40.0) / 120 * 180 + 99.5, (np.arange(80) - 44.0) / 110 * 180 + 74.5)
    seen = as_seen_by(picture, source, target).astype(float)
    assert np.abs(seen[..., 0] - u).max() < 1
    assert np.abs(seen[..., 1] - v).max() < 1


def test_views_from_any_pose(room_run: RunFolder, tmp_path: Path) -> None:
    pose = room_run.keyframes().poses()[7]
    files = render_poses(room_run, [pose, np.eye(4)], ["color", "depth"], tmp_path)
    assert [f.name for f in files] == [f"view{n:03d}_{kind}.png" for n in (0, 1) for kind in ("color", "depth")]
    with torch.no_grad():
        view = ggslam.render(room_run.gaussians(), room_run.sequence().camera, T_world_camera=pose)
    np.testing.assert_array_equal(cv2.imread(str(files[0]))[..., ::-1], color_to_uint8(view.image.numpy()))
    render_poses(room_run, [pose], ["color"], tmp_path / "one.png")
    assert (tmp_path / "one.png").read_bytes() == files[0].read_bytes()
    with pytest.raises(ConfigError, match="2 pictures need a folder"):
        render_poses(room_run, [pose], ["color", "depth"], tmp_path / "one.png")


def marked_floor() -> GaussianMap:
    """A grey floor y = 1, a red mark at (0.5, 1, 0.25), a blue one at (-1, 1, 2), and a ceiling that hides both."""
    x, z = np.meshgrid(np.arange(-2, 2.01, 0.05), np.arange(-1, 3.01, 0.05))
    floor = np.stack([x, 0 * x + 1, z], -1).reshape(-1, 3)
    rows = [(floor, 0.5), (floor - [0, 2.5, 0], 0.5)]
    points = np.concatenate([points for points, _ in rows] + [np.array([[0.5, 0.99, 0.25], [-1, 0.99, 2]])])
    colors = np.full((len(points), 3), 0.5)
    colors[-2:] = [[1, 0, 0], [0, 0, 1]]
    out, count = GaussianMap(0, 0), len(points)
    scales = np.log(np.tile([0.03, 0.002, 0.03], (count, 1)))
    out.insert(
        torch.tensor(points, dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.tensor(scales, dtype=torch.float32), torch.full((count,), 3.0), torch.zeros(count, 3),
        torch.zeros(count, 0),
    )  # fmt: skip
    out.sh[:, 0] = rgb_to_sh(torch.tensor(colors, dtype=torch.float32))
    return out


def test_a_plan_is_to_scale() -> None:
    gaussians = marked_floor()
    plan = find_plan(gaussians, np.eye(4)[None], 0.02, cut=1.5)
    assert plan.floor == pytest.approx(-1, abs=0.02)
    with torch.no_grad():
        image = ggslam.render(gaussians, plan.camera, T_world_camera=plan.T_world_camera).image.numpy()
    a, _, _, e, x, y = (float(line) for line in plan.world_file().split())
    for name, place in (("red", (0.5, 0.25)), ("blue", (-1.0, 2.0))):
        weight = np.maximum(image[0] - image[2] if name == "red" else image[2] - image[0], 0)
        weight = np.where(weight > 0.2, weight, 0)
        row, column = (float((weight * i).sum() / weight.sum()) for i in np.indices(weight.shape))
        assert (a * column + x, e * row + y) == pytest.approx(place, abs=0.004)
    moved = plan.T_plan_world() @ [-1.0, 0.99, 2.0, 1.0]
    assert moved[:3] == pytest.approx([-1, 2, 0], abs=0.03)


def test_plans_of_runs(room_run: RunFolder, tmp_path: Path) -> None:
    plan = render_plan(room_run, tmp_path / "plan.png", metre_per_pixel=0.02)
    picture = cv2.imread(str(tmp_path / "plan.png"))
    told = json.loads((tmp_path / "plan.json").read_text())
    assert picture.shape[:2] == (plan.camera.height, plan.camera.width) == (told["height"], told["width"])
    assert told["metre_per_pixel"] == 0.02
    assert (picture < 250).any(-1).mean() > 0.4
    assert (tmp_path / "plan.pgw").read_text() == plan.world_file()
    for options, problem in (({"metre_per_pixel": 0}, "metre_per_pixel"), ({"cut": -5}, "nothing of the map"),
                             ({"metre_per_pixel": 0.0001}, "at most")):  # fmt: skip
        with pytest.raises(ConfigError, match=problem):
            render_plan(room_run, tmp_path / "other.png", **options)
    with pytest.raises(ConfigError, match=r"\.png"):
        render_plan(room_run, tmp_path / "plan.jpg")
