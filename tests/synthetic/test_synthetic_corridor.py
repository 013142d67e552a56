# SPDX-License-Identifier: Apache-2.0
"""The generated corridor: as long as its recording, walked once without a jump, consistent from frame to frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.sequences import open_sequence
from ggslam.synthetic import RayCaster, Scene, camera_path
from ggslam.synthetic.houses import corridor as corridor_module
from ggslam.synthetic.houses.corridor import furnished_corridor
from ggslam.synthetic.houses.palette import HousePalette
from ggslam.synthetic.lighting import LightingTuning
from ggslam.system.tuning import overridden

CAMERA = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
FRAMES = 200


@pytest.fixture(scope="module", autouse=True)
def one_palette() -> Iterator[None]:
    """Textures take most of the time that a corridor takes: they are made once, whatever the seed."""
    palette = HousePalette(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(corridor_module, "HousePalette", lambda seed: palette)
        yield


@pytest.fixture(scope="module")
def corridor(one_palette: None) -> Scene:
    return furnished_corridor(0, FRAMES)


@pytest.fixture(scope="module")
def caster(corridor: Scene) -> RayCaster:
    return RayCaster(corridor)


@pytest.fixture(scope="module")
def poses(corridor: Scene) -> np.ndarray:
    return camera_path(corridor, FRAMES, "walk")


def agreement(depth: np.ndarray, T: np.ndarray, other_depth: np.ndarray, T_other: np.ndarray) -> float:
    """Share of the pixels of one view that lie where the other view measures them, to 3 %, of those in its image."""
    points = transform_points(CAMERA.back_project(depth)[depth > 0], inverse(T_other) @ T)
    front = points[points[:, 2] > 0.05]
    u = np.rint(CAMERA.fx * front[:, 0] / front[:, 2] + CAMERA.cx).astype(int)
    v = np.rint(CAMERA.fy * front[:, 1] / front[:, 2] + CAMERA.cy).astype(int)
    inside = (u >= 0) & (u < CAMERA.width) & (v >= 0) & (v < CAMERA.height)
    seen, z = other_depth[v[inside], u[inside]], front[inside, 2]
    return float((np.abs(seen - z) < 0.03 * z).mean())


def test_the_corridor_is_as_long_as_the_recording_needs() -> None:
    reached = []
    for frames in (2, 100, 500):
        scene = furnished_corridor(0, frames)
        poses = camera_path(scene, frames, "walk")
        reached.append(float(poses[-1, 0, 3]))
        assert 5 < scene.bounds[1][0] - reached[-1] < 14
    assert reached[2] - reached[0] > 25
    assert (reached[2] - reached[1]) / 400 == pytest.approx(0.06, abs=0.004)  # metres per frame
    with pytest.raises(SequenceError, match="the route is too short for 900 frames"):
        camera_path(furnished_corridor(0, 200), 900, "walk")


def test_the_way_is_smooth_and_free(corridor: Scene, poses: np.ndarray) -> None:
    motion = inverse(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(motion[:, :3, 3], axis=1)
    turn = np.degrees(np.arccos(np.clip((np.trace(motion[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert step.min() > 0.02 and step.max() < 0.09 and turn.max() < 4 and np.abs(np.diff(turn)).max() < 1.2
    assert (np.diff(poses[:, 0, 3]) > 0).all()
    assert min(shape.distance(poses[:, :3, 3]).min() for shape in corridor.shapes) > 0.3
    heading = np.degrees(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    assert heading.max() > 35 and heading.min() < -35
    other = camera_path(corridor, FRAMES, "walk", seed=1)
    assert 0.005 < np.abs(other[:, :3, 3] - poses[:, :3, 3]).max() < 0.2


def test_frames_agree_with_their_neighbours(caster: RayCaster, poses: np.ndarray) -> None:
    for i in range(0, FRAMES - 5, 24):
        views = [caster.measure(CAMERA, poses[k])[0] for k in (i, i + 5)]
        assert (views[0] > 0).all()  # no ray leaves the corridor
        assert agreement(views[0], poses[i], views[1], poses[i + 5]) > 0.85
        wrong = poses[i + 5].copy()
        wrong[1, 3] += 0.3
        assert agreement(views[0], poses[i], views[1], wrong) < 0.6


def test_every_section_shows_things_of_its_own(caster: RayCaster, poses: np.ndarray) -> None:
    seen = []
    for pose in poses[::10]:
        depth, mask = caster.measure(CAMERA, pose)
        seen.append(set(np.unique(mask[depth < 3]).tolist()))
    new = [len(later - set.union(*seen[: k + 1])) for k, later in enumerate(seen[1:])]
    assert sum(new[: len(new) // 2]) >= 8 and sum(new[len(new) // 2 :]) >= 8


def test_a_shorter_recording_begins_like_a_longer_one(corridor: Scene) -> None:
    shorter, other = furnished_corridor(0, 40), furnished_corridor(1, 40)
    first = [(shape.half, shape.T_world_shape[0, 3]) for shape in shorter.shapes[2:]]
    assert first == [(shape.half, shape.T_world_shape[0, 3]) for shape in corridor.shapes[2 : len(first) + 2]]
    assert first != [(shape.half, shape.T_world_shape[0, 3]) for shape in other.shapes[2:]]


def test_a_written_corridor_repeats(tmp_path: Path) -> None:
    with overridden(LightingTuning, max_patches=2):
        for name in ("a", "b"):
            options = ["--scene", "corridor", "--frames", "3", "--width", "80", "--height", "60"]
            result = CliRunner().invoke(app, ["synth", str(tmp_path / name), *options])
            assert result.exception is None, result.output
        contents = [
            {path.relative_to(tmp_path / name): path.read_bytes() for path in (tmp_path / name).rglob("*.*")}
            for name in ("a", "b")
        ]
        assert contents[0] == contents[1]
        sequence = open_sequence(tmp_path / "a")
        assert len(sequence) == 3 and sequence.has_masks and sequence.timestamps[2] == pytest.approx(0.2)
        frame = next(iter(sequence.stream()))
        scene = furnished_corridor(0, 3)
        expected, _ = RayCaster(scene).measure(frame.camera, camera_path(scene, 3, "walk")[0])
        assert frame.depth is not None and np.median(np.abs(frame.depth - expected)[frame.depth > 0]) < 0.03
