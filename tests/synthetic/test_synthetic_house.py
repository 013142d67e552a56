# SPDX-License-Identifier: Apache-2.0
"""The generated house: a true loop, a smooth and free way, whole walls, rooms that differ; and the room as ever."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.synthetic import (
    SCENES,
    RayCaster,
    Scene,
    SceneBuilder,
    camera_path,
    scenes,
    write_synthetic_sequence,
)
from ggslam.synthetic.houses.house import ring_of_rooms
from ggslam.synthetic.lighting import LightingTuning
from ggslam.synthetic.materials import MaterialMaker
from ggslam.synthetic.sensor import SensorTuning, disparity_distortion, noisy_depth
from ggslam.system.tuning import overridden

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
FRAMES = 480
PLAIN = MaterialMaker(np.random.default_rng(0)).plain((0.5, 0.5, 0.5))


@pytest.fixture(scope="module")
def house() -> Scene:
    return ring_of_rooms(0)


@pytest.fixture(scope="module")
def caster(house: Scene) -> RayCaster:
    return RayCaster(house)


@pytest.fixture(scope="module")
def poses(house: Scene) -> np.ndarray:
    return camera_path(house, FRAMES, "route")


@pytest.fixture
def quick_light(monkeypatch: pytest.MonkeyPatch, house: Scene) -> Iterator[None]:
    """A few patches a face instead of thousands, and the house that is there already."""
    monkeypatch.setitem(scenes.SCENES, "loop", replace(SCENES["loop"], build=lambda seed, frames: house))
    with overridden(LightingTuning, max_patches=2):
        yield


def agreement(caster: RayCaster, T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    """Share of the pixels of view a that view b sees, too (same surface, within 3 %); how many of these have the same
    instance."""
    depth, mask = caster.measure(CAMERA, T_a)
    other_depth, other_mask = caster.measure(CAMERA, T_b)
    T = inverse(T_b) @ T_a
    points = CAMERA.back_project(depth).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    front = points[:, 2] > 0.05
    u = np.rint(CAMERA.fx * points[front, 0] / points[front, 2] + CAMERA.cx).astype(int)
    v = np.rint(CAMERA.fy * points[front, 1] / points[front, 2] + CAMERA.cy).astype(int)
    inside = (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)
    seen, z = other_depth[v[inside], u[inside]], points[front, 2][inside]
    same = np.abs(seen - z) < 0.03 * z
    alike = other_mask[v[inside], u[inside]] == mask.ravel()[front][inside]
    return float(same.sum() / depth.size), float(alike[same].mean()) if same.any() else 0.0


def test_the_end_sees_what_the_beginning_saw(caster: RayCaster, poses: np.ndarray) -> None:
    again = [i for i in range(300, FRAMES) if np.linalg.norm(poses[i, :3, 3] - poses[0, :3, 3]) < 0.1]
    first = again[0]
    assert FRAMES - first >= 40
    for i in range(0, FRAMES - first, 8):
        share, alike = agreement(caster, poses[first + i], poses[i])
        assert share > 0.6 and alike > 0.95
    assert np.linalg.norm(poses[first:, :3, 3] - poses[: FRAMES - first, :3, 3], axis=1).max() > 0.02  # not a replay
    for i in range(100, 360, 20):
        assert agreement(caster, poses[i], poses[0])[0] < 0.05  # in between it saw other things
    wide = poses[:, :2, 3].max(0) - poses[:, :2, 3].min(0)
    assert wide.min() > 6 and wide.max() > 9


def test_the_way_is_long_smooth_and_free(house: Scene, caster: RayCaster, poses: np.ndarray) -> None:
    motion = inverse(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(motion[:, :3, 3], axis=1)
    cosine = (np.trace(motion[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert 25 < step.sum() < 40
    assert step.min() > 0.02 and step.max() < 0.11 and 0.05 < np.median(step) < 0.10
    assert turn.max() < 4 and turn.mean() > 1
    assert np.linalg.norm(np.diff(poses[:, :3, 3], 2, axis=0), axis=1).max() < 0.02
    assert np.abs(np.diff(turn)).max() < 1.2
    assert min(shape.distance(poses[:, :3, 3]).min() for shape in house.shapes) > 0.25
    assert min(caster.measure(CAMERA, poses[i])[0].min() for i in range(0, FRAMES, 12)) > 0.25


def test_walls_are_whole_and_masks_name_everything(house: Scene, caster: RayCaster, poses: np.ndarray) -> None:
    seen: list[set[int]] = []
    for i in range(0, FRAMES, 12):
        depth, mask = caster.measure(CAMERA, poses[i])
        assert (depth > 0).all() and depth.max() < 15  # no ray leaves the house
        seen.append(set(np.unique(mask).tolist()))
        share, alike = agreement(caster, poses[i], poses[min(i + 4, FRAMES - 1)])
        assert share > 0.5 and alike > 0.95
    assert set.union(*seen) <= set(house.instance_names)
    assert len(set.union(*seen)) > 80
    rooms = [seen[i // 12] for i in (12, 132, 216, 336)]  # within the four rooms
    for i, room in enumerate(rooms):
        others = set.union(*rooms[:i], *rooms[i + 1 :])
        assert len(room - others) >= 6


def test_the_seed_decides(house: Scene, poses: np.ndarray) -> None:
    assert (camera_path(house, FRAMES, "route") == poses).all()
    other = camera_path(house, FRAMES, "route", seed=1)
    assert 0.005 < np.abs(other[:, :3, 3] - poses[:, :3, 3]).max() < 0.2


def test_a_route_that_cannot_be_gone() -> None:
    b = SceneBuilder()
    b.instance("floor").box((0, 0, -0.05), (4, 4, 0.1), PLAIN)
    with pytest.raises(SequenceError, match="no route"):
        camera_path(b.scene, 10, "route")
    b.scene.route = np.array([[0, 0, 1, 0, 0], [1, 0, 0.2, 90, 0], [1, 1, 1, 180, 0], [0, 1, 1, 270, 0]], float)
    with pytest.raises(SequenceError, match="nearer than 0.3 m"):
        camera_path(b.scene, 10, "route")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long("two recordings are drawn")
def test_a_written_loop_repeats(quick_light: None, caster: RayCaster, house: Scene, tmp_path: Path) -> None:
    options = ["--frames", "3", "--width", "80", "--height", "60"]
    result = CliRunner().invoke(app, ["synth", str(tmp_path / "a"), "--scene", "loop", *options])
    assert result.exception is None, result.output
    sequence = open_sequence(tmp_path / "a")
    assert len(sequence) == 3 and sequence.has_masks and sequence.instance_names == house.instance_names
    assert sequence.timestamps[1] == pytest.approx(0.1)
    write_synthetic_sequence(tmp_path / "b", frames=3, width=80, height=60, scene="loop")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    write_synthetic_sequence(tmp_path / "c", frames=3, width=80, height=60, scene="loop", noise=False)
    frame = next(iter(open_sequence(tmp_path / "c").stream()))
    depth, mask = caster.measure(frame.camera, camera_path(house, 3, "route")[0])
    np.testing.assert_allclose(frame.depth, depth, atol=2e-4)
    assert frame.mask is not None and (frame.mask == mask).all()
    assert contents(tmp_path / "a")["depth/000000.png"] != contents(tmp_path / "c")["depth/000000.png"]
    with pytest.raises(SequenceError, match="expected one of room, loop, corridor, bare, found 'maze'"):
        write_synthetic_sequence(tmp_path / "d", scene="maze")
    with pytest.raises(SequenceError, match="depth_distortion: expected 0 to 10"):
        write_synthetic_sequence(tmp_path / "d", depth_distortion=-1.0)


def test_distortion_is_fixed_smooth_and_in_disparity() -> None:
    camera = Camera(160, 120, 120, 120, 79.5, 59.5)
    offset = disparity_distortion(camera, 0.4, 2)
    assert np.sqrt((offset**2).mean()) == pytest.approx(0.4) and abs(offset.mean()) < 1e-9
    assert np.abs(np.diff(offset, axis=0)).max() < 0.05 and np.abs(np.diff(offset, axis=1)).max() < 0.05
    small = disparity_distortion(camera.resize(80, 60), 0.4, 2)
    np.testing.assert_allclose(cv2.resize(offset, (80, 60), interpolation=cv2.INTER_AREA), small, atol=0.01)
    assert np.abs(disparity_distortion(camera, 0.4, 3) - offset).max() > 0.1
    for z in (1.5, 3.0):
        wall = np.full((120, 160), z, np.float32)
        measured = np.stack([noisy_depth(wall, camera, np.random.default_rng(i), offset) for i in range(40)])
        error = np.nanmean(np.where(measured > 0, measured, np.nan), axis=0) - z
        expected = -offset * SensorTuning.disparity_step * z**2
        assert np.corrcoef(error.ravel(), expected.ravel())[0, 1] > 0.6
        assert (error * expected).sum() / (expected**2).sum() == pytest.approx(1, abs=0.05)


def test_the_room_is_as_ever(room: Path) -> None:
    """Numbers of the recording as it was before there was a house."""
    mask = cv2.imread(str(room / "masks" / "000010.png"), cv2.IMREAD_UNCHANGED)
    assert hashlib.sha256(mask.tobytes()).hexdigest().startswith("b907fb94d05b84e9")
    pose = [0.333333, 3.200407357, 1.879346966, 1.433892852, 0.77227556, 0.288178017, -0.194526991, -0.531698354]
    np.testing.assert_allclose(np.loadtxt(room / "poses.txt")[10], pose, atol=2e-9)
    depth = cv2.imread(str(room / "depth" / "000010.png"), cv2.IMREAD_UNCHANGED) / 5000
    expected = [[2.80453, 3.04658, 2.76348, 2.24101], [2.57995, 2.65744, 2.29592, 1.87178],
                [1.5463, 1.35253, 1.78072, 1.58922]]  # fmt: skip
    np.testing.assert_allclose(depth.reshape(3, 40, 4, 40).mean((1, 3)), expected, atol=1e-4)
    color = cv2.imread(str(room / "rgb" / "000010.png"))
    expected = [[147.66, 205.93, 163.17, 139.45], [105.79, 115.83, 110.51, 113.99], [78.52, 83.22, 85.14, 81.19]]
    np.testing.assert_allclose(color.reshape(3, 40, 4, 40, 3).mean((1, 3, 4)), expected, atol=0.1)
    names = {path.name for path in room.iterdir()}
    assert names == {"rgb", "depth", "masks", "camera.yaml", "poses.txt"}
    assert "distortion" not in (room / "camera.yaml").read_text()
