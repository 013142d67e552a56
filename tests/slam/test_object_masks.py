# SPDX-License-Identifier: Apache-2.0
"""Objects in whole runs: whatever masks a recording has, or none."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import ConfigError, GgslamError, SequenceError
from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunOutcome, RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, open_recording_of
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.scene.frame import Frame
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.result import SlamResult
from ggslam.slam.slam import Slam

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "tools"))
from scramble_masks import scramble_recording  # noqa: E402

FAST = ["mapping.iterations_per_frame=2", "mapping.first_frame_iterations=10"]


def run(
    recording: Path, out: Path, *overrides: str, masks: Path | None = None, stop: int | None = None,
    scale: float | None = None,
) -> RunOutcome:  # fmt: skip
    request = SequenceRequest(recording, masks=masks, stop=stop, scale=scale)
    return execute(RunRequest(request, out, overrides=[*FAST, *overrides], evaluate=False))


def scores(outcome: RunOutcome) -> MetricsRecord:
    return score_run(outcome.folder, open_recording_of(outcome.folder), SilentObserver(), lpips=False, every=4)


def table(folder: Path) -> dict:
    return json.loads((folder / "objects.json").read_text())


@pytest.fixture(scope="module")
def own_ids(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunOutcome:
    return run(room, tmp_path_factory.mktemp("runs") / "own")


@pytest.fixture(scope="module")
def own_scores(own_ids: RunOutcome) -> MetricsRecord:
    return scores(own_ids)


def test_pictures_show_ids_where_scores_leave_pixels_out(own_ids: RunOutcome, room: Path, tmp_path: Path) -> None:
    """Masks of twice the size, moved by one of their pixels: along every outline two things share pixels half and
    half, which scores leave out and pictures do not."""
    folder = RunFolder(Path(shutil.copytree(own_ids.folder.path, tmp_path / "run")))
    (tmp_path / "masks").mkdir()
    for path in sorted((room / "masks").iterdir()):
        ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        moved = np.roll(ids.repeat(2, 0).repeat(2, 1), (1, 1), (0, 1))
        cv2.imwrite(str(tmp_path / "masks" / path.name), moved)
    recording = open_recording_of(folder, masks=tmp_path / "masks")
    [unshared] = [frame.mask for frame in recording.stream(masks="unshared") if frame.index == 0]
    assert unshared is not None and (unshared == 0).mean() > 0.02
    score_run(folder, recording, SilentObserver(), lpips=False, every=4)
    picture = cv2.imread(str(folder.path / "renders" / "compare000000.png"))[:, :, ::-1]
    height, width = unshared.shape
    drawn = picture[-height:, :width]
    unlabelled = (drawn == folder.object_table().palette()[0]).all(-1)
    assert unlabelled.mean() < 0.002


def test_masks_with_consistent_ids_are_learned_by_name(own_ids: RunOutcome, own_scores: MetricsRecord) -> None:
    content = table(own_ids.folder.path)
    assert content["supervision"] == "masks"
    names = {record["name"] for record in content["objects"]}
    assert {"floor", "sofa", "coffee table"} <= names
    held_out = own_scores.segmentation.held_out
    assert held_out.miou > 0.75 and held_out.votes_miou > 0.7 and held_out.accuracy > 0.95
    assert own_scores.segmentation.matching == "same"
    assert own_scores.segmentation.gaussians.accuracy > 0.9


def test_objects_cost_no_quality(room: Path, tmp_path: Path, own_scores: MetricsRecord) -> None:
    plain = scores(run(room, tmp_path / "plain", "identity.enabled=false"))
    assert plain.images == own_scores.images
    assert not (tmp_path / "plain" / "objects.json").exists() and plain.segmentation is None


@pytest.mark.long("two whole runs")
def test_shuffled_ids_become_objects(room: Path, tmp_path: Path) -> None:
    scramble_recording(room, tmp_path / "masks", 0, 0.2, 0.05, 0.01)
    outcome = run(room, tmp_path / "run", masks=tmp_path / "masks")
    assert table(tmp_path / "run")["supervision"] == "associated masks"
    truth = open_recording_of(outcome.folder, masks=room / "masks")
    metrics = score_run(outcome.folder, truth, SilentObserver(), lpips=False, every=2, masks=room / "masks")
    assert metrics.segmentation.matching == "assignment"
    assert metrics.segmentation.all.miou > 0.5  # by one-to-one matching; 24 small frames with large steps
    assert metrics.segmentation.all.accuracy > 0.7


def test_without_masks_geometry_finds_objects(room: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(room, bare)
    shutil.rmtree(bare / "masks")
    run(bare, tmp_path / "run")
    content = table(tmp_path / "run")
    assert content["supervision"] == "geometry" and len(content["objects"]) >= 5
    assert all(record["name"] is None for record in content["objects"])
    labelled = sum(record["gaussians"] for record in content["objects"])
    assert labelled > 2 * content["unlabelled_gaussians"]


@pytest.mark.parametrize("kind", ["empty", "one id", "half the files", "other size"])
def test_masks_of_any_kind_are_handled(room: Path, tmp_path: Path, kind: str) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for number, path in enumerate(sorted((room / "masks").glob("*.png"))):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if kind == "empty":
            mask[:] = 0
        elif kind == "one id":
            mask[:] = 7
        elif kind == "other size":
            mask = mask[::2, ::2]
        elif number % 2:
            continue
        cv2.imwrite(str(masks / path.name), mask)
    run(room, tmp_path / "run", masks=masks, stop=12, scale=0.5)
    if kind == "empty":
        assert not (tmp_path / "run" / "objects.json").exists()
        return
    ids = [record["id"] for record in table(tmp_path / "run")["objects"]]
    assert ids == [7] if kind == "one id" else len(ids) > 8


def test_a_model_plugs_in(room: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nothere.onnx"):
        run(room, tmp_path / "run", f"masks.model={tmp_path / 'nothere.onnx'}")


def slam_result(frames: list[Frame], *overrides: str, has_masks: bool | None = None) -> SlamResult:
    slam = Slam(frames[0].camera, load_config(None, [*FAST, *overrides]), has_masks)
    for frame in frames:
        slam.step(frame)
    return slam.finish()


def test_from_python_the_first_keyframe_tells_whether_there_are_masks(room: Path) -> None:
    frames = list(open_sequence(room).stream())[:8]
    result = slam_result(frames)
    assert result.objects is not None and result.objects.supervision == "masks"
    bare = slam_result([dataclasses.replace(frame, mask=None) for frame in frames])
    assert bare.objects is not None and bare.objects.supervision == "geometry"
    none = slam_result(frames, "masks.source=none")
    assert none.objects is None and none.gaussians.features.shape[1] == 0
    assert result.objects.observations and all(o.views >= 1 for o in result.objects.observations.values())


def test_a_mask_of_a_wrong_size_is_refused_by_name(room: Path) -> None:
    frame = open_sequence(room).frame(0)
    with pytest.raises(SequenceError, match=r"frame 0: .*uint16 \[3, 3\]"):
        slam_result([dataclasses.replace(frame, mask=np.ones((3, 3), np.uint16))])


def test_masks_that_are_asked_for_must_be_there(room: Path) -> None:
    frame = open_sequence(room).frame(0)
    with pytest.raises(SequenceError, match="masks"):
        slam_result([frame], "masks.source=recording", has_masks=False)


class Notes(SilentObserver):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def test_masks_that_help_nothing_are_said_so(room: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for path in (room / "masks").glob("*.png"):
        (empty / path.name).write_bytes(cv2.imencode(".png", np.zeros((120, 160), np.uint16))[1].tobytes())
    notes = Notes()
    request = SequenceRequest(room, masks=empty, stop=4)
    execute(RunRequest(request, out=tmp_path / "run", evaluate=False, overrides=FAST), notes)
    assert any("no objects were learned" in note for note in notes.notes)


def test_masks_of_other_frames_are_refused_and_leave_no_folder(room: Path, tmp_path: Path) -> None:
    late = tmp_path / "late"
    late.mkdir()
    last = sorted((room / "masks").glob("*.png"))[-1]
    shutil.copy(last, late / last.name)
    with pytest.raises(SequenceError, match="late"):
        execute(RunRequest(SequenceRequest(room, masks=late, stop=4), out=tmp_path / "run"))
    (tmp_path / "bad.onnx").write_bytes(b"no model")
    with pytest.raises(GgslamError, match=r"bad\.onnx"):
        execute(RunRequest(SequenceRequest(room), tmp_path / "run", overrides=[f"masks.model={tmp_path}/bad.onnx"]))
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match=r"masks\.model"):
        execute(RunRequest(SequenceRequest(room), tmp_path / "run", overrides=["masks.source=model"]))


def deva_masks(recording: Path, out: Path, gone: range) -> dict[int, int]:
    """A recording's masks as DEVA writes them: ids above 65535 as colours, and pred.json, which lists the segments of
    each frame. The object that most frames show vanishes in some and comes back with its id. Returns code by id."""
    (out / "Annotations").mkdir(parents=True)
    masks = {path: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((recording / "masks").iterdir())}
    ids = np.unique(np.concatenate([np.unique(mask) for mask in masks.values()]))
    codes = {int(i): 70_001 * int(i) for i in ids if i}
    lost = max(codes, key=lambda i: sum((mask == i).any() for mask in masks.values()))
    frames = []
    for number, (path, mask) in enumerate(masks.items()):
        seen = np.where(mask == lost, 0, mask) if number in gone else mask
        coded = 70_001 * seen.astype(np.int64)
        cv2.imwrite(str(out / "Annotations" / path.name), np.stack([coded >> 16, coded >> 8 & 255, coded & 255], -1))
        segments = [{"id": codes[int(i)], "isthing": True, "score": 0.9} for i in np.unique(seen) if i]
        frames.append({"file_name": path.name, "segments_info": segments})
    (out / "pred.json").write_text(json.dumps({"annotations": frames}))
    return codes


def test_deva_masks_of_a_moving_camera(room: Path, own_scores: MetricsRecord, tmp_path: Path) -> None:
    """Objects come into view, vanish and come back: each stays one, and the map is as right as with all masks."""
    codes = deva_masks(room, tmp_path / "deva", range(6, 14))
    outcome = run(room, tmp_path / "run", masks=tmp_path / "deva")
    assert table(outcome.folder.path)["supervision"] == "masks"  # ids are taken as they are
    listed = {entry["id"] for entry in table(outcome.folder.path)["objects"]}
    assert listed <= set(range(1, len(codes) + 1))  # one id for each code, in their order
    truth = open_recording_of(outcome.folder, masks=room / "masks")
    found = score_run(outcome.folder, truth, SilentObserver(), lpips=False, every=4)
    miou = found.number("segmentation", "all", "miou")
    usual = own_scores.number("segmentation", "all", "miou")
    assert miou is not None and usual is not None and miou > usual - 0.02
