# SPDX-License-Identifier: Apache-2.0
"""Colour and depth out of step are told; frames at the start that are black, blurred or overexposed are not."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.sequences import open_sequence
from ggslam.sequences.step_doubts import doubt_steps
from ggslam.synthetic import write_synthetic_sequence

FRAMES = 24


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_sequence(tmp_path_factory.mktemp("steps") / "room", frames=FRAMES, width=160, height=120)


SPOILT = {
    "black": np.zeros_like,
    "blurred": lambda image: cv2.GaussianBlur(image, (0, 0), 6),
    "overexposed": lambda image: cv2.convertScaleAbs(image, alpha=4),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_bad_start_is_not_out_of_step(
    recording: Path, tmp_path: Path, spoil: Callable[[np.ndarray], np.ndarray]
) -> None:
    folder = shutil.copytree(recording, tmp_path / "room")
    for path in sorted((folder / "rgb").iterdir())[:3]:
        cv2.imwrite(str(path), spoil(cv2.imread(str(path))))
    doubt = doubt_steps(open_sequence(folder))
    assert doubt is None or not doubt.wrong


@pytest.mark.parametrize("late", [2, 1, 0])
def test_depth_that_is_frames_late_is_told(recording: Path, tmp_path: Path, late: int) -> None:
    folder = shutil.copytree(recording, tmp_path / "room")
    for name, left_out in (("rgb", range(late)), ("depth", range(FRAMES - late, FRAMES))):
        for k, path in enumerate(sorted((folder / name).iterdir())):
            if k in left_out:
                path.unlink()
            else:
                path.rename(path.with_name(f"{k - left_out.stop if name == 'rgb' else k:06d}.png"))
    doubt = doubt_steps(open_sequence(folder, truth=False))
    assert (0 if doubt is None or not doubt.wrong else doubt.behind) == late
