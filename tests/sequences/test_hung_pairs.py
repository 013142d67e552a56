# SPDX-License-Identifier: Apache-2.0
"""Recordings whose colour and depth hang at once are told with their frames; cameras at rest are not."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ggslam.sequences import open_sequence
from ggslam.sequences.depth_doubts import DepthDoubts
from ggslam.sequences.hung_pairs import find_hung_pairs
from ggslam.sequences.hung_streams import Stretch
from ggslam.synthetic import write_synthetic_sequence

FRAMES = 24


def written(folder: Path, trajectory: str = "loop", noise: bool = True) -> Path:
    size = {"width": 160, "height": 120}
    write_synthetic_sequence(folder, frames=FRAMES, **size, seed=5, trajectory=trajectory, noise=noise)
    return folder


def hold_both(folder: Path, first: int, last: int, held: int | None = None) -> None:
    """Frames from `first` to `last` get the images of frame `held`; None: of the first of them."""
    for kind in ("rgb", "depth"):
        images = sorted((folder / kind).iterdir())
        source = images[first if held is None else held]
        for path in images[first : last + 1]:
            if path != source:
                shutil.copy(source, path)


@pytest.mark.parametrize(("first", "last", "remedy"), [(6, 23, "`stop` 7"), (0, 9, "`start` 9"), (5, 12, "again")])
def test_both_streams_hang(tmp_path: Path, first: int, last: int, remedy: str) -> None:
    folder = written(tmp_path / "room")
    hold_both(folder, first, last)
    sequence = open_sequence(folder)
    assert find_hung_pairs(sequence) == [Stretch(first, last)]
    (found,) = DepthDoubts(sequence).judge()
    assert (found.code, found.severity) == ("both_repeat", "doubtful")
    assert f"frames {first} to {last} hold the images of the first" in found.text and remedy in found.text


def test_without_noise_the_jump_where_images_go_on_tells(tmp_path: Path) -> None:
    folder = written(tmp_path / "room", noise=False)
    hold_both(folder, 5, 16)
    assert find_hung_pairs(open_sequence(folder)) == [Stretch(5, 16)]


def test_a_camera_without_noise_that_rests_and_goes_on_is_not_doubted(tmp_path: Path) -> None:
    folder = written(tmp_path / "room", noise=False)
    hold_both(folder, 0, 9, held=10)
    assert find_hung_pairs(open_sequence(folder)) == []
    hold_both(folder, 20, 23)
    assert find_hung_pairs(open_sequence(folder)) == []


@pytest.mark.parametrize("noise", [True, False])
@pytest.mark.parametrize("trajectory", ["still", "pan", "loop"])
def test_sound_recordings_are_not_doubted(tmp_path: Path, trajectory: str, noise: bool) -> None:
    folder = written(tmp_path / "room", trajectory, noise)
    assert find_hung_pairs(open_sequence(folder)) == []


def test_true_recordings_are_not_doubted(shared_data: Path) -> None:
    for name in ("redkitchen", "phone_scan", "hololens_walk", "rgbd_dataset_freiburg3_cabinet", "shelf"):
        assert find_hung_pairs(open_sequence(shared_data / name, scale=0.5)) == [], name
