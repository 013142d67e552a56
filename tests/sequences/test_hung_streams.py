# SPDX-License-Identifier: Apache-2.0
"""Streams that hang, noise, and one repeated frame are told with their frames; sound rooms are not."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.sequences import open_sequence
from ggslam.sequences.depth_doubts import DepthDoubts
from ggslam.sequences.hung_streams import Stretch, find_hung
from ggslam.sequences.thumbnails import thumbnails_of
from ggslam.synthetic import write_synthetic_sequence

FRAMES = 24
KINDS = {"color": "rgb", "depth": "depth"}


@pytest.fixture
def spoilt(room: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room, tmp_path / "spoilt"))


def paths(folder: Path, kind: str) -> list[Path]:
    return sorted((folder / kind).iterdir())


def hold(folder: Path, kind: str, first: int, last: int) -> None:
    images = paths(folder, kind)
    for path in images[first + 1 : last + 1]:
        shutil.copy(images[first], path)


def edit(folder: Path, kind: str, change: Callable[[np.ndarray], np.ndarray], first: int = 0) -> None:
    for path in paths(folder, kind)[first:]:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None and cv2.imwrite(str(path), change(image))


def told(folder: Path) -> dict[str, tuple[str, str]]:
    return {verdict.code: (verdict.severity, verdict.text) for verdict in DepthDoubts(open_sequence(folder)).judge()}


@pytest.mark.parametrize("kind", ["color", "depth"])
@pytest.mark.parametrize(("first", "last"), [(0, 23), (0, 11), (9, 23), (6, 16)])
def test_a_stream_that_hangs_is_told_with_its_frames(spoilt: Path, kind: str, first: int, last: int) -> None:
    hold(spoilt, KINDS[kind], first, last)
    sequence = open_sequence(spoilt)
    (found,) = find_hung(sequence, thumbnails_of(sequence), kind)
    assert (found.first, found.last) == (first, last)
    severity, text = told(spoilt)[f"{kind}_repeats"]
    assert severity == "doubtful" and f"{last - first + 1} of {FRAMES} frames, {first} to {last}," in text
    at_one_end = {(0, 11): "`start` 11", (9, 23): "`stop` 10"}.get((first, last), "record again")
    assert at_one_end in text


def test_colour_that_was_compressed_again_hangs_too(spoilt: Path) -> None:
    """No two files are the same; the last of the frames is found by halving."""
    random = np.random.default_rng(0)
    hold(spoilt, "rgb", 7, 19)
    edit(spoilt, "rgb", lambda i: np.clip(i.astype(int) + random.integers(-1, 2, i.shape), 0, 255).astype(np.uint8))
    sequence = open_sequence(spoilt)
    assert find_hung(sequence, thumbnails_of(sequence), "color") == [Stretch(7, 19)]
    few = [view for view in thumbnails_of(sequence) if view.index % 4 == 0]
    assert find_hung(sequence, few, "color") == [Stretch(7, 19)]


def test_colour_of_changing_compression_is_one_stretch(spoilt: Path) -> None:
    """Of 95, then 72 per cent: these differ too much to be taken for one image at first."""
    hold(spoilt, "rgb", 7, 23)
    for k, path in enumerate(paths(spoilt, "rgb")):
        image = cv2.imread(str(path))
        assert image is not None and cv2.imwrite(str(path.with_suffix(".jpg")), image, [1, 95 if k < 15 else 72])
        path.unlink()
    sequence = open_sequence(spoilt)
    assert find_hung(sequence, thumbnails_of(sequence), "color") == [Stretch(7, 23)]
    assert told(spoilt)["color_repeats"][1].endswith("try `stop` 8")


def test_depth_that_hangs_with_fresh_noise(spoilt: Path) -> None:
    """No two files are the same, nor two small views."""
    random = np.random.default_rng(0)
    hold(spoilt, "depth", 6, 23)
    edit(spoilt, "depth", lambda i: np.rint(i * (1 + random.normal(0, 0.002, i.shape))).astype(np.uint16))
    sequence = open_sequence(spoilt)
    assert find_hung(sequence, thumbnails_of(sequence), "depth") == [Stretch(6, 23)]


def test_a_lamp_before_a_tripod_is_no_depth_that_hangs(tmp_path: Path) -> None:
    """From frame 8 on one half of the image is lit by a third of the light, and the other by more: depth goes on."""
    folder = tmp_path / "room"
    write_synthetic_sequence(folder, frames=16, width=160, height=120, seed=4, trajectory="still")
    light = np.linspace(0.3, 1.4, 160)[None, :, None]
    edit(folder, "rgb", lambda i: np.clip(i * light, 0, 255).astype(np.uint8), first=8)
    sequence = open_sequence(folder)
    views = thumbnails_of(sequence)
    assert views[0].same_depth(views[-1]) and views[0].color_moved(views[-1])
    assert find_hung(sequence, views, "depth") == []


def test_every_other_image_is_told_as_repeats(spoilt: Path) -> None:
    for first in range(0, FRAMES, 2):
        hold(spoilt, "rgb", first, first + 1)
    assert told(spoilt)["color_repeats"][1].endswith("try `stride` 2")


def noise(image: np.ndarray) -> np.ndarray:
    most = 20000 if image.ndim == 2 else 256
    return np.random.default_rng(int(image.sum())).integers(0, most, image.shape).astype(image.dtype)


def test_noise_is_told(spoilt: Path) -> None:
    edit(spoilt, "rgb", noise)
    assert {code: severity for code, (severity, _) in told(spoilt).items()} == {"color_noise": "doubtful"}
    edit(spoilt, "depth", noise)
    found = told(spoilt)
    assert [found[code][0] for code in ("color_noise", "depth_noise")] == ["doubtful", "wrong"] and len(found) == 2
    share = int(found["depth_noise"][1].partition("in all frames: ")[2].partition("%")[0])
    assert share <= 8  # two uniform values lie within 5 % of each other in 5 % of the cases
    assert abs(float(found["color_noise"][1].partition("a correlation of ")[2].split(",")[0])) < 0.05


def test_noise_of_some_frames_is_a_doubt_that_names_them(spoilt: Path) -> None:
    edit(spoilt, "depth", noise, first=15)
    severity, text = told(spoilt)["depth_noise"]
    assert severity == "doubtful" and "in 9 of 24 frames that were looked at, from 15 to 23" in text


@pytest.mark.long("rooms that are drawn")
def test_colour_of_another_room_does_not_belong_to_depth(spoilt: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    write_synthetic_sequence(other, frames=FRAMES, width=160, height=120, seed=7, trajectory="pan")
    for path, image in zip(paths(spoilt, "rgb"), paths(other, "rgb"), strict=True):
        shutil.copy(image, path)
    severity, text = told(spoilt)["unrelated"]
    assert "cropped" in text and "`depth_delay`" in text and "JPEG" in text
    assert severity == "doubtful" and float(text.partition("strength ")[2].split(",")[0]) < 0.2


def test_one_frame_shows_no_motion(spoilt: Path) -> None:
    assert "one frame shows no motion" in DepthDoubts(open_sequence(spoilt, stop=1)).judge()[0].text
    assert "2 frames show no motion" in DepthDoubts(open_sequence(spoilt, stop=2)).judge()[0].text
    assert DepthDoubts(open_sequence(spoilt, stop=3)).judge() == []
    for kind in KINDS.values():
        hold(spoilt, kind, 0, 23)
    assert told(spoilt).keys() == {"no_motion"} and "all 24 frames hold the same images" in told(spoilt)["no_motion"][1]


@pytest.mark.long("rooms that are drawn")
@pytest.mark.parametrize(
    ("path", "movers", "seed"), [("loop", (), 3), ("still", (), 4), ("still", ("walker", "mug"), 5), ("pan", (), 6)]
)
def test_nothing_is_said_of_sound_rooms(tmp_path: Path, path: str, movers: tuple[str, ...], seed: int) -> None:
    """A camera on a tripod records the same colour beside depth that differs by its noise only."""
    size = {"width": 160, "height": 120}
    write_synthetic_sequence(tmp_path / "room", frames=30, **size, seed=seed, trajectory=path, movers=movers)
    assert told(tmp_path / "room") == {}


def test_nothing_is_said_of_true_recordings(shared_data: Path) -> None:
    for name in ("redkitchen", "phone_scan", "hololens_walk", "rgbd_dataset_freiburg3_cabinet", "shelf"):
        sequence = open_sequence(shared_data / name, scale=0.5)
        views = thumbnails_of(sequence)
        assert [find_hung(sequence, views, kind) for kind in KINDS] == [[], []], name
        assert min(view.grain for view in views) > 0.8 and min(view.surface for view in views) > 0.9, name
