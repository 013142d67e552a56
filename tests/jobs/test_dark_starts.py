# SPDX-License-Identifier: Apache-2.0
"""First frames that a camera took while it was still regulating itself do not colour the map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.saved_state import describe_state, restore_state
from ggslam.slam.slam import Slam

Image = Callable[[np.ndarray], np.ndarray]
HELD_OUT_FROM = 15
"""The first frame that is held out after the longest of the starts."""


def times(gain: float) -> Image:
    return lambda image: np.clip(np.rint(image * np.float32(gain)), 0, 255).astype(np.uint8)


STARTS: dict[str, list[Image]] = {
    "dark": [times(0.15), times(0.35), times(0.7)],
    "long dark": [times(0.1 * 10 ** (k / 10)) for k in range(10)],
    "overexposed": [times(4), times(3), times(1.8)],
    "saturated": [times(30)],
    "covered": [times(0)],
    "blurred": [lambda image: cv2.GaussianBlur(image, (0, 0), 4)],
}


def started(room: Path, folder: Path, start: list[Image]) -> Path:
    """The recording with its first colour images changed."""
    shutil.copytree(room, folder)
    for path, change in zip(sorted((folder / "rgb").iterdir()), start, strict=False):
        cv2.imwrite(str(path), change(cv2.imread(str(path))))
    return folder


def run(recording: Path, out: Path, *more: str) -> tuple[float, np.ndarray]:
    """Mean PSNR in dB of the held-out frames after the start, and colours [N, 3] of the map, of 255."""
    outcome = execute(RunRequest(SequenceRequest(recording), out=out, overrides=list(more)))
    assert outcome.error is None
    rows = [line.split(",") for line in (out / "frames.csv").read_text().splitlines()]
    column = rows[0].index("psnr")
    late = [float(row[column]) for row in rows[1:] if row[1] == "held_out" and int(row[0]) >= HELD_OUT_FROM]
    return float(np.mean(late)), 255 * RunFolder.open(out).gaussians().rgb.numpy()


@pytest.fixture(scope="module")
def usual(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[float, np.ndarray]:
    return run(room, tmp_path_factory.mktemp("usual") / "run")


@pytest.mark.long("runs a recording and scores it")
@pytest.mark.parametrize("kind", STARTS)
def test_the_map_is_as_bright_as_most_frames(
    room: Path, usual: tuple[float, np.ndarray], tmp_path: Path, kind: str
) -> None:
    psnr, colors = run(started(room, tmp_path / "recording", STARTS[kind]), tmp_path / "run")
    assert psnr > usual[0] - 2.5
    assert abs(np.median(colors) - np.median(usual[1])) < 12
    exposures = [k.exposure for k in RunFolder.open(tmp_path / "run").keyframes().keyframes]
    assert all(abs(exposure[:, 0] - 1).max() < 0.05 for exposure in exposures[-3:] if exposure is not None)


@pytest.mark.long("runs a recording and scores it")
def test_the_score_of_a_dark_map_is_in_the_range_of_its_frames(room: Path, tmp_path: Path) -> None:
    """With a map that stays dark: errors that are small in its own range."""
    recording = started(room, tmp_path / "recording", STARTS["dark"])
    run(recording, tmp_path / "run", "mapping.exposure.typical=10")
    keyframes = json.loads((tmp_path / "run" / "keyframes.json").read_text())
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["images"]["held_out"]["psnr_exposed"] < 36, keyframes["keyframes"][0]


def test_all_dark_frames_are_named(room: Path, tmp_path: Path) -> None:
    recording = started(room, tmp_path / "recording", [times(0.1)] * 24)
    run(recording, tmp_path / "run")
    notes = json.loads((tmp_path / "run" / "metrics.json").read_text())["notes"]
    assert any("the images are dark (mean colour 1" in note for note in notes)


def test_a_run_that_went_on_after_its_exposure_changed_is_the_same(room: Path, tmp_path: Path) -> None:
    sequence = open_sequence(started(room, tmp_path / "recording", STARTS["dark"]), stop=14)
    config = load_config(None, ["mapping.iterations_per_frame=1", "identity.enabled=false", "loops.enabled=false"])
    slams = [Slam(sequence.camera, config, False) for _ in range(2)]
    for frame in sequence.stream(masks=False):
        slams[0].step(frame)
        if frame.index == 3:  # its exposure changed, but what is typical is not known yet
            tree, arrays = describe_state(slams[0])
            restore_state(slams[1], json.loads(json.dumps(tree)), [array.copy() for array in arrays])
        elif frame.index > 3:
            slams[1].step(frame)
    one, other = (slam.finish() for slam in slams)
    assert one.keyframes[0].exposure[0, 0] < 0.3  # it was corrected
    assert np.array_equal(one.gaussians.sh.numpy(), other.gaussians.sh.numpy())
    exposures = [np.stack([k.exposure for k in result.keyframes]) for result in (one, other)]
    assert exposures[0].tobytes() == exposures[1].tobytes()
