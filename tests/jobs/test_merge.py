# SPDX-License-Identifier: Apache-2.0
"""Runs of one room become one run that the other commands take; runs of two rooms do not."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam
from kept import generated_recording, session_folder
from small_runs import run_of

from ggslam.errors import ConfigError, RunFolderError, SequenceError
from ggslam.evaluation.trajectory import score_trajectory
from ggslam.formats.trajectory import read_tum
from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.jobs.merge.merge import MergeOutcome, merge_runs
from ggslam.jobs.report.gather import path_of_run
from ggslam.jobs.run.evaluate_run import evaluate_run
from ggslam.jobs.view.viewed_run import ViewedRun
from ggslam.merging.settings import MergeSettings
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.starting import start_in_map
from ggslam.sequences.joined import JoinedSequence
from ggslam.slam.slam import Slam

pytest.importorskip("gtsam")
FAST = MergeSettings(steps=24)


@dataclass(frozen=True)
class Halves:
    """Two runs of one recording that share frames 8 to 15, and what became of them."""

    first: RunFolder
    second: RunFolder
    outcome: MergeOutcome

    @property
    def merged(self) -> RunFolder:
        """The run that both became."""
        return RunFolder.open(self.outcome.folder.path)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return session_folder(tmp_path_factory) / "merging"


@pytest.fixture(scope="module")
def halves(room: Path, places: Path) -> Halves:
    first, second = run_of(room, places / "first", 0, 16), run_of(room, places / "second", 8, 24)
    outcome = merge_runs([first, second], places / "whole", settings=FAST)
    return Halves(RunFolder.open(first), RunFolder.open(second), outcome)


@pytest.mark.long("two runs of a generated room are made and merged")
def test_the_merged_run_has_all_frames_in_one_world(halves: Halves) -> None:
    merged, trajectory = halves.merged, halves.merged.trajectory()
    assert len(trajectory) == 32 and (np.diff(trajectory.timestamps) > 0).all()
    truth = read_tum(merged.path / "ground_truth.txt")
    assert np.array_equal(truth.timestamps, trajectory.timestamps)
    scores = score_trajectory(list(trajectory.T_world_camera), list(truth.T_world_camera))
    assert scores is not None and scores.ate_rmse_m < 0.01
    counts = [len(run.keyframes().keyframes) for run in (halves.first, halves.second, merged)]
    assert counts[2] == counts[0] + counts[1]
    assert merged.mark().complete and merged.mark().merged is not None
    assert [Path(part.run).name for part in merged.mark().merged or []] == ["first", "second"]
    assert {link.believed for link in halves.outcome.poses.links} == {True}


def test_what_both_maps_show_is_there_once(halves: Halves) -> None:
    counts = [len(run.gaussians()) for run in (halves.first, halves.second)]
    assert len(halves.merged.gaussians()) == sum(counts) - sum(halves.outcome.doubles)
    assert max(counts) < len(halves.merged.gaussians()) < 0.8 * sum(counts)
    assert halves.outcome.trained > 0 and halves.outcome.steps == FAST.steps


def test_one_thing_has_one_id_and_its_name(halves: Halves) -> None:
    table, own = halves.merged.object_table(), [run.object_table() for run in (halves.first, halves.second)]
    assert set(table.ids()) <= set(own[0].ids()) | set(own[1].ids())
    assert len(halves.outcome.united) == len(set(own[0].ids()) & set(own[1].ids())) > 5
    names = {o.id: o.name for o in own[0].objects}
    assert all(names[o.id] == o.name for o in table.objects if o.id in names)


def test_its_recordings_are_read_as_one(halves: Halves, room: Path) -> None:
    sequence = open_recording_of(halves.merged)
    assert isinstance(sequence, JoinedSequence) and len(sequence) == 32
    frame = sequence.frame(16 + 3)
    assert (frame.index, frame.source_index) == (19, 11)
    assert np.array_equal(frame.color, open_recording_of(halves.second).frame(3).color)
    assert [f.index for f in sequence.stream(masks=False)] == list(range(32))
    assert (np.diff(sequence.timestamps) > 0).all() and sequence.has_masks
    assert halves.merged.sequence().own_number(19) == 3
    with pytest.raises(SequenceError, match="room"):
        sequence[2:4]
    with pytest.raises(SequenceError, match="room.* 0 .*31.*32"):
        sequence.frame(32)


@pytest.mark.long("every fourth frame of both runs is scored")
def test_it_is_scored_against_all_recordings(halves: Halves) -> None:
    metrics = evaluate_run(halves.merged, lpips=False, every=4)
    assert metrics.trajectory is not None and metrics.trajectory.frames_compared == 32
    assert metrics.images.held_out is not None and metrics.images.held_out.psnr is not None
    assert metrics.images.held_out.psnr > 24


@pytest.mark.long("an edited copy is written")
def test_it_can_be_edited(halves: Halves, tmp_path: Path) -> None:
    name = str(halves.outcome.united[0][0])
    edited = edit_run(halves.merged, [Edit("rename", name, "found twice"), Edit("remove", name)], tmp_path / "edited")
    assert int(name) not in edited.folder.object_table().ids()


def test_the_ways_of_its_runs_are_drawn_apart(halves: Halves) -> None:
    path = path_of_run(halves.merged, halves.merged.keyframes())
    drawn = path.in_order(path.positions)
    assert np.flatnonzero(np.isnan(drawn).all(1)).tolist() == [16, 33]
    assert np.array_equal(drawn[17:33], path.positions[16:])
    assert [len(walk) for walk in ViewedRun(halves.merged).walks] == [16, 16]


def test_another_run_can_start_in_it(halves: Halves) -> None:
    sequence = open_recording_of(halves.second)
    slam = Slam(sequence.camera, halves.merged.config(), has_masks=False)
    start_in_map(slam, halves.merged, growing=False)
    slam.step(sequence.frame(12))
    assert slam.frames[0].status == "recovered"


@pytest.mark.long("a merge of a merged run and a third one")
def test_a_merged_run_is_merged_again(halves: Halves, room: Path, places: Path, tmp_path: Path) -> None:
    """A third run with smaller images and no objects; first of all are the smaller ones."""
    third = run_of(room, places / "third", 4, 20, scale=0.8, more=("identity.enabled=false",))
    outcome = merge_runs([third, halves.merged.path], tmp_path / "again", settings=MergeSettings(steps=6))
    sequence = open_recording_of(outcome.folder)
    assert isinstance(sequence, JoinedSequence) and [len(part.sequence) for part in sequence.parts] == [16, 16, 16]
    assert sequence.frame(0).camera.width == 128 and sequence.frame(20).camera.width == 160
    trajectory, truth = outcome.folder.trajectory(), read_tum(outcome.folder.path / "ground_truth.txt")
    scores = score_trajectory(list(trajectory.T_world_camera), list(truth.T_world_camera))
    assert scores is not None and scores.frames_compared == 48 and scores.ate_rmse_m < 0.01
    left, before = set(outcome.folder.object_table().ids()), set(halves.merged.object_table().ids())
    assert left <= before and len(left) > 0.6 * len(before)  # where the third run measured best there are none


@pytest.mark.long("a merge without training")
def test_without_the_recordings_it_merges_and_says_so(
    halves: Halves, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(folder: RunFolder) -> None:
        raise SequenceError(f"{folder.path}: no such folder or file")

    monkeypatch.setattr("ggslam.jobs.merge.sources.open_recording_of", gone)
    outcome = merge_runs([halves.first.path, halves.second.path], tmp_path / "out", settings=FAST)
    assert outcome.trained == outcome.steps == 0 and sum("not trained on" in note for note in outcome.notes) == 2
    assert len(outcome.folder.segmented_map().gaussians) == outcome.gaussians


def test_runs_without_objects_are_named(halves: Halves, room: Path, places: Path, tmp_path: Path) -> None:
    bare = run_of(room, places / "bare", 4, 12, more=("masks.source=none",))
    outcome = merge_runs([halves.first.path, bare], tmp_path / "out", settings=MergeSettings(steps=0))
    assert [str(bare) in note for note in outcome.notes if "has no objects" in note] == [True]
    assert outcome.shared_objects == 0


def test_what_three_runs_saw_is_counted_once(halves: Halves) -> None:
    """Two runs found object 4 again, one of them in two pieces."""
    outcome = MergeOutcome(halves.merged, halves.outcome.poses, united=[(4, 1, 4), (4, 2, 7), (4, 2, 8), (5, 2, 1)])
    assert outcome.shared_objects == 2


@pytest.mark.long("a run of another room is made")
def test_two_rooms_are_refused_by_name(
    halves: Halves, places: Path, tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    other = generated_recording(tmp_path_factory, "corridor", frames=6, width=160, height=120, seed=1, scene="corridor")
    elsewhere = run_of(other, places / "elsewhere", 0, 6)
    done = ggslam("merge", halves.first.path, elsewhere, "--out", tmp_path / "out")
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    assert f"{elsewhere}: no common ground with {halves.first.path}" in done.stderr
    assert "needed" in done.stderr or "no keyframe" in done.stderr


def test_the_command_line_says_what_came_of_it(halves: Halves, tmp_path: Path) -> None:
    done = ggslam("merge", halves.first.path, halves.second.path, "--out", tmp_path / "out", "--steps", "0")
    assert done.returncode == 0 and "links believed" in done.stdout and f"wrote {tmp_path / 'out'}" in done.stdout
    assert "at the seams" not in done.stdout


def test_what_cannot_be_merged_is_said(halves: Halves, tmp_path: Path) -> None:
    first, second = halves.first.path, halves.second.path
    with pytest.raises(ConfigError, match="two runs.* 1$"):
        merge_runs([first], tmp_path / "out")
    with pytest.raises(ConfigError, match="first.* twice"):
        merge_runs([first, second, first], tmp_path / "out")
    with pytest.raises(ConfigError, match="`out`.*first"):
        merge_runs([first, second], first, overwrite=True)
    with pytest.raises(RunFolderError, match="whole.*`overwrite`"):
        merge_runs([first, second], halves.merged.path)
    shutil.copytree(first, tmp_path / "again")
    with pytest.raises(ConfigError, match="again.*first"):
        merge_runs([second, first, tmp_path / "again"], tmp_path / "out")
    edited = tmp_path / "edited"
    shutil.copytree(second, edited)
    (edited / "places.npz").unlink()
    mark = json.loads((edited / "run.json").read_text())
    (edited / "run.json").write_text(json.dumps({**mark, "edits": ["removed mug (7)"]}))
    with pytest.raises(RunFolderError, match=r"edited/places\.npz"):
        merge_runs([first, edited], tmp_path / "out")
    assert not (tmp_path / "out").exists()
