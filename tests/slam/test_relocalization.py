# SPDX-License-Identifier: Apache-2.0
"""Lost frames are found, and a second recording starts in the map of the first."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError, RunFolderError
from ggslam.jobs.edit.edits import Edit, edit_run
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.verification import accept_files
from ggslam.scene.arrays import read_all_arrays
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.saved_places import PLACES_FILE
from ggslam.slam.slam import Slam

CHEAP = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=20", "identity.enabled=false"]


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_sequence(room).stream())


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
