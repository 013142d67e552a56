# SPDX-License-Identifier: Apache-2.0
"""Records of a run: read as written, files of older versions, what is said of damaged ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import RunFolderError
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.runs.records.timing import TimingRecord

EYE = np.eye(4).tolist()
KEYFRAMES = {
    "keyframes": [{"index": 0, "frame": 3, "timestamp": 0.1, "T_world_camera": EYE, "iterations": 5}],
    "frames": [
        {"frame": 3, "source": 3, "timestamp": 0.1, "keyframe": 0, "T_keyframe_camera": EYE, "overlap": None,
         "rmse_m": 0.01, "status": "first", "reason": ""},
        {"frame": 4, "source": 4, "timestamp": 0.2, "keyframe": 0, "T_keyframe_camera": EYE, "overlap": 0.1,
         "rmse_m": 0.01, "status": "lost", "reason": "dark"},
    ],
}  # fmt: skip
CAMERA = {"width": 32, "height": 24, "fx": 30, "fy": 30.5, "cx": 15.5, "cy": 11.5}


def text_of(values: object) -> str:
    return json.dumps(values, indent=1) + "\n"


@pytest.mark.parametrize(("record", "values"), [
    (KeyframesRecord, KEYFRAMES),
    (RunRecord, {"ggslam": "0.0.1", "complete": True, "stopped_by": None}),
    (RunRecord, {"ggslam": "0.1.0", "complete": True, "stopped_by": None, "environment": {"torch": "2", "threads": 2},
                 "edits": ["removed mug"], "displaced": {"3": None}, "of_later": [1, 2.5]}),
    (SequenceRecord, {"open": {"path": "/a", "scale": 1, "topics": ["color=/c"]}, "camera": CAMERA, "frames": 7}),
    (TimingRecord, {"frames": 3, "frames_per_s": None, "wall_s": 2, "mapping": {"iterations": 4}, "gaussians": 9}),
    (LoopsRecord, {"seconds": 0.5, "events": [], "lost": [{"first": 2, "frames": 3, "seconds": 1, "after": None}]}),
    (MetricsRecord, {"images": {"held_out": {"psnr": 30.125, "lpips": None, "frames": 2}}, "notes": ["x"]}),
])  # fmt: skip
def test_a_record_is_written_as_it_was_read(record: type[RunRecord], values: object, tmp_path: Path) -> None:
    """Whole numbers stay whole, fields that an older file lacks stay away, unknown ones stay."""
    (tmp_path / record.FILE).write_text(text_of(values))
    read = record.read(tmp_path)
    (tmp_path / record.FILE).unlink()
    assert read.write(tmp_path).read_text() == text_of(values)


def test_poses_are_those_of_the_keyframes(tmp_path: Path) -> None:
    record = KeyframesRecord.of(KEYFRAMES)
    assert set(record.poses()) == {3} and record.keyframe_numbers() == {3}
    np.testing.assert_array_equal(record.poses()[3], np.eye(4))
    assert np.isnan(KeyframesRecord.of({**KEYFRAMES, "keyframes": [{"frame": 1, "T_world_camera": [[None]]}]})
                    .keyframes[0].T_world_camera).all()  # fmt: skip


def test_lost_and_found_are_told_once(tmp_path: Path) -> None:
    lost = {"first": 4, "frames": 2, "seconds": 0.25}
    found = {"kind": "found again", "frame": 6, "keyframe": 3, "old_keyframe": 1, "reason": "12 inliers"}
    closed = {"kind": "closed", "frame": 9, "keyframe": 5, "old_keyframe": 0, "reason": "", "moved_m": 0.125}
    record = LoopsRecord.of({"events": [found, closed], "lost": [{**lost, "after": 6}, {**lost, "after": None}]})
    assert record.notes() == [
        "loop closed at frame 9: keyframe 5 moved 12.5 cm to keyframe 0",
        "lost for 2 frames (0.25 s) from frame 4, found again at frame 6: 12 inliers",
        "lost for 2 frames (0.25 s) from frame 4 and not found again",
    ]


@pytest.mark.parametrize(("record", "content", "words"), [
    (KeyframesRecord, "[]", "expected an object, found []"),
    (KeyframesRecord, "{}", "keyframes is missing"),
    (KeyframesRecord, '{"keyframes": [], "frames": [{"frame": 1}]}', r"frames[0].keyframe is missing"),
    (KeyframesRecord, '{"keyframes": [{"frame": 1, "T_world_camera": "x"}], "frames": []}',
     "keyframes[0].T_world_camera: expected a matrix of numbers, found 'x'"),
    (KeyframesRecord, "{", "cannot be read"),
    (RunRecord, '{"environment": "x"}', "environment: "),
    (RunRecord, '{"displaced": {"1": [1]}}', "displaced: "),
    (SequenceRecord, '{"open": 3, "camera": {}}', "open: expected an object, found 3"),
    (SequenceRecord, '{"open": {"path": "a"}, "camera": null}', "camera: expected width"),
    (SequenceRecord, '{"open": {"path": "a", "fold": 1}, "camera": null}', "open.fold: "),
    (TimingRecord, '{"frames": NaN}', "frames: "),
    (TimingRecord, '{"wall_s": NaN}', "wall_s: expected a finite number, found nan"),
    (TimingRecord, '{"paging": {"x": "y"}}', "paging.x: expected a finite number, found 'y'"),
    (MetricsRecord, '{"images": {"all": {"psnr": true}}}', "images.all.psnr: expected a finite number, found True"),
])  # fmt: skip
def test_damage_is_named(record: type[RunRecord], content: str, words: str, tmp_path: Path) -> None:
    (tmp_path / record.FILE).write_text(content)
    with pytest.raises(RunFolderError) as caught:
        record.read(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / record.FILE}: ") and words in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert MetricsRecord.read_if_there(tmp_path) is None
    with pytest.raises(RunFolderError, match=r"metrics\.json: .*missing"):
        MetricsRecord.read(tmp_path)


def test_the_whole_time_of_a_run_has_its_refinement() -> None:
    timing = TimingRecord.of({"wall_s": 2.0, "refinement_s": 3.0, "mapping": {"identity_finish": 0.5, "forward": 9.0}})
    assert timing.whole_s == 5.5
