# SPDX-License-Identifier: Apache-2.0
"""Volumes follow a run: loop closures, lost frames, objects that turn out to be one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ggslam.driving.body import CameraBody
from ggslam.driving.body_options import read_body
from ggslam.errors import ConfigError
from ggslam.jobs.volumes.live import LiveVolumes
from ggslam.jobs.volumes.no_returns import NoReturns
from ggslam.mapping.keyframe import make_keyframe
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.sequences import open_sequence
from ggslam.sequences.moving_pixels import MovingPixels
from ggslam.slam.loop_results import LoopEvent
from ggslam.slam.result import StepReport, TrackedFrame
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.volume_settings import VolumeSettings

SETTINGS = VolumeSettings(tsdf=TsdfSettings(voxel=0.06, max_depth=4.0), esdf_every=1)


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room, stop=6).stream())


class Played:
    """What `LiveVolumes` asks of a run, at given poses; each frame is a keyframe."""

    def __init__(self) -> None:
        self.corrections, self.scale = [], 1.0
        self.cameras = [None]
        self.mapper: Any = SimpleNamespace(keyframes=[], identity=None)
        self.poses: dict[int, np.ndarray] = {}

    def pose_of(self, frame: TrackedFrame) -> np.ndarray:
        return self.poses[frame.frame_index]

    def play(self, live: LiveVolumes, frame: Frame, T: np.ndarray, status: str = "ok") -> None:
        self.poses[frame.index] = T
        if status != "lost":
            self.mapper.keyframes.append(make_keyframe(len(self.mapper.keyframes), frame, T))
        tracked = TrackedFrame(frame.index, frame.index, 0.0, 0, np.eye(4), 1.0, 0.0, status)
        live(self, frame, StepReport(tracked, status != "lost", 0, 0.0, 0.5))  # type: ignore[arg-type]


def values(maps: VolumeMaps) -> dict[tuple[int, ...], np.ndarray]:
    at = maps.tsdf.blocks().coordinates
    return dict(zip(map(tuple, at.tolist()), maps.tsdf.read(at).value, strict=True))


def test_after_a_correction_the_volumes_are_where_the_keyframes_are(frames: list[Frame]) -> None:
    drift = se3_exp(np.array([0.4, 0, 0, 0, 0.2, 0]))
    maps, slam = VolumeMaps(SETTINGS, esdf=True, occupancy=0.2), Played()
    live = LiveVolumes(maps, lambda frame, T: None)
    for k, frame in enumerate(frames[:4]):
        slam.play(live, frame, (drift if k < 3 else np.eye(4)) @ frame.T_world_camera)
    slam.corrections = [np.eye(4)]
    for keyframe, frame in zip(slam.mapper.keyframes, frames, strict=False):
        keyframe.T_camera_world = np.linalg.inv(frame.T_world_camera)
    slam.play(live, frames[4], frames[4].T_world_camera)

    straight = VolumeMaps(SETTINGS, esdf=True, occupancy=0.2)
    for frame in [*frames[:5], frames[4]]:  # the newest frame is a keyframe already when the maps are made anew
        straight.add(frame, frame.T_world_camera, frame.load_mask())
    found, expected = values(maps), values(straight)
    shared = found.keys() & expected.keys()
    assert len(shared) > 0.95 * len(found.keys() | expected.keys())
    apart = np.concatenate([np.abs(found[at].astype(int) - expected[at]) for at in shared])
    assert np.percentile(apart, 95) < 0.05 * 32767
    assert maps.field is not None and straight.field is not None
    points = maps.field.surface()[0]
    assert np.nanpercentile(np.abs(straight.field.query(points).distance), 95) < 0.5 * SETTINGS.tsdf.voxel
    assert maps.occupancy is not None and straight.occupancy is not None
    assert maps.occupancy.summary().occupied == pytest.approx(straight.occupancy.summary().occupied, rel=0.02)
    assert len(maps.times.rebuilds) == 1


def test_the_robots_body_is_left_out_live_and_after_a_correction(frames: list[Frame]) -> None:
    """A box before the lower half of the camera."""
    body = read_body(["-2,0.2,0.3,2,1,0.5"])
    assert body is not None
    cut, maps, slam = CameraBody(body), VolumeMaps(SETTINGS), Played()
    live = LiveVolumes(maps, lambda frame, T: None, body=body)
    for corrections in ([], [np.eye(4)]):
        slam.corrections = corrections
        for frame in frames[:2]:
            slam.play(live, frame, frame.T_world_camera)
    straight = VolumeMaps(SETTINGS)
    for frame in frames[:2]:
        straight.add(cut.without(frame), frame.T_world_camera, frame.load_mask())
    assert len(maps.times.rebuilds) == 1 and values(maps).keys() == values(straight).keys()


def test_what_moves_is_left_out_live(frames: list[Frame]) -> None:
    pixels, left = MovingPixels(), np.zeros(frames[0].depth.shape, bool)
    left[:, : left.shape[1] // 2] = True
    pixels.add(1, left)
    maps, slam = VolumeMaps(SETTINGS), Played()
    live = LiveVolumes(maps, lambda frame, T: None, objects=False, still=lambda slam, frame: pixels.without(frame))
    slam.play(live, frames[1], frames[1].T_world_camera)
    halved = VolumeMaps(SETTINGS)
    halved.add(pixels.without(frames[1]), frames[1].T_world_camera)
    assert values(maps).keys() == values(halved).keys() and len(values(maps)) > 10
    assert not (frames[1].depth[left] == 0).all()


def test_lost_frames_are_left_out(frames: list[Frame]) -> None:
    maps, slam = VolumeMaps(SETTINGS), Played()
    seen: list[np.ndarray] = []
    live = LiveVolumes(maps, lambda frame, T: seen.append(T))
    slam.play(live, frames[0], frames[0].T_world_camera)
    before = maps.tsdf.revision
    slam.play(live, frames[1], np.full((4, 4), np.nan), status="lost")
    assert maps.tsdf.revision == before and len(seen) == len(maps.times.rows) == 1
    assert maps.times.summary()["all"]["mean_ms"] > 500  # a robot waits for the pose, too


def test_what_was_left_out_in_the_end_is_not_in_the_volumes(frames: list[Frame]) -> None:
    """A part of the recording that nothing joined lay a hundred metres above."""
    maps, slam, above = VolumeMaps(SETTINGS, esdf=True), Played(), np.eye(4)
    above[1, 3] = -100
    live = LiveVolumes(maps, lambda frame, T: None, objects=False)
    for k, frame in enumerate(frames[:4]):
        slam.play(live, frame, (above if k > 1 else np.eye(4)) @ frame.T_world_camera)
    assert len({at[1] < -50 / (8 * SETTINGS.tsdf.voxel) for at in values(maps)}) == 2
    events = [LoopEvent("new part", 2, -1, -1, ""), LoopEvent("left out", 2, -1, -1, "")]
    result: Any = SimpleNamespace(loop_events=events, keyframes=slam.mapper.keyframes[:2])
    assert live.follow_parts(result)
    kept = VolumeMaps(SETTINGS, esdf=True)
    for frame in frames[:2]:
        kept.add(frame, frame.T_world_camera)
    found, expected = values(maps), values(kept)
    assert found.keys() == expected.keys() and len(found) > 50
    assert not live.follow_parts(SimpleNamespace(loop_events=[], keyframes=[]))  # type: ignore[arg-type]


def test_objects_that_turn_out_to_be_one_get_one_id(frames: list[Frame]) -> None:
    maps, slam = VolumeMaps(SETTINGS), Played()
    alias = np.arange(65536, dtype=np.uint16)
    slam.mapper.identity = SimpleNamespace(current=lambda ids: alias[ids])
    live = LiveVolumes(maps, lambda frame, T: None)
    for frame in frames[:3]:
        slam.play(live, frame, frame.T_world_camera)
    ids = extract_mesh(maps.tsdf).objects()
    kept, merged, noise = ids[:3]
    alias[merged] = kept
    live.settle([i for i in ids if i not in (merged, noise)])
    assert extract_mesh(maps.tsdf).objects() == [i for i in ids if i not in (merged, noise)]


def test_the_distance_field_is_updated_as_often_as_told(frames: list[Frame]) -> None:
    maps = VolumeMaps(VolumeSettings(tsdf=SETTINGS.tsdf, esdf_every=2, decay_every=2), esdf=True)
    maps.add(frames[0], frames[0].T_world_camera)
    assert maps.field is not None and len(maps.field) == 0
    maps.add(frames[1], frames[1].T_world_camera)
    assert len(maps.field) > 0
    maps.add(frames[2], frames[2].T_world_camera)
    assert [sorted(row) for row in maps.times.rows] == [["tsdf"], ["esdf", "tsdf"], ["tsdf"]]
    whole = maps.times.whole()  # only the frame with which everything was done tells how long that takes
    assert len(whole) == 1 and whole[0] == pytest.approx(sum(maps.times.rows[1].values()))


def test_fusing_on_a_device_gives_the_same_volumes(frames: list[Frame]) -> None:
    native, torch_on_cpu = (VolumeMaps(SETTINGS, esdf=True, device=device) for device in (None, "cpu"))
    for maps in (native, torch_on_cpu):
        for frame in frames[:2]:
            maps.add(frame, frame.T_world_camera)
        maps.finish()
    found, expected = values(torch_on_cpu), values(native)
    assert found.keys() == expected.keys() and len(found) > 50
    apart = np.concatenate([np.abs(found[at].astype(int) - expected[at]) for at in found])
    assert (apart > 4).mean() < 0.002
    assert torch_on_cpu.field is not None and len(torch_on_cpu.field) == len(found)
    with pytest.raises(ConfigError, match="device"):
        VolumeMaps(SETTINGS, device="nonsense")


def test_what_the_sensor_no_longer_finds_goes(frames: list[Frame]) -> None:
    """A frame that says "nothing within range" everywhere, after one that saw a room: nothing is left in range."""
    maps = VolumeMaps(SETTINGS, esdf=True, occupancy=0.06)
    seen, T = frames[0], np.eye(4)
    for _ in range(5):
        maps.add(seen, T)
    assert len(maps.field.surface()[0]) > 100 and maps.occupancy.summary().occupied > 100
    nothing = replace(seen, depth=np.zeros_like(seen.depth), no_return=np.ones(seen.depth.shape, bool))
    missing = replace(nothing, no_return=None)
    before = maps.occupancy.summary().occupied
    for _ in range(20):
        maps.add(missing, T)
    assert maps.occupancy.summary().occupied == before
    for _ in range(20):
        maps.add(nothing, T)
    points = maps.field.surface()[0]
    column = points[:, 0] / points[:, 2] * seen.camera.fx + seen.camera.cx
    row = points[:, 1] / points[:, 2] * seen.camera.fy + seen.camera.cy
    margin = 0.1 * seen.camera.fx / np.maximum(points[:, 2], 0.1)  # of the view: voxels half in it
    inner = (np.minimum(column, seen.camera.width - 1 - column) > margin) & (points[:, 2] > 0.3)
    inner &= (np.minimum(row, seen.camera.height - 1 - row) > margin) & (points[:, 2] < 3.9)
    assert not inner.any()
    centres = maps.occupancy.occupied_centers()[0]
    assert not (centres[:, 2] < 3.9).any()


def test_what_keyframes_found_nothing_of_stays_free_after_a_correction(frames: list[Frame]) -> None:
    """Frames that say "nothing within range" on their left half, after one that saw a room there: the same, made anew
    of the keyframes. Of many frames only masks of keyframes and of the newest are kept."""
    seen, T = frames[0], np.eye(4)
    half = np.zeros(seen.depth.shape, bool)
    half[:, : half.shape[1] // 2] = True
    nothing = replace(seen, index=1, depth=np.where(half, 0, seen.depth).astype(np.float32), no_return=half)
    maps, slam = VolumeMaps(SETTINGS, esdf=True, occupancy=0.06), Played()
    live = LiveVolumes(maps, lambda frame, T: None, objects=False)
    slam.play(live, seen, T)
    before = len(maps.field.surface()[0])
    for k in range(1, 9):
        slam.play(live, replace(nothing, index=k), T)
    surface, occupied = len(maps.field.surface()[0]), maps.occupancy.summary().occupied
    assert 0.2 * before < surface < 0.8 * before
    slam.corrections = [np.eye(4)]
    slam.play(live, replace(nothing, index=9), T)
    assert len(maps.times.rebuilds) == 1
    assert len(maps.field.surface()[0]) == pytest.approx(surface, rel=0.02)
    assert maps.occupancy.summary().occupied == pytest.approx(occupied, rel=0.02)
    kept = NoReturns()
    for k in range(1000):
        kept.note(replace(nothing, index=k), slam.mapper.keyframes)
    assert set(range(1, 10)) | set(range(936, 1000)) <= set(kept._packed) and len(kept._packed) < 250
