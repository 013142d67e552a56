# SPDX-License-Identifier: Apache-2.0
"""A camera that is lost begins a new part of the map; a loop joins it, or the largest part is the result."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from kept import build_once, generated_recording, session_folder
from lost_camera import BEGINNING, COVERED, way, write_lost_camera

from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute, resume
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.loops import LoopsRecord
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.map_parts import NOT_JOINED
from ggslam.slam.realtime import RealtimeSlam
from ggslam.slam.result import SlamResult, StepReport
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam
from ggslam.slam.verdicts import judge_run

CHEAP = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=10", "identity.enabled=false",
         "refine_iterations=10", "threads=2"]  # fmt: skip
HIDDEN = range(BEGINNING, BEGINNING + COVERED)
LAST = 60
"""Frame of the walk after the covered ones: nothing in view that the beginning shows."""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Once around the room, 100 frames."""
    return generated_recording(tmp_path_factory, "walk", frames=100, width=160, height=120, trajectory="round")


def recording(
    factory: pytest.TempPathFactory, walk: Path, name: str, frames: list[int], covered: Iterable[int]
) -> Path:
    folder = session_folder(factory) / "recordings" / name
    return build_once(folder, lambda out: write_lost_camera(out, walk, frames, covered))


@pytest.fixture(scope="module")
def back(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The camera comes back to the beginning."""
    return recording(tmp_path_factory, walk, "back", way(BEGINNING, range(LAST, -1, -1)), HIDDEN)


@pytest.fixture(scope="module")
def away(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """It never does."""
    return recording(tmp_path_factory, walk, "away", way(BEGINNING, range(LAST, LAST + 26)), HIDDEN)


def frames_of(folder: Path) -> list[Frame]:
    return list(open_sequence(folder).stream(masks=False))


def run(frames: Sequence[Frame], *overrides: str) -> Slam:
    slam = Slam(frames[0].camera, load_config(None, [*CHEAP, *overrides]), has_masks=False)
    for frame in frames:
        slam.step(frame)
    return slam


def errors_mm(result: SlamResult, frames: Sequence[Frame], world: int = 0) -> np.ndarray:
    """Distances from the truth of the frames that were not lost, millimetres; the first of these is the world, or
    another frame."""
    T = result.trajectory()
    known = [k for k in range(len(frames)) if np.isfinite(T[k]).all()]
    world = world or known[0]
    ours = inverse(T[world]) @ T[known]
    truth = [inverse(frames[world].T_world_camera) @ frames[k].T_world_camera for k in known]
    return 1e3 * np.linalg.norm(ours[:, :3, 3] - np.array(truth)[:, :3, 3], axis=1)


def lost(result: SlamResult) -> list[int]:
    return [f.frame_index for f in result.frames if f.status == "lost"]


def assert_in_one_room(result: SlamResult) -> None:
    """Nothing is at an arbitrary place: the room is 6 m long."""
    assert float(result.gaussians.means.abs().max()) < 8
    assert max(np.abs(keyframe.T_world_camera[:3, 3]).max() for keyframe in result.keyframes) < 6


@pytest.fixture(scope="module")
def joined(back: Path) -> tuple[Slam, SlamResult]:
    slam = run(frames_of(back))
    return slam, slam.finish()


def test_a_part_that_begins_after_a_loss_is_joined_by_a_loop(back: Path, joined: tuple[Slam, SlamResult]) -> None:
    slam, result = joined
    assert lost(result) == list(HIDDEN)
    errors = errors_mm(result, frames_of(back))
    assert np.sqrt((errors**2).mean()) < 10 and errors.max() < 25
    assert_in_one_room(result)
    assert slam.loops is not None and slam.loops.parts.all() == [0] and not judge_parts(result)
    notes = LoopsRecord.of_result(result).notes()
    (told,) = (note for note in notes if note.startswith("part 2"))
    assert "part 2 was joined to part 1 at frame" in told and 60 > int(told.rsplit(maxsplit=1)[1]) > 40
    assert "lost for 8 frames (0.30 s) from frame 10; part 2 begins at frame 18" in notes


def judge_parts(result: SlamResult) -> list[str]:
    return [verdict.text for verdict in judge_run(result) if verdict.code == "parts"]


def test_without_parts_frames_are_lost_until_the_beginning_is_seen(back: Path) -> None:
    result = run(frames_of(back), "tracking.recovery.new_part_after=0").finish()
    assert set(lost(result)) > set(range(BEGINNING, 36))


def test_nothing_is_at_two_places_until_then(back: Path) -> None:
    """The new part is a hundred metres off, and its map is consistent in itself."""
    frames = frames_of(back)[:40]
    slam = run(frames)
    assert slam.loops is not None and slam.loops.parts.of == [0] * 3 + [3] * (len(slam.mapper.keyframes) - 3)
    poses = np.array([keyframe.T_world_camera for keyframe in slam.mapper.keyframes])
    assert np.abs(poses[:3, :3, 3]).max() < 1 and (poses[3:, 1, 3] < -90).all()
    truth = np.array([frames[keyframe.frame_index].T_world_camera for keyframe in slam.mapper.keyframes])
    apart = inverse(poses[3]) @ poses[3:]
    assert np.abs(apart - inverse(truth[3]) @ truth[3:])[:, :3, 3].max() < 0.02
    heights, births = slam.map.means[:, 1].numpy(), slam.map.birth_keyframe.numpy()
    assert (heights[births >= 3] < -90).all() and (heights[births < 3] > -5).all()


def test_what_nothing_joins_is_left_out(away: Path) -> None:
    """The part with the most frames is the result, in the world of its own first keyframe."""
    frames = frames_of(away)
    result = run(frames).finish()
    begins = BEGINNING + COVERED
    assert lost(result) == list(range(begins))
    assert [f.reason == NOT_JOINED for f in result.frames[:begins]] == [True] * BEGINNING + [False] * COVERED
    errors = errors_mm(result, frames)
    assert np.sqrt((errors**2).mean()) < 15 and errors.max() < 40
    assert_in_one_room(result)
    assert [keyframe.index for keyframe in result.keyframes] == list(range(len(result.keyframes)))
    assert np.allclose(result.keyframes[0].T_world_camera, np.eye(4), atol=1e-3)
    assert [keyframe.frame_index for keyframe in result.keyframes][:2] == [begins, begins + 5]
    assert set(np.unique(result.gaussians.birth_keyframe)) <= set(range(len(result.keyframes)))
    (text,) = judge_parts(result)
    assert text.startswith("frames 0-9 are part 1, which could not be joined")
    assert text.partition(";")[0] in LoopsRecord.of_result(result).notes()


def test_a_smaller_part_is_left_out(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    order = way(30, range(85, 99))
    frames = frames_of(recording(tmp_path_factory, walk, "small", order, range(30, 38)))
    result = run(frames).finish()
    assert lost(result) == list(range(30, len(frames)))
    assert_in_one_room(result)
    assert judge_parts(result)[0].startswith(f"frames 38-{len(frames) - 1} are part 2, which could not be joined")
    alone = run(frames[:30]).finish()
    assert np.abs(alone.trajectory()[:30] - result.trajectory()[:30]).max() < 0.005


@pytest.mark.long("two runs of a hundred frames")
@pytest.mark.parametrize(("third", "gone"), [(range(60, 99), range(10)), (range(60, -1, -1), range(18, 30))])
def test_of_three_parts_two_are_joined(
    walk: Path, tmp_path_factory: pytest.TempPathFactory, third: range, gone: range
) -> None:
    """The third leads to the second, or to the first; the other one is left out."""
    after = [*range(99, 87, -1), *np.linspace(87, 60, COVERED).round().astype(int), *third]
    hidden = [*HIDDEN, *range(30, 38)]
    frames = frames_of(recording(tmp_path_factory, walk, f"three{gone.start}", way(BEGINNING, after), hidden))
    result = run(frames).finish()
    assert len([event for event in result.loop_events if event.kind == "new part"]) == 2
    assert lost(result) == sorted({*gone, *hidden})
    errors = errors_mm(result, frames)
    assert np.sqrt((errors**2).mean()) < 25 and errors.max() < 60
    assert_in_one_room(result)
    number = 1 if gone.start == 0 else 2
    assert judge_parts(result)[0].startswith(f"frames {gone.start}-{gone.stop - 1} are part {number}")


def test_parts_are_compared_once_more_at_the_end(back: Path, joined: tuple[Slam, SlamResult]) -> None:
    """One loop was verified, no second one confirmed it: pairs of keyframes from anywhere may."""
    frames = frames_of(back)
    (at,) = (event.frame for event in joined[1].loop_events if event.kind == "joined")
    slam = run(frames[: at + 8], "loops.confirmations=100")
    assert slam.loops is not None and slam.loops.parts.all() == [0, 3]
    slam.loops.settings = dataclasses.replace(slam.loops.settings, confirmations=2)
    result = slam.finish()
    assert lost(result) == list(HIDDEN) and slam.loops.parts.all() == [0]
    assert "part 2 was joined to part 1 when the recording had ended" in LoopsRecord.of_result(result).notes()
    errors = errors_mm(result, frames[: at + 8])
    assert np.sqrt((errors**2).mean()) < 20 and errors.max() < 50
    assert_in_one_room(result)


@pytest.mark.parametrize("at", [23, 31, 57])
def test_another_run_goes_on_bit_for_bit(back: Path, joined: tuple[Slam, SlamResult], at: int) -> None:
    """From amidst the frames that are watched, from the new part, and from after it was joined."""
    frames = frames_of(back)
    first = run(frames[:at])
    tree, arrays = describe_state(first)
    slam = Slam(first.camera, first.config, has_masks=False)
    restore_state(slam, tree, [array.copy() for array in arrays])
    for frame in frames[at:]:
        slam.step(frame)
    result, whole = slam.finish(), joined[1]
    assert result.trajectory().tobytes() == whole.trajectory().tobytes()
    for name in ("means", "quaternions", "sh", "birth_keyframe"):
        ours, theirs = (getattr(r.gaussians, name).detach().numpy() for r in (result, whole))
        assert ours.tobytes() == theirs.tobytes(), name
    assert result.places == whole.places


@pytest.mark.parametrize(
    ("settings", "times", "begins"),
    [
        ((), True, 27),
        (("tracking.recovery.new_part_after=3",), True, 27),
        (("tracking.recovery.new_part_after=2", "tracking.recovery.new_part_seconds=0"), True, 19),
        (("tracking.recovery.new_part_after=3", "tracking.recovery.new_part_seconds=0.12"), True, 22),
        (("tracking.recovery.new_part_after=2",), False, 19),
        (("tracking.recovery.new_part_after=11",), True, 29),  # frame 28 is held out for scoring
        (("loops.enabled=false",), True, None),
        (("memory_limit_mb=4000",), True, None),
    ],
)
def test_when_a_part_begins(away: Path, settings: tuple[str, ...], times: bool, begins: int | None) -> None:
    """Ten frames, and three tenths of a second: whichever comes later. The frames that were waited for belong to it."""
    frames = frames_of(away)[:35]
    if not times:
        frames = [dataclasses.replace(frame, timestamp=0.0) for frame in frames]
    slam = run(frames, *settings)
    firsts = [keyframe.frame_index for keyframe in slam.mapper.keyframes if keyframe.frame_index >= 18]
    statuses = [frame.status for frame in slam.frames]
    slam.close()
    if begins is None:
        assert not firsts and statuses[10:] == ["lost"] * 25
        return
    assert firsts[0] == 18 and statuses[begins] == "first"
    assert statuses[10:18] == ["lost"] * 8 and statuses[18:begins] == ["recovered"] * (begins - 18)
    assert "lost" not in statuses[begins:]


class KilledAt(SilentObserver):
    """Kills a run after a frame, or, if that never comes, in its refinement."""

    def __init__(self, frame: int) -> None:
        self._frame, self._stage = frame, ""

    def begin(self, stage: str, total: int) -> None:
        self._stage = stage

    def frame(self, report: StepReport) -> None:
        if report.frame.frame_index == self._frame:
            raise SystemExit

    def advance(self, done: int, total: int) -> None:
        if self._stage == "refine" and done >= 20:
            raise SystemExit


@pytest.mark.long("four runs, three of them in two halves")
def test_a_run_that_is_killed_goes_on_from_its_checkpoint(away: Path, tmp_path: Path) -> None:
    """Amidst the frames that are watched (some were saved as lost before), in the new part, and after the other one
    was left out."""

    def request(out: str) -> RunRequest:
        cheap = [*CHEAP, "refine_iterations=40"]
        return RunRequest(SequenceRequest(away), tmp_path / out, overrides=cheap, evaluate=False, checkpoint_every=4)

    execute(request("whole"))
    for at in (23, 35, 1000):
        out = f"killed{at}"
        with pytest.raises(SystemExit):
            execute(request(out), KilledAt(at))
        resume(tmp_path / out, checkpoint_every=4)
        for name in ("trajectory.txt", "keyframes.json", "map.ply", "places.npz", "points.ply"):
            assert (tmp_path / out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), (at, name)


def behind_a_board(frames: Sequence[Frame], hidden: range) -> list[Frame]:
    """Something textured is held before the lens, 40 cm away, and turned a little from frame to frame."""
    random = np.random.default_rng(0)
    texture = cv2.resize(random.integers(0, 255, (40, 60, 3), np.uint8), (400, 300), interpolation=cv2.INTER_CUBIC)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    out = list(frames)
    for k in hidden:
        since = k - hidden.start
        depth = 0.4 + 0.05 * np.sin(u / 25 + 0.1 * since) + 0.04 * np.cos(v / 20) + random.normal(0, 0.0015, u.shape)
        color = texture[10 + since : 130 + since, 20 + 2 * since : 180 + 2 * since].copy()
        out[k] = dataclasses.replace(frames[k], color=color, depth=depth.astype(np.float32))
    return out


@pytest.mark.long("three runs of a hundred frames, and one resumed")
def test_what_covers_the_view_for_long_takes_nothing_away(walk: Path) -> None:
    """It becomes a part, and when it is gone the camera is found where it was lost, although no place tells that it is
    there: the recording's other frames are located as if there had been no part."""
    walked = frames_of(walk)
    order = [*range(30), *np.linspace(30, 40, 40).round().astype(int), *range(40, 75)]
    played = [dataclasses.replace(walked[i], index=k, timestamp=k / 30) for k, i in enumerate(order)]
    frames = behind_a_board(played, range(30, 70))
    slam = run(frames)
    assert slam.loops is not None and len(slam.loops.parts.begun) == 2
    result = slam.finish()
    (found,) = (event for event in result.loop_events if event.kind == "found again")
    assert found.frame == 70 and found.reason == "where the camera was lost before"
    assert lost(result) == list(range(30, 70))
    plain = run(frames, "tracking.recovery.new_part_after=0").finish()
    errors, without = errors_mm(result, frames), errors_mm(plain, frames)
    assert len(errors) == len(without) and errors.max() < without.max() + 10 < 40
    tree, arrays = describe_state(run(frames[:60]))
    again = Slam(slam.camera, slam.config, has_masks=False)
    restore_state(again, tree, [array.copy() for array in arrays])
    for frame in frames[60:]:
        again.step(frame)
    assert again.finish().trajectory().tobytes() == result.trajectory().tobytes()


@pytest.mark.parametrize("setting", ["tracker=features", "movers.enabled=false", "loops.activity.forget_after=0.5"])
def test_other_ways_of_running_join_parts_too(back: Path, setting: str) -> None:
    frames = frames_of(back)
    result = run(frames, setting).finish()
    assert any(event.kind == "joined" for event in result.loop_events)
    assert lost(result) == list(HIDDEN)
    errors = errors_mm(result, frames)
    assert np.sqrt((errors**2).mean()) < 20
    assert_in_one_room(result)


def test_objects_of_what_is_left_out_are_none(away: Path) -> None:
    """With the recording's masks: those that the kept frames show, no others."""
    sequence = open_sequence(away)
    settings = load_config(None, ["mapping.iterations_per_frame=2", "refine_iterations=10", "masks.source=recording"])
    slam, shown = Slam(sequence.camera, settings, has_masks=True), [set[int](), set[int]()]
    for frame in sequence.stream(masks="lazy"):
        slam.step(frame)
    for keyframe in slam.mapper.keyframes:
        assert keyframe.mask is not None
        shown[keyframe.frame_index >= BEGINNING].update(np.unique(keyframe.mask).tolist())
    result = slam.finish()
    assert result.objects is not None and len(shown[0] - shown[1]) > 3
    assert set(result.objects.observations) <= shown[1]
    assert {o.id for o in result.object_table().objects if o.gaussians} <= shown[1]


def test_a_run_that_only_localizes_begins_no_part(away: Path, tmp_path: Path) -> None:
    few: dict[str, Any] = {"overrides": CHEAP, "evaluate": False}
    execute(RunRequest(SequenceRequest(away, stop=BEGINNING), out=tmp_path / "map", **few))
    in_map = {"map": tmp_path / "map", "localize_only": True}
    again = execute(RunRequest(SequenceRequest(away), tmp_path / "again", **in_map, **few))
    kinds = {event.kind for event in again.result.loop_events}
    assert lost(again.result)[-26:] == list(range(18, 44)) and "new part" not in kinds


def test_a_map_that_the_run_began_with_is_never_left_out(away: Path, tmp_path: Path) -> None:
    """However many more frames the part has that it is not joined to."""
    few: dict[str, Any] = {"overrides": CHEAP, "evaluate": False}
    execute(RunRequest(SequenceRequest(away, stop=BEGINNING), out=tmp_path / "map", **few))
    request = RunRequest(SequenceRequest(away, start=18), tmp_path / "grown", map=tmp_path / "map", **few)
    result = execute(request).result
    assert len(lost(result)) == len(result.frames) == 26
    assert {keyframe.frame_index for keyframe in result.keyframes} == {-1}
    assert judge_parts(result)[0].startswith("frames 0-25 are part 2")
    assert_in_one_room(result)


@pytest.mark.long("two runs and their scores")
def test_run_folders_have_one_part(away: Path, tmp_path: Path) -> None:
    """All files agree, and another recording can start in them."""
    request = RunRequest(SequenceRequest(away), tmp_path / "run", overrides=[*CHEAP, "identity.enabled=true"])
    outcome = execute(request)
    folder = RunFolder.open(tmp_path / "run")
    record = folder.keyframes()
    assert [f.frame for f in record.frames if f.is_lost] == list(range(18))
    assert outcome.metrics is not None and outcome.metrics.trajectory is not None
    assert 1e3 * outcome.metrics.trajectory.ate_rmse_m < 15
    assert any(verdict.code == "parts" for verdict in outcome.verdicts)
    known = RunRequest(SequenceRequest(away), tmp_path / "again", map=tmp_path / "run", localize_only=True,
                       overrides=CHEAP, evaluate=False)  # fmt: skip
    result = execute(known).result
    assert set(range(18)) <= set(lost(result)) <= set(range(20))
    earlier = np.array([record.poses()[k] for k in range(18, 44)])
    assert np.nanmax(np.abs(result.trajectory()[18:] - earlier)[:, :3, 3]) < 0.04


def test_in_real_time_a_part_begins_before_its_keyframes_are_mapped(back: Path) -> None:
    """The mapper takes keyframes in after every fourth frame only."""
    frames = frames_of(back)
    slam = Slam(frames[0].camera, load_config(None, CHEAP), has_masks=False)
    live, waited = RealtimeSlam(slam, 30), 0
    for frame in frames:
        slam.step(frame)
        waited += slam.locator.part_start.target is not None
        while live._jobs.qsize() and frame.index % 4 == 0:
            live._insert_next()
    while live._jobs.qsize():
        live._insert_next()
    result = slam.finish()
    assert waited > 1 and lost(result) == list(HIDDEN)
    assert any(event.kind == "joined" for event in result.loop_events)
    errors = errors_mm(result, frames)
    assert np.sqrt((errors**2).mean()) < 20 and errors.max() < 50
    assert_in_one_room(result)
