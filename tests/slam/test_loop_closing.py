# SPDX-License-Identifier: Apache-2.0
"""Loops are closed, lost frames are found, and a second recording starts in the map of the first."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from drifting_camera import walk_with_drift

from ggslam.errors import ConfigError, RunFolderError
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.loops.activity import ActivitySettings
from ggslam.loops.revisits import RevisitSettings
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.verification import accept_files
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sequences import open_sequence
from ggslam.slam.config import Config, load_config
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.slam.schedules import NewKeyframe
from ggslam.slam.slam import Slam
from ggslam.tracking.points import extract_points
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

CHEAP = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=20", "identity.enabled=false"]


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room).stream())


FORGETFUL = LoopSettings(activity=ActivitySettings(forget_after=0.05, near=0.15, batch=1, spread=0))
"""Whatever the camera has not seen for a step is put aside."""
IN_VIEW = LoopSettings(revisits=RevisitSettings(gap=4, least_way=0.1), repair_iterations=5)
"""Nothing is put aside in a room as small as this."""


def drifting(
    frames: list[Frame], loops: LoopSettings = FORGETFUL, keyframes: int = 24, drift: float = 1.0
) -> tuple[Slam, np.ndarray]:
    """A camera goes through the room and back again, tracked with drift: 18 cm and 4 degrees in all. Gives the run up
    to a keyframe, which all frames are, and their true poses."""
    config = dataclasses.replace(load_config(None, CHEAP), loops=loops)
    slam = Slam(frames[0].camera, config, has_masks=False)
    truth = walk_with_drift(slam, frames, drift * np.array([0.15, 0.06, -0.09, 0.0, np.radians(4), 0.0]), keyframes)
    return slam, truth


@pytest.fixture(scope="module")
def closing(frames: list[Frame]) -> tuple[Slam, np.ndarray]:
    """A drifting camera that closes its loop."""
    return drifting(frames)


@pytest.fixture(scope="module")
def unconfirmed(frames: list[Frame]) -> tuple[Slam, np.ndarray]:
    """The same one, which believes no sighting that is not confirmed by a hundred others."""
    return drifting(frames, dataclasses.replace(FORGETFUL, confirmations=100))


def error_of_keyframes(slam: Slam, truth: np.ndarray) -> float:
    return float(np.linalg.norm(slam.mapper.keyframes[-1].T_world_camera[:3, 3] - truth[-1, :3, 3]))


def test_a_loop_is_closed_and_everything_follows(
    closing: tuple[Slam, np.ndarray], unconfirmed: tuple[Slam, np.ndarray]
) -> None:
    (slam, truth), (unclosed, _) = closing, unconfirmed
    assert slam.loops is not None and unclosed.loops is not None
    closed = [e for e in slam.loops.events if e.kind == "closed"]
    assert closed, [e.reason for e in slam.loops.events]
    assert error_of_keyframes(unclosed, truth) > 0.1
    assert error_of_keyframes(slam, truth) < error_of_keyframes(unclosed, truth) / 3
    # Poses, surface and Gaussians are where their keyframes are.
    for part, pose in zip(slam.surface.poses, slam.loops.poses, strict=True):
        np.testing.assert_allclose(part, pose, atol=1e-9)
    last = slam.mapper.keyframes[-1]
    view = CpuRasterizer(context=slam.context).forward(slam.map, slam.camera, last.T_camera_world, features=False)
    seen = (last.depth_m() > 0) & (view.alpha.numpy() > 0.7)
    assert np.abs(view.expected_depth.numpy() - last.depth_m())[seen].mean() < 0.05
    slam.follow_corrections()  # the tracker hears of it with the next frame
    assert slam.moves_followed == len(closed) and slam.tracker.target is slam.surface.target


def test_a_loop_within_the_view_is_closed(frames: list[Frame], unconfirmed: tuple[Slam, np.ndarray]) -> None:
    (slam, truth), (unclosed, _) = drifting(frames, IN_VIEW), unconfirmed
    assert slam.loops is not None and not slam.loops.activity.inactive()
    kinds = [e.kind for e in slam.loops.events]
    assert "closed" in kinds, [e.reason for e in slam.loops.events]
    assert error_of_keyframes(slam, truth) < error_of_keyframes(unclosed, truth) / 3
    for part, pose in zip(slam.surface.poses, slam.loops.poses, strict=True):
        np.testing.assert_allclose(part, pose, atol=1e-9)


def test_without_drift_old_keyframes_agree_and_nothing_moves(frames: list[Frame]) -> None:
    slam, truth = drifting(frames, IN_VIEW, drift=0.0)
    assert slam.loops is not None
    assert {e.kind for e in slam.loops.events} == {"agreed"} and len(slam.corrections) == 0
    np.testing.assert_allclose(slam.loops.poses, truth, atol=1e-9)


def test_one_sighting_alone_closes_nothing(unconfirmed: tuple[Slam, np.ndarray]) -> None:
    slam, _ = unconfirmed
    assert slam.loops is not None
    kinds = {event.kind for event in slam.loops.events}
    assert "verified" in kinds and "closed" not in kinds


def test_false_closures_are_rejected_and_change_nothing(closing: tuple[Slam, np.ndarray]) -> None:
    slam, _ = closing
    assert slam.loops is not None
    graph = copy.deepcopy(slam.loops.graph)
    before = graph.optimise().poses
    for i, j in ((0, 9), (1, 11), (3, 8)):
        wrong = se3_exp(np.array([1.0, -0.5, 0.3, 0.3, 0.2, 0.4])) @ inverse(graph.poses[i]) @ graph.poses[j]
        graph.add_loop(i, j, wrong, 1e6 * np.eye(6))
    result = graph.optimise()
    assert set(result.rejected) >= set(range(len(graph.loops) - 3, len(graph.loops)))
    np.testing.assert_allclose(result.poses, before, atol=1e-3)


def test_a_lost_camera_is_found_far_from_where_it_was_lost(frames: list[Frame]) -> None:
    slam = Slam(frames[0].camera, load_config(None, CHEAP), has_masks=False)
    dark = dataclasses.replace(frames[0], color=np.zeros_like(frames[0].color), depth=np.zeros_like(frames[0].depth))
    played = [*frames, dark, dark, dark, *frames[:4]]
    played = [dataclasses.replace(f, index=i, timestamp=0.1 * i) for i, f in enumerate(played)]
    for frame in played:
        count = len(slam.mapper.keyframes)
        report = slam.step(frame)
        if report.frame.status == "lost":
            assert len(slam.mapper.keyframes) == count
    result = slam.finish()
    assert [f.status for f in result.frames[24:27]] == ["lost"] * 3 and result.frames[27].status in ("ok", "recovered")
    truth = [inverse(frames[0].T_world_camera) @ f.T_world_camera for f in frames]
    poses = result.trajectory()
    for k in range(4):
        assert np.linalg.norm(poses[27 + k][:3, 3] - truth[k][:3, 3]) < 0.02
    (stretch,) = result.lost_stretches()
    assert (stretch.first, stretch.frames, stretch.after) == (24, 3, 27) and stretch.seconds == pytest.approx(0.4)
    assert any("lost for 3 frames (0.40 s) from frame 24" in note for note in LoopsRecord.of_result(result).notes())


def test_a_keyframe_from_before_the_loss_that_comes_late_hangs_on_the_one_before_it(frames: list[Frame]) -> None:
    slam, _ = drifting(frames, keyframes=6)
    loops = slam.loops
    assert loops is not None
    points = extract_points(frames[4].depth, slam.camera, slam.config.tracking.points, DepthNoise(), slam.context)
    last, count = loops.poses[-1].copy(), len(loops.poses)
    loops._found_at = (1000, 0)  # the tracker was lost and found at keyframe 0 by frame 1000
    late = TrackingResult(last, TrackingStatus.OK, 1.0, 0.0, "", points)
    slam.map_keyframe(NewKeyframe(dataclasses.replace(frames[4], index=990), late, slam.moves_followed))
    assert loops.graph._tree.parents[count] == count - 1 and count not in loops.activity.active
    slam.map_keyframe(NewKeyframe(dataclasses.replace(frames[4], index=1001), late, slam.moves_followed))
    assert loops.graph._tree.parents[count + 1] == 0 and count + 1 in loops.activity.active
    assert loops._found_at is None


def played(room: Path, out: Path, **values: object) -> RunOutcome:
    sequence = SequenceRequest(room, start=int(values.pop("start", 0)), stop=int(values.pop("stop", 24)))  # type: ignore[call-overload]
    return execute(RunRequest(sequence, out, overrides=CHEAP[:2], evaluate=False, **values))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def first_half(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "first"
    assert played(room, out, stop=16).error is None
    return out


def errors_in_map(run: Path, room: Path, start: int) -> list[float]:
    """Distance of each frame from where it is, in the world of the first recording."""
    truth = open_sequence(room).ground_truth
    assert truth is not None
    poses = RunFolder.open(run).keyframes().poses()
    wanted = {i: inverse(truth[0]) @ truth[start + i] for i in sorted(poses)}
    return [float(np.linalg.norm(poses[i][:3, 3] - T[:3, 3])) for i, T in wanted.items()]


def test_another_recording_is_localized_in_a_saved_map(room: Path, first_half: Path, tmp_path: Path) -> None:
    outcome = played(room, tmp_path / "visit", start=12, map=first_half, localize_only=True)
    errors = errors_in_map(tmp_path / "visit", room, 12)
    assert outcome.error is None and len(errors) == 12 and max(errors) < 0.03
    before, after = (RunFolder.open(path).gaussians() for path in (first_half, tmp_path / "visit"))
    assert torch.equal(before.means, after.means) and torch.equal(before.sh, after.sh)  # nothing was trained
    keyframes = json.loads((tmp_path / "visit" / "keyframes.json").read_text())["keyframes"]
    assert {k["frame"] for k in keyframes} == {-1}


def test_edges_and_planes_start_in_a_saved_map_too(room: Path, first_half: Path, tmp_path: Path) -> None:
    sequence = SequenceRequest(room, start=12)
    overrides = [*CHEAP, "tracker=edges_planes"]
    request = RunRequest(sequence, tmp_path / "v", None, overrides, False, map=first_half, localize_only=True)
    assert execute(request).error is None
    errors = errors_in_map(tmp_path / "v", room, 12)
    assert len(errors) == 12 and max(errors) < 0.05
    times = json.loads((tmp_path / "v" / "timing.json").read_text())["tracking_ms_per_100_frames"]
    assert len(times) == 1 and times[0] > 0


@pytest.mark.long("a second whole run")
def test_a_saved_map_grows(room: Path, first_half: Path, tmp_path: Path) -> None:
    old = RunFolder.open(first_half)
    outcome = played(room, tmp_path / "grown", start=10, map=first_half)
    new = RunFolder.open(tmp_path / "grown")
    assert outcome.error is None and max(errors_in_map(new.path, room, 10)) < 0.03
    numbers = [k.frame for k in new.keyframes().keyframes]
    count = len(old.keyframes().keyframes)
    assert numbers[:count] == [-1] * count and len(numbers) > count
    born = read_all_arrays(new.path / PLACES_FILE, "places")["birth"]
    assert 0.02 < (born >= count).mean() < 0.8 and born.min() >= 0
    assert set(old.object_table().ids()) <= set(new.object_table().ids())
    again = played(room, tmp_path / "again", start=8, stop=12, map=new.path)
    assert again.error is None and max(errors_in_map(tmp_path / "again", room, 8)) < 0.03


def test_mistakes_with_maps_are_named(room: Path, first_half: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`localize_only`.*`map`"):
        played(room, tmp_path / "a", localize_only=True)
    with pytest.raises(RunFolderError, match="none"):
        played(room, tmp_path / "a", map=tmp_path / "none")
    with pytest.raises(ConfigError, match=str(first_half)):
        played(room, first_half, map=first_half, overwrite=True)
    with pytest.raises(ConfigError, match="160x120.*80x60.*`scale`"):
        execute(RunRequest(SequenceRequest(room, scale=0.5), tmp_path / "a", map=first_half, evaluate=False))
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("noise", None), ("noise", np.ones(5)), ("keyframe_poses", np.zeros((1, 2, 4))), ("camera", np.ones(3)),
        ("keyframe_poses", np.eye(4)[None]), ("birth", np.zeros((3, 3), np.int32)),
        ("loops_poses", np.full((9, 4, 4), np.nan)),
        ("birth", "far"), ("surface_counts", np.array([5])),
    ],
)  # fmt: skip
def test_damaged_places_are_named(
    room: Path, first_half: Path, tmp_path: Path, name: str, value: np.ndarray | str | None
) -> None:
    shutil.copytree(first_half, tmp_path / "map")
    arrays = dict(np.load(tmp_path / "map" / "places.npz"))
    if value is None:
        del arrays[name]
    else:
        arrays[name] = arrays[name] + 1000 if isinstance(value, str) else value
    np.savez(tmp_path / "map" / "places.npz", **arrays)
    accept_files(tmp_path / "map")
    with pytest.raises(RunFolderError, match="places.npz"):
        played(room, tmp_path / "a", stop=2, map=tmp_path / "map", localize_only=True)


@pytest.mark.long("a second whole run")
def test_the_first_run_must_be_there_still(room: Path, first_half: Path, tmp_path: Path) -> None:
    shutil.copytree(first_half, tmp_path / "a")
    assert played(room, tmp_path / "b", start=12, stop=16, map=tmp_path / "a").error is None
    with pytest.raises(ConfigError, match=str(tmp_path / "a")):
        played(room, tmp_path / "a", map=tmp_path / "b", overwrite=True)
    assert played(room, tmp_path / "a", stop=2, overwrite=True).error is None
    with pytest.raises(RunFolderError, match=str(tmp_path / "a")):
        played(room, tmp_path / "c", map=tmp_path / "b")
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(RunFolderError, match=str(tmp_path / "a")):
        played(room, tmp_path / "c", map=tmp_path / "b")
    assert played(room, tmp_path / "c", start=12, stop=14, map=tmp_path / "b", localize_only=True).error is None


def test_a_grown_run_is_edited_and_then_no_map_to_start_in(room: Path, first_half: Path, tmp_path: Path) -> None:
    assert played(room, tmp_path / "b", start=12, stop=16, map=first_half).error is None
    grown = RunFolder.open(tmp_path / "b")
    small = min((o for o in grown.object_table().objects if o.gaussians > 100), key=lambda o: o.gaussians).id
    edit_run(grown, [Edit("remove", str(small))], tmp_path / "edited", inpainting=True)
    with pytest.raises(RunFolderError, match=str(tmp_path / "edited")):
        played(room, tmp_path / "c", map=tmp_path / "edited")


def test_loops_can_be_turned_off(frames: list[Frame]) -> None:
    slam = Slam(frames[0].camera, load_config(None, [*CHEAP, "loops.enabled=false"]), has_masks=False)
    for frame in frames[:4]:
        slam.step(frame)
    result = slam.finish()
    assert slam.loops is None and result.places is None and result.loop_events == []


def test_a_room_is_tracked_the_same_with_loops_and_without(frames: list[Frame]) -> None:
    trajectories = []
    for enabled in ("true", "false"):
        slam = Slam(frames[0].camera, load_config(None, [*CHEAP, f"loops.enabled={enabled}"]), has_masks=False)
        for frame in frames[:12]:
            slam.step(frame)
        trajectories.append(slam.finish().trajectory())
    np.testing.assert_array_equal(*trajectories)
    assert score_trajectory(list(trajectories[0]), np.array([f.T_world_camera for f in frames[:12]])) is not None
    assert Config().loops.enabled
